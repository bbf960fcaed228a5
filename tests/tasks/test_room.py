"""The room: who exchanges places with whom, where pillars stand, and what counts as touching and arriving."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import jit_unoptimized

from jaxdrones import load_params, repeat
from jaxdrones.envs import TASKS, make
from jaxdrones.sensing import Scene

ENV = functools.cache(lambda: make("room", drones=3))
first_world = functools.cache(lambda: jit_unoptimized(ENV().reset)(jax.random.key(0))[1])
advance = jit_unoptimized(lambda world: ENV().task.advance(ENV().task, world))


def moved_to(*pos):
    world = first_world()
    return advance(world.replace(drones=world.drones.replace(pos=jnp.asarray(pos))))


def starts(keys):
    """Places on the ring, goals, and the smallest distance (m) of both from the obstacles of rooms."""
    env = ENV()

    @jit_unoptimized
    @jax.vmap
    def of_room(key):
        scene_key, start_key = jax.random.split(key)
        scene = env.task.scene(scene_key)
        state, variables = env.task.begin(start_key, env.params, scene)
        places = jnp.concatenate([state.pos, variables["goal"]])
        return state.pos, variables["goal"], jnp.min(jax.vmap(scene.distance)(places))

    return of_room(keys)


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


@pytest.mark.slow
def test_drones_that_pass_through_each_other_between_two_control_steps_have_touched():
    """Five meters a second each: 20 cm between two control steps, more than the two drones are wide."""
    env = make("room", drones=3, pillars=0)
    _, world = jit_unoptimized(env.reset)(jax.random.key(0))
    met = jit_unoptimized(lambda world: env.task.advance(env.task, world)["touched"])
    for gap, touched in ((1.9, True), (2.1, False)):
        aside = gap * float(env.params.collision_radius[0])
        before = world.drones.pos.at[:2].set(jnp.array([[-0.1, 0.0, 1.0], [0.1, aside, 1.0]]))
        after = world.drones.replace(pos=before.at[:2, 0].multiply(-1))
        now = world.replace(drones=after, variables=world.variables | {"pos": before})
        np.testing.assert_array_equal(met(now), [touched, touched, False])


def test_success_is_arriving_within_20_cm_without_touching():
    errors = jnp.array([[1.0, 1.0, 1.0], [0.1, 0.3, 0.1]])  # time, drones
    touched = jnp.array([[0.0, 0, 0], [0, 0, 1]])
    np.testing.assert_array_equal(ENV().task.success({"error": errors, "touched": touched}, 0.02), [True, False, False])


@pytest.mark.parametrize("name", ["room", "forest"])
def test_the_clearance_begins_with_the_distance_from_the_ground_or_a_wall_however_large(name):
    task = TASKS[name]()
    params = repeat(load_params("cf2x"), task.drones)
    state, variables = jit_unoptimized(task.begin)(jax.random.key(0), params, Scene())
    np.testing.assert_allclose(variables["clearance"], state.pos[:, 2] - params.collision_radius, rtol=1e-12)


@pytest.mark.parametrize(
    ("name", "drones", "radius", "height"), [("room", 4, 2.0, 1.5), ("swap-goals", 16, 1.528, 2.0)]
)
def test_on_a_ring_nobody_starts_at_the_goal_and_each_goal_is_the_place_of_another(name, drones, radius, height):
    task = TASKS[name](drones=drones)
    begin = jax.vmap(lambda key: task.begin(key, repeat(load_params("cf2x"), drones), Scene()))
    state, variables = jit_unoptimized(begin)(jax.random.split(jax.random.key(0), 50))
    goal = np.asarray(variables["goal"])
    np.testing.assert_allclose(np.linalg.norm(goal[..., :2], axis=-1), radius, rtol=1e-3)
    np.testing.assert_allclose(goal[..., 2], height)
    away = np.abs(np.asarray(state.pos)[:, :, None] - goal[:, None]).max(axis=-1)
    own = np.argmin(away, axis=2)
    assert away.min(axis=2).max() <= 0.1 and np.array_equal(np.sort(own), np.tile(np.arange(drones), (50, 1)))
    assert not np.any(own == np.arange(drones))
    assert TASKS["swap-goals"](drones=8).duration == pytest.approx(4 + 2 / 1.2)


def test_a_single_drone_flies_to_the_opposite_place():
    task, params = TASKS["room"](drones=1), repeat(load_params("cf2x"), 1)
    _, variables = jit_unoptimized(task.begin)(jax.random.key(0), params, Scene())
    np.testing.assert_allclose(variables["goal"], [[-2, 0, 1.5]])


def test_a_ring_has_room_for_so_many_drones():
    make("room", drones=12)
    with pytest.raises(ValueError, match="at most 12"):
        make("room", drones=13)
    wide = repeat(load_params("cf2x"), 12)
    wide = wide.replace(collision_radius=jnp.full(12, 0.4))  # places are 1.04 m apart, starts as little as 0.75 m
    with pytest.raises(ValueError, match=r"0\.8 m wide and would start in each other, as little as 0\.752 m apart"):
        TASKS["room"](drones=12).begin(jax.random.key(0), wide, Scene())


@pytest.mark.slow
@pytest.mark.float32
def test_terms_and_metrics_of_a_drone_that_flies_alone_are_one_number_for_it():
    env = make("room", drones=1)
    info = jax.eval_shape(lambda key: env.step(key, env.reset(key)[1], jnp.zeros((1, 4))), jax.random.key(0))[5]
    for kind in "rewards", "metrics", "terminations":
        assert {name: x.shape for name, x in info[kind].items()} == dict.fromkeys(info[kind], (1,))
