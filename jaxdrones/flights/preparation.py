"""Preparation of logs for identification: one drone each, at 100 Hz, with plausible units and consistent columns."""

import dataclasses
import os
from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxdrones.errors import UserError
from jaxdrones.flights.files import read_log
from jaxdrones.flights.log import OPTIONAL, PERIOD, STATE, FlightLog

_MAX_PERIOD = 0.012 + 1e-8  # s; larger steps do not resolve the motion of a small quadrotor
_MAX_GAP = 0.05  # s
_MAX_JITTER = 0.5e-3  # s, tolerance of times at 100 Hz without resampling
_MIN_ROWS = 100
_FULL_PWM = 65535
_PLAUSIBLE = (  # columns, lowest and highest number, what numbers beyond look like, and what to give
    (("omega",), -60.0, 60.0, "degrees/s", "rad/s"),  # gyroscopes of small quadrotors saturate at 35
    (("target_yaw",), -4 * np.pi, 4 * np.pi, "degrees", "rad"),
    (("vel", "target_vel"), -100.0, 100.0, "mm/s or cm/s", "m/s"),
    (("pos", "target_pos"), -1e4, 1e4, "mm", "m"),
    (("vbat",), -np.inf, 60.0, "millivolts", "V"),
    (("vbat",), 1.0, np.inf, "a voltage too low for motors", "V"),
    (("pwm",), 0.0, _FULL_PWM, "numbers beyond 16-bit duty cycles", "0 to 65535"),
    (("rpm",), 0.0, 1e6, "numbers beyond rotor speeds", "RPM"),
)
_MIN_MEDIAN_RPM = 2700.0  # lowest median speed of small quadrotors; 16,000 RPM are 1,700 rad/s
_MIN_PEAK_PWM = 0.1 * _FULL_PWM  # no quadrotor flies below a tenth of the duty cycle


def load_flights(*files: str | os.PathLike, allow_inconsistent: bool = False) -> list[FlightLog]:
    """Read logs for identification (see `read_log`): one for each drone, resampled to 100 Hz, with unique names.

    With `allow_inconsistent` the columns of a log may contradict each other, see `inconsistencies`.

    Raises:
        UserError: a log that cannot be read, without inputs, with implausible units, too low a rate, or
            contradictory columns.
    """
    return named_apart([drone for file in files for drone in prepare(read_log(file), allow_inconsistent)])


def prepare(log: FlightLog, allow_inconsistent: bool = False) -> list[FlightLog]:
    """Logs of the drones of a log, see `load_flights`."""
    drones = [log.drone(i) for i in range(len(log.labels))]
    if len(drones) > 1:
        drones = [dataclasses.replace(one, name=f"{log.name}, {one.labels[0]}") for one in drones]
    drones = [_resampled(_checked(one)) for one in drones]
    for one in () if allow_inconsistent else drones:
        if found := inconsistencies(one):
            raise UserError(
                f"{one.name}: {'; '.join(found)}; repair the log, or pass allow_inconsistent=True "
                "(--allow-inconsistent) to accept it"
            )
    return drones


def inconsistencies(log: FlightLog) -> list[str]:
    """Contradictions between columns of a prepared log, a sentence each with the likely cause."""
    from scipy.spatial.transform import Rotation  # loading it takes half a second

    from jaxdrones.flights.consistency import Motion, contradictions

    flying = np.flatnonzero(log.in_flight)
    if not len(flying):
        return []
    rows = slice(int(flying[0]), int(flying[-1]) + 1)
    pos, quat, vel, omega = (np.array(getattr(log, name)[rows, 0]) for name in STATE)  # SciPy needs writable arrays
    motion = Motion(pos, Rotation.from_quat(quat), vel, omega)
    thrusts = (log.rpm**2 if log.has("rpm") else log.pwm)[rows, 0]
    if log.conditions.as_dict():  # simulated here, with a known order of the motors
        thrusts = thrusts[:0]
    return contradictions(motion, thrusts, log.sag)


def named_apart(logs: Sequence[FlightLog]) -> list[FlightLog]:
    """Logs with unique names: equal names get the differing folders of their files, or a number."""
    given = [(log.file.resolve(), log.labels) for log in logs if log.file is not None]
    for twice in (one for one in given if given.count(one) > 1):
        raise UserError(f"{twice[0]} is given twice; give each flight once")
    names = [log.name for log in logs]
    named = []
    for i, log in enumerate(logs):
        name, file = log.name, log.file
        if names.count(name) > 1 and file is not None:
            others = [o.file.resolve().parts for o in logs if o.name == name and o.file not in (None, file)]
            parts = file.resolve().parts
            count = next(n for n in range(2, len(parts) + 1) if all(parts[-n:] != other[-n:] for other in others))
            name = "/".join((*parts[-count:-1], name))
        elif names.index(name) < i:
            name = f"{name} ({names[: i + 1].count(name)})"
        named.append(dataclasses.replace(log, name=name))
    return named


