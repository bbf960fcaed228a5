"""What a flight leaves behind: its log and its numbers."""

import csv
import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np

from jaxdrones.control.pid import VEHICLES, rpm_to_pwm

_BAND = 0.1  # share of the steady error within which a response counts as settled
_LEAST_BAND = 5e-3  # m or m/s
_LOST = 1.0  # m or m/s that the error of a drone that diverged exceeds the error at the start


@dataclasses.dataclass(frozen=True)
class Record:
    """The log of a flight of n drones over K control steps; row k is the state at time t[k]."""

    t: np.ndarray  # (K,) s
    pos: np.ndarray  # (K, n, 3) m, world
    quat: np.ndarray  # (K, n, 4) body to world
    rpy: np.ndarray  # (K, n, 3) rad
    vel: np.ndarray  # (K, n, 3) m/s, world
    omega: np.ndarray  # (K, n, 3) rad/s, body
    rpm: np.ndarray  # (K, n, 4) RPM
    target_pos: np.ndarray  # (K, n, 3) m; NaN where a velocity is commanded
    target_vel: np.ndarray  # (K, n, 3) m/s; NaN where a position is commanded
    labels: tuple[str, ...]  # n names
    conditions: Any  # what was flown, and how: `as_dict()`, for JSON

    @property
    def late(self) -> np.ndarray:
        """(K,) whether a time is in the last quarter of the flight."""
        return self.t >= self.t[-1] * 3 / 4

    @property
    def error(self) -> np.ndarray:
        """(K, n, 1) distance to the target position, m."""
        return np.linalg.norm(self.pos - self.target_pos, axis=-1, keepdims=True)

    def not_finite(self) -> dict[str, str]:
        """Drones whose state is not a number at some time, and from when on."""
        states = (self.pos, self.quat, self.vel, self.omega, self.rpm)
        broken = np.any([~np.isfinite(x).all(-1) for x in states], axis=0)
        return {
            self.labels[i]: f"the state of {self.labels[i]} is not finite from t = {self.t[broken[:, i]][0]:.3f} s on"
            for i in np.flatnonzero(broken.any(axis=0))
        }

    def diverged(self) -> dict[str, str]:
        """Drones that did not fly what was commanded, and in which way.

        A drone diverged if its state is not finite at some time, or if at some time in the last quarter of the flight
        it is upside down, or its error (the distance to the target position or the difference to the target velocity)
        is 1 m or 1 m/s above its error at the start. The paper's four flights, flown well, stay below 0.6 m or m/s and
        within 30 degrees of level; a drone that is lost is hundreds of metres off.
        """
        miss, unit = self._miss()
        with np.errstate(over="ignore", invalid="ignore"):
            error = np.linalg.norm(miss.astype(np.float64), axis=-1)
            lost = error[self.late].max(axis=0) > error[0] + _LOST
            x, y = self.quat[self.late, :, 0], self.quat[self.late, :, 1]
            upside_down = (2 * (x**2 + y**2) > 1).any(axis=0)
        found = {}
        for i, label in enumerate(self.labels):
            if lost[i]:
                found[label] = f"{label} is {error[self.late, i].max():.3g} {unit} off what was commanded"
            elif upside_down[i]:
                found[label] = f"{label} is upside down"
        return found | self.not_finite()

    def results(self, after: float) -> list[dict[str, float | str | None]]:
        """One row of numbers per drone, taken from time `after` (s), or half of a shorter flight, to the end.

        The error is the distance to the target position, or the difference to the target velocity. The steady error
        is its mean over the last quarter of the flight. It has settled when it stays within 10 % (or 5 mm, 5 mm/s) of
        that; `None` if it does not before the last quarter. Numbers that are not finite are `None` too.
        """
        miss, unit = self._miss()
        unit = unit.replace("/", "_")
        late = self.t >= (after if after < self.t[-1] else self.t[-1] / 2)
        steady = self.late
        with np.errstate(over="ignore", invalid="ignore"):  # of a drone that broke
            error, speed = np.linalg.norm(miss, axis=-1), np.linalg.norm(self.vel, axis=-1)
            columns = {
                f"rms_error_{unit}": np.sqrt(np.mean(error[late] ** 2, axis=0)),
                f"peak_error_{unit}": error[late].max(axis=0),
                f"steady_error_{unit}": error[steady].mean(axis=0),
                "settled_after_s": [_settling(self.t, e, steady) for e in error.T],
                "lowest_z_m": self.pos[late, :, 2].min(axis=0),
                "highest_z_m": self.pos[late, :, 2].max(axis=0),
                "peak_vz_m_s": self.vel[late, :, 2].max(axis=0),
                "peak_speed_m_s": speed[late].max(axis=0),
                "rpm_std": self.rpm[late].std(axis=0).max(axis=-1),
            }
        return [
            {"drone": label} | {name: float(x[i]) if np.isfinite(x[i]) else None for name, x in columns.items()}
            for i, label in enumerate(self.labels)
        ]

    def _miss(self) -> tuple[np.ndarray, str]:
        """(K, n, 3) difference to what was commanded, and its unit."""
        if np.isnan(self.target_pos).any():
            return self.vel - self.target_vel, "m/s"
        return self.pos - self.target_pos, "m"

    def arrays(self, pwm: bool = False) -> dict[str, np.ndarray]:
        """The log by name, the conditions as JSON; `pwm` adds the Crazyflie's PWM beside the RPM.

        Raises:
            ValueError: PWM is asked for and the vehicle is no Crazyflie.
        """
        if pwm:
            check_pwm(self.conditions.vehicle)
        arrays = {field.name: np.asarray(getattr(self, field.name)) for field in dataclasses.fields(self)}
        arrays["conditions"] = np.asarray(json.dumps(self.conditions.as_dict()))
        return arrays | {"pwm": rpm_to_pwm(self.rpm)} if pwm else arrays

    def save_npz(self, path: Path, pwm: bool = False) -> None:
        """Write the named arrays."""
        arrays: dict[str, Any] = self.arrays(pwm)
        np.savez_compressed(path, **arrays)

    def save_csv(self, path: Path, pwm: bool = False) -> None:
        """Write one line per time and drone."""
        axes = {"pos": "xyz", "quat": "xyzw", "rpy": "rpy", "vel": "xyz", "omega": "xyz", "rpm": "0123", "pwm": "0123"}
        axes |= {"target_pos": "xyz", "target_vel": "xyz"}
        arrays = {name: array for name, array in self.arrays(pwm).items() if name in axes}
        with path.open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(["t", "drone"] + [f"{name}_{axis}" for name in arrays for axis in axes[name]])
            for k, t in enumerate(self.t):
                for i, label in enumerate(self.labels):
                    writer.writerow([t, label, *np.concatenate([array[k, i] for array in arrays.values()])])


