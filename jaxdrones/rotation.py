"""Unit quaternions (x, y, z, w), body to world.

Every function is for one rotation: use `jax.vmap` for batches. All are differentiable wherever they are defined, also
at zero rotation.
"""

import math

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdrones.errors import UserError
from jaxdrones.vector import atan2, components, dot, is_double, polynomial, sin_cos

_SMALL = 1e-6  # rad^2; below it the leading terms of power series are exact to 1e-18
_POLE = 3 / 1024  # exact in every precision


def _components(v: Float[Array, " n"] | list[Array], size: int) -> list[Float[Array, ""]]:
    """Components of one quaternion or vector. A batch is an error, because its rows could pass for components."""
    given = (len(v),) if isinstance(v, list) else jnp.shape(v)
    if given != (size,):
        raise UserError(f"argument of a rotation has shape {given}; expected ({size},); use jax.vmap for teams")
    return components(v)


def multiply(p: Float[Array, "4"], q: Float[Array, "4"]) -> Float[Array, "4"]:
    """Hamilton product p q: first the rotation q, then p."""
    a, b, c, d = _components(p, 4)
    x, y, z, w = _components(q, 4)
    return jnp.stack(
        [
            d * x + a * w + b * z - c * y,
            d * y - a * z + b * w + c * x,
            d * z + a * y - b * x + c * w,
            d * w - a * x - b * y - c * z,
        ]
    )


def conjugate(q: Float[Array, "4"]) -> Float[Array, "4"]:
    """Inverse rotation of a unit quaternion."""
    x, y, z, w = _components(q, 4)
    return jnp.stack([-x, -y, -z, w])


def rotate(q: Float[Array, "4"], v: Float[Array, "3"]) -> Float[Array, "3"]:
    """R v: a vector from the body frame to the world frame, v + w t + u x t with t = 2 u x v and q = (u, w)."""
    x, y, z, w = _components(q, 4)
    return _rotate(x, y, z, w, v)


def rotate_inverse(q: Float[Array, "4"], v: Float[Array, "3"]) -> Float[Array, "3"]:
    """R^T v: a vector from the world frame to the body frame."""
    x, y, z, w = _components(q, 4)
    return _rotate(x, y, z, -w, v)


def _rotate(x: Array, y: Array, z: Array, w: Array, v: Array) -> Array:
    vx, vy, vz = _components(v, 3)
    tx, ty, tz = 2 * (y * vz - z * vy), 2 * (z * vx - x * vz), 2 * (x * vy - y * vx)
    return jnp.stack([vx + w * tx + y * tz - z * ty, vy + w * ty + z * tx - x * tz, vz + w * tz + x * ty - y * tx])


def axes(q: Float[Array, "4"]) -> list[Float[Array, "3"]]:
    """R e_x, R e_y, R e_z: the body axes in the world frame, the columns of the rotation matrix."""
    x, y, z, w = _components(q, 4)
    return [
        jnp.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)]),
        jnp.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)]),
        jnp.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)]),
    ]


def z_axis(q: Float[Array, "4"]) -> Float[Array, "3"]:
    """R e_z: the thrust axis in the world frame."""
    return axes(q)[2]


def normalize(q: Float[Array, "4"]) -> Float[Array, "4"]:
    """Unit quaternion along q (not zero)."""
    parts = _components(q, 4)
    norm = jnp.sqrt(dot(parts, parts))
    return jnp.stack([x / norm for x in parts])


def exp(v: Float[Array, "3"]) -> Float[Array, "4"]:
    """Rotation by |v| rad about v; smooth at zero. Every whole turn changes the sign of the quaternion."""
    square = dot(_components(v, 3), v)
    angle = jnp.sqrt(jnp.maximum(square, _SMALL))
    turns = jnp.round(angle / (2 * math.pi))
    return exp_half_turn(v * (1 - 2 * math.pi * turns / angle)) * (1 - 2 * (turns % 2))


