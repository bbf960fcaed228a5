"""Barometer and magnetometer."""

from collections.abc import Callable
from typing import Annotated

import jax
import jax.numpy as jnp

from jaxdrones import rotation
from jaxdrones.arguments import checked, number, shape
from jaxdrones.params import Params
from jaxdrones.quantity import Quantity, quantities
from jaxdrones.sensing.noise import Errors, Noise
from jaxdrones.sensing.scene import Scene
from jaxdrones.sensing.sensor import Sensor
from jaxdrones.state import State

_FIELD = shape(3, meaning="x, y, z, uT, world", name="{argument} of a {function}", finite=True)
_RATE = Annotated[float, number("1/s", "{argument} of a {function}", above=0)]
_PASCAL = 1 / 12.013  # m; height at sea level over which the pressure of the ISA falls by 1 Pa: 1 / (1.225 x 9.80665)

BMP388 = Noise(density=0.03 * _PASCAL, turn_on=8 * _PASCAL)
"""Barometer of the Crazyflie 2.1, as height in m: Bosch BST-BMP388-DS001 gives a relative accuracy of +-8 Pa, taken for
the standard deviation of the bias, and a noise of 0.03 Pa at its slowest setting, used here as a density per
sqrt(Hz)."""
LIS3MDL = Noise(density=0.08, turn_on=3.0, limit=1200.0)
"""Magnetometer at 12 gauss, in uT: STMicroelectronics DocID024204 gives a noise of 3.2 (x, y) and 4.1 mgauss (z) in a
reading, 0.36 uT, which is this density at 20 Hz. The bias, of iron and currents around, is assumed."""
EUROPE = (0.0, 21.5, -43.0)
"""uT; about the magnetic field at a latitude of 47 degrees in central Europe, with x east, y north and z up (WMM)."""


@checked
def barometer(errors: Noise = BMP388, rate: _RATE = 50.0, name: str = "barometer") -> Sensor:
    """Barometer; its reading (1,) is the height above the origin by air pressure, m.

    The errors are in m; 1 Pa is 0.083 m at sea level. Wind and rotors disturb a real barometer by more.
    """
    entries = (Quantity("height measured", "m", "world"),)
    return _noisy(name, errors, rate, 1, lambda state: state.pos[2:], entries)


@checked
def magnetometer(
    errors: Noise = LIS3MDL,
    field: Annotated[tuple[float, float, float], _FIELD] = EUROPE,
    rate: _RATE = 20.0,
    name: str = "magnetometer",
) -> Sensor:
    """Magnetometer; its reading (3,) is the magnetic field in body axes, uT.

    The `field` (3,) is in uT, world, and the errors are in uT, too.
    """

    def true(state: State) -> jax.Array:
        return rotation.rotate_inverse(state.quat, jnp.asarray(field, state.quat.dtype))

    return _noisy(name, errors, rate, 3, true, quantities("magnetic field measured", "uT", "body"))


def _noisy(
    name: str,
    errors: Noise,
    rate: float,
    size: int,
    true: Callable[[State], jax.Array],
    entries: tuple[Quantity, ...],
) -> Sensor:
    """Sensor of `true(state)`, (size,), with errors."""

    def init(key: jax.Array, params: Params) -> Errors:
        return errors.init(key, (size,), params.mass.dtype)

    def measure(key: jax.Array, params: Params, state: State, rate_: State, scene: Scene, memory: Errors):
        return errors.measure(key, memory, true(state), 1 / rate)

    return Sensor(name, measure, init, bound=errors.limit, rate=rate, entries=entries, clocked=rate)
