"""What follows a step is worth: advantages and targets from rewards and values."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


def advantages(
    reward: Float[Array, "t *w"],
    value: Float[Array, "t *w"],
    next_value: Float[Array, "t *w"],
    terminated: Bool[Array, "t *w"],
    truncated: Bool[Array, "t *w"],
    discount: float,
    trace: float,
) -> Float[Array, "t *w"]:
    """Generalised advantage estimation (Schulman et al. 2016), exact at time limits.

    Termination stops the sum and what follows is worth nothing; a cut episode stops it too, but what would have
    followed is worth the value of what was seen last.

    Args:
        reward: of every step.
        value: of what was seen before it.
        next_value: of what was seen after it, before a new episode started.
        terminated: whether the step ended the episode for good.
        truncated: whether it was cut there.
        discount: gamma.
        trace: lambda; 0 for one step, 1 for all to the end.

    Returns:
        Advantages; with the values added they are the targets of TD(lambda).
    """
    surprise = reward + discount * jnp.where(terminated, 0, next_value) - value
    carry_on = jnp.where(terminated | truncated, 0, discount * trace)

    def backwards(later, x):
        surprise, carry_on = x
        now = surprise + carry_on * later
        return now, now

    _, result = jax.lax.scan(backwards, jnp.zeros_like(reward[0]), (surprise, carry_on), reverse=True)
    return result
