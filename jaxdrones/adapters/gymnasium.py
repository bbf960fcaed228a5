"""Gymnasium environments; the import registers `jaxdrones/Hover-v0`, ..., one id per task.

`gymnasium.make(id, **options)` makes one environment, `gymnasium.make_vec(id, num_envs, **options)` many of them in one
compiled step; the options are those of `jaxdrones.make`.
"""

import dataclasses
import string
from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from jaxdrones import envs
from jaxdrones.adapters import pictures
from jaxdrones.adapters.session import SEEDS, Session, TaskOrEnv, as_env, as_numpy, flat, rewarding
from jaxdrones.adapters.spaces import Layout
from jaxdrones.adapters.worlds import Worlds
from jaxdrones.arguments import Count, Switch, checked
from jaxdrones.checks import check_whole, look_up, short_repr
from jaxdrones.errors import UserError

NAMESPACE = "jaxdrones"


class GymnasiumEnv(gymnasium.Env):
    """One world.

    `info` has the terms of the reward (`reward_position`, ...), the metrics (`metric_...`) and the conditions
    (`termination_...`, `truncation_...`) of every drone.
    """

    metadata = {"render_modes": pictures.MODES, "render_fps": 100}  # noqa: RUF012

    @checked
    def __init__(
        self,
        task: TaskOrEnv,
        *,
        dict_spaces: Switch = False,
        team_reward: str = "sum",
        render_mode: pictures.RenderMode = None,
        **options: Any,
    ):
        """Wrap an environment.

        Args:
            task: as for `jaxdrones.make`, or an environment.
            dict_spaces: whether observations and actions are dicts by drone, "0", "1", ..., as in gym-pybullet-drones
                (2021); else a team has Box spaces (n, d) and (n, a), and a single drone (d,) and (a,).
            team_reward: reward of a team, `sum` or `mean` of the rewards of its drones.
            render_mode: `rgb_array` or `None`.
            **options: options of `jaxdrones.make`.
        """
        self.env, self.render_mode = as_env(task, options), render_mode
        self.metadata = self.metadata | {"render_fps": round(1 / self.env.dt)}
        self._layout, self._rewarding = _layout(self.env, dict_spaces), rewarding(team_reward)
        self.observation_space, self.action_space = self._layout.observation, self._layout.action
        self._session = Session(self.env)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode, reproducible by its seed."""
        super().reset(seed=seed)
        _refuse(options)
        obs = self._session.reset(int(self.np_random.integers(SEEDS)) if seed is None else seed)
        return self._layout.arrange(obs), {}

    def step(self, action: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """One control step.

        Raises:
            ValueError: an action of wrong shape or with NaN.
            gymnasium.error.ResetNeeded: before `reset`, or after the end of an episode.
        """
        if not self._session.running:
            raise gymnasium.error.ResetNeeded("step is called before reset or after the end of an episode; call reset")
        obs, reward, terminated, truncated, info = self._session.step(self._layout.gather(action))
        info = flat(info)
        if self.env.drones == 1:
            info = {name: x.item() for name, x in info.items()}
        return self._layout.arrange(obs), float(self._rewarding(reward)), terminated, truncated, info

    def render(self) -> np.ndarray | None:
        """Picture (height, width, 3) of the team from the side, with `render_mode="rgb_array"`."""
        return self._session.photo() if pictures.wanted(self.render_mode, self._session.world is not None) else None

    def close(self) -> None:
        """Close the connection to Bullet, if any."""
        self._session.close()


class VectorEnv(gymnasium.vector.VectorEnv):
    """Many worlds in one compiled step, by default with automatic reset in the same step.

    `infos` has the infos of one world as arrays, each with a mask `_name` of valid worlds. World i of a reset with
    `seed` starts like a `GymnasiumEnv` with `seed + i`. At the end of an episode with the autoreset mode `SAME_STEP`,
    `infos` has `final_obs`, of all worlds with its mask, and `final_info`, with the last infos of the episode and
    `episode`: return `r` and length `l`.
    """

    metadata = {"render_modes": pictures.MODES, "autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012

    @checked
    def __init__(
        self,
        task: TaskOrEnv,
        num_envs: Count = 1,
        *,
        dict_spaces: Switch = False,
        team_reward: str = "sum",
        numpy: Switch = True,
        max_episode_steps: Count | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.SAME_STEP,
        render_mode: pictures.RenderMode = None,
        **options: Any,
    ):
        """Wrap an environment.

        Args:
            task: as for `jaxdrones.make`, or an environment.
            num_envs: number of worlds.
            dict_spaces: as for `GymnasiumEnv`.
            team_reward: as for `GymnasiumEnv`.
            numpy: whether to return new NumPy arrays; else JAX arrays, without copies and asynchronous, with
                `final_obs` and `final_info` in every step.
            max_episode_steps: time limit in steps, in place of the task's duration.
            autoreset_mode: a mode of gymnasium or its value: `SAME_STEP`, reset in the step that ends an episode;
                `NEXT_STEP`, in the step after it, with its action ignored and zero reward; `DISABLED`, only by
                `reset(options={"reset_mask": ...})`.
            render_mode: `rgb_array` or `None`.
            **options: options of `jaxdrones.make`.
        """
        self.env, self.num_envs, self._numpy = as_env(task, options), num_envs, numpy
        if max_episode_steps is not None:
            self.env = dataclasses.replace(self.env, steps=max_episode_steps)
        mode = autoreset_mode.value if isinstance(autoreset_mode, AutoresetMode) else autoreset_mode
        self.autoreset_mode = look_up("autoreset_mode", mode, {known.value: known for known in AutoresetMode})
        self.render_mode = render_mode
        self.metadata = self.metadata | {"autoreset_mode": self.autoreset_mode, "render_fps": round(1 / self.env.dt)}
        self._layout = _layout(self.env, dict_spaces)
        self.single_observation_space, self.single_action_space = self._layout.observation, self._layout.action
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._worlds = Worlds(self.env, self._layout, self.autoreset_mode, team_reward)
        self._over = np.zeros(num_envs, bool)  # worlds that need a reset, in NumPy with autoreset disabled

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start an episode in every world, or in those of a mask, reproducible by seeds.

        Args:
            seed: seed of the first world, incremented for the others; or one for every world.
            options: `None`, or `reset_mask`: (num_envs,) bool, the worlds to reset.

        Raises:
            ValueError: a wrong number of seeds, a wrong mask, or an unknown option.
            gymnasium.error.ResetNeeded: a mask before the first reset of all worlds.
        """
        mask = self._mask(options)
        seeds = self._seeds(seed)
        obs = self._worlds.reset(seeds, mask)
        self._over &= False if mask is None else ~mask
        return self._out(obs), {}

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """One control step in every world.

        Raises:
            ValueError: actions of wrong shape or with NaN (not checked in JAX arrays).
            gymnasium.error.ResetNeeded: before `reset`, or after the end of an episode without autoreset (with
                `numpy=False` the episode continues).
        """
        if not self._worlds.started:
            raise gymnasium.error.ResetNeeded("step is called before reset; call reset")
        if self._over.any():
            raise gymnasium.error.ResetNeeded(
                f"the episodes of worlds {short_repr(np.flatnonzero(self._over))} have ended; call "
                'reset(options={"reset_mask": terminated | truncated})'
            )
        actions = self._layout.gather(actions, (self.num_envs,))
        obs, reward, terminated, truncated, info = self._out(self._worlds.step(actions))
        if self.autoreset_mode is AutoresetMode.DISABLED and self._numpy:
            self._over = terminated | truncated
        return obs, reward, terminated, truncated, self._infos(info, terminated | truncated)

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Picture (height, width, 3) of every world from the side, with `render_mode="rgb_array"`."""
        shown = pictures.wanted(self.render_mode, self._worlds.started)
        return tuple(pictures.of_worlds(self.env, self._worlds.world)) if shown else None

    def close_extras(self, **kwargs: Any) -> None:
        """Close the connection to Bullet, if any."""
        self.env.close()

    def _seeds(self, seed: int | Sequence[int | None] | None) -> np.ndarray:
        if not isinstance(seed, Sequence | np.ndarray):
            if seed is not None:
                check_whole("seed", seed, 0)
            super().reset(seed=None if seed is None else int(seed))
            first = int(self.np_random.integers(SEEDS)) if seed is None else int(seed)
            seeds = [first + i for i in range(self.num_envs)]
        else:
            if len(seed) != self.num_envs:
                raise UserError(f"seed has {len(seed)} entries; give one number, or one for each of {self.num_envs}")
            given = [x for x in seed if x is not None]
            for x in given:
                check_whole("an entry of seed", x, 0)
            super().reset(seed=int(given[0]) if given else None)
            seeds = [int(self.np_random.integers(SEEDS)) if x is None else int(x) for x in seed]
        return np.array([seed % SEEDS for seed in seeds], np.uint32)

    def _mask(self, options: dict[str, Any] | None) -> np.ndarray | None:
        """Mask of worlds in the options of `reset`; `None` for all."""
        if not options or "reset_mask" not in options:
            _refuse(options)
            return None
        _refuse({name: x for name, x in options.items() if name != "reset_mask"})
        mask = np.asarray(options["reset_mask"])
        if mask.shape != (self.num_envs,) or mask.dtype != bool:
            raise UserError(
                f"reset_mask has shape {mask.shape} and dtype {mask.dtype}; give ({self.num_envs},) of True and False"
            )
        if not self._worlds.started:
            raise gymnasium.error.ResetNeeded("a mask is given before the first reset of all worlds; call reset first")
        return mask

    def _out(self, tree: Any) -> Any:
        return as_numpy(tree) if self._numpy else tree

    def _infos(self, info: dict[str, Any], ended: Any) -> dict[str, Any]:
        """Infos with gymnasium's masks `_name` of valid worlds."""
        last, infos = info["last"], _masked(info["last"], info["not_reset"])
        if "final_obs" in info and (not self._numpy or ended.any()):
            final = _masked(last | {"episode": _masked(info["episode"], ended)}, ended)
            infos |= _masked({"final_obs": info["final_obs"], "final_info": final}, ended)
        return infos


def ids() -> dict[str, str]:
    """Id of every task by name."""
    return {task: f"{NAMESPACE}/{string.capwords(task, '-').replace('-', '')}-v0" for task in envs.TASKS}


def _layout(env: envs.Env, by_drone: bool) -> Layout:
    return Layout(env, [str(i) for i in range(env.drones)] if by_drone else None)


def _refuse(options: dict[str, Any] | None) -> None:
    if options:
        raise UserError(f"reset is called with the unknown options {', '.join(map(str, options))}; leave them out")


def _masked(values: dict[str, Any], mask: Any) -> dict[str, Any]:
    return values | {f"_{name}": mask for name in values}


for _task, _id in ids().items():
    if _id not in gymnasium.registry:
        gymnasium.register(
            _id, f"{__name__}:GymnasiumEnv", vector_entry_point=f"{__name__}:VectorEnv", kwargs={"task": _task}
        )
