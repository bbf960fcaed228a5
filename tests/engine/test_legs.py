"""A rollout in legs is the rollout."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxdrones as jd
from jaxdrones.engine.rollout import leg_length, legs


@pytest.mark.slow
@pytest.mark.parametrize("leg", [1, 4, 10, 16])
def test_legs_are_the_rollout_cut_into_pieces(leg):
    params = jd.repeat(jd.load_params("cf2x"), 2)
    start = jd.State.at_rest(jnp.array([[0.0, 0.0, 1.0], [0.0, 0.0, 1.5]]))
    step = jd.make_step(effects=(jd.drag,), dt=1 / 240)

    def control(params, memory, state, k):  # the memory and the number of the step both count
        return memory + 1, params.hover_rpm[:, None] + 10.0 * memory + k * jnp.ones((2, 4))

    parts = list(legs(step, control, params, start, jnp.zeros(()), 10, leg))
    assert [len(part.pos) for part in parts] == [leg] * (10 // leg) + [10 % leg] * (10 % leg > 0)
    whole = jd.rollout(step, control, params, start, jnp.zeros(()), 10)[1]
    for ours, theirs in zip(
        jax.tree.leaves(jax.tree.map(lambda *x: np.concatenate(x), *parts)), jax.tree.leaves(whole), strict=True
    ):
        np.testing.assert_allclose(ours, theirs, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize(("hz", "length"), [(20, 1), (30, 1), (48, 2), (120, 4), (500, 17)])
def test_a_leg_is_a_thirtieth_of_a_second_or_one_step(hz, length):
    assert leg_length(1 / hz) == length
