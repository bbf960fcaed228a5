"""The forest: who starts and arrives where, what counts as touching and reaching, and what a policy is told."""

import functools
import itertools
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import jit_unoptimized

from jaxdrones import load_params, repeat
from jaxdrones.envs import TASKS, make
from jaxdrones.sensing import Cylinder, Scene, collisions

ENV = functools.cache(lambda: make("forest", vision=()))
advance = jit_unoptimized(lambda world: ENV().task.advance(ENV().task, world))
first_world = functools.cache(lambda: jit_unoptimized(ENV().reset)(jax.random.key(0))[1])


def moved_to(to, **known):
    world = first_world()
    drones = world.drones.replace(pos=jnp.asarray([to]))
    return advance(world.replace(drones=drones, variables=world.variables | known))


def starts(keys):
    """Gaps (m) of start and goal from the obstacles of forests."""
    env = ENV()

    @jax.jit
    @jax.vmap
    def gaps(key):
        scene_key, start_key = jax.random.split(key)
        scene = env.task.scene(scene_key)
        state, variables = env.task.begin(start_key, env.params, scene)
        return jnp.stack([scene.distance(state.pos[0]), scene.distance(variables["goal"][0])])

    return gaps(keys)


@pytest.mark.slow
def test_starts_and_goals_are_never_in_an_obstacle():
    assert jnp.min(starts(jax.random.split(jax.random.key(1), 10_000))) > 0.9  # m


def test_a_drone_reaches_its_goal_within_a_meter_and_touches_what_it_is_in():
    assert moved_to((19.1, 0, 1.5))["reached"][0] and not moved_to((18.9, 0, 1.5))["reached"][0]
    trees = first_world().scene.cylinders
    i = int(jnp.argmax(trees.active))
    beside = trees.pos[i].at[0].add(-trees.radius[i] - ENV().params.collision_radius[0])
    beside = beside.at[2].set(1.5)
    assert moved_to(beside + jnp.array([0.01, 0, 0]))["touched"][0]
    assert moved_to((5.0, 0.0, 0.01))["touched"][0]  # the ground
    assert moved_to((5.0, 0.0, 1.5), touched=jnp.array([True]))["touched"][0], "what has touched has touched"
    through = jnp.array([trees.radius[i] + 1.0, 0, 0])
    before = trees.pos[i].at[2].set(1.5) - through
    assert moved_to(before + 2 * through, pos=before[None])["touched"][0], "a tree on the way"


def test_the_clearance_is_the_smallest_so_far():
    radius = ENV().params.collision_radius[0]
    for height, clearance in (0.4, 0.4 - radius), (0.8, 0.5):
        found = moved_to((-5.0, 0.0, height), clearance=jnp.array([0.5]))["clearance"]
        np.testing.assert_allclose(found, clearance, rtol=1e-12)


def test_a_goal_is_rewarded_once_also_while_a_team_waits_for_others():
    world, rewarded = first_world(), []
    for x in (18.9, 19.1, 19.2, 18.5, 19.5):
        world = world.replace(drones=world.drones.replace(pos=jnp.array([[x, 0, 1.5]])))
        world = world.replace(variables=advance(world))
        scale, term = ENV().task.rewards["reached"]
        rewarded.append(scale * float(term(ENV().task, world)[0]))
    assert rewarded == [0, 10, 0, 0, 0]


def test_the_path_is_summed_and_progress_is_what_the_goal_comes_closer():
    world = first_world()
    world = world.replace(variables=world.variables | {"start": jnp.array([[0, 0, 1.5]]), "path": jnp.zeros(1)})
    places = jnp.array([[0, 0, 1.5], [3, 4, 1.5], [3, 0, 1.5]])
    for before, after in itertools.pairwise(places):
        drones = world.drones.replace(pos=after[None])
        variables = advance(world.replace(drones=drones, variables=world.variables | {"pos": before[None]}))
        world = world.replace(drones=drones, variables=variables)
    assert world.variables["path"][0] == 9.0
    np.testing.assert_allclose(world.variables["progress"], np.hypot(17, 4) - 17, rtol=1e-12)
    np.testing.assert_allclose(ENV().task.metrics["detour"](ENV().task, world), 3.0, rtol=1e-12)


@pytest.mark.parametrize(
    ("pos", "out"),
    [
        ((10, 4.9, 1), 0),
        ((10, -5.1, 1), 1),
        ((10, 5.1, 1), 1),
        ((-1.9, 0, 3.9), 0),
        ((-2.1, 0, 1), 1),
        ((22.1, 0, 1), 1),
        ((10, 0, 4.1), 1),
    ],
)
def test_a_drone_that_leaves_the_strip_of_ten_meters_ends_its_episode(pos, out):
    world = first_world()
    drones = world.drones.replace(pos=jnp.array([pos], float))
    assert ENV().task.terminations["left"](ENV().task, world.replace(drones=drones)).tolist() == [bool(out)]


@pytest.mark.slow
def test_what_is_touched_is_what_collisions_tell_in_one_world_and_in_many():
    world = first_world()
    pos = jax.random.uniform(jax.random.key(2), (512, 1, 3), minval=0, maxval=jnp.array([20, 5, 2.0]))

    @jax.vmap
    def there(pos):  # and there at the last step, so that the sweep between both finds nothing more
        return world.replace(drones=world.drones.replace(pos=pos), variables=world.variables | {"pos": pos})

    worlds = there(pos)

    def by_geometry(world):
        found = collisions(world.params, world.drones, world.scene)
        return found.ground | found.scene

    expected = jax.jit(jax.vmap(by_geometry))(worlds)
    assert 3 < jnp.sum(expected) < 100
    np.testing.assert_array_equal(
        jax.jit(jax.vmap(lambda world: ENV().task.advance(ENV().task, world)["touched"]))(worlds), expected
    )


