"""Continuous collision detection: sweep of a body past obstacles, and separating planes.

A body is a disc that is rounded by a ball. It moves along a straight line by conservative advancement (Mirtich, 1996):
where the gap to a convex obstacle is g along the normal n, and the displacement d closes it by w = -d . n, the
fraction g/w of the displacement is free of contact. Then it rotates.
No function here has a gradient.
"""

from typing import Any, NamedTuple, Self

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxdrones import rotation
from jaxdrones.sensing.distances import fold_near
from jaxdrones.sensing.geometry import Number, Point, length
from jaxdrones.sensing.shapes import Obstacle
from jaxdrones.vector import dot, safe_sqrt

_ADVANCES = 8  # at most
_PROJECTIONS = 4  # alternating projections on disc and obstacle in each advance; they begin where the last ones ended
_PLANES = 3  # of a body: a corner has three faces


class Disc(NamedTuple):
    """Disc rounded by a ball."""

    center: Point
    """m, world."""
    axis: Point
    """Unit normal, world."""
    ring: Number
    """Radius of the disc without its rounding, m."""
    rounding: Number
    """Radius of the ball, m."""

    @classmethod
    def of(cls, pos: Point, quat: Float[Array, "4"], offset: Number, ring: Number, rounding: Number) -> Self:
        """Disc of a drone at a pose, with its center `offset` (m) above the center of mass."""
        axis = rotation.z_axis(quat)
        return cls(pos + offset * axis, axis, ring, rounding)

    def nearest(self, point: Point) -> Point:
        """Nearest point of the disc, without its rounding, to a point."""
        offset = point - self.center
        radial = offset - dot(offset, self.axis) * self.axis
        return self.center + radial * jnp.minimum(1, self.ring / jnp.maximum(length(radial), 1e-9))

    def lowest_point(self, normal: Point) -> Point:
        """Lowest point of the disc, without its rounding, along a unit vector."""
        radial = normal - dot(normal, self.axis) * self.axis
        return self.center - radial * (self.ring / jnp.maximum(length(radial), 1e-9))

    def lowest(self, normal: Point) -> Number:
        """Height of the lowest point along a unit vector, m."""
        extent = self.ring * safe_sqrt(1 - dot(normal, self.axis) ** 2) + self.rounding
        return dot(normal, self.center) - extent


class Planes(NamedTuple):
    """Separating planes of a disc and the obstacles in its way."""

    normals: Float[Array, "planes 3"]
    """Unit normals away from the obstacles, world; zero for no plane."""
    heights: Float[Array, " planes"]
    """Offsets of the planes from the origin, m."""


def planes(kinds: list[Any], start: Disc, end: Disc) -> Planes:
    """Separating planes that a moving disc would cross, for up to three obstacles, nearest first."""

    def look(found: tuple[Planes, Point, Array], obstacle: Obstacle, _: Any) -> tuple[Planes, Point, Array]:
        known, center, count = found
        touches, normal, height = _approach(obstacle, start, end)
        lowest = end._replace(center=center).lowest(normal)
        behind = jnp.where(touches, jnp.maximum(height - lowest, 0), 0)
        here = (jnp.arange(_PLANES) == count) & (behind > 0)
        after = Planes(jnp.where(here[:, None], normal[None], known.normals), jnp.where(here, height, known.heights))
        return after, center + behind * normal, count + (behind > 0)

    none = Planes(jnp.zeros((_PLANES, 3), end.center.dtype), jnp.zeros(_PLANES, end.center.dtype))
    found = none, end.center, jnp.zeros((), jnp.int32)
    for kind in kinds:
        found = fold_near(kind, *_reach(start, end), look, found)
    return found[0]


def meets(kinds: list[Any], start: Disc, end: Disc) -> Bool[Array, ""]:
    """Whether a moving disc touches any obstacle; arguments are those of `planes`."""

    def look(touches: Array, obstacle: Obstacle, _: Any) -> Array:
        return touches | _approach(obstacle, start, end)[0]

    found = jnp.zeros((), bool)
    for kind in kinds:
        found = fold_near(kind, *_reach(start, end), look, found)
    return found


def _reach(start: Disc, end: Disc) -> tuple[Point, Number]:
    """Bounding ball of the disc's motion: center and radius, m."""
    return (start.center + end.center) / 2, length(end.center - start.center) / 2 + end.ring + end.rounding


def _approach(obstacle: Obstacle, start: Disc, end: Disc) -> tuple[Bool[Array, ""], Point, Number]:
    """Whether the disc touches one obstacle, and a separating plane before: its normal, away from it, and its height.

    They are computed in the obstacle's axes, first with the initial attitude, then with the final one. The plane is the
    last one with the initial attitude, because the other side of a thin obstacle is nearer as soon as the disc is more
    than half through.
    """
    start, end = _in_axes(obstacle, start), _in_axes(obstacle, end)
    way = end.center - start.center

    def nearest(disc: Disc, on_obstacle: Point) -> tuple[Point, Point, Number]:
        on_obstacle = jax.lax.fori_loop(
            0, _PROJECTIONS, lambda _, point: obstacle.nearest(disc.nearest(point)), on_obstacle
        )
        on_disc = disc.nearest(on_obstacle)
        return on_obstacle, on_disc, obstacle.distance(on_disc) - disc.rounding

    def is_on_the_way(carry: tuple) -> Bool[Array, ""]:
        return (carry[0] < _ADVANCES) & (carry[1] < 1)

    def advance(carry: tuple) -> tuple:
        count, share, on_obstacle, _, _ = carry
        now = start._replace(center=start.center + share * way)
        on_obstacle, on_disc, gap = nearest(now, on_obstacle)
        normal = obstacle.outward(on_disc)
        height = dot(on_disc, normal) - gap - start.rounding  # of the obstacle; all of it is below
        closing = -dot(way, normal)
        passes = closing <= 0
        more = jnp.where(passes, 1, jnp.maximum(now.lowest(normal) - height, 0) / jnp.where(passes, 1, closing))
        return count + 1, jnp.minimum(share + more, 1), on_obstacle, normal, height

    zero = jnp.zeros_like(start.rounding)
    begin = jnp.zeros((), jnp.int32), zero, obstacle.nearest(start.center), jnp.zeros_like(way), zero
    _, share, _, normal, height = jax.lax.while_loop(is_on_the_way, advance, begin)
    touches = (share < 1) | (nearest(end, obstacle.nearest(end.lowest_point(normal)))[2] < 0)
    normal = rotation.rotate(obstacle.quat, normal)
    return touches, normal, height + dot(obstacle.pos, normal)


def _in_axes(obstacle: Obstacle, disc: Disc) -> Disc:
    axis = rotation.rotate_inverse(obstacle.quat, disc.axis)
    return disc._replace(center=obstacle.to_local(disc.center), axis=axis)
