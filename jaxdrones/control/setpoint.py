"""Set-points of controllers."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array
from numpy.typing import ArrayLike

from jaxdrones.pytree import PyTreeNode


class Setpoint(PyTreeNode):
    """Target of one drone, or of a team, with a leading drone axis on every array."""

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
        pos: ArrayLike,
        vel: ArrayLike | None = None,
        acc: ArrayLike | None = None,
        yaw: ArrayLike | None = None,
        omega: ArrayLike | None = None,
    ) -> Setpoint:
        """Set-point at a position (*n, 3), with other quantities zero by default."""
        pos = jnp.asarray(pos)
        zero = jnp.zeros_like(pos)
        return cls(
            pos=pos,
            vel=zero if vel is None else jnp.asarray(vel),
            acc=zero if acc is None else jnp.asarray(acc),
            yaw=zero[..., 0] if yaw is None else jnp.asarray(yaw),
            omega=zero if omega is None else jnp.asarray(omega),
        )
