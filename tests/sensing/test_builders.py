"""Scenes that are drawn: the same for the same key, of the same shapes for every key, and free where asked for."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import jit_unoptimized

from jaxdrones import rotation
from jaxdrones.sensing import BEAMS, Scene, Sphere, builders, forest, gate, room, track

KEYS = jax.random.split(jax.random.key(0), 4096)
ENDS = jnp.array([[0.0, 0.0, 1.5], [20.0, 0.0, 1.5]])


@jit_unoptimized
@jax.vmap
def mixed_forests(key):
    """A forest of everything, and the distances of its obstacles alone from the two points that are kept free."""
    scene = forest(key, density=(0.05, 0.2), tilt=20.0, spheres=3, boxes=3)
    return scene, jax.vmap(scene.replace(ground=False).distance)(ENDS)


@pytest.mark.slow
def test_one_program_draws_a_forest_for_each_of_4096_worlds_and_no_two_are_the_same():
    scenes, distances = mixed_forests(KEYS)
    trees = scenes.cylinders
    assert jnp.all(distances >= 1.5 - 1e-9)
    assert len(np.unique(np.asarray(trees.pos[:, 0, 0]))) == len(KEYS)
    assert trees.pos.shape == (len(KEYS), 40, 3) and scenes.spheres.radius.shape == (len(KEYS), 3)
    again = mixed_forests(KEYS)[0]
    assert all(jnp.array_equal(a, b) for a, b in zip(jax.tree.leaves(scenes), jax.tree.leaves(again), strict=True))


@pytest.mark.slow
def test_trees_are_as_many_as_the_density_says_but_for_those_left_out():
    trees = mixed_forests(KEYS)[0].cylinders
    count = jnp.sum(trees.active, axis=1)
    area, kept_free = 20 * 10, np.pi * (1.5 + 0.2) ** 2  # m^2; half a disc at either end, of a trunk's mean radius more
    np.testing.assert_allclose(jnp.mean(count), 0.125 * (area - kept_free), rtol=0.02)
    assert 5 <= jnp.min(count) < 10 and 35 < jnp.max(count) <= 40
    assert jnp.all((trees.radius >= 0.1) & (trees.radius <= 0.3))


def test_trunks_stand_with_their_foot_in_the_strip_and_tilt_to_all_sides_as_far_as_they_may():
    corners = np.array([[0, -3, 0], [20, 3, 5.0]])

    @jit_unoptimized
    def drawn(key):
        trunks = builders._trunks(key, 500, jnp.array(corners), (0.1, 0.3), tilt=20.0)
        return trunks.pos, jax.vmap(rotation.z_axis)(trunks.quat), trunks.radius

    pos, axes, radius = map(np.asarray, drawn(KEYS[0]))
    foot = pos - 2.5 * axes
    np.testing.assert_allclose(foot[:, 2], 0, atol=1e-12)
    assert np.all((foot >= corners[0] - 1e-9) & (foot <= corners[1]))
    tilt = np.degrees(np.arccos(axes[:, 2]))
    assert tilt.max() <= 20 + 1e-9 and np.all(np.histogram(tilt, 4, (0, 20))[0] > 90)  # of 125
    assert np.abs(axes[:, :2].mean(axis=0)).max() < 0.02
    assert 0.1 <= radius.min() < 0.11 and 0.29 < radius.max() <= 0.3


def test_what_is_free_is_far_from_all_places():
    balls = Scene.of(Sphere(pos=np.array([[0, 0, 1], [5, 0, 1], [2, 9, 1]]), radius=0.5)).shapes(float)[0]
    places = jnp.array([[0.0, 0, 1], [5, 0, 1]])
    assert builders._is_free(balls, places, 1.0).tolist() == [False, False, True]


@pytest.mark.slow
def test_a_room_is_closed_and_its_pillars_keep_away_from_places():
    places = jnp.array([[1.0, 1.0, 1.0], [-1.0, 0.5, 1.0]])
    outside = jnp.array([(3.1, 0, 1.5), (-3.1, 0, 1.5), (0, 2.1, 1.5), (0, -2.1, 1.5), (0, 0, 3.1), (3.1, 2.1, 1.5)])

    @jit_unoptimized
    def distances(key):
        scene = room((6.0, 4.0, 3.0), key=key, pillars=20, keep_free=places, clearance=0.7)
        return scene.cylinders.active, jax.vmap(scene.distance)(places), jax.vmap(scene.distance)(outside)

    active, clear, beyond = distances(jax.random.key(1))
    assert 0 < jnp.sum(active) < 20 and jnp.all(clear >= 0.7) and jnp.all(beyond < 0)


distances = jit_unoptimized(jax.vmap(Scene.distance, (None, 0)))


def test_a_room_is_as_large_as_it_says_and_its_walls_are_as_thick():
    """1 cm from the middle of walls, floor and ceiling, inside, and outside but for the floor."""
    half, wall = np.array([3.0, 2.0, 1.5]), 0.2
    middle, sides = np.array([0, 0, 1.5]), np.concatenate([np.eye(3), -np.eye(3)])
    scene = room(tuple(2 * half), wall=wall)
    np.testing.assert_allclose(distances(scene, middle + (half - 0.01) * sides), 0.01, atol=1e-12)
    np.testing.assert_allclose(distances(scene, middle + (half + wall + 0.01) * sides[:5]), 0.01, atol=1e-12)


def test_the_opening_of_a_gate_is_a_square_of_the_size_that_was_asked_for_in_a_square_frame():
    """Along the two lines through the middle: free half the opening away, solid over the frame, and free again."""
    opening, frame, depth, yaw, center = 0.4, 0.16, 0.05, 0.7, np.array([1.0, 2, 3])
    scene = Scene.of(gate(center, yaw, opening, frame, depth), ground=False)
    ahead, left = np.array([np.cos(yaw), np.sin(yaw), 0]), np.array([-np.sin(yaw), np.cos(yaw), 0])
    ways = np.stack([left, -left, [0, 0, 1], [0, 0, -1]])
    inner, outer = opening / 2, opening / 2 + frame
    for along, expected in (0, inner), (inner - 0.01, 0.01), (inner + 0.01, -0.01), (outer + 0.01, 0.01):
        np.testing.assert_allclose(distances(scene, center + along * ways), expected, atol=1e-12)
    corners = np.array([a + b for a in ways[:2] for b in ways[2:]])
    np.testing.assert_allclose(distances(scene, center + (inner - 0.01) * corners), 0.01, atol=1e-12)
    np.testing.assert_allclose(distances(scene, center + (outer - 0.01) * corners), -0.01, atol=1e-12)
    thick = center + (inner + frame / 2) * ways + (depth / 2 + 0.01) * ahead
    np.testing.assert_allclose(distances(scene, thick), 0.01, atol=1e-12)


def test_a_track_is_its_gates_in_their_order():
    poses = np.array([(0.0, 0.0, 1.0, 0.3), (2.0, 1.0, 1.5, -2.0)])
    beams = track(poses).boxes
    own = gate(poses[1, :3], poses[1, 3])
    np.testing.assert_allclose(beams.pos[BEAMS:], own.pos)
    np.testing.assert_allclose(beams.quat[BEAMS:], own.quat)


@pytest.mark.parametrize(
    ("build", "error"),
    [
        (lambda: forest(3), "key is 3"),
        (lambda: forest(KEYS[0], density=1e6), "give a number of at most 10000"),
        (lambda: forest(KEYS[0], keep_free=(0, 0)), r"keep_free has shape \(2,\); give points \(k, 3\), m"),
        (lambda: room(pillars=2), "a room with pillars or clutter is drawn from a key"),
        (lambda: forest(KEYS[0], density=np.nan), "smallest density of a forest is nan"),
        (
            lambda: forest(KEYS[0], density=(0.3, 0.1)),
            "largest density of a forest is 0.1; give a number of at least 0.3",
        ),
        (lambda: forest(KEYS[0], radius=(-0.1, 0.3)), "smallest radius is -0.1; give a number of at least 0"),
        (lambda: forest(KEYS[0], length=0), r"length of a forest is 0; give a positive number \(m\)"),
        (lambda: forest(KEYS[0], tilt=90), r"tilt of a forest is 90; give .* \(degrees\)"),
        (lambda: forest(KEYS[0], boxes=-1), "boxes is -1; give a whole number of at least 0"),
        (lambda: room(size=(4, -4, 3)), "size of a room is -4; give a positive number"),
        (lambda: room(size=(4, 4)), r"size of a room has shape \(2,\); expected \(3,\)"),
        (lambda: room(wall=np.inf), "wall of a room is inf; give a positive number"),
        (lambda: room(pillars=1.5, key=KEYS[0]), "pillars is 1.5; give a whole number"),
        (lambda: gate((0, 0, 1), opening=-0.4), r"opening of a gate is -0.4; give a positive number \(m\)"),
        (lambda: gate((0, 0, 1), frame=0), "frame of a gate is 0; give a positive number"),
        (lambda: track([(0, 0, 1)]), r"gates of a track has shape \(1, 3\); expected \(k, 4\)"),
    ],
)
def test_bad_input_says_what_to_give(build, error):
    with pytest.raises(ValueError, match=error):
        build()
