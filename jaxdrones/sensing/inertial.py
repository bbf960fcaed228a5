"""Inertial measurement units: accelerometer and gyroscope, with errors of named parts."""

import dataclasses
import functools
import math
from typing import Annotated

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdrones import rotation
from jaxdrones.arguments import checked, number, shape
from jaxdrones.params import Params
from jaxdrones.quantity import quantities
from jaxdrones.sensing.noise import Errors, Noise
from jaxdrones.sensing.scene import Scene
from jaxdrones.sensing.sensor import Sensor
from jaxdrones.state import State
from jaxdrones.vector import along_z, cross

STANDARD_GRAVITY = 9.80665
"""m/s^2; what a data sheet calls g."""
_DEGREE = math.pi / 180
_OFFSET = shape(3, meaning="x, y, z, m, body", name="{argument} of an {function}", finite=True)


@dataclasses.dataclass(frozen=True)
class ImuPart:
    """Errors of an inertial measurement unit."""

    acc: Noise
    """Of the accelerometer, m/s^2."""
    gyro: Noise
    """Of the gyroscope, rad/s."""


PERFECT = ImuPart(Noise(), Noise())
"""A unit without errors."""
BMI088 = ImuPart(
    acc=Noise(density=175e-6 * STANDARD_GRAVITY, turn_on=20e-3 * STANDARD_GRAVITY, limit=24 * STANDARD_GRAVITY),
    gyro=Noise(density=0.014 * _DEGREE, instability=2 / 3600 * _DEGREE, turn_on=1 * _DEGREE, limit=2000 * _DEGREE),
)
"""Of the Crazyflie 2.1, at the ranges of its firmware (24 g, 2000 degrees/s): Bosch BST-BMI088-DS001 gives 175 ug and
0.014 degrees/s per sqrt(Hz), offsets of +-20 mg and +-1 degree/s, used as standard deviations, and a gyroscope stable
to 2 degrees/h, whose correlation time of 100 s is assumed. It does not state the stability of the accelerometer."""
MPU9250 = ImuPart(
    acc=Noise(density=300e-6 * STANDARD_GRAVITY, turn_on=60e-3 * STANDARD_GRAVITY, limit=16 * STANDARD_GRAVITY),
    gyro=Noise(density=0.01 * _DEGREE, turn_on=5 * _DEGREE, limit=2000 * _DEGREE),
)
"""Of the Crazyflie 2.0, at 16 g and 2000 degrees/s: InvenSense PS-MPU-9250A-01 gives 300 ug and 0.01 degrees/s per
sqrt(Hz) and offsets of +-60 mg and +-5 degrees/s, used as standard deviations. It does not state their stability."""


@checked
def imu(
    part: ImuPart = BMI088,
    rate: Annotated[float, number("1/s", "{argument} of an {function}", above=0)] = 100.0,
    offset: Annotated[tuple[float, float, float], _OFFSET] = (0.0, 0.0, 0.0),
    name: str = "imu",
) -> Sensor:
    """Inertial measurement unit; its reading is `acc` (3,), specific force, m/s^2, and `gyro` (3,), rad/s, body.

    Readings are instantaneous, without the unit's low-pass filter: white noise has the density of the part and the
    standard deviation density times sqrt(`rate`). The unit has an offset (3,) from the center of mass, m, body.
    """
    at_center = not np.any(np.asarray(offset))

    def measure(key: jax.Array, params: Params, state: State, rate_: State, scene: Scene, memory: dict[str, Errors]):
        place = None if at_center else jnp.asarray(offset, state.pos.dtype)
        return read(part, key, memory, motion(params, state, rate_, place), 1 / rate)

    entries = (*quantities("specific force", "m/s^2", "body"), *quantities("body rates measured", "rad/s", "body"))
    bound = max(part.acc.limit, part.gyro.limit)
    return Sensor(name, measure, functools.partial(begin, part), bound=bound, rate=rate, entries=entries, clocked=rate)


def begin(part: ImuPart, key: jax.Array, params: Params) -> dict[str, Errors]:
    """Initial errors of a unit in an episode: of `acc` and of `gyro`."""
    keys = dict(zip(("acc", "gyro"), jax.random.split(key), strict=True))
    return {name: getattr(part, name).init(keys[name], (3,), params.mass.dtype) for name in keys}


def read(
    part: ImuPart, key: jax.Array, errors: dict[str, Errors], true: dict[str, Array], dt: float
) -> tuple[dict[str, Errors], dict[str, Array]]:
    """Errors and reading of one measurement of a unit, `dt` (s) after the previous one; `true` is from `motion`."""
    keys = dict(zip(("acc", "gyro"), jax.random.split(key), strict=True))
    result = {name: getattr(part, name).measure(keys[name], errors[name], true[name], dt) for name in keys}
    return {name: result[name][0] for name in keys}, {name: result[name][1] for name in keys}


def mean_motion(
    params: Params, quat: Float[Array, "4"], vel: Float[Array, "3"], state: State, dt: float
) -> dict[str, Array]:
    """Mean ideal reading over a step of dt (s), as of a unit that integrates: `acc` and `gyro`, body.

    Rotation and change of velocity over the step follow exactly from these means, with `acc` in the axes of mid-step.
    The attitude and velocity are those at the start of the step, the state that at its end.
    """
    turn = rotation.log(rotation.multiply(rotation.conjugate(quat), state.quat))
    middle = rotation.multiply(quat, rotation.exp(turn / 2))
    return {
        "acc": rotation.rotate_inverse(middle, (state.vel - vel) / dt + along_z(params.gravity)),
        "gyro": turn / dt,
    }


def motion(params: Params, state: State, rate: State, offset: Float[Array, "3"] | None = None) -> dict[str, Array]:
    """Ideal reading: `acc` R^T (a - g) + dw/dt x r + w x (w x r), m/s^2, and `gyro` w, rad/s, body; r is the offset."""
    acc = rotation.rotate_inverse(state.quat, rate.vel + along_z(params.gravity))
    if offset is not None:
        acc += cross(rate.omega, offset) + cross(state.omega, cross(state.omega, offset))
    return {"acc": acc, "gyro": state.omega}
