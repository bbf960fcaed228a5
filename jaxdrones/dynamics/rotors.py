"""Rotors: how their speed follows the command, and the wrench they produce (paper, equations 1 to 3)."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdrones.params import Params
from jaxdrones.state import State
from jaxdrones.vector import dot
from jaxdrones.wrench import Wrench


def limited(params: Params, rpm: Float[Array, "4"]) -> Float[Array, "4"]:
    """The nearest speeds at which rotors can turn, RPM: from 0 to `max_rpm`, which may be infinite.

    A rotor does not turn backwards, where the square of its speed would lift all the same. The derivative is zero
    beyond the limits and one on them, so that a gradient finds back from there.
    """
    return jnp.where(rpm < 0, 0, jnp.where(rpm > params.max_rpm, params.max_rpm, rpm))


def instant_rotors(
    params: Params, rpm: Float[Array, "4"], command: Float[Array, "4"]
) -> tuple[Float[Array, "4"], Float[Array, "4"]]:
    """The paper's rotors: the limited command (RPM) acts at once. Returns the speed and its rate, RPM and RPM/s."""
    return limited(params, command), jnp.zeros_like(command)


def lagging_rotors(
    params: Params, rpm: Float[Array, "4"], command: Float[Array, "4"]
) -> tuple[Float[Array, "4"], Float[Array, "4"]]:
    """First-order lag behind the limited command, with separate rise and fall times.

    Returns the speed and its rate, RPM and RPM/s.
    """
    error = limited(params, command) - rpm
    tau = jnp.where(error > 0, params.rotor_rise_time, params.rotor_fall_time)
    return rpm, error / tau


def thrust(params: Params, state: State) -> Float[Array, "4"]:
    """Thrust of each rotor, N along body z: F_i = k_F P_i^2."""
    return params.kf * state.rpm**2


def rotor_wrench(params: Params, state: State) -> Wrench:
    """Thrusts at the rotors and reaction torques about body z: T = sum of spin_i k_T P_i^2."""
    wrench = Wrench.of_thrusts(params.rotor_pos, thrust(params, state))
    yaw_torque = params.km * dot(params.rotor_spin, state.rpm**2)
    zero = jnp.zeros_like(yaw_torque)
    return wrench + Wrench(jnp.zeros_like(wrench.force), jnp.stack([zero, zero, yaw_torque]))
