"""Kinds of obstacles and their geometry: distances, rays, extents.

An obstacle is convex: all points within `rounding` of a core, which is a box or a cylinder, possibly of zero width. A
sphere is a rounded point and a capsule a rounded line segment; a box and a cylinder are their own cores. All methods
are about a single obstacle, in its own frame.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxdrones import rotation
from jaxdrones.pytree import PyTreeNode
from jaxdrones.sensing.geometry import (
    Components,
    Interval,
    Number,
    Point,
    between_planes,
    direction,
    length,
    outward,
    signed_distance,
    within_radius,
)
from jaxdrones.vector import components, dot

_NUMBERS = (int, float, np.ndarray, np.generic, jax.Array)
GREY = (0.6, 0.6, 0.6, 1.0)
LENGTHS = {"pos": 3, "quat": 4, "color": 4, "size": 3}
"""Numbers in a field of a single obstacle; a field that is not named here is one number."""


class Obstacle(PyTreeNode, kw_only=True):
    """Static convex solid, or many of one kind with leading axes on the arrays.

    A kind defines `half`, `interval` and `normals`, and `rounding` or `is_round` where they differ.
    """

    pos: Any
    """(3,) position of the center, m, world."""
    quat: Any = (0.0, 0.0, 0.0, 1.0)
    """(4,) attitude, unit quaternion (x, y, z, w), obstacle to world."""
    color: Any = GREY
    """(4,) red, green, blue, opacity, each 0 to 1."""
    active: Any = None
    """() bool: whether the obstacle is active; `None` means active. An inactive one keeps its number and is invisible
    to cameras, sensors and contact."""

    def __post_init__(self):
        for name, value in vars(self).items():
            if isinstance(value, tuple | list) and all(isinstance(x, _NUMBERS) for x in jax.tree.leaves(value)):
                array = jnp.asarray(value, None if name == "active" else float)
                object.__setattr__(self, name, array)  # JAX would take each number for an array

    @property
    def rounding(self) -> Any:
        """() distance of the surface from the core, m."""
        return 0.0

    def to_local(self, point: Point) -> Point:
        """A point of the world in the frame of the obstacle, m."""
        return rotation.rotate_inverse(self.quat, point - self.pos)

    @property
    def half(self) -> Any:
        """(3,) half of the core's extents along x, y and z, m."""
        raise NotImplementedError

    @property
    def is_round(self) -> Any:
        """() bool: whether the core is a cylinder along z, with a radius of `half[0]`."""
        return False

    def distance(self, point: Point) -> Number:
        """Signed distance of a point from the surface, m; negative inside."""
        return signed_distance(self._beyond(point)) - self.rounding

    def outward(self, point: Point) -> Point:
        """Outward unit normal at the nearest point of the surface: the gradient of the distance.

        Ties are broken arbitrarily.
        """
        side = jnp.where(point < 0, -1, 1).astype(point.dtype)
        normal = outward(self._beyond(point))

        def of_cylinder() -> Point:
            x, y = components(direction(point[:2]))
            radial, _, along = components(normal)
            return jnp.stack([radial * x, radial * y, side[2] * along])

        return _either(self.is_round, of_cylinder, lambda: side * normal)

    def nearest(self, point: Point) -> Point:
        """Nearest point of the core to a point, m."""
        inside = jnp.clip(point, -self.half, self.half)

        def of_cylinder() -> Point:
            x, y, _ = components(point)
            radius = self.half[0]
            inward = jnp.minimum(1, radius / jnp.maximum(length(point[:2]), radius))
            return jnp.stack([inward * x, inward * y, inside[2]])

        return _either(self.is_round, of_cylinder, lambda: inside)

    def extent(self, direction: Point) -> Number:
        """Support function of the core: its extent from its center along a unit vector, m."""
        across, _, along = components(self.half)
        return _either(
            self.is_round,
            lambda: along * jnp.abs(direction[2]) + across * length(direction[:2]),
            lambda: dot(jnp.abs(direction), self.half),
        )

    def interval(self, origin: Components, direction: Components) -> Interval:
        """Interval of lines `origin` + t `direction` inside the obstacle: first and last t.

        The first is larger than the last for a miss.
        """
        raise NotImplementedError

    def normals(self, point: Components) -> Components:
        """Outward normals of any length at points on the surface."""
        raise NotImplementedError

    def _beyond(self, point: Point) -> Array:
        """Excess of a point beyond the core along x, y and z, or beyond its radius and ends, m."""

        def of_cylinder() -> Array:
            radial = length(point[:2]) - self.half[0]
            return jnp.stack([radial, jnp.full_like(radial, -jnp.inf), jnp.abs(point[2]) - self.half[2]])

        return _either(self.is_round, of_cylinder, lambda: jnp.abs(point) - self.half)


