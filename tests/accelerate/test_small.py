"""A function of few numbers is a single kernel where it can be, and gives the numbers of `jax.jit` in any case."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdrones.accelerate import compiler
from jaxdrones.accelerate.small import in_one_kernel, jit_small

X = jnp.linspace(-1.0, 1.0, 12).reshape(3, 4)


def arithmetic(n, x, tree):
    return {"sums": jnp.sum(jnp.sin(x) * tree["a"], axis=0) + n, "pairs": x[:, None] - x[None], "unused": x[:, :1]}


def sorting(n, x, tree):
    return jnp.sort(x, axis=-1) * n


def nothing(n, x, tree):
    return jnp.concatenate([x, x[:, :0]], axis=-1)


@pytest.mark.parametrize(("function", "is_one"), [(arithmetic, True), (sorting, False), (nothing, False)])
def test_the_numbers_are_those_of_jit_in_a_single_kernel_if_it_can_be(function, is_one):
    arguments = X, {"a": X + 1, "unused": jnp.zeros(2)}
    compiled = jit_small(function, static=1)
    for n in (1, 2):
        expected = jax.jit(function, static_argnums=0)(n, *arguments)
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12), compiled(n, *arguments), expected)
    program = jax.jit(in_one_kernel(function, 1), static_argnums=0).lower(1, *arguments).compile().as_text()
    assert ("xla_cpu_small_call" in program) == is_one


def test_a_kernel_that_does_not_compile_is_replaced(monkeypatch):
    """A sum of many numbers by a library, which XLA refuses inside of a kernel."""
    monkeypatch.setattr(compiler, "small_options", dict)
    x = jnp.ones((60, 60))
    compiled = jit_small(lambda x: jnp.sum(jnp.sin(x), axis=0))
    for _ in range(2):
        np.testing.assert_allclose(compiled(x), 60 * np.sin(1.0) * np.ones(60), rtol=1e-6)
