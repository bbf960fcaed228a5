"""Torques identified from recorded flights: flapping, rate damping, trim."""

import jax.numpy as jnp

from jaxdrones import rotation
from jaxdrones.dynamics.rotors import drag_speed
from jaxdrones.params import Params
from jaxdrones.state import State
from jaxdrones.vector import components, safe_sqrt
from jaxdrones.wrench import Wrench

_MOST_CLIMB = 3.0  # m/s, limit of the climb speed in the loss; the identified flights climb at up to 2 m/s


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
