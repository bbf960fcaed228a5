"""Parameters of the vehicle: those with an effect on the simulation, and those that scripts request."""

import struct
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from jaxdrones.control.firmware_loops import Gains
from jaxdrones.firmware.crazyflie.packet import ENOENT, MAX_DATA
from jaxdrones.firmware.crazyflie.toc import TYPES, Toc, Type

_TABLE, _READ, _WRITE, _MISC = range(4)
_SET_BY_NAME, _EXTENDED_TYPE, _DEFAULT = 0, (2, 7), (6, 8)
_PERSISTENT = (3, 4, 5)
_READ_ONLY = 0x40
_DECKS = ("bcFlow2", "bcZRanger2", "bcMultiranger", "bcLighthouse4", "bcLoco", "bcDWM1000", "bcAI", "bcLedRing")
_FITTED = ("bcFlow2", "bcZRanger2")  # the state is known, as if these measured it

GAINS = {
    f"{group}.{axis}{end}": (field, i)
    for group, axes, ends in (
        ("pid_attitude", ("roll", "pitch", "yaw"), {"_kp": "attitude_p", "_ki": "attitude_i", "_kd": "attitude_d"}),
        ("pid_rate", ("roll", "pitch", "yaw"), {"_kp": "rate_p", "_ki": "rate_i", "_kd": "rate_d"}),
        ("posCtlPid", "xyz", {"Kp": "pos_p", "Ki": "pos_i", "VelMax": "max_vel"}),
        ("velCtlPid", ("vx", "vy", "vz"), {"Kp": "vel_p", "Ki": "vel_i"}),
    )
    for end, field in ends.items()
    for i, axis in enumerate(axes)
}
"""Parameter of a gain -> field of `Gains` and axis."""
_THRUSTS = {"posCtlPid.thrustBase": ("base_thrust", ()), "posCtlPid.thrustMin": ("min_thrust", ())}
_FIELDS: dict[str, tuple[str, Any]] = GAINS | _THRUSTS


class Parameter(NamedTuple):
    """Parameter and its initial value."""

    kind: Type
    default: float
    read_only: bool = False


def _parameters(gains: Gains) -> dict[str, Parameter]:
    u8 = TYPES["uint8_t"]
    found = {name: Parameter(TYPES["float"], _gain(gains, name)) for name in GAINS}
    found |= {name: Parameter(TYPES["uint16_t"], round(_gain(gains, name))) for name in _THRUSTS}
    found |= {f"deck.{deck}": Parameter(u8, float(deck in _FITTED), True) for deck in _DECKS}
    settings = {
        "commander.enHighLevel": 1,
        "flightmode.stabModeRoll": 1,
        "flightmode.stabModePitch": 1,
        "flightmode.stabModeYaw": 0,
        "kalman.resetEstimation": 0,
        "stabilizer.controller": 1,
        "stabilizer.estimator": 2,
        "stabilizer.stop": 0,
        "ring.effect": 0,
        "led.bitmask": 0,
        "sound.effect": 0,
    }
    found |= {name: Parameter(u8, value) for name, value in settings.items()}
    found |= {f"hlCommander.{name}": Parameter(TYPES["float"], 0.5) for name in ("vtoff", "vland")}
    found |= {f"kalman.initial{name}": Parameter(TYPES["float"], 0) for name in ("X", "Y", "Z", "Yaw")}
    found |= {f"firmware.revision{i}": Parameter(TYPES["uint32_t"], 0, True) for i in (0, 1)}
    return dict(sorted(found.items()))


def _gain(gains: Gains, name: str) -> float:
    field, i = _FIELDS[name]
    return float(np.asarray(getattr(gains, field))[i])


class Parameters:
    """Parameters and their values, by the names `group.name` of the firmware."""

    def __init__(self, gains: Gains, changed: Callable[[Gains], None] = lambda gains: None):
        """Start with default values, those of the gains included; `changed` is called with new gains."""
        self._gains, self._changed = gains, changed
        self._entries = _parameters(gains)
        self.values = {name: entry.default for name, entry in self._entries.items()}
        self.toc = Toc({name: e.kind.parameter | _READ_ONLY * e.read_only for name, e in self._entries.items()})

    def __getitem__(self, name: str) -> float:
        return self.values[name]

    def answer(self, channel: int, data: bytes) -> bytes:
        """Answer to a packet; empty for an invalid one."""
        if channel == _TABLE:
            return self.toc.answer(data)
        if channel == _MISC:
            return self._answer_misc(data)
        if len(data) < 2:
            return b""
        number = data[:2]
        name = self._name(number)
        if name is None:
            return number + bytes([ENOENT])
        kind = self._entries[name].kind
        if channel == _WRITE:
            self._write(name, data[2:])
            return number + kind.pack(self[name])
        return number + b"\0" + kind.pack(self[name])

    def _name(self, number: bytes) -> str | None:
        index = struct.unpack("<H", number)[0]
        return self.toc.names[index] if index < len(self.toc.names) else None

    def _write(self, name: str, data: bytes) -> int:
        """Set a parameter; the error number. Read-only ones, other sizes and NaN change nothing."""
        entry = self._entries[name]
        if entry.read_only or len(data) != entry.kind.size:
            return ENOENT
        value = entry.kind.unpack(data)
        if not np.isfinite(value):
            return ENOENT
        self.values[name] = value
        if name in _FIELDS:
            field, i = _FIELDS[name]
            new = np.array(getattr(self._gains, field))
            new[i] = value
            self._gains = self._gains.replace(**{field: new})
            self._changed(self._gains)
        return 0

    def _answer_misc(self, data: bytes) -> bytes:
        if data[:1] == bytes([_SET_BY_NAME]):
            group, _, rest = data[1:].partition(b"\0")
            short, _, typed = rest.partition(b"\0")
            given = f"{group.decode('latin-1')}.{short.decode('latin-1')}"
            known = given in self._entries and typed[:1] == bytes([self._entries[given].kind.parameter])
            error = self._write(given, typed[1:]) if known else ENOENT
            return data[: len(data) - len(typed)][: MAX_DATA - 1] + bytes([error])
        if len(data) < 3 or data[0] not in (*_EXTENDED_TYPE, *_DEFAULT, *_PERSISTENT):
            return b""
        name = self._name(data[1:3])
        if data[0] in _DEFAULT and name is not None:
            entry, status = self._entries[name], b"\0" if data[0] == _DEFAULT[1] else b""
            return data[:3] + status + entry.kind.pack(entry.default)
        return data[:3] + bytes([ENOENT])  # nothing is stored, and no parameter has an extended type
