"""The room: who exchanges places with whom, where pillars stand, and what counts as touching and arriving."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import jit_unoptimized

from jaxdrones.envs import make

ENV = make("room", drones=3)
TASK = ENV.task
first_world = functools.cache(lambda: jit_unoptimized(ENV.reset)(jax.random.key(0))[1])
advance = jit_unoptimized(lambda world: TASK.advance(TASK, world))


def moved_to(*pos):
    world = first_world()
    return advance(world.replace(drones=world.drones.replace(pos=jnp.asarray(pos))))


@jit_unoptimized
@jax.vmap
def starts(key):
    """Places on the ring, goals, and the smallest distance (m) of both from the obstacles of a room."""
    scene_key, start_key = jax.random.split(key)
    scene = TASK.scene(scene_key)
    state, variables = TASK.begin(start_key, ENV.params, scene)
    places = jnp.concatenate([state.pos, variables["goal"]])
    return state.pos, variables["goal"], jnp.min(jax.vmap(scene.distance)(places))


@pytest.mark.slow
def test_every_drone_goes_to_the_place_of_another_and_none_starts_or_arrives_in_an_obstacle():
    pos, goal, gap = starts(jax.random.split(jax.random.key(1), 10_000))
    assert jnp.min(gap) > 0.3  # m
    shift = jnp.argmin(jnp.linalg.norm(goal[:, :, None] - pos[:, None], axis=-1), axis=-1)
    assert set(map(tuple, shift.tolist())) == {(1, 2, 0), (2, 0, 1)}


@pytest.mark.slow
def test_touching_is_of_walls_pillars_the_ground_and_each_other():
    a, b, c = first_world().drones.pos
    assert not jnp.any(moved_to(a, b, c)["touched"])
    np.testing.assert_array_equal(moved_to(a, a + jnp.array([0.05, 0, 0]), c)["touched"], [True, True, False])
    np.testing.assert_array_equal(moved_to(a.at[0].set(2.98), b, c.at[2].set(0.01))["touched"], [True, False, True])
    scene = first_world().scene
    pillar = scene.cylinders.pos[jnp.argmax(scene.cylinders.active)]
    np.testing.assert_array_equal(moved_to(a, pillar, c)["touched"], [False, True, False])


def test_success_is_arriving_within_20_cm_without_touching():
    errors = jnp.array([[1.0, 1.0, 1.0], [0.1, 0.3, 0.1]])  # time, drones
    touched = jnp.array([[0.0, 0, 0], [0, 0, 1]])
    np.testing.assert_array_equal(TASK.success({"error": errors, "touched": touched}, 0.02), [True, False, False])


def test_a_ring_has_room_for_so_many_drones():
    make("room", drones=12)
    with pytest.raises(ValueError, match="at most 12"):
        make("room", drones=13)
