"""`over_worlds` gives what `jax.vmap` gives, of whatever JAX can trace."""

import os
import subprocess
import sys
import warnings
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from programs import program, worlds

from jaxdrones.accelerate import compiler
from jaxdrones.accelerate.fitting import fits_a_kernel
from jaxdrones.accelerate.worlds import in_chunks

TOLERANCES = {"float32": 1e-6, "float64": 1e-12}
QUICK = 3


def assert_same(function, arguments, dtype, chunk, inside_jit, devices=()):
    """Relative to the largest number of a result."""
    many = in_chunks(function, chunk, devices=devices)
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)  # a kernel that does not compile
        found = (jax.jit(many) if inside_jit else many)(*arguments)
    expected = jax.jit(jax.vmap(function))(*arguments)
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for x, y in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert (x.shape, x.dtype) == (y.shape, y.dtype)
        size = np.max(np.abs(y), initial=1)
        np.testing.assert_allclose(x, y, rtol=0, atol=TOLERANCES[dtype] * size)


@pytest.mark.parametrize(
    "seed", [seed if seed < QUICK else pytest.param(seed, marks=pytest.mark.slow) for seed in range(320)]
)
def test_random_programs_give_what_vmap_gives(seed):
    dtype, arithmetic = ("float64", "float64", "float32")[seed % 3], seed % 2 == 0
    number = (1, 3, 7, 300)[seed // 4 % 4]
    function, arguments = program(seed, arithmetic), worlds(seed, number, dtype, arithmetic)
    assert_same(function, arguments, dtype, (None, 4)[seed // 2 % 2], inside_jit=seed // 8 % 3 == 0)


@pytest.mark.slow
def test_many_of_the_arithmetic_programs_are_kernels():
    def is_kernel(seed):
        arguments = [x[0] for x in worlds(seed, 1, "float64", arithmetic=True)]
        return fits_a_kernel(compiler.trace(program(seed, arithmetic=True), *arguments)[0])

    assert np.mean([is_kernel(seed) for seed in range(0, 100, 2)]) > 0.5


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(1000, 1040))
def test_derivatives_around_many_worlds_are_those_of_vmap(seed):
    function, arguments = program(seed, arithmetic=True), worlds(seed, 5, "float64", arithmetic=True)
    x, *others = arguments

    def along(vmap):
        def total(x):
            results = jax.tree.leaves(vmap(function)(x, *others))
            return sum(jnp.sum(jnp.sin(y)) for y in results if jnp.issubdtype(y.dtype, jnp.floating))

        return jax.jit(jax.grad(total))(x)

    found, expected = along(lambda f: in_chunks(f, 2)), along(jax.vmap)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * max(1, np.max(np.abs(expected))))


@pytest.mark.slow
def test_two_devices_give_what_vmap_gives():
    script = """
import jax
jax.config.update("jax_num_cpu_devices", 2)
jax.config.update("jax_enable_x64", True)
from test_worlds_fuzz import *
for seed in range(2000, 2030):
    arithmetic = seed % 2 == 0
    arguments = worlds(seed, (2, 6, 20)[seed % 3], "float64", arithmetic)
    assert_same(program(seed, arithmetic), arguments, "float64", 4, seed % 4 < 2, jax.devices())
"""
    folders = [Path(__file__).parent, Path(__file__).parent.parent]
    path = os.pathsep.join([*map(str, folders), *sys.path])
    subprocess.run([sys.executable, "-c", script], check=True, env=os.environ | {"PYTHONPATH": path})
