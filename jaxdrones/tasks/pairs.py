"""Quantities of pairs of drones."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

CORE = 0.05  # m; added in quadrature to distances, as directions of drones that pass through each other turn at once
_SLOW = 0.05  # m^2/s^2, added to squared speeds

Vectors = list[Float[Array, "k n"]]
"""x, y and z of vectors from n drones to k others each: on a CPU three arrays take a fourth of the time of one."""


def nearest(pos: Float[Array, "n 3"], count: int) -> Int[Array, "n k"]:
    """Indices of the nearest other drones of every drone, nearest first; k is at most n - 1.

    The last bits of a squared distance make room for the index: among 512 drones, distances that agree to 3e-5 may
    change places. Repeated minima of such numbers take a quarter of the time of `jax.lax.top_k`.
    """
    n = len(pos)
    x, y, z = jax.lax.stop_gradient(pos).T
    away = sum((c[None] - c[:, None]) ** 2 for c in (x, y, z))
    integer = jnp.int64 if away.dtype == jnp.float64 else jnp.int32
    bits, none = (1 << (n - 1).bit_length()) - 1, jnp.iinfo(integer).max
    packed = (jax.lax.bitcast_convert_type(away, integer) & ~bits) | jnp.arange(n, dtype=integer)[:, None]
    packed = jnp.where(jnp.eye(n, dtype=bool), none, packed)

    def next_nearest(last: Array, _: None) -> tuple[Array, Array]:
        following = jnp.min(jnp.where(packed > last[None], packed, none), axis=0)
        return following, following

    found = jax.lax.scan(next_nearest, jnp.full(n, -1, integer), length=min(count, n - 1), unroll=True)[1]
    return (found & bits).T


def nearby(pos: Float[Array, "n 3"], count: int) -> Int[Array, "n k"] | None:
    """Indices of the nearest other drones; `None` for all others if they are at most `count`."""
    return None if count >= len(pos) - 1 else nearest(pos, count)


def seen_from(x: Float[Array, "n 3"], index: Int[Array, "n k"] | None) -> Vectors:
    """Vectors of the indexed drones relative to those of each drone; with `None` of all others.

    Without an index the derivative needs no scatter, which takes as many serial steps as there are pairs.
    """
    if index is not None:
        return [c[index.T] - c[None] for c in x.T]
    turns = range(1, len(x))
    return [jnp.stack([jnp.roll(c, -k) - c for k in turns]) if turns else jnp.zeros((0, 1), c.dtype) for c in x.T]


def dot(a: Vectors, b: Vectors) -> Float[Array, "k n"]:
    """Scalar products."""
    (ax, ay, az), (bx, by, bz) = a, b
    return ax * bx + ay * by + az * bz


def along(start: Vectors, move: Vectors, share: Float[Array, "k n"]) -> Vectors:
    """`start + share * move`."""
    return [x + share * dx for x, dx in zip(start, move, strict=True)]


def closest_approach(pos: Vectors, vel: Vectors, horizon: float) -> tuple[Float[Array, "k n"], Vectors]:
    """Time of the closest approach at constant relative velocities, from now to `horizon` (s), and the position (m)."""
    time = jnp.clip(-dot(pos, vel) / (dot(vel, vel) + _SLOW), 0, horizon)
    return time, along(pos, vel, time)


def sums_with(x: Float[Array, " n"], index: Int[Array, "n k"] | None) -> Float[Array, "k n"]:
    """Sums of a number of each drone and those of the indexed ones; with `None` of all others."""
    if index is not None:
        return x[index.T] + x[None]
    turns = range(1, len(x))
    return jnp.stack([jnp.roll(x, -k) + x for k in turns]) if turns else jnp.zeros((0, 1), x.dtype)


def nearest_on_the_way(
    before: Float[Array, "n 3"],
    pos: Float[Array, "n 3"],
    index: Int[Array, "n k"] | None,
    radius: Float[Array, " n"] | None = None,
) -> Float[Array, " n"]:
    """Smallest distance of every drone from those of its `index` between two control steps, m; `None` for all.

    Positions are joined by straight ways. With radii it is the gap between two balls, negative where they overlap.
    """
    start, move = seen_from(before, index), seen_from(pos - before, index)
    length = dot(move, move)
    share = jnp.clip(-dot(start, move) / jnp.where(length > 0, length, 1), 0, 1)
    closest = along(start, move, share)
    distance = jnp.sqrt(dot(closest, closest))
    return jnp.min(distance if radius is None else distance - sums_with(radius, index), axis=0)
