"""High-level commander: take-off, landing, positions and trajectories, flown by set-points of its own."""

import dataclasses
import math
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np

from jaxdrones.firmware.crazyflie.packet import ENOENT, ENOEXEC
from jaxdrones.firmware.crazyflie.planner import Goal, Trajectory, go_to, unpack
from jaxdrones.firmware.crazyflie.vehicle import Target, motors_off, target

MEMORY_BYTES = 4096
"""Size of the memory of trajectories."""
_ALL_GROUPS = 0
_IN_MEMORY, _POLYNOMIALS = 1, 0
_LEAST_DURATION, _MOST_DURATION = 0.01, 1e6  # s

_FORMATS: dict[int, tuple[str, str, dict[int, float]]] = {  # command -> name, format, and places of missing values
    0: ("set_group_mask", "B", {}),
    1: ("takeoff", "Bff", {2: 0.0, 3: False}),
    2: ("land", "Bff", {2: 0.0, 3: False}),
    3: ("stop", "B", {}),
    4: ("go_to", "B?fffff", {2: False}),
    5: ("start_trajectory", "B??Bf", {2: False}),
    6: ("define_trajectory", "BBBIB", {}),
    7: ("takeoff", "Bff?f", {}),
    8: ("land", "Bff?f", {}),
    9: ("takeoff_with_velocity", "Bf?f?f", {}),
    10: ("land_with_velocity", "Bf?f?f", {}),
    12: ("go_to", "B??fffff", {}),
    13: ("start_trajectory", "B???Bf", {}),
}


@dataclasses.dataclass
class HighLevel:
    """Planner of trajectories."""

    parameters: Mapping[str, float]
    """Values of the parameters of the vehicle."""
    memory: bytearray = dataclasses.field(default_factory=lambda: bytearray(MEMORY_BYTES))
    """Memory of trajectories."""
    trajectory: Trajectory | None = None
    """Trajectory in flight or finished, whose last point is held; `None` with motors off."""
    _landing: bool = False
    _group: int = 0
    _defined: dict[int, tuple[int, int]] = dataclasses.field(default_factory=dict)

    def command(self, data: bytes, t: float, now: Goal) -> bytes:
        """Execute the payload of a packet at time t (s), from the vehicle at rest; the answer has its error number."""
        name, form, missing = _FORMATS.get(data[0] if data else -1, ("", "", {}))
        if not name or len(data) != 1 + struct.calcsize("<" + form):
            return data[:3].ljust(3, b"\0") + bytes([ENOEXEC])
        values: list[Any] = list(struct.unpack("<" + form, data[1:]))
        for place, value in missing.items():
            values.insert(place, value)
        error, own = 0, name in ("define_trajectory", "set_group_mask")  # all others are for a group
        if not all(math.isfinite(x) for x in values):
            error = ENOEXEC
        elif own or values[0] == _ALL_GROUPS or values[0] & self._group:
            start = now if self.trajectory is None else self.trajectory.at(t)
            error = self._execute(name, t, start, *(values if own else values[1:]))
        return data[:3].ljust(3, b"\0") + bytes([error])

    def off(self) -> None:
        """Drop the trajectory."""
        self.trajectory, self._landing = None, False

    def target(self, t: float) -> Target:
        """Set-point at time t (s); motors are off without a trajectory and after a landing."""
        if self.trajectory is not None and self._landing and self.trajectory.finished(t):
            self.off()
        if self.trajectory is None:
            return motors_off()
        goal = self.trajectory.at(t)
        return target(goal.pos, goal.vel, yaw=goal.yaw)

    def finished(self, t: float) -> bool:
        """Whether no trajectory is in flight at time t (s)."""
        return self.trajectory is None or self.trajectory.finished(t)

    def _execute(self, name: str, t: float, start: Goal, *values: Any) -> int:
        """Execute a command at time t (s), from a point of the flight; the error number."""
        match name, *values:
            case "set_group_mask", mask:
                self._group = mask
            case "define_trajectory", number, place, kind, offset, pieces:
                if place != _IN_MEMORY or kind != _POLYNOMIALS:
                    return ENOEXEC
                self._defined[number] = offset, pieces
            case "start_trajectory", *_:
                return self._start_trajectory(t, start, *values)
            case "stop", *_:
                self.off()
            case "go_to", relative, linear, *pos, yaw, duration:
                origin, turn = (start.pos, start.yaw) if relative else (0, 0)
                self._fly(t, start, np.array(pos) + origin, yaw + turn, duration, linear)
            case "takeoff" | "land", height, yaw, keep_yaw, duration:
                self._fly(t, start, np.append(start.pos[:2], height), start.yaw if keep_yaw else yaw, duration)
                self._landing = name == "land"
            case _, height, relative, yaw, keep_yaw, velocity:  # takeoff_with_velocity, land_with_velocity
                name = name.removesuffix("_with_velocity")
                height = start.pos[2] + (height if name == "takeoff" else -height) if relative else height
                way = abs(height - start.pos[2])
                if velocity <= 0:  # the default, as in the firmware
                    velocity = self.parameters["hlCommander.vtoff" if name == "takeoff" else "hlCommander.vland"]
                return self._execute(name, t, start, height, yaw, keep_yaw, way / velocity if velocity > 0 else 0.0)
        return 0

    def _fly(self, t: float, start: Goal, pos: Any, yaw: float, duration: float, linear: bool = False) -> None:
        self._landing = False
        duration = min(max(duration, _LEAST_DURATION), _MOST_DURATION)
        self.trajectory = go_to(start, pos, yaw, duration, t, linear)

    def _start_trajectory(
        self, t: float, start: Goal, relative: bool, relative_yaw: bool, backwards: bool, number: int, scale: float
    ) -> int:
        if number not in self._defined or scale <= 0:
            return ENOENT
        pieces = unpack(bytes(self.memory), *self._defined[number])
        if pieces is None:
            return ENOENT
        plain = Trajectory(pieces, t, scale, backwards)
        turn = start.yaw - plain.at(t).yaw if relative_yaw else 0.0
        turned = dataclasses.replace(plain, turn=turn)
        shift = start.pos - turned.at(t).pos if relative else np.zeros(3)
        self.trajectory, self._landing = dataclasses.replace(turned, shift=shift), False
        return 0
