"""Unit quaternions (x, y, z, w), body to world.

Every function is about one rotation, never a batch: use `jax.vmap` for more. All are differentiable wherever they are
defined, also at zero rotation.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdrones.vector import asin, atan2, components, dot, sin_cos, tangent


def multiply(p: Float[Array, "4"], q: Float[Array, "4"]) -> Float[Array, "4"]:
    """Hamilton product p q: first the rotation q, then p."""
    a, b, c, d = components(p)
    x, y, z, w = components(q)
    return jnp.stack(
        [
            d * x + a * w + b * z - c * y,
            d * y - a * z + b * w + c * x,
            d * z + a * y - b * x + c * w,
            d * w - a * x - b * y - c * z,
        ]
    )


def conjugate(q: Float[Array, "4"]) -> Float[Array, "4"]:
    """The inverse rotation of a unit quaternion."""
    x, y, z, w = components(q)
    return jnp.stack([-x, -y, -z, w])


def rotate(q: Float[Array, "4"], v: Float[Array, "3"]) -> Float[Array, "3"]:
    """R v: a vector from the body frame to the world frame, v + w t + u x t with t = 2 u x v and q = (u, w)."""
    x, y, z, w = components(q)
    return _rotate(x, y, z, w, v)


def rotate_inverse(q: Float[Array, "4"], v: Float[Array, "3"]) -> Float[Array, "3"]:
    """R^T v: a vector from the world frame to the body frame."""
    x, y, z, w = components(q)
    return _rotate(x, y, z, -w, v)


def _rotate(x: Array, y: Array, z: Array, w: Array, v: Array) -> Array:
    vx, vy, vz = components(v)
    tx, ty, tz = 2 * (y * vz - z * vy), 2 * (z * vx - x * vz), 2 * (x * vy - y * vx)
    return jnp.stack([vx + w * tx + y * tz - z * ty, vy + w * ty + z * tx - x * tz, vz + w * tz + x * ty - y * tx])


def axes(q: Float[Array, "4"]) -> list[Float[Array, "3"]]:
    """R e_x, R e_y, R e_z: the body axes in the world frame, the columns of the rotation matrix."""
    x, y, z, w = components(q)
    return [
        jnp.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)]),
        jnp.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)]),
        jnp.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)]),
    ]


def z_axis(q: Float[Array, "4"]) -> Float[Array, "3"]:
    """R e_z: the thrust axis in the world frame."""
    return axes(q)[2]


def normalize(q: Float[Array, "4"]) -> Float[Array, "4"]:
    """The unit quaternion along q (not zero)."""
    norm = jnp.sqrt(dot(q, q))
    return jnp.stack([x / norm for x in components(q)])


def exp(v: Float[Array, "3"]) -> Float[Array, "4"]:
    """The rotation by |v| rad about v.

    It is computed from the tangent of |v|/4, without a root, and so it is as smooth at zero as elsewhere and has unit
    length whatever the error of the tangent. Exact to the precision of v up to a full turn.
    """
    s = dot(v, v) / 16
    a, b = tangent(s)
    norm = a * a + s * b * b
    return jnp.append(v * (a * b / 2 / norm), 1 - 2 * s * b * b / norm)


def log(q: Float[Array, "4"]) -> Float[Array, "3"]:
    """The rotation vector (rad) of a unit quaternion, at most half a turn: the inverse of `exp`, as smooth at zero."""
    sign = jnp.where(q[3] < 0, -1, 1)
    v, w = sign * q[:3], sign * q[3]
    square = dot(v, v)
    small = square < 1e-6
    sine = jnp.sqrt(jnp.where(small, 1, square))
    return v * jnp.where(small, 2 + square / 3 + 3 / 20 * square**2, 2 * atan2(sine, w) / sine)


def to_matrix(q: Float[Array, "4"]) -> Float[Array, "3 3"]:
    """The rotation matrix R."""
    return jnp.stack(axes(q), axis=-1)


def from_matrix(r: Float[Array, "3 3"]) -> Float[Array, "4"]:
    """The quaternion of a rotation matrix, by Shepperd's method: divides by the largest component."""
    trace = r[0, 0] + r[1, 1] + r[2, 2]
    diagonal = jnp.append(2 * jnp.diagonal(r) - trace, trace)  # 4 q_i^2 - 1
    skew = jnp.stack([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]])  # 4 w (x, y, z)
    products = jnp.zeros((4, 4), r.dtype).at[:3, :3].set(r + r.T).at[3, :3].set(skew).at[:3, 3].set(skew)
    products = products.at[jnp.diag_indices(4)].set(1 + diagonal)  # 4 q_i q_j
    return normalize(products[jnp.argmax(diagonal)])


def from_rpy(rpy: Float[Array, "3"]) -> Float[Array, "4"]:
    """The quaternion of roll, pitch, yaw (rad) about fixed axes: R = Rz(yaw) Ry(pitch) Rx(roll)."""
    sin, cos = sin_cos(rpy / 2)
    cr, cp, cy = components(cos)
    sr, sp, sy = components(sin)
    return jnp.stack(
        [
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
            cr * cp * cy + sr * sp * sy,
        ]
    )


def to_rpy(q: Float[Array, "4"]) -> Float[Array, "3"]:
    """Roll, pitch, yaw (rad) about fixed axes, as Bullet extracts them.

    Within 0.26 degrees of pitch +-90 degrees (|sin| >= 0.99999) roll is set to zero and yaw takes it up.
    """
    x, y, z, w = components(q)
    sin_pitch = 2 * (w * y - x * z)
    up, down = sin_pitch >= 0.99999, sin_pitch <= -0.99999
    regular = ~(up | down)
    roll_y, roll_x = 2 * (y * z + w * x), w * w - x * x - y * y + z * z
    roll = jnp.where(regular, atan2(jnp.where(regular, roll_y, 0), jnp.where(regular, roll_x, 1)), 0)
    pitch = jnp.where(regular, asin(jnp.where(regular, sin_pitch, 0)), jnp.where(up, jnp.pi / 2, -jnp.pi / 2))
    yaw_y = jnp.where(regular, 2 * (x * y + w * z), jnp.where(up, -x, x))
    yaw_x = jnp.where(regular, w * w + x * x - y * y - z * z, jnp.where(up, y, -y))
    yaw = jnp.where(regular, 1, 2) * atan2(yaw_y, yaw_x)
    return jnp.stack([roll, pitch, yaw])
