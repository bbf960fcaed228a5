"""Loss of PPO."""

import dataclasses
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import pytest
from helpers import jit_unoptimized

from jaxdrones.learning import ppo


@pytest.mark.parametrize("advantage", [1.0, -1.0])
def test_the_loss_of_ppo_has_no_gradient_where_the_clipped_ratio_is_worse_and_falls_with_the_entropy(
    advantage, monkeypatch
):
    """Where the ratio is beyond the clipping range to the side of the advantage."""
    config = ppo.Config(value_coef=0.0, clip_epsilon=0.2)
    monkeypatch.setattr(ppo, "discounted_value", lambda *_: jnp.zeros((1, 1)))
    policy, zero = SimpleNamespace(replay=lambda memory, obs, starts: obs), jnp.zeros((1, 1, 1))

    @jit_unoptimized
    @jax.grad
    def slope_of(log_std, ratio, entropy_coef):
        behavior = ppo.log_prob(zero, zero, jnp.zeros(1)) - jnp.log(ratio)
        batch = ppo.Batch(zero, zero, behavior, zero, jnp.full((1, 1), advantage), jnp.zeros((1, 1)))
        return ppo.loss(dataclasses.replace(config, entropy_coef=entropy_coef), policy, log_std, None, batch)[0]

    slopes = {ratio: slope_of(jnp.zeros(1), ratio, 0.0).item() for ratio in (0.7, 0.9, 1.1, 1.3)}
    clipped = 1.3 if advantage > 0 else 0.7
    assert [ratio for ratio, slope in slopes.items() if slope == 0] == [clipped]
    assert slope_of(jnp.zeros(1), clipped, 0.1).item() == pytest.approx(-0.1)
