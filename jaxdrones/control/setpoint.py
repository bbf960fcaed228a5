"""What a controller is asked to do."""

from __future__ import annotations

import flax.struct
import jax.numpy as jnp
from jaxtyping import Array, Float


class Setpoint(flax.struct.PyTreeNode):
    """Target of one drone, or of a team with a leading drone axis on every array."""

    pos: Array
    """(3,) m, world."""
    vel: Array
    """(3,) m/s, world."""
    acc: Array
    """(3,) m/s^2, world."""
    yaw: Array
    """() heading, rad."""
    omega: Array
    """(3,) angular velocity, rad/s, body."""

    @classmethod
    def at(
        cls,
        pos: Float[Array, "*n 3"],
        vel: Float[Array, "*n 3"] | None = None,
        acc: Float[Array, "*n 3"] | None = None,
        yaw: Float[Array, " *n"] | None = None,
        omega: Float[Array, "*n 3"] | None = None,
    ) -> Setpoint:
        """A position to be at; what is left out is zero."""
        pos = jnp.asarray(pos)
        zero = jnp.zeros_like(pos)
        return cls(
            pos=pos,
            vel=zero if vel is None else jnp.asarray(vel),
            acc=zero if acc is None else jnp.asarray(acc),
            yaw=zero[..., 0] if yaw is None else jnp.asarray(yaw),
            omega=zero if omega is None else jnp.asarray(omega),
        )
