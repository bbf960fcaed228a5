"""Of the surfaces along a pixel's ray the nearest one is seen, in whatever pass it is looked for."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import jit_unoptimized, mostly_slow

import jaxdrones
from jaxdrones import Camera, Scene, State, render, rotation
from jaxdrones.sensing import Box, Sphere
from jaxdrones.sensing.frustum import placed_in
from jaxdrones.sensing.images import view_of
from jaxdrones.sensing.visibility import depth, surfaces, visible

CAMERA = Camera(resolution=(40, 12), field_of_view=70, far=30.0)
CRAZYFLIE = jaxdrones.load_params("cf2x")


def look(scene: Scene, dtype: type) -> list[np.ndarray]:
    """Depth; index and depth of the pass for segmentation; depth and index of the pass for derivatives."""
    quat = rotation.from_rpy(jnp.array([0.1, 0.05, 0.02]))
    state = jax.tree.map(lambda x: x[0], State.at_rest(jnp.zeros((1, 3)))).replace(quat=quat)
    view = jax.tree.map(lambda x: jnp.asarray(x, dtype), view_of(CAMERA, CRAZYFLIE, state))
    solids = [kind.replace(active=None) for kind in scene.shapes(dtype)]
    active = [kind.active for kind in scene.shapes(dtype)]

    @jax.jit
    def passes(view, solids):
        index, about = visible(view, solids, active)
        return [depth(view, solids, active), index, about, *surfaces(view, solids, active)]

    return [np.asarray(x) for x in passes(view, solids)]


@pytest.mark.parametrize("dtype", mostly_slow([np.float32, np.float64], [np.float32]))
def test_all_passes_see_the_same(dtype):
    rng = np.random.default_rng(1)
    low, high = [4, -6, -3], [20, 6, 3]
    boxes = Box(pos=rng.uniform(low, high, (40, 3)), size=rng.uniform(1, 3, (40, 3)))
    scene = Scene.of(boxes, Sphere(pos=rng.uniform(low, high, (40, 3)), radius=rng.uniform(0.5, 1.5, 40)), ground=False)
    depths, index, about, same_depths, same_index = look(scene, dtype)
    assert 0.3 < np.mean(depths < CAMERA.far) < 0.95 and len(np.unique(index)) > 10
    same = (index == same_index) & ((index == 80) == (depths == CAMERA.far))
    assert np.mean(~same) < 0.005  # at silhouettes, which passes may round differently
    np.testing.assert_allclose(about[same], depths[same], rtol=2e-5)
    np.testing.assert_allclose(same_depths[same], depths[same], rtol=1e-5)


@pytest.mark.parametrize("others", mostly_slow([0, 3000], [3000]))
def test_a_wall_hides_another_one_a_millimeter_behind(others):
    """Among three thousand solids, too: an index takes no more bits of a depth than there are to spare.

    The others are in front, but inactive.
    """
    pos = np.array([[10.501, 0, 0], [10.5, 0, 0], [12, 0, 0]] + [[5.0, 0, 0]] * others)
    walls = Box(pos=pos, size=(1.0, 100.0, 100.0), active=np.arange(3 + others) < 3)
    index = look(Scene.of(walls, ground=False), np.float32)[1]
    np.testing.assert_array_equal(index, 1)


@pytest.mark.parametrize("side", [1, 2])
def test_a_ball_beside_the_view_is_in_it_as_far_as_its_radius_reaches(side):
    view = view_of(CAMERA, CRAZYFLIE, jax.tree.map(lambda x: x[0], State.at_rest(jnp.zeros((1, 3)))))
    slope = np.max(np.abs(view.u if side == 1 else view.v))
    outward, edge = (np.array([x, 0.0, 0.0]) for x in (-slope, 1.0))
    outward[side], edge[side] = 1.0, slope
    for beyond in 0.9, 1.1:
        ball = Sphere(pos=5 * edge + beyond * outward / np.linalg.norm(outward), radius=1.0)
        assert placed_in(view, ball).in_view(view) == (beyond < 1)


@pytest.mark.slow
def test_a_ball_looks_and_moves_the_same_beside_a_box():
    """Kinds are looked at one after the other, and with one solid the second place in a turn stays empty."""
    ball, box = Sphere(pos=(3.0, 0.5, 0.3), radius=1.0), Box(pos=(3.0, -1.5, 0.0), size=(1.0, 1.0, 1.0))
    params, state = jaxdrones.repeat(CRAZYFLIE, 1), State.at_rest(jnp.zeros((1, 3)))

    def seen(scene: Scene, label: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        def image(pos):
            images = render(scene, params, state.replace(pos=pos), CAMERA)
            return images.depth, images

        moved = jit_unoptimized(lambda pos: jax.jvp(image, (pos,), (pos + 1,), has_aux=True))
        _, rate, images = moved(state.pos)
        return np.asarray(images.segmentation == label), np.asarray(images.rgb), np.asarray(rate)

    alone, rgb, rate = seen(Scene.of(ball, ground=False), 2)
    beside, same_rgb, same_rate = seen(Scene.of(ball, box, ground=False), 3)
    np.testing.assert_array_equal(alone, beside)
    assert alone.sum() > 20
    np.testing.assert_array_equal(same_rgb[alone], rgb[alone])
    np.testing.assert_allclose(same_rate[alone], rate[alone], rtol=1e-9)
