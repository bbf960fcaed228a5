"""Episodes of a policy or of the policies in the history of a training, on either backend, and their logs."""

import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxdrones.engine.rollout import leg_length
from jaxdrones.engine.step import HostStep
from jaxdrones.envs import Env
from jaxdrones.errors import UserError
from jaxdrones.flights.log import FlightLog, ImageSequence, LoggedConditions, logged
from jaxdrones.learning.networks import AnyPolicy, act, initial_hidden_state
from jaxdrones.params import Params
from jaxdrones.pytree import PyTreeNode
from jaxdrones.sensing import Scene
from jaxdrones.state import State
from jaxdrones.training.run import Run
from jaxdrones.visualization.viewer.show import records_of, refuse

Decide = Callable[[Any, Any], tuple[Any, jax.Array]]
"""(hidden_state, observations) -> (hidden_state, actions)"""


class EpisodeLog(PyTreeNode):
    """Episode of n drones over K control steps."""

    t: np.ndarray
    """(K,) time, s."""
    drones: State
    """(K, n, ...) states after every control step."""
    target: np.ndarray
    """(K, n, 3) target positions, m."""
    reward: np.ndarray
    """(K, n)"""
    metrics: dict[str, np.ndarray]
    """(K, n) by metric of the task."""
    ended_by: tuple[str, ...]
    """Names of the terminations and truncations at the end; empty at the time limit."""
    images: dict[str, np.ndarray]
    """(K, n, ...) observed images by kind; empty without vision."""
    params: Params
    """Parameters of the team (n, ...) in this episode."""
    scene: Scene
    """Scene of this episode."""
    success: bool | None
    """Whether all drones met the task's criterion of success; `None` without one."""


def to_record(log: EpisodeLog, conditions: LoggedConditions) -> FlightLog:
    """Convert an episode to a `FlightLog`."""
    return FlightLog(
        **jax.tree.map(np.asarray, logged(log.drones)),
        t=log.t,
        target_pos=log.target,
        conditions=conditions,
        params=log.params,
        scene=log.scene,
        images={name: _renewed(log.t, frames) for name, frames in log.images.items()},
    )


def _renewed(t: np.ndarray, frames: np.ndarray) -> ImageSequence:
    """Images that differ from the one before."""
    new = np.flatnonzero(np.any(frames[1:] != frames[:-1], axis=tuple(range(1, frames.ndim)))) + 1
    rows = np.concatenate([[0], new])
    return ImageSequence(t[rows], frames[rows])


@records_of.register
def _(flight: EpisodeLog, of_trajectory: dict[str, Any]) -> list[FlightLog]:
    refuse(of_trajectory)
    end = {"success": flight.success, "ended_by": list(flight.ended_by), "duration": float(flight.t[-1])}
    how = {True: ", success", False: ", no success", None: ""}[flight.success]
    why = f", ended by {', '.join(flight.ended_by)}" if flight.ended_by else ""
    return [to_record(flight, LoggedConditions(end, f"an episode of {flight.t[-1]:.2f} s{how}{why}"))]


def fly_episode(
    env: Env,
    policy: AnyPolicy,
    key: jax.Array,
    on_progress: Callable[[float], Any] = lambda fraction: None,
    watch: Callable[[EpisodeLog, float], Any] | None = None,
) -> EpisodeLog:
    """Fly one episode with a policy, as of `evaluate`, on either backend.

    `on_progress` is called with the completed fraction of the longest possible episode, on Bullet only; `watch(leg,
    end)` with each 1/30 s of the episode and the latest possible end time, s.
    """
    start_key, key = jax.random.split(key)
    keys = jax.random.split(key, env.steps)
    obs, start = env.reset(start_key)
    world = start
    hidden_state = initial_hidden_state(policy, env.drones)

    def loop(carry, keys):
        rows = []
        for key in keys:
            carry, row = _step(env, decide, carry, key)
            rows.append(jax.device_get(row))
            on_progress((flown + len(rows)) / env.steps)
            if row[1]:
                break
        return carry, jax.tree.map(lambda *x: np.stack(x), *rows)

    def log(rows, first, success=None):
        drones, target, reward, metrics, ends, images, _ = rows
        return EpisodeLog(
            t=env.dt * np.arange(first + 1, first + len(reward) + 1),
            drones=drones,
            target=target,
            reward=reward,
            metrics=metrics,
            ended_by=tuple(name for name, ended in ends.items() if np.any(ended)),
            images=images or {},
            params=params,
            scene=scene,
            success=success,
        )

    fly: Callable
    decide: Decide = functools.partial(act, policy)
    if isinstance(env.physics, HostStep):
        decide, fly = jax.jit(decide), loop
    elif isinstance(policy, PyTreeNode):  # an argument, to share the program between policies of one shape
        fly = functools.partial(_compiled_leg, env, policy)
    else:
        fly = jax.jit(functools.partial(_leg, env, policy))
    params, scene = jax.device_get((start.params, start.scene))
    carry: Any = (hidden_state, obs, world)
    leg = env.steps if watch is None else leg_length(env.dt)
    flown, ended = 0, False
    parts: list[tuple] = []
    while flown < env.steps and not ended:
        ahead = np.arange(flown, flown + leg)
        used = ahead[ahead < env.steps] if fly is loop else np.minimum(ahead, env.steps - 1)  # one length: one program
        carry, (rows, done) = fly(carry, keys[used])
        count = min(int(np.argmax(done)) + 1 if np.any(done) else len(done), env.steps - flown)
        rows = jax.tree.map(lambda x, count=count: np.asarray(x)[:count], rows)
        parts.append(_held(rows, parts[-1] if parts else rows) if env.task.ends == "drone" else rows)
        if watch is not None:
            watch(log(parts[-1], flown), env.steps * env.dt)
        flown, ended = flown + count, bool(np.any(done[:count]))
    rows = jax.tree.map(lambda *x: np.concatenate(x), *parts)
    return log(rows, 0, _success(env, rows[0], rows[3], rows[4]))


