"""Physics of a drone whose motors Betaflight commands."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdrones.engine.step import Step
from jaxdrones.errors import UserError
from jaxdrones.firmware import drone
from jaxdrones.firmware.betaflight.packets import motor_order, state_packet
from jaxdrones.firmware.drone import Sample
from jaxdrones.params import Params, repeat
from jaxdrones.state import State
from jaxdrones.urdf import load_params

_LEAST_HZ = 1000  # of the physics
_SPINS = np.array([1.0, -1.0, -1.0, 1.0])
"""Signs of the reaction torque of motors 1 to 4 in Betaflight's default direction, props in."""
_WIDTHS = np.cumsum([3, 4, 3, 3, 4])


class Simulation:
    """Drone at rest on the ground, with lagging rotors, drag and ground contact."""

    def __init__(self, vehicle: str = "racer", hz: int = 1000):
        """Compile the simulation of a vehicle with `hz` steps per second, each of which takes one output of the motors.

        Raises:
            UserError: rotors that are not in X configuration, or not alternating in direction.
        """
        self.params, self.dt, self.steps = load_params(vehicle), 1 / hz, 0
        pos, spin = np.asarray(self.params.rotor_pos), np.asarray(self.params.rotor_spin)
        if sorted(np.sign(pos[:, 0]) + 2 * np.sign(pos[:, 1])) != [-3, -1, 1, 3]:
            raise UserError(f"{vehicle} has rotors on its body axes; give a vehicle in X configuration")
        self._motor_of_rotor = motor_order(pos)
        turns = spin * _SPINS[self._motor_of_rotor]
        if abs(turns.sum()) != 4:
            raise UserError(f"{vehicle} has rotors with the directions {spin.tolist()}; give alternating ones")
        self.reversed_yaw = bool(turns[0] < 0)
        """Whether the rotors turn in the opposite of Betaflight's default direction: props out."""
        step = drone.make_physics(self.dt, substeps=-(-_LEAST_HZ // hz))
        self._team = repeat(self.params, 1)
        self._advance = jax.jit(functools.partial(_advance, step))
        self._state = step.init(self._team, drone.on_ground(self.params))
        self.sample = self.advance(np.zeros(4))

    @property
    def time(self) -> float:
        """Simulated time, s."""
        return self.steps * self.dt

    def packet(self) -> bytes:
        """State packet of the current sample."""
        return state_packet(self.time, self.sample.quat, self.sample.omega, self.sample.acc)

    def advance(self, outputs: np.ndarray) -> Sample:
        """Take one step with the outputs (4,) of motors 1 to 4, fractions of the largest rotor speed."""
        rpm = np.asarray(outputs, float)[self._motor_of_rotor] * float(self.params.max_rpm)
        self._state, row = self._advance(self._team, self._state, rpm)
        self.steps += 1
        self.sample = Sample(*np.split(np.asarray(row, float), _WIDTHS))
        return self.sample

    def set_upright(self) -> None:
        """Set the drone on the ground below it, upright and at rest."""
        self._state = drone.set_upright(self.params, self._state)


def _advance(step: Step, team: Params, state: State, rpm: Float[Array, "4"]) -> tuple[State, Array]:
    """State after a step, and the numbers of a `Sample`."""
    rpm = jnp.asarray(rpm, state.pos.dtype)[None]
    state = step(team, state, rpm)
    return state, jnp.concatenate(drone.measured(step, team, state, rpm))
