"""Physics of a drone whose motors Betaflight commands."""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdrones.dynamics.aero import drag
from jaxdrones.dynamics.contact import ground_contact, rim
from jaxdrones.dynamics.rigid_body import specific_force
from jaxdrones.dynamics.rotors import lagging_rotors
from jaxdrones.engine.explicit import make_step
from jaxdrones.engine.step import Step
from jaxdrones.errors import UserError
from jaxdrones.firmware.betaflight.packets import motor_order
from jaxdrones.params import Params, repeat
from jaxdrones.state import State
from jaxdrones.urdf import load_params

_LEAST_HZ = 1000  # of the physics
_SPINS = np.array([1.0, -1.0, -1.0, 1.0])
"""Signs of the reaction torque of motors 1 to 4 in Betaflight's default direction, props in."""


class Sample(NamedTuple):
    """State and specific force of the drone."""

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


_WIDTHS = np.cumsum([3, 4, 3, 3, 4])


class Simulation:
    """Drone at rest on the ground, with lagging rotors, drag and ground contact."""

    def __init__(self, vehicle: str = "racer", hz: int = 1000):
        """Compile the simulation.

        Args:
            vehicle: a bundled vehicle or the path of a URDF.
            hz: steps per second, each of which takes one output of the motors.

        Raises:
            UserError: rotors that are not in X configuration, or not alternating in direction.
        """
        self.params, self.dt, self.steps = load_params(vehicle), 1 / hz, 0
        self._check(vehicle)
        self._motor_of_rotor = motor_order(np.asarray(self.params.rotor_pos))
        substeps = -(-_LEAST_HZ // hz)
        step = make_step((drag, ground_contact), rotors=lagging_rotors, dt=self.dt / substeps, substeps=substeps)
        self._team = repeat(self.params, 1)
        self._advance = jax.jit(functools.partial(_advance, step))
        self._height = float(rim(self.params)[0] - self.params.collision_offset)  # at which it touches the ground
        self._state = step.init(self._team, State.at_rest([[0.0, 0.0, self._height]]))
        self.sample = self.advance(np.zeros(4))

    def _check(self, vehicle: str) -> None:
        pos, spin = np.asarray(self.params.rotor_pos), np.asarray(self.params.rotor_spin)
        quadrants = np.sign(pos[:, 0]) + 2 * np.sign(pos[:, 1])
        if sorted(quadrants) != [-3, -1, 1, 3]:
            raise UserError(f"{vehicle} has rotors on its axes; Betaflight's mixer is for an X, give such a vehicle")
        turns = spin * _SPINS[motor_order(pos)]
        if abs(turns.sum()) != 4:
            raise UserError(f"{vehicle} has rotors with the directions {spin.tolist()}; neighbors must turn oppositely")

    @property
    def reversed_yaw(self) -> bool:
        """Whether the rotors turn in the opposite of Betaflight's default direction: props out."""
        order = motor_order(np.asarray(self.params.rotor_pos))
        return bool(np.asarray(self.params.rotor_spin)[0] != _SPINS[order][0])

    @property
    def time(self) -> float:
        """Simulated time, s."""
        return self.steps * self.dt

    def advance(self, outputs: np.ndarray) -> Sample:
        """Take one step with the outputs (4,) of motors 1 to 4, fractions of the largest rotor speed."""
        rpm = np.asarray(outputs, float)[self._motor_of_rotor] * float(self.params.max_rpm)
        self._state, row = self._advance(self._team, self._state, rpm)
        self.steps += 1
        self.sample = Sample(*np.split(np.asarray(row, float), _WIDTHS))
        return self.sample

    def set_upright(self) -> None:
        """Set the drone on the ground below it, upright and at rest."""
        x, y, _ = self.sample.pos
        start = State.at_rest([[float(x), float(y), self._height]])
        same = ("pos", "quat", "vel", "omega", "rpm")
        self._state = self._state.replace(
            **{name: jnp.asarray(getattr(start, name), self._state.pos.dtype) for name in same}
        )


def _advance(step: Step, team: Params, state: State, rpm: Float[Array, "4"]) -> tuple[State, Array]:
    """State after a step, and the numbers of a `Sample`."""
    rpm = jnp.asarray(rpm, state.pos.dtype)[None]
    state = step(team, state, rpm)
    params, one = jax.tree.map(lambda x: x[0], (team, state))
    acc = specific_force(params, one, step.rate(team, state, rpm).vel[0])
    return state, jnp.concatenate([one.pos, one.quat, one.vel, one.omega, one.rpm, acc])
