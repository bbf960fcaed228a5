"""Only solids in view are tested by every pixel: the image is that of all solids, and the work is linear in them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import jit_unoptimized

import jaxdrones
from jaxdrones import Camera, Scene, State, render, rotation
from jaxdrones.sensing import Cylinder
from jaxdrones.sensing.images import view_of
from jaxdrones.vector import components

CAMERA = Camera(resolution=(16, 12), field_of_view=70, far=60.0)
PARAMS = jaxdrones.repeat(jaxdrones.load_params("cf2x"), 1)


def trees(count: int) -> Scene:
    """Trunks that lean in all directions, within 100 m."""
    rng = np.random.default_rng(0)
    quat = rng.normal(size=(count, 4))
    return Scene.of(
        Cylinder(
            pos=rng.uniform([-100, -100, 0], [100, 100, 4], (count, 3)),
            quat=quat / np.linalg.norm(quat, axis=1, keepdims=True),
            radius=0.3,
            height=5.0,
        ),
        ground=False,
    )


def looking(yaw: float) -> State:
    """A tilted drone in the middle of the trees."""
    quat = rotation.from_rpy(jnp.array([0.3, -0.2, yaw]))
    return State.at_rest(jnp.array([[0.0, 0.0, 2.0]])).replace(quat=quat[None])


@jit_unoptimized
def hits(scene: Scene, state: State) -> jax.Array:
    """(k, h, w) depth at which each pixel's ray enters each tree; infinity for a miss."""
    view = view_of(CAMERA, *jax.tree.map(lambda x: x[0], (PARAMS, state)))
    ones = jnp.ones_like(view.u + view.v)
    rays = jnp.stack([ones, view.u * ones, view.v * ones], axis=-1).reshape(-1, 3) @ view.axes

    def one(tree: Cylinder) -> jax.Array:
        ray = (rays @ rotation.to_matrix(tree.quat)).T
        first, last = tree.interval(components(tree.to_local(view.eye)), components(ray))
        first = jnp.maximum(first, CAMERA.near)
        return jnp.where((last >= first) & (first < CAMERA.far), first, jnp.inf)

    first = jax.lax.map(one, scene.shapes(view.eye.dtype)[0].replace(active=None))
    return first.reshape(-1, *reversed(CAMERA.resolution))


@pytest.mark.slow
@pytest.mark.parametrize("worlds", [1, 3])
def test_among_two_thousand_trees_a_pixel_sees_the_nearest_of_all(worlds):
    """Worlds look in different directions, so the numbers of trees in view differ."""
    scene = trees(2000)
    states = [looking(yaw) for yaw in np.linspace(0.4, 5, worlds)]
    look = jax.jit(jax.vmap(lambda state: render(scene, PARAMS, state, CAMERA)))
    images = look(jax.tree.map(lambda *x: jnp.stack(x), *states))
    for i, state in enumerate(states):
        first = np.asarray(hits(scene, state))
        nearest = np.min(first, axis=0)
        assert 0.2 < np.mean(nearest < np.inf) < 0.95
        np.testing.assert_allclose(images.depth[i, 0], np.minimum(nearest, CAMERA.far), rtol=1e-9)
        seen = np.where(nearest < np.inf, np.argmin(first, axis=0) + 2, -1)  # 0 ground, 1 drone
        np.testing.assert_array_equal(images.segmentation[i, 0], seen)


@pytest.mark.slow
def test_the_work_is_linear_in_the_trees():
    def work(count: int) -> float:
        scene = trees(count)
        look = jax.jit(lambda scene, state: render(scene, PARAMS, state, CAMERA).depth)
        return look.lower(scene, looking(0.0)).compile().cost_analysis()["flops"]

    assert work(4000) < 5 * work(1000)
