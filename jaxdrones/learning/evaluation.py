"""How well a policy flies: many episodes at once, and how sure that is."""

from __future__ import annotations

import functools
from collections.abc import Callable

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from jaxdrones.accelerate.compiler import training_options
from jaxdrones.checks import check_key
from jaxdrones.envs import Env
from jaxdrones.limits import LARGEST_COUNT, check_at_most, check_memory

_CHUNK = 1000  # episodes flown at a time
_EPISODE_BYTES = 64  # of a drone, that an evaluation keeps until its end


class Report(flax.struct.PyTreeNode):
    """What came of the episodes."""

    episodes: int
    success: float
    """Share of the episodes in which every drone did what it should."""
    interval: tuple[float, float]
    """95 % confidence interval of it (Wilson)."""
    error: float
    """Mean distance from the target in the end, m."""
    error_percentiles: dict[int, float]
    """50, 95, 99 % of the drones end nearer than this, m."""
    rms_error: float
    """Root mean square over the last four fifths of all episodes, m."""
    returned: float
    """Mean sum of a drone's rewards."""
    length: float
    """Mean length of an episode, s."""
    ends: dict[str, float]
    """Share of the episodes that each end or limit of the task stopped."""
    metrics: dict[str, float]
    """Mean over drones of each of the task's metrics in the end."""


def evaluate(env: Env, policy: Callable, key: jax.Array, episodes: int = 1000) -> Report:
    """Fly episodes from start to end; what a drone's metrics are when its episode ends, they stay.

    Args:
        env: environment of either backend.
        policy: observations (n, d), or a dictionary with images, -> actions (n, a); a pytree, or any function.
        key: random key.
        episodes: number of them.

    Raises:
        ValueError: no random key, or so many episodes cannot be flown.
    """
    check_key("key", key)
    check_episodes(env, episodes)
    keys = jax.random.split(key, episodes)
    if isinstance(policy, flax.struct.PyTreeNode):
        flown = _fly_policy()(env, policy, keys)
    else:
        flown = jax.jit(functools.partial(_fly, env, policy))(keys)
    return _report(env, jax.tree.map(np.asarray, flown))


def check_episodes(env: Env, episodes: int) -> None:
    """Raise unless so many episodes can be flown at once."""
    check_at_most("episodes", episodes, LARGEST_COUNT)
    check_memory(f"an evaluation of {episodes:,} episodes", episodes * env.drones * _EPISODE_BYTES, "give fewer")


@functools.cache
def _fly_policy() -> Callable:
    return jax.jit(_fly, static_argnums=0, compiler_options=training_options())


def _fly(env: Env, policy: Callable, keys: jax.Array):
    return jax.lax.map(functools.partial(_episode, env, policy), keys, batch_size=min(_CHUNK, len(keys)))


def _episode(env: Env, policy: Callable, key: jax.Array) -> dict:
    """One episode, frozen where it ended; positions that are not numbers at any time are no success."""
    start_key, key = jax.random.split(key)
    obs, world = env.reset(start_key)
    first = jax.eval_shape(env.step, key, world, jnp.zeros((env.drones, env.action_size)))[-1]
    nothing = jax.tree.map(
        lambda x: jnp.zeros(x.shape, x.dtype), (first["metrics"], first["terminations"] | first["truncations"])
    )

    def control_step(carry, key):
        obs, world, lost, done, outcome, returned, length = carry
        obs, world, reward, terminated, truncated, info = env.step(key, world, policy(obs))
        now = (info["metrics"], info["terminations"] | info["truncations"])
        outcome = jax.tree.map(lambda new, old: jnp.where(done, old, new), now, outcome)
        returned = returned + jnp.where(done, 0, reward)
        length = length + ~done
        lost = lost | ~jnp.all(jnp.isfinite(world.drones.pos))
        return (obs, world, lost, done | terminated | truncated, outcome, returned, length), outcome[0]

    zero = jnp.zeros(env.drones, world.drones.pos.dtype)
    no = jnp.zeros((), bool)
    carry = (obs, world, no, no, nothing, zero, jnp.zeros((), jnp.int32))
    carry, metrics = jax.lax.scan(control_step, carry, jax.random.split(key, env.steps))
    _, _, lost, _, (final, ends), returned, length = carry
    success = no if env.task.success is None else jnp.all(env.task.success(metrics, env.dt)) & ~lost
    rms = jnp.sqrt(jnp.mean(metrics["error"][env.steps // 5 :] ** 2, axis=0))
    return dict(success=success, final=final, ends=ends, returned=returned, length=length, rms=rms)


def _report(env: Env, flown: dict) -> Report:
    episodes = len(flown["success"])
    error = flown["final"]["error"]
    return Report(
        episodes=episodes,
        success=float(np.mean(flown["success"])),
        interval=wilson(int(np.sum(flown["success"])), episodes),
        error=float(np.mean(error)),
        error_percentiles={q: float(np.percentile(error, q)) for q in (50, 95, 99)},
        rms_error=float(np.sqrt(np.mean(flown["rms"] ** 2))),
        returned=float(np.mean(flown["returned"])),
        length=float(np.mean(flown["length"]) * env.dt),
        ends={name: float(np.mean(ended)) for name, ended in flown["ends"].items()},
        metrics={name: float(np.mean(x)) for name, x in flown["final"].items()},
    )


def wilson(successes: int, trials: int, z: float = 1.959964) -> tuple[float, float]:
    """Wilson's score interval of a share, 95 % by default."""
    p, n = successes / trials, trials
    centre = p + z**2 / (2 * n)
    half = z * np.sqrt(p * (1 - p) / n + z**2 / (4 * n**2))
    low, high = (centre - half) / (1 + z**2 / n), (centre + half) / (1 + z**2 / n)
    return max(0.0, float(low)), min(1.0, float(high))
