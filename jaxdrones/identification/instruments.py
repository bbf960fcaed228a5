"""What stands between a flight and its log."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdrones import rotation
from jaxdrones.pytree import PyTreeNode
from jaxdrones.state import State
from jaxdrones.vector import components

_SOUND_SAG = 0.55  # V, of a Crazyflie's battery at take-off, up to which motors get the voltage that is logged


class Instruments(PyTreeNode):
    """How the arrays of a log differ from the flight; nothing differs for `Instruments.ideal()`."""

    delay: Array
    """() time by which rotor speeds or PWM act later than they are logged, s; negative where they are logged late."""
    tilt: Array
    """(2,) turn about body x and y from the logged attitude to that of the rotors, rad."""
    position_scale: Array
    """() horizontal distance in logged positions over that which logged velocities cover."""
    unfelt_sag: Array
    """() share of a battery's sag at take-off, of what is beyond 0.55 V, that is logged and that motors do not feel."""
    estimate_tilt: Array
    """() tilt that the drone's own filter shows over the true one."""
    estimate_delay: Array
    """() time by which its position and attitude are late, s."""

    @classmethod
    def ideal(cls) -> Instruments:
        """A log that shows what was."""
        return cls(jnp.zeros(()), jnp.zeros(2), jnp.ones(()), jnp.zeros(()), jnp.ones(()), jnp.zeros(()))

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

    def motor_supply(self, logged: Float[Array, "*n"], sag: Float[Array, "*#n"]) -> Float[Array, "*n"]:
        """Voltage that motors get at full PWM, V, by that of the battery and its sag at take-off, V."""
        return logged + self.unfelt_sag * jnp.maximum(sag - _SOUND_SAG, 0)

    def estimate(self, state: State) -> State:
        """The state of one drone as its own filter shows it."""
        late = rotation.multiply(state.quat, rotation.exp(-self.estimate_delay * state.omega))
        x, y, _ = components(rotation.z_axis(late))
        more_tilt = (self.estimate_tilt - 1) * jnp.stack([-y, x, jnp.zeros_like(x)])
        return state.replace(
            pos=state.pos - self.estimate_delay * state.vel, quat=rotation.multiply(rotation.exp(more_tilt), late)
        )
