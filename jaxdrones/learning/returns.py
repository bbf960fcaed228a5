"""Discounted rewards, advantages and TD(lambda) targets of trajectories."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdrones.arguments import Scalar
from jaxdrones.learning.collect import Trajectory


def discounted_rewards(trajectory: Trajectory, gamma: Scalar) -> Float[Array, "t w n"]:
    """Rewards up to the end of each episode, discounted from the start of the trajectory."""
    weight = gamma ** jnp.arange(len(trajectory.reward), dtype=trajectory.reward.dtype)
    return jnp.where(trajectory.was_done, 0, weight[:, None, None] * trajectory.reward)


def advantages(
    trajectory: Trajectory,
    value: Float[Array, "t *w"],
    next_value: Float[Array, "t *w"],
    gamma: Scalar,
    gae_lambda: Scalar,
) -> Float[Array, "t *w"]:
    """Generalized advantage estimation (Schulman et al. 2016), exact at time limits.

    A termination ends the sum with a value of zero, a truncation with the value of the last observation. The values are
    those of the observations before and after each step, the latter before a new episode starts. A `gae_lambda` of 0
    sums one step, of 1 all steps to the end of the episode. The sums of advantage and value are the TD(lambda) targets
    of the value.
    """
    ends = trajectory.terminated | trajectory.truncated
    td_error = trajectory.reward + gamma * jnp.where(trajectory.terminated, 0, next_value) - value
    decay = jnp.where(ends, 0, gamma * gae_lambda)

    def backward(later, step):
        td_error, decay = step
        advantage = td_error + decay * later
        return advantage, advantage

    _, result = jax.lax.scan(backward, jnp.zeros_like(td_error[0]), (td_error, decay), reverse=True)
    return result