@pytest.mark.slow
def test_the_policy_is_told_the_desired_velocity_in_body_axes_and_nothing_of_its_place():
    world = first_world()
    term = ENV().task.observations["desired_velocity"].observe(ENV().task, world)
    np.testing.assert_allclose(jnp.linalg.norm(term), 3.0)
    assert not {"position", "position_error"} & set(ENV().task.observation)


@pytest.mark.slow
def test_the_clearance_term_grows_with_the_closing_speed_and_is_free_far_away():
    scene = Scene.of(Cylinder(pos=(10.0, 0.0, 2.5), radius=0.2, height=5.0))
    _, clearance = ENV().task.rewards["clearance"]

    world = first_world()

    def cost(x, speed):
        drones = world.drones.replace(pos=jnp.array([[x, 0, 1.5]]), vel=jnp.array([[speed, 0, 0]]))
        return clearance(ENV().task, world.replace(drones=drones, scene=scene))[0]

    costs = jax.jit(jax.vmap(cost))
    near = costs(jnp.full(3, 9.4), jnp.array([-3.0, 0.0, 3.0]))
    assert near[0] == near[1] < near[2]
    assert costs(jnp.array([5.0]), jnp.array([3.0]))[0] < 1e-6  # the ground is 1.5 m below
    assert jax.jit(jax.grad(cost))(9.4, 3.0) > 0


def test_traversability_is_the_free_way_in_widths_of_the_drone():
    width = 2 * ENV().params.collision_radius[0]
    metric = ENV().task.metrics["traversability"]
    world = first_world()
    np.testing.assert_allclose(metric(ENV().task, world.replace(scene=Scene()))[0], 20 / width)
    wall = Scene.of(Cylinder(pos=(60.0, 0.0, 0.0), radius=50.0 - width / 2, height=1.0))  # nearly flat, 10 m ahead
    assert 10 < metric(ENV().task, world.replace(scene=wall))[0] * width < 10.2
    nothing = wall.replace(cylinders=wall.cylinders.replace(active=jnp.zeros(1, bool)))
    np.testing.assert_allclose(metric(ENV().task, world.replace(scene=nothing))[0], 20 / width)


def test_a_flight_to_the_goal_at_the_commanded_speed_with_the_camera_ahead_costs_nothing():
    def terms(vel, quat):
        drones = world.drones.replace(pos=jnp.array([[5.0, 0, 1.5]]), vel=jnp.array([vel]), quat=jnp.array([quat]))
        now = world.replace(drones=drones, variables=world.variables | {"progress": jnp.array([vel[0] * ENV().dt])})
        rewards = ENV().task.rewards
        return [rewards[name][1](ENV().task, now)[0] for name in ("velocity", "progress", "heading", "height")]

    world = first_world()
    np.testing.assert_allclose(terms([3.0, 0, 0], [0.0, 0, 0, 1]), [0, 1, 0, 0], atol=1e-12)
    slow = (np.hypot(3, 0.3) - 0.3) / 3
    np.testing.assert_allclose(terms([0.0, 0, 0], [0.0, 0, 1, 0]), [slow, 0, 2, 0], atol=1e-12)


@pytest.mark.parametrize(("drones", "spread"), [(1, 0.5), (2, 0.3)])
def test_drones_start_side_by_side_and_all_have_to_reach_the_goals_ahead_of_them(drones, spread):
    task = TASKS["forest"](drones=drones)
    params = repeat(load_params("cf2x"), drones)
    begin = jit_unoptimized(jax.vmap(lambda key: task.begin(key, params, Scene())))
    state, variables = begin(jax.random.split(jax.random.key(0), 200))
    y = np.arange(drones) - (drones - 1) / 2
    goal = np.stack([np.full(drones, 20), y, np.full(drones, 1.5)], axis=-1)
    np.testing.assert_array_equal(variables["goal"], np.tile(goal, (200, 1, 1)))
    off = np.abs(np.asarray(state.pos) - goal + [20, 0, 0]).max(axis=(0, 1))
    assert off[0] == 0 and spread - 0.02 < off[1] <= spread and 0.18 < off[2] <= 0.2
    one = SimpleNamespace(variables={"reached": jnp.arange(drones) == 0})
    assert task.terminations["reached"](task, one).tolist() == [drones == 1] * drones


@pytest.mark.parametrize(
    ("options", "error"),
    [
        (dict(speed=0), "speed is 0; give"),
        (dict(drones=12), "width is 10.0; give a number above 13"),
        (dict(density=-1), "density"),
    ],
)
def test_options_out_of_range_say_so(options, error):
    with pytest.raises(ValueError, match=error):
        make("forest", **options)


@pytest.mark.slow
def test_the_drones_of_a_team_start_apart():
    """One of a thousand teams of two would touch at once if each drone started half a meter to either side."""
    env = make("forest", drones=3)
    pos = jit_unoptimized(jax.vmap(lambda key: env.task.begin(key, env.params, Scene())[0].pos))(
        jax.random.split(jax.random.key(0), 10_000)
    )
    assert jnp.min(pos[:, 1:, 1] - pos[:, :-1, 1]) > 0.4 - 1e-6