def check_pwm(vehicle: str) -> None:
    """Raise unless the Crazyflie's PWM is known of a vehicle's motors."""
    if vehicle not in VEHICLES:
        raise ValueError(f"PWM is asked for of {vehicle!r}; it is known of {' and '.join(VEHICLES)} only, leave it out")


def divergence(record: Record, other: Record, rows: int = 12) -> list[dict[str, float]]:
    """How two flights of the same conditions part: the largest difference over the drones, at `rows` times."""
    at = np.unique(np.linspace(0, len(record.t) - 1, rows).round().astype(int))

    def largest(difference: np.ndarray) -> list[float]:
        return np.linalg.norm(difference[at], axis=-1).max(axis=-1).tolist()

    # |q - p| of unit quaternions is 2 sin(angle / 4), up to their sign
    apart = np.minimum(*(np.linalg.norm(record.quat[at] - sign * other.quat[at], axis=-1) for sign in (1, -1)))
    columns = {
        "t_s": record.t[at].tolist(),
        "pos_m": largest(record.pos - other.pos),
        "vel_m_s": largest(record.vel - other.vel),
        "angle_rad": (4 * np.arcsin(np.minimum(apart / 2, 1))).max(axis=-1).tolist(),
        "omega_rad_s": largest(record.omega - other.omega),
        "rpm": largest(record.rpm - other.rpm),
    }
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]


def _settling(t: np.ndarray, error: np.ndarray, steady: np.ndarray) -> float:
    mean = error[steady].mean()
    outside = np.flatnonzero(~(np.abs(error - mean) <= max(_BAND * mean, _LEAST_BAND)))
    if len(outside) == 0:
        return 0.0
    return np.nan if steady[outside[-1]] else float(t[outside[-1] + 1])
