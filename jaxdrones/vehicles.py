"""Random realistic quadrotors of 20 g to 3 kg: a random mass, and scaling laws for the other parameters.

A scaling law gives the median for a vehicle of this mass. A random parameter is the median times a log-normal factor,
truncated to the range of published vehicles. Medians, spreads and limits are those of a regression over 13 published
airframes of 31 g to 3.35 kg; tests/test_any_vehicle.py has the table with its sources and repeats the regression. The
laws have these forms:

- mass: its logarithm is uniform, so that light and heavy vehicles are equally frequent. RAPTOR (rl-tools, l2f,
  `sample_initial_parameters`), whose ranges of thrust-to-weight ratio and of lag are used, draws its cube root.
- arm: a power of the mass, by regression; it would be the cube root for geometrically similar vehicles.
- inertia: m l^2 times a number, limited from below by the largest angular acceleration; I_zz is nearly I_xx + I_yy, the
  value of a flat body (perpendicular axis theorem).
- thrust: C_T rho n^2 D^4 of a propeller that fits between the arms.
- torque: momentum theory of hover, power T sqrt(T / (2 rho A)) over a figure of merit.
- drag: proportional to thrust and to air speed over tip speed, the form of blade flapping and induced drag (Mahony,
  Kumar and Corke 2012), so that drag per rotor speed is c k_F / R.
- lag: it falls with the thrust-to-weight ratio, by regression.
- maximum speed: sqrt(g l), Froude scaling (Kushleyev, Mellinger, Powers and Kumar 2013).
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxdrones.checks import check_number
from jaxdrones.errors import UserError
from jaxdrones.params import AIR_DENSITY, Params
from jaxdrones.urdf import GRAVITY

LIGHTEST, HEAVIEST = 0.02, 3.0  # kg
_RADIANS_PER_SECOND = 2 * np.pi / 60  # per RPM
_CORNERS = np.array([[1.0, -1, 0], [-1, -1, 0], [-1, 1, 0], [1, 1, 0]])  # signs of rotors 0 to 3, as in the Crazyflie
_SPINS = np.array([-1.0, 1, -1, 1])


class Law(NamedTuple):
    """Truncated log-normal distribution of a parameter about the median of its scaling law."""

    median: float
    spread: float
    """Standard deviation of the logarithm."""
    low: float
    high: float
    """Limits, in the unit of `median`."""


LAWS = {
    "arm": Law(0.188, 0.148, 0.139, 0.235),  # m at 1 kg, times kg^-0.423
    "inertia": Law(0.208, 0.247, 0.142, 0.351),  # mean of I_xx and I_yy over m l^2
    "elongation": Law(1.0, 0.173, 0.641, 1.371),  # I_yy / I_xx
    "flatness": Law(0.910, 0.050, 0.795, 0.959),  # I_zz / (I_xx + I_yy)
    "aspect": Law(1.0, 0.1, 0.87, 1.15),  # rotors' y over x; the propellers stay clear of each other
    "thrust_to_weight": Law(2.87, 0.281, 1.5, 5.0),  # at 1 kg, times kg^-0.143; limits of RAPTOR
    "prop_radius": Law(0.553, 0.079, 0.508, 0.638),  # over the arm
    "thrust_coefficient": Law(0.106, 0.327, 0.066, 0.179),  # C_T
    "figure_of_merit": Law(0.390, 0.290, 0.252, 0.635),
    "drag": Law(2.36, 0.235, 1.72, 3.69),  # times k_F / R
    "vertical_drag": Law(1.55, 0.304, 1.14, 2.72),  # along z over that along x and y
    "rise_time": Law(0.147, 0.427, 0.03, 0.10),  # s at thrust to weight 1, times its power -1.07; limits of RAPTOR
    "fall_time": Law(1.09, 0.268, 0.788, 2.0),  # over the rise time; at least 0.03 s, as in RAPTOR
    "rotor_inertia": Law(1.60e-3, 0.232, 1.18e-3, 2.06e-3),  # over m R^2
}
ARM_POWER, THRUST_POWER, LAG_POWER = 0.423, 0.143, -1.07
_SHORTEST_LAG = 0.03  # s
_MAX_ACCELERATION = 1200.0  # rad/s^2: arm times the thrust of a rotor over the inertia; limit of RAPTOR
_FROUDE = 12.0  # maximum speed over sqrt(g l): 8 to 17 for the bundled vehicles
_COLLISION_HEIGHT = 0.5  # over the collision radius, about that of the bundled vehicles
_DOWNWASH_LOSS = 0.07 * 35.0  # `inflow_loss` of the Crazyflie times the speed of its blade tips

Vary = Callable[..., Array]


def draw(
    key: jax.Array, params: Params, lightest: float = LIGHTEST, heaviest: float = HEAVIEST, light: float = 1.0
) -> Params:
    """Random quadrotor; gravity, air, wind, external force and `aux` are those of `params`, of one drone.

    The ground effect is that of Cheeseman and Bennett; the downwash of equation 6 is off. `lightest` and `heaviest` are
    the smallest and the largest mass, kg. The position of the logarithm of the mass in its range is u**light with a
    uniform u: a `light` above 1 draws more light vehicles.

    Raises:
        ValueError: masses outside 20 g to 3 kg, or the lightest is not first.
    """
    check_masses(lightest, heaviest)
    dtype = params.mass.dtype
    mass_key, *keys = jax.random.split(key, len(LAWS) + 1)
    key_of = dict(zip(LAWS, keys, strict=True))
    where = jax.random.uniform(mass_key, (), dtype) ** light
    mass = lightest * (heaviest / lightest) ** where

    def vary(name: str, median: Array, low: Array, high: Array) -> Array:
        spread = LAWS[name].spread
        ends = jnp.log(low / median) / spread, jnp.log(high / median) / spread
        return median * jnp.exp(spread * jax.random.truncated_normal(key_of[name], *ends, (), dtype))

    return _vehicle(params, mass, vary)


def median(params: Params, lightest: float = LIGHTEST, heaviest: float = HEAVIEST) -> Params:
    """Quadrotor of the median mass with the medians of the scaling laws; arguments and errors as for `draw`."""
    check_masses(lightest, heaviest)
    mass = jnp.asarray(np.sqrt(lightest * heaviest), params.mass.dtype)
    return _vehicle(params, mass, lambda name, median, low, high: jnp.clip(median, low, high))


def largest_radius(heaviest: float) -> float:
    """Largest collision radius of a random vehicle of up to a mass (kg), m."""
    return LAWS["arm"].high * heaviest**ARM_POWER * (1 + LAWS["prop_radius"].high)


def check_masses(lightest: float, heaviest: float) -> None:
    """Raise unless the scaling laws hold for these masses and the lightest is first."""
    for name, mass in ("lightest", lightest), ("heaviest", heaviest):
        check_number(f"mass of the {name} vehicle", mass, "kg", at_least=LIGHTEST, at_most=HEAVIEST)
    if not lightest <= heaviest:
        raise UserError(f"the masses are {lightest} to {heaviest} kg; give the lightest first")


def _vehicle(params: Params, mass: Array, vary: Vary) -> Params:
    """Quadrotor of a mass; `vary(name, median, low, high)` returns a parameter near its median."""

    def by_law(name: str, scale: Array | float = 1.0) -> Array:
        law = LAWS[name]
        scale = jnp.asarray(scale, mass.dtype)
        return vary(name, scale * law.median, scale * law.low, scale * law.high)

    def within(name: str, scale: Array, low: Array | float, high: Array | float) -> Array:
        ends = (jnp.asarray(end, mass.dtype) for end in (low, high))
        return vary(name, scale * LAWS[name].median, *ends)

    arm = by_law("arm", mass**ARM_POWER)
    radius = by_law("prop_radius", arm)
    angle = jnp.arctan(by_law("aspect"))
    place = arm * jnp.stack([jnp.cos(angle), jnp.sin(angle), jnp.zeros_like(arm)])
    rotor_pos = place[None] * jnp.asarray(_CORNERS, arm.dtype)

    _, _, low, high = LAWS["thrust_to_weight"]
    thrust_to_weight = within("thrust_to_weight", mass**THRUST_POWER, low, high)
    _, _, low, high = LAWS["inertia"]
    elongation, slender = by_law("elongation"), mass * arm**2
    torque = arm * thrust_to_weight * mass * GRAVITY / 4
    least = jnp.maximum(low * slender, (1 + elongation) / 2 * torque / _MAX_ACCELERATION)
    across = within("inertia", slender, least, high * slender)
    roll = 2 * across / (1 + elongation)
    inertia = jnp.stack([roll, elongation * roll, 2 * across * by_law("flatness")])

    coefficient = by_law("thrust_coefficient")
    kf = coefficient * AIR_DENSITY * (2 * radius) ** 4 / 3600  # N/RPM^2
    weight = mass * GRAVITY / 4  # on one rotor
    hover_rpm = jnp.sqrt(weight / kf)
    induced = jnp.sqrt(weight / (2 * AIR_DENSITY * jnp.pi * radius**2))  # m/s, through the rotors in hover
    tip_speed = _RADIANS_PER_SECOND * hover_rpm * radius
    torque_over_thrust = radius * induced / tip_speed / by_law("figure_of_merit")  # m; the same at every rotor speed

    _, _, low, high = LAWS["rise_time"]
    rise_time = within("rise_time", thrust_to_weight**LAG_POWER, low, high)
    law = LAWS["fall_time"]
    fall_time = within("fall_time", rise_time, jnp.maximum(law.low * rise_time, _SHORTEST_LAG), law.high * rise_time)

    drag = by_law("drag", kf / (_RADIANS_PER_SECOND**2 * radius))
    collision_radius = arm + radius
    zero, one = jnp.zeros_like(mass), jnp.ones_like(mass)
    return params.replace(
        mass=mass,
        inertia=inertia,
        rotor_pos=rotor_pos,
        rotor_spin=jnp.asarray(_SPINS, mass.dtype),
        kf=kf,
        km=torque_over_thrust * kf,
        max_rpm=jnp.sqrt(thrust_to_weight) * hover_rpm,
        rotor_rise_time=rise_time,
        rotor_fall_time=fall_time,
        rotor_inertia=by_law("rotor_inertia", mass * radius**2),
        drag_coeff=drag * jnp.stack([one, one, by_law("vertical_drag")]),
        ground_effect_coeff=one,
        downwash_coeff=jnp.stack([zero, zero, one]),
        inflow_loss=_DOWNWASH_LOSS / tip_speed,
        prop_radius=radius,
        max_speed=_FROUDE * jnp.sqrt(GRAVITY * arm),
        collision_radius=collision_radius,
        collision_height=_COLLISION_HEIGHT * collision_radius,
        collision_offset=zero,
    )
