"""One episode as it was flown, on either backend."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from jaxdrones import rotation
from jaxdrones.engine.step import HostStep
from jaxdrones.envs import Env
from jaxdrones.flights.record import Record
from jaxdrones.state import State


class Episode(flax.struct.PyTreeNode):
    """K control steps of n drones, to the end of the episode."""

    t: np.ndarray
    """(K,) s."""
    drones: State
    """(K, n, ...) after every control step."""
    target: np.ndarray
    """(K, n, 3) where they should be, m."""
    reward: np.ndarray
    """(K, n)"""
    metrics: dict[str, np.ndarray]
    """(K, n) of each of the task's metrics."""
    ends: tuple[str, ...]
    """What ended it, of the task's ends and limits; nothing when time was up."""
    success: bool | None
    """Whether all drones did what they should; `None` where the task does not say what that is."""


@dataclasses.dataclass(frozen=True)
class PolicyFlight:
    """What a policy flew, and under which conditions; the conditions of a record."""

    run: str
    task: str
    algorithm: str
    realistic: bool
    backend: str
    seed: int
    vehicle: str
    """A bundled vehicle or the path of a URDF."""
    options: dict[str, Any]
    """Of `jaxdrones.make`."""

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return dataclasses.asdict(self)

    def __str__(self) -> str:
        options = "".join(f", {name} {x}" for name, x in self.options.items())
        backend = "Bullet" if self.backend == "bullet" else f"the {self.backend} backend"
        return (
            f"{self.task} by {self.algorithm}{', realistic' * self.realistic}{options}, "
            f"policy of {self.run}, on {backend}, seed {self.seed}"
        )


def record_of(episode: Episode, flight: PolicyFlight) -> Record:
    """The log of an episode, as other flights have it."""
    drones = jax.tree.map(np.asarray, episode.drones)
    return Record(
        **vars(drones),
        t=episode.t,
        rpy=np.asarray(jax.vmap(jax.vmap(rotation.to_rpy))(jnp.asarray(drones.quat))),
        target_pos=episode.target,
        target_vel=np.full_like(episode.target, np.nan),
        labels=tuple(f"drone {i}" for i in range(drones.pos.shape[1])),
        conditions=flight,
    )


def fly_episode(
    env: Env, policy: Callable, key: jax.Array, tell: Callable[[float], Any] = lambda share: None
) -> Episode:
    """Fly one episode.

    Args:
        env: environment of either backend.
        policy: observations (n, d), or a dictionary with images, -> actions (n, a).
        key: of start and noise.
        tell: is told now and then which share of the longest episode is flown; with Bullet.
    """
    start_key, key = jax.random.split(key)
    keys = jax.random.split(key, env.steps)
    obs, world = env.reset(start_key)

    def step(carry, key):
        obs, world = carry
        obs, world, reward, terminated, truncated, info = env.step(key, world, policy(obs))
        seen = (
            world.drones,
            env.task.target_now(world).pos,
            reward,
            info["metrics"],
            info["terminations"] | info["truncations"],
        )
        return (obs, world), (seen, terminated | truncated)

    if isinstance(env.physics, HostStep):
        decide, rows = policy, []
        policy = jax.jit(lambda obs: decide(obs))
        for k in range(env.steps):
            (obs, world), (seen, over) = step((obs, world), keys[k])
            rows.append(jax.device_get(seen))
            tell((k + 1) / env.steps)
            if over:
                break
        flown = jax.tree.map(lambda *x: np.stack(x), *rows)
    else:
        _, (flown, over) = jax.jit(lambda *carry: jax.lax.scan(step, carry, keys))(obs, world)
        length = int(np.argmax(over)) + 1 if np.any(over) else env.steps
        flown = jax.tree.map(lambda x: np.asarray(x)[:length], flown)
    drones, target, reward, metrics, ends = flown
    length = len(reward)
    return Episode(
        t=env.dt * np.arange(1, length + 1),
        drones=drones,
        target=target,
        reward=reward,
        metrics=metrics,
        ends=tuple(name for name, ended in ends.items() if ended[-1]),
        success=_success(env, drones, metrics),
    )


def _success(env: Env, drones: State, metrics: dict[str, np.ndarray]) -> bool | None:
    """As `evaluate` judges: metrics stay what they were when the episode ended."""
    if env.task.success is None:
        return None
    missing = env.steps - len(drones.pos)
    whole = {name: jnp.asarray(np.pad(x, ((0, missing), (0, 0)), mode="edge")) for name, x in metrics.items()}
    return bool(jnp.all(env.task.success(whole, env.dt)) and np.isfinite(drones.pos).all())
