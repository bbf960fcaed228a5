"""Torques of flapping, of rates and of trim."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import flying

import jaxdrones
from jaxdrones.dynamics.aero import flapping_moment, rate_damping, trim_torque

params = jaxdrones.load_params("cf2x").replace(
    flapping_coeff=jnp.array([1e-7, 8e-8]),
    flapping_climb=jnp.array([0.3, 0.1, 0.2]),
    rate_damping=jnp.array([8e-5, 8e-5, 2e-5]),
    trim_torque=jnp.array([1e-5, -2e-5, 3e-6]),
)
states = flying(jaxdrones.repeat(params, 20))


def level(vel):
    return jax.tree.map(lambda x: x[0], states).replace(quat=jnp.array([0.0, 0, 0, 1]), vel=jnp.array(vel))


@pytest.mark.parametrize(("vel", "axis"), [([1.0, 0, 0], 1), ([0.0, 1, 0], 0)])
def test_a_drone_is_tilted_against_its_motion(vel, axis):
    """Nose up when it flies forward, that is, about -y; left side up when it flies to the left, about +x."""
    torque = flapping_moment(params, level(vel)).torque
    assert torque[axis] * (1 if axis == 0 else -1) > 0
    np.testing.assert_array_equal(np.delete(torque, axis), 0)


def test_only_the_velocity_through_the_air_flaps():
    state = level([1.0, 2, 3])
    drifting = params.replace(wind=state.vel)
    np.testing.assert_array_equal(flapping_moment(drifting, state).torque, 0)


def test_a_climb_takes_some_of_the_moment():
    for axis, loss in enumerate((0.3, 0.1)):  # of motion along x and along y
        vel = np.eye(3)[axis]
        still, climbing = (
            abs(flapping_moment(params, level(vel + np.array([0, 0, w]))).torque[1 - axis]) for w in (0.0, 0.5)
        )
        expected = 1 - loss * 0.493 + 0.2 * 0.493**2  # 0.493 = 0.5/sqrt(1 + (0.5/3)^2)
        np.testing.assert_allclose(climbing / still, expected, rtol=1e-3)


def test_damping_takes_energy_from_every_rotation():
    torque = jax.vmap(rate_damping, (None, 0))(params, states).torque
    assert (jnp.sum(torque * states.omega, axis=1) < 0).all()


def test_trim_is_there_whatever_the_drone_does():
    torque = jax.vmap(trim_torque, (None, 0))(params, states).torque
    np.testing.assert_array_equal(torque, jnp.broadcast_to(params.trim_torque, (20, 3)))
