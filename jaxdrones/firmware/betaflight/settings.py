"""Settings and status of Betaflight by MSP: switches, rates, gain of yaw, direction of the motors, arming."""

import math
import struct
from typing import NamedTuple

from jaxdrones.control import rates
from jaxdrones.firmware.betaflight import msp
from jaxdrones.params import Params

MAX_RATE = 700
"""Rate at the end of a stick, degrees/s."""
IDLE = 0.055
"""Output of a motor at no throttle, a fraction of the largest; Betaflight's default."""
_ARM, _ANGLE = 0, 1  # permanent numbers of modes
_ACTUAL = 3  # kind of rates: center sensitivity and maximum, in 10 degrees/s
_RATE_LIMIT = 1998  # degrees/s
_QUAD_X = 3
_FAILSAFE_DELAY = 200  # 0.1 s
_GYRO_HZ, _MOST_DENOMINATOR = 8000, 16  # rate of the gyroscope; largest quotient of it and the rate of the loop
_FIRST_LOW_PASS, _LOW_PASS, _DYNAMIC = slice(0, 1), slice(20, 24), slice(29, 33)  # cutoffs for the gyroscope, Hz
_LOOPS = 2  # for each state; with one, the states and Betaflight's clock, which has their pace, wait for each other
_STICKS, _HOLD = 4, 1  # channels that keep their values if the receiver seems lost, for example as the clock jumped
_YAW_P = 6  # place of its proportional gain
_P_SCALE = 3.2029e-5  # share of a motor's range per degree/s and unit of the gain
_LARGEST_P = 100  # more adds thrust: it changes two outputs up, two down, and thrust grows with their square
_SWITCH_ON = (1700, 2100)  # us
_STATUS = struct.Struct("<HHHIBHBB")
FLAGS = (
    "no gyro, failsafe, no receiver, not disarmed, failsafe switch, runaway takeoff, crash, throttle, angle, boot, "
    "no prearm, load, calibrating, command line, menu, bus, MSP, paralyze, GPS, rescue, no telemetry, reboot required, "
    "bitbang, accelerometer, motor protocol, crash flip, altitude hold, position hold, arm switch"
).split(", ")
"""Reasons against arming, in Betaflight's order."""


class Status(NamedTuple):
    """Status of the flight controller."""

    armed: bool
    """Whether the motors may turn."""
    cycle: int
    """Time between its last loops, us."""
    reasons: tuple[str, ...]
    """Reasons against arming, of `FLAGS`."""


def configure(client: msp.Client, params: Params, hz: float, reversed_yaw: bool = False) -> bool:
    """Configure switches (AUX1 arms, AUX2 selects angle mode), linear rates, failsafe, yaw gain and motor direction.

    The rate of the control loop becomes twice that of the states. The low-pass filters of the gyroscope are off,
    because it has no noise, and because filters and derivatives become slower when a busy computer runs the loop less
    often. All settings are saved in `eeprom.bin` in the folder of the process.

    Args:
        client: connection.
        params: of the drone, for the yaw gain.
        hz: states per second.
        reversed_yaw: whether the motors turn in the opposite of Betaflight's default direction.

    Raises:
        msp.NoAnswer: no answer, or rejected settings.

    Returns:
        Whether Betaflight must be restarted for its loop rate and filters.
    """
    for slot, mode in enumerate((_ARM, _ANGLE)):
        client.request(msp.SET_MODE_RANGE, mode_range(slot, mode, slot))
    tuning = rc_tuning()
    client.request(msp.SET_RC_TUNING, tuning)
    gains = bytearray(client.request(msp.PID))
    gains[_YAW_P] = yaw_gain(params)
    client.request(msp.SET_PID, bytes(gains))
    client.request(msp.SET_MIXER, bytes([_QUAD_X, reversed_yaw]))
    failsafe = client.request(msp.FAILSAFE)  # whose clock jumps if this computer is busy
    client.request(msp.SET_FAILSAFE, bytes([_FAILSAFE_DELAY]) + failsafe[1:])
    for channel in range(_STICKS):
        client.request(msp.SET_RX_FAIL, struct.pack("<BBH", channel, _HOLD, 1500))
    slower = _with_loop(client, hz)
    client.request(msp.EEPROM_WRITE)
    if client.request(msp.RC_TUNING)[: len(tuning)] != tuning or client.request(msp.PID) != gains:
        raise msp.NoAnswer("Betaflight did not accept the rates and gains; use version 4.6")
    return slower


def yaw_gain(params: Params) -> int:
    """Proportional gain about the yaw axis with which a hovering drone responds as fast as with the controller `rates`.

    Betaflight's default, 45, suits propellers of larger torque; with those of the racer, the integral term oscillates.
    """
    per_output = 8 * float(params.km * params.hover_rpm * params.max_rpm / params.inertia[2]) * (1 - IDLE)  # rad/s^2
    wanted = float(rates.gains().rate[2]) / (_P_SCALE * math.degrees(1) * per_output)
    return min(max(round(wanted), 1), _LARGEST_P)


def _with_loop(client: msp.Client, hz: float) -> bool:
    """Set the rate of the control loop and switch filters off; return whether this is a change."""
    old = client.request(msp.ADVANCED), client.request(msp.FILTERS)
    advanced, filters = map(bytearray, old)
    if len(advanced) < 2 or len(filters) < _DYNAMIC.stop:
        raise msp.NoAnswer("Betaflight's settings are shorter than those of version 4.6; use this version")
    advanced[1] = min(max(round(_GYRO_HZ / (_LOOPS * hz)), 1), _MOST_DENOMINATOR)
    for place in (_FIRST_LOW_PASS, _LOW_PASS, _DYNAMIC):
        filters[place] = bytes(place.stop - place.start)
    client.request(msp.SET_ADVANCED, bytes(advanced))
    client.request(msp.SET_FILTERS, bytes(filters))
    return (advanced, filters) != tuple(map(bytearray, old))


def mode_range(slot: int, mode: int, auxiliary: int) -> bytes:
    """Payload of rule `slot`: a mode (permanent number) is activated by an auxiliary channel, 0 for AUX1."""
    return bytes([slot, mode, auxiliary, *((pulse - 900) // 25 for pulse in _SWITCH_ON)])


def rc_tuning() -> bytes:
    """Payload of linear rates up to `MAX_RATE` and of a linear throttle."""
    rate = MAX_RATE // 10
    limits = struct.pack("<3H", *[_RATE_LIMIT] * 3)
    throttle = bytes([0, 50, 0, 0, 0])  # no attenuation, middle, no expo, no breakpoint
    return bytes([rate, 0, rate, rate, rate]) + throttle + bytes([0, rate, rate, 0, 0, 100]) + limits + bytes([_ACTUAL])


def parse_status(data: bytes) -> Status:
    """Status in an answer."""
    try:
        cycle, _, _, modes, *_ = _STATUS.unpack_from(data)
        more = data[_STATUS.size] & 0x0F  # bytes of further modes
        _, flags = struct.unpack_from("<BI", data, _STATUS.size + 1 + more)
    except (struct.error, IndexError):
        raise msp.NoAnswer(f"Betaflight's status has {len(data)} bytes, unlike in version 4.6; use 4.6") from None
    reasons = tuple(name for bit, name in enumerate(FLAGS) if flags >> bit & 1)
    return Status(bool(modes & 1), cycle, reasons)
