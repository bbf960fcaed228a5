import functools

import jax
import jax.numpy as jnp
import numpy as np
from helpers import jit_unoptimized

import jaxdrones as jd
from jaxdrones import rotation
from jaxdrones.tasks.starts import thrown

EAST = jnp.array([[1.0, 0.0, 0.0]])


def test_the_reward_for_precision_falls_by_a_factor_of_e_in_ten_centimeters_and_is_steepest_near_the_goal():
    env = jd.make("hover", precision=2.0)
    _, world = jit_unoptimized(env.reset)(jax.random.key(0))
    scale, near = env.task.rewards["near"]
    goal = world.variables["goal"][0]

    @jax.jit
    def reward(distance):
        return scale * near(env.task, world.replace(drones=world.drones.replace(pos=goal[None] + distance * EAST)))[0]

    assert float(reward(0.0)) == 2.0
    far, farther = float(reward(0.5)), float(reward(0.6))
    np.testing.assert_allclose(farther / far, np.exp(-1), rtol=1e-3)  # beyond the parabola within 2 cm
    slopes = jax.jit(jax.vmap(jax.grad(reward)))(jnp.array([0.03, 0.1, 0.3, 1.0]))
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
