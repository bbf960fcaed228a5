"""Rotors: how their speed follows the command, and the wrenches they produce (paper, equations 1 to 3)."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdrones.params import AIR_DENSITY, Params
from jaxdrones.state import State
from jaxdrones.vector import along_z, components, dot, total
from jaxdrones.wrench import Wrench

_RADIANS_PER_SECOND = 2 * jnp.pi / 60  # per RPM


def limited(params: Params, rpm: Float[Array, "4"]) -> Float[Array, "4"]:
    """The nearest speeds at which rotors can turn, RPM: from 0 to `max_rpm`, which may be infinite.

    A rotor does not turn backwards, where the square of its speed would lift all the same. The derivative is zero
    beyond the limits and one on them, so that a gradient finds back from there.
    """
    return jnp.where(rpm < 0, 0, jnp.where(rpm > params.max_rpm, params.max_rpm, rpm))


def instant_rotors(
    params: Params, state: State, command: Float[Array, "4"]
) -> tuple[Float[Array, "4"], Float[Array, "4"]]:
    """Rotors that take the limited command at once (paper). Returns their speed and its rate, RPM and RPM/s."""
    return limited(params, command), jnp.zeros_like(command)


def lagging_rotors(
    params: Params, state: State, command: Float[Array, "4"]
) -> tuple[Float[Array, "4"], Float[Array, "4"]]:
    """Rotors that follow the limited command by a first-order lag, with time constants of their own up and down.

    Returns their speed and its rate, RPM and RPM/s.
    """
    error = limited(params, command) - state.rpm
    time_constant = jnp.where(error > 0, params.rotor_rise_time, params.rotor_fall_time)
    return state.rpm, error / time_constant


def thrust(params: Params, state: State) -> Float[Array, "4"]:
    """Thrust of each rotor, N along body z: F_i = k_F P_i^2, times the relative density of the air."""
    return params.relative_density * params.kf * state.rpm**2


def drag_speed(params: Params, state: State) -> Float[Array, ""]:
    """Sum of the four rotor speeds, rad/s, times the relative density of the air; rotor drag is proportional to it."""
    return params.relative_density * _RADIANS_PER_SECOND * total(state.rpm)


def induced_speed(params: Params, rpm: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Speed of the air through a rotor in hover by momentum theory, sqrt(F / (2 rho A)), m/s.

    It does not depend on the density of the air, to which thrust is proportional.
    """
    area = jnp.pi * params.prop_radius**2
    return rpm * jnp.sqrt(params.kf / (2 * AIR_DENSITY * area))


def lost_share(loss: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Share of the thrust that a rotor loses, from the linear law of blade elements; negative for a gain.

    Up to one half it is the linear law's. Beyond, where blades stall, it tends smoothly to one: thrust stays positive,
    and does not grow to more than twice its value. The form of this limit is an assumption.
    """
    beyond = jnp.exp(-jnp.maximum(-2 * loss - 1, 0)) - jnp.exp(-jnp.maximum(2 * loss - 1, 0))
    return jnp.clip(loss, -0.5, 0.5) + beyond / 2


def rotor_wrench(params: Params, state: State) -> Wrench:
    """Aerodynamic wrench of the rotors: their thrusts and drag torques, T = sum of spin_i k_T P_i^2 about body z."""
    drag_torque = params.relative_density * params.km * dot(params.rotor_spin, state.rpm**2)
    return Wrench.of_thrusts(params.rotor_pos, thrust(params, state)) + Wrench.of_torque(along_z(drag_torque))


def rotor_reaction(params: Params, state: State, rpm_rate: Float[Array, "4"]) -> Wrench:
    """Torque of the spinning rotors on the body: -h' of rotors that change speed, -omega x h of a body that turns.

    h is the angular momentum of the rotors relative to the body, along its z axis.
    """
    x, y, _ = components(state.omega)
    h, h_rate = angular_momentum(params, state.rpm), angular_momentum(params, rpm_rate)
    return Wrench.of_torque(jnp.stack([-y * h, x * h, -h_rate]))


def angular_momentum(params: Params, rpm: Float[Array, "4"]) -> Float[Array, ""]:
    """Angular momentum of the rotors relative to the body, about body z, kg m^2/s.

    A rotor turns against the torque that its drag exerts on the body. Linear: of RPM/s it is the rate.
    """
    return dot(-params.rotor_inertia * _RADIANS_PER_SECOND * params.rotor_spin, rpm)


def with_rotor_speed(params: Params, state: State, rpm: Float[Array, "4"]) -> State:
    """The state after the rotors have taken another speed at once; the body keeps the angular momentum of both."""
    change = angular_momentum(params, rpm - state.rpm)
    _, _, inertia = components(params.inertia)
    return state.replace(rpm=rpm, omega=state.omega - along_z(change / inertia))
