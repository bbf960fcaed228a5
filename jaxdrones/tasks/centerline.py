"""Centerline of a race track: a smooth curve from the start through the gates, and coordinates along and beside it."""

from typing import Self

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxdrones.pytree import PyTreeNode
from jaxdrones.tasks.racetrack import direction

_POINTS = 12  # of a segment between two gates
_BEFORE, _BEHIND = 4, 8  # points of the segments before and behind that are near a drone
_FAR = 10.0  # m, from which on all points are alike
_WIDTH = 0.12  # m, standard deviation of the weights of the points near a place

_U = np.arange(_POINTS) / _POINTS
_HERMITE = np.stack(  # of the ends and of the derivatives there
    [2 * _U**3 - 3 * _U**2 + 1, 3 * _U**2 - 2 * _U**3, _U**3 - 2 * _U**2 + _U, _U**3 - _U**2], axis=-1
)


class Centerline(PyTreeNode):
    """Points of p segments; segment i ends at gate i."""

    pos: Array
    """(p, k, 3) positions, m."""
    along: Array
    """(p, k) distance from the start along the curve, m."""
    speed: Array
    """(p, k) speed of a point mass with limited acceleration that starts at rest, m/s."""

    def near(self, index: Int[Array, ""]) -> Self:
        """Points (k, ...) from shortly before to shortly behind the segment to gate `index`, constant in derivatives.

        Other parts of the track may cross this one and do not count.
        """
        first = jnp.maximum(index * _POINTS - _BEFORE, 0)
        count = _BEFORE + _POINTS + _BEHIND

        def section(x: Array) -> Array:
            points = jax.lax.stop_gradient(x).reshape(-1, *x.shape[2:])
            return jax.lax.dynamic_slice_in_dim(points, first, count)

        return jax.tree.map(section, self)


def centerline(gates: Float[Array, "g 4"], start: Float[Array, "4"], acc: Float[Array, ""]) -> Centerline:
    """Centerline from the start through gates, with largest acceleration along the curve and across it (m/s^2).

    A segment is a cubic curve in the crossing directions of both gates: a quarter turn is nearly an arc, a half turn is
    flatter. The rows of `gates`, in order, and `start` are x, y, z (m) and heading (rad).
    """
    begin, count = jnp.concatenate([start[None], gates[:-1]]), len(gates)
    ways = jnp.stack([direction(begin), direction(gates)], axis=1)
    cos = jnp.sum(ways[:, 0] * ways[:, 1], axis=-1)
    length = (1 + (1 - cos**2) / 6) * jnp.linalg.norm(gates[:, :3] - begin[:, :3], axis=-1)
    knots = jnp.concatenate([begin[:, None, :3], gates[:, None, :3], length[:, None, None] * ways], axis=1)
    pos = jnp.asarray(_HERMITE, gates.dtype)[None] @ knots
    line = pos.reshape(-1, 3)
    steps = jnp.linalg.norm(line[1:] - line[:-1], axis=-1)
    along = jnp.concatenate([jnp.zeros(1, line.dtype), jnp.cumsum(steps)])
    return Centerline(pos, along.reshape(count, _POINTS), _speeds(line, steps, acc).reshape(count, _POINTS))


def foot(section: Centerline, pos: Float[Array, "3"]) -> Float[Array, " p"]:
    """Weights of the points of a section whose mean is the point nearest to a position (m), smooth in the position."""
    away = jnp.minimum(jnp.sum((section.pos - pos[None]) ** 2, axis=-1), _FAR**2)  # finite for drones that left
    return jax.nn.softmax(-away / (2 * _WIDTH**2))


def at(section: Centerline, along: Float[Array, ""]) -> Float[Array, " p"]:
    """Weights of the points of a section whose mean is the point at a coordinate along the curve, m."""
    return jax.nn.softmax(-((section.along - along) ** 2) / (2 * _WIDTH**2))


def interpolate(
    line: Centerline, along: Float[Array, " n"]
) -> tuple[Float[Array, "n 3"], Float[Array, "n 3"], Float[Array, " n"]]:
    """Positions (m), unit tangents and speeds (m/s) at coordinates along the curve, m, linear between its points."""
    pos, coordinate, speed = line.pos.reshape(-1, 3), line.along.reshape(-1), line.speed.reshape(-1)
    k = jnp.clip(jnp.searchsorted(coordinate, along, side="right"), 1, len(coordinate) - 1)
    step = coordinate[k] - coordinate[k - 1]
    share, ways = (along - coordinate[k - 1]) / step, pos[k] - pos[k - 1]
    speeds = (1 - share) * speed[k - 1] + share * speed[k]
    return pos[k - 1] + share[:, None] * ways, ways / step[:, None], speeds


def tangent(section: Centerline, weights: Float[Array, " p"]) -> Float[Array, "3"]:
    """Unit tangent at the mean of weighted points of a section."""
    ahead = section.pos[1:] - section.pos[:-1]
    mean = weights[:-1] @ ahead + weights[-1] * ahead[-1]
    return mean / jnp.sqrt(jnp.sum(mean**2) + 1e-12)


def _speeds(line: Float[Array, "m 3"], steps: Float[Array, " l"], acc: Array) -> Float[Array, " m"]:
    """Largest speeds at points of a curve, at rest in the first one, m/s."""
    ways = (line[1:] - line[:-1]) / steps[:, None]
    bend = jnp.linalg.norm(ways[1:] - ways[:-1], axis=-1) / ((steps[1:] + steps[:-1]) / 2)
    bend = jnp.concatenate([bend[:1], bend, bend[-1:]])
    square = acc / jnp.maximum(bend, 0.1)

    def limited(before: Array, limit: tuple[Array, Array]) -> tuple[Array, Array]:
        now = jnp.minimum(limit[0], before + 2 * acc * limit[1])
        return now, now

    forward = jax.lax.scan(limited, jnp.zeros_like(acc), (square[1:], steps))[1]
    end = forward[-1]
    backward = jax.lax.scan(limited, end, (forward[:-1][::-1], steps[1:][::-1]))[1][::-1]
    return jnp.sqrt(jnp.concatenate([jnp.zeros_like(square[:1]), backward, end[None]]))
