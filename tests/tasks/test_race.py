"""Races: order and overtakes, contact between control steps, progress, and flights without contact."""

import functools
import itertools
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import jit_unoptimized

from jaxdrones import load_params, repeat
from jaxdrones.envs import make
from jaxdrones.envs.randomize import AnyVehicle
from jaxdrones.sensing import Scene, Sphere
from jaxdrones.tasks import centerline
from jaxdrones.tasks.race import _clearance, _course, _grid, _in_flight, _observe_line, _order, race
from jaxdrones.tasks.racetrack import GATES, OPENING, direction, passes
from jaxdrones.tasks.starts import standing_height

START = np.array([-1.5, 0.75, 0.0, -0.2])
centerline_of = jit_unoptimized(centerline.centerline)
LINE = functools.cache(
    lambda: centerline_of(jnp.asarray(np.tile(GATES, (2, 1))), jnp.asarray(START), jnp.asarray(12.0))
)
ENV = functools.cache(lambda drones=2, **options: make("race", drones=drones, level=0, **options))
RACING = jnp.ones(2, bool)


@functools.cache
def start(drones=2):
    return jit_unoptimized(ENV(drones).reset)(jax.random.key(0))[1]


@functools.cache
def advance(drones=2, **options):
    env = ENV(drones, **options)
    return jit_unoptimized(lambda world: env.task.advance(env.task, world))


def after(before, pos, index=0, active=None, steps=0, known=None, **options):
    """Variables after a step of two drones between these positions."""
    world = start().replace(step=jnp.asarray(steps, jnp.int32))
    variables = world.variables | {"pos": jnp.asarray(before), "index": jnp.full(2, index)} | (known or {})
    drones = world.drones.replace(pos=jnp.asarray(pos))
    active = world.active if active is None else jnp.asarray(active)
    return advance(**options)(world.replace(drones=drones, variables=variables, active=active))


def overtakes(leads, racing=RACING):
    """Overtakes of two drones over a history of leads of the first, m."""
    lead, total = jnp.zeros((2, 2), jnp.int32), jnp.zeros(2)
    for x in leads:
        lead, new = _order(lead, jnp.array([5.0 + x, 5.0]), racing)
        total += new
    return total.tolist()


@pytest.mark.parametrize(
    ("leads", "counts"),
    [
        ([-0.5, 0.5], [1, 0]),
        ([0.5, -0.5], [0, 1]),
        ([-0.5, -0.1, 0.1, -0.1, 0.1, 0.3, 0.5, 0.9], [1, 0]),
        ([-0.5, 0.5, -0.5, 0.5], [2, 1]),
        ([-0.5, 0.1, -0.5], [0, 0]),
        ([0.0, 0.1, 0.5], [0, 0]),
    ],
)
def test_an_overtake_counts_once_for_the_drone_that_went_from_clearly_behind_to_clearly_ahead(leads, counts):
    assert overtakes(leads) == counts


def test_a_drone_that_left_the_race_is_not_overtaken():
    assert overtakes([-0.5]) == overtakes([-0.5, 0.5], jnp.array([True, False])) == [0, 0]


def test_drones_that_pass_through_each_other_between_two_control_steps_have_touched():
    radius = float(ENV().params.collision_radius[0])
    for gap, touched in ((1.9, True), (2.1, False)):
        aside = gap * radius
        left, right = [[0.0, 1.5, 1.0], [0.4, 1.5 + aside, 1.0]], [[0.4, 1.5, 1.0], [0.0, 1.5 + aside, 1.0]]
        np.testing.assert_array_equal(after(left, right)["touched"], [touched] * 2)
        np.testing.assert_array_equal(after(left, right, active=[True, False])["touched"], [False] * 2)


def test_gates_progress_and_time_are_those_of_drones_that_race():
    ahead = 0.1 * np.asarray(direction(jnp.asarray(GATES[0])))
    step = [GATES[0][:3] - ahead, GATES[0][:3] - ahead + 1.0], [GATES[0][:3] + ahead, GATES[0][:3] + ahead + 1.0]
    for index, active, gates in (0, [True, True], 1), (0, [False, True], 0), (4, [True, True], 4):
        variables = after(*step, index=index, active=active, steps=120)
        races = np.array(active) & (index < 4)
        assert variables["index"][0] == gates and variables["before"][0] == index
        np.testing.assert_array_equal(variables["progress"] != 0, races)
        np.testing.assert_allclose(variables["lap_time"], np.where(races, 120 * ENV().dt, 0))


