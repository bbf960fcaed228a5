"""Pilots: from the state of the drone to the sticks."""

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from numpy.typing import ArrayLike

from jaxdrones.control import Setpoint, rates
from jaxdrones.firmware.betaflight.packets import Sticks
from jaxdrones.firmware.betaflight.settings import IDLE, MAX_RATE
from jaxdrones.firmware.drone import Sample
from jaxdrones.params import Params
from jaxdrones.state import State

Pilot = Callable[[float, Sample], Sticks]
"""(time since arming in s, sample) -> sticks, 100 times a second."""
PERIOD = 0.01
"""Time between positions of the sticks, s."""
_MIN_CHECK = 0.05  # stick up to which the throttle is zero


def sticks_for(params: Params, thrust: float, omega: ArrayLike) -> Sticks:
    """Sticks for a total thrust (N) and body rates (3,) (rad/s, x forward, y left, z up) of a drone."""
    output = math.sqrt(max(thrust, 0.0) / (4 * float(params.kf))) / float(params.max_rpm)
    share = min(max((output - IDLE) / (1 - IDLE), 0.0), 1.0)
    roll, pitch, yaw = np.rad2deg(np.asarray(omega, float)) / MAX_RATE
    return Sticks(float(roll), float(pitch), _MIN_CHECK + (1 - _MIN_CHECK) * share, float(-yaw))


@jax.jit
def _command(params: Params, state: State, setpoint: Setpoint) -> Any:
    return rates.command(rates.gains(), params, state, setpoint)


@dataclasses.dataclass(frozen=True)
class Hover:
    """Outer loop of the controller `rates`: it flies to a position and stays there; Betaflight controls the rates."""

    params: Params
    """Parameters of the drone."""
    target: tuple[float, float, float] = (0.0, 0.0, 1.5)
    """m, world."""

    def __call__(self, t: float, sample: Sample) -> Sticks:
        """Sticks at a time since arming (s)."""
        thrust, omega = jax.device_get(_command(self.params, state_of(sample), Setpoint.at(np.array(self.target))))
        return sticks_for(self.params, float(thrust) * float(self.params.mass), omega)


@dataclasses.dataclass(frozen=True)
class TakeOff:
    """Take-off by one pilot, followed by another one that cannot take off."""

    first: Pilot
    """Pilot until `after`."""
    then: Pilot
    """Pilot afterwards, called with the time since `after`."""
    after: float
    """Time since arming, s."""

    def __call__(self, t: float, sample: Sample) -> Sticks:
        """Sticks at a time since arming (s)."""
        return self.first(t, sample) if t < self.after else self.then(t - self.after, sample)


@dataclasses.dataclass
class Flip:
    """Flip in acro: the drone climbs, rolls once around at full stick, and continues with another pilot."""

    params: Params
    """Parameters of the drone."""
    then: Pilot
    """Pilot before and after."""
    at: float
    """Time since arming, s."""
    _angle: float = 0.0
    _last: float | None = None

    _CLIMB = 0.35  # s
    _SHARE = 0.75  # share of the turn at full stick

    def __call__(self, t: float, sample: Sample) -> Sticks:
        """Sticks at a time since arming (s)."""
        weight = float(self.params.weight)
        if t < self.at or self._angle >= self._SHARE * 2 * math.pi:
            return self.then(t, sample)
        if t < self.at + self._CLIMB:
            return sticks_for(self.params, 2 * weight, np.zeros(3))
        self._angle += 0.0 if self._last is None else (t - self._last) * float(sample.omega[0])
        self._last = t
        return sticks_for(self.params, 0.3 * weight, np.zeros(3))._replace(roll=1.0)


def state_of(sample: Sample) -> State:
    """State of one drone."""
    arrays: Any = (sample.pos, sample.quat, sample.vel, sample.omega, sample.rpm)
    return State(*arrays)
