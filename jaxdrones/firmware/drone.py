"""Drone whose motors a firmware commands: its physics, measurements and clock."""

from __future__ import annotations

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
from jaxdrones.params import Params
from jaxdrones.state import State

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
        """Simulated over real time."""
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
    """State of a team of one on the ground below it, upright and at rest, with the states of its models."""
    x, y, _ = np.asarray(state.pos[0]).tolist()
    same = ("pos", "quat", "vel", "omega", "rpm")
    start = on_ground(params, x, y)
    return state.replace(**{name: getattr(start, name).astype(state.pos.dtype) for name in same})


def measured(step: Step, team: Params, state: State, rpm: jax.Array) -> tuple[Any, ...]:
    """Numbers of a `Sample` of a team of one under commanded rotor speeds (1, 4), RPM."""
    params, one, rate = jax.tree.map(lambda x: x[0], (team, state, step.rate(team, state, rpm)))
    return one.pos, one.quat, one.vel, one.omega, one.rpm, specific_force(params, one, rate.vel)
