"""Newton-Euler equations."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdrones import rotation, vector
from jaxdrones.params import Params
from jaxdrones.state import State
from jaxdrones.wrench import Wrench


def newton_euler(params: Params, state: State, wrench: Wrench) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
    """Linear acceleration (m/s^2, world) and angular acceleration (rad/s^2, body).

    Equations 2 and 3 of Panerati et al. 2021.
    """
    acc = rotation.rotate(state.quat, wrench.force) / params.mass - vector.along_z(params.gravity)
    gyroscopic = vector.cross(state.omega, params.inertia * state.omega)
    return acc, (wrench.torque - gyroscopic) / params.inertia


def quat_rate(state: State) -> Float[Array, "4"]:
    """Time derivative of the attitude, q' = q (omega, 0) / 2."""
    return rotation.multiply(state.quat, jnp.append(state.omega / 2, 0.0))


def specific_force(params: Params, state: State, acc: Float[Array, "3"]) -> Float[Array, "3"]:
    """Specific force R^T (a - g) at the center of mass, m/s^2, body: the reading of an ideal accelerometer.

    Args:
        params: of the drone.
        state: of the drone.
        acc: (3,) acceleration of the center of mass, m/s^2, world: `vel` of the state's derivative.
    """
    return rotation.rotate_inverse(state.quat, acc + vector.along_z(params.gravity))
