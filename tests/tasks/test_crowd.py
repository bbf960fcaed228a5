"""The crowd: random starts and goals at a constant density, and a touch that no control step misses."""

from functools import partial
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import jit_unoptimized, mostly_slow, mostly_slow_rows

from jaxdrones import load_params, repeat, rotation
from jaxdrones.envs import make
from jaxdrones.sensing import Scene
from jaxdrones.tasks import crossing, shaping
from jaxdrones.tasks.crowd import FLOOR, _random_sides, crowd, in_box
from jaxdrones.tasks.pairs import closest_approach, nearby, nearest, nearest_on_the_way, seen_from

KEYS = jax.random.split(jax.random.key(0), 20)


@pytest.mark.float32
@pytest.mark.parametrize("drones, density", mostly_slow_rows([(2, 1.0), (8, 1.0), (8, 4.0), (27, 1.0)], [(8, 4.0)]))
def test_starts_and_goals_fill_a_cube_of_the_density_and_keep_their_distance(drones, density):
    env = make("crowd", drones=drones, density=density)
    _, worlds = jit_unoptimized(jax.vmap(env.reset))(KEYS)
    side = (drones / density) ** (1 / 3)
    radius = float(env.params.collision_radius[0])
    for places in (np.asarray(worlds.drones.pos), np.asarray(worlds.variables["goal"])):
        inside = places - [0, 0, FLOOR + side / 2]
        assert np.abs(inside).max() <= side / 2
        np.testing.assert_allclose(np.abs(inside).mean(), side / 4, rtol=0.25)
        apart = np.linalg.norm(places[:, :, None] - places[:, None], axis=-1) + 9 * np.eye(drones)
        assert apart.min() > 4 * radius
    assert np.linalg.norm(worlds.variables["goal"] - worlds.drones.pos, axis=-1).mean() > 0.4 * side


def test_the_largest_of_different_vehicles_sets_the_distance_between_starts():
    """Where no random place is far enough, as for a drone as wide as the box, it is the farthest."""

    @jit_unoptimized
    def apart(largest):
        params = repeat(load_params("cf2x"), 2)
        params = params.replace(collision_radius=jnp.stack([0.05, largest]))
        pos = jax.vmap(lambda key: in_box(key, params, Scene(), np.zeros(3), 3.0, False)[0].pos)(KEYS)
        return jnp.linalg.norm(pos[:, 0] - pos[:, 1], axis=-1)

    for largest in 0.3, 3.0:
        assert jnp.min(apart(largest)) > 4 * 0.3


def test_balls_fill_the_cube_and_the_longest_diagonal_sets_the_duration():
    spheres = crowd(drones=64, obstacles=2.0).scene(KEYS[0]).spheres
    away = np.asarray(spheres.pos) - [0, 0, FLOOR + 2]
    assert away.shape == (128, 3) and np.all(away.min(axis=0) < -1.8) and np.all(away.max(axis=0) > 1.8)
    assert np.abs(away).max() <= 2 and 0.1 <= spheres.radius.min() < 0.11 and 0.19 < spheres.radius.max() <= 0.2
    assert crowd(random_box=True).duration == pytest.approx(6 + np.sqrt(4**2 + 2**2 + 2**2) / 1.2)


def test_in_half_of_the_random_boxes_one_side_is_up_to_twice_as_long():
    sides = np.sort(jax.vmap(lambda key: _random_sides(key, 2.0))(jax.random.split(KEYS[0], 1000)), axis=1)
    assert 1.2 <= sides.min() < 1.21 and sides[:, :2].max() < 2.2 and 3.9 < sides.max() <= 4
    np.testing.assert_allclose(np.mean(sides[:, 2] > 2.2), 0.9 / 2, atol=0.06)  # 3.8 standard deviations


@pytest.mark.slow
@pytest.mark.float32
def test_random_boxes_are_narrow_or_long():
    env = make("crowd", random_box=True)
    _, worlds = jit_unoptimized(jax.vmap(env.reset))(jax.random.split(jax.random.key(1), 200))
    places = np.concatenate([worlds.drones.pos, worlds.variables["goal"]], axis=1)
    sides = np.ptp(places, axis=1)
    assert sides.min() > 0.3 and 1.0 < np.median(sides) < 2.0
    assert 0.2 < np.mean(sides.max(axis=1) > 2.2) < 0.5 and sides.max() < 4


