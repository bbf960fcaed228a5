"""A result that matters in few worlds is that of `vmap` where it matters, however many they are."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxdrones.accelerate.where_needed import where_needed

X = jnp.arange(1.0, 65.0)


def double(x, shared):
    return {"double": 2 * x, "sum": x + shared}


def test_what_is_needed_equals_vmap_and_the_rest_is_zero():
    computed = jax.jit(jax.vmap(where_needed(double, one_in=8), (0, 0, None)))
    expected = jax.vmap(double, (0, None))(X, 3.0)
    for count in 0, 1, 8, 9, 16, 17, 64:
        needed = np.random.default_rng(count).permutation(64) < count
        found = computed(needed, X, 3.0)
        for name in expected:
            np.testing.assert_array_equal(found[name], jnp.where(needed, expected[name], 0))


def test_derivatives_are_those_of_the_function_where_it_is_needed_and_zero_elsewhere():
    """Forward, backward and twice."""
    cube = where_needed(lambda x: x**3, one_in=8)
    for derivative in jax.grad, jax.jacfwd:
        slope = derivative(lambda x, needed: cube(needed, x))
        for f, expected in (slope, 3 * X**2), (derivative(slope), 6 * X):
            of_worlds = jax.jit(jax.vmap(f))
            for needed in (jnp.arange(64) < count for count in (0, 9, 64)):
                np.testing.assert_allclose(of_worlds(X, needed), jnp.where(needed, expected, 0), rtol=1e-12)


def test_worlds_with_one_key_get_one_result():
    key = jax.random.key(0)
    found = jax.vmap(where_needed(jax.random.normal), (0, None))(X > 3, key)
    np.testing.assert_array_equal(found, jnp.where(X > 3, jax.random.normal(key), 0))


def test_closed_over_values_are_inputs_too():
    def loss(factors):
        scaled = where_needed(lambda x: jnp.sum(factors * x**2), one_in=8)
        return jnp.sum(jax.vmap(scaled)(X > 3, X))

    np.testing.assert_allclose(jax.grad(loss)(jnp.ones(2)), np.sum(np.asarray(X[3:]) ** 2), rtol=1e-12)