def exp_half_turn(v: Float[Array, "3"]) -> Float[Array, "4"]:
    """Rotation by |v| rad about v, at most half a turn, by power series without a root or branches, which are fast."""
    square = dot(_components(v, 3), v) / 4  # of half the angle
    terms = 11 if is_double(v) else 7
    cos, sinc = (polynomial([(-1) ** k / math.factorial(2 * k + odd) for k in range(terms)], square) for odd in (0, 1))
    return jnp.append(v / 2 * sinc, cos)


def log(q: Float[Array, "4"]) -> Float[Array, "3"]:
    """Rotation vector (rad) of a unit quaternion, at most half a turn: the inverse of `exp`; smooth at zero."""
    sign = jnp.where(_components(q, 4)[3] < 0, -1, 1)
    v, w = sign * q[:3], sign * q[3]
    square = dot(v, v)  # of the sine of half the angle
    sine = jnp.sqrt(jnp.maximum(square, _SMALL))
    return v * jnp.where(square < _SMALL, 2 + square / 3 + 3 / 20 * square**2, 2 * atan2(sine, w) / sine)


def to_matrix(q: Float[Array, "4"]) -> Float[Array, "3 3"]:
    """Rotation matrix R."""
    return jnp.stack(axes(q), axis=-1)


def from_matrix(r: Float[Array, "3 3"]) -> Float[Array, "4"]:
    """Quaternion of a rotation matrix by Shepperd's method, with division by the largest component."""
    (a, b, c), (d, e, f), (g, h, i) = (components(row) for row in components(r))
    squares = [1 + a - e - i, 1 - a + e - i, 1 - a - e + i, 1 + a + e + i]  # 4 q_i^2
    products = [  # 4 q_i q_j
        jnp.stack([squares[0], b + d, c + g, h - f]),
        jnp.stack([b + d, squares[1], f + h, c - g]),
        jnp.stack([c + g, f + h, squares[2], d - b]),
        jnp.stack([h - f, c - g, d - b, squares[3]]),
    ]
    largest, row = squares[0], products[0]
    for square, other in zip(squares[1:], products[1:], strict=True):
        row = jnp.where(square > largest, other, row)
        largest = jnp.maximum(largest, square)
    return normalize(row)


def from_rpy(rpy: Float[Array, "3"]) -> Float[Array, "4"]:
    """Quaternion of roll, pitch, yaw (rad) about fixed axes: R = Rz(yaw) Ry(pitch) Rx(roll)."""
    (sr, cr), (sp, cp), (sy, cy) = [sin_cos(angle / 2) for angle in _components(rpy, 3)]
    return jnp.stack(
        [
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
            cr * cp * cy + sr * sp * sy,
        ]
    )


def to_rpy(q: Float[Array, "4"]) -> Float[Array, "3"]:
    """Roll, pitch, yaw (rad) about fixed axes, in [-pi, pi].

    At pitch +-90 degrees only the sum or difference of roll and yaw is determined; there roll is zero, as in Bullet.
    This pole is where the sums or differences of components that vanish at +-90 degrees are at most 0.0029, within
    0.24 to 0.34 degrees of it.
    """
    x, y, z, w = _components(q, 4)
    up = (jnp.abs(w - y) <= _POLE) & (jnp.abs(x + z) <= _POLE)
    down = (jnp.abs(w + y) <= _POLE) & (jnp.abs(x - z) <= _POLE)
    pole = up | down  # of sums with a common rounding, so that the three angles use the same branch
    sin_roll = jnp.where(pole, 0, 2 * (y * z + w * x))  # times the cosine of pitch
    cos_roll = jnp.where(pole, 1, w * w - x * x - y * y + z * z)
    cos_pitch = jnp.where(pole, 0, jnp.sqrt(sin_roll * sin_roll + cos_roll * cos_roll))
    sin_yaw = jnp.where(pole, -2 * x * y, 2 * (x * y + w * z))
    cos_yaw = jnp.where(pole, y * y - x * x, w * w + x * x - y * y - z * z)
    pitch = atan2(2 * (w * y - x * z), cos_pitch)
    return jnp.stack([atan2(sin_roll, cos_roll), pitch, atan2(sin_yaw, cos_yaw)])


def yaw_of(x: float, y: float, z: float, w: float) -> float:
    """Yaw of one unit quaternion of Python numbers, rad, without JAX."""
    return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
