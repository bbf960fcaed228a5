"""Flight logs: recorded flights as arrays, checked when they are loaded."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from jaxdrones import assets
from jaxdrones.checks import shown
from jaxdrones.errors import UserError
from jaxdrones.identification import quaternions
from jaxdrones.identification.consistency import Columns, contradictions
from jaxdrones.npz import read_arrays

PERIOD = 0.01  # s, time between the rows of a log
_PERIOD_TOLERANCE = 0.2  # largest relative error of the median time between rows
_MAX_GAP = 0.05  # s
_MAX_JITTER = 0.5e-3  # s, by which the times of rows that are not resampled differ from 100 Hz
_MIN_ROWS = 100
_FULL_PWM = 65535
_TAKE_OFF = slice(150, 350)  # rows after the motors start, over which the voltage at take-off is averaged
_MAX_RATE = 60.0  # rad/s; gyroscopes of small quadrotors saturate at 35
_MIN_VOLTAGE, _MAX_VOLTAGE = 1.0, 60.0  # V
_MAX_RPM = 1e6
_MIN_MEDIAN_RPM = 2700.0  # small quadrotors do not fly at a lower median speed; 16,000 RPM are 1,700 rad/s
_MAX_PERCENT = 100.0  # PWM that never exceeds this is a percentage; a motor with more than this runs

_COLUMNS = {  # name: (numbers per row, meaning and unit)
    "t": (1, "time, s"),
    "pos": (3, "position, m, world"),
    "quat": (4, "attitude, quaternion x, y, z, w, body to world"),
    "vel": (3, "velocity, m/s, world"),
    "omega": (3, "angular velocity, rad/s, body"),
    "rpm": (4, "rotor speeds, RPM"),
    "pwm": (4, "duty cycles of the motors, 0 to 65535"),
    "vbat": (1, "voltage of the battery, V"),
    "ref_pos": (3, "set-points of the position, m, world"),
    "ref_yaw": (1, "set-points of the heading, rad"),
}


@dataclasses.dataclass(frozen=True)
class FlightLog:
    """A recorded flight of one drone: T rows at 100 Hz.

    A log has either the rotor speeds, or the PWM of the motors and the voltage of the battery.
    """

    name: str
    t: np.ndarray
    """(T,) time, s."""
    pos: np.ndarray
    """(T, 3) position, m, world."""
    quat: np.ndarray
    """(T, 4) attitude, unit quaternions (x, y, z, w), body to world."""
    vel: np.ndarray
    """(T, 3) velocity, m/s, world."""
    omega: np.ndarray
    """(T, 3) angular velocity, rad/s, body."""
    rpm: np.ndarray | None = None
    """(T, 4) rotor speeds, RPM; motors front right, back right, back left, front left."""
    pwm: np.ndarray | None = None
    """(T, 4) duty cycles of the motors, 0 to 65535."""
    vbat: np.ndarray | None = None
    """(T,) voltage of the battery, V."""
    ref_pos: np.ndarray | None = None
    """(T, 3) set-points of the position, m, world."""
    ref_yaw: np.ndarray | None = None
    """(T,) set-points of the heading, rad."""
    file: Path | None = None
    """The file of the log."""

    @classmethod
    def load(cls, file: str | os.PathLike, allow_inconsistent: bool = False) -> FlightLog:
        """Read a log from an .npz file, or a bundled one by its name (`jaxdrones.assets.flights`).

        Columns are `t`, `pos`, `quat`, `vel`, `omega` (or `gyro`), and either `rpm` or `pwm` with `vbat`; a flight on
        set-points has `ref_pos` and `ref_yaw`. Other columns are ignored. Rows 8 to 12 ms apart are resampled to 100
        Hz by their times: linearly, attitudes at a constant rate.

        Args:
            file: the file, or the name of a bundled log.
            allow_inconsistent: whether to load a log whose columns contradict each other, see `inconsistencies()`.

        Raises:
            ValueError: the file is not a log, lacks a column, or has invalid data: NaN, times that run backwards, a
                rate far from 100 Hz, other units, too few rows; or its columns contradict each other.
        """
        path = assets.flights().get(os.fspath(file), Path(file))
        columns = read_arrays(path, (*_COLUMNS, "gyro"))
        if "omega" not in columns and "gyro" in columns:
            columns["omega"] = columns["gyro"]
        columns.pop("gyro", None)
        log = cls(path.name, **_resampled(_checked(path.name, columns)), file=path)
        found = [] if allow_inconsistent else log.inconsistencies()
        if found:
            raise UserError(
                f"{path.name}: {'; '.join(found)}; repair the log, or pass allow_inconsistent=True "
                "(--allow-inconsistent) to take it as it is"
            )
        return log

    def inconsistencies(self) -> list[str]:
        """Contradictions between the columns, a sentence each with the likely cause; none for a sound log."""
        flying = np.flatnonzero(self.in_flight)
        rows = slice(int(flying[0]), int(flying[-1]) + 1) if len(flying) else slice(0)
        motion = Columns(self.pos[rows], self.quat[rows], self.vel[rows], self.omega[rows])
        thrusts = self.rpm**2 if self.rpm is not None else self.pwm if self.pwm is not None else np.zeros((0, 4))
        return contradictions(motion, thrusts[rows], self.sag)

    @property
    def has_rotor_speeds(self) -> bool:
        """Whether the rotor speeds were measured."""
        return self.rpm is not None

    @property
    def has_setpoints(self) -> bool:
        """Whether the flight can be simulated in closed loop: the log has set-points and PWM."""
        return self.ref_pos is not None and self.pwm is not None

    @property
    def closed_loop_columns(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """The columns `ref_pos`, `ref_yaw`, `pwm` and `vbat`, which closed-loop simulation needs.

        Raises:
            ValueError: the log lacks one of them.
        """
        if self.ref_pos is None or self.ref_yaw is None or self.pwm is None or self.vbat is None:
            raise UserError(f"{self.name}: has no set-points; add ref_pos, ref_yaw, pwm and vbat for a closed loop")
        return self.ref_pos, self.ref_yaw, self.pwm, self.vbat

    @property
    def in_flight(self) -> np.ndarray:
        """(T,) whether all motors run; true in all rows of a log without PWM."""
        return np.ones(len(self.t), bool) if self.pwm is None else np.min(self.pwm, axis=1) > _MAX_PERCENT

    @property
    def sag(self) -> float:
        """Drop of the battery voltage from rest to take-off, V; 0 for a log that begins in flight.

        The voltage at rest is the highest one before the motors start, that at take-off the mean from 1.5 to 3.5 s
        after they start.
        """
        begin = int(np.argmax(self.in_flight))
        if self.vbat is None or begin == 0:
            return 0.0
        return float(np.max(self.vbat[:begin]) - np.mean(self.vbat[begin:][_TAKE_OFF]))


def named_apart(logs: Sequence[FlightLog]) -> list[FlightLog]:
    """The logs with different names: those of equal names get as many folders of their files as tell them apart.

    Raises:
        ValueError: a file is given twice.
    """
    files = [log.file.resolve() for log in logs if log.file is not None]
    for file in files:
        if files.count(file) > 1:
            raise UserError(f"{file} is given twice; give each flight once")
    names = [log.name for log in logs]
    named = []
    for i, log in enumerate(logs):
        name = log.name
        if names.count(name) > 1 and log.file is not None:
            others = [
                other.file.resolve() for other in logs if other.name == name and other.file not in (None, log.file)
            ]
            parts = log.file.resolve().parts
            count = next(n for n in range(2, len(parts) + 1) if all(parts[-n:] != o.parts[-n:] for o in others))
            name = "/".join(parts[-count:])
        elif names.index(name) < i:
            name = f"{name} ({names[: i + 1].count(name)})"
        named.append(dataclasses.replace(log, name=name))
    return named


def _resampled(columns: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The columns at 100 Hz by their times; rows that are at 100 Hz already stay as they are."""
    times = columns["t"]
    even = times[0] + PERIOD * np.arange(len(times))
    if np.max(np.abs(times - even)) <= _MAX_JITTER:
        return columns
    t = times[0] + PERIOD * np.arange(int((times[-1] - times[0]) / PERIOD + 1e-6) + 1)
    resampled = {"t": t}
    for name, x in columns.items():
        if name == "quat":
            resampled[name] = quaternions.slerp(t, times, x)
        elif name == "ref_yaw":
            resampled[name] = np.interp(t, times, np.unwrap(x))
        elif name != "t":
            resampled[name] = (
                np.stack([np.interp(t, times, c) for c in x.T], axis=-1) if x.ndim > 1 else np.interp(t, times, x)
            )
    return resampled


