"""Log variables of the vehicle, in the firmware's names, units and signs."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from jaxdrones.firmware.crazyflie.toc import TYPES, Type
from jaxdrones.firmware.crazyflie.vehicle import Sample, Target

_G = 9.8  # m/s^2, unit of accelerations of the log; the gravity of the bundled vehicles
_VOLTAGE = 4.0  # V; the battery does not discharge


class Readings(NamedTuple):
    """Logged data of one instant."""

    sample: Sample
    target: Target
    status: int
    """State bits of the supervisor."""


class Variable(NamedTuple):
    """Log variable."""

    kind: Type
    read: Callable[[Readings], float]


def _variables() -> dict[str, Variable]:
    number = TYPES["float"]
    found: dict[str, Variable] = {}

    def add(names: str, kind: Type, read: Callable[..., Any]) -> None:
        group, _, rest = names.partition(".")
        for i, name in enumerate(rest.split()):
            found[f"{group}.{name}"] = Variable(kind, functools.partial(read, i=i))

    add("stateEstimate.x y z", number, lambda now, i: now.sample.pos[i])
    add("kalman.stateX stateY stateZ", number, lambda now, i: now.sample.pos[i])
    add("stateEstimate.vx vy vz", number, lambda now, i: now.sample.vel[i])
    add("stateEstimate.ax ay az", number, lambda now, i: _world_acc(now.sample)[i] / _G)
    add("stateEstimate.roll pitch yaw", number, lambda now, i: now.sample.rpy[i])
    add("stabilizer.roll pitch yaw", number, lambda now, i: now.sample.rpy[i])
    add("stateEstimate.qx qy qz qw", number, lambda now, i: now.sample.quat[i])
    add("kalman.varPX varPY varPZ", number, lambda now, i: 0.0)
    add("gyro.x y z", number, lambda now, i: np.rad2deg(now.sample.omega[i]))
    add("acc.x y z", number, lambda now, i: now.sample.acc[i] / _G)
    add("ctrltarget.x y z", number, lambda now, i: now.target.setpoint.pos[i])
    add("ctrltarget.vx vy vz", number, lambda now, i: now.target.setpoint.vel[i])
    add("stabilizer.thrust", number, lambda now, i: float(np.mean(now.sample.motors)))
    add("motor.m1 m2 m3 m4", TYPES["uint32_t"], lambda now, i: now.sample.motors[i])
    add("pm.vbat", number, lambda now, i: _VOLTAGE)
    add("pm.vbatMV", TYPES["uint16_t"], lambda now, i: 1000 * _VOLTAGE)
    add("pm.batteryLevel", TYPES["uint8_t"], lambda now, i: 100)
    add("pm.state", TYPES["int8_t"], lambda now, i: 0)
    add("range.zrange", TYPES["uint16_t"], lambda now, i: 1000 * now.sample.pos[2])
    add("radio.rssi", TYPES["uint8_t"], lambda now, i: 0)
    add("supervisor.info", TYPES["uint16_t"], lambda now, i: now.status)
    bits = (3, 4, 5, 1)
    add("sys.canfly isFlying isTumbled armed", TYPES["uint8_t"], lambda now, i: now.status >> bits[i] & 1)
    return dict(sorted(found.items()))


def _world_acc(sample: Sample) -> np.ndarray:
    """(3,) acceleration without gravity, m/s^2, world."""
    u, w = sample.quat[:3], sample.quat[3]
    turned = 2 * np.cross(u, sample.acc)
    return sample.acc + w * turned + np.cross(u, turned) - [0.0, 0.0, _G]


VARIABLES = _variables()
"""Name `group.name` -> log variable."""
