"""Geometry of convex solids as products and unions of intervals, in the frame of one solid."""

import functools
from collections.abc import Sequence

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdrones.vector import components, cross, dot, safe_sqrt

Point = Float[Array, "3"]
Number = Float[Array, ""]
Interval = tuple[Array, Array]
Components = Sequence[Array]
"""x, y and z of one vector, or of many, as three arrays that broadcast with each other."""


def length(v: Float[Array, " n"]) -> Number:
    """Length of a vector, with a zero gradient at zero."""
    return safe_sqrt(dot(v, v))


def signed_distance(beyond: Float[Array, " n"]) -> Number:
    """Signed distance from a product of intervals, given the excess of each coordinate beyond its interval.

    Its gradient on a face is that of inside.
    """
    inside = functools.reduce(jnp.maximum, components(beyond))
    return length(jnp.maximum(beyond, 0)) + jnp.where(inside > 0, 0, inside)


def outward(beyond: Float[Array, " n"]) -> Float[Array, " n"]:
    """Gradient of `signed_distance`, of unit length also on faces and edges."""
    outside = jnp.maximum(beyond, 0)
    distance = length(outside)
    to_face = jnp.arange(len(beyond)) == jnp.argmax(beyond)
    return jnp.where(distance > 0, outside / jnp.where(distance > 0, distance, 1), to_face)


def direction(v: Float[Array, " n"]) -> Float[Array, " n"]:
    """Unit vector along v; the first axis where v is zero."""
    size = length(v)
    first = jnp.arange(len(v)) == 0
    return jnp.where(size > 0, v / jnp.where(size > 0, size, 1), first)


def around_z(center: Point, axis: Point) -> list[Point]:
    """The z axis, its radius towards `center`, and the common normal with another axis."""
    x, y, _ = components(center)
    z_axis = jnp.array([0, 0, 1], center.dtype)
    return [z_axis, jnp.stack([x, y, jnp.zeros_like(x)]), cross(axis, z_axis)]


def between_planes(origin: Array, direction: Array, half: Array) -> Interval:
    """Interval of lines between two planes at +-`half`."""
    per_unit = 1 / nonzero(direction)
    middle, reach = -origin * per_unit, half * jnp.abs(per_unit)
    return middle - reach, middle + reach


def within_radius(origin: Components, direction: Components, radius: Number) -> Interval:
    """Interval of lines within `radius` of zero; the empty interval [inf, -inf] for a miss."""
    square = product(direction, direction)
    divisor = nonzero(square)
    per_square = 1 / divisor
    middle = -product(origin, direction) * per_square
    if len(origin) == 2:  # the closest distance is a cross product, and that of the origin where nothing moves
        (x, y), (u, v) = origin, direction
        slack = divisor * radius**2 - (x * v - y * u) ** 2 - (divisor - square) * (x * x + y * y)
        half = safe_sqrt(slack) * per_square
    else:
        closest = [o + middle * d for o, d in zip(origin, direction, strict=True)]
        slack = radius**2 - product(closest, closest)
        half = safe_sqrt(slack * per_square)
    reach = jnp.where(slack >= 0, half, -jnp.inf)
    return middle - reach, middle + reach


def product(a: Components, b: Components) -> Array:
    """Scalar product of two vectors, or of many."""
    return functools.reduce(jnp.add, (x * y for x, y in zip(a, b, strict=True)))


def nonzero(x: Array) -> Array:
    """Clamp a number away from zero, so that its inverse has finite derivatives."""
    smallest = jnp.finfo(x.dtype).tiny ** 0.25
    return jnp.where(jnp.abs(x) < smallest, smallest, x)
