"""Drone whose motors a firmware commands: its physics, measurements, clock and records."""

import collections
import dataclasses
from typing import Any

import jax
import numpy as np

from jaxdrones.dynamics.aero import drag
from jaxdrones.dynamics.contact import ground_contact, rim
from jaxdrones.dynamics.rigid_body import specific_force
from jaxdrones.dynamics.rotors import lagging_rotors
from jaxdrones.engine.explicit import make_step
from jaxdrones.engine.step import Step
from jaxdrones.flights.log import FlightLog, LoggedConditions
from jaxdrones.params import Params, repeat
from jaxdrones.state import State

_MOST_ROWS = 360_000  # an hour at 100 rows per second
LATE = 0.1  # s, lag behind the clock after which the schedule restarts


@dataclasses.dataclass
class Pace:
    """Simulated and real time of a flight."""

    simulated_s: float = 0.0
    real_s: float = 0.0
    late: int = 0
    """Number of times that the flight fell behind the clock by 0.1 s."""

    @property
    def real_time_factor(self) -> float:
        """Real-time factor: simulated time over elapsed time."""
        return self.simulated_s / self.real_s if self.real_s else 0.0


@dataclasses.dataclass(frozen=True)
class Sample:
    """State and specific force of the drone; no noise."""

    pos: np.ndarray
    """(3,) m, world."""
    quat: np.ndarray
    """(4,) x, y, z, w, body to world."""
    vel: np.ndarray
    """(3,) m/s, world."""
    omega: np.ndarray
    """(3,) rad/s, body."""
    rpm: np.ndarray
    """(4,) rotor speeds, RPM."""
    acc: np.ndarray
    """(3,) specific force, m/s^2, body: 9.8 upwards at rest."""


def make_physics(dt: float, substeps: int) -> Step:
    """Step of `dt` (s) with lagging rotors, drag and ground contact."""
    return make_step((drag, ground_contact), rotors=lagging_rotors, dt=dt / substeps, substeps=substeps)


def on_ground(params: Params, x: float = 0.0, y: float = 0.0) -> State:
    """State of a team of one, upright and at rest on the ground."""
    height = float(rim(params)[0] - params.collision_offset)  # at which it touches the ground
    return State.at_rest([[x, y, height]])


def set_upright(params: Params, state: State) -> State:
    """State of one drone (a team of one), moved upright and at rest to the ground below it; model states stay."""
    x, y, _ = np.asarray(state.pos[0]).tolist()
    start = jax.tree.map(lambda x: x.astype(state.pos.dtype), on_ground(params, x, y))
    return start.replace(aux=state.aux)


def measured(step: Step, team: Params, state: State, rpm: jax.Array) -> tuple[Any, ...]:
    """Numbers of a `Sample` of a team of one under commanded rotor speeds (1, 4), RPM."""
    params, one, rate = jax.tree.map(lambda x: x[0], (team, state, step.rate(team, state, rpm)))
    return one.pos, one.quat, one.vel, one.omega, one.rpm, specific_force(params, one, rate.vel)


class Recorder:
    """Rows of a flight of one drone; of a long flight the last 360,000."""

    def __init__(self) -> None:
        self._rows: collections.deque[tuple[Any, ...]] = collections.deque(maxlen=_MOST_ROWS)

    def __len__(self) -> int:
        return len(self._rows)

    def add(self, t: float, now: Sample, target: Any = None) -> None:
        """Add a row: time (s), sample of the drone and target position (3,) (m, world), if it has one then."""
        unknown = np.full(3, np.nan)
        arrays = (now.pos, now.quat, now.vel, now.omega, now.rpm, unknown if target is None else target)
        self._rows.append((t, *(np.array(x, np.float32) for x in arrays)))

    def log(self, params: Params, conditions: dict[str, Any], about: str) -> FlightLog:
        """Log of the flight; the conditions, with `vehicle`, are for JSON, and `about` is the title."""
        t, *arrays = map(np.array, zip(*self._rows, strict=True))
        pos, quat, vel, omega, rpm, target = (x[:, None] for x in arrays)
        return FlightLog(
            t=t.astype(float),
            pos=pos,
            quat=quat,
            vel=vel,
            omega=omega,
            rpm=rpm,
            target_pos=target,
            conditions=LoggedConditions(conditions, about),
            params=repeat(params, 1),
        )
