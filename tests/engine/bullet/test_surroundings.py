"""Obstacles of a call stand where its scene says, whatever stood there before."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close

import jaxdrones as jd
from jaxdrones import State
from jaxdrones.engine import bullet
from jaxdrones.sensing import Box, Scene, Sphere

pytestmark = pytest.mark.needs("pybullet")

TEAM = jd.repeat(jd.load_params("cf2x"), 2)
HOVER = jnp.broadcast_to(TEAM.hover_rpm[:, None], (2, 4))


def forest(key: jax.Array) -> Scene:
    """Five boxes and three balls of random sizes around the team, and a floor slab under the first drone."""
    places, sizes = jax.random.split(key)
    boxes = Box(pos=jax.random.uniform(places, (5, 3), float, 1.0, 3.0), size=jax.random.uniform(sizes, (5, 3)) + 0.1)
    balls = Sphere(pos=jax.random.uniform(sizes, (3, 3), float, -3.0, -1.0), radius=0.2)
    return Scene.of(boxes, balls, corner(jax.random.uniform(key, (), float, 0.3, 1.3)))


def corner(height) -> Box:
    """A floor and two walls that a drone at (0.05, 0.05, height + 0.1) falls into."""
    pos = jnp.array([[0.0, 0.0, -0.05], [-0.1, 0.0, 0.2], [0.0, -0.1, 0.2]])
    size = jnp.array([[0.6, 0.6, 0.1], [0.16, 0.6, 0.4], [0.6, 0.16, 0.4]])
    return Box(pos=pos.at[:, 2].add(height), size=size)


def resting(step, scene, height, steps=30):
    state = State.at_rest(jnp.array([[0.05, 0.05, height + 0.02], [5.0, 5.0, 1.0]]))
    for _ in range(steps):
        state = step(TEAM, state, 0.3 * HOVER, scene)
    return state


@pytest.mark.slow
def test_a_scene_of_a_call_is_that_of_a_step_built_with_it_whatever_was_called_between():
    scenes = [Scene.of(corner(0.5)), Scene.of(corner(1.0), ground=False), forest(jax.random.key(1))]
    expected = []
    for scene in scenes:
        with bullet.make_step(scene=scene) as step:
            expected.append(resting(step, None, 0.5))
    with bullet.make_step() as step:
        for i in (0, 1, 0, 2, 1, 2, 0):
            actual = resting(step, scenes[i], 0.5)
            jax.tree.map(np.testing.assert_array_equal, actual, expected[i])
    assert not np.array_equal(expected[0].pos, expected[1].pos)


@pytest.mark.slow
def test_many_worlds_have_a_scene_each_in_a_compiled_program():
    keys = jax.random.split(jax.random.key(2), 3)
    start = State.at_rest(jnp.array([[0.05, 0.05, 0.45], [2.0, 2.0, 2.0]]))
    with bullet.make_step(substeps=3) as step:
        fly = jax.jit(jax.vmap(lambda key: step(TEAM, start, 0.5 * HOVER, forest(key))))
        together = fly(keys)
        for i, key in enumerate(keys):
            alone = step(TEAM, start, 0.5 * HOVER, forest(key))
            assert_close(jax.tree.map(lambda x, i=i: x[i], together), alone, 1e-12)
            assert {c.other for c in step.contacts(TEAM, start, forest(key))} <= {f"obstacle {j}" for j in range(11)}


def test_an_obstacle_that_is_not_active_is_not_there_and_the_others_keep_their_numbers():
    place = jnp.array([[0.0, 0.0, 0.705], [5.0, 5.0, 0.705]])
    state = State.at_rest(place + jnp.array([[0.0, 0.0, 0.295]]))
    with bullet.make_step() as step:
        for active in ([True, True], [False, True], [True, False], [False, False]):
            scene = Scene.of(Sphere(pos=place, radius=0.3, active=jnp.array(active)))
            touching = {(c.body, c.other) for c in step.contacts(TEAM, state, scene)}
            assert touching == {(f"drone {i}", f"obstacle {i}") for i in range(2) if active[i]}
            below = State.at_rest(place)
            inside = step.camera(TEAM, below, scene=scene).segmentation == jnp.array([3, 4])[:, None, None]
            np.testing.assert_array_equal(jnp.all(inside, axis=(1, 2)), active)


def test_a_moved_obstacle_is_touched_where_it_is_and_the_camera_sees_it_there():
    ball = Sphere(pos=(0.0, 0.0, 0.0), radius=0.3)
    with bullet.make_step() as step:
        for place in ([0.0, 0.0, 0.705], [5.0, 5.0, 0.705], [0.0, 0.0, 0.705]):
            scene = Scene.of(ball.replace(pos=jnp.array(place)))
            state = State.at_rest(jnp.array([[0.0, 0.0, 1.0], [5.0, 5.0, 1.0]]))
            touching = {(c.body, c.other) for c in step.contacts(TEAM, state, scene)}
            assert touching == {("drone 0" if place[0] == 0 else "drone 1", "obstacle 0")}
            away = State.at_rest(jnp.array([place, [9.0, 9.0, 1.0]]) - jnp.array([[2.0, 0, 0], [0, 0, 0]]))
            images = step.camera(TEAM, away, scene=scene)
            assert images.segmentation[0, 24, 32] == 3 and abs(images.depth[0, 24, 32] - 1.7) < 0.02  # facets
