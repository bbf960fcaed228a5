"""Thrust and duty cycle of the Crazyflie's brushed motors from the 16-bit commands of its firmware.

The constants are those of the firmware (Bitcraze, 2025.12): the thrust of one motor is a cubic of the mean voltage
across it, and a command is a fraction of the maximum thrust, at any voltage of the battery.
"""

from typing import Annotated

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdrones import vector
from jaxdrones.arguments import checked, choice
from jaxdrones.checks import check_number
from jaxdrones.control.allocation import mixer
from jaxdrones.params import Params
from jaxdrones.pytree import PyTreeNode
from jaxdrones.thrust_curves import THRUST_CURVES, voltage_for
from jaxdrones.vector import largest, safe_sqrt

FULL = 65535.0
"""The largest command, and the duty cycle of a motor that is always on."""

_MIXER = ((-0.5, -0.5, -1.0), (-0.5, 0.5, 1.0), (0.5, 0.5, -1.0), (0.5, -0.5, 1.0))
_BATTERY_FILTER = 0.99  # weight of the last filtered voltage after 1 ms
_WEIGHT = 0.029 * 9.81  # N, weight of a Crazyflie 2.1 with 2.1+ propellers in its firmware
_LEVERS = (0.0325, 0.0325, 0.00699)  # m, lever arms along y and x; torque over thrust in its firmware
_INERTIA = (16.6e-6, 16.7e-6, 29.3e-6)  # kg m^2; Foerster 2015
_ACCELERATION = tuple(
    _WEIGHT * lever * share / inertia for lever, share, inertia in zip(_LEVERS, (0.5, 0.5, 1), _INERTIA, strict=True)
)  # 1/s^2, as `_acceleration` computes it
_LEAST_VOLTAGE = 2.0  # V; the firmware considers a lower reading of the battery invalid and stops the motors
_COMMANDS = {"2.1": (0.12, 0.012817578), "2.1+": (0.12, 0.012817578), "thrust upgrade": (0.18, 0.019226368)}
"""Thrust at full command, N; thrust below which a motor stands still, N."""
PROPELLERS = tuple(_COMMANDS)


class Motor(PyTreeNode):
    """The firmware's model of the thrust of one motor with its propeller."""

    thrust: Array
    """(4,) coefficients of the thrust in the voltage, N, N/V, N/V^2, N/V^3; thrust must rise with the voltage."""
    max_thrust: Array
    """() thrust at full command, N."""
    min_thrust: Array
    """() thrust below which the motor stops, N."""


class Command(PyTreeNode):
    """Commands of the firmware, as in its log."""

    attitude: Array
    """(3,) desired roll, pitch, yaw, degrees; pitch is positive nose up. For `Rates` the present attitude."""
    thrust: Array
    """() thrust of each motor, 16 bit."""
    torque: Array
    """(3,) torque in roll, pitch, yaw, 16 bit, right-handed body axes."""
    pwm: Array
    """(4,) duty cycles of the motors, 0 to 65535: front right, back right, back left, front left."""


@checked
def motor(propellers: Annotated[str, choice("propellers", PROPELLERS)] = "2.1+") -> Motor:
    """Motor of a Crazyflie with propellers of the 2.1, of the 2.1+, or of the thrust upgrade kit."""
    return Motor(jnp.array(THRUST_CURVES[propellers]), *(jnp.array(x) for x in _COMMANDS[propellers]))


def duty_cycle(motor: Motor, command: Float[Array, "4"], battery: Float[Array, ""]) -> Float[Array, "4"]:
    """Duty cycle (0 to 65535, not limited) for a 16-bit thrust command at a battery voltage (V)."""
    thrust = command * (motor.max_thrust / FULL)
    turning = (thrust >= motor.min_thrust) & (battery >= _LEAST_VOLTAGE)
    return jnp.where(turning, voltage_for(motor.thrust, thrust) * (FULL / jnp.maximum(battery, _LEAST_VOLTAGE)), 0)


def mix(
    thrust: Float[Array, ""], torque: Float[Array, "3"], mixer: Float[Array, "4 3"] | None = None
) -> Float[Array, "4"]:
    """Commands of the motors from thrust and torque, 16 bit, not limited; the default mixer is a Crazyflie in X."""
    shares = jnp.array(_MIXER) if mixer is None else mixer
    return jnp.stack([thrust + vector.dot(share, torque) for share in vector.components(shares)])


def within_range(commands: Float[Array, "4"]) -> Float[Array, "4"]:
    """Commands limited to 0 .. 65535; if one is too high, all are lowered, so thrust is reduced before torque."""
    excess = jnp.maximum(largest(commands) - FULL, 0)
    return jnp.stack([jnp.maximum(command - excess, 0) for command in vector.components(commands)])


def duty_cycles(
    motor: Motor,
    thrust: Float[Array, ""],
    torque: Float[Array, "3"],
    battery: Float[Array, ""] | float | None,
    voltage: Float[Array, ""],
    dt: float,
) -> tuple[Float[Array, ""], Float[Array, "4"]]:
    """Filtered battery voltage, V, and duty cycles, 0 to 65535, for a thrust of each motor and a torque, 16 bit.

    The torque has right-handed body axes. Without a `battery` (V), nothing is compensated, so that a duty cycle equals
    the command. `voltage` is the filtered one at the last call, V, zero at the first, and `dt` the time since then, s.
    """
    commands = mix(thrust, torque)
    if battery is None:
        return voltage, within_range(commands)
    kept = jnp.where(voltage > 0, _BATTERY_FILTER ** (dt / 0.001), 0)
    voltage = battery + kept * (voltage - battery)
    return voltage, within_range(duty_cycle(motor, commands, voltage))


def rotor_speeds(
    motor: Motor, params: Params, thrust: Float[Array, ""], torque: Float[Array, "3"]
) -> Float[Array, "4"]:
    """Rotor speeds (RPM, up to `max_rpm`) for the thrusts of 16-bit commands, mixed by the geometry of the rotors."""
    commands = within_range(mix(thrust, torque, mixer(params)))
    return jnp.minimum(safe_sqrt(commands * (motor.max_thrust / FULL) / params.kf), params.max_rpm)


def scale(params: Params) -> tuple[Float[Array, ""], Float[Array, "3"]]:
    """Factors of the firmware's thrust and torque commands for a vehicle to respond like a Crazyflie.

    The first is the weight over that of a Crazyflie. A torque that no rotor speeds produce is not commanded.

    Raises:
        ValueError: there is no gravity.
    """
    check_number("params.gravity", params.gravity, "m/s^2", above=0)
    acceleration = _acceleration(params)
    turns = acceleration != 0
    return params.weight / _WEIGHT, jnp.where(turns, jnp.array(_ACCELERATION) / jnp.where(turns, acceleration, 1), 0)


def _acceleration(params: Params) -> Float[Array, "3"]:
    """Angular acceleration for a torque command as large as the thrust command of hover, 1/s^2."""
    x, y, _ = params.rotor_pos.T
    levers = jnp.stack([y, -x, params.rotor_spin * params.km / params.kf])
    return params.weight * jnp.sum(levers * mixer(params).T, axis=1) / params.inertia / 4
