"""Sticks of a joystick or of a transmitter on USB, by the joystick interface of Linux."""

import contextlib
import os
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jaxdrones.errors import UserError
from jaxdrones.firmware.betaflight.packets import Sticks
from jaxdrones.firmware.drone import Sample

_EVENT = struct.Struct("<IhBB")  # time in ms, value, kind, number
_AXIS = 2
_INITIAL = 0x80  # bit of the kind of events that tell the first positions
_FULL = 32767
AXES = (0, 1, 2, 3)
"""Numbers of the axes for roll, pitch, throttle and yaw, in the order of RC transmitters."""


class Joystick(contextlib.AbstractContextManager["Joystick"]):
    """Pilot with the stick positions of a joystick; its switches are not used."""

    def __init__(self, device: Path, axes: Sequence[int] = AXES):
        """Open a joystick, such as /dev/input/js0.

        `axes` are the numbers of those for roll (right), pitch (forward), throttle (up) and yaw (right); -1, -2, ...
        are the axes 0, 1, ... reversed.
        """
        try:
            self._file = os.open(device, os.O_RDONLY | os.O_NONBLOCK)
        except OSError as error:
            raise UserError(
                f"the joystick {device} cannot be opened: {error.strerror}; see ls /dev/input/js*"
            ) from None
        self._axes = tuple(axes)
        self._at: dict[int, float] = {}
        self._rest = b""

    def __exit__(self, *_: Any) -> None:
        os.close(self._file)

    def __call__(self, t: float, sample: Sample) -> Sticks:
        """Positions of the sticks; the time and the sample are not used."""
        self._read()
        roll, pitch, throttle, yaw = (self._axis(number) for number in self._axes)
        return Sticks(roll, pitch, (throttle + 1) / 2, yaw)

    def _axis(self, number: int) -> float:
        """Position from -1 to 1; the lowest or center without an event: throttle must not start at half."""
        start = -1.0 if number == self._axes[2] else 0.0
        return self._at.get(number, start) if number >= 0 else -self._at.get(-1 - number, -start)

    def _read(self) -> None:
        try:
            self._rest += os.read(self._file, 4096)
        except OSError:  # nothing new, or the joystick was unplugged: the sticks stay
            return
        whole = len(self._rest) - len(self._rest) % _EVENT.size
        for _, value, kind, number in _EVENT.iter_unpack(self._rest[:whole]):
            if kind & ~_INITIAL == _AXIS:
                self._at[number] = max(value / _FULL, -1.0)
        self._rest = self._rest[whole:]
