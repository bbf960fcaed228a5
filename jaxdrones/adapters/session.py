"""One episode at a time on the host: NumPy in and out, one compiled call per control step."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.typing import ArrayLike

from jaxdrones.engine.step import HostStep
from jaxdrones.envs import AutoReset, Env, make
from jaxdrones.tasks.task import Task, World

SEEDS = 2**32  # a seed counts modulo this


class Session:
    """A world that stays on the device; what is seen of it comes in fresh arrays."""

    def __init__(self, env: Env):
        self.env = env
        self.world: World | None = None
        self.running = False
        """Whether an episode has begun and not ended."""
        on_host = isinstance(env.physics, HostStep)  # is called as it is, and compiles what is around it by itself
        self._begin: Callable[..., Any]
        self._advance: Callable[..., Any]
        self._begin, self._advance = (begin, _advance) if on_host else (_begin_compiled, _advance_compiled)

    def reset(self, seed: int) -> Any:
        """Start an episode; returns the observation."""
        self._key, self.world, obs = self._begin(self.env, np.uint32(seed % SEEDS))
        self.running = True
        return _numpy(obs)

    def step(self, action: np.ndarray) -> tuple[Any, np.ndarray, bool, bool, dict[str, Any]]:
        """One control step.

        Args:
            action: (n, a), checked.

        Returns:
            Observation, reward (n,), terminated, truncated and info, as the environment gives them.
        """
        self.world, outcome = self._advance(self.env, self._key, self.world, action)
        obs, reward, terminated, truncated, info = _numpy(outcome)
        terminated, truncated = bool(terminated), bool(truncated)
        self.running = not (terminated or truncated)
        info["ends"] = {name: bool(end) for name, end in info["ends"].items()}
        return obs, reward, terminated, truncated, info

    def photo(self) -> np.ndarray:
        """A picture of the team from the side: RGB (height, width, 3) uint8; taken by Bullet, whatever the backend.

        Raises:
            ImportError: pybullet is not installed; says which extra to install.
        """
        assert self.world is not None
        pos = np.asarray(self.world.drones.pos, float)
        center = pos.mean(axis=0)
        reach = 1.0 + np.abs(pos - center).max()  # m
        eye = center + reach * np.array([0.9, -1.2, 0.6])
        return self._photographer.photo(self.world.params, self.world.drones, eye, center)

    def close(self) -> None:
        """End what is connected to Bullet; the session cannot go on."""
        self.running = False
        self.env.close()
        if "_photographer" in vars(self):
            self._photographer.close()

    @functools.cached_property
    def _photographer(self):
        if isinstance(self.env.physics, HostStep):
            return self.env.physics
        from jaxdrones.engine import bullet  # an optional library behind it

        return bullet.make_step(scene=self.env.task.scene)


def made(task: str | Task | Env, options: dict[str, Any]) -> Env:
    """The environment that is meant by a name, a task, or an environment.

    Raises:
        ValueError: as of `jaxdrones.make`, or options beside an environment.
    """
    if not isinstance(task, Env):
        return make(task, **options)
    if options:
        raise ValueError(f"options {', '.join(options)} are given beside an environment; give them to jaxdrones.make")
    return task


def begin(env: Env | AutoReset, seed: ArrayLike) -> tuple[jax.Array, Any, Any]:
    """The key of an episode's steps, the world at its start, and what is seen of it."""
    key, start = jax.random.split(jax.random.PRNGKey(seed))
    obs, world = env.reset(start)
    return key, world, obs


def _advance(env: Env, key: jax.Array, world: World, action: np.ndarray) -> tuple[World, Any]:
    obs, world, *rest = env.step(jax.random.fold_in(key, world.step), world, action)
    return world, (obs, *rest)


_begin_compiled = jax.jit(begin, static_argnums=0)  # once for an environment, however many sessions it has
_advance_compiled = jax.jit(_advance, static_argnums=0)


def _numpy(tree: Any) -> Any:
    """Arrays of one's own, in single precision where they are real."""
    return jax.tree.map(lambda x: np.array(x, np.float32 if x.dtype == np.float64 else None), tree)
