"""Commands of a drone, and their control."""

import enum
from typing import Any, Self

import flax.struct
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdrones import rotation
from jaxdrones.control import CONTROLLERS as ALL_CONTROLLERS
from jaxdrones.control import Setpoint, firmware_pid, rates
from jaxdrones.params import Params
from jaxdrones.state import State
from jaxdrones.vector import sin_cos

CONTROLLERS = {name: module for name, module in ALL_CONTROLLERS.items() if module is not firmware_pid}
"""Controllers with velocity control by a `Setpoint`, unlike the firmware's."""


class Mode(enum.IntEnum):
    """Kind of a command."""

    POSITION = 0
    VELOCITY = 1
    RATES = 2
    MOTORS = 3


class Command(flax.struct.PyTreeNode):
    """Command of one drone, or of a team with a leading drone axis on every array."""

    mode: Any
    """() a `Mode`."""
    pos: Any
    """(3,) m, world."""
    yaw: Any
    """() heading, rad."""
    vel: Any
    """(3,) m/s, x forward along the heading, y to the left, z up."""
    yaw_rate: Any
    """() rad/s."""
    omega: Any
    """(3,) body rates, rad/s, body."""
    thrust: Any
    """() collective thrust per mass, m/s^2."""
    rpm: Any
    """(4,) rotor speeds, RPM."""

    @classmethod
    def zero(cls, mode: Mode, **given: Any) -> Self:
        """Command of one drone with zero defaults."""
        sizes: dict[str, tuple[int, ...]] = {"pos": (3,), "vel": (3,), "omega": (3,), "rpm": (4,)}
        numbers = ("pos", "yaw", "vel", "yaw_rate", "omega", "thrust", "rpm")
        values = {name: np.array(given.get(name, np.zeros(sizes.get(name, ()))), float) for name in numbers}
        return cls(mode=np.asarray(mode, np.int32), **values)


class Memory(flax.struct.PyTreeNode):
    """State of the control of one drone between steps."""

    controller: Any
    """Memory of the controller of positions and velocities."""
    heading: Array
    """() heading of velocity commands, rad; the integral of the commanded yaw rate."""


def init(controller: str, state: State) -> Memory:
    """Initial memory of one drone."""
    return Memory(CONTROLLERS[controller].init(), rotation.to_rpy(state.quat)[2])


def control(
    controller: str, params: Params, memory: Memory, state: State, command: Command, dt: float
) -> tuple[Memory, Float[Array, "4"]]:
    """Rotor speeds of one drone, RPM.

    Positions and velocities are tracked by a controller of `CONTROLLERS`, body rates by the inner loop of `rates`;
    rotor speeds pass unchanged. A velocity command uses the present position as set-point, as the velocity input of
    gym-pybullet-drones does. `dt` is the control period, s.
    """
    flown = CONTROLLERS[controller]
    yaw = rotation.to_rpy(state.quat)[2]
    by_velocity = command.mode == Mode.VELOCITY
    heading = jnp.where(by_velocity, memory.heading + command.yaw_rate * dt, yaw)
    sin, cos = sin_cos(heading)
    forward, left, up = command.vel
    vel = jnp.stack([cos * forward - sin * left, sin * forward + cos * left, up])
    by_position = command.mode == Mode.POSITION
    setpoint = Setpoint.at(
        jnp.where(by_position, command.pos, state.pos),
        vel=jnp.where(by_velocity, vel, 0),
        yaw=jnp.where(by_position, command.yaw, heading),
    )
    kept, to_setpoint = flown.control(flown.gains(), params, memory.controller, state, setpoint, dt=dt)
    to_rates = rates.follow(rates.gains(), params, state, command.thrust, command.omega)
    rpm = jnp.where(command.mode == Mode.RATES, to_rates, to_setpoint)
    return Memory(kept, heading), jnp.where(command.mode == Mode.MOTORS, command.rpm, rpm)
