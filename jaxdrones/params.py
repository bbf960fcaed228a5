"""Constants of a vehicle and of the air around it."""

from collections.abc import Sequence
from typing import Annotated, Any

import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxdrones.arguments import checked, whole
from jaxdrones.checks import check_params, check_shape, check_whole, short_repr
from jaxdrones.errors import UserError
from jaxdrones.pytree import PyTreeNode
from jaxdrones.vector import safe_sqrt

AIR_DENSITY = 1.225
"""Air density of the rotor coefficients, kg/m^3: standard atmosphere at sea level. Their sources do not state it;
in a laboratory it is within a few percent."""


class Params(PyTreeNode):
    """Constants of one drone, or of a team with a leading drone axis on every array.

    Wind, air density and an external force are included, and can change at every step.
    """

    mass: Array
    """() kg."""
    inertia: Array
    """(3,) principal moments about the body axes, kg m^2."""
    rotor_pos: Array
    """(4, 3) rotor positions, m, body."""
    rotor_spin: Array
    """(4,) +1 or -1: sign of the reaction torque on the body about its z axis."""
    kf: Array
    """() thrust coefficient in air of `AIR_DENSITY`, N/RPM^2."""
    km: Array
    """() torque coefficient in air of `AIR_DENSITY`, N m/RPM^2."""
    max_rpm: Array
    """() highest rotor speed, RPM, independent of the mass. Infinity for motors without a limit."""
    rotor_rise_time: Array
    """() time constant of a lagging rotor when speeding up, s."""
    rotor_fall_time: Array
    """() time constant of a lagging rotor when slowing down, s."""
    rotor_inertia: Array
    """() moment of inertia of one rotor about its axis, kg m^2. Zero disables gyroscopic and reaction torques."""
    gravity: Array
    """() acceleration towards -z, m/s^2."""
    air_density: Array
    """() kg/m^3; thrust, torque and drag of the rotors are proportional to it, and zero in a vacuum."""
    wind: Array
    """(3,) velocity of the air, m/s, world."""
    external_force: Array
    """(3,) force on the center of mass, N, world; acts through the effect `external_force`."""
    drag_coeff: Array
    """(3,) rotor drag per axis in air of `AIR_DENSITY`, N per m/s of air speed and rad/s of summed rotor speed."""
    flapping_coeff: Array
    """(2,) moment of rotors moving along body x and y, N m per m/s of air speed and rad/s of summed rotor speed."""
    flapping_climb: Array
    """(3,) share of that moment lost per m/s of climb, along x and y, s/m; share gained per its square, s^2/m^2."""
    rate_damping: Array
    """(3,) torque against the angular velocity, N m per rad/s, body."""
    trim_torque: Array
    """(3,) constant torque of an unbalanced vehicle, N m, body."""
    ground_effect_coeff: Array
    """() k_G of equation 5 of Panerati et al. 2021."""
    downwash_coeff: Array
    """(3,) k_D1 (N), k_D2, k_D3 (m) of equation 6 of Panerati et al. 2021."""
    inflow_loss: Array
    """() share of a rotor's thrust lost per m/s of downwash through it, s/m; below one half of the thrust."""
    prop_radius: Array
    """() radius of the propellers, m."""
    max_speed: Array
    """() highest speed of the vehicle, m/s."""
    collision_radius: Array
    """() radius of the collision cylinder, m."""
    collision_height: Array
    """() height of the collision cylinder, m."""
    collision_offset: Array
    """() height of the cylinder's center above the center of mass, m."""
    aux: dict[str, Any] = flax.struct.field(default_factory=dict)
    """Constants of further models by name: pytrees of arrays."""

    @property
    def weight(self) -> Array:
        """() m g, N."""
        return self.mass * self.gravity

    @property
    def arm(self) -> Array:
        """() mean horizontal distance of a rotor from the center of mass, m."""
        return jnp.mean(jnp.sqrt(jnp.sum(self.rotor_pos[..., :2] ** 2, axis=-1)), axis=-1)

    @property
    def relative_density(self) -> Array:
        """() air density relative to that of the rotor coefficients, 1.225 kg/m^3."""
        return self.air_density / AIR_DENSITY

    @property
    def hover_rpm(self) -> Array:
        """() rotor speed in hover, RPM.

        This and the following limits are for air of `AIR_DENSITY`. Like the controllers they are independent of
        `air_density`, which is unknown to a vehicle; in other air it hovers at this speed over the square root of
        `relative_density`.
        """
        return safe_sqrt(self.weight / (4 * self.kf))

    @property
    def max_thrust(self) -> Array:
        """() total thrust of the four rotors at full speed, N."""
        return 4 * self.kf * self.max_rpm**2

    @property
    def max_xy_torque(self) -> Array:
        """() largest roll torque: the rotors on one side at full speed, the others at rest, N m."""
        return self.kf * self.max_rpm**2 * jnp.sum(jnp.abs(self.rotor_pos[..., 1]), axis=-1) / 2

    @property
    def max_z_torque(self) -> Array:
        """() largest yaw torque: two rotors at full speed, the others at rest, N m."""
        return 2 * self.km * self.max_rpm**2


def stack(team: Sequence[Params]) -> Params:
    """Stack drones to a team, with a leading drone axis on every array.

    Raises:
        ValueError: an empty sequence, a member that is already a team or cannot fly, or members with other constants in
            `aux`.
    """
    check_whole("number of drones", len(team))
    for i, params in enumerate(team):
        check_single(f"mass of drone {i}", params, "stack takes the parameters of single drones")
        given, wanted = _aux_shapes(params), _aux_shapes(team[0])
        if given != wanted:
            raise UserError(
                f"aux of drone {i} has {given or 'nothing'}, and that of drone 0 {wanted or 'nothing'}; give all "
                "drones the same constants, with values that have no effect where a drone does not need them"
            )
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *map(_real, team))


@checked
def repeat(params: Params, n: Annotated[int, whole("number of drones")]) -> Params:
    """Team of `n` equal drones.

    Raises:
        ValueError: `n` < 1, or `params` is already a team or cannot fly.
    """
    check_single("mass", params, "repeat takes the parameters of a single drone")
    return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (n, *jnp.shape(leaf))), _real(params))


def _aux_shapes(params: Params) -> str:
    leaves = jax.tree_util.tree_leaves_with_path(params.aux)
    return ", ".join(f"{jax.tree_util.keystr(path)} {jnp.shape(leaf)}" for path, leaf in leaves)


def _real(params: Params) -> Params:
    """Parameters with real numbers in place of whole ones, such as `mass=1`, except for `aux`."""
    fields = jax.tree.map(lambda x: jnp.asarray(x, jnp.result_type(x, 1.0)), params.replace(aux={}))
    return fields.replace(aux=params.aux)


def check_single(name: str, params: Params, meaning: str) -> None:
    """Raise unless these are the parameters of one drone that can fly; `meaning` is for the message."""
    if not isinstance(params, Params):
        raise UserError(f"{short_repr(params)} is given; {meaning}, for example of jaxdrones.load_params")
    check_params(params)
    check_shape(name, params.mass, (), meaning)