def _resampled(log: FlightLog) -> FlightLog:
    """Log resampled to 100 Hz; rows at 100 Hz are unchanged."""
    from scipy.spatial.transform import Rotation, Slerp

    times = log.t
    if np.max(np.abs(times - times[0] - PERIOD * np.arange(len(times)))) <= _MAX_JITTER:
        return log
    t = times[0] + PERIOD * np.arange(int((times[-1] - times[0]) / PERIOD + 1e-6) + 1)

    def interpolated(x: np.ndarray) -> np.ndarray:
        columns = [np.interp(t, times, column) for column in x.reshape(len(x), -1).T]
        return np.stack(columns, axis=-1).reshape(-1, *x.shape[1:])

    arrays: dict[str, Any] = {name: interpolated(getattr(log, name)) for name in STATE | OPTIONAL if log.has(name)}
    turn = Slerp(times, Rotation.from_quat(np.array(log.quat[:, 0])))
    arrays["quat"] = turn(np.minimum(t, times[-1])).as_quat()[:, None]  # the last time may be rounded
    if log.has("target_yaw"):
        arrays["target_yaw"] = interpolated(np.unwrap(log.target_yaw, axis=0))
    arrays |= {name: np.asarray(np.nan) for name in OPTIONAL if not log.has(name)}
    return dataclasses.replace(log, t=t, images={}, **arrays)


def _checked(log: FlightLog) -> FlightLog:
    """Validated log in float64, with unit quaternions and one kind of input."""
    inputs = ("rpm",) if log.has("rpm") else ("pwm", "vbat")
    for name in inputs:
        if not log.has(name):
            raise UserError(f"{log.name}: has no column {name!r} (or rpm); add it to the log")
    names = [name for name in ("t", *STATE, *OPTIONAL) if log.has(name)]
    arrays: dict[str, Any] = {name: np.array(getattr(log, name), float) for name in names}
    if log.has("rpm"):
        arrays["pwm"] = np.asarray(np.nan)
    for name, x in arrays.items():
        if x.ndim and not np.isfinite(x).all():
            row = int(np.argmin(np.isfinite(x.reshape(len(x), -1)).all(axis=1)))
            raise UserError(f"{log.name}: {name} is not finite in row {row}; remove or repair such rows")
        if x.ndim:
            _check_units(log.name, name, x)
    _check_times(log.name, arrays["t"])
    arrays["quat"] /= np.linalg.norm(arrays["quat"], axis=-1, keepdims=True)
    return dataclasses.replace(log, **arrays)


def _check_times(name: str, t: np.ndarray) -> None:
    if t[-1] - t[0] < (_MIN_ROWS - 1) * PERIOD - _MAX_JITTER:
        raise UserError(f"{name}: has {len(t)} rows, {t[-1] - t[0]:.2g} s; give at least one second of flight")
    steps = np.diff(t)
    if (period := np.median(steps)) > _MAX_PERIOD:
        raise UserError(f"{name}: rows are {period:.4g} s apart; record them at least every {_MAX_PERIOD:.3g} s")
    if np.max(steps) > _MAX_GAP:
        row = int(np.argmax(steps))
        raise UserError(f"{name}: no rows between {t[row]:g} and {t[row + 1]:g} s; cut the log there")


def _check_units(name: str, column: str, x: np.ndarray) -> None:
    """Raise for implausible values in the column's unit; the message names the likely unit."""

    def require(condition, looks: str, give: str) -> None:
        if not condition:
            low, high = np.min(x), np.max(x)
            raise UserError(f"{name}: {column} is {low:.4g} to {high:.4g}, which looks like {looks}; give {give}")

    for columns, low, high, looks, give in _PLAUSIBLE:
        if column in columns:
            require(low <= np.min(x) and np.max(x) <= high, looks, give)
    if column == "quat":
        length = np.linalg.norm(x, axis=-1)
        require(np.all(np.abs(length - 1) < 0.05), f"quaternions of length {length[0, 0]:.4g}, not 1", "x, y, z, w")
    elif column == "pwm":
        require(np.max(x) > _MIN_PEAK_PWM, "percent, 8 bits or microseconds", "0 to 65535")
    elif column == "rpm":
        require(np.median(x) >= _MIN_MEDIAN_RPM, "rad/s", "RPM, 60 / (2 pi) times as many")
