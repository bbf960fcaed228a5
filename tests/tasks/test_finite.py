"""Values and gradients of a flight with random actions are finite in every task, in single precision."""

from functools import partial

import jax
import jax.numpy as jnp
import pytest
from helpers import assert_finite, jit_unoptimized

from jaxdrones.envs import TASKS, make

STARTS, STEPS = 8, 50
pytestmark = [pytest.mark.slow, pytest.mark.float32]


def flight(env, actions, key):
    """Sum of rewards and observations of a flight (steps, n, a), and everything of its steps."""
    key, start_key = jax.random.split(key)

    def advance(world, given):
        obs, world, reward, *_, info = env.step(given[0], world, given[1])
        return world, (obs, world.drones, reward, info["rewards"], info["metrics"])

    world = env.reset(start_key)[1]
    steps = jax.lax.scan(advance, world, (jax.random.split(key, len(actions)), actions))[1]
    observed = sum(jnp.sum(x) for x in jax.tree.leaves(steps[0]) if jnp.issubdtype(x.dtype, jnp.floating))
    return jnp.sum(steps[2]) + 0.01 * observed, steps


NOT_REALISTIC = ("tune", "meetup")  # their controllers need rotors with less lag


@pytest.mark.parametrize(
    ("task", "realistic"),
    [*((task, False) for task in TASKS), *((task, True) for task in TASKS if task not in NOT_REALISTIC)],
)
def test_a_flight_with_random_actions_and_its_gradient_are_finite(task, realistic):
    env = make(task, realistic=realistic)
    shape = (STARTS, STEPS, env.drones, env.action_size)
    actions = jax.random.uniform(jax.random.key(1), shape, minval=-1, maxval=1)
    of_worlds = jax.vmap(jax.value_and_grad(partial(flight, env), has_aux=True))
    (_, steps), gradients = jit_unoptimized(of_worlds)(actions, jax.random.split(jax.random.key(0), STARTS))
    assert_finite(steps)
    assert_finite(gradients)
    assert jnp.any(gradients != 0)
