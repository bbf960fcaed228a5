"""The camera of a film is close to the team, has all of it in the picture, and moves calmly."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdrones.sensing import Box, Camera, Cylinder, Scene, Sphere, images, ray, room
from jaxdrones.visualization.overlay import Lens
from jaxdrones.visualization.shots import FIELD_OF_VIEW, _distance, shoot

SIZE = (1280, 720)
TRUNKS = np.random.default_rng(0).uniform([0, -6, 2], [20, 6, 2], (30, 3))


@pytest.fixture(scope="module")
def circle(part_of_circle):
    return part_of_circle(drones=3, seconds=4.0)


def along(record, path, scene=None):
    """The record of a flight along a path, (K,) -> (K, 3), by drones half a meter apart."""
    offsets = 0.5 * np.arange(record.pos.shape[1])[:, None] * [0, 1, 0]
    pos = path(record.t)[:, None] + offsets
    nowhere = np.full_like(pos, np.nan)
    return dataclasses.replace(record, pos=pos, target_pos=nowhere, scene=jax.device_get(scene or Scene()))


def straight(t):
    return np.stack([5 * t, 0.4 * np.sin(3 * t), 1 + 0.2 * t], axis=1)


def around(t):
    return np.stack([2 * np.cos(t), 2 * np.sin(t), 1 + 0 * t], axis=1)


FLIGHTS = {
    "circle": lambda record: record,
    "20 m": lambda record: along(record, straight),
    "forest": lambda record: along(record, straight, Scene.of(Cylinder(pos=TRUNKS, radius=0.15, height=4.0))),
    "room": lambda record: along(record, around, room()),
}


@pytest.mark.parametrize("direction", [(0.6, -0.5, 0.6), (0.0, 1.0, 0.2)])
def test_the_distance_of_a_camera_is_the_smallest_with_all_points_in_the_middle_of_the_picture(direction):
    points, middle = np.random.default_rng(0).normal(size=(50, 3)) * [3, 1, 0.5], np.array([1.0, 2.0, 3.0])
    direction = np.array(direction) / np.linalg.norm(direction)
    (away,) = _distance(points[None], 0.0, direction, SIZE[0] / SIZE[1])
    pixels, depth = Lens(middle + away * direction, middle, FIELD_OF_VIEW, SIZE).project(middle + points)
    assert (depth > 0).all()
    np.testing.assert_allclose(np.abs(pixels / SIZE - 0.5).max(), 0.85 / 2, rtol=1e-9)


def test_a_lens_projects_what_a_camera_sees_onto_the_same_pixel():
    """The center of a pixel is half a pixel from its corner."""
    eye, target = np.array([1.0, -2.0, 3.0]), np.array([4.0, 1.0, 2.0])
    lens = Lens(eye, target, FIELD_OF_VIEW, (64, 48))
    axes = np.stack(Lens.axes_of(eye, target))
    rays = images._view(
        Camera(resolution=(64, 48), field_of_view=FIELD_OF_VIEW), jnp.asarray(eye), jnp.asarray(axes), 0.1
    )
    for row, column, depth in (0, 0, 1.0), (40, 5, 7.0), (11, 60, 3.0):
        point = eye + depth * np.array([1, rays.u[0, column], rays.v[row, 0]]) @ axes
        pixel, away = lens.project(point)
        np.testing.assert_allclose([*pixel, away], [column + 0.5, row + 0.5, depth], rtol=1e-9)
    assert np.isnan(lens.project(2 * eye - target)[0]).all()  # behind the camera


@pytest.fixture(scope="module", params=FLIGHTS)
def filmed(request, circle):
    record = FLIGHTS[request.param](circle)
    return record, shoot(record, 24, SIZE[0] / SIZE[1])


def lenses(shot):
    return [Lens(eye, target, FIELD_OF_VIEW, SIZE) for eye, target in zip(shot.eyes, shot.targets, strict=True)]


@pytest.mark.slow
def test_every_drone_is_in_every_picture(filmed):
    record, shot = filmed
    for row, lens in zip(shot.rows, lenses(shot), strict=True):
        pixels, depth = lens.project(record.pos[row])
        assert (depth > 0).all() and (pixels > 0).all() and (pixels < SIZE).all()


def test_drones_are_large_enough_to_be_seen(filmed):
    record, shot = filmed
    width = 2 * shot.scale * np.linalg.norm(record.params.rotor_pos[0], axis=-1).max()
    for row, lens in zip(shot.rows, lenses(shot), strict=True):
        depth = lens.project(record.pos[row])[1]
        assert (width * SIZE[1] / 2 / np.tan(np.deg2rad(FIELD_OF_VIEW) / 2) / depth).min() > 12  # pixels


def test_the_camera_moves_calmly(filmed):
    """By less than a fifth of its distance in a tenth of a second, and without a jerk."""
    _, shot = filmed
    distance = np.linalg.norm(shot.eyes - shot.targets, axis=1).min()
    speed = 24 * np.diff(shot.eyes, axis=0)
    assert np.linalg.norm(speed, axis=1).max() < 2 * distance
    assert np.linalg.norm(np.diff(speed, axis=0), axis=1).max() < 0.2 * distance  # m/s, from frame to frame


def test_obstacles_hide_the_team_in_a_fifth_of_the_pictures_at_most(filmed):
    record, shot = filmed
    see = jax.jit(jax.vmap(lambda eye, ahead: ray(shot.scene.replace(ground=False), eye, ahead)))
    free = [np.asarray(see(shot.eyes, record.pos[shot.rows, i] - shot.eyes)) >= 1 for i in range(3)]
    assert np.mean(free) > 0.8


def test_a_flight_that_fits_is_filmed_by_a_camera_that_stands_still(circle):
    shot = shoot(circle, 24, 16 / 9)
    assert len(shot.rows) == 96 and shot.scale == 1
    assert np.ptp(shot.eyes, axis=0).max() == 0 and np.ptp(shot.targets, axis=0).max() == 0


def test_obstacles_that_hide_nothing_stay_and_a_roof_is_left_out(circle):
    balls = Sphere(pos=(0.0, 0.0, -0.5), radius=0.1), Sphere(pos=(0.0, 3.0, 0.5), radius=0.1)
    roof = Box(pos=(0.0, 0.0, 0.2 + circle.pos[..., 2].max()), size=(30.0, 30.0, 0.1))
    scene = shoot(dataclasses.replace(circle, scene=jax.device_get(Scene.of(*balls, roof))), 24, 16 / 9).scene
    assert scene.count == 2 and {type(solid) for solid in scene.numbered.values()} == {Sphere}
