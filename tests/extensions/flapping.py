"""Blade flapping: the rotor disc tilts away from the air that comes from the side, with a first-order lag."""

import jax.numpy as jnp

import jaxdrones as jd

ANGLE_PER_SPEED = 0.015  # rad per m/s, of the steady tilt
TIME_CONSTANT = 0.03  # s
HUB_STIFFNESS = 2e-3  # N m/rad, of all hubs together


def flapping() -> jd.Model:
    """`state.aux["flapping"]`: tilt of the rotor disc of one drone, (2,), along body x and y, rad."""
    return jd.Model("flapping", init=lambda params: jnp.zeros(2), rate=_rate)


def tilted_thrust(params, state):
    """The thrust leans with the disc, against the motion, and the hubs turn the body with it."""
    x, y = state.aux["flapping"]
    thrust = params.kf * jnp.sum(state.rpm**2)
    force = -thrust * jnp.stack([jnp.sin(x), jnp.sin(y), 2 - jnp.cos(x) - jnp.cos(y)])
    return jd.Wrench(force, HUB_STIFFNESS * jnp.stack([y, -x, jnp.zeros_like(x)]))


def _rate(params, state, command):
    air = jd.rotation.rotate_inverse(state.quat, state.vel - params.wind)
    return (ANGLE_PER_SPEED * air[:2] - state.aux["flapping"]) / TIME_CONSTANT