def _checked(name: str, columns: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The columns of a log as float64, with unit quaternions; raises `ValueError` on invalid ones."""
    if "rpm" in columns:
        columns.pop("pwm", None)
    inputs = ("rpm",) if "rpm" in columns else ("pwm", "vbat")
    for column in ("t", "pos", "quat", "vel", "omega", *inputs):
        if column not in columns:
            others = " (or rpm)" if column in ("pwm", "vbat") else " (or gyro)" if column == "omega" else ""
            raise UserError(f"{name}: has no column {column!r}{others}: {_COLUMNS[column][1]}; add it to the log")
    rows = np.size(columns["t"])
    for column, array in columns.items():
        count, meaning = _COLUMNS[column]
        shape = (rows,) if count == 1 else (rows, count)
        if array.shape != shape or array.dtype.kind not in "fiu":
            raise UserError(
                f"{name}: {column} is {array.dtype} of shape {array.shape}; give numbers of shape {shape}: {meaning}"
            )
        columns[column] = array.astype(float)
        if not np.isfinite(columns[column]).all():
            row = int(np.argmin(np.isfinite(columns[column].reshape(rows, -1)).all(axis=1)))
            raise UserError(f"{name}: {column} is not finite in row {row}; remove or repair such rows")
    _check_times(name, columns["t"])
    for column in columns:
        _check_units(name, column, columns[column])
    if {"ref_pos"} & columns.keys() and "ref_yaw" not in columns:
        columns["ref_yaw"] = np.zeros(rows)
    columns["quat"] /= np.linalg.norm(columns["quat"], axis=1, keepdims=True)
    return columns


def _check_times(name: str, t: np.ndarray) -> None:
    if len(t) < _MIN_ROWS:
        raise UserError(f"{name}: has {len(t)} rows; give at least {_MIN_ROWS}, one second of flight")
    steps = np.diff(t)
    if not (steps > 0).all():
        row = int(np.argmin(steps > 0)) + 1
        raise UserError(f"{name}: time goes from {t[row - 1]:g} to {t[row]:g} s in row {row}; sort the rows by time")
    period = np.median(steps)
    if abs(period - PERIOD) > (_PERIOD_TOLERANCE + 1e-6) * PERIOD:
        raise UserError(f"{name}: rows are {period:.4g} s apart; resample the log to {PERIOD:g} s")
    if np.max(steps) > _MAX_GAP:
        row = int(np.argmax(steps))
        raise UserError(f"{name}: no rows between {t[row]:g} and {t[row + 1]:g} s; cut the log there")


def _check_units(name: str, column: str, x: np.ndarray) -> None:
    """Raise on values that are implausible in the column's unit; the message names the likely unit."""

    def require(condition, looks: str, give: str) -> None:
        if not condition:
            low, high = np.min(x), np.max(x)
            raise UserError(f"{name}: {column} is {low:.4g} to {high:.4g}, which looks like {looks}; give {give}")

    largest = np.max(np.abs(x))
    if column == "quat":
        length = np.linalg.norm(x, axis=1)
        require(np.all(np.abs(length - 1) < 0.05), f"no unit quaternion (length {shown(length[0])})", "x, y, z, w")
    elif column == "omega":
        require(largest <= _MAX_RATE, "degrees/s", "rad/s")
    elif column == "ref_yaw":
        require(largest <= 4 * np.pi, "degrees", "rad")
    elif column == "vel":
        require(largest <= 100, "mm/s or cm/s", "m/s")
    elif column in ("pos", "ref_pos"):
        require(largest <= 1e4, "mm", "m")
    elif column == "vbat":
        require(largest <= _MAX_VOLTAGE, "millivolts", "V")
        require(np.min(x) >= _MIN_VOLTAGE, "no voltage that turns motors", "V")
    elif column == "pwm":
        require(0 <= np.min(x) and largest <= _FULL_PWM, "no duty cycle of 16 bits", "0 to 65535")
        require(largest > _MAX_PERCENT, "percent", "0 to 65535")
    elif column == "rpm":
        require(0 <= np.min(x) and largest <= _MAX_RPM, "no rotor speed", "RPM")
        require(np.median(x) >= _MIN_MEDIAN_RPM, "rad/s", "RPM, 60 / (2 pi) times as many")
