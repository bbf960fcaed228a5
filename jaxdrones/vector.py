"""Vectors of a few components, and elementary functions that are differentiable everywhere."""

import functools
import math
from collections.abc import Callable, Iterable
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


def components(v: Float[Array, "n *shape"]) -> list[Float[Array, "*shape"]]:
    """The components of a vector, or the rows of a matrix."""
    return [jnp.squeeze(x, 0) for x in jax.lax.split(v, [1] * len(v))]


def total(v: Float[Array, " n"]) -> Float[Array, ""]:
    """The sum of the components of a short vector."""
    return cast(Array, sum(components(v)))


def dot(a: Float[Array, " n"], b: Float[Array, " n"]) -> Float[Array, ""]:
    """Scalar product of two short vectors."""
    return cast(Array, sum(x * y for x, y in zip(components(a), components(b), strict=True)))


def cross(a: Float[Array, "3"], b: Float[Array, "3"]) -> Float[Array, "3"]:
    """Vector product a x b."""
    ax, ay, az = components(a)
    bx, by, bz = components(b)
    return jnp.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


def along_z(x: Float[Array, ""]) -> Float[Array, "3"]:
    """The vector (0, 0, x)."""
    return jnp.stack([jnp.zeros_like(x), jnp.zeros_like(x), x])


def unit(v: Float[Array, "3"]) -> Float[Array, "3"]:
    """The direction of v; zero, with a zero gradient, where v is zero."""
    length = safe_sqrt(dot(v, v))
    return v / jnp.where(length > 0, length, 1)


def safe_sqrt(x: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """The square root; zero, with a zero gradient, of numbers that are not positive. NaN stays NaN."""
    none = x <= 0
    return jnp.where(none, 0, jnp.sqrt(jnp.where(none, 1, x)))


def tangent(s: Float[Array, "*n"]) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
    """Two numbers a and b with tan x = x b/a, as functions of s = x^2.

    They are smooth, and never both zero. The quotient is exact to the precision of s up to x = 0.8, and to 1e-12
    (float32: 1e-6) up to pi/2.
    """
    return _fraction(s, lambda k: -1, terms=9 if _is_double(s) else 6)


_HALF_TURN = (3.140625, math.pi - 3.140625)  # the first part has few digits, so that many times of it are exact


@jax.custom_jvp
def sin_cos(x: Float[Array, "*n"]) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
    """Sine and cosine of an angle, exact to 6e-16 in float64.

    They are computed from the tangent of half the angle, after half turns are subtracted.
    """
    turns = jnp.round(x / math.pi)
    sign = 1 - 2 * jnp.abs(turns - 2 * jnp.round(turns / 2))
    half = (x - turns * _HALF_TURN[0] - turns * _HALF_TURN[1]) / 2
    s = half * half
    a, b = tangent(s)
    scale = sign / (a * a + s * b * b)
    return 2 * half * a * b * scale, (a * a - s * b * b) * scale


@sin_cos.defjvp
def _(x, turn):
    sin, cos = sin_cos(*x)
    return (sin, cos), (cos * turn[0], -sin * turn[0])


_EIGHTH = math.tan(math.pi / 8)


@jax.custom_jvp
def atan2(y: Float[Array, "*n"], x: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """The angle of the point (x, y), in [-pi, pi]; zero, with a zero gradient, at (0, 0).

    Exact to 4e-16 in float64, and differentiable elsewhere. The point is first turned into half an octant.
    """
    large, small = jnp.maximum(jnp.abs(x), jnp.abs(y)), jnp.minimum(jnp.abs(x), jnp.abs(y))
    upper = small > _EIGHTH * large  # half of the octant: turn back by pi/4
    slope = jnp.where(upper, small - large, small) / jnp.where(upper, small + large, jnp.where(large > 0, large, 1))
    a, b = _fraction(slope * slope, lambda k: k * k, terms=11 if _is_double(slope) else 6)  # atan x = x b/a
    angle = slope * b / a + jnp.where(upper, jnp.pi / 4, 0)
    angle = jnp.where(jnp.abs(y) > jnp.abs(x), jnp.pi / 2 - angle, angle)
    angle = jnp.where(x < 0, jnp.pi - angle, angle)
    return jnp.copysign(angle, y)


@atan2.defjvp
def _(point, turn):
    (y, x), (dy, dx) = point, turn
    square = x * x + y * y
    none = square == 0
    return atan2(y, x), jnp.where(none, 0, (x * dy - y * dx) / jnp.where(none, 1, square))


def asin(s: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """The angle in [-pi/2, pi/2] whose sine is s, in [-1, 1]. At the ends its gradient, which is infinite, is zero."""
    square = (1 - s) * (1 + s)
    end = square == 0
    return atan2(s, jnp.where(end, 0, jnp.sqrt(jnp.where(end, 1, square))))


def _is_double(x: Array) -> bool:
    return jnp.result_type(x) == jnp.float64


def _fraction(s: Array, numerator: Callable[[int], int], terms: int) -> tuple[Array, Array]:
    """Polynomials a and b of s: b/a = 1/(1 + n(1) s/(3 + n(2) s/(5 + ...))), Lambert's fraction of `terms` terms."""
    a, b = [np.poly1d([1]), np.poly1d([1])], [np.poly1d([0]), np.poly1d([1])]
    for k in range(1, terms):
        for p in (a, b):
            p.append((2 * k + 1) * p[-1] + numerator(k) * np.poly1d([1, 0]) * p[-2])
    return _horner(a[-1], s), _horner(b[-1], s)


def _horner(polynomial: np.poly1d, s: Array) -> Array:
    coefficients: Iterable[Any] = map(float, polynomial.coeffs)  # arrays from the second value on
    return functools.reduce(lambda value, coefficient: value * s + coefficient, coefficients)
