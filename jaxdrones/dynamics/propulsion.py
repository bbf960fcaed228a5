"""Rotors with PWM commands, and rotor failures."""

import functools
from collections.abc import Callable
from typing import Annotated

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxdrones.arguments import checked, choice, number, shape
from jaxdrones.checks import is_concrete, short_repr
from jaxdrones.dynamics.model import constants
from jaxdrones.dynamics.power import battery_voltage
from jaxdrones.dynamics.rotors import lagging_rotors
from jaxdrones.errors import UserError
from jaxdrones.params import Params
from jaxdrones.pytree import PyTreeNode
from jaxdrones.state import State
from jaxdrones.thrust_curves import THRUST_CURVES, thrust_at, voltage_for
from jaxdrones.vector import safe_sqrt

Rotors = Callable[[Params, State, Float[Array, "4"]], tuple[Float[Array, "4"], Float[Array, "4"]]]

Supply = Annotated[ArrayLike, number("V", "supply of the motors", above=0)]
FULL_PWM = 65535
"""PWM command at a duty cycle of 1."""


class Motors(PyTreeNode):
    """Thrust curve of the motors, `Params.aux["motors"]`; `crazyflie_motors` and `cubic_motors` make it."""

    coefficients: Array
    """(4,) coefficients of the thrust of one motor as a cubic of its voltage, N/V^0 to N/V^3."""
    supply: Array
    """() supply voltage if no battery is simulated, V."""

    def thrust(self, voltage: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Thrust of one motor at a mean voltage (V), N; zero at low voltage, where the cubic is negative."""
        return jnp.maximum(thrust_at(self.coefficients, voltage), 0)

    def voltage(self, thrust: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Voltage for a thrust (N), V: the single root of the monotonic cubic."""
        return voltage_for(self.coefficients, thrust)


_CUBIC = shape(
    4, meaning="those of the powers 0 to 3 of the voltage", name="coefficients of the thrust curve", finite=True
)


@checked
def cubic_motors(coefficients: Annotated[ArrayLike, _CUBIC], supply: Supply = 3.7) -> Motors:
    """Motors with a cubic thrust curve.

    Args:
        coefficients: (4,) coefficients of the powers 0 to 3 of the voltage, N/V^0 to N/V^3.
        supply: supply voltage without a simulated battery, V.

    Raises:
        ValueError: a wrong shape, numbers that are not finite, a curve that does not rise everywhere, or a supply
            voltage that is not positive.
    """
    if is_concrete(coefficients):
        _, b, c, d = np.asarray(coefficients, float)
        if not (d > 0 and c * c < 3 * b * d):
            raise UserError(
                f"the thrust curve {short_repr(coefficients)} does not rise everywhere; "
                "give a cubic whose slope is positive"
            )
    return Motors(jnp.asarray(coefficients, float), jnp.asarray(supply, float))


@checked
def crazyflie_motors(
    propellers: Annotated[str, choice("propellers", THRUST_CURVES)] = "2.1+", supply: Supply = 3.7
) -> Motors:
    """Motors of the Crazyflie with the firmware's thrust curve, a name of `THRUST_CURVES`; see `cubic_motors`."""
    return cubic_motors(np.array(THRUST_CURVES[propellers]), supply)


def pwm_rotors(params: Params, state: State, command: Float[Array, "4"]) -> tuple[Float[Array, "4"], Float[Array, "4"]]:
    """Rotors with a first-order lag and a PWM command (4,) for each motor, limited to 0 .. 65535.

    The mean voltage of a motor is the fraction PWM / 65535 of the supply voltage: that of `battery()` under load, or
    the motors' `supply` in a step without this model. The motors' cubic gives the thrust, and `kf` the speed for it.
    `Motors` are in `params.aux["motors"]`.
    """
    thrust = _motors(params).thrust(_duty(command) * supply_voltage(params, state))
    return lagging_rotors(params, state, safe_sqrt(thrust / params.kf))


def pwm_of_thrust(params: Params, state: State, thrust: Float[Array, "4"]) -> Float[Array, "4"]:
    """PWM commands for rotor thrusts (4,), N, limited to 0 .. 65535: battery compensation for `pwm_rotors`."""
    return FULL_PWM * _duty(FULL_PWM * _motors(params).voltage(thrust) / supply_voltage(params, state))


def supply_voltage(params: Params, state: State) -> Float[Array, ""]:
    """Voltage of the motors at full PWM, V."""
    return battery_voltage(params, state) if "battery" in state.aux else _motors(params).supply


def failing(rotors: Rotors) -> Rotors:
    """Rotors with failures: each gets the fraction `params.aux["rotor_health"]` (4,) of its command.

    A rotor of health 1 is intact, and a rotor of health 0 slows down and stops. Like every parameter, the health can be
    randomized, change in flight, and have a gradient.
    """

    @functools.wraps(rotors)
    def with_health(params: Params, state: State, command: Float[Array, "4"]) -> tuple[Array, Array]:
        health = constants(params, "rotor_health", "jax.numpy.ones(4)")
        return rotors(params, state, health * command)

    return with_health


def _duty(pwm: Float[Array, "4"]) -> Float[Array, "4"]:
    """Duty cycle, 0 to 1; the derivative at the limits is not zero, so gradient descent can leave them."""
    return jnp.where(pwm < 0, 0, jnp.where(pwm > FULL_PWM, 1, pwm / FULL_PWM))


def _motors(params: Params) -> Motors:
    motors: Motors = constants(params, "motors", "jaxdrones.crazyflie_motors()")
    return motors
