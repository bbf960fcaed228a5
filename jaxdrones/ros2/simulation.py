"""Simulation of a commanded team: step, controllers and measurements."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxdrones import rotation
from jaxdrones.control import pid
from jaxdrones.dynamics.rigid_body import specific_force
from jaxdrones.engine.step import HostStep, Step
from jaxdrones.params import Params
from jaxdrones.ros2 import command as commands
from jaxdrones.ros2.command import Command, Mode
from jaxdrones.ros2.convert import Measurement
from jaxdrones.sensing import Camera, Scene, render
from jaxdrones.state import State

Battery = Callable[[Params, State], dict[str, Any]]
"""(params, state) of one drone -> `voltage` V, `current` A drawn, `charge` and `capacity` A s; any may be missing."""

_SECOND = 1_000_000_000  # ns


class Simulation:
    """Team and its step; `advance` takes one control step."""

    def __init__(
        self,
        step: Step,
        params: Params,
        state: State,
        control_hz: int,
        *,
        controller: str | None = None,
        battery: Battery | None = None,
        scene: Scene | None = None,
    ):
        """Start a flight with every drone holding its position.

        Args:
            step: step of either backend, for one control period.
            params: parameters of a team.
            state: initial state of the team.
            control_hz: control steps per second.
            controller: name of the controller of positions and velocities in `CONTROLLERS`; by default the vehicle's.
            battery: readings of the battery of one drone as a function of its state; by default none.
            scene: obstacles; by default those of the step, and none in images of the explicit backend.
        """
        self.controller = controller or ("pid" if pid.fits(params) else "geometric")
        self.params, self.control_hz, self.steps = params, control_hz, 0
        self.state = step.init(params, jax.tree.map(jnp.asarray, state))
        self._step, self._scene = step, scene
        n = len(state.pos)
        self._memory = jax.vmap(functools.partial(commands.init, self.controller))(self.state)
        self._rpm: jax.Array = self.state.rpm
        self._control = jax.jit(jax.vmap(functools.partial(commands.control, self.controller, dt=1 / control_hz)))
        self._measure = jax.jit(_measure_team, static_argnames="battery")
        self._battery = battery
        yaw = np.asarray(jax.vmap(rotation.to_rpy)(self.state.quat))[:, 2]
        self.commands = [Command.zero(Mode.POSITION, pos=np.asarray(self.state.pos[i]), yaw=yaw[i]) for i in range(n)]

        self._control_team()  # compiles all functions of a control step before the flight
        self._step(self.params, self.state, self._rpm, self._scene)
        self.measure()

    @property
    def drones(self) -> int:
        """Size of the team."""
        return len(self.commands)

    @property
    def has_battery(self) -> bool:
        """Whether batteries are published."""
        return self._battery is not None

    @property
    def ns(self) -> int:
        """Simulated time, ns."""
        return self.steps * _SECOND // self.control_hz

    def advance(self) -> None:
        """Take one control step with `commands`, one for each drone."""
        self._memory, self._rpm = self._control_team()
        self.state = self._step(self.params, self.state, self._rpm, self._scene)
        self.steps += 1

    def _control_team(self) -> tuple[commands.Memory, jax.Array]:
        dtype = self.state.pos.dtype
        team = jax.tree.map(
            lambda *x: np.stack(x).astype(np.int32 if x[0].dtype == np.int32 else dtype), *self.commands
        )
        return self._control(self.params, self._memory, self.state, team)

    def measure(self) -> Measurement:
        """Current published data of the team.

        Accelerometers measure the acceleration under the last commanded rotor speeds.
        """
        acc = self._step.rate(self.params, self.state, self._rpm, self._scene).vel
        return jax.device_get(self._measure(self.params, self.state, acc, self._battery))

    def images(self, camera: Camera) -> np.ndarray:
        """Images (n, h, w, 4) of the camera on every drone: red, green, blue, opacity."""
        if isinstance(self._step, HostStep):
            return np.asarray(self._step.camera(self.params, self.state, camera, self._scene).rgb)
        return np.asarray(render(self._scene or Scene(), self.params, self.state, camera).rgb)


def _measure_team(params: Params, state: State, acc: jax.Array, battery: Battery | None) -> Measurement:
    def measure(params: Params, state: State, acc: jax.Array) -> Measurement:
        return Measurement(
            pos=state.pos,
            quat=state.quat,
            vel=rotation.rotate_inverse(state.quat, state.vel),
            omega=state.omega,
            acc=specific_force(params, state, acc),
            rpm=state.rpm,
            battery=None if battery is None else battery(params, state),
        )

    return jax.vmap(measure)(params, state, acc)