def test_what_has_been_touched_and_overtaken_counts_until_the_end():
    known = {"touched": jnp.array([True, False]), "overtakes": jnp.array([2.0, 1.0])}
    place = [[0.0, 1.5, 1.0], [1.5, 1.5, 1.0]]
    variables = after(place, place, known=known)
    assert variables["touched"].tolist() == [True, False] and variables["overtakes"].tolist() == [2, 1]


def test_success_is_all_gates_of_all_laps_without_touching():
    success = race(laps=2).success
    metrics = {"gates": jnp.array([[4.0, 8, 8]]), "touched": jnp.array([[0.0, 0, 1]])}
    assert success(metrics, 0.02).tolist() == [False, True, False]


def test_beside_a_straight_centerline_a_policy_is_told_to_fly_along_and_back_to_it():
    gates = jnp.stack([jnp.array([x, 0, 1, 0]) for x in (2.0, 4, 6, 8)])
    line = centerline_of(gates, jnp.array([0.0, 0, 1, 0]), jnp.asarray(12.0))
    drones = SimpleNamespace(pos=jnp.array([[3.0, 0.1, 1.0]]))
    world = SimpleNamespace(variables={"line": line, "index": jnp.array([1])}, drones=drones)
    found = jit_unoptimized(lambda: _observe_line(None, world))()[0]
    np.testing.assert_allclose(found[:3], [np.sqrt(2 * 12 * 3.0), -3 * 0.1, 0], atol=0.05)
    np.testing.assert_allclose(found[3:].reshape(3, 3), [[x, -0.1, 0] for x in (0.3, 0.7, 1.2)], atol=0.02)
    drones.pos, world.variables["index"] = jnp.array([[0.0, 0, 1.0]]), jnp.array([0])
    assert np.linalg.norm(_observe_line(None, world)[0, :3]) >= 1.5  # at the start, where the speed is zero


def test_the_clearance_falls_off_beyond_six_centimeters_of_obstacles_and_above_where_a_drone_stands():
    scene, params = Scene.of(Sphere(pos=(0.0, 0.0, 1.0), radius=0.1)), repeat(load_params("cf2x"), 4)
    foot = standing_height(params)[0]
    pos = jnp.array([[0.25, 0, 1.0], [1.25, 0, 1.0], [1, 0, foot], [1, 0, foot - 0.06]])
    world = SimpleNamespace(scene=scene, drones=SimpleNamespace(pos=pos), params=params)
    expected = [0.03 * np.log1p(np.exp(-1)), 0, 0.03 * np.log(2), 0.03 * np.log1p(np.exp(2))]
    np.testing.assert_allclose(_clearance(None, world), expected, atol=1e-9)


def test_behind_the_last_gate_the_course_goes_straight_on():
    course = np.asarray(_course(jnp.asarray(GATES), 2))
    np.testing.assert_allclose(course[:8], np.tile(GATES, (2, 1)))
    np.testing.assert_allclose(course[8:], GATES[-1] + [[1.5, 0, 0, 0], [3, 0, 0, 0]])


