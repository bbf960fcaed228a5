"""Attitude targets and attitude errors of tracking controllers."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdrones import vector
from jaxdrones.vector import dot, sin_cos

Axes = list[Float[Array, "3"]]
"""The body's x, y and z in the world frame."""


def from_thrust(force: Float[Array, "3"], yaw: Float[Array, ""]) -> Axes:
    """Attitude with body z along `force` (N, world) and body x as close to the heading `yaw` (rad) as possible."""
    sin, cos = sin_cos(yaw)
    heading = jnp.stack([cos, sin, jnp.zeros_like(yaw)])
    z = vector.unit(force)
    y = vector.unit(vector.cross(z, heading))
    return [vector.cross(y, z), y, z]


def error(axes: Axes, target: Axes) -> Float[Array, "3"]:
    """Attitude error, body: the vector of (R_d^T R - R^T R_d) / 2, sine of the angle times axis (Lee et al. 2010)."""
    x, y, z = axes
    tx, ty, tz = target
    return jnp.stack([dot(tz, y) - dot(ty, z), dot(tx, z) - dot(tz, x), dot(ty, x) - dot(tx, y)]) / 2
