"""Observation terms against what they stand for."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxdrones as jd
from jaxdrones.envs import OBSERVATIONS, TASKS
from jaxdrones.envs.observations import deviations
from jaxdrones.tasks import World

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


def test_a_privileged_critic_is_given_relative_deviations_of_what_is_drawn():
    drawn = TEAM.replace(mass=TEAM.mass * jnp.array([1.1, 0.8]), kf=2 * TEAM.kf)
    chosen = [x is TEAM.mass for x in jax.tree.leaves(TEAM)]
    np.testing.assert_allclose(deviations(drawn, TEAM, chosen), [[0.1], [-0.2]], rtol=1e-9)
