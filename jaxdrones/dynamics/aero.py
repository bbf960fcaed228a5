"""Drag, ground effect, torques and external forces on one drone; equation numbers are those of Panerati et al. 2021.

`drag` and `ground_effect` are the smooth, physical laws. `drag_world_axes` and `ground_effect_2021` are those of
gym-pybullet-drones (2021), for its figures and its recorded data. Flapping, rate damping and trim are identified from
recorded flights.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdrones import rotation, vector
from jaxdrones.dynamics.model import constants
from jaxdrones.dynamics.needs import Needs, declare
from jaxdrones.dynamics.rotors import drag_speed, thrust
from jaxdrones.params import Params
from jaxdrones.state import State
from jaxdrones.vector import components, safe_sqrt
from jaxdrones.wrench import Wrench

_FLOOR = 1.63  # propeller radii; below this height ground effect levels off, as for the Crazyflie of (2021)
_MOST_CLIMB = 3.0  # m/s, limit of the climb speed in the loss; the identified flights climb at up to 2 m/s


def drag(params: Params, state: State) -> Wrench:
    """Rotor drag, -k_D sum(rotor speed) v with v the velocity relative to the air and k_D along the body axes."""
    air_velocity = rotation.rotate_inverse(state.quat, state.vel - params.wind)
    return Wrench.of_force(-params.drag_coeff * drag_speed(params, state) * air_velocity)


def quadratic_drag(params: Params, state: State) -> Wrench:
    """Drag of the body, -rho/2 A |v| v with v the velocity relative to the air.

    A is `params.aux["drag_area"]`, (3,) m^2: drag coefficient times projected area along each body axis. It adds to the
    rotors' linear `drag`, which dominates below about 5 m/s.
    """
    area = constants(params, "drag_area", "jax.numpy.array([2e-3, 2e-3, 6e-3])")
    air_velocity = rotation.rotate_inverse(state.quat, state.vel - params.wind)
    speed = safe_sqrt(vector.dot(air_velocity, air_velocity))
    return Wrench.of_force(-params.air_density / 2 * area * speed * air_velocity)


def drag_world_axes(params: Params, state: State) -> Wrench:
    """Rotor drag as in gym-pybullet-drones, with the coefficients along the world axes."""
    force = -params.drag_coeff * drag_speed(params, state) * (state.vel - params.wind)
    return Wrench.of_force(rotation.rotate_inverse(state.quat, force))


@declare(Needs(ground_only=True))
def ground_effect(params: Params, state: State, scene: Any = None) -> Wrench:
    """Extra thrust near the ground, smooth and bounded.

    Each rotor gains k_G (r_P / 4)^2 / sqrt(h^4 + h_0^4) of its thrust: equation 5 far above
    h_0 = 1.63 propeller radii, level below. The gain fades with the squared cosine of the tilt and is zero upside down.
    A `scene` without a ground has no ground effect.
    """
    if scene is not None and not scene.ground:
        return Wrench.of_force(jnp.zeros_like(state.pos))
    height = _rotor_heights(params, state)
    floor = _FLOOR * params.prop_radius
    gain = params.ground_effect_coeff * (params.prop_radius / 4) ** 2 / jnp.sqrt(height**4 + floor**4)
    upright = jnp.maximum(rotation.z_axis(state.quat)[2], 0) ** 2
    return Wrench.of_thrusts(params.rotor_pos, upright * gain * thrust(params, state))


@declare(Needs(ground_only=True))
def ground_effect_2021(params: Params, state: State, scene: Any = None) -> Wrench:
    """Equation 5 with the height limited from below, and no effect beyond 90 degrees of roll or pitch.

    A `scene` without a ground has no ground effect.
    """
    if scene is not None and not scene.ground:
        return Wrench.of_force(jnp.zeros_like(state.pos))
    clip = params.prop_radius / 4 * safe_sqrt(15 / 4 * params.ground_effect_coeff)
    height = jnp.maximum(_rotor_heights(params, state), clip)
    above = height > 0  # below the ground there is no clip where the coefficient is zero
    gain = jnp.where(
        above, params.ground_effect_coeff * (params.prop_radius / (4 * jnp.where(above, height, 1))) ** 2, 0
    )
    roll, pitch, _ = rotation.to_rpy(state.quat)
    upright = (jnp.abs(roll) < jnp.pi / 2) & (jnp.abs(pitch) < jnp.pi / 2)
    return Wrench.of_thrusts(params.rotor_pos, jnp.where(upright, gain * thrust(params, state), 0))


def flapping_moment(params: Params, state: State) -> Wrench:
    """Moment of rotors in horizontal flight, from tilted discs and from drag above the center of mass.

    M = sum(rotor speed) (c_y v g_y, -c_x u g_x, 0) with u, v, w the velocity relative to the air along the body axes.
    It pitches the nose up in forward flight. The factor g = 1 - l w + k w^2 depends on the climb speed, as flights
    of the Crazyflie 2.1 brushless show (docs/reality.md).
    """
    u, v, w = components(rotation.rotate_inverse(state.quat, state.vel - params.wind))
    climb = w / safe_sqrt(1 + (w / _MOST_CLIMB) ** 2)
    loss_x, loss_y, gain = components(params.flapping_climb)
    c_x, c_y = components(params.flapping_coeff)
    about_x = c_y * v * (1 - loss_y * climb + gain * climb**2)
    about_y = -c_x * u * (1 - loss_x * climb + gain * climb**2)
    return Wrench.of_torque(drag_speed(params, state) * jnp.stack([about_x, about_y, jnp.zeros_like(u)]))


def rate_damping(params: Params, state: State) -> Wrench:
    """Torque against the angular velocity: a sinking rotor gains thrust, a rising one loses thrust."""
    return Wrench.of_torque(-params.relative_density * params.rate_damping * state.omega)


def trim_torque(params: Params, state: State) -> Wrench:
    """Constant torque `params.trim_torque` of an unbalanced vehicle."""
    return Wrench.of_torque(params.trim_torque)


def external_force(params: Params, state: State) -> Wrench:
    """Force `params.external_force` on the center of mass."""
    return Wrench.of_force(rotation.rotate_inverse(state.quat, params.external_force))


def _rotor_heights(params: Params, state: State) -> Float[Array, "4"]:
    """World z of each rotor, m."""
    up = rotation.z_axis(rotation.conjugate(state.quat))  # the world's z axis in the body frame
    return state.pos[2] + jax.vmap(vector.dot, (0, None))(params.rotor_pos, up)