class Box(Obstacle, kw_only=True):
    """Cuboid centered at `pos`."""

    size: Any
    """(3,) edge lengths along x, y and z, m."""

    @property
    def half(self) -> Array:
        """(3,) half of the edge lengths, m."""
        return self.size / 2

    def interval(self, origin: Components, direction: Components) -> Interval:
        """Intersection of the intervals between the three pairs of faces."""
        faces = zip(origin, direction, components(self.size / 2), strict=True)
        first, last = zip(*(between_planes(*face) for face in faces), strict=True)
        return functools.reduce(jnp.maximum, first), functools.reduce(jnp.minimum, last)

    def normals(self, point: Components) -> Components:
        """Normal of the face under each point."""
        x, y, z = (p / half for p, half in zip(point, components(self.size / 2), strict=True))
        largest = functools.reduce(jnp.maximum, map(jnp.abs, (x, y, z)))
        return [jnp.where(jnp.abs(p) == largest, p, 0) for p in (x, y, z)]


class Sphere(Obstacle, kw_only=True):
    """Ball centered at `pos`."""

    radius: Any
    """() m."""

    @property
    def rounding(self) -> Any:
        """() radius, m: the core is the center."""
        return self.radius

    @property
    def half(self) -> Array:
        """Zero: the core is the center."""
        return jnp.zeros_like(self.pos)

    def interval(self, origin: Components, direction: Components) -> Interval:
        """Interval of lines within the radius."""
        return within_radius(origin, direction, self.radius)

    def normals(self, point: Components) -> Components:
        """The direction from the center."""
        return point


class Cylinder(Obstacle, kw_only=True):
    """Cylinder centered at `pos`, with its axis along its own z."""

    radius: Any
    """() m."""
    height: Any
    """() m."""

    is_round = True

    @property
    def half(self) -> Array:
        """(3,) radius, radius and half of the height, m."""
        return jnp.stack([self.radius, self.radius, self.height / 2])

    def interval(self, origin: Components, direction: Components) -> Interval:
        """Interval of lines within the radius and between the two ends."""
        first, last = within_radius(origin[:2], direction[:2], self.radius)
        bottom, top = between_planes(origin[2], direction[2], self.height / 2)
        return jnp.maximum(first, bottom), jnp.minimum(last, top)

    def normals(self, point: Components) -> Components:
        """The direction from the axis, or along the axis at the ends."""
        x, y, z = point
        at_end = (z * self.radius) ** 2 > (x * x + y * y) * (self.height / 2) ** 2
        return [jnp.where(at_end, 0, x), jnp.where(at_end, 0, y), jnp.where(at_end, z, 0)]


class Capsule(Obstacle, kw_only=True):
    """Cylinder centered at `pos`, with its axis along its own z, and half a ball on either end."""

    radius: Any
    """() m."""
    height: Any
    """() height of the cylinder, without the half balls, m."""

    @property
    def rounding(self) -> Any:
        """() radius, m: the core is the axis of the cylinder."""
        return self.radius

    @property
    def half(self) -> Array:
        """(3,) zero, zero and half of the height of the cylinder, m."""
        zero = jnp.zeros_like(self.height)
        return jnp.stack([zero, zero, self.height / 2])

    def interval(self, origin: Components, direction: Components) -> Interval:
        """Interval of lines in the cylinder or a ball: one interval, as the capsule is convex."""
        x, y, z = origin
        cylinder = Cylinder(pos=self.pos, radius=self.radius, height=self.height)
        parts = [
            cylinder.interval(origin, direction),
            within_radius((x, y, z - self.height / 2), direction, self.radius),
            within_radius((x, y, z + self.height / 2), direction, self.radius),
        ]
        first = (jnp.where(first <= last, first, jnp.inf) for first, last in parts)
        last = (jnp.where(first <= last, last, -jnp.inf) for first, last in parts)
        return functools.reduce(jnp.minimum, first), functools.reduce(jnp.maximum, last)

    def normals(self, point: Components) -> Components:
        """The direction from the nearest point of the axis."""
        x, y, z = point
        return [x, y, z - jnp.clip(z, -self.height / 2, self.height / 2)]


def _either(condition: Any, a: Callable[[], Array], b: Callable[[], Array]) -> Array:
    """Result of one of two functions; both are called only where the condition is an array."""
    if isinstance(condition, bool):
        return a() if condition else b()
    return jnp.where(condition, a(), b())


def single(obstacles: Obstacle, i: int) -> Any:
    """One of many obstacles of a kind."""
    obstacle = jax.tree.map(lambda x: x[i], obstacles)
    return obstacle.replace(active=True) if obstacle.active is None else obstacle
