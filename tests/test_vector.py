"""Functions that replace those of the library."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdrones.vector import atan2, safe_sqrt, sin_cos

rng = np.random.default_rng(0)


def test_the_angle_of_a_point_is_that_of_the_library_in_all_quadrants_and_at_any_distance():
    y, x = rng.normal(size=(2, 10_000)) * 10.0 ** rng.uniform(-150, 150, 10_000)
    np.testing.assert_allclose(jax.jit(atan2)(y, x), np.arctan2(y, x), rtol=0, atol=1e-15)
    np.testing.assert_allclose(jax.jit(atan2)(1e-9 * y, x), np.arctan2(1e-9 * y, x), rtol=1e-15)


@pytest.mark.float32
def test_single_precision_has_the_accuracy_that_is_stated():
    """A relative error of 2e-8 of the arctangent and of 5e-9 of the sine, beside the rounding of their arguments."""
    eps = np.finfo(np.float32).eps
    small, large = np.linspace(1e-6, 1, 200_001, dtype=np.float32), np.float32(1)
    for y, x in ((small, large), (large, small), (small, -large), (-large, small), (-small, -large)):
        y, x = np.broadcast_arrays(y, x)
        exact = np.arctan2(y.astype(float), x)
        assert np.max(np.abs(jax.jit(atan2)(y, x) / exact - 1)) < 2 * eps + 2e-8
    x = np.linspace(-20, 20, 200_001, dtype=np.float32)
    for mine, exact in zip(jax.jit(sin_cos)(x), (np.sin(x.astype(float)), np.cos(x.astype(float))), strict=True):
        assert np.all(np.abs(mine - exact) < (np.abs(x) + 2) * eps)


@pytest.mark.float32
@pytest.mark.parametrize("angle", [0.0, 1.0, 45.0, 90.0, 135.0, 180.0, 270.0])
def test_single_precision_is_continuous_from_branch_to_branch(angle):
    """Whichever branch is taken of a point on a border, the angle is right, except for whole turns."""
    turn = np.radians(angle) + np.linspace(-4e-7, 4e-7, 101)
    wrong = jax.jit(atan2)(np.sin(turn).astype(np.float32), np.cos(turn).astype(np.float32)) - turn
    np.testing.assert_allclose((wrong + np.pi) % (2 * np.pi) - np.pi, 0, atol=5e-7)


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


def test_sine_and_cosine_are_those_of_the_library_over_many_turns():
    x = np.concatenate([rng.uniform(-50, 50, 10_000), np.arange(-8, 9) * np.pi / 4])
    for mine, library in zip(jax.jit(sin_cos)(x), (np.sin(x), np.cos(x)), strict=True):
        np.testing.assert_allclose(mine, library, rtol=0, atol=4e-15)  # the rounding of 16 half turns
    sin, cos = jax.jit(sin_cos)(np.linspace(-np.pi, np.pi, 10_001))
    np.testing.assert_allclose(sin**2 + cos**2, 1, rtol=0, atol=1e-15)


def test_their_derivatives_are_each_other():
    x = rng.uniform(-5, 5, 100)
    sin, cos = sin_cos(x)
    by_sin, by_cos = (jax.vmap(jax.grad(lambda x, i=i: sin_cos(x)[i]))(x) for i in (0, 1))
    np.testing.assert_array_equal(by_sin, cos)
    np.testing.assert_array_equal(by_cos, -sin)


def test_gradients_are_zero_where_an_angle_or_a_root_has_none():
    """At the origin; first and second ones, however they are taken."""
    origin = jnp.zeros(2)
    for derived in (jax.jacrev, jax.jacfwd, jax.hessian):
        np.testing.assert_array_equal(jax.jit(derived(lambda p: atan2(p[0], p[1])))(origin), 0)
        np.testing.assert_array_equal(jax.jit(derived(lambda p: safe_sqrt(p[0])))(origin), 0)
    assert np.isfinite(jax.jit(jax.grad(lambda x: atan2(x * 0, x * 0) + safe_sqrt(x - x)))(3.0))


def test_the_root_is_that_of_the_library_with_its_derivatives():
    x = jnp.array([-1.0, 0.0, 1e-300, 2.0, jnp.inf, jnp.nan])
    np.testing.assert_array_equal(safe_sqrt(x), np.sqrt(np.maximum(x, 0)))
    for order in jax.grad, jax.hessian:
        np.testing.assert_allclose(
            jax.jit(jax.vmap(order(safe_sqrt)))(x[2:4]), jax.jit(jax.vmap(order(jnp.sqrt)))(x[2:4]), rtol=1e-15
        )
