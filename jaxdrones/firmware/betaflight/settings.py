"""Settings and status of Betaflight by MSP: switches, rates, direction of the motors, arming."""

from __future__ import annotations

import struct
from typing import NamedTuple

from jaxdrones.firmware.betaflight import msp

MAX_RATE = 700
"""Rate at the end of a stick, degrees/s."""
_ARM, _ANGLE = 0, 1  # permanent numbers of modes
_ACTUAL = 3  # kind of rates: center sensitivity and maximum, in 10 degrees/s
_RATE_LIMIT = 1998  # degrees/s
_QUAD_X = 3
_FAILSAFE_DELAY = 200  # 0.1 s
_STICKS, _HOLD = 4, 1  # channels that keep their values if the receiver seems lost, for example as the clock jumped
_SWITCH_ON = (1700, 2100)  # us
_STATUS = struct.Struct("<HHHIBHBB")
FLAGS = (
    "no gyro",
    "failsafe",
    "no receiver",
    "not disarmed",
    "failsafe switch",
    "runaway takeoff",
    "crash",
    "throttle",
    "angle",
    "boot",
    "no prearm",
    "load",
    "calibrating",
    "command line",
    "menu",
    "bus",
    "MSP",
    "paralyze",
    "GPS",
    "rescue",
    "no telemetry",
    "reboot required",
    "bitbang",
    "accelerometer",
    "motor protocol",
    "crash flip",
    "altitude hold",
    "position hold",
    "arm switch",
)
"""Reasons against arming, in Betaflight's order."""


class Status(NamedTuple):
    """Status of the flight controller."""

    armed: bool
    """Whether the motors may turn."""
    cycle: int
    """Time between its last loops, us."""
    reasons: tuple[str, ...]
    """Reasons against arming, of `FLAGS`."""


def configure(client: msp.Client, max_rate: int = MAX_RATE, reversed_yaw: bool = False) -> None:
    """Set AUX1 to arm, AUX2 to level (else acro), linear rates, a long failsafe and the direction of the motors.

    They are saved in `eeprom.bin` in the folder of the process, which activates them.

    Args:
        client: connection.
        max_rate: rate at the end of a stick about all axes, degrees/s.
        reversed_yaw: whether the motors turn in the opposite of Betaflight's default direction.

    Raises:
        msp.NoAnswer: no answer, or settings that were not taken.
    """
    for slot, mode in enumerate((_ARM, _ANGLE)):
        client.request(msp.SET_MODE_RANGE, mode_range(slot, mode, slot))
    rates = rc_tuning(max_rate)
    client.request(msp.SET_RC_TUNING, rates)
    client.request(msp.SET_MIXER, bytes([_QUAD_X, reversed_yaw]))
    failsafe = client.request(msp.FAILSAFE)  # whose clock jumps if this computer is busy
    client.request(msp.SET_FAILSAFE, bytes([_FAILSAFE_DELAY]) + failsafe[1:])
    for channel in range(_STICKS):
        client.request(msp.SET_RX_FAIL, struct.pack("<BBH", channel, _HOLD, 1500))
    client.request(msp.EEPROM_WRITE)
    if client.request(msp.RC_TUNING)[: len(rates)] != rates:
        raise msp.NoAnswer("Betaflight did not take the rates; it is another version than 4.6")


def mode_range(slot: int, mode: int, auxiliary: int) -> bytes:
    """Payload that activates a mode by a switch.

    Args:
        slot: number of the rule.
        mode: permanent number of the mode.
        auxiliary: channel, 0 for AUX1.
    """
    return bytes([slot, mode, auxiliary, *((pulse - 900) // 25 for pulse in _SWITCH_ON)])


def rc_tuning(max_rate: int) -> bytes:
    """Payload of linear rates (degrees/s at the end of a stick) and of a linear throttle."""
    rate = max_rate // 10
    limits = struct.pack("<3H", *[_RATE_LIMIT] * 3)
    throttle = bytes([0, 50, 0, 0, 0])  # no attenuation, middle, no expo, no breakpoint
    return bytes([rate, 0, rate, rate, rate]) + throttle + bytes([0, rate, rate, 0, 0, 100]) + limits + bytes([_ACTUAL])


def status(client: msp.Client) -> Status:
    """Status of the flight controller.

    Raises:
        msp.NoAnswer: no answer, or one of another version.
    """
    return parse_status(client.request(msp.STATUS))


def parse_status(data: bytes) -> Status:
    """Status in an answer.

    Raises:
        msp.NoAnswer: an answer that is too short.
    """
    try:
        cycle, _, _, modes, *_ = _STATUS.unpack_from(data)
        more = data[_STATUS.size] & 0x0F  # bytes of further modes
        _, flags = struct.unpack_from("<BI", data, _STATUS.size + 1 + more)
    except (struct.error, IndexError):
        raise msp.NoAnswer(f"Betaflight's status has {len(data)} bytes; it is another version than 4.6") from None
    reasons = tuple(name for bit, name in enumerate(FLAGS) if flags >> bit & 1)
    return Status(bool(modes & 1), cycle, reasons)
