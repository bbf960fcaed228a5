"""Functions that replace those of the library."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdrones.vector import asin, atan2, sin_cos

rng = np.random.default_rng(0)


def test_the_angle_of_a_point_is_that_of_the_library_in_all_quadrants_and_at_any_distance():
    y, x = rng.normal(size=(2, 10_000)) * 10.0 ** rng.uniform(-150, 150, 10_000)
    np.testing.assert_allclose(jax.jit(atan2)(y, x), np.arctan2(y, x), rtol=0, atol=1e-15)
    np.testing.assert_allclose(jax.jit(atan2)(1e-9 * y, x), np.arctan2(1e-9 * y, x), rtol=1e-15)


@pytest.mark.float32
def test_it_is_as_exact_in_float32():
    y, x = rng.normal(size=(2, 10_000)).astype(np.float32)
    np.testing.assert_allclose(jax.jit(atan2)(y, x), np.arctan2(y.astype(float), x), rtol=0, atol=4e-7)


@pytest.mark.parametrize("y", [-1.0, -0.0, 0.0, 1.0])
@pytest.mark.parametrize("x", [-1.0, 0.0, 1.0])
def test_axes_and_diagonals_are_met_with_the_sign_of_y(y, x):
    np.testing.assert_allclose(atan2(jnp.array(y), jnp.array(x)), np.arctan2(y, x), rtol=0, atol=5e-16)
    assert np.signbit(atan2(jnp.array(y), jnp.array(x))) == np.signbit(y)


def test_the_angle_of_what_is_not_a_number_is_none():
    assert jnp.isnan(atan2(jnp.array(jnp.nan), jnp.array(1.0)))
    assert jnp.isnan(atan2(jnp.array(1.0), jnp.array(jnp.nan)))


def test_its_derivatives_are_those_of_the_library():
    points = rng.normal(size=(100, 2))
    mine, library = (jax.jit(jax.vmap(jax.jacrev(lambda p, f=f: f(p[0], p[1]))))(points) for f in (atan2, jnp.arctan2))
    np.testing.assert_allclose(mine, library, rtol=1e-13)


def test_the_arcsine_is_that_of_the_library_to_the_ends():
    s = np.concatenate([np.linspace(-1, 1, 10_001), 1 - np.logspace(-15, -1, 100)])
    np.testing.assert_allclose(jax.jit(asin)(s), np.arcsin(s), rtol=0, atol=5e-16)


def test_sine_and_cosine_are_those_of_the_library_over_many_turns():
    x = np.concatenate([rng.uniform(-50, 50, 10_000), np.arange(-8, 9) * np.pi / 4])
    for mine, library in zip(jax.jit(sin_cos)(x), (np.sin(x), np.cos(x)), strict=True):
        np.testing.assert_allclose(mine, library, rtol=0, atol=4e-15)  # the rounding of 16 half turns
    sin, cos = jax.jit(sin_cos)(np.linspace(-np.pi, np.pi, 10_001))
    np.testing.assert_allclose(sin**2 + cos**2, 1, rtol=0, atol=1e-15)


@pytest.mark.float32
def test_they_are_as_exact_in_float32():
    x = rng.uniform(-4, 4, 10_000).astype(np.float32)
    for mine, library in zip(jax.jit(sin_cos)(x), (np.sin(x.astype(float)), np.cos(x.astype(float))), strict=True):
        np.testing.assert_allclose(mine, library, rtol=0, atol=4e-7)


def test_their_derivatives_are_each_other():
    x = rng.uniform(-5, 5, 100)
    sin, cos = sin_cos(x)
    by_sin, by_cos = (jax.vmap(jax.grad(lambda x, i=i: sin_cos(x)[i]))(x) for i in (0, 1))
    np.testing.assert_array_equal(by_sin, cos)
    np.testing.assert_array_equal(by_cos, -sin)


def test_gradients_are_zero_where_an_angle_has_none():
    """At the origin, and at the ends of the arcsine; first and second ones, however they are taken."""
    origin, ends = jnp.zeros(2), jnp.array([-1.0, 1.0])
    for derived in (jax.jacrev, jax.jacfwd, jax.hessian):
        np.testing.assert_array_equal(jax.jit(derived(lambda p: atan2(p[0], p[1])))(origin), 0)
    for derived in (jax.grad, jax.jacfwd, jax.hessian):
        np.testing.assert_array_equal(jax.jit(jax.vmap(derived(asin)))(ends), 0)
    assert np.isfinite(jax.jit(jax.grad(lambda x: atan2(x * 0, x * 0) + asin(x / x)))(3.0))


def test_derivatives_of_the_arcsine_are_those_of_the_library_between_its_ends():
    s = np.concatenate([np.linspace(-0.999, 0.999, 1001), 1 - np.logspace(-12, -1, 50)])
    np.testing.assert_allclose(jax.jit(jax.vmap(jax.grad(asin)))(s), 1 / np.sqrt((1 - s) * (1 + s)), rtol=1e-9)


def test_what_has_no_arcsine_is_not_a_number():
    assert np.isnan(asin(jnp.array([-1.1, 1.1, jnp.nan]))).all()
