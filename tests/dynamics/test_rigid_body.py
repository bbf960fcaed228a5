"""Newton and Euler."""

import jax
import jax.numpy as jnp
import numpy as np
from helpers import flying

import jaxdrones
from jaxdrones import Wrench, rotation
from jaxdrones.dynamics.rigid_body import newton_euler, quat_rate

params = jaxdrones.load_params("cf2x")
team = jaxdrones.repeat(params, 20)
states = flying(team)


def accelerations(wrench):
    return jax.vmap(newton_euler, (None, 0, None))(params, states, wrench)


def test_without_a_wrench_everything_falls():
    acc, _ = accelerations(Wrench.of_force(jnp.zeros(3)))
    np.testing.assert_array_equal(acc, np.tile([0, 0, -9.8], (20, 1)))


def test_a_body_force_accelerates_along_the_attitude():
    force = jnp.array([0.1, -0.2, 0.3])
    acc, _ = accelerations(Wrench.of_force(force))
    expected = jax.vmap(rotation.to_matrix)(states.quat) @ force / params.mass - jnp.array([[0, 0, 9.8]])
    np.testing.assert_allclose(acc, expected, atol=1e-13)


def test_gyroscopic_torque_does_no_work():
    """It is normal to the body rates; 1e-15 of the power that its parts would have."""
    _, omega_rate = accelerations(Wrench.of_force(jnp.zeros(3)))
    power = jnp.sum(states.omega * params.inertia[None] * omega_rate, axis=1)
    parts = jnp.sum(jnp.abs(states.omega * params.inertia[None] * omega_rate), axis=1)
    assert np.all(parts > 0)
    assert np.all(np.abs(power) <= 1e-15 * parts)


def test_gyroscopic_torque_keeps_the_angular_momentum():
    """d/dt (R J omega) = R (J omega' + omega x J omega) = R torque; 1e-12 relative."""
    torque = jnp.array([1e-3, 2e-3, -1e-3])
    _, omega_rate = accelerations(Wrench(jnp.zeros(3), torque))
    momentum = params.inertia[None] * states.omega
    change = params.inertia[None] * omega_rate + np.cross(states.omega, momentum)
    np.testing.assert_allclose(change, np.tile(torque, (20, 1)), rtol=1e-12)


def test_the_attitude_rate_is_the_rate_of_the_exponential():
    def turned(t):
        return jax.vmap(lambda q, w: rotation.multiply(q, rotation.exp(w * t)))(states.quat, states.omega)

    rate, expected = jax.jit(lambda: (jax.vmap(quat_rate)(states), jax.jvp(turned, (0.0,), (1.0,))[1]))()
    np.testing.assert_allclose(rate, expected, atol=1e-14)
