"""The record of a flight: its log, its results, and whether it diverged."""

import csv
import dataclasses
import functools
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxdrones import rotation
from jaxdrones.control.pid import VEHICLES, rpm_to_pwm
from jaxdrones.errors import UserError
from jaxdrones.flights.arrays import check_arrays_of_flight
from jaxdrones.npz import read_arrays
from jaxdrones.params import Params
from jaxdrones.sensing import Scene
from jaxdrones.sensing.serialization import scene_from_dict, scene_to_dict
from jaxdrones.writing import replaced

_ARRAYS = ("t", "pos", "quat", "rpy", "vel", "omega", "rpm", "target_pos", "target_vel", "labels")  # of a log
_IMAGES = "images/"  # that names of arrays begin with
_BAND = 0.1  # share of the steady error within which a response counts as settled
_MIN_BAND = 5e-3  # m or m/s
_LOST = 1.0  # m or m/s above the error at the start, at which a drone has diverged


class ImageSequence(NamedTuple):
    """Images of the drones' cameras."""

    t: np.ndarray
    """(F,) when each was taken or, of an episode, observed first, s."""
    frames: np.ndarray
    """(F, n, height, width, ...): of colors uint8 with 3 or 4 channels, of depth in m, of segmentation numbers."""


@dataclasses.dataclass(frozen=True)
class LoggedConditions:
    """The conditions of a flight as its log has them."""

    entries: dict[str, Any]
    about: str
    """The same in words."""

    @property
    def vehicle(self) -> str:
        """Name of a bundled vehicle, or path of a URDF."""
        return self.entries["vehicle"]

    def as_dict(self) -> dict[str, Any]:
        """The conditions for JSON."""
        return self.entries

    def __str__(self) -> str:
        return self.about


