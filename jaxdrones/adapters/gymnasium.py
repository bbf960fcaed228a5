"""Gymnasium: importing this registers `jaxdrones/Hover-v0`, ... one id per task.

`gymnasium.make(id, **options)` gives one environment, `gymnasium.make_vec(id, num_envs, **options)` many of them in one
compiled step; the options are those of `jaxdrones.make`.
"""

from __future__ import annotations

import copy
import functools
from typing import Any

import gymnasium
import jax
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from jaxdrones import envs
from jaxdrones.adapters.session import SEEDS, Session, as_env, begin
from jaxdrones.adapters.spaces import Layout
from jaxdrones.checks import check_whole
from jaxdrones.tasks.task import Task

NAMESPACE = "jaxdrones"


class GymnasiumEnv(gymnasium.Env):
    """One world. A team's reward is the sum over its drones; `info["rewards"]` has the terms of every drone by name."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 100}  # noqa: RUF012

    def __init__(
        self, task: str | Task | envs.Env, *, dict_spaces: bool = False, render_mode: str | None = None, **options: Any
    ):
        """Wrap an environment.

        Args:
            task: a name, a task, or an environment.
            dict_spaces: observations and actions are dicts by drone, "0", "1", ..., as in gym-pybullet-drones (2021);
                else a team has Box spaces (n, d) and (n, a), and a single drone (d,) and (a,).
            render_mode: `rgb_array` or nothing; pybullet renders the pictures, on both backends.
            **options: options of `jaxdrones.make`.

        Raises:
            ValueError: an argument that `jaxdrones.make` refuses.
        """
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode is {render_mode!r}; take 'rgb_array' or leave it out")
        self.env, self.render_mode = as_env(task, options), render_mode
        self.metadata = self.metadata | {"render_fps": round(1 / self.env.dt)}
        self._layout = _layout(self.env, dict_spaces)
        self.observation_space, self.action_space = self._layout.observation, self._layout.action
        self._session = Session(self.env)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode; the same seed starts the same one."""
        super().reset(seed=seed)
        _refuse(options)
        obs = self._session.reset(int(self.np_random.integers(SEEDS)) if seed is None else seed)
        return self._layout.arrange(obs), {}

    def step(self, action: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """One control step.

        Raises:
            ValueError: an action of wrong shape or with NaN.
            gymnasium.error.ResetNeeded: no episode has begun, or the last one has ended.
        """
        if not self._session.running:
            raise gymnasium.error.ResetNeeded("step is called before reset or after the end of an episode; call reset")
        obs, reward, terminated, truncated, info = self._session.step(self._layout.gather(action))
        if self.env.drones == 1:
            info["rewards"], info["metrics"] = (
                {k: v.item() for k, v in info[x].items()} for x in ("rewards", "metrics")
            )
        return self._layout.arrange(obs), float(reward.sum()), terminated, truncated, info

    def render(self) -> np.ndarray | None:
        """A picture (height, width, 3) of the team from the side, if made with `render_mode="rgb_array"`.

        Raises:
            ImportError: pybullet is not installed; says which extra to install.
            gymnasium.error.ResetNeeded: no episode has begun.
        """
        if self.render_mode is None:
            gymnasium.logger.warn('render is called without a render mode; make it with render_mode="rgb_array"')
            return None
        if self._session.world is None:
            raise gymnasium.error.ResetNeeded("render is called before reset; call reset")
        return self._session.photo()

    def close(self) -> None:
        """End the connection to Bullet, if there is one."""
        self._session.close()


class VectorEnv(gymnasium.vector.VectorEnv):
    """Many worlds in one compiled step; where an episode ends, the next one begins in the same step.

    `infos` has `rewards`, `metrics`, `terminations` and `truncations` by name. If an episode ended, it has `final_obs`
    (of all worlds; `_final_obs` says of which it is valid) and `final_info`, with the last infos of the episode and
    `episode`: return `r` and length `l`. World i, reset with `seed`, starts like a `GymnasiumEnv` that is reset with
    `seed + i`.
    """

    metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012

    def __init__(
        self,
        task: str | Task | envs.Env,
        num_envs: int = 1,
        *,
        dict_spaces: bool = False,
        numpy: bool = True,
        max_episode_steps: int | None = None,
        **options: Any,
    ):
        """Wrap an environment.

        Args:
            task: a name, a task, or an environment.
            num_envs: number of worlds.
            dict_spaces: as for `GymnasiumEnv`.
            numpy: return new NumPy arrays; else JAX arrays, not copied and not waited for, with `final_obs` and
                `final_info` in every step.
            max_episode_steps: truncate episodes after so many steps, not after the task's duration.
            **options: options of `jaxdrones.make`.

        Raises:
            ValueError: an argument that `jaxdrones.make` refuses.
        """
        check_whole("num_envs", num_envs)
        self.env, self.num_envs, self._numpy = as_env(task, options), num_envs, numpy
        if max_episode_steps is not None:
            check_whole("max_episode_steps", max_episode_steps)
            self.env = copy.copy(self.env)
            self.env.steps = max_episode_steps
        self._layout = _layout(self.env, dict_spaces)
        self.single_observation_space, self.single_action_space = self._layout.observation, self._layout.action
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._episodes = envs.AutoReset(self.env)
        self._compiled_reset = jax.jit(self._reset)
        self._compiled_step = jax.jit(self._step, donate_argnums=1)
        self._worlds = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode in every world; the same seed starts the same ones."""
        super().reset(seed=seed)
        _refuse(options)
        first = int(self.np_random.integers(SEEDS)) if seed is None else seed
        seeds = ((first + np.arange(self.num_envs)) % SEEDS).astype(np.uint32)
        self._keys, self._worlds, obs = self._compiled_reset(seeds)
        return self._out(obs), {}

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """One control step in every world.

        Raises:
            ValueError: actions of wrong shape or with NaN (JAX arrays are not searched for NaN).
            gymnasium.error.ResetNeeded: no episode has begun.
        """
        if self._worlds is None:
            raise gymnasium.error.ResetNeeded("step is called before reset; call reset")
        actions = self._layout.gather(actions, (self.num_envs,))
        self._worlds, outcome = self._compiled_step(self._keys, self._worlds, actions)
        obs, reward, terminated, truncated, info = self._out(outcome)
        return obs, reward, terminated, truncated, self._infos(info, terminated | truncated)

    def close_extras(self, **kwargs: Any) -> None:
        """End the connection to Bullet, if there is one."""
        self.env.close()

    def _reset(self, seeds: jax.Array):
        keys, episodes, obs = jax.vmap(functools.partial(begin, self._episodes))(seeds)
        return keys, (np.uint32(0), episodes), self._layout.arrange(obs, 1)

    def _step(self, keys: jax.Array, worlds: tuple, actions: jax.Array):
        count, episodes = worlds

        def step(key, episode, action):
            return self._episodes.step(jax.random.fold_in(key, count), episode, action)

        obs, episodes, reward, terminated, truncated, info = jax.vmap(step)(keys, episodes, actions)
        last = {"rewards": info["rewards"], "metrics": info["metrics"]}
        if self.env.drones == 1:
            last = jax.tree.map(lambda x: x[:, 0], last)
        last |= {name: info[name] for name in ("terminations", "truncations")}
        episode = {"r": info["episode"]["return"].sum(-1), "l": info["episode"]["length"]}
        info = {"last": last, "episode": episode, "final_obs": self._layout.arrange(info["final_obs"], 1)}
        return (count + 1, episodes), (self._layout.arrange(obs, 1), reward.sum(-1), terminated, truncated, info)

    def _out(self, tree: Any) -> Any:
        if not self._numpy:
            return tree
        return jax.tree.map(lambda x: np.array(x, np.float32 if x.dtype == np.float64 else None), tree)

    def _infos(self, info: dict[str, Any], ended: Any) -> dict[str, Any]:
        """The infos with gymnasium's masks: `_name` says of which worlds `name` is valid."""
        last, goes_on = info["last"], ~ended
        infos = _masked({name: _masked(group, goes_on) for name, group in last.items()}, goes_on)
        if not self._numpy or ended.any():
            final = {name: _masked(group, ended) for name, group in (last | {"episode": info["episode"]}).items()}
            infos |= _masked({"final_obs": info["final_obs"], "final_info": _masked(final, ended)}, ended)
        return infos


def ids() -> dict[str, str]:
    """Id of every task, by its name."""
    return {task: f"{NAMESPACE}/{_camel_case(task)}-v0" for task in envs.TASKS}


def _camel_case(name: str) -> str:
    return "".join(word.capitalize() for word in name.split("-"))


def _layout(env: envs.Env, by_drone: bool) -> Layout:
    return Layout(env, [str(i) for i in range(env.drones)] if by_drone else None)


def _refuse(options: dict[str, Any] | None) -> None:
    if options:
        raise ValueError(f"reset is called with options {', '.join(map(str, options))}; there are none, leave them out")


def _masked(values: dict[str, Any], mask: Any) -> dict[str, Any]:
    return values | {f"_{name}": mask for name in values}


for _task, _id in ids().items():
    if _id not in gymnasium.registry:
        gymnasium.register(
            _id, f"{__name__}:GymnasiumEnv", vector_entry_point=f"{__name__}:VectorEnv", kwargs={"task": _task}
        )
