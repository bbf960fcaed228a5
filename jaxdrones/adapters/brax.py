"""Brax environments for its trainers, with `wrap_for_training` and, from jax 0.10 on, `trainers`.

```python
from jaxdrones.adapters import brax
from brax.training.agents.ppo import train as ppo

env = jd.make("hover")
with brax.trainers():
    ppo.train(brax.wrap(env), episode_length=env.steps, wrap_env_fn=brax.wrap_for_training, ...)
```
"""

from __future__ import annotations

import contextlib
import functools
import sys
from collections.abc import Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from jaxdrones.adapters.session import TaskOrEnv, as_env, rewarding
from jaxdrones.arguments import Count, checked
from jaxdrones.errors import UserError, needs

with needs("brax", "brax"), contextlib.redirect_stdout(sys.stderr):  # mujoco prints what it could not import
    from brax.envs import base

_COLORED = 4  # axes of color images of a team
_NEXT = np.uint32(2**32 - 1)  # fold for the key of the next episode, above the number of steps of any episode


class BraxEnv(base.Env):
    """One world with one agent: actions and observations of the drones are concatenated.

    `metrics` has the weighted terms of the reward, and means of the task's metrics over the drones that
    have not ended their episodes.

    As in all of brax's environments, the time limit is the trainer's `episode_length`; give `env.steps`.
    `info["time_out"]` is 1 where the task truncated the episode. With images, observations are dictionaries for brax's
    vision networks: `state`, and `pixels/rgb`, `pixels/depth`, `pixels/segmentation` (h, w, channels), with the images
    of all drones as channels.
    """

    def __init__(self, env: TaskOrEnv, *, team_reward: str = "sum"):
        """Wrap an environment, or a task as for `jaxdrones.make`.

        The reward of a team is the `sum` or the `mean` of the rewards of its drones.
        """
        self.env, self._rewarding = as_env(env, {}), rewarding(team_reward)

    @property
    def observation_size(self) -> Any:
        """Length of the concatenated observation of all drones; with images the shape of every array by name."""
        size = self.env.drones * self.env.observation_size
        if not self.env.image_spaces:
            return size
        obs, _ = jax.eval_shape(self.env.reset, jax.random.key(0))
        return jax.tree.map(jnp.shape, jax.eval_shape(self._flat, obs))

    @property
    def action_size(self) -> int:
        """Length of the concatenated action of all drones."""
        return self.env.drones * self.env.action_size

    @property
    def backend(self) -> str:
        """Name of the simulator."""
        return "jaxdrones"

    def reset(self, rng: jax.Array) -> base.State:
        """Start an episode."""
        key, start = jax.random.split(rng)
        obs, world = self.env.reset(start)
        zero = jnp.zeros((), jnp.float32)
        shapes = jax.eval_shape(self.env.step, key, world, jnp.zeros((self.env.drones, self.env.action_size)))
        metrics = jax.tree.map(lambda _: zero, jax.eval_shape(self._metrics, shapes[-1]))
        return base.State((world, key), self._flat(obs), zero, zero, metrics, {"time_out": zero})

    def step(self, state: base.State, action: jax.Array) -> base.State:
        """One control step."""
        world, key = state.pipeline_state
        action = jnp.reshape(action, (self.env.drones, self.env.action_size))
        obs, world, reward, terminated, _, info = self.env.step(jax.random.fold_in(key, world.step), world, action)
        cut = functools.reduce(jnp.logical_or, info["truncations"].values(), jnp.zeros((), bool))
        if self.env.task.ends == "drone":  # the last drones decide, whatever the time limit of the task is
            ended = ~jnp.any(world.active)
            cut = ended & cut & ~info["terminated"]
            terminated = ended & ~jnp.any(cut)
        cut = jnp.any(cut)
        return state.replace(
            pipeline_state=(world, key),
            obs=self._flat(obs),
            reward=_float(self._rewarding(reward)),
            done=_float(terminated | cut),
            metrics=state.metrics | self._metrics(info),
            info=state.info | {"time_out": _float(cut & ~terminated)},
        )

    def _flat(self, obs: Any) -> Any:
        if not isinstance(obs, dict):
            return jnp.ravel(obs).astype(jnp.float32)
        images = {f"pixels/{name}": _channels(x) for name, x in obs.items() if name != "state"}
        return {"state": self._flat(obs["state"])} | images

    def _metrics(self, info: dict[str, Any]) -> dict[str, jax.Array]:
        rewards = {f"reward_{name}": _float(self._rewarding(x)) for name, x in info["rewards"].items()}
        count = jnp.maximum(jnp.sum(info["active"]), 1)
        means = {name: jnp.sum(jnp.where(info["active"], x, 0)) / count for name, x in info["metrics"].items()}
        return rewards | {name: _float(mean) for name, mean in means.items()}