@pytest.mark.slow
@pytest.mark.float32
def test_among_balls_starts_and_goals_are_free_and_a_ball_touches():
    env = make("crowd", drones=8, obstacles=1.0)
    _, worlds = jit_unoptimized(jax.vmap(env.reset))(KEYS)
    radius = float(env.params.collision_radius[0])
    balls = np.asarray(worlds.scene.spheres.pos)
    assert balls.shape == (20, 8, 3) and np.all(np.abs(balls - [0, 0, FLOOR + 1]) <= 1)
    for places in (worlds.drones.pos, worlds.variables["goal"]):
        away = np.linalg.norm(places[:, :, None] - balls[:, None], axis=-1)
        assert np.min(away - worlds.scene.spheres.radius[:, None]) > radius + 0.25 - 1e-5
    world = jax.tree.map(lambda x: x[0], worlds)
    surface = balls[0, 0] + jnp.array([0, 0, world.scene.spheres.radius[0]])
    for gap, touched in ((0.9, True), (1.1, False)):
        pos = world.drones.pos.at[2].set(surface + jnp.array([0, 0, gap * radius]))
        after = world.replace(drones=world.drones.replace(pos=pos), variables=world.variables | {"pos": pos})
        expected = np.arange(8) == 2 if touched else np.zeros(8, bool)
        np.testing.assert_array_equal(env.task.advance(env.task, after)["touched"], expected)


def test_the_heading_costs_one_minus_its_cosine_also_of_a_tilted_drone():
    env = make("crowd", drones=2)
    _, world = jit_unoptimized(env.reset)(KEYS[0])
    tilts = np.array([[0.0, 0.0], [0.3, 0.5]])

    @jit_unoptimized
    @jax.vmap
    def cost(heading):
        quat = jax.vmap(lambda tilt: rotation.from_rpy(jnp.append(tilt, heading)))(tilts)
        return shaping.heading(env.task, world.replace(drones=world.drones.replace(quat=quat)))

    headings = np.array([0.0, 0.5, np.pi, -2.0])
    np.testing.assert_allclose(cost(headings), np.tile(1 - np.cos(headings), (2, 1)).T, atol=0.015)


def test_the_desired_velocity_is_straight_to_the_target_and_slower_within_a_distance_of_it():
    pos, target = jnp.array([[0.0, 0, 0], [3, 0, 0], [3, 4, 0]]), jnp.array([[3.0, 4, 0]])
    task = SimpleNamespace(target_now=lambda world: SimpleNamespace(pos=target))
    found = shaping.velocity_to_target(task, SimpleNamespace(drones=SimpleNamespace(pos=pos)), 2.0, 4.5)
    np.testing.assert_allclose(found, [[1.2, 1.6, 0], [0, 2 * 4 / 4.5, 0], [0, 0, 0]])


@pytest.mark.parametrize("speed", [0.0, 2.0])
def test_the_margin_of_drones_grows_with_their_relative_and_closing_speed(speed):
    """Two drones 0.3 m apart, one of which flies to the other one, or beside it."""
    params = SimpleNamespace(collision_radius=jnp.array([0.05, 0.06]))
    pos = jnp.array([[0.0, 0, 0], [0.3, 0, 0]])
    for ahead in (1.0, 0.0):
        vel = speed * jnp.array([[ahead, 1 - ahead, 0], [0, 0, 0]])
        world = SimpleNamespace(params=params, drones=SimpleNamespace(pos=pos, vel=vel))
        apart = np.hypot(0.3, 0.05)
        closing = ahead * speed * 0.3 / apart
        inside = 0.08 + 0.06 * np.hypot(speed, 0.1) + 0.3 * closing - (apart - 0.11)
        expected = (1 + closing) * 0.04 * np.log1p(np.exp(inside / 0.04))
        np.testing.assert_allclose(crossing._approach(None, world), [expected] * 2)