@dataclasses.dataclass(frozen=True)
class Record:
    """The log of a flight of n drones over K control steps; row k is the state at time t[k]."""

    t: np.ndarray  # (K,) s
    pos: np.ndarray  # (K, n, 3) m, world
    quat: np.ndarray  # (K, n, 4) body to world
    vel: np.ndarray  # (K, n, 3) m/s, world
    omega: np.ndarray  # (K, n, 3) rad/s, body
    rpm: np.ndarray  # (K, n, 4) RPM
    target_pos: np.ndarray  # (K, n, 3) m; NaN where a velocity is commanded
    target_vel: np.ndarray  # (K, n, 3) m/s; NaN where a position is commanded
    labels: tuple[str, ...]  # n names
    conditions: Any  # conditions of the flight, with `as_dict()` for JSON
    params: Params  # of the team: every array has a leading axis of length n
    scene: Scene = dataclasses.field(default_factory=Scene)
    images: Mapping[str, ImageSequence] = dataclasses.field(default_factory=dict)  # of the on-board cameras, by kind

    @functools.cached_property
    def rpy(self) -> np.ndarray:
        """(K, n, 3) roll, pitch and yaw, rad."""
        return np.asarray(jax.jit(jax.vmap(jax.vmap(rotation.to_rpy)))(jnp.asarray(self.quat)))

    @property
    def last_quarter(self) -> np.ndarray:
        """(K,) which times are in the last quarter of the flight."""
        return self.t >= self.t[-1] * 3 / 4

    @property
    def error(self) -> np.ndarray:
        """(K, n, 1) distance to the target position, m."""
        return np.linalg.norm(self.pos.astype(float) - self.target_pos, axis=-1, keepdims=True)

    def not_finite(self) -> dict[str, str]:
        """Drones whose state is not finite at some time: label -> what happened and when."""
        states = (self.pos, self.quat, self.vel, self.omega, self.rpm)
        broken = np.any([~np.isfinite(x).all(-1) for x in states], axis=0)
        return {
            self.labels[i]: f"the state of {self.labels[i]} is not finite from t = {self.t[broken[:, i]][0]:.3f} s on"
            for i in np.flatnonzero(broken.any(axis=0))
        }

    def diverged(self) -> dict[str, str]:
        """Drones that did not follow their commands: label -> what happened.

        A drone diverged if its state is not finite at some time, or if at some time in the last quarter of the flight
        it is upside down, or its error (the distance to the target position or the difference to the target velocity)
        is 1 m or 1 m/s above its error at the start. The four examples with their defaults stay below 0.6 m or m/s
        and within 30 degrees of level; an unstable drone is hundreds of metres off.
        """
        difference, unit = self.difference()
        with np.errstate(over="ignore", invalid="ignore"):
            error = np.linalg.norm(difference.astype(np.float64), axis=-1)
            lost = error[self.last_quarter].max(axis=0) > error[0] + _LOST
            x, y = self.quat[self.last_quarter, :, 0], self.quat[self.last_quarter, :, 1]
            upside_down = (2 * (x**2 + y**2) > 1).any(axis=0)
        found = {}
        for i, label in enumerate(self.labels):
            if lost[i]:
                found[label] = f"{label} is {error[self.last_quarter, i].max():.3g} {unit} off its command"
            elif upside_down[i]:
                found[label] = f"{label} is upside down"
        return found | self.not_finite()

    def results(self, after: float) -> list[dict[str, float | str | None]]:
        """One row of numbers per drone, over the flight from time `after` (s) on, or its second half if it is shorter.

        The error is the distance to the target position, or the difference to the target velocity. The steady error
        is its mean over the last quarter of the flight. The drone has settled when the error stays within 10 % (or
        5 mm, 5 mm/s) of that; `None` if it does not before the last quarter. Numbers that are not finite are `None`.
        """
        difference, unit = self.difference()
        unit = unit.replace("/", "_")
        counted = self.t >= self._counted_from(after)
        steady = self.last_quarter
        with np.errstate(over="ignore", invalid="ignore"):  # where the state is not finite
            error, speed = np.linalg.norm(difference, axis=-1), np.linalg.norm(self.vel, axis=-1)
            columns = {
                f"rms_error_{unit}": np.sqrt(np.mean(error[counted] ** 2, axis=0)),
                f"peak_error_{unit}": error[counted].max(axis=0),
                f"steady_error_{unit}": error[steady].mean(axis=0),
                "settled_after_s": [_settling(self.t, e, steady) for e in error.T],
                "lowest_z_m": self.pos[counted, :, 2].min(axis=0),
                "highest_z_m": self.pos[counted, :, 2].max(axis=0),
                "peak_vz_m_s": self.vel[counted, :, 2].max(axis=0),
                "peak_speed_m_s": speed[counted].max(axis=0),
                "rpm_std": self.rpm[counted].std(axis=0).max(axis=-1),
            }
        return [
            {"drone": label} | {name: float(x[i]) if np.isfinite(x[i]) else None for name, x in columns.items()}
            for i, label in enumerate(self.labels)
        ]

    def definitions(self, after: float) -> str:
        """What the numbers of `results` are and from which times on they count, in words; three lines."""
        unit = "mm" if self.difference()[1] == "m" else "mm/s"
        last, begin = self.t[self.last_quarter][0], self._counted_from(after)
        band = f"{100 * _BAND:g} % or {1000 * _MIN_BAND:g} {unit}"
        return (
            f"steady: mean error from {last:.2f} s on, the last quarter of the flight\n"
            f"settled: time from which on the error stays within {band} of steady (-: not before the last quarter)\n"
            f"all other numbers count from {begin:.2f} s on"
        )

    def _counted_from(self, after: float) -> float:
        """Time from which on results count, s."""
        return after if after < self.t[-1] else float(self.t[-1]) / 2

    def difference(self) -> tuple[np.ndarray, str]:
        """(K, n, 3) difference between actual and commanded position or velocity, and its unit."""
        if np.isnan(self.target_pos).any():
            return self.vel - self.target_vel, "m/s"
        return self.pos - self.target_pos, "m"

    def arrays(self, pwm: bool = False) -> dict[str, np.ndarray]:
        """The log by name; conditions, parameters and scene are JSON; `pwm` adds the Crazyflie's PWM signals.

        Raises:
            ValueError: PWM is asked for and the vehicle is no Crazyflie.
        """
        if pwm:
            check_pwm(self.conditions.vehicle)
        texts = {
            "conditions": self.conditions.as_dict(),
            "params": {name: np.asarray(x).tolist() for name, x in vars(self.params).items() if name != "aux"},
            "scene": scene_to_dict(self.scene),
        }
        arrays = {name: np.asarray(getattr(self, name)) for name in _ARRAYS}
        arrays |= {name: np.asarray(json.dumps(entries)) for name, entries in texts.items()}
        arrays["about"] = np.asarray(str(self.conditions))
        for kind, images in self.images.items():
            arrays |= {f"{_IMAGES}{kind}/{name}": array for name, array in images._asdict().items()}
        return arrays | {"pwm": rpm_to_pwm(self.rpm)} if pwm else arrays

    def save_npz(self, path: Path, pwm: bool = False) -> None:
        """Write the log as named arrays."""
        arrays: dict[str, Any] = self.arrays(pwm)
        with replaced(path) as new:
            np.savez_compressed(new, **arrays)

    @classmethod
    def load(cls, path: Path) -> "Record":
        """The record that `save_npz` wrote.

        Raises:
            ValueError: the file is no log of a flight, or lacks something; names it.
        """
        names = {field.name for field in dataclasses.fields(cls)} - {"images"}
        try:
            log = read_arrays(path)
            arrays: dict[str, Any] = {name: log[name] for name in names}
            about = str(log["about"])
            kinds = sorted({name.split("/")[1] for name in log if name.startswith(_IMAGES)})
            images = {
                kind: ImageSequence(*(log[f"{_IMAGES}{kind}/{name}"] for name in ImageSequence._fields))
                for kind in kinds
            }
            texts = {name: json.loads(str(arrays.pop(name))) for name in ("conditions", "params", "scene")}
            constants: dict[str, Any] = {name: np.asarray(x, float) for name, x in texts["params"].items()}
            params, scene = Params(**constants), scene_from_dict(texts["scene"])
            labels = tuple(map(str, arrays.pop("labels")))
            record = cls(
                **arrays,
                labels=labels,
                conditions=LoggedConditions(texts["conditions"], about),
                params=params,
                scene=scene,
                images=images,
            )
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            why = f"{error.args[0]!r} is missing" if isinstance(error, KeyError) and error.args else error
            raise UserError(
                f"{path} is not the log of a flight ({why}); give a log.npz that `jaxdrones fly` wrote"
            ) from None
        check_arrays_of_flight(record, str(path))
        return record

    def save_csv(self, path: Path, pwm: bool = False) -> None:
        """Write one line per time and drone."""
        axes = {"pos": "xyz", "quat": "xyzw", "rpy": "rpy", "vel": "xyz", "omega": "xyz", "rpm": "0123", "pwm": "0123"}
        axes |= {"target_pos": "xyz", "target_vel": "xyz"}
        arrays = {name: array for name, array in self.arrays(pwm).items() if name in axes}
        with replaced(path) as new, new.open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(["t", "drone"] + [f"{name}_{axis}" for name in arrays for axis in axes[name]])
            for k, t in enumerate(self.t):
                for i, label in enumerate(self.labels):
                    writer.writerow([t, label, *np.concatenate([array[k, i] for array in arrays.values()])])


def check_pwm(vehicle: str) -> None:
    """Raise `ValueError` unless a vehicle has the motors of the Crazyflie, whose PWM is known."""
    if vehicle not in VEHICLES:
        raise UserError(
            f"PWM is asked for with {vehicle!r}; it is known for {' and '.join(VEHICLES)} only, leave it out"
        )


def divergence(record: Record, other: Record, rows: int = 12) -> list[dict[str, float]]:
    """How two flights of the same conditions diverge: the largest differences over the drones, at `rows` times."""
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
    outside = np.flatnonzero(~(np.abs(error - mean) <= max(_BAND * mean, _MIN_BAND)))
    if len(outside) == 0:
        return 0.0
    return np.nan if steady[outside[-1]] else float(t[outside[-1] + 1])
