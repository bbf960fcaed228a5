"""What several expressions use is stored once."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdrones.accelerate.shared import store_shared

x = np.linspace(-1, 1, 5)


def costly(x):
    return x / (1 + x * x) / (2 + x) - x * x


CASES = {
    "used twice": (lambda x: (jnp.sin(costly(x)), jnp.cos(costly(x))), 1),  # also: computed twice, found to be the same
    "used once": (lambda x: jnp.sin(costly(x)), 0),
    "cheap": (lambda x: (jnp.sin(x + 1), jnp.cos(x + 1)), 0),
    "not needed": (lambda x: (costly(x), [jnp.sin(costly(x)), 0][1]), 0),
    "a number": (lambda x: (jnp.sin(costly(x[0])), jnp.cos(costly(x[0]))), 0),
}


@pytest.mark.parametrize("name", CASES)
def test_what_is_shared_and_worth_it_is_stored(name):
    function, stores = CASES[name]
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-15), store_shared(function)(x), function(x))
    assert str(jax.make_jaxpr(store_shared(function))(x)).count("custom_jvp_call") == stores


def test_numbers_that_differ_in_the_twelfth_digit_are_two():
    def both(x):
        return x * 1.000000000001, x * 1.000000000002

    a, b = store_shared(both)(x)
    assert np.all(a[x != 0] != b[x != 0])