def _step(env: Env, decide: Decide, carry: tuple, key: jax.Array) -> tuple[tuple, tuple]:
    """One control step of an episode: carry of the next step, and log of this one with its end flag."""
    hidden_state, obs, world = carry
    hidden_state, action = decide(hidden_state, obs)
    obs, world, reward, terminated, truncated, info = env.step(key, world, action)
    row = (
        world.drones,
        env.task.target_now(world).pos,
        reward,
        info["metrics"],
        info["terminations"] | info["truncations"],
        world.images,
        info["active"],
    )
    return (hidden_state, obs, world), (row, terminated | truncated)


def _held(rows: tuple, before: tuple) -> tuple:
    """Rows of a leg with the last values, of `before` it, of every drone whose episode has ended, and no reward."""
    reward = rows[2]  # zero after the end
    at = slice(0, 1) if before is rows else slice(-1, None)
    rows = jax.tree.map(lambda old, new: np.concatenate([old[at], new]), before, rows)
    active = rows[-1]
    last = np.maximum.accumulate(np.where(active, np.arange(len(active))[:, None], 0), axis=0)[1:]
    drones, target, _, *others = jax.tree.map(lambda x: x[last, np.arange(active.shape[1])], rows)
    return drones, target, reward, *others


def _leg(env: Env, policy: AnyPolicy, carry: tuple, keys: jax.Array) -> tuple[tuple, tuple]:
    return jax.lax.scan(functools.partial(_step, env, functools.partial(act, policy)), carry, keys)


_compiled_leg = jax.jit(_leg, static_argnums=0)


def _success(env: Env, drones: State, metrics: dict[str, np.ndarray], ends: dict[str, np.ndarray]) -> bool | None:
    """Whether an episode is a success, by the criterion of `evaluate`."""
    if env.task.success is None:
        return None
    missing = env.steps - len(drones.pos)
    padded = {name: jnp.asarray(np.pad(x, ((0, missing), (0, 0)), mode="edge")) for name, x in metrics.items()}
    ended = {name: np.any(x, axis=0) for name, x in ends.items()}
    return bool(jnp.all(env.task.succeeded(padded, ended, env.dt))) and bool(np.isfinite(drones.pos).all())


class Evaluated(NamedTuple):
    """Policy of an evaluation."""

    update: int
    """Number of updates before."""
    value: float
    """Success rate, or mean return of a task without success."""
    flight: EpisodeLog
    """An episode, with the same start for all policies."""


def fly_history(run: Run, env: Env) -> list[Evaluated]:
    """Fly an episode with every policy in the history of a run."""
    if not run.kept:
        raise UserError(
            f"{run.folder} holds no policies of its evaluations; train with --keep-history, or give that of one seed"
        )
    name = "evaluated_return" if env.task.success is None else "success"
    found = []
    for kept in run.kept:
        value = run.sidecar_entry(kept, "evaluation").get(name, math.nan)
        flight = fly_episode(env, run.policy(kept, env), jax.random.key(0))
        found.append(Evaluated(run.sidecar_entry(kept, "update"), value, flight))
    return found
