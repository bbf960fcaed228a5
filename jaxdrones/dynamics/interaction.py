"""Downwash of one drone on another; equation numbers are those of Panerati et al. 2021."""

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdrones import rotation, vector
from jaxdrones.dynamics.rotors import induced_speed, lost_share, thrust
from jaxdrones.params import Params
from jaxdrones.state import State
from jaxdrones.wrench import Wrench

# Turbulent jet below a hovering multirotor, fitted to 16 h of flight by Bauersfeld et al., RA-L 2024.
_JET_SPEED = 10.11  # center speed over induced speed, at one motor distance per unit of the denominator
_JET_ORIGIN = 5.817  # motor distances from the virtual origin of the jet to the rotors
_JET_WIDTH = 0.07668  # half width over distance from the virtual origin
_JET_SHAPE = math.sqrt(2) - 1

_CUTOFF = 10.0  # m, horizontal cutoff of equation 6 in gym-pybullet-drones (2021)
_MIN_HEIGHT = 0.05  # m; equation 6 grows without bound below
_MIN_WIDTH = 5e-4  # m; equation 6 has no width at a height of 0.6875 m


def downwash(params: Params, state: State, other: Params, other_state: State) -> Wrench:
    """Loss of thrust of the rotors of a drone in the jet of another drone; smooth and bounded.

    The jet is along the other drone's thrust axis. Its speed is proportional to the induced speed U_0 of the other's
    rotors, and falls with the distance z along and r off the axis as
    U(z, r) = U_0 10.11 / (z/l + 5.817) / (1 + (sqrt(2) - 1) (r/w)^2)^2, w = 0.07668 (z + 5.817 l),
    l the distance of neighboring motors; it sets in smoothly within one l below the other drone.
    A rotor loses the fraction `inflow_loss` of its thrust per m/s of flow down its own axis, so a drone halfway in the
    jet tilts; beyond one half of the thrust the loss levels off (`lost_share`). The law is valid from 2.5 l on
    (Bauersfeld et al. 2024); at shorter distances it is an extrapolation.
    """
    per_length = 1 / (jnp.sqrt(2.0) * other.arm)
    own_axes = rotation.axes(state.quat)
    axis = [vector.dot(own, rotation.z_axis(other_state.quat)) for own in own_axes]
    to_other = [vector.dot(own, other_state.pos - state.pos) for own in own_axes]
    speed = vector.total(induced_speed(other, jnp.abs(other_state.rpm))) / 4
    loss = params.inflow_loss * axis[2] * speed

    def share(rotor: Float[Array, "3"]) -> Float[Array, ""]:
        above = [(a - b) * per_length for a, b in zip(to_other, vector.components(rotor), strict=True)]
        z = vector.dot(axis, above)
        return lost_share(loss * _jet(z, vector.dot(above, above) - z**2))

    rotors = zip(vector.components(params.rotor_pos), vector.components(thrust(params, state)), strict=True)
    return Wrench.of_thrusts(params.rotor_pos, [-force * share(rotor) for rotor, force in rotors])


@jax.custom_jvp
def _jet(z: Float[Array, ""], off_axis: Float[Array, ""]) -> Float[Array, ""]:
    """Speed U/U_0 of a jet at the distance z along and the squared distance off its axis, in motor distances."""
    depth, onset = jnp.maximum(z, 0) + _JET_ORIGIN, jnp.clip(z, 0, 1)
    width = (_JET_WIDTH * depth) ** 2
    share = width / (width + _JET_SHAPE * off_axis)
    return _JET_SPEED * share**2 * onset**2 * (3 - 2 * onset) / depth


@_jet.defjvp
def _(at: tuple, change: tuple) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Speed and its change, in terms of the speed: cheaper than derivatives of each term."""
    z, off_axis = at
    depth, onset = jnp.maximum(z, 0) + _JET_ORIGIN, jnp.clip(z, 0, 1)
    width = (_JET_WIDTH * depth) ** 2
    spread = width + _JET_SHAPE * off_axis
    share = width / spread
    rising = _JET_SPEED * share**2 * onset / depth
    speed = rising * onset * (3 - 2 * onset)
    along = jnp.where(z > 0, 6 * rising * (1 - onset) + speed * (3 - 4 * share) / depth, 0)
    return speed, along * change[0] - 2 * _JET_SHAPE * speed / spread * change[1]


def downwash_2021(params: Params, state: State, other: Params, other_state: State) -> Wrench:
    """Equation 6: a force along -z of the lower drone's body, independent of thrusts and attitudes.

    The force of the equation diverges at zero height difference, and its width vanishes at 0.6875 m, so the height
    difference is limited to at least 0.05 m and the width to at least 0.5 mm.
    """
    k1, k2, k3 = other.downwash_coeff
    dx, dy, dz = other_state.pos - state.pos
    height = jnp.maximum(dz, _MIN_HEIGHT)
    off_axis = dx**2 + dy**2
    width = jnp.maximum((k2 * height + k3) ** 2, _MIN_WIDTH**2)
    strength = k1 * (other.prop_radius / (4 * height)) ** 2 * jnp.exp(-off_axis / width / 2)
    strength = jnp.where((dz > 0) & (off_axis < _CUTOFF**2), strength, 0)
    return Wrench.of_force(vector.along_z(-strength))
