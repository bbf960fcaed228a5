import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_finite

from jaxdrones import rotation
from jaxdrones.control import attitude


@jax.jit
def from_thrust(force, yaw):
    return jnp.stack(attitude.from_thrust(force, yaw), axis=-1)


gradients = jax.jit(jax.jacrev(from_thrust, argnums=(0, 1)))


def directions(n, seed=0):
    rng = np.random.default_rng(seed)
    return jnp.asarray(rng.normal(size=(n, 3))), jnp.asarray(rng.uniform(-np.pi, np.pi, n))


def test_the_attitude_of_a_thrust_is_a_rotation_with_z_along_it():
    force, yaw = directions(50)
    r = jax.vmap(from_thrust)(force, yaw)
    np.testing.assert_allclose(jnp.swapaxes(r, 1, 2) @ r, np.broadcast_to(np.eye(3), (50, 3, 3)), rtol=0, atol=1e-13)
    np.testing.assert_allclose(jnp.linalg.det(r), 1, rtol=0, atol=1e-13)
    along = force / jnp.linalg.norm(force, axis=1, keepdims=True)
    np.testing.assert_allclose(r[:, :, 2], along, rtol=0, atol=1e-13)


def test_body_x_is_as_near_to_the_heading_as_it_can_be():
    """Of all vectors at right angles to the thrust the nearest is the projection of the heading."""
    force, yaw = directions(50)
    r = jax.vmap(from_thrust)(force, yaw)
    heading = jnp.stack([jnp.cos(yaw), jnp.sin(yaw), jnp.zeros_like(yaw)], axis=1)
    in_plane = heading - jnp.sum(heading * r[:, :, 2], axis=1, keepdims=True) * r[:, :, 2]
    nearest = in_plane / jnp.linalg.norm(in_plane, axis=1, keepdims=True)
    np.testing.assert_allclose(r[:, :, 0], nearest, rtol=0, atol=1e-12)


def test_a_thrust_straight_up_gives_a_level_attitude_with_that_yaw():
    yaw = jnp.array(0.7)
    level = rotation.to_matrix(rotation.from_rpy(jnp.array([0, 0, 0.7])))
    np.testing.assert_allclose(from_thrust(jnp.array([0, 0, 3.0]), yaw), level, rtol=0, atol=1e-15)


def test_turning_force_and_heading_turns_the_attitude():
    force, yaw = directions(20)
    turn = rotation.to_matrix(rotation.from_rpy(jnp.array([0, 0, 1.2])))
    turned = jax.vmap(from_thrust)(force @ turn.T, yaw + 1.2)
    np.testing.assert_allclose(turned, turn[None] @ jax.vmap(from_thrust)(force, yaw), rtol=0, atol=1e-13)


def test_the_error_is_zero_at_the_target():
    quat = rotation.normalize(jnp.array([0.3, -0.2, 0.5, 0.7]))
    np.testing.assert_allclose(attitude.error(*2 * [rotation.axes(quat)]), 0, rtol=0, atol=1e-16)


@pytest.mark.parametrize("angle", [1e-6, 0.4, np.pi / 2, 2.0])
def test_the_error_is_the_axis_times_the_sine_of_the_angle(angle):
    axis = jnp.array([0.6, 0.0, -0.8])
    target = rotation.normalize(jnp.array([0.3, -0.2, 0.5, 0.7]))
    axes = rotation.axes(rotation.multiply(target, rotation.exp(angle * axis)))
    expected = np.sin(angle) * axis
    np.testing.assert_allclose(attitude.error(axes, rotation.axes(target)), expected, rtol=0, atol=2e-15)


@pytest.mark.parametrize(
    "force", [(0, 0, 0), (0, 0, -1), (1, 0, 0)], ids=["none", "straight down", "along the heading"]
)
def test_there_is_an_attitude_and_a_gradient_for_every_force(force):
    force, yaw = jnp.array(force, float), jnp.array(0.0)
    assert_finite(from_thrust(force, yaw))
    assert_finite(gradients(force, yaw))
