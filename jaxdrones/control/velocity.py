"""Velocity input of gym-pybullet-drones (2021): direction and fraction of a speed limit, tracked by the PID."""

from typing import Annotated

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdrones import rotation, vector
from jaxdrones.arguments import TimeStep, checked, shape
from jaxdrones.control import pid
from jaxdrones.control.setpoint import Setpoint
from jaxdrones.control.single import Finite, OneParams, OneState
from jaxdrones.params import Params
from jaxdrones.state import State

SPEED_SHARE = 0.03  # speed at magnitude 1 over the vehicle's highest speed
_OF_ONE = shape(4, meaning="direction and magnitude of one drone; use jax.vmap for a team")


@checked
def control(
    gains: Finite[pid.Gains],
    params: OneParams,
    memory: pid.Memory,
    state: OneState,
    action: Annotated[Float[Array, "4"], _OF_ONE],
    *,
    dt: TimeStep,
) -> tuple[pid.Memory, Float[Array, "4"]]:
    """Rotor speeds of one drone by the PID, RPM; see `jaxdrones.control`.

    The action (4,) is a direction x, y, z of any length, and a magnitude: the fraction of the speed limit, sign
    ignored. The position target is the position of the drone and the yaw target its heading, so only the velocity error
    acts.
    """
    return pid.control(gains, params, memory, state, setpoint(params, state, action), dt=dt)


def setpoint(params: Params, state: State, action: Float[Array, "4"]) -> Setpoint:
    """Setpoint of an action: position and heading of the drone, and commanded velocity."""
    return Setpoint.at(state.pos, vel=commanded(params, action), yaw=rotation.to_rpy(state.quat)[2])


def commanded(params: Params, action: Float[Array, "4"]) -> Float[Array, "3"]:
    """Commanded velocity of an action, m/s, world."""
    return SPEED_SHARE * params.max_speed * jnp.abs(action[3]) * vector.unit(action[:3])
