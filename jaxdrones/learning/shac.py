"""Short-horizon actor-critic (Xu et al. 2022): backpropagation through short trajectories with a terminal value."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array

from jaxdrones import arguments
from jaxdrones.arguments import checked
from jaxdrones.envs import Env
from jaxdrones.envs.env import Obs
from jaxdrones.learning import bptt, collect, result, sharding
from jaxdrones.learning.critic import critic_observation, discounted_value, init_critic
from jaxdrones.learning.gradients import GradientConfig
from jaxdrones.learning.layers import expand
from jaxdrones.learning.networks import Policy
from jaxdrones.learning.returns import advantages, discounted_rewards

_CRITIC_BATCH = 4  # successive control steps in a minibatch of the critic


@checked
@dataclasses.dataclass(frozen=True)
class Config(GradientConfig):
    """Settings; numbers that are not shapes may be traced, for `vmap` over many values."""

    updates: arguments.TracedCount = 220
    gamma: arguments.BelowOne = 0.98
    """Discount factor."""
    critic_hidden_sizes: arguments.HiddenSizes = (32, 32)
    privileged_critic: arguments.Switch = False
    """Whether the critic takes privileged observations: without noise, and with drawn parameters."""
    critic_learning_rate: arguments.Positive = 5e-3
    """Initial learning rate of the critic, with a cosine decay to zero."""
    critic_steps: arguments.Count = 8
    """Gradient steps of the critic in an update, each on four successive control steps of all worlds."""
    terminal_value_warmup: arguments.PositiveFraction = 0.9
    """Fraction of the updates in which the weight of the terminal value rises linearly from 0 to 1."""
    gae_lambda: arguments.Fraction = 0.95
    """Lambda of the critic's TD(lambda) targets."""
    target_update_rate: arguments.PositiveFraction = 0.2
    """Step size of the target critic towards the critic in an update."""


class TrainState(result.TrainState):
    """Complete state of a training."""

    critic: Any
    """Parameters of the value function."""
    target_critic: Any
    """Parameters of the target value function, a moving average of the critic."""
    critic_opt_state: optax.OptState


def init(key: jax.Array, env: Env, config: Config, network: Any = None) -> TrainState:
    """State before the first update."""
    key, policy_key, critic_key = jax.random.split(key, 3)
    policy = result.init_policy(policy_key, env, config, network)
    critic = init_critic(critic_key, env, policy, config)
    return TrainState(
        step=jnp.zeros((), jnp.int32),
        key=key,
        policy=policy,
        opt_state=bptt.optimizer(config).init(policy.params),
        worlds=collect.empty_worlds(env, config.worlds, policy),
        critic=critic,
        target_critic=critic,
        critic_opt_state=_critic_optimizer(config).init(critic),
    )


def update(env: Env, config: Config, state: TrainState) -> tuple[TrainState, dict[str, Array]]:
    """Simulate a trajectory of all worlds, take one gradient step of the policy, then fit the critic."""
    key, *keys, critic_key = jax.random.split(state.key, 5)
    weight = jnp.minimum(state.step / (config.terminal_value_warmup * config.updates), 1)

    def cost(policy: Policy, trajectory: collect.Trajectory) -> Array:
        bootstrap = trajectory.truncated.at[-1].set(~trajectory.terminated[-1]) & ~trajectory.was_done
        final_obs = _final_observation(policy, _at(bootstrap, trajectory))
        terminal_value = weight * config.gamma * discounted_value(config, state.target_critic, final_obs)
        reward = trajectory.reward + jnp.where(bootstrap, terminal_value[None], 0)
        returns = jnp.sum(discounted_rewards(trajectory.replace(reward=reward), config.gamma), axis=0)
        return -jnp.mean(returns) / config.horizon

    after, trajectory, metrics = bptt.policy_step(env, config, state, keys, cost, privileged=config.privileged_critic)
    replicated = sharding.REPLICATED
    fit = sharding.map_worlds(
        functools.partial(_fit_critic, config), (replicated, replicated, sharding.STEPS), replicated
    )
    critic, critic_opt_state, critic_metrics = fit(critic_key, state.replace(worlds=None), trajectory)
    target_critic = optax.incremental_update(critic, state.target_critic, config.target_update_rate)
    nonfinite = metrics["nonfinite_gradients"] + critic_metrics["nonfinite_gradients"]
    metrics |= {"critic_loss": critic_metrics["loss"], "nonfinite_gradients": nonfinite}
    after = after.replace(key=key, critic=critic, target_critic=target_critic, critic_opt_state=critic_opt_state)
    return after, metrics


train = result.make_train(Config, init, update)


def _at(chosen: Array, trajectory: collect.Trajectory) -> collect.Trajectory:
    """Inputs of the critic at the chosen step (t, w, n) of each drone's trajectory, (w, n, ...)."""

    def select(x: Array) -> Array:  # an index would make devices exchange worlds
        return jnp.sum(jnp.where(expand(chosen, x.ndim), x, 0), axis=0, dtype=x.dtype)

    names = ("hidden_state", "final_obs", "final_privileged")
    return trajectory.replace(**{name: jax.tree.map(select, getattr(trajectory, name)) for name in names})


def _final_observation(policy: Policy, trajectory: collect.Trajectory) -> Obs:
    hidden_state, _ = policy.act(trajectory.hidden_state, trajectory.final_obs)
    return critic_observation(policy, trajectory.final_obs, hidden_state, trajectory.final_privileged)


def _fit_critic(config: Config, key: jax.Array, state: TrainState, trajectory: collect.Trajectory):
    """Parameters, optimizer state and metrics of the critic after gradient steps on the TD(lambda) returns."""
    obs = critic_observation(state.policy, trajectory.obs, trajectory.hidden_state, trajectory.privileged)
    now = discounted_value(config, state.target_critic, obs)
    later = discounted_value(config, state.target_critic, _final_observation(state.policy, trajectory))
    target = now + advantages(trajectory, now, later, config.gamma, config.gae_lambda)
    data = obs, target, (~trajectory.was_done).astype(target.dtype)
    length = min(_CRITIC_BATCH, config.horizon)

    def loss(params, obs, target, mask):
        error = (1 - config.gamma) * (discounted_value(config, params, obs) - target)
        return jnp.mean(mask * error**2)

    def step(carry, key):
        params, opt_state = carry
        start = jax.random.randint(key, (), 0, config.horizon - length + 1)
        batch = jax.tree.map(lambda x: jax.lax.dynamic_slice_in_dim(x, start, length), data)
        cost, gradient = sharding.mean_over_devices(jax.value_and_grad(loss)(params, *batch))
        step, opt_state = _critic_optimizer(config).update(gradient, opt_state)
        return (optax.apply_updates(params, step), opt_state), (cost, optax.tree.norm(gradient))

    carry = (state.critic, state.critic_opt_state)
    (critic, opt_state), (costs, norms) = jax.lax.scan(step, carry, jax.random.split(key, config.critic_steps))
    return critic, opt_state, {"loss": jnp.mean(costs), "nonfinite_gradients": result.count_nonfinite(norms)}


def _critic_optimizer(config: Config) -> optax.GradientTransformation:
    return result.cosine_adam(config.critic_learning_rate, config.updates * config.critic_steps, config.max_grad_norm)
