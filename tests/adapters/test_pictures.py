"""Pictures from the side show what is there, of one world and of many."""

from types import SimpleNamespace

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxdrones as jd
from jaxdrones.adapters import pictures
from jaxdrones.adapters.gymnasium import GymnasiumEnv, VectorEnv
from jaxdrones.sensing import Camera, Scene, Sphere, photograph


@pytest.mark.slow
def test_the_target_is_in_the_middle_of_a_photograph_and_what_is_above_it_above():
    red, blue = (1.0, 0, 0, 1.0), (0.0, 0, 1, 1)
    balls = Sphere(pos=[(3.0, 4, 5), (3, 4, 5.5)], radius=[0.2, 0.2], color=[red, blue])
    params, state = jd.repeat(jd.load_params("cf2x"), 1), jd.State.at_rest(jnp.zeros((1, 3)))
    scene, camera = Scene.of(balls), Camera(resolution=(33, 33), field_of_view=40.0)
    for eye in ([0.0, 0, 5], [5.0, 6, 6]):
        picture = np.asarray(photograph(scene, params, state, eye, [3.0, 4, 5], camera), int)
        assert picture[16, 16].argmax() == 0 and picture[16, 16, 2] == 0
        rows = np.flatnonzero((picture[:, 16, 2] > 60) & (picture[:, 16, 0] == 0))
        assert len(rows) > 1 and rows.max() < 16
    with pytest.raises(ValueError, match="eye has shape"):
        photograph(scene, params, state, jnp.zeros(2), jnp.zeros(3))


@pytest.mark.slow
def test_a_compiled_photograph_in_float32_leaves_one_in_float64_as_it_is():
    def taken(eye):
        params, state = jd.repeat(jd.load_params("cf2x"), 1), jd.State.at_rest(jnp.zeros((1, 3)))
        return photograph(
            Scene.of(Sphere(pos=[(3.0, 4, 5)], radius=[0.2])), params, state, eye, jnp.array([3.0, 4, 5]), camera
        )

    camera = Camera(resolution=(9, 9))
    with jax.enable_x64(False):
        compiled = jax.jit(taken)(jnp.array([0.0, 0, 5]))
    np.testing.assert_array_equal(taken(jnp.array([0.0, 0, 5])), compiled)


def test_a_picture_is_of_the_drones_that_are_still_in_the_world():
    def camera(pos, active):
        return pictures._side(SimpleNamespace(drones=jd.State.at_rest(jnp.array(pos)), active=jnp.array(active)))

    near, left = [[0.0, 1, 2], [1.0, 0, 3]], [1e4, 0, 1e4]
    expected = camera(near, [True, True])
    for found in camera([*near, left], [True, True, False]), camera([left, *near], [False, True, True]):
        np.testing.assert_allclose(found, expected)
    np.testing.assert_allclose(camera(near, [False, False]), expected)
    eye, center = camera([[0.0, 0, 1]], [True])
    assert np.linalg.norm(eye - center) > 1  # of a single drone, too


def test_a_picture_before_the_first_reset_is_refused():
    assert pictures.wanted("rgb_array", True)
    with pytest.raises(gymnasium.error.ResetNeeded, match="call reset"):
        pictures.wanted("rgb_array", False)


@pytest.mark.slow
def test_a_world_of_many_looks_as_it_does_alone():
    one = GymnasiumEnv("hover", drones=2, render_mode="rgb_array")
    many = VectorEnv("hover", 3, drones=2, render_mode="rgb_array")
    assert many.metadata["render_modes"] == ["rgb_array"] and many.metadata["render_fps"] == one.metadata["render_fps"]
    with pytest.raises(gymnasium.error.ResetNeeded):
        many.render()
    many.reset(seed=4)
    pictures = many.render()
    assert isinstance(pictures, tuple) and len(pictures) == 3
    for i, picture in enumerate(pictures):
        one.reset(seed=4 + i)
        assert picture.shape == (480, 640, 3) and picture.dtype == np.uint8
        assert np.abs(picture.astype(int) - one.render()).mean() < 0.1
    assert np.abs(pictures[0].astype(int) - pictures[1]).mean() > 1
    assert np.unique(pictures[0][..., 0]).size > 20


@pytest.mark.slow
def test_rendering_needs_its_mode(recwarn):
    envs = VectorEnv("hover", 2)
    envs.reset(seed=0)
    assert envs.render() is None and "render_mode" in str(recwarn.pop().message)
    with pytest.raises(ValueError, match="unknown render_mode 'human'"):
        VectorEnv("hover", 2, render_mode="human")


@pytest.mark.slow
@pytest.mark.needs("pybullet")
def test_bullet_makes_the_pictures_of_its_own_backend():
    with jd.make("hover", backend="bullet", drones=2) as on_bullet:
        envs = VectorEnv(on_bullet, 2, render_mode="rgb_array")
        envs.reset(seed=4)
        pictures = envs.render()
    ours = VectorEnv("hover", 2, drones=2, render_mode="rgb_array")
    ours.reset(seed=4)
    assert pictures[0].shape == ours.render()[0].shape
    both = (picture.astype(int) for picture in (pictures[0], ours.render()[0]))
    drones = [(picture[..., 0] > picture[..., 1] + 60).sum() for picture in both]
    assert min(drones) > 0 and abs(np.log(drones[0] / drones[1])) < 0.7  # the red discs are as large


@pytest.mark.slow
def test_a_photograph_can_be_taken_in_a_compiled_program():
    params, state = jd.repeat(jd.load_params("cf2x"), 2), jd.State.at_rest(jnp.array([[0.0, 0, 1], [0.5, 0, 1]]))
    camera = Camera(resolution=(16, 12))
    look = jax.jit(jax.vmap(lambda eye: photograph(Scene(), params, state, eye, jnp.array([0.25, 0, 1]), camera)))
    front, side = look(jnp.array([[2.0, 0, 1.2], [0.25, -2, 1.2]]))
    assert front.shape == (12, 16, 3) and jnp.any(front != side)


@pytest.mark.slow
@pytest.mark.needs("moviepy")
def test_gymnasium_records_videos(tmp_path):
    envs = VectorEnv("hover", 2, duration=0.1, render_mode="rgb_array", autoreset_mode="NextStep")
    recorder = gymnasium.wrappers.vector.RecordVideo(
        envs, str(tmp_path / "videos"), video_aspect_ratio=(1, 1), record_first_only=True
    )
    recorder.reset(seed=0)
    for _ in range(12):
        recorder.step(np.zeros((2, 4), np.float32))
    recorder.close()
    assert any(file.stat().st_size > 1000 for file in tmp_path.rglob("*.mp4"))
