"""Flying one episode with a policy, on either backend, and its log."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxdrones.engine.step import HostStep
from jaxdrones.envs import Env
from jaxdrones.flights.record import ImageSequence, LoggedConditions, Record
from jaxdrones.learning.recurrence import AnyPolicy, act, initial_memory
from jaxdrones.params import Params
from jaxdrones.pytree import PyTreeNode
from jaxdrones.sensing import Scene
from jaxdrones.state import State
from jaxdrones.training.presets import realism
from jaxdrones.visualization.viewer.show import records_of, refuse

_LOGGED = ("pos", "quat", "vel", "omega", "rpm")  # states that a `Record` holds


class EpisodeLog(PyTreeNode):
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
    images: dict[str, np.ndarray]
    """(K, n, ...) images that the policy observed, by kind; none of an environment without vision."""
    params: Params
    """Parameters of the team (n, ...), as drawn for this episode."""
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
    realistic: bool | str
    backend: str
    seed: int
    vehicle: str
    """Name of a bundled vehicle, path of a URDF, or `any vehicle`."""
    options: dict[str, Any]
    """Options of `jaxdrones.make`."""

    def as_dict(self) -> dict[str, Any]:
        """The conditions for JSON."""
        return dataclasses.asdict(self)

    def __str__(self) -> str:
        options = "".join(f", {name} {x}" for name, x in self.options.items())
        backend = "Bullet" if self.backend == "bullet" else f"the {self.backend} backend"
        return (
            f"{self.task} by {self.algorithm}{realism(self.realistic)}{options}, "
            f"policy of {self.run}, on {backend}, seed {self.seed}"
        )


def to_record(log: EpisodeLog, conditions: EpisodeConditions | LoggedConditions) -> Record:
    """The log of an episode in the form that demonstration flights have too."""
    drones = jax.tree.map(np.asarray, log.drones)
    return Record(
        **{name: getattr(drones, name) for name in _LOGGED},
        t=log.t,
        target_pos=log.target,
        target_vel=np.full_like(log.target, np.nan),
        labels=tuple(f"drone {i}" for i in range(drones.pos.shape[1])),
        conditions=conditions,
        params=log.params,
        scene=log.scene,
        images={name: _renewed(log.t, frames) for name, frames in log.images.items()},
    )


def _renewed(t: np.ndarray, frames: np.ndarray) -> ImageSequence:
    """Those of some images that differ from the one before."""
    new = np.flatnonzero(np.any(frames[1:] != frames[:-1], axis=tuple(range(1, frames.ndim)))) + 1
    rows = np.concatenate([[0], new])
    return ImageSequence(t[rows], frames[rows])


@records_of.register
def _(flight: EpisodeLog, of_trajectory: dict[str, Any]) -> list[Record]:
    refuse(of_trajectory)
    end = {"success": flight.success, "ended_by": list(flight.ended_by), "duration": float(flight.t[-1])}
    how = {True: ", success", False: ", no success", None: ""}[flight.success]
    why = f", ended by {', '.join(flight.ended_by)}" if flight.ended_by else ""
    return [to_record(flight, LoggedConditions(end, f"an episode of {flight.t[-1]:.2f} s{how}{why}"))]


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
    obs, start = env.reset(start_key)
    world = start
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
            world.images,
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
    drones, target, reward, metrics, ends, images = log
    length = len(reward)
    return EpisodeLog(
        t=env.dt * np.arange(1, length + 1),
        drones=drones,
        target=target,
        reward=reward,
        metrics=metrics,
        ended_by=tuple(name for name, ended in ends.items() if ended[-1]),
        images=images or {},
        params=jax.device_get(start.params),
        scene=jax.device_get(start.scene),
        success=_success(env, drones, metrics),
    )


def _success(env: Env, drones: State, metrics: dict[str, np.ndarray]) -> bool | None:
    """The criterion of `evaluate`, for which metrics keep their values after the end of the episode."""
    if env.task.success is None:
        return None
    missing = env.steps - len(drones.pos)
    padded = {name: jnp.asarray(np.pad(x, ((0, missing), (0, 0)), mode="edge")) for name, x in metrics.items()}
    return bool(jnp.all(env.task.success(padded, env.dt)) and np.isfinite(drones.pos).all())