def test_drones_that_pass_between_two_control_steps_have_touched():
    """Four meters a second: 16 cm between two control steps, more than the two drones are wide."""
    env = make("crowd", drones=3)
    _, world = jit_unoptimized(env.reset)(jax.random.key(0))
    radius = float(env.params.collision_radius[0])
    advance, measure = jit_unoptimized(partial(env.task.advance, env.task)), jit_unoptimized(env.task.measure)
    for gap, touches in ((1.9, True), (2.1, False)):
        before = np.array([[0.0, 0, 3], [0.16, gap * radius, 3], [0, 3, 3]])
        after = np.array([[0.16, 0, 3], [0.0, gap * radius, 3], [0, 3, 3]])
        now = world.replace(
            drones=world.drones.replace(pos=after),
            variables=world.variables | {"pos": before, "touched": jnp.zeros(3, bool)},
        )
        variables = advance(now)
        np.testing.assert_array_equal(variables["touched"], [touches, touches, False])
        later = now.replace(variables=variables)
        np.testing.assert_array_equal(measure(later)["safe"], [not touches, not touches, True])
        apart = later.replace(drones=later.drones.replace(pos=after + np.array([[0, -3, 0], [0, 0, 0], [0, 3, 0]])))
        np.testing.assert_array_equal(advance(apart)["touched"], variables["touched"], "whoever touched has touched")


@pytest.mark.float32
@pytest.mark.parametrize("speed", mostly_slow([1.0, 6.0, 20.0], [6.0]))
def test_a_ball_that_is_passed_between_two_control_steps_has_been_touched(speed):
    env = make("crowd", drones=2, obstacles=1.0)
    _, world = jit_unoptimized(env.reset)(KEYS[1])
    advance = jit_unoptimized(lambda now: env.task.advance(env.task, now)["touched"])
    spheres = world.scene.spheres
    ball = jnp.array([0.0, 0.0, 3.0])
    spheres = spheres.replace(pos=spheres.pos.at[:].set(ball + jnp.array([0, 50.0, 0])).at[0].set(ball))
    reach = float(spheres.radius[0] + env.params.collision_radius[0])
    way = speed * env.dt
    for share in (0.2, 0.5, 0.9):  # of the way, at which the drone is nearest to the ball
        for gap, touches in ((0.98, True), (1.02, False)):
            before = ball[None] + jnp.array([[-share * way, gap * reach, 0], [0, 9.0, 0]])
            after = before.at[0, 0].add(way)
            now = world.replace(
                scene=world.scene.replace(spheres=spheres),
                drones=world.drones.replace(pos=after),
                variables=world.variables | {"pos": before, "touched": jnp.zeros(2, bool)},
            )
            np.testing.assert_array_equal(advance(now), [touches, False])


def test_a_drone_that_left_the_world_touches_nobody_on_the_way():
    """Drones that leave are moved far along x, here past another one."""
    pos = jnp.array([[0.0, 0, 3], [1.0, 0, 3], [0, 3, 3]])
    left = SimpleNamespace(
        params=SimpleNamespace(collision_radius=jnp.full(3, 0.06)),
        drones=SimpleNamespace(pos=pos.at[0, 0].set(1e4)),
        variables={"pos": pos, "touched": jnp.zeros(3, bool)},
        active=jnp.array([False, True, True]),
        scene=Scene(),
    )
    np.testing.assert_array_equal(crossing.advance(None, left)["touched"], [False, False, False])


def test_the_goal_is_seen_up_to_two_meters_and_approached_slower_within_80_cm():
    goal, vel = jnp.array([[5.0, 0, 0], [0.4, 0, 0]]), jnp.array([[1.2, 0, 0], [0.6, 0, 0]])
    task = SimpleNamespace(target_now=lambda world: SimpleNamespace(pos=goal))
    world = SimpleNamespace(drones=SimpleNamespace(pos=jnp.zeros((2, 3)), vel=vel), variables={"goal": goal})
    np.testing.assert_allclose(crossing._goal(task, world), [[2, 0, 0], [0.4, 0, 0]], atol=1e-3)
    np.testing.assert_allclose(crossing._velocity(task, world), 0, atol=1e-12)


