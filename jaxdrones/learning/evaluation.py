"""Evaluation of a policy over many episodes, with a confidence interval of its success rate."""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import NamedSharding
from jaxtyping import Array, UInt32

from jaxdrones.arguments import Count, Key, checked
from jaxdrones.engine.step import HostStep
from jaxdrones.envs import Env
from jaxdrones.learning import compilation, sharding
from jaxdrones.learning.networks import AnyPolicy, act, check_callable, initial_hidden_state
from jaxdrones.learning.settings import check_environment
from jaxdrones.limits import check_memory
from jaxdrones.pytree import PyTreeNode

_CHUNK = 1000  # episodes simulated at a time
_ROUNDING = 1e-4  # relative, and absolute in SI units: tolerance between repetitions of a flight
_EPISODE_BYTES = 128  # memory of the results of an episode per drone

Score = tuple[float, float]
"""Success rate and mean return of an evaluation."""


class Report(PyTreeNode):
    """Results of an evaluation."""

    episodes: int
    distinct_episodes: int
    """Number of distinct episodes, by start or random draws; 1 if all are the same flight."""
    trials: int
    """Number of the trials of which `success` and `end_rates` are fractions: the episodes, or in a task with
    `ends="drone"` the drones in all episodes."""
    success: float | None
    """Fraction of the episodes without a failure in which every drone met the task's criterion of success, or of such
    drones in a task with `ends="drone"`; `None` for a task without a criterion."""
    success_interval: tuple[float, float] | None
    """95 % confidence interval of `success` (Wilson) from the distinct episodes; `None` for only one."""
    final_error: float
    """Mean distance from the target at the end of an episode, m."""
    final_error_percentiles: dict[int, float]
    """50th, 95th and 99th percentile of that distance over all drones, m."""
    rms_error: float
    """Root mean square distance from the target over the last four fifths of every episode, m."""
    mean_return: float
    """Mean over drones and episodes of the sum of rewards."""
    mean_length: float
    """Mean length of an episode, s."""
    end_rates: dict[str, float]
    """Fraction of the episodes that ended by each termination or truncation of the task; of drones as in `success`."""
    final_metrics: dict[str, float]
    """Mean over drones of each of the task's metrics at the end of an episode."""

    @property
    def success_lower_bound(self) -> float:
        """Lower end of the interval; the success itself for a single flight, 0 for a task without a criterion."""
        return self.success_interval[0] if self.success_interval else self.success or 0.0


@checked
def evaluate(env: Env, policy: AnyPolicy, key: Key, episodes: Count = 1000) -> Report:
    """Simulate whole episodes on either backend; steps after the end of an episode are ignored.

    The policy is a function from observations, (n, d) or a dictionary with images, to actions (n, a); a pytree that is
    called like one; or a recurrent policy, see `learning.networks`.

    Raises:
        ValueError: no policy, no random key, or more episodes than fit in memory.
    """
    check_environment(env)
    check_callable(policy)
    check_episodes(env, episodes)
    keys = jax.random.split(key, episodes)
    if isinstance(policy, PyTreeNode):
        outcomes = _compiled_outcomes(env)(policy, keys)
    else:
        outcomes = jax.jit(functools.partial(_outcomes, env, policy))(keys)
    return _report(env, jax.tree.map(np.asarray, outcomes))


@checked
def compile_evaluation(
    env: Env, policy: Any, episodes: Count, devices: Sequence[jax.Device] | None = None
) -> Callable[[AnyPolicy, jax.Array], Report]:
    """Compile `evaluate` for policies of one structure on the explicit backend: (policy, key) -> report.

    `policy` is one of them, or its shapes. The devices of this host share the episodes, if they can share them equally;
    by default all of them.
    """
    check_episodes(env, episodes)
    split = functools.partial(jax.random.split, num=episodes)
    keys = jax.eval_shape(split, jax.random.key(0))
    leaves, structure = jax.tree.flatten(policy)
    devices = jax.local_devices() if devices is None else devices
    mesh = sharding.make_mesh(episodes, devices if episodes % len(devices) == 0 else devices[:1])
    shardings = NamedSharding(mesh, sharding.REPLICATED), NamedSharding(mesh, sharding.WORLDS)

    def all_outcomes(leaves: list[Array], keys: jax.Array) -> dict:
        outcomes = functools.partial(_outcomes, env, jax.tree.unflatten(structure, leaves))
        return sharding.map_worlds(outcomes, (sharding.WORLDS,), sharding.WORLDS)(keys)

    with jax.set_mesh(mesh):
        program = compilation.jit(all_outcomes, env, in_shardings=shardings).lower(leaves, keys).compile()

    def report(policy: AnyPolicy, key: jax.Array) -> Report:
        outcomes = program(*jax.device_put((jax.tree.leaves(policy), split(key)), shardings))
        return _report(env, jax.tree.map(np.asarray, outcomes))

    return report