wrap = BraxEnv
"""Wrap an environment for brax's trainers."""


class _Training(base.Wrapper):
    """Many worlds with automatic reset to a new random start."""

    def __init__(self, env: BraxEnv, episode_length: int):
        super().__init__(env)
        self.episode_length = episode_length

    def reset(self, rng: jax.Array) -> base.State:
        state = jax.vmap(self.env.reset)(rng)
        zero = jnp.zeros_like(state.done)
        sums = {name: zero for name in ("sum_reward", "length", *state.metrics)}
        info = {"steps": zero, "truncation": zero, "episode_done": zero, "episode_metrics": sums}
        return state.replace(info=state.info | info)

    def step(self, state: base.State, action: jax.Array) -> base.State:
        return jax.vmap(self._step)(state, action)

    def _step(self, state: base.State, action: jax.Array) -> base.State:
        again = 1 - state.done  # 0 in the first step of an episode
        info = state.info
        after = self.env.step(state, action)
        steps = again * info["steps"] + 1
        cut = after.info["time_out"] > 0
        terminated = (after.done > 0) & ~cut
        truncated = (cut | (steps >= self.episode_length)) & ~terminated
        done = terminated | truncated

        now = {"sum_reward": after.reward, "length": jnp.ones_like(steps), **after.metrics}
        before = jax.tree.map(lambda x: jnp.where(again > 0, x, 0), info["episode_metrics"])  # 0 * NaN would stay NaN
        sums = {name: total + now[name] for name, total in before.items()}
        info = after.info | {
            "steps": steps,
            "truncation": _float(truncated),
            "time_out": _float(truncated),
            "episode_done": _float(done),
            "episode_metrics": sums,
        }
        _, key = after.pipeline_state
        fresh = self.env.reset(jax.random.fold_in(key, _NEXT))
        place, obs = jax.tree.map(
            lambda new, old: jnp.where(done, new, old),
            (fresh.pipeline_state, fresh.obs),
            (after.pipeline_state, after.obs),
        )
        return after.replace(pipeline_state=place, obs=obs, done=_float(done), info=info)


@checked
def wrap_for_training(
    env: BraxEnv, episode_length: Count, action_repeat: int = 1, randomization_fn: Any = None
) -> base.Wrapper:
    """`wrap_env_fn` of the trainers: many worlds, each episode from a new random start.

    Brax's own wrapper starts every episode of a world from the same cached state. `info["truncation"]` and
    `info["time_out"]` are 1 where an episode was truncated, by `episode_length` or by the task.

    Args:
        env: environment of `wrap`.
        episode_length: control steps of an episode.
        action_repeat: must be 1; use a lower `control_hz` of the environment instead.
        randomization_fn: must be `None`; use `randomize` of the environment instead.

    Raises:
        ValueError: an unsupported argument.
    """
    if action_repeat != 1:
        raise UserError(
            f"action_repeat is {action_repeat}; leave it at 1 and make the environment with a lower control_hz"
        )
    if randomization_fn is not None:
        raise UserError("randomization_fn is given; leave it out and make the environment with randomize")
    return _Training(env, episode_length)


@contextlib.contextmanager
def trainers() -> Iterator[None]:
    """Context for brax 0.14.2's trainers with jax 0.10 and later.

    They call `jax.device_put_replicated`, which jax 0.10 removed (google/brax issue 671). The context adds it
    temporarily.
    """
    missing = not hasattr(jax, "device_put_replicated")
    if missing:
        jax.device_put_replicated = _device_put_replicated
    try:
        yield
    finally:
        if missing:
            del jax.device_put_replicated


def _device_put_replicated(x: Any, devices: Sequence[jax.Device]) -> Any:
    """Copy every array to every device, along a new leading axis, with the sharding of a `pmap` over "i"."""
    sharding = NamedSharding(Mesh(np.array(devices), ("i",)), PartitionSpec("i"))

    def put(leaf):
        copies = jnp.broadcast_to(jnp.asarray(leaf)[None], (len(devices), *jnp.shape(leaf)))
        return jax.device_put(copies, sharding)

    return jax.tree.map(put, x)


def _channels(image: jax.Array) -> jax.Array:
    """Images (n, h, w) or (n, h, w, c) of a team as one, (h, w, n c)."""
    image = image if image.ndim == _COLORED else image[..., None]
    return jnp.moveaxis(image, 0, -2).reshape(*image.shape[1:3], -1).astype(jnp.float32)


def _float(x: jax.Array) -> jax.Array:
    return x.astype(jnp.float32)
