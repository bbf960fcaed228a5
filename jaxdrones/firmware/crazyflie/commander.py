"""Set-points in packets of the commander and the generic commander, and timeouts without them."""

import math
import struct
from typing import Any

import numpy as np

from jaxdrones.firmware.crazyflie.high_level import HighLevel
from jaxdrones.firmware.crazyflie.parameters import Parameters
from jaxdrones.firmware.crazyflie.planner import Goal
from jaxdrones.firmware.crazyflie.vehicle import Sample, Target, motors_off, target
from jaxdrones.rotation import yaw_of

LEVEL_AFTER, OFF_AFTER = 0.5, 2.0
"""Seconds without a set-point after which the vehicle levels, and after which its motors stop."""
_SETPOINT, _META = 0, 1
_LEAST_THRUST, _MOST_THRUST = 1000, 60000
_FORMATS = {  # type -> format of its data
    0: "",
    1: "ffff",
    2: "ffff",
    4: "ffff",
    5: "ffff",
    6: "hhhhhhhhhIhhh",
    7: "ffff",
    8: "ffff",
    9: "ffff",
    10: "ffff",
    11: "fffHB",
}


class Commander:
    """Source of the set-point: the packets of a client, or the high-level commander after a handover.

    Packets with numbers that are not finite are ignored.
    """

    def __init__(self, parameters: Parameters, high_level: HighLevel):
        self._parameters, self.high_level = parameters, high_level
        self._streamed: Target | None = None
        self._time = -math.inf
        self._valid_until: float | None = None
        self._thrust_locked = True

    def rpyt(self, data: bytes, t: float) -> None:
        """Set roll, pitch, yaw rate and thrust; as a safety lock, the first packet must have zero thrust."""
        if len(data) != 14:
            return
        roll, pitch, yaw, thrust = struct.unpack("<fffH", data)
        if not all(map(math.isfinite, (roll, pitch, yaw))):
            return
        if self._streamed is None:
            self._thrust_locked = True
        if thrust == 0:
            self._thrust_locked = False
        thrust = 0 if self._thrust_locked or thrust < _LEAST_THRUST else min(thrust, _MOST_THRUST)
        by_rate = not self._parameters["flightmode.stabModeRoll"], not self._parameters["flightmode.stabModePitch"]
        heading: dict[str, Any] = {"yaw_rate": -math.radians(yaw)}  # of this packet alone it is clockwise
        if self._parameters["flightmode.stabModeYaw"]:
            heading = {"yaw": math.radians(yaw)}
        self._stream(target(thrust=thrust, rpy=np.deg2rad([roll, -pitch, 0.0]), by_rate=by_rate, **heading), t)

    def generic(self, channel: int, data: bytes, t: float) -> None:
        """Set a set-point of any kind, or end a stream."""
        if channel == _META:
            if len(data) == 5 and data[0] == 0:
                self._valid_until = t + struct.unpack("<I", data[1:])[0] / 1000
            return
        form = _FORMATS.get(data[0] if data else -1)
        if channel == _SETPOINT and form is not None and len(data) == 1 + struct.calcsize("<" + form):
            values = struct.unpack("<" + form, data[1:])
            if all(math.isfinite(x) for x in values):
                self._stream(_decode(data[0], values), t)

    def plan(self, data: bytes, t: float, sample: Sample) -> bytes:
        """Answer to a command of the high-level commander, which flies if the stream has ended or is old."""
        now = Goal.at_rest(sample.pos, math.radians(sample.rpy[2]))
        answer = self.high_level.command(data, t, now)
        if self._valid_until is not None or t - self._time >= LEVEL_AFTER:
            self._streamed, self._valid_until = None, None
        return answer

    def off(self) -> None:
        """Drop all set-points."""
        self._streamed, self._valid_until = None, None
        self.high_level.off()

    def target(self, t: float) -> Target:
        """Set-point at time t (s)."""
        if self._streamed is None:
            return self.high_level.target(t)
        age = t - self._time
        if age < LEVEL_AFTER or (self._valid_until is not None and t <= self._valid_until):
            return self._streamed
        if age < OFF_AFTER:
            return _level(self._streamed)
        self._streamed, self._valid_until = None, None
        return motors_off()

    def _stream(self, new: Target, t: float) -> None:
        self._streamed, self._time, self._valid_until = new, t, None
        self.high_level.off()


def _level(old: Target) -> Target:
    """Level attitude at the height or thrust of a set-point."""
    setpoint = old.setpoint.replace(rpy=np.zeros(3), tilt_given=np.array(True), rates_given=np.zeros(2, bool))
    return old.replace(setpoint=setpoint, yaw_rate=np.array(0.0), yaw_given=np.array(False))


def _decode(kind: int, values: tuple[Any, ...]) -> Target:
    """Set-point of a generic packet; the firmware's pitch is positive nose up, legacy yaw rates are clockwise."""
    if kind == 0:
        return motors_off()
    if kind in (1, 8):
        *vel, yaw_rate = values
        return target(vel=vel, yaw_rate=math.radians(yaw_rate if kind == 8 else -yaw_rate))
    if kind in (2, 9):
        roll, pitch, yaw_rate, height = values
        yaw_rate = math.radians(yaw_rate if kind == 9 else -yaw_rate)
        return target(rpy=np.deg2rad([roll, -pitch, 0]), height=height, yaw_rate=yaw_rate)
    if kind == 4:
        roll, pitch, yaw_rate, climb = values
        return target(vel=[0, 0, climb], rpy=np.deg2rad([roll, -pitch, 0]), yaw_rate=math.radians(yaw_rate))
    if kind in (5, 10):
        forward, left, yaw_rate, height = values
        yaw_rate = math.radians(yaw_rate if kind == 10 else -yaw_rate)
        return target(vel=[forward, left, 0], in_heading=True, height=height, yaw_rate=yaw_rate)
    if kind == 6:
        yaw = yaw_of(*decompress(values[9]).tolist())
        return target(np.array(values[:3]) / 1000, np.array(values[3:6]) / 1000, yaw=yaw)
    if kind == 7:
        *pos, degrees = values
        return target(pos, yaw=math.radians(degrees))
    roll, pitch, yaw_rate, thrust, by_rate = values
    angles = np.deg2rad([roll, -pitch, 0])
    return target(thrust=thrust, yaw_rate=math.radians(yaw_rate), rpy=angles, by_rate=(by_rate, by_rate))


def decompress(number: int) -> np.ndarray:
    """Quaternion x, y, z, w in 32 bits: the index of the largest, and sign and 9 bits of each of the others."""
    largest, quat = number >> 30, np.zeros(4)
    for i in reversed(range(4)):
        if i != largest:
            magnitude = (number & 0x1FF) / 0x1FF / math.sqrt(2)
            quat[i] = -magnitude if number >> 9 & 1 else magnitude
            number >>= 10
    quat[largest] = math.sqrt(max(1 - float(quat @ quat), 0.0))
    return quat
