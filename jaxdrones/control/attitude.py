"""What the tracking controllers share: the attitude that points a force, and the error to it."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdrones import rotation


def from_thrust(force: Float[Array, "3"], yaw: Float[Array, ""]) -> Float[Array, "3 3"]:
    """The attitude with body z along `force` (N, world) and body x as near to the heading `yaw` (rad) as it can be."""
    heading = jnp.stack([jnp.cos(yaw), jnp.sin(yaw), jnp.zeros_like(yaw)])
    z = rotation.unit(force)
    y = rotation.unit(rotation.cross(z, heading))
    return jnp.stack([rotation.cross(y, z), y, z], axis=-1)


def error(r: Float[Array, "3 3"], target: Float[Array, "3 3"]) -> Float[Array, "3"]:
    """Vector of (R_d^T R - R^T R_d) / 2, body: the sine of the angle times the axis (Lee et al. 2010)."""
    e = target.T @ r
    return jnp.stack([e[2, 1] - e[1, 2], e[0, 2] - e[2, 0], e[1, 0] - e[0, 1]]) / 2
