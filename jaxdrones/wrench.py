"""Wrenches: force and torque of effects, which add up."""

from typing import Self

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdrones.pytree import PyTreeNode
from jaxdrones.vector import along_z, components, dot, total


class Wrench(PyTreeNode):
    """Force and torque on one drone at its center of mass, in its body frame."""

    force: Array
    """(3,) N, body."""
    torque: Array
    """(3,) N m, body, about the center of mass."""

    def __add__(self, other: Self) -> Self:
        return type(self)(self.force + other.force, self.torque + other.torque)

    @classmethod
    def of_force(cls, force: Float[Array, "3"]) -> Self:
        """Force (N, body) through the center of mass."""
        return cls(force, jnp.zeros_like(force))

    @classmethod
    def of_torque(cls, torque: Float[Array, "3"]) -> Self:
        """Torque (N m, body) without a force."""
        return cls(jnp.zeros_like(torque), torque)

    @classmethod
    def of_thrusts(cls, rotor_pos: Float[Array, "4 3"], thrust: Float[Array, "4"] | list[Float[Array, ""]]) -> Self:
        """Wrench of forces along body z (N) at the rotors (m, body); `thrust` is an array or a list of four."""
        x, y, _ = components(rotor_pos.T)
        force = along_z(total(thrust))
        zero = jnp.zeros_like(dot(x, thrust))
        torque = jnp.stack([dot(y, thrust), -dot(x, thrust), zero])
        return cls(force, torque)
