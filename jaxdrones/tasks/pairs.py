"""Quantities of pairs of drones."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

_SLOW = 0.05  # m^2/s^2, added to squared speeds


def others(n: int) -> Int[Array, "n k"]:
    """Indices of the other drones of every drone, k = n - 1."""
    return jnp.asarray((np.arange(n)[:, None] + np.arange(1, n)) % n)


def seen_from(x: Float[Array, "n 3"], index: Int[Array, "n k"]) -> Float[Array, "n k 3"]:
    """Vectors of the indexed drones, relative to those of each drone."""
    return x[index] - x[:, None]


def closest_approach(
    pos: Float[Array, "*p 3"], vel: Float[Array, "*p 3"], horizon: float
) -> tuple[Float[Array, "*p"], Float[Array, "*p 3"]]:
    """Time of the closest approach at constant velocities, between now and `horizon` (s), and the position then.

    Args:
        pos: relative positions, m.
        vel: relative velocities, m/s.
        horizon: latest time, s.
    """
    time = jnp.clip(-jnp.sum(pos * vel, axis=-1) / (jnp.sum(vel**2, axis=-1) + _SLOW), 0, horizon)
    return time, pos + vel * time[..., None]


def nearest_on_the_way(before: Float[Array, "n 3"], pos: Float[Array, "n 3"]) -> Float[Array, " n"]:
    """Smallest distance of every drone from another one on straight ways between two control steps, m.

    Args:
        before: positions at the last control step, m.
        pos: positions now, m.
    """
    index = others(len(pos))
    start, move = seen_from(before, index), seen_from(pos - before, index)
    length = jnp.sum(move**2, axis=-1)
    share = jnp.clip(-jnp.sum(start * move, axis=-1) / jnp.where(length > 0, length, 1), 0, 1)
    return jnp.sqrt(jnp.min(jnp.sum((start + share[..., None] * move) ** 2, axis=-1), axis=-1))
