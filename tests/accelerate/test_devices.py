"""Whatever device JAX takes by default flies what a CPU flies, and `over_worlds` what `jax.vmap` flies."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import flying, tape

import jaxdrones as jd

EPSILON = {32: 1e-5, 64: 1e-12}  # of the largest number of an array: 20 steps, rounded in another order


@pytest.mark.parametrize("bits", [32, pytest.param(64, marks=pytest.mark.slow)])
@pytest.mark.slow
def test_flights_and_their_gradients_are_those_of_a_cpu_in_either_precision(bits):
    with jax.enable_x64(bits == 64):
        params = jd.repeat(jd.load_params("cf2x"), 1)
        step = jd.make_step((jd.drag,), rotors=jd.lagging_rotors)
        starts = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(flying(params, seed) for seed in range(3)))
        commands = jnp.stack([tape(params, 20, seed) for seed in range(3)])

        def miss(commands, start):
            final = jax.lax.scan(lambda state, rpm: (step(params, state, rpm), None), start, commands)[0]
            return jnp.sum(final.pos**2), final

        both = jax.value_and_grad(miss, has_aux=True)
        on_cpu = jax.device_put((commands, starts), jax.devices("cpu")[0])
        expected = jax.jit(jax.vmap(both))(*on_cpu)
        for many in (jax.vmap(both), jd.over_worlds(both)):
            flown = jax.jit(many)(commands, starts)
            for ours, theirs in zip(jax.tree.leaves(flown), jax.tree.leaves(expected), strict=True):
                assert ours.dtype == f"float{bits}"
                np.testing.assert_allclose(ours, theirs, rtol=0, atol=EPSILON[bits] * np.abs(theirs).max())
