"""Short vectors, and elementary functions with finite derivatives everywhere."""

import math
from collections.abc import Sequence
from typing import cast

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

Short = Float[Array, " n"] | list[Float[Array, ""]]
"""A short vector, or the list of its components, which is faster on a CPU if they are computed anew."""


def components(v: Float[Array, "n *shape"] | list[Float[Array, "*shape"]]) -> list[Float[Array, "*shape"]]:
    """Components of a vector, or rows of a matrix."""
    return v if isinstance(v, list) else [jnp.squeeze(x, 0) for x in jax.lax.split(v, [1] * len(v))]


def total(v: Float[Array, "n *shape"] | list[Float[Array, "*shape"]]) -> Float[Array, "*shape"]:
    """Sum of the components of a short vector, or of the rows of a short matrix."""
    if isinstance(v, list) or len(v):
        return cast(Array, sum(components(v)))
    return jnp.zeros(v.shape[1:], v.dtype)


def dot(a: Short, b: Short) -> Float[Array, ""]:
    """Scalar product of two short vectors."""
    return cast(Array, sum(x * y for x, y in zip(components(a), components(b), strict=True)))


def cross(a: Float[Array, "3"], b: Float[Array, "3"]) -> Float[Array, "3"]:
    """Vector product a x b."""
    ax, ay, az = components(a)
    bx, by, bz = components(b)
    return jnp.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


def largest(v: Float[Array, "4"]) -> Float[Array, ""]:
    """The largest of four numbers.

    The derivative of `jnp.max` compares each number with the maximum: NaN where both are rounded differently.
    """
    a, b, c, d = components(v)
    return jnp.maximum(jnp.maximum(a, b), jnp.maximum(c, d))


def along_z(x: Float[Array, ""]) -> Float[Array, "3"]:
    """Vector (0, 0, x)."""
    return jnp.stack([jnp.zeros_like(x), jnp.zeros_like(x), x])


def unit(v: Float[Array, "3"]) -> Float[Array, "3"]:
    """Unit vector along v; zero, with a zero gradient, where v is zero."""
    length = safe_sqrt(dot(v, v))
    return v / jnp.where(length > 0, length, 1)


@jax.custom_jvp
def safe_sqrt(x: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Square root; zero, with a zero gradient, for numbers that are not positive. NaN stays NaN."""
    return jnp.sqrt(jnp.maximum(x, 0))


@safe_sqrt.defjvp
def _(x, change):
    root = safe_sqrt(*x)
    none = root == 0
    return root, jnp.where(none, 0, change[0] / (2 * jnp.where(none, 1, root)))


_SINE = (1.0, -0.166666567, 0.00833302514, -0.000198074187, 2.60190307e-06)


@jax.custom_jvp
def sin_cos(x: Float[Array, "*n"]) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
    """Sine and cosine of an angle.

    In single precision, where library functions prevent vectorization on a CPU, a minimax polynomial of the sine on
    [0, pi/2] is used, with a relative error of 5e-9. Whole turns are subtracted first.
    """
    if is_double(x):
        return jnp.sin(x), jnp.cos(x)
    turn = x - 2 * math.pi * jnp.round(x / (2 * math.pi))
    size = jnp.abs(turn)
    sin = _odd(_SINE, jnp.minimum(size, math.pi - size))
    return jnp.where(turn < 0, -sin, sin), _odd(_SINE, math.pi / 2 - size)


@sin_cos.defjvp
def _(x, change):
    sin, cos = sin_cos(*x)
    return (sin, cos), (cos * change[0], -sin * change[0])


_ARCTANGENT = (
    *(1.0, -0.333330733, 0.199926194, -0.142036445, 0.106409341),
    *(-0.0750429461, 0.0426915201, -0.0160686294, 0.00284988974),
)


@jax.custom_jvp
def atan2(y: Float[Array, "*n"], x: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Angle of the point (x, y), in [-pi, pi]; zero, with a zero gradient, at (0, 0).

    In single precision, where library functions prevent vectorization on a CPU, a minimax polynomial of the arctangent
    on [0, 1] is used, with a relative error of 2e-8. Its branches compare x and y alone, and the angle is continuous
    across branches, except for the turn between -pi and pi. It is therefore correct even if a compiled program computes
    x and y twice with different rounding.
    """
    if is_double(x) or is_double(y):
        return jnp.arctan2(y, x)
    across, along = jnp.abs(y), jnp.abs(x)
    large = jnp.maximum(across, along)
    angle = _odd(_ARCTANGENT, jnp.minimum(across, along) / jnp.where(large > 0, large, 1))
    angle = jnp.where(across > along, math.pi / 2 - angle, angle)
    angle = jnp.where(x < 0, math.pi - angle, angle)
    return jnp.where(y < 0, -angle, angle)


@atan2.defjvp
def _(point, change):
    (y, x), (dy, dx) = point, change
    square = x * x + y * y
    none = square == 0
    return atan2(y, x), jnp.where(none, 0, (x * dy - y * dx) / jnp.where(none, 1, square))


def _odd(coefficients: Sequence[float], x: Array) -> Array:
    """Polynomial of x with these coefficients of odd powers, lowest first."""
    return x * polynomial(coefficients, x * x)


def polynomial(coefficients: Sequence[float], x: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Polynomial of x with these coefficients, lowest first."""
    value = jnp.zeros_like(x)
    for coefficient in reversed(coefficients):
        value = value * x + coefficient
    return value


def is_double(x: Array) -> bool:
    """Whether a number has double precision."""
    return jnp.result_type(x) == jnp.float64