def test_drones_start_in_any_order_on_the_ground_and_in_flight_along_the_centerline():
    params, line = repeat(load_params("cf2x"), 3), LINE()
    keys = jax.random.split(jax.random.key(0), 100)

    @jit_unoptimized
    def starts(keys):
        flying = jax.vmap(lambda key: _in_flight(key, params, line, 6))(keys)
        return jax.vmap(lambda key: _grid(key, params, jnp.asarray(START)))(keys), flying

    grid, (flying, index) = starts(keys)
    y = np.asarray(grid.pos)[..., 1]
    assert {*np.argmin(y, axis=1)} == {0, 1, 2} and np.all(np.abs(np.diff(np.sort(y, axis=1)) - 0.4) < 0.1)
    away = np.linalg.norm(flying.pos[:, :, None, None] - line.pos[None, None], axis=-1)
    place = np.argmin(away.reshape(100, 3, -1), axis=-1)
    assert np.mean(place // 12 == index) > 0.8 and index.min() == 0 and index.max() == 5
    way = np.diff(np.asarray(line.pos).reshape(-1, 3), axis=0)[np.minimum(place, 94)]
    assert np.mean(np.sum(way * np.asarray(flying.vel), axis=-1) > 0) > 0.9
    assert {*np.argmax(np.asarray(index), axis=1)} == {0, 1, 2}
    apart = np.linalg.norm(flying.pos[:, [0, 0, 1]] - flying.pos[:, [1, 2, 2]], axis=-1)
    assert apart.min() > 2 * params.collision_radius[0] and 0.1 < np.mean(apart < 1.2) < 0.9  # in sight or not


def test_between_its_points_the_centerline_is_straight():
    line = LINE()
    pos, along, speed = (np.asarray(x).reshape(96, -1) for x in (line.pos, line.along, line.speed))
    k, share = np.array([0, 11, 12, 94]), np.array([0.0, 0.25, 0.5, 1.0])
    place = along[k, 0] + share * (along[k + 1, 0] - along[k, 0])
    found = centerline.interpolate(line, jnp.asarray(place))
    for x, y in zip(found, (pos, along, speed), strict=True):
        expected = y[k] + share[:, None] * (y[k + 1] - y[k])
        if y is along:  # in its place is the tangent
            expected = (pos[k + 1] - pos[k]) / (along[k + 1] - along[k])
        np.testing.assert_allclose(np.reshape(x, expected.shape), expected, atol=1e-12)


@pytest.mark.slow
def test_drones_of_different_vehicles_touch_at_the_sum_of_their_own_radii():
    world = start()
    radius = jnp.array([1.0, 3.0]) * world.params.collision_radius
    world = world.replace(params=world.params.replace(collision_radius=radius))
    for gap, touched in ((0.99, True), (1.01, False)):
        pos = jnp.array([[0.0, 1.5, 1.0], [0.0, 1.5, 1.0]]).at[1, 0].add(gap * jnp.sum(radius))
        now = world.replace(drones=world.drones.replace(pos=pos), variables=world.variables | {"pos": pos})
        np.testing.assert_array_equal(advance()(now)["touched"], [touched] * 2)


@pytest.mark.slow
def test_each_of_different_vehicles_starts_on_its_own_feet():
    env = make("race", drones=3, randomize=[AnyVehicle(heaviest=0.1)])
    worlds = jit_unoptimized(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 20))[1]
    np.testing.assert_allclose(worlds.drones.pos[..., 2], jax.vmap(standing_height)(worlds.params), rtol=1e-12)


@pytest.mark.slow
def test_a_flight_along_the_centerline_makes_progress_of_its_length_and_back_none():
    line = LINE()
    way = np.asarray(line.pos[1]), np.asarray(line.pos[2])  # to the second gate, and to the third
    length = float(line.along[2, 0] - line.along[1, 3])
    steps = np.concatenate([way[0][3:], way[1][:1]])
    gained = sum(float(after([a, a], [b, a], index=1)["progress"][0]) for a, b in itertools.pairwise(steps))
    np.testing.assert_allclose(gained, length, rtol=0.04)  # means over 12 cm of a bend
    back = after([steps[3], steps[3]], [steps[2], steps[3]], index=1)
    assert back["progress"][0] < -0.05 and back["progress"][1] == 0


def test_the_centerline_passes_the_gates_in_order_and_in_their_direction():
    line = np.asarray(LINE().pos)
    for i in range(5):
        gate = GATES[i % 4]
        np.testing.assert_allclose(line[i + 1, 0], gate[:3], atol=1e-6)
        before, beyond = line[i, -1], line[i + 1, 1]
        heading = (beyond - before) / np.linalg.norm(beyond - before)
        assert heading @ np.asarray(direction(jnp.asarray(gate))) > 0.8
        assert passes(jnp.asarray(gate)[None], jnp.asarray(before)[None], jnp.asarray(beyond)[None])[0]


@pytest.mark.parametrize(("y", "counts"), [(0.0, True), (0.19, True), (0.21, False), (-0.3, False)])
def test_a_gate_is_passed_where_the_way_crosses_its_plane(y, counts):
    """Obliquely, 0.5 m to both sides of the plane in x and in y."""
    before, beyond = (jnp.array([[way, y + way, 0.1]]) for way in (-0.5, 0.5))
    assert passes(jnp.zeros((1, 4)), before, beyond).tolist() == [counts]
    assert passes(jnp.zeros((1, 4)), beyond, before).tolist() == [False]


def test_the_centerline_between_gates_on_a_circle_is_nearly_the_circle():
    angle = np.arange(4) * np.pi / 2
    gates = np.stack([np.cos(angle), np.sin(angle), np.ones(4), angle + np.pi / 2], axis=-1)
    line = centerline_of(jnp.asarray(gates), jnp.asarray([0.0, -1, 1, 0]), jnp.asarray(4.0))
    np.testing.assert_allclose(np.linalg.norm(line.pos[..., :2], axis=-1), 1, atol=2e-3)
    np.testing.assert_allclose(line.along[3, 0], 1.5 * np.pi, rtol=5e-3)
    np.testing.assert_allclose(line.speed[2:], 2.0, rtol=0.03)  # v^2 / r is the largest acceleration


