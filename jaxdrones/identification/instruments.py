"""What stands between a flight and its log."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdrones import rotation
from jaxdrones.pytree import PyTreeNode


class Instruments(PyTreeNode):
    """How the arrays of a log differ from the flight; nothing differs for `Instruments.ideal()`."""

    delay: Array
    """() time by which rotor speeds or PWM act later than they are logged, s; negative where they are logged late."""
    tilt: Array
    """(2,) turn about body x and y from the logged attitude to that of the rotors, rad."""
    position_scale: Array
    """() horizontal distance in logged positions over that which logged velocities cover."""

    @classmethod
    def ideal(cls) -> Instruments:
        """A log that shows what was."""
        return cls(jnp.zeros(()), jnp.zeros(2), jnp.ones(()))

    def true_attitude(self, logged: Float[Array, "4"]) -> Float[Array, "4"]:
        """The attitude of the rotors."""
        return rotation.multiply(logged, rotation.exp(jnp.append(self.tilt, 0.0)))

    def logged_attitude(self, true: Float[Array, "4"]) -> Float[Array, "4"]:
        """The attitude that is logged."""
        return rotation.multiply(true, rotation.exp(jnp.append(-self.tilt, 0.0)))

    def logged_position(self, true: Float[Array, "3"], start: Float[Array, "3"]) -> Float[Array, "3"]:
        """The position that is logged of a flight from `start`."""
        scale = jnp.stack([self.position_scale, self.position_scale, jnp.ones_like(self.position_scale)])
        return start + scale * (true - start)
