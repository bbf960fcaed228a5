"""The noise of depth cameras has the statistics that it promises."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxdrones as jd
from jaxdrones.sensing import DepthNoise

KEY = jax.random.key(0)
CAMERA = jd.Camera(resolution=(100, 100), near=0.1, far=20.0)


def flat(depth: float):
    return np.full((1, 100, 100), depth)


def read_by(noise, depth):
    return np.asarray(jax.jit(lambda depth: noise.apply(KEY, depth, CAMERA))(depth))


@pytest.mark.parametrize("depth", [1.0, 4.0])
def test_the_range_scatters_with_the_square_of_the_depth(depth):
    noise = DepthNoise(spread=0.01, constant_spread=0.03)
    read = read_by(noise, flat(depth))
    deviation = np.hypot(0.01 * depth**2, 0.03)
    assert abs(read.mean() - depth) < 4 * deviation / 100  # of 10,000 pixels; four standard errors
    np.testing.assert_allclose(read.std(), deviation, rtol=0.03)


@pytest.mark.parametrize(("missing", "value"), [("zero", 0.0), ("far", 20.0)])
def test_a_share_of_the_pixels_has_no_value(missing, value):
    read = read_by(DepthNoise(dropout=0.1, missing=missing), flat(3.0))
    lost = read == value
    assert abs(lost.mean() - 0.1) < 4 * np.sqrt(0.1 * 0.9 / lost.size)
    assert np.all(lost | (read == 3.0))


def test_a_rounded_disparity_is_a_whole_number_of_steps_and_the_nearest():
    depth = np.linspace(0.2, 19.9, 10_000).reshape(1, 100, 100)
    read = read_by(DepthNoise(disparity_step=0.1), depth)
    steps = 1 / (read[read < 20] * 0.1)
    np.testing.assert_allclose(steps, np.round(steps), rtol=1e-12)
    error = np.abs(1 / read - 1 / depth)
    assert error[read < 20].max() <= 0.05 + 1e-12
    assert np.all((read == 20) == (depth > 1 / 0.05))  # less than half a step is no disparity


def test_what_shows_nothing_stays_far_and_nothing_leaves_the_limits():
    noise = DepthNoise(spread=0.1, disparity_step=0.02)
    assert jnp.all(noise.apply(KEY, flat(20.0), CAMERA) == 20.0)
    read = noise.apply(KEY, flat(15.0), CAMERA)
    assert jnp.all((read >= 0.1) & (read <= 20.0))
    np.testing.assert_array_equal(DepthNoise().apply(KEY, flat(3.0), CAMERA), flat(3.0))
    np.testing.assert_array_equal(DepthNoise(disparity_step=6.0).apply(KEY, flat(0.105), CAMERA), flat(0.1))


@pytest.mark.slow
def test_the_gradient_is_that_of_the_scatter_and_zero_where_a_pixel_is_missing():
    scatter = DepthNoise(spread=0.01)
    whole = DepthNoise(spread=0.01, disparity_step=1e-3, dropout=0.3)

    def total(noise):
        return jax.grad(lambda depth: jnp.sum(noise.apply(KEY, depth, CAMERA)))(flat(2.0))

    difference = scatter.apply(KEY, flat(2.0 + 1e-5), CAMERA) - scatter.apply(KEY, flat(2.0 - 1e-5), CAMERA)
    np.testing.assert_allclose(total(scatter), difference / 2e-5, rtol=1e-6)
    lost = whole.apply(KEY, flat(2.0), CAMERA) == 0
    np.testing.assert_allclose(total(whole), jnp.where(lost, 0, total(scatter)), rtol=1e-12)


def test_the_gradient_is_finite_also_where_something_touches_the_camera():
    noise = DepthNoise(spread=0.01)
    gradient = jax.jit(jax.grad(lambda depth: jnp.sum(noise.apply(KEY, depth, CAMERA))))(flat(0.0))
    assert np.all(np.isfinite(gradient))
