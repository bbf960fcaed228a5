"""Thrust of moving rotors by momentum theory and blade elements."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdrones import rotation
from jaxdrones.dynamics.rotors import induced_speed, lost_share, thrust
from jaxdrones.params import Params
from jaxdrones.state import State
from jaxdrones.vector import components, cross
from jaxdrones.wrench import Wrench

_NEWTON_STEPS = 3
_STOPPED = 1.0  # RPM; the thrust of a slower rotor is negligible
_STILL = 1e-6  # (m/s)^2; makes the inflow of a resting rotor differentiable


def inflow_thrust(params: Params, state: State) -> Wrench:
    """Change of thrust at constant rotor speed: a loss in climb, a gain in descent or forward flight.

    With U the flow through a moving rotor, and v_h that in hover,

        dF = -s(2 b (U - v_h)) F,  b = inflow_loss hover_rpm / P.

    A blade element loses lift in proportion to the flow through the disc. In a slow climb the induced velocity falls by
    half the climb speed, hence the factor 2: in a climb at w the fraction b w is lost. Beyond one half of the thrust
    the limit s (`lost_share`) keeps thrust positive, and at most doubles it in a fast descent. Forward flight lowers
    the induced velocity (translational lift). The lift of advancing blades is not modeled. Sources:
    Leishman, Principles of Helicopter Aerodynamics, 2006, chapters 2 and 3; Glauert 1926.

    The z component of `drag_coeff` is the same loss, measured on the Crazyflie: set it to zero if you also use `drag`.
    """
    air_velocity = rotation.rotate_inverse(state.quat, state.vel - params.wind)

    def share(rotor: Float[Array, "3"], rpm: Float[Array, ""]) -> Float[Array, ""]:
        x, y, climb = components(air_velocity + cross(state.omega, rotor))
        in_hover = induced_speed(params, rpm)
        loss_per_speed = 2 * params.inflow_loss * params.hover_rpm / jnp.maximum(rpm, _STOPPED)
        return lost_share(loss_per_speed * (flow_through(climb, x**2 + y**2, in_hover) - in_hover))

    return Wrench.of_thrusts(params.rotor_pos, -thrust(params, state) * jax.vmap(share)(params.rotor_pos, state.rpm))


def flow_through(
    climb: Float[Array, ""], edgewise_squared: Float[Array, ""], in_hover: Float[Array, ""]
) -> Float[Array, ""]:
    """Flow U through a rotor of constant thrust, m/s: (U - w) sqrt(V^2 + U^2) = v_h^2, after Glauert.

    For flow from below, U < 0, the square root has V alone: momentum theory has several solutions there, or none
    (vortex ring state), and this solution is smooth. `climb` is w, the speed of the rotor through the air along its
    axis, m/s, negative in descent; V is that in the plane of the disc, and `in_hover` v_h the induced velocity in
    hover, m/s.
    """
    # The solution for V = 0 is exact there and too large elsewhere; as the left side is convex, Newton's steps go down.
    flow = climb / 2 + jnp.sqrt(climb**2 / 4 + in_hover**2 + _STILL)
    for _ in range(_NEWTON_STEPS):
        down = jnp.maximum(flow, 0)
        past = jnp.sqrt(edgewise_squared + down**2 + _STILL)
        induced = flow - climb
        flow = flow - (induced * past - in_hover**2) / (past + induced * down / past)
    return flow
