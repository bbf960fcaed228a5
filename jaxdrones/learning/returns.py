"""Discounted rewards, advantages and TD(lambda) targets of trajectories."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxdrones.arguments import Scalar
from jaxdrones.learning.collect import Trajectory


def discounted_rewards(trajectory: Trajectory, gamma: Scalar) -> Float[Array, "t w n"]:
    """Rewards up to the end of each episode, discounted from the start of the trajectory."""
    weight = gamma ** jnp.arange(len(trajectory.reward), dtype=trajectory.reward.dtype)
    return jnp.where(trajectory.was_done, 0, weight[:, None, None] * trajectory.reward)


def trajectory_advantages(
    trajectory: Trajectory,
    value: Float[Array, "t w n"],
    next_value: Float[Array, "t w n"],
    gamma: Scalar,
    gae_lambda: Scalar,
) -> Float[Array, "t w n"]:
    """Advantages of every drone in a trajectory, see `advantages`."""
    return advantages(
        trajectory.reward, value, next_value, trajectory.terminated, trajectory.truncated, gamma, gae_lambda
    )


def advantages(
    reward: Float[Array, "t *w"],
    value: Float[Array, "t *w"],
    next_value: Float[Array, "t *w"],
    terminated: Bool[Array, "t *w"],
    truncated: Bool[Array, "t *w"],
    gamma: Scalar,
    gae_lambda: Scalar,
) -> Float[Array, "t *w"]:
    """Generalized advantage estimation (Schulman et al. 2016), exact at time limits.

    A termination ends the sum with a value of zero, a truncation with the value of the last observation. The values are
    those of the observations before and after each step, the latter before a new episode starts. A `gae_lambda` of 0
    sums one step, of 1 all steps to the end of the episode. The sums of advantage and value are the TD(lambda) targets
    of the value.
    """
    td_error = reward + gamma * jnp.where(terminated, 0, next_value) - value
    decay = jnp.where(terminated | truncated, 0, gamma * gae_lambda)

    def backward(later, step):
        td_error, decay = step
        advantage = td_error + decay * later
        return advantage, advantage

    _, result = jax.lax.scan(backward, jnp.zeros_like(reward[0]), (td_error, decay), reverse=True)
    return result
