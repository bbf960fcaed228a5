"""Flying one episode with a policy, on either backend, and its log."""

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
from jaxdrones.learning.recurrence import AnyPolicy, act, initial_memory
from jaxdrones.sensing import Scene
from jaxdrones.state import State

_LOGGED = ("pos", "quat", "vel", "omega", "rpm")  # states that a `Record` holds


class EpisodeLog(flax.struct.PyTreeNode):
    """K control steps of n drones, up to the end of the episode."""

    t: np.ndarray
    """(K,) time, s."""
    drones: State
    """(K, n, ...) states after every control step."""
    target: np.ndarray
    """(K, n, 3) target positions, m."""
    reward: np.ndarray
    """(K, n)"""
    metrics: dict[str, np.ndarray]
    """(K, n) for each of the task's metrics."""
    ended_by: tuple[str, ...]
    """Names of the terminations and truncations that ended the episode; none if its time was up."""
    scene: Scene
    """What stood around, as drawn for this episode."""
    success: bool | None
    """Whether all drones met the task's criterion of success; `None` if the task has none."""


@dataclasses.dataclass(frozen=True)
class EpisodeConditions:
    """The conditions under which a policy flew an episode, for a `Record`."""

    run: str
    task: str
    algorithm: str
    realistic: bool
    backend: str
    seed: int
    vehicle: str
    """Name of a bundled vehicle, or path of a URDF."""
    options: dict[str, Any]
    """Options of `jaxdrones.make`."""

    def as_dict(self) -> dict[str, Any]:
        """The conditions for JSON."""
        return dataclasses.asdict(self)

    def __str__(self) -> str:
        options = "".join(f", {name} {x}" for name, x in self.options.items())
        backend = "Bullet" if self.backend == "bullet" else f"the {self.backend} backend"
        return (
            f"{self.task} by {self.algorithm}{', realistic' * self.realistic}{options}, "
            f"policy of {self.run}, on {backend}, seed {self.seed}"
        )


def to_record(log: EpisodeLog, conditions: EpisodeConditions) -> Record:
    """The log of an episode in the form that demonstration flights have too."""
    drones = jax.tree.map(np.asarray, log.drones)
    return Record(
        **{name: getattr(drones, name) for name in _LOGGED},
        t=log.t,
        rpy=np.asarray(jax.vmap(jax.vmap(rotation.to_rpy))(jnp.asarray(drones.quat))),
        target_pos=log.target,
        target_vel=np.full_like(log.target, np.nan),
        labels=tuple(f"drone {i}" for i in range(drones.pos.shape[1])),
        conditions=conditions,
    )


def fly_episode(
    env: Env, policy: AnyPolicy, key: jax.Array, on_progress: Callable[[float], Any] = lambda fraction: None
) -> EpisodeLog:
    """Fly one episode with a policy.

    Args:
        env: environment of either backend.
        policy: observations (n, d), or a dictionary with images, -> actions (n, a); or a policy with a memory, see
            `learning.recurrence`.
        key: random key of the start and of the noise.
        on_progress: function that shows which fraction of the longest possible episode is flown; called on Bullet only.
    """
    start_key, key = jax.random.split(key)
    keys = jax.random.split(key, env.steps)
    obs, world = env.reset(start_key)
    memory = initial_memory(policy, env.drones)

    def decide(memory, obs):
        return act(policy, memory, obs)

    def step(carry, key):
        memory, obs, world = carry
        memory, action = decide(memory, obs)
        obs, world, reward, terminated, truncated, info = env.step(key, world, action)
        row = (
            world.drones,
            env.task.target_now(world).pos,
            reward,
            info["metrics"],
            info["terminations"] | info["truncations"],
        )
        return (memory, obs, world), (row, terminated | truncated)

    if isinstance(env.physics, HostStep):
        decide, rows = jax.jit(decide), []
        for k in range(env.steps):
            (memory, obs, world), (row, done) = step((memory, obs, world), keys[k])
            rows.append(jax.device_get(row))
            on_progress((k + 1) / env.steps)
            if done:
                break
        log = jax.tree.map(lambda *x: np.stack(x), *rows)
    else:
        _, (log, done) = jax.jit(lambda *carry: jax.lax.scan(step, carry, keys))(memory, obs, world)
        length = int(np.argmax(done)) + 1 if np.any(done) else env.steps
        log = jax.tree.map(lambda x: np.asarray(x)[:length], log)
    drones, target, reward, metrics, ends = log
    length = len(reward)
    return EpisodeLog(
        t=env.dt * np.arange(1, length + 1),
        drones=drones,
        target=target,
        reward=reward,
        metrics=metrics,
        ended_by=tuple(name for name, ended in ends.items() if ended[-1]),
        scene=jax.device_get(world.scene),
        success=_success(env, drones, metrics),
    )


def _success(env: Env, drones: State, metrics: dict[str, np.ndarray]) -> bool | None:
    """The criterion of `evaluate`, for which metrics keep their values after the end of the episode."""
    if env.task.success is None:
        return None
    missing = env.steps - len(drones.pos)
    padded = {name: jnp.asarray(np.pad(x, ((0, missing), (0, 0)), mode="edge")) for name, x in metrics.items()}
    return bool(jnp.all(env.task.success(padded, env.dt)) and np.isfinite(drones.pos).all())