def test_the_centerline_of_a_half_turn_is_flatter_than_an_arc():
    gates = np.array([(0, i, 1, np.pi * (i % 2)) for i in range(1, 5)])
    line = centerline_of(jnp.asarray(gates), jnp.asarray([0.0, 0, 1, 0]), jnp.asarray(4.0))
    np.testing.assert_allclose(line.pos[:, 6], [(x, 0.5 + i, 1) for i, x in enumerate((0.25, -0.25) * 2)], atol=1e-12)


def test_points_near_a_drone_are_those_about_the_segment_to_its_next_gate():
    flat = np.asarray(LINE().pos).reshape(-1, 3)
    for index, first in (0, 0), (1, 8), (7, 72):  # 4 points before it and 8 behind; all others may cross it
        section = LINE().near(jnp.asarray(index))
        np.testing.assert_array_equal(section.pos, flat[first : first + 24])
    np.testing.assert_allclose(jnp.linalg.norm(centerline.tangent(section, jnp.eye(24)[-1])), 1, rtol=1e-9)


def test_speeds_of_the_centerline_begin_at_rest_and_use_the_acceleration_up_to_its_limit():
    along, square = np.asarray(LINE().along).ravel(), np.asarray(LINE().speed).ravel() ** 2
    share = np.diff(square) / (2 * 12.0 * np.diff(along))
    assert square[0] == 0
    np.testing.assert_allclose([share.min(), share.max()], [-1, 1])
    gates = jnp.stack([jnp.array([x, 0, 1, 0]) for x in (1.0, 2, 3, 4)])
    straight = centerline_of(gates, jnp.array([0.0, 0, 1, 0]), jnp.asarray(12.0))
    np.testing.assert_allclose(straight.speed**2, 2 * 12.0 * straight.along, atol=1e-9)


@pytest.mark.slow
def test_without_contact_a_gate_counts_also_beside_its_opening_and_its_frame_ends_nothing():
    gate = GATES[0]
    left = np.array([-np.sin(gate[3]), np.cos(gate[3]), 0.0])
    place = gate[:3] + (OPENING / 2 + 0.08) * left  # in the frame
    ahead = 0.1 * np.asarray(direction(jnp.asarray(gate)))
    step = [place - ahead] * 2, [place + ahead, place - ahead]
    np.testing.assert_array_equal(after(*step)["index"], [0, 0])
    np.testing.assert_array_equal(after(*step, contact=False)["index"], [1, 0])
    assert after(*step)["hit"][0] and "crashed" not in ENV(contact=False).task.terminations


@pytest.mark.slow
def test_drones_start_on_the_ground_in_random_order_or_one_behind_the_other_and_apart():
    keys = jax.random.split(jax.random.key(0), 200)
    grid = np.asarray(jit_unoptimized(jax.vmap(make("race", drones=3).reset))(keys)[1].drones.pos)
    first = np.argmin(grid[..., 1], axis=1)
    np.testing.assert_allclose(np.bincount(first) / len(keys), 1 / 3, atol=0.12)  # 3.6 standard deviations
    env = make("race", drones=3, random_start=True, contact=False)
    worlds = jit_unoptimized(jax.vmap(env.reset))(keys)[1]
    pos, index = np.asarray(worlds.drones.pos), np.asarray(worlds.variables["index"])
    flying = pos[..., 2] > 0.05
    assert abs(flying.mean() - 0.8 * 0.75) < 0.1
    some, every = (of(flying, axis=1).mean() for of in (np.any, np.all))
    np.testing.assert_allclose([some, every], [0.8 * (1 - 0.25**3), 0.8 * 0.75**3], atol=0.1)
    assert index.max() == 3 and np.all(index[~flying] == 0)
    apart = np.linalg.norm(pos[:, [0, 0, 1]] - pos[:, [1, 2, 2]], axis=-1)
    assert apart.min() > 2 * float(np.max(worlds.params.collision_radius))


@pytest.mark.slow
@pytest.mark.float32
def test_observations_and_their_gradients_are_finite_for_a_drone_that_left_the_world():
    env = make("race", drones=2)
    _, world = env.reset(jax.random.key(0))
    term = env.task.observations["line"].observe

    def observed(pos):
        return term(env.task, world.replace(drones=world.drones.replace(pos=pos)))

    pos = world.drones.pos.at[1].set(jnp.array([1e4, 0.0, 1e4]))
    obs, gradient = jax.jit(lambda pos: (observed(pos), jax.grad(lambda pos: jnp.sum(observed(pos)))(pos)))(pos)
    assert np.all(np.isfinite(obs)) and np.all(np.isfinite(gradient))
