"""Evaluation of a policy over many episodes, with the confidence interval of its success rate."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxdrones.checks import check_key
from jaxdrones.engine.step import HostStep
from jaxdrones.envs import Env
from jaxdrones.learning import compilation
from jaxdrones.learning.recurrence import AnyPolicy, act, initial_memory
from jaxdrones.limits import LARGEST_COUNT, check_at_most, check_memory
from jaxdrones.pytree import PyTreeNode

_CHUNK = 1000  # episodes simulated at a time
_EPISODE_BYTES = 64  # memory that the results of an episode take per drone until the evaluation ends


class Report(PyTreeNode):
    """Results of an evaluation."""

    episodes: int
    success: float
    """Fraction of the episodes in which every drone met the task's criterion of success."""
    success_interval: tuple[float, float]
    """95 % confidence interval of `success` (Wilson)."""
    final_error: float
    """Mean distance from the target at the end of an episode, m."""
    final_error_percentiles: dict[int, float]
    """50th, 95th and 99th percentile of that distance over all drones, m."""
    rms_error: float
    """Root mean square distance from the target over the last four fifths of all episodes, m."""
    mean_return: float
    """Mean over drones and episodes of the sum of rewards."""
    mean_length: float
    """Mean length of an episode, s."""
    end_rates: dict[str, float]
    """Fraction of the episodes that ended by each termination or truncation of the task."""
    final_metrics: dict[str, float]
    """Mean over drones of each of the task's metrics at the end of an episode."""


def evaluate(env: Env, policy: AnyPolicy, key: jax.Array, episodes: int = 1000) -> Report:
    """Simulate whole episodes; after an episode has ended, its metrics keep their last values.

    Args:
        env: environment of either backend.
        policy: observations (n, d), or a dictionary with images, -> actions (n, a): a pytree, or any function; or a
            policy with a memory, see `learning.recurrence`.
        key: random key.
        episodes: number of episodes.

    Raises:
        ValueError: no random key, or more episodes than the memory holds.
    """
    check_key("key", key)
    check_episodes(env, episodes)
    keys = jax.random.split(key, episodes)
    if isinstance(policy, PyTreeNode):
        outcomes = _compiled_outcomes()(compilation.Static(env), policy, keys)
    else:
        outcomes = jax.jit(functools.partial(_outcomes, env, policy))(keys)
    return _report(env, jax.tree.map(np.asarray, outcomes))


def compile_evaluation(env: Env, policy: Any, episodes: int) -> Callable[[AnyPolicy, jax.Array], Report]:
    """`evaluate` of so many episodes, compiled for all policies of one structure: (policy, key) -> report.

    Args:
        env: environment of the explicit backend.
        policy: a policy that is a pytree, or the shapes of one.
        episodes: number of episodes.

    Raises:
        ValueError: more episodes than the memory holds.
    """
    check_episodes(env, episodes)
    split = functools.partial(jax.random.split, num=episodes)
    keys = jax.eval_shape(split, jax.random.key(0))
    leaves, structure = jax.tree.flatten(policy)
    function = compilation.jit(lambda leaves, keys: _outcomes(env, jax.tree.unflatten(structure, leaves), keys))
    outcomes = function.lower(leaves, keys).compile()
    return lambda policy, key: _report(env, jax.tree.map(np.asarray, outcomes(jax.tree.leaves(policy), split(key))))


def check_episodes(env: Env, episodes: int) -> None:
    """Raise if an evaluation of so many episodes needs more memory than there is."""
    check_at_most("episodes", episodes, LARGEST_COUNT)
    check_memory(f"an evaluation of {episodes:,} episodes", episodes * env.drones * _EPISODE_BYTES, "give fewer")


@functools.cache
def _compiled_outcomes() -> Callable:
    return compilation.jit(lambda env, policy, keys: _outcomes(env.value, policy, keys), static_argnums=0)


def _outcomes(env: Env, policy: AnyPolicy, keys: jax.Array) -> dict:
    """Outcomes of one episode per key, along a leading axis."""
    on_host = isinstance(env.physics, HostStep)  # which flies one world after the other, and rebuilds each one's scene
    chunk = None if on_host else min(_CHUNK, len(keys))
    return jax.lax.map(functools.partial(_outcome, env, policy), keys, batch_size=chunk)


def _outcome(env: Env, policy: AnyPolicy, key: jax.Array) -> dict:
    """The outcome of one episode; an episode in which a position is ever not finite is no success."""
    start_key, key = jax.random.split(key)
    obs, world = env.reset(start_key)
    info = jax.eval_shape(env.step, key, world, jnp.zeros((env.drones, env.action_size)))[-1]
    zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), _metrics_and_ends(info))

    def control_step(carry, key):
        memory, obs, world, diverged, done, last, episode_return, length = carry
        memory, action = act(policy, memory, obs)
        obs, world, reward, terminated, truncated, info = env.step(key, world, action)
        last = jax.tree.map(lambda new, old: jnp.where(done, old, new), _metrics_and_ends(info), last)
        episode_return = episode_return + jnp.where(done, 0, reward)
        length = length + ~done
        diverged = diverged | ~jnp.all(jnp.isfinite(world.drones.pos))
        return (memory, obs, world, diverged, done | terminated | truncated, last, episode_return, length), last[0]

    zero = jnp.zeros(env.drones, world.drones.pos.dtype)
    false = jnp.zeros((), bool)
    carry = (initial_memory(policy, env.drones), obs, world, false, false, zeros, zero, jnp.zeros((), jnp.int32))
    carry, metrics = jax.lax.scan(control_step, carry, jax.random.split(key, env.steps))
    _, _, _, diverged, _, (final_metrics, ends), episode_return, length = carry
    success = false if env.task.success is None else jnp.all(env.task.success(metrics, env.dt)) & ~diverged
    rms_error = jnp.sqrt(jnp.mean(metrics["error"][env.steps // 5 :] ** 2, axis=0))
    return {
        "success": success,
        "final_metrics": final_metrics,
        "ends": ends,
        "return": episode_return,
        "length": length,
        "rms_error": rms_error,
    }


def _metrics_and_ends(info: dict) -> tuple[dict, dict]:
    return info["metrics"], info["terminations"] | info["truncations"]


def _report(env: Env, outcomes: dict) -> Report:
    episodes = len(outcomes["success"])
    error = outcomes["final_metrics"]["error"]
    return Report(
        episodes=episodes,
        success=float(np.mean(outcomes["success"])),
        success_interval=wilson_interval(int(np.sum(outcomes["success"])), episodes),
        final_error=float(np.mean(error)),
        final_error_percentiles={q: float(np.percentile(error, q)) for q in (50, 95, 99)},
        rms_error=float(np.sqrt(np.mean(outcomes["rms_error"] ** 2))),
        mean_return=float(np.mean(outcomes["return"])),
        mean_length=float(np.mean(outcomes["length"]) * env.dt),
        end_rates={name: float(np.mean(ended)) for name, ended in outcomes["ends"].items()},
        final_metrics={name: float(np.mean(x)) for name, x in outcomes["final_metrics"].items()},
    )


def wilson_interval(successes: int, trials: int, z: float = 1.959964) -> tuple[float, float]:
    """Wilson's score interval of a proportion, of 95 % confidence by default."""
    p, n = successes / trials, trials
    center = p + z**2 / (2 * n)
    half = z * np.sqrt(p * (1 - p) / n + z**2 / (4 * n**2))
    low, high = (center - half) / (1 + z**2 / n), (center + half) / (1 + z**2 / n)
    return max(0.0, float(low)), min(1.0, float(high))
