"""Thrust of rotors that move through the air: momentum theory and blade elements."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdrones import rotation
from jaxdrones.params import Params
from jaxdrones.state import State
from jaxdrones.vector import components, cross
from jaxdrones.wrench import Wrench

_NEWTON_STEPS = 3
_STILL = 1e-6  # (m/s)^2; rounds off the inflow of a rotor that neither turns nor moves


def inflow_thrust(params: Params, state: State) -> Wrench:
    """Thrust that rotors lose when they climb, and gain when they sink or fly forward, at the same speed.

    With U the flow through a rotor that moves through the air and v_h that in hover,

        dF = -2 b F (U - v_h),  b = inflow_loss hover_rpm / P.

    A blade element loses lift in proportion to the flow through the disc. Half of a slow climb is taken up by the
    smaller induced velocity, hence the 2: in a climb at w the loss is the share b w. Forward flight lowers the induced
    velocity, which is translational lift. Sources: Leishman, Principles of Helicopter Aerodynamics, 2006, chapters 2
    and 3; Glauert 1926. What the blades gain by advancing is left out.

    The part along z of `drag_coeff` is the same loss as it was measured on the Crazyflie: with `drag` set it to zero.
    """
    air_velocity = rotation.rotate_inverse(state.quat, state.vel - params.wind)
    area = jnp.pi * params.prop_radius**2

    def change(rotor: Float[Array, "3"], rpm: Float[Array, ""]) -> Float[Array, ""]:
        x, y, climb = components(air_velocity + cross(state.omega, rotor))
        in_hover = rpm * jnp.sqrt(params.kf / (2 * params.air_density * area))
        loss_per_speed = 2 * params.inflow_loss * params.hover_rpm * params.kf * rpm
        return -loss_per_speed * (flow_through(climb, x**2 + y**2, in_hover) - in_hover)

    return Wrench.of_thrusts(params.rotor_pos, jax.vmap(change)(params.rotor_pos, state.rpm))


def flow_through(
    climb: Float[Array, ""], edgewise_squared: Float[Array, ""], in_hover: Float[Array, ""]
) -> Float[Array, ""]:
    """Speed U of the air through a rotor of constant thrust, m/s: (U - w) sqrt(V^2 + U^2) = v_h^2, after Glauert.

    Where the air comes from below, U < 0, its part of the flow past the disc is left out: momentum theory has several
    solutions there, or none (vortex ring), and this one is smooth.

    Args:
        climb: w, speed of the rotor through the air along its axis, m/s; negative when it sinks.
        edgewise_squared: V^2, square of its speed in the plane of the disc, (m/s)^2.
        in_hover: v_h, induced velocity in hover, m/s.
    """
    # The solution for V = 0 is exact there and too large elsewhere; as the left side is convex, Newton's steps go down.
    flow = climb / 2 + jnp.sqrt(climb**2 / 4 + in_hover**2 + _STILL)
    for _ in range(_NEWTON_STEPS):
        down = jnp.maximum(flow, 0)
        past = jnp.sqrt(edgewise_squared + down**2 + _STILL)
        induced = flow - climb
        flow = flow - (induced * past - in_hover**2) / (past + induced * down / past)
    return flow