def check_episodes(env: Env, episodes: int) -> None:
    """Raise if the episodes of an evaluation do not fit in memory."""
    check_memory(f"an evaluation of {episodes:,} episodes", episodes * env.drones * _EPISODE_BYTES, "give fewer")


@functools.lru_cache(maxsize=8)
def _compiled_outcomes(env: Env) -> Callable:
    return compilation.jit(functools.partial(_outcomes, env), env)


def _outcomes(env: Env, policy: AnyPolicy, keys: jax.Array) -> dict:
    on_host = isinstance(env.physics, HostStep)  # which flies the worlds sequentially, and rebuilds the scene of each
    chunk = None if on_host else min(_CHUNK, len(keys))
    return jax.lax.map(functools.partial(_outcome, env, policy), keys, batch_size=chunk)


def _outcome(env: Env, policy: AnyPolicy, key: jax.Array) -> dict:
    """Outcome of one episode; an episode with a position that is not finite is no success."""
    start_key, key = jax.random.split(key)
    obs, world = env.reset(start_key)
    first_state = (world.drones.pos, world.drones.quat, world.drones.vel, world.drones.omega)
    start = _fingerprint(world.replace(images={}, poses=None))
    info = jax.eval_shape(env.step, key, world, jnp.zeros((env.drones, env.action_size)))[-1]
    zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), _metrics_and_ends(info))

    def control_step(carry, key):
        state, obs, world, diverged, done, last, episode_return, length = carry
        state, action = act(policy, state, obs)
        obs, world, reward, terminated, truncated, info = env.step(key, world, action)
        counts = info["active"] & ~done
        last = jax.tree.map(lambda new, old: jnp.where(counts, new, old), _metrics_and_ends(info), last)
        episode_return = episode_return + jnp.where(counts, reward, 0)
        length = length + counts
        diverged = diverged | (counts & ~jnp.all(jnp.isfinite(world.drones.pos), axis=-1))
        return (state, obs, world, diverged, done | terminated | truncated, last, episode_return, length), last[0]

    zero = jnp.zeros(env.drones, world.drones.pos.dtype)
    none = jnp.zeros(env.drones, bool)
    hidden_state, false = initial_hidden_state(policy, env.drones), jnp.zeros((), bool)
    carry = (hidden_state, obs, world, none, false, zeros, zero, jnp.zeros(env.drones, jnp.int32))
    carry, metrics = jax.lax.scan(control_step, carry, jax.random.split(key, env.steps))
    _, _, _, diverged, _, (final_metrics, ends), episode_return, length = carry
    flown = jnp.arange(env.steps)[:, None]
    counts = (flown >= length[None] // 5) & (flown < length[None])
    rms_error = jnp.sqrt(jnp.mean(metrics["error"] ** 2, axis=0, where=counts))
    success = {}
    if env.task.success is not None:
        success["success"] = env.task.shared(jnp.all, env.task.succeeded(metrics, ends, env.dt) & ~diverged)
    return success | {
        "start": start,
        "first_state": first_state,
        "final_metrics": final_metrics,
        "ends": {name: env.task.shared(jnp.any, ended) for name, ended in ends.items()},
        "return": episode_return,
        "length": length,
        "rms_error": rms_error,
    }


def _metrics_and_ends(info: dict) -> tuple[dict, dict]:
    return info["metrics"], info["terminations"] | info["truncations"]


def _fingerprint(tree: Any) -> UInt32[Array, "2"]:
    """Hash of a tree: two sums of all bits with random odd weights."""
    total = jnp.zeros(2, jnp.uint32)
    rng = np.random.default_rng(0)
    for leaf in jax.tree.leaves(tree):
        if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            leaf = jax.random.key_data(leaf)
        if jnp.issubdtype(leaf.dtype, jnp.floating):
            leaf = leaf.astype(jnp.promote_types(leaf.dtype, jnp.float32))
            bits = jax.lax.bitcast_convert_type(jnp.where(leaf == 0, 0, leaf), jnp.uint32)  # -0 is 0
        else:
            bits = leaf.astype(jnp.uint32)
        weights = rng.integers(2**32, size=(2, bits.size), dtype=np.uint32) | np.uint32(1)
        total = total + jnp.sum(weights * bits.reshape(1, -1), axis=1, dtype=jnp.uint32)
    return total


def _count_distinct(env: Env, outcomes: dict) -> int:
    """Number of distinct episodes.

    Two episodes are the same with equal initial worlds and no later random draws. All episodes with one initial state
    are the same if their results also agree: then the random draws have no effect.
    """

    def rows(names: list[str]) -> np.ndarray:
        leaves = jax.tree.leaves([outcomes[name] for name in names])
        return np.concatenate([np.asarray(x, np.float64).reshape(len(x), -1) for x in leaves], axis=1)

    results = rows(["return", "rms_error", "length", "final_metrics"])
    firsts, state = np.unique(np.round(rows(["first_state"]), 6), axis=0, return_inverse=True)
    state = state.reshape(-1)
    highest, lowest = (np.full((len(firsts), results.shape[1]), sign * -np.inf) for sign in (1, -1))
    np.maximum.at(highest, state, results)
    np.minimum.at(lowest, state, results)
    alike = np.all(highest - lowest <= _ROUNDING * (1 + np.abs(highest)), axis=1)
    drawn_on_the_way = env.noise or env.disturbance or env.sensors or (env.vision and env.vision.camera.noise)
    told_apart = np.concatenate([rows(["start"]), results], axis=1) if drawn_on_the_way else rows(["start"])
    return len(np.unique(np.where(alike[state, None], state[:, None], told_apart), axis=0))


def _report(env: Env, outcomes: dict) -> Report:
    episodes, distinct = len(outcomes["length"]), _count_distinct(env, outcomes)
    error = outcomes["final_metrics"]["error"]
    success = float(np.mean(outcomes["success"])) if "success" in outcomes else None
    return Report(
        episodes=episodes,
        distinct_episodes=distinct,
        trials=episodes * (env.drones if env.task.ends == "drone" else 1),
        success=success,
        success_interval=None if success is None or distinct == 1 else _interval(outcomes["success"], distinct),
        final_error=float(np.mean(error)),
        final_error_percentiles={q: float(np.percentile(error, q)) for q in (50, 95, 99)},
        rms_error=float(np.sqrt(np.mean(outcomes["rms_error"] ** 2))),
        mean_return=float(np.mean(outcomes["return"])),
        mean_length=float(np.mean(outcomes["length"]) * env.dt),
        end_rates={name: float(np.mean(ended)) for name, ended in outcomes["ends"].items()},
        final_metrics={name: float(np.mean(x)) for name, x in outcomes["final_metrics"].items()},
    )


def _interval(success: np.ndarray, distinct: int) -> tuple[float, float]:
    """Confidence interval of the success (episodes, n) of drones, which are not independent within an episode.

    The number of independent trials in an episode follows from the variance of its fraction of successes: 1 if all
    drones of an episode succeed or fail together, or if none failed; at most n.
    """
    p, variance = np.mean(success), np.var(np.mean(success, axis=1))
    trials = np.clip(p * (1 - p) / variance, 1, success.shape[1]) if variance > 0 else 1
    return wilson_interval(p * distinct * trials, distinct * trials)


def wilson_interval(successes: float, trials: int, z: float = 1.959964) -> tuple[float, float]:
    """Wilson's score interval of a proportion, of 95 % confidence by default."""
    p, n = successes / trials, trials
    center = p + z**2 / (2 * n)
    half = z * np.sqrt(p * (1 - p) / n + z**2 / (4 * n**2))
    low, high = (center - half) / (1 + z**2 / n), (center + half) / (1 + z**2 / n)
    return max(0.0, float(low)), min(1.0, float(high))


def score_of(success: float | None, mean_return: float) -> Score:
    """Score of an evaluation; missing success is 0, a return that is NaN is the worst."""
    return success or 0.0, mean_return if math.isfinite(mean_return) else -math.inf
