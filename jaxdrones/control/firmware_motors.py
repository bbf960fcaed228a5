"""From the 16-bit commands of the Crazyflie's firmware to thrust and to the duty cycle of its brushed motors.

The constants are those of the firmware (Bitcraze, 2025.12): the thrust of one motor is a cubic of the mean voltage
across it, and a command is a share of the largest thrust, whatever the battery has left.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdrones import vector
from jaxdrones.checks import check_choice
from jaxdrones.pytree import PyTreeNode
from jaxdrones.thrust_curves import THRUST_CURVES, voltage_for

FULL = 65535.0
"""The largest command and the duty cycle of a motor that is always on."""

_MIXER = ((-0.5, -0.5, -1.0), (-0.5, 0.5, 1.0), (0.5, 0.5, -1.0), (0.5, -0.5, 1.0))
_LEAST_VOLTAGE = 2.0  # V; below it a reading of the battery is not believed, and the motors stop
_COMMANDS = {"2.1": (0.12, 0.012817578), "2.1+": (0.12, 0.012817578), "thrust upgrade": (0.18, 0.019226368)}
"""N at full command, N below which a motor stands still."""
PROPELLERS = tuple(_COMMANDS)


class Motor(PyTreeNode):
    """Thrust of one motor with its propeller, as the firmware believes it to be."""

    thrust: Array
    """(4,) polynomial of the voltage, N, N/V, N/V^2, N/V^3; it must rise with the voltage."""
    max_thrust: Array
    """() N at full command."""
    min_thrust: Array
    """() N; a motor that is told to push less stands still."""


def motor(propellers: str = "2.1+") -> Motor:
    """The motor of a Crazyflie with propellers of the 2.1, of the 2.1+, or of the thrust upgrade kit.

    Raises:
        ValueError: unknown propellers.
    """
    check_choice("propellers", propellers, PROPELLERS)
    return Motor(jnp.array(THRUST_CURVES[propellers]), *(jnp.array(x) for x in _COMMANDS[propellers]))


def duty_cycle(motor: Motor, command: Float[Array, "4"], battery: Float[Array, ""]) -> Float[Array, "4"]:
    """Duty cycle (0 to 65535 and above) that makes of a battery's voltage (V) the thrust of a 16-bit command."""
    thrust = command * (motor.max_thrust / FULL)
    turning = (thrust >= motor.min_thrust) & (battery >= _LEAST_VOLTAGE)
    return jnp.where(turning, voltage_for(motor.thrust, thrust) * (FULL / jnp.maximum(battery, _LEAST_VOLTAGE)), 0)


def mix(
    thrust: Float[Array, ""], torque: Float[Array, "3"], mixer: Float[Array, "4 3"] | None = None
) -> Float[Array, "4"]:
    """Commands of the motors, of any size.

    Args:
        thrust: 16 bit, of each motor.
        torque: roll, pitch, yaw, 16 bit, right-handed body axes.
        mixer: share of each motor in the torques; the firmware's for a Crazyflie, a cross, when left out.
    """
    shares = jnp.array(_MIXER) if mixer is None else mixer
    return thrust + jax.vmap(vector.dot, (0, None))(shares, torque)


def within_range(commands: Float[Array, "4"]) -> Float[Array, "4"]:
    """Commands from 0 to 65535: where one is too high all are lowered, so that thrust is lost and not attitude."""
    return jnp.maximum(commands - jnp.maximum(jnp.max(commands) - FULL, 0), 0)