@pytest.mark.parametrize("count", [3, 4])
def test_the_nearest_point_of_two_ways_is_that_of_a_fine_search(count):
    rng = np.random.default_rng(0)
    before, after = rng.normal(size=(2, 5, 3))
    share = np.linspace(0, 1, 20001)[:, None, None]
    way = before + share * (after - before)
    apart = np.linalg.norm(way[:, :, None] - way[:, None], axis=-1) + 9 * np.eye(5)
    found = jax.jit(lambda before, after: nearest_on_the_way(before, after, nearby(after, count)))(before, after)
    np.testing.assert_allclose(found, apart.min(axis=(0, 2)), atol=1e-4)


@pytest.mark.parametrize("count", mostly_slow([1, 3, 6, 9], [1, 3]))
def test_the_nearest_are_those_of_a_sorted_search(count):
    pos = np.random.default_rng(0).normal(size=(7, 3))
    away = np.linalg.norm(pos[:, None] - pos[None], axis=-1) + 99 * np.eye(7)
    expected = np.argsort(away, axis=1)[:, : min(count, 6)]
    found, seen = jax.jit(lambda pos: (nearest(pos, count), jnp.stack(seen_from(pos, nearby(pos, count)))))(pos)
    np.testing.assert_array_equal(found, expected)
    seen = np.linalg.norm(seen, axis=0).T
    np.testing.assert_allclose(np.sort(seen, axis=1), np.take_along_axis(away, expected, axis=1), rtol=1e-6)


def test_the_closest_approach_is_looked_for_until_the_horizon():
    pos, vel = ([jnp.array([[x]]) for x in v] for v in ((6.0, 0.3, 0.0), (-2.0, 0.0, 0.0)))
    for horizon, time in (4.0, 12 / 4.05), (1.5, 1.5):  # as 0.05 m^2/s^2 are added to the squared speed
        found, (x, y, z) = closest_approach(pos, vel, horizon)
        np.testing.assert_allclose([found, x, y, z], np.reshape([time, 6 - 2 * time, 0.3, 0], (4, 1, 1)))


def test_the_gradient_of_the_closest_approach_is_finite_for_drones_at_rest_and_at_one_place():
    def of(p, v):
        return jnp.sum(jnp.stack(closest_approach(*(list(x[:, None, None]) for x in (p, v)), 1.5)[1]))

    for pos in ([1.0, 0, 0], [0.0, 0, 0]):
        gradient = jit_unoptimized(jax.grad(of, (0, 1)))(jnp.array(pos), jnp.zeros(3))
        assert np.all(np.isfinite(gradient))


@pytest.mark.float32
def test_the_longer_the_patience_the_longer_the_episode():
    assert make("crowd", patience=2.0).steps == pytest.approx(2 * make("crowd").steps, abs=1)
    with pytest.raises(ValueError, match="patience"):
        make("crowd", patience=0.5)


@pytest.mark.slow
@pytest.mark.float32
def test_in_half_of_the_trainings_of_swap_goals_drones_start_in_a_box():
    env = make("swap-goals", drones=8, random_places=True)
    _, worlds = jit_unoptimized(jax.vmap(env.reset))(jax.random.split(jax.random.key(1), 200))
    pos, goal = np.asarray(worlds.drones.pos), np.asarray(worlds.variables["goal"])
    on_ring = np.abs(np.linalg.norm(goal[..., :2], axis=-1) - 1).max(axis=1) < 1e-3
    assert 0.35 < np.mean(on_ring) < 0.65
    np.testing.assert_allclose(goal[on_ring][..., 2], 2.0, rtol=1e-6)
    assert np.all(np.abs(pos[on_ring] - np.array([0, 0, 2])).max(axis=(1, 2)) < 1.2)
    extent = np.ptp(pos[~on_ring], axis=1)
    assert extent.min() > 0.3 and np.median(extent) < 1.35, "a box of 1.7 m, not a ring"
    for places in (pos, goal):
        apart = np.linalg.norm(places[:, :, None] - places[:, None], axis=-1) + 9 * np.eye(8)
        assert apart.min() > 4 * float(env.params.collision_radius[0])
