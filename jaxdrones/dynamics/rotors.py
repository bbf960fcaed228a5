"""Rotor speeds and rotor wrenches (Panerati et al. 2021, equations 1 to 3)."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdrones.params import AIR_DENSITY, Params
from jaxdrones.state import State
from jaxdrones.vector import along_z, components, dot, total
from jaxdrones.wrench import Wrench

_RADIANS_PER_SECOND = 2 * jnp.pi / 60  # per RPM


def limited(params: Params, rpm: Float[Array, "4"]) -> Float[Array, "4"]:
    """Rotor speeds limited to 0 .. `max_rpm`, RPM; `max_rpm` may be infinite.

    Rotors do not turn backwards. The derivative is zero beyond the limits and one on them, so gradient descent can
    leave the limits.
    """
    return jnp.where(rpm < 0, 0, jnp.where(rpm > params.max_rpm, params.max_rpm, rpm))


def instant_rotors(
    params: Params, state: State, command: Float[Array, "4"]
) -> tuple[Float[Array, "4"], Float[Array, "4"]]:
    """Rotors without lag. Returns their speed and its rate, RPM and RPM/s."""
    return limited(params, command), jnp.zeros_like(command)


def lagging_rotors(
    params: Params, state: State, command: Float[Array, "4"]
) -> tuple[Float[Array, "4"], Float[Array, "4"]]:
    """Rotors with a first-order lag, with different time constants up and down.

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
    """Induced speed of a rotor in hover by momentum theory, sqrt(F / (2 rho A)), m/s.

    It is independent of the air density, as thrust is proportional to it.
    """
    area = jnp.pi * params.prop_radius**2
    return rpm * jnp.sqrt(params.kf / (2 * AIR_DENSITY * area))


def lost_share(loss: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Limited loss of thrust as a fraction, given that of the linear blade-element law; negative for a gain.

    Up to one half it is linear. Beyond, where blades stall, it tends smoothly to one: thrust stays positive and at most
    doubles. The form of this limit is an assumption.
    """
    beyond = 1 - jnp.exp(-jnp.maximum(2 * jnp.abs(loss) - 1, 0))
    return jnp.clip(loss, -0.5, 0.5) + jnp.sign(loss) * beyond / 2


def rotor_wrench(params: Params, state: State) -> Wrench:
    """Aerodynamic wrench of the rotors: their thrusts and drag torques, T = sum of spin_i k_T P_i^2 about body z."""
    drag_torque = params.relative_density * params.km * dot(params.rotor_spin, state.rpm**2)
    return Wrench.of_thrusts(params.rotor_pos, thrust(params, state)) + Wrench.of_torque(along_z(drag_torque))


def rotor_reaction(params: Params, state: State, rpm_rate: Float[Array, "4"]) -> Wrench:
    """Reaction torque of the rotors on the body, -h' - omega x h.

    h is the angular momentum of the rotors relative to the body, along its z axis.
    """
    x, y, _ = components(state.omega)
    h, h_rate = angular_momentum(params, state.rpm), angular_momentum(params, rpm_rate)
    return Wrench.of_torque(jnp.stack([-y * h, x * h, -h_rate]))


def angular_momentum(params: Params, rpm: Float[Array, "4"]) -> Float[Array, ""]:
    """Angular momentum of the rotors relative to the body, about body z, kg m^2/s.

    A rotor turns against its drag torque on the body. The function is linear: RPM/s give the rate.
    """
    return dot(-params.rotor_inertia * _RADIANS_PER_SECOND * params.rotor_spin, rpm)


def with_rotor_speed(params: Params, state: State, rpm: Float[Array, "4"]) -> State:
    """State after an instant change of rotor speed, with the total angular momentum conserved."""
    change = angular_momentum(params, rpm - state.rpm)
    _, _, inertia = components(params.inertia)
    return state.replace(rpm=rpm, omega=state.omega - along_z(change / inertia))
