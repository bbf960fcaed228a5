"""Flight logs: states, rotor speeds, commands and conditions."""

import dataclasses
import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np

from jaxdrones import rotation
from jaxdrones.dynamics.model import PointMass
from jaxdrones.errors import UserError
from jaxdrones.params import Params, repeat
from jaxdrones.sensing import Scene
from jaxdrones.state import State
from jaxdrones.urdf import load_params

STATE = {"pos": 3, "quat": 4, "vel": 3, "omega": 3}
"""Arrays of the state and their widths."""
STATE_AND_SPEEDS = STATE | {"rpm": 4}
"""The same with the rotor speeds, as in a simulated `State`."""
PERIOD = 0.01
"""Time between the rows of a log prepared for identification, s."""
OPTIONAL = {"rpm": 4, "pwm": 4, "vbat": 0, "target_pos": 3, "target_vel": 3, "target_yaw": 0, "load_pos": 3}
"""Optional arrays and their widths; 0 for a number per drone."""

_TAKE_OFF = slice(150, 350)  # rows after the motors start, for the mean voltage at take-off
_RUNNING_PWM = 100.0  # PWM above which a motor runs


class ImageSequence(NamedTuple):
    """Images of the drones' cameras."""

    t: np.ndarray
    """(F,) time of each exposure or, in an episode, of its first observation, s."""
    frames: np.ndarray
    """(F, n, height, width, ...): uint8 colors with 3 or 4 channels, depths in m, or segmentation labels."""


@dataclasses.dataclass(frozen=True)
class LoggedConditions:
    """Conditions of a flight from its log."""

    entries: dict[str, Any]
    about: str
    """Title."""

    @property
    def vehicle(self) -> str:
        """Name of a bundled vehicle, or path of a URDF."""
        return self.entries["vehicle"]

    def as_dict(self) -> dict[str, Any]:
        """The conditions for JSON."""
        return self.entries

    def __str__(self) -> str:
        return self.about


def _unknown() -> np.ndarray:
    return np.asarray(np.nan)


