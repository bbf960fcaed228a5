import functools
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
from helpers import jit_unoptimized
from scipy.spatial.transform import Rotation

import jaxdrones as jd
from jaxdrones import rotation
from jaxdrones.envs import TASKS
from jaxdrones.sensing import Scene
from jaxdrones.tasks.starts import thrown

EAST = jnp.array([[1.0, 0.0, 0.0]])
TEAM = jd.repeat(jd.load_params("cf2x"), 3)


def starts(name):
    """States and variables of 300 teams of three, and their attitudes."""
    begin = jax.vmap(lambda key: TASKS[name](drones=3).begin(key, TEAM, Scene()))
    state, variables = jit_unoptimized(begin)(jax.random.split(jax.random.key(0), 300))
    return state, variables, Rotation.from_quat(np.reshape(state.quat, (-1, 4)))


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


def test_a_hover_starts_tilted_about_any_axis_by_up_to_its_tilt():
    turn = starts("hover")[2].as_rotvec()
    angle = np.linalg.norm(turn, axis=1, keepdims=True)
    assert angle.min() < 0.05 and np.pi / 2 - 0.05 < angle.max() <= np.pi / 2
    axis = turn / angle
    np.testing.assert_allclose(axis.T @ axis / len(axis), np.eye(3) / 3, atol=0.04)


def test_a_recovery_starts_upside_down_and_a_landing_above_its_pad():
    _, variables, attitude = starts("recovery")
    assert -0.53 < attitude.as_matrix()[:, 2, 2].max() <= -0.5  # 60 degrees from upside down
    np.testing.assert_allclose(variables["goal"], np.tile([[-3.0, 0, 5], [0, 0, 5], [3, 0, 5]], (300, 1, 1)))
    state, variables, _ = starts("landing")
    above = np.asarray(state.pos - variables["goal"])[..., 2]
    np.testing.assert_array_equal(variables["sinking"], -state.vel[..., 2])
    assert 0.5 <= above.min() < 0.51 and 1.49 < above.max() <= 1.5


def test_a_landing_has_crashed_where_a_drone_is_upside_down_on_the_ground():
    task = TASKS["landing"](drones=3)
    drones = jd.State.at_rest(jnp.array([[0, 0, 0.05], [0, 0, 0.05], [0, 0, 1.0]]))
    drones = drones.replace(quat=jnp.array([[0.0, 0, 0, 1], [1, 0, 0, 0], [1, 0, 0, 0]]))
    world = SimpleNamespace(params=TEAM, drones=drones)
    assert task.terminations["crashed"](task, world).tolist() == [False, True, False]


def test_a_descent_costs_what_is_faster_than_30_cm_and_half_the_height_per_second():
    _, descent = TASKS["landing"](drones=3).rewards["descent"]
    drones = jd.State.at_rest(jnp.array([[0, 0, 1.0], [0, 0, 1.0], [0, 0, -0.1]]))
    drones = drones.replace(vel=jnp.array([[0, 0, -1.0], [0, 0, -0.7], [0, 0, -0.5]]))
    world = SimpleNamespace(drones=drones, variables={"goal": jnp.zeros((3, 3))})
    np.testing.assert_allclose(descent(None, world), [0.2, 0, 0.2], atol=1e-12)


def test_who_recovers_is_level_slow_and_near_in_the_end():
    good = {"upright": np.cos(np.radians(14)), "speed": 0.4, "error": 0.4}
    bad = {"upright": np.cos(np.radians(16)), "speed": 0.6, "error": 0.6}
    for change, recovered in ({}, True), *(({name: x}, False) for name, x in bad.items()):
        metrics = {name: jnp.array([[x]]) for name, x in (good | change).items()}
        assert TASKS["recovery"]().success(metrics, 0.01).tolist() == [recovered]
