"""Training data of PPO: transitions with advantages and value targets, in minibatches."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxdrones.envs.env import Obs
from jaxdrones.errors import UserError
from jaxdrones.learning import collect, sharding
from jaxdrones.learning.critic import critic_observation, discounted_value
from jaxdrones.learning.exploration import sample
from jaxdrones.learning.normalize import map_state_vector
from jaxdrones.learning.returns import advantages
from jaxdrones.pytree import PyTreeNode


class Batch(PyTreeNode):
    """Training data of an update; leading axes (t, w, n)."""

    obs: Obs
    """Normalized observations."""
    action: Array
    log_prob: Array
    """Log probability density of the action under the behavior policy."""
    critic_obs: Obs
    advantage: Array
    value_target: Array
    hidden_state: Any = None
    """(1, w, n, ...) hidden state of the policy at the start of the trajectories; `None` without one."""
    starts: Array | None = None
    """(t, w) whether a new episode starts; `None` for a policy without a hidden state."""
    valid: Array | None = None
    """Whether the transition counts; `None` if all do."""


def batch_of(
    config: Any, state: Any, hidden_state: Any, trajectory: collect.Trajectory, noise: Array, ends_alone: bool = False
) -> Batch:
    """Transitions of a trajectory with normalized advantages and value targets, for the `state` before the update.

    The hidden state (w, n, ...) is that before the trajectory, or `None`. The `noise` (k, w, n, a) is standard normal,
    of the actions of a centralized critic after the end of the trajectory and of truncated episodes; at most k - 1
    episodes of a world are truncated. With `ends_alone` a drone's episode may end before that of its team.
    """
    policy, action = state.policy, trajectory.action if config.centralized_critic else None
    critic_obs = critic_observation(policy, trajectory.obs, trajectory.hidden_state, trajectory.privileged, action)
    value = discounted_value(config, state.critic, critic_obs)
    next_value = _next_value(config, state, trajectory, value, noise)
    advantage = advantages(trajectory, value, next_value, config.gamma, config.gae_lambda)
    valid = ~trajectory.was_done if ends_alone else None
    centered = advantage - sharding.mean_over_devices(sharding.share_of_mean(advantage, valid))
    std = jnp.sqrt(sharding.mean_over_devices(sharding.share_of_mean(centered**2, valid)))
    return Batch(
        obs=map_state_vector(policy.obs_stats.normalize, trajectory.obs),
        action=trajectory.action,
        log_prob=trajectory.extras,
        critic_obs=critic_obs,
        advantage=centered / (std + 1e-6),
        value_target=value + advantage,
        hidden_state=jax.tree.map(lambda x: x[None], hidden_state),
        starts=None if hidden_state is None else jnp.roll(trajectory.done, 1, axis=0).at[0].set(False),
        valid=valid,
    )


def _next_value(config: Any, state: Any, trajectory: collect.Trajectory, value: Array, noise: Array) -> Array:
    """(t, w, n) values of the observations after the steps that do not terminate an episode.

    They are those before the next step. Only for the last step and for truncated episodes the critic is evaluated.
    """
    policy = state.policy
    ends = jnp.any(trajectory.truncated, axis=-1).at[-1].set(True)
    order = jnp.cumsum(ends, axis=0) - 1
    steps = jax.vmap(lambda i: jnp.argmax(ends & (order == i), axis=0))(jnp.arange(len(noise)))  # (k, w)
    final = trajectory.hidden_state, trajectory.final_obs, trajectory.final_privileged
    hidden_state, obs, privileged = jax.tree.map(lambda x: x[steps, jnp.arange(x.shape[1])], final)
    hidden_state, mean = policy.act(hidden_state, obs)
    action = sample(noise, mean, state.log_std) if config.centralized_critic else None
    final_value = discounted_value(
        config, state.critic, critic_observation(policy, obs, hidden_state, privileged, action)
    )
    chosen = jnp.take_along_axis(final_value, jnp.minimum(order, len(noise) - 1)[..., None], axis=0)
    return jnp.where(ends[..., None], chosen, jnp.roll(value, -1, axis=0))


def minibatches(config: Any, batch: Batch) -> Batch:
    """Minibatches (minibatches, ...) of equally spaced worlds with all their steps.

    Without a hidden state the axes of steps and worlds are merged, and with a shared network those of the drones, too:
    arrays of fewer axes are faster.
    """
    worlds = batch.advantage.shape[1]
    if worlds % config.minibatches:
        raise UserError(
            f"each device has {worlds} worlds; give a number of worlds that is a multiple of minibatches, "
            f"{config.minibatches}, on every device"
        )
    merged = 0 if batch.starts is not None else 2 if config.per_agent else 3

    def cut(x):
        x = jnp.moveaxis(x.reshape(len(x), -1, config.minibatches, *x.shape[2:]), 2, 0)
        return x.reshape(config.minibatches, -1, *x.shape[1 + merged :]) if merged else x

    return jax.tree.map(cut, batch)
