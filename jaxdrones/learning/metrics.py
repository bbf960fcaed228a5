"""Metrics of an update: rewards, errors, and returns of whole episodes."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdrones.arguments import Scalar
from jaxdrones.envs import Env
from jaxdrones.learning import collect

_KNOWN = "return_known"  # name of a metric of programs


def measure(
    env: Env, config: Any, step: Array, worlds: collect.Worlds, trajectory: collect.Trajectory
) -> tuple[collect.Worlds, dict[str, Array]]:
    """Update the returns of the worlds after a trajectory, and compute the metrics of update `step`.

    The metrics are the mean reward and the mean error (m) of the valid steps, the fraction of them that terminated an
    episode, and the mean return. The latter is NaN before a whole episode can have ended, as only failed episodes have
    ended by then: in the first `env.steps` steps of a training, and always if every trajectory is shorter and starts
    new episodes in all worlds.
    """
    counts = ~trajectory.was_done
    worlds = with_returns(worlds, trajectory, config.restart_fraction)
    episodes_fit = config.horizon >= env.steps
    could_end = (config.restart_fraction < 1) & ((step + 1) * config.horizon >= env.steps) | episodes_fit
    return worlds, {
        "reward": jnp.mean(trajectory.reward, where=counts),
        "error": jnp.mean(trajectory.error, where=counts),
        "termination_rate": jnp.mean(trajectory.terminated.astype(trajectory.reward.dtype), where=counts),
        "return": jnp.where(could_end, mean_return(worlds), jnp.nan),
    }


def without_unknown(metrics: dict[str, Array]) -> dict[str, Array]:
    """Metrics as outputs of a program, in which JAX_DEBUG_NANS finds no NaN of a return before the first."""
    if "return" not in metrics:
        return metrics
    known = ~jnp.isnan(metrics["return"])
    return metrics | {"return": jnp.where(known, metrics["return"], 0), _KNOWN: known}


def with_unknown(metrics: dict[str, Array]) -> dict[str, Array]:
    """Inverse of `without_unknown`, outside a program."""
    if _KNOWN not in metrics:
        return metrics
    with jax.debug_nans(False):
        returns = jnp.where(metrics[_KNOWN], metrics["return"], jnp.nan)
    return {name: x for name, x in metrics.items() if name != _KNOWN} | {"return": returns}


def with_returns(worlds: collect.Worlds, trajectory: collect.Trajectory, restart_fraction: Scalar) -> collect.Worlds:
    """Worlds after a trajectory with the return and the weight of the last finished episode in each.

    An episode of k updates survives `collect.restart` with the probability (1 - restart_fraction)^k. The inverse is the
    weight that corrects for missing long episodes (Horvitz and Thompson 1952).
    """
    ended = trajectory.done & ~jnp.all(trajectory.was_done, axis=-1)
    t = jnp.arange(len(ended))[:, None]
    last = jnp.max(jnp.where(ended, t, -1), axis=0)
    chosen = t == last[None]  # an index would make devices exchange worlds
    length = jnp.sum(jnp.where(chosen, trajectory.length, 0), axis=0)
    passed = -((last + 1 - length) // len(ended))  # updates since its first step
    weight = (1 - jnp.asarray(restart_fraction, trajectory.reward.dtype)) ** -passed
    returns = jnp.mean(jnp.sum(jnp.where(chosen[..., None], trajectory.episode_return, 0), axis=0), axis=-1)
    return worlds.replace(
        last_return=jnp.where(last >= 0, returns, worlds.last_return),
        last_weight=jnp.where(last >= 0, weight, worlds.last_weight),
    )


def mean_return(worlds: collect.Worlds) -> Float[Array, ""]:
    """Mean return of the last finished episode over worlds and drones; NaN before the first.

    Every world counts once. A mean over all finished episodes would be biased towards short ones.
    """
    weight = jnp.sum(worlds.last_weight)
    mean = jnp.sum(worlds.last_weight * worlds.last_return) / jnp.where(weight > 0, weight, 1)
    return jnp.where(weight > 0, mean, jnp.nan)
