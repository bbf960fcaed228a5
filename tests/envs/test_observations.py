"""Observation terms against what they stand for."""

import dataclasses
import itertools
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import jit_unoptimized, mostly_slow_rows
from scipy.spatial.transform import Rotation

import jaxdrones as jd
from jaxdrones.envs import OBSERVATIONS, TASKS, Env, make
from jaxdrones.envs.observations import deviations
from jaxdrones.envs.surroundings import encounters, neighbors, obstacles
from jaxdrones.sensing import Scene
from jaxdrones.tasks import ObservationTerm, World

TASK = TASKS["hover"](drones=2)
TEAM = jd.repeat(jd.load_params("cf2x"), 2)
GOAL, VEL = np.array([[1.0, 2, 3], [-1, 0, 2]]), np.array([[0.5, -0.2, 0.1], [0, 0.3, -0.4]])
ATTITUDE = Rotation.from_rotvec([[0.3, -0.7, 1.1], [-0.2, 0.4, 2.0]])


@pytest.mark.parametrize(
    ("name", "world_axes"),
    [("gravity", np.tile([0.0, 0, -1], (2, 1))), ("velocity_body", VEL), ("position_error_body", GOAL)],
)
def test_a_term_in_body_axes_is_the_vector_of_the_world_seen_from_the_drone(name, world_axes):
    drones = jd.State.at_rest(jnp.zeros((2, 3))).replace(quat=jnp.array(ATTITUDE.as_quat()), vel=jnp.array(VEL))
    goal = {"goal": jnp.array(GOAL)}
    world = World(TEAM, drones, goal, None, jnp.zeros((2, 1, 4)), jnp.zeros(()), jnp.ones(2, bool), 0.01)
    np.testing.assert_allclose(OBSERVATIONS[name].observe(TASK, world), ATTITUDE.inv().apply(world_axes), atol=1e-12)


def test_other_terms_are_the_state_of_the_drone_in_their_units():
    quat = jnp.array(ATTITUDE.as_quat()) * jnp.array([[1.0], [-1.0]])
    drones = jd.State.at_rest(jnp.zeros((2, 3))).replace(
        quat=quat, vel=jnp.array(VEL), omega=jnp.array(GOAL), rpm=jnp.full((2, 4), 0.3) * TEAM.max_rpm[:, None]
    )
    world = SimpleNamespace(params=TEAM, drones=drones)
    still = SimpleNamespace(target_now=lambda world: SimpleNamespace(vel=jnp.ones((2, 3))))
    for name, expected in {
        "omega_world": ATTITUDE.apply(GOAL),
        "rotor_speed": np.full((2, 4), 0.3),
        "velocity_error": 1 - VEL,
        "quaternion": ATTITUDE.as_quat(canonical=True),
        "rotation_matrix": ATTITUDE.as_matrix().reshape(2, 9),
    }.items():
        np.testing.assert_allclose(OBSERVATIONS[name].observe(still, world), expected, atol=1e-12, err_msg=name)
    normalized = OBSERVATIONS["normalized_kinematics"].observe(still, world)
    np.testing.assert_allclose(normalized[:, 6:9], VEL / 3, atol=1e-12)


def test_rows_of_drones_and_obstacles_have_the_closest_approach_and_missing_ones_are_far_away():
    pos, vel = jnp.array([[0.0, 0, 1], [1.0, 0, 1]]), jnp.array([[0.0, 0, -1], [0.0, 0, 0]])
    world = SimpleNamespace(drones=SimpleNamespace(pos=pos, vel=vel), scene=Scene())
    seen = jit_unoptimized(lambda: [term.observe(None, world) for term in (encounters(2), obstacles(2), neighbors(2))])
    others, ground, near = (np.asarray(x) for x in seen())

    def row(x, v, time):
        away = np.sqrt(x @ x + 0.05**2)
        return [*x, *v, *(x + time * v), time, *(0.3 / (away * (away + 0.1)) * x)]

    down = np.array([0.0, 0, 1])
    np.testing.assert_allclose(others[0, :13], row(np.array([1.0, 0, 0]), down, 0))
    np.testing.assert_allclose(ground[0, :13], row(-down, down, 1 / 1.05), atol=1e-12)
    np.testing.assert_allclose(ground[1, :13], row(-down, 0 * down, 0), atol=1e-12)
    np.testing.assert_allclose(
        near, [[1, 0, 0, 0, 0, 1, 20, 20, 20, 0, 0, 0], [-1, 0, 0, 0, 0, -1, 20, 20, 20, 0, 0, 0]]
    )
    assert np.all(np.linalg.norm(others[:, 13:16], axis=1) > 30) and np.all(ground[:, 13] == 20)


def test_a_privileged_critic_is_given_relative_deviations_of_what_is_drawn():
    drawn = TEAM.replace(mass=TEAM.mass * jnp.array([1.1, 0.8]), kf=2 * TEAM.kf)
    chosen = [x is TEAM.mass for x in jax.tree.leaves(TEAM)]
    np.testing.assert_allclose(deviations(drawn, TEAM, chosen), [[0.1], [-0.2]], rtol=1e-9)
    env = SimpleNamespace(terms=(OBSERVATIONS["position"],), task=None, params=TEAM, _drawn=chosen)
    world = SimpleNamespace(params=drawn, drones=SimpleNamespace(pos=jnp.array(GOAL)))
    found = Env.privileged_observation(env, world)
    np.testing.assert_allclose(found.params, [[0.1], [-0.2]], rtol=1e-9)
    np.testing.assert_array_equal(found.obs, GOAL)


@pytest.mark.parametrize(
    ("bound", "dtype"),
    mostly_slow_rows(
        list(itertools.product((10.0, 1000.0, np.inf), (jnp.uint8, jnp.int8, jnp.int32))),
        [(10.0, jnp.uint8), (np.inf, jnp.int32)],
    ),
)
def test_a_term_of_whole_numbers_is_clipped_as_the_same_real_numbers_are(dtype, bound):
    task = TASKS["hover"]()
    values = jnp.arange(0, 120, 40).astype(dtype)[None]
    whole, real = (ObservationTerm(lambda task, world, v=v: v, bound) for v in (values, values.astype(float)))
    obs = []
    for term in whole, real:
        env = make(dataclasses.replace(task, observations={"own": term}), observation=("own",))
        obs.append(jit_unoptimized(env.reset)(jax.random.key(0))[0])
    assert obs[0].dtype == obs[1].dtype
    np.testing.assert_array_equal(*obs)


def test_a_change_of_the_action_is_penalized_also_where_one_action_is_observed():
    env = make("hover", observation=("last_action",))
    world = jit_unoptimized(env.reset)(jax.random.key(0))[1]
    scale, term = env.task.rewards["action_change"]
    assert scale * term(env.task, world.replace(actions=world.actions.at[:, -1].set(0.5)))[0] == scale
