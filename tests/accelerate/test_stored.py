"""Storing a number changes when it is computed, not what it is."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdrones.accelerate.stored import stored, stored_for_derivatives

rng = np.random.default_rng(0)


@pytest.mark.parametrize("store", [stored, stored_for_derivatives])
def test_storing_changes_neither_values_nor_derivatives(store):
    def kept(x):
        y, z = store((jnp.sin(x), {"z": x * x}))
        return jnp.sum(y * z["z"])

    def plain(x):
        return jnp.sum(jnp.sin(x) * x * x)

    x = rng.normal(size=(5, 3))
    for derived in (lambda f: f, jax.grad, jax.jacfwd, jax.hessian):
        mine, expected = (jax.jit(jax.vmap(derived(f)))(x) for f in (kept, plain))
        np.testing.assert_allclose(mine, expected, rtol=1e-14, atol=1e-14)


def test_what_is_stored_is_computed_once():
    def products(store):
        def used_twice(x):
            y = store(x * x * x * x)
            return y[::2] * 3, y[::-1] * 5

        return jax.jit(used_twice).lower(jnp.ones(1024)).compile().cost_analysis()["flops"]

    assert products(stored) < products(lambda y: y)
