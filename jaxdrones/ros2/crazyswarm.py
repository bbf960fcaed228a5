"""Simulation backend for Crazyswarm2.

Crazyswarm2 imports the class `Backend` from `crazyflie_sim.backend.<name>`. Add a file `jaxdrones.py` to that folder,
with the line `from jaxdrones.ros2.crazyswarm import Backend`, and `sim: backend: jaxdrones` to its `server.yaml`.
Parameters of the server, all optional: `sim.jaxdrones.vehicle` (cf2x),
`sim.jaxdrones.dt` (0.0005 s), `sim.jaxdrones.downwash` (true).

The interface is that of Crazyswarm2's own backend `np`, read in its source; it has not been run inside Crazyswarm2.
"""

import importlib
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxdrones import rotation
from jaxdrones.checks import check_number
from jaxdrones.dynamics.contact import ground_contact
from jaxdrones.dynamics.interaction import downwash
from jaxdrones.engine.explicit import make_step
from jaxdrones.errors import UserError
from jaxdrones.params import repeat
from jaxdrones.state import State
from jaxdrones.urdf import load_params

_NS = 1_000_000_000
_GRAMS = (2.55077341e-08, -4.92422570e-05, -1.51910248e-01)  # of RPM; Crazyswarm2's fit to a Crazyflie's rotors
_NEWTON_PER_GRAM = 9.81e-3
_PLACES = ((1, -1), (-1, -1), (-1, 1), (1, 1))  # signs of x and y of the motors m1 to m4 of a Crazyflie
_CLOCK_DEPTH = 10


SwarmState = Any
"""`crazyflie_sim.sim_data_types.State`: pos, vel (world), quat (w, x, y, z), omega (body)."""
SwarmAction = Any
"""`crazyflie_sim.sim_data_types.Action`: rpm, the speeds of the motors m1 to m4, RPM."""


class Backend:
    """Backend with Crazyswarm2's interface."""

    def __init__(self, node: Any, names: list[str], states: Sequence[SwarmState]):
        """Start a team of drones with these names and initial states; `step` updates the same states and returns them.

        The parameters of the server, a node of rclpy, configure the backend, which publishes the clock by it.
        """
        self.names, self._states, self._steps = names, list(states), 0
        self.dt = float(_parameter(node, "dt", 0.0005))
        check_number("sim.jaxdrones.dt", self.dt, "s", above=0)
        with_downwash = _parameter(node, "downwash", True)
        vehicle = load_params(_parameter(node, "vehicle", "cf2x"))
        self._params = repeat(vehicle, len(names))
        self._order = _rotors_of_motors(np.asarray(vehicle.rotor_pos))
        self._kf = np.asarray(self._params.kf)[:, None]
        pairs = (downwash,) if with_downwash and len(names) > 1 else ()
        self._step = make_step((ground_contact,), pairs, dt=self.dt)
        self._state = _from_swarm(self._states, self._params.hover_rpm.dtype)
        self._clock_type = importlib.import_module("rosgraph_msgs.msg").Clock
        self._time_type = importlib.import_module("builtin_interfaces.msg").Time
        self._clock = node.create_publisher(self._clock_type, "clock", _CLOCK_DEPTH)

    def time(self) -> float:
        """Simulated time, s."""
        return self._steps * self.dt

    def step(self, states_desired: Sequence[Any], actions: Sequence[SwarmAction]) -> list[SwarmState]:
        """Advance all drones by `dt`, publish the clock, and return the states; without actions the motors stop.

        Crazyswarm2's motor speeds are converted to thrust by its fit, and to rotor speeds of the vehicle, so the
        firmware's thrust is independent of the vehicle's coefficients.
        """
        speeds = np.array([np.zeros(4) if action is None else np.asarray(action.rpm, float) for action in actions])
        rpm = np.sqrt(thrust_of(speeds)[:, self._order] / self._kf)
        self._state = self._step(self._params, self._state, jnp.asarray(rpm, self._state.pos.dtype))
        self._steps += 1
        now = jax.device_get(self._state)
        for i, state in enumerate(self._states):
            state.pos, state.vel, state.omega = now.pos[i], now.vel[i], now.omega[i]
            state.quat = now.quat[i][[3, 0, 1, 2]]
        sec, nanosec = divmod(round(self.time() * _NS), _NS)
        self._clock.publish(self._clock_type(clock=self._time_type(sec=sec, nanosec=nanosec)))
        return self._states

    def shutdown(self) -> None:
        """End the flight."""


def thrust_of(rpm: np.ndarray) -> np.ndarray:
    """Thrust of a Crazyflie's rotor at speeds (RPM) by the fit of Crazyswarm2, N; never negative."""
    return np.maximum(np.polyval(_GRAMS, rpm), 0) * _NEWTON_PER_GRAM


def _parameter(node: Any, name: str, default: Any) -> Any:
    name = f"sim.jaxdrones.{name}"
    return node.get_parameter(name).value if node.has_parameter(name) else default


def _rotors_of_motors(places: np.ndarray) -> np.ndarray:
    """Number of the Crazyflie's motor in the quadrant of each rotor (4, 3) of a vehicle."""
    signs = [
        tuple(row) for row in np.sign(np.where(np.abs(places[:, :2]) < 1e-6, 0, places[:, :2])).astype(int).tolist()
    ]
    if sorted(signs) != sorted(_PLACES):
        where = places[:, :2].tolist()
        raise UserError(f"the rotors of the vehicle are at {where}; Crazyswarm2 flies an X configuration, give cf2x")
    return np.array([_PLACES.index(sign) for sign in signs])


def _from_swarm(states: Sequence[SwarmState], dtype: Any) -> State:
    pos, vel, quat, omega = (
        jnp.asarray(np.array([getattr(state, name) for state in states], float), dtype)
        for name in ("pos", "vel", "quat", "omega")
    )
    return State(
        pos, jax.vmap(rotation.normalize)(jnp.roll(quat, -1, axis=1)), vel, omega, jnp.zeros((len(states), 4), dtype)
    )
