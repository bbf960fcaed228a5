"""Range finders and optical flow measure what geometry says, as far and as often as they can."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_finite, jit_unoptimized

import jaxdrones as jd
from jaxdrones.sensing import (
    Box,
    Scene,
    Sensor,
    Sphere,
    downward_range,
    lidar,
    multi_ranger,
    optical_flow,
    range_finder,
    time_of_flight,
)
from jaxdrones.sensing.sensor import is_due, measure_sensors

TEAM = jd.repeat(jd.load_params("cf2x"), 1)
ROOM = Scene.of(  # walls at x = 2, x = -1, y = 1.5, y = -0.5 and a ceiling at z = 2.5
    Box(pos=(2.5, 0, 1), size=(1, 20, 20)),
    Box(pos=(-1.5, 0, 1), size=(1, 20, 20)),
    Box(pos=(0, 2.0, 1), size=(20, 1, 20)),
    Box(pos=(0, -1.0, 1), size=(20, 1, 20)),
    Box(pos=(0, 0, 3.0), size=(20, 20, 1)),
)
WALL = Scene.of(Box(pos=(2.5, 0, 1), size=(1, 20, 20)), ground=False)
HERE = jnp.array([0.0, 0.0, 1.0])


def at(pos=HERE, rpy=(0.0, 0.0, 0.0), vel=(0.0, 0.0, 0.0), omega=(0.0, 0.0, 0.0)):
    quat = jd.rotation.from_rpy(jnp.asarray(rpy, float))[None]
    return jd.State.at_rest(jnp.asarray(pos, float)[None]).replace(
        quat=quat, vel=jnp.asarray(vel, float)[None], omega=jnp.asarray(omega, float)[None]
    )


@partial(jax.jit, static_argnums=0)
def reading(sensor, state, scene=ROOM, key=None):
    key = jax.random.key(0) if key is None else key
    return measure_sensors((sensor,), key, TEAM, state, state, scene, {sensor.name: None})[1][sensor.name][0]


def test_a_multi_ranger_measures_to_the_front_back_left_right_and_up():
    deck = multi_ranger()
    np.testing.assert_allclose(reading(deck, at()), [2, 1, 1.5, 0.5, 1.5])
    np.testing.assert_allclose(reading(deck, at(rpy=(0, 0, np.pi / 2))), [1.5, 0.5, 1, 2, 1.5])
    np.testing.assert_allclose(reading(multi_ranger(max_range=1.2), at()), [1.2, 1, 1.2, 0.5, 1.2])
    assert deck.bound == 4.0 and deck.rate == 10.0


def test_a_tilted_drone_measures_a_longer_way_to_the_ground():
    for roll, pitch in (0.3, 0.0), (-0.2, 0.4):
        range_ = reading(downward_range(), at(rpy=(roll, pitch, 1.0)))
        np.testing.assert_allclose(range_, [1 / (np.cos(roll) * np.cos(pitch))])


def test_a_lidar_sees_the_walls_around_it_and_turns_with_the_drone():
    scanner = lidar(beams=8)
    scan = np.minimum([2, 1.5 * np.sqrt(2), 1.5, np.sqrt(2), 1, 0.5 * np.sqrt(2), 0.5, 0.5 * np.sqrt(2)], 12)
    np.testing.assert_allclose(reading(scanner, at()), scan)
    np.testing.assert_allclose(reading(scanner, at(rpy=(0, 0, np.pi / 4))), np.roll(scan, -1))


def test_a_grid_looks_up_in_its_first_row_and_left_in_its_first_column():
    """At a wall ahead, under a ceiling, and with a wall to the left."""
    sensor, angle = time_of_flight(zones=4), np.radians(45 / 4 * (1.5 - np.arange(4)))
    up, left = np.meshgrid(np.tan(angle), np.tan(angle), indexing="ij")
    slant = np.sqrt(1 + up**2 + left**2)
    np.testing.assert_allclose(reading(sensor, at(), WALL), 2 * slant)
    ceiling = Scene.of(Box(pos=(0, 0, 2.2), size=(20, 20, 2)), ground=False)
    above = np.where(up > 0, 0.2 * slant / np.abs(up), 4)
    np.testing.assert_allclose(reading(sensor, at(), ceiling), np.minimum(above, 4))
    side = Scene.of(Box(pos=(0, 1.2, 1), size=(20, 2, 20)), ground=False)
    np.testing.assert_allclose(reading(sensor, at(), side), np.minimum(above, 4).T)


def test_a_device_is_turned_and_placed_on_the_body():
    backwards = range_finder(
        "tail", np.array([1.0, 0, 0]), max_range=9.0, offset=(-0.1, 0, 0), orientation=(0, 0, 1, 0)
    )
    np.testing.assert_allclose(reading(backwards, at()), 0.9)
    np.testing.assert_allclose(reading(backwards, at(rpy=(0, 0, np.pi))), 1.9)
    quarter = (0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5))  # the device's x axis is the body's y axis
    leftwards = range_finder("left", np.array([1.0, 0, 0]), max_range=9.0, orientation=quarter)
    np.testing.assert_allclose(reading(leftwards, at()), 1.5)
    np.testing.assert_allclose(reading(leftwards, at(rpy=(0.3, 0, 0))), 1.5 / np.cos(0.3))


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        (dict(directions=np.array([[1.0, 0, 0], [0, 0, 0]])), "has no length or is not finite"),
        (dict(directions=np.array([0, np.nan, 1.0])), "has no length or is not finite"),
        (dict(directions=np.ones((3, 2))), r"have shape \(3, 2\); give \(..., 3\)"),
        (dict(directions=1.0), r"have shape \(\); give \(..., 3\)"),
        (dict(orientation=(0, 0, 0, 0)), "orientation of a range finder has length 0"),
        (dict(max_range=-1.0), "max_range of a range finder is -1.0; give a positive number"),
        (dict(noise=-0.1), "noise of a range finder is -0.1"),
        (dict(dropout=1.5), "dropout of a range finder is 1.5"),
    ],
)
def test_beams_that_are_none_are_refused(wrong, says):
    with pytest.raises(ValueError, match=says):
        range_finder("wrong", **dict(directions=np.eye(3), max_range=4.0) | wrong)
    with pytest.raises(ValueError, match="beams of a lidar is 0; give a whole number of at least 1"):
        lidar(beams=0)
    with pytest.raises(ValueError, match="field_of_view is 180; give a number above 0 and below 180"):
        time_of_flight(field_of_view=180)


def test_a_range_is_in_meters_whatever_the_length_of_its_direction():
    """The directions of one device have lengths from 1e-3 to 1e3, and its quaternion the largest error that passes."""
    lengths = np.array([1.0, 2.0, 0.5, 1e-3, 1e3])
    turned = range_finder(
        "turned", lengths[:, None] * [1.0, 0, 0], max_range=9.0, orientation=tuple(1.0009 * np.array([0, 0, 1, 0]))
    )
    np.testing.assert_allclose(reading(turned, at()), np.ones(5), rtol=1e-12)
    assert {entry.name for entry in turned.entries} == {"range along (1.00, 0.00, 0.00)"}
    camera = jd.sensing.Camera(orientation=tuple(1.0009 * np.array([0, 0, 0.6, 0.8])))
    np.testing.assert_allclose(np.linalg.norm(camera.orientation), 1, rtol=1e-12)


def test_optical_flow_is_the_velocity_over_the_height_and_the_turn():
    """It vanishes where the drone turns about a point of the ground below."""
    flow = optical_flow()
    np.testing.assert_allclose(reading(flow, at((0, 0, 2), vel=(1, -0.5, 3)), Scene()), [0.5, -0.25])
    turned = at((0, 0, 2), rpy=(0, 0, np.pi / 2), vel=(1, 0, 0))
    np.testing.assert_allclose(reading(flow, turned, Scene()), [0, -0.5], atol=1e-9)
    np.testing.assert_allclose(reading(flow, at(omega=(0.3, 0.2, 5)), Scene()), [-0.2, 0.3])
    omega = np.array([0.3, 0.2, 0.0])
    about_ground = np.cross(omega, [0, 0, 2.0])
    np.testing.assert_allclose(reading(flow, at((0, 0, 2), vel=about_ground, omega=omega), Scene()), 0, atol=1e-12)
    near = at((0, 0, 0.02), vel=(0.4, 0, 0))  # out of focus: as from 8 cm
    np.testing.assert_allclose(reading(flow, near, Scene()), [0.4 / 0.08, 0])
    np.testing.assert_allclose(reading(flow, at(vel=(1, 1, 1)), Scene(ground=False)), 0)


def test_noise_stays_within_the_range_and_each_beam_drops_out_alone():
    beams = np.repeat([[1.0, 0, 0], [-1.0, 0, 0]], 50, axis=0)  # to the wall and away from it
    poor = range_finder("poor", beams, max_range=30.0, noise=3.0, dropout=0.5)
    wall, none = np.split(reading(poor, at(), WALL), 2)
    lost = wall == 30
    assert wall.min() == 0 and lost.any() and not lost.all() and np.all(none == 30)


def test_a_ray_passes_inactive_obstacles_and_is_nan_where_it_is_none():
    ghost = Scene.of(Box(pos=(2.5, 0, 1), size=(1, 20, 20), active=False), ground=False)
    assert jd.sensing.ray(ghost, HERE, jnp.array([1.0, 0, 0])) == jnp.inf
    assert jnp.isnan(jd.sensing.ray(ghost, HERE, jnp.array([jnp.nan, 0, 0])))


@pytest.mark.slow
def test_noise_has_its_deviation_and_dropouts_read_the_limit():
    scanner = lidar(beams=4000, noise=0.05, dropout=0.1)
    middle = reading(scanner, at(), Scene.of(Sphere(pos=HERE + 0.0, radius=0.01), ground=False))
    assert np.all((middle == 12) | (middle <= 0.3))
    around = Scene.of(*(Box(pos=(x, y, 1), size=(1, 1, 9)) for x, y in ((9, 0),)), ground=False)
    ahead = range_finder("many", np.tile([1.0, 0, 0], (4000, 1)), max_range=12.0, noise=0.05, dropout=0.1)
    ranges = np.asarray(reading(ahead, at(), around))
    lost = ranges == 12
    np.testing.assert_allclose(lost.mean(), 0.1, atol=0.02)
    np.testing.assert_allclose([ranges[~lost].mean(), ranges[~lost].std()], [8.5, 0.05], rtol=0.05)


def test_a_ray_that_starts_in_the_plane_of_a_face_has_a_zero_gradient():
    """Its range jumps from zero to infinity there."""
    box = Scene.of(Box(pos=(0.0, 0, 1), size=(1, 1, 1)), ground=False)
    slope = jit_unoptimized(jax.grad(jd.sensing.ray, (1, 2)))
    slopes = slope(box, jnp.array([-0.5, 0.0, 1.0]), jnp.array([0.0, 1.0, 0.0]))
    np.testing.assert_array_equal(slopes, 0)


@pytest.mark.slow
def test_the_gradient_of_a_range_is_that_of_the_way_to_the_wall():
    @jit_unoptimized
    @jax.grad
    def slope(state):
        return jnp.sum(reading(time_of_flight(), state, WALL)) + jnp.sum(reading(optical_flow(), state, WALL))

    found = slope(at())
    assert_finite(found)
    angle = np.radians(45 / 8 * (3.5 - np.arange(8)))
    up, left = np.meshgrid(np.tan(angle), np.tan(angle), indexing="ij")
    np.testing.assert_allclose(found.pos[0], [-np.sum(np.sqrt(1 + up**2 + left**2)), 0, 0], atol=1e-9)


EVERY = list(range(13))


@pytest.mark.parametrize(
    ("rate", "expected"), [(25.0, [0, 4, 8, 12]), (30.0, [0, 4, 7, 10]), (None, EVERY), (500.0, EVERY)]
)
def test_a_measurement_is_due_in_the_first_step_that_is_late_enough(rate, expected):
    """At 100 control steps per second."""
    clock = Sensor("clock", lambda key, params, state, rate, scene, memory: (None, 0.0), rate=rate)
    assert [k for k in range(13) if k == 0 or clock.is_due(k, 0.01)] == expected


@pytest.mark.float32
@pytest.mark.parametrize(("rate", "control_hz"), [(125, 240), (70, 240), (70, 120), (333, 1000)])
def test_a_measurement_is_due_after_hours_as_in_the_first_minute(rate, control_hz):
    """The k-th one is in the first step at or after k / rate, up to two million steps."""
    steps = np.append(np.arange(20_000), 2_000_000 + np.arange(20_000))
    count, before = ((steps - i) * rate // control_hz for i in (0, 1))
    clock = Sensor("clock", lambda key, params, state, rate, scene, memory: (None, 0.0), rate=float(rate))
    np.testing.assert_array_equal(clock.is_due(jnp.asarray(steps), 1 / control_hz), count > before)
    np.testing.assert_array_equal(is_due(jnp.asarray(steps), control_hz / rate), count > before)
    assert not is_due(jnp.asarray(steps[1:]), 1e12).any()  # longer than any episode


@pytest.mark.slow
def test_in_an_environment_a_sensor_measures_at_its_rate():
    env = jd.make("hover", sensors=(downward_range(rate=25.0),), observation=("downward_range",), speed=1.0)
    step = jit_unoptimized(env.step)
    key = jax.random.key(0)
    obs, world = env.reset(key)
    seen = [float(obs[0, 0])]
    for _ in range(8):
        obs, world, *_ = step(key, world, jnp.zeros((1, 4)))
        seen.append(float(obs[0, 0]))
    changes = np.flatnonzero(np.diff(seen)) + 1
    assert changes.tolist() == [4, 8]
