"""Force and torque, the currency of the physics: every effect returns one and they add up."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdrones.pytree import PyTreeNode
from jaxdrones.vector import components, dot


class Wrench(PyTreeNode):
    """Force and torque on one drone at its centre of mass, in its body frame."""

    force: Array
    """(3,) N, body."""
    torque: Array
    """(3,) N m, body, about the centre of mass."""

    def __add__(self, other: Wrench) -> Wrench:
        return Wrench(self.force + other.force, self.torque + other.torque)

    @classmethod
    def of_force(cls, force: Float[Array, "3"]) -> Wrench:
        """A force (N, body) through the centre of mass."""
        return cls(force, jnp.zeros_like(force))

    @classmethod
    def of_torque(cls, torque: Float[Array, "3"]) -> Wrench:
        """A torque (N m, body) without a force."""
        return cls(jnp.zeros_like(torque), torque)

    @classmethod
    def of_thrusts(cls, rotor_pos: Float[Array, "4 3"], thrust: Float[Array, "4"]) -> Wrench:
        """Forces along body z (N) at the rotors (m, body): sum of f and of r x f."""
        x, y, _ = components(rotor_pos.T)
        zero = jnp.zeros((), thrust.dtype)
        force = jnp.stack([zero, zero, sum(components(thrust))])
        torque = jnp.stack([dot(y, thrust), -dot(x, thrust), zero])
        return cls(force, torque)