@dataclasses.dataclass(frozen=True)
class FlightLog:
    """Log of n drones over K rows; row k is the state at time t[k]. Unknown numbers are NaN."""

    t: np.ndarray
    """(K,) time, s."""
    pos: np.ndarray
    """(K, n, 3) position, m, world."""
    quat: np.ndarray
    """(K, n, 4) attitude, quaternion x, y, z, w, body to world."""
    vel: np.ndarray
    """(K, n, 3) velocity, m/s, world."""
    omega: np.ndarray
    """(K, n, 3) angular velocity, rad/s, body."""
    rpm: np.ndarray = dataclasses.field(default_factory=_unknown)
    """(K, n, 4) rotor speeds, RPM; motors front right, back right, back left, front left."""
    pwm: np.ndarray = dataclasses.field(default_factory=_unknown)
    """(K, n, 4) duty cycles of the motors, 0 to 65535."""
    vbat: np.ndarray = dataclasses.field(default_factory=_unknown)
    """(K, n) voltage of the battery, V."""
    target_pos: np.ndarray = dataclasses.field(default_factory=_unknown)
    """(K, n, 3) commanded position, m, world."""
    target_vel: np.ndarray = dataclasses.field(default_factory=_unknown)
    """(K, n, 3) commanded velocity, m/s, world."""
    target_yaw: np.ndarray = dataclasses.field(default_factory=_unknown)
    """(K, n) commanded heading, rad."""
    load_pos: np.ndarray = dataclasses.field(default_factory=_unknown)
    """(K, n, 3) position of the load on the cable of each drone, m, world."""
    labels: tuple[str, ...] = ()
    """Names of the n drones."""
    conditions: Any = dataclasses.field(default_factory=lambda: LoggedConditions({}, ""))
    """Conditions of the flight, with `as_dict()` for JSON."""
    params: Params = None  # type: ignore[assignment]  # filled in below
    """Constants of the team, with a leading axis of length n; by default those of cf2x."""
    scene: Scene = dataclasses.field(default_factory=Scene)
    images: Mapping[str, ImageSequence] = dataclasses.field(default_factory=dict)
    """Images of the on-board cameras, by kind."""
    name: str = "flight"
    file: Path | None = None
    """File of the log."""

    def __post_init__(self):
        rows, drones = len(self.t), (*np.shape(self.pos), 0, 0)[1]
        for name, width in STATE.items():
            shape = np.shape(getattr(self, name))
            if shape != (rows, drones, width):
                raise UserError(
                    f"{name} of a log has shape {shape}, pos {np.shape(self.pos)} and t {np.shape(self.t)}; give "
                    f"(K, n, {width}) of K times and n drones, also of one drone"
                )
        for name, width in OPTIONAL.items():
            shape = (rows, drones, width) if width else (rows, drones)
            known = np.isfinite(getattr(self, name)).any()
            object.__setattr__(self, name, np.broadcast_to(getattr(self, name) if known else np.nan, shape))
        if not self.labels:
            object.__setattr__(self, "labels", tuple(f"drone {i}" for i in range(drones)))
        if self.params is None:
            object.__setattr__(self, "params", repeat(load_params("cf2x"), drones))

    def __repr__(self) -> str:
        n, times = len(self.labels), f"{self.t[0]:g} to {self.t[-1]:g} s" if len(self.t) else "empty"
        columns = ", ".join((*STATE, *filter(self.has, OPTIONAL)))
        return f"<FlightLog {self.name}: {n} drone{'s' * (n != 1)}, {len(self.t)} rows, {times}, with {columns}>"

    def has(self, *names: str) -> bool:
        """Whether the log has all of these optional arrays."""
        return all(bool(np.isfinite(getattr(self, name)).any()) for name in names)

    def state(self, row: int) -> State:
        """State of the team (n, ...) at a row."""
        return State(**{name: getattr(self, name)[row] for name in STATE_AND_SPEEDS})

    def drone(self, i: int) -> Self:
        """Log of one drone of a team."""
        arrays: dict[str, Any] = {name: getattr(self, name)[:, i : i + 1] for name in STATE | OPTIONAL}
        params = jax.tree.map(lambda x: x[i : i + 1], self.params)
        images = {kind: ImageSequence(x.t, x.frames[:, i : i + 1]) for kind, x in self.images.items()}
        return dataclasses.replace(self, **arrays, labels=self.labels[i : i + 1], params=params, images=images)

    @property
    def in_flight(self) -> np.ndarray:
        """(K,) whether all motors run; true for a log without PWM."""
        return np.min(self.pwm, axis=(1, 2)) > _RUNNING_PWM if self.has("pwm") else np.ones(len(self.t), bool)

    @property
    def sag(self) -> float:
        """Drop of the battery voltage of the first drone from rest to take-off, V; 0 for a log that begins in flight.

        The voltage at rest is the highest one before the motors start; the voltage at take-off is the mean from 1.5 to
        3.5 s after, at 100 rows per second, or over the whole of a shorter flight.
        """
        begin, voltage = int(np.argmax(self.in_flight)), self.vbat[:, 0]
        if not (begin and self.has("vbat")):
            return 0.0
        flown = voltage[begin:]
        return float(np.max(voltage[:begin]) - np.mean(flown[_TAKE_OFF] if len(flown) > _TAKE_OFF.start else flown))

    @functools.cached_property
    def rpy(self) -> np.ndarray:
        """(K, n, 3) roll, pitch and yaw, rad."""
        return np.asarray(jax.jit(jax.vmap(jax.vmap(rotation.to_rpy)))(jnp.asarray(self.quat)))

    @property
    def begin(self) -> float:
        """Start of the flight, s: 0, or the first time of a log that begins later than it lasts and than 1 s."""
        first, last = float(self.t[0]), float(self.t[-1])
        return first if first > max(last - first, 1.0) else 0.0

    @property
    def last_quarter(self) -> np.ndarray:
        """(K,) mask of the last quarter of the flight."""
        return self.t - self.begin >= (self.t[-1] - self.begin) * 3 / 4

    @property
    def error(self) -> np.ndarray:
        """(K, n, 1) distance to the target position, m."""
        return np.linalg.norm(self.pos.astype(float) - self.target_pos, axis=-1, keepdims=True)

    def difference(self) -> tuple[np.ndarray, str]:
        """(K, n, 3) difference between actual and commanded position or velocity, and its unit."""
        if not self.has("target_pos"):
            return self.vel - self.target_vel, "m/s"
        return self.pos - self.target_pos, "m"

    def not_finite(self) -> dict[str, str]:
        """Drones with a state that is not finite: label -> message."""
        states = [getattr(self, name) for name in (*STATE, *["rpm"] * self.has("rpm"))]
        broken = np.any([~np.isfinite(x).all(-1) for x in states], axis=0)
        return {
            self.labels[i]: f"the state of {self.labels[i]} is not finite from t = {self.t[broken[:, i]][0]:.3f} s on"
            for i in np.flatnonzero(broken.any(axis=0))
        }


def logged(states: State) -> dict[str, Any]:
    """Arrays of a log in the states (K, n, ...) of a trajectory; the model `payload` has the positions of loads."""
    load = states.aux.get("payload")
    loads = {"load_pos": load.pos} if isinstance(load, PointMass) else {}
    return {name: getattr(states, name) for name in STATE_AND_SPEEDS} | loads
