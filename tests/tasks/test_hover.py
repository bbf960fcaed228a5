import functools

import jax
import jax.numpy as jnp
import numpy as np
from helpers import jit_unoptimized

import jaxdrones as jd
from jaxdrones import rotation
from jaxdrones.tasks.starts import thrown

EAST = jnp.array([[1.0, 0.0, 0.0]])


def test_the_reward_for_precision_falls_with_distance_and_speed_and_is_steepest_at_rest_at_the_goal():
    """By a factor of e over 10 cm, and over 0.2 m/s."""
    env = jd.make("hover", precision=2.0)
    _, world = jit_unoptimized(env.reset)(jax.random.key(0))
    scale, near = env.task.rewards["near"]
    goal = world.variables["goal"][0]

    @jax.jit
    def reward(distance, speed):
        drones = world.drones.replace(pos=goal[None] + distance * EAST, vel=speed * EAST)
        return scale * near(env.task, world.replace(drones=drones))[0]

    assert float(reward(0.0, 0.0)) == 2.0
    far = float(reward(0.5, 1.0))  # beyond the parabolas within 2 cm and 2 cm/s
    np.testing.assert_allclose(float(reward(0.6, 1.0)) / far, np.exp(-1), rtol=1e-3)
    np.testing.assert_allclose(float(reward(0.5, 1.2)) / far, np.exp(-1), rtol=1e-3)
    x = jnp.array([0.03, 0.1, 0.3, 1.0])
    for argument, points in ((0, (x, 0 * x)), (1, (0 * x, 2 * x))):
        slopes = jax.jit(jax.vmap(jax.grad(reward, argument)))(*points)
        assert np.all(slopes < 0) and np.all(np.diff(np.asarray(slopes)) > 0)


def test_the_penalty_of_the_heading_is_one_minus_its_cosine_and_absent_by_default():
    env = jd.make("hover", heading=0.5)
    _, world = jit_unoptimized(env.reset)(jax.random.key(0))
    scale, heading = env.task.rewards["heading"]

    def reward(yaw):
        quat = rotation.from_rpy(jnp.array([0.0, 0.0, yaw]))[None]
        return scale * heading(env.task, world.replace(drones=world.drones.replace(quat=quat)))[0]

    yaw = jnp.radians(jnp.array([0.0, 30.0, -90.0, 180.0]))
    np.testing.assert_allclose(jax.jit(jax.vmap(reward))(yaw), -0.5 * (1 - np.cos(yaw)), atol=5e-3)
    assert "heading" not in jd.make("hover").task.rewards


def test_the_numbers_of_a_random_start_are_drawn_for_themselves():
    params = jd.repeat(jd.load_params("cf2x"), 2)
    place = functools.partial(thrown, reach=1.0, speed=1.0, omega=1.0, tilt=1.0)
    state = jit_unoptimized(place)(jax.random.key(0), params, jnp.zeros((2, 3)))
    drawn = np.concatenate([state.pos, state.vel, state.omega], axis=1)
    assert len(np.unique(np.abs(drawn))) == drawn.size
