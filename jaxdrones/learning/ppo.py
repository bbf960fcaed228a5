"""Proximal policy optimization (Schulman et al. 2017), for teams and many worlds."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array

from jaxdrones.checks import check_keywords, check_number, is_concrete
from jaxdrones.envs import Env
from jaxdrones.envs.env import Obs
from jaxdrones.errors import UserError
from jaxdrones.learning import collect, result, settings
from jaxdrones.learning.critic import critic_observation, discounted_value, init_critic
from jaxdrones.learning.exploration import HALF_LOG_2_PI, explore, log_prob, sample
from jaxdrones.learning.networks import Policy
from jaxdrones.learning.returns import trajectory_advantages
from jaxdrones.learning.settings import (
    BelowOne,
    Bool,
    Count,
    Fraction,
    HiddenSizes,
    NotNegative,
    Positive,
    PositiveOrInfinite,
    TracedCount,
    check_config,
)
from jaxdrones.pytree import PyTreeNode

_MAX_LOG_RATIO = 10.0  # far beyond the clipping range, with a finite exponential


@check_keywords
@dataclasses.dataclass(frozen=True)
class Config(settings.Config):
    """Settings; numbers that are not shapes may be traced, for `vmap` over many values."""

    updates: TracedCount = 400
    horizon: Count = 96
    """Control steps of a trajectory. Rotor speeds affect the position within about one second."""
    obs_stats_freeze: Fraction = 0.1
    """Fraction of the updates after which the statistics of observations are frozen."""
    learning_rate: Positive = 2e-3
    """Initial learning rate; it adapts to `target_kl`."""
    gamma: BelowOne = 0.99
    """Discount factor."""
    restart_fraction: Fraction = 0.05
    """Fraction of the worlds that start a new episode before an update; the others continue theirs."""
    max_grad_norm: PositiveOrInfinite = 0.5
    epochs: Count = 4
    """Passes over each trajectory."""
    minibatches: Count = 8
    """Minibatches of an epoch, each with all steps of a subset of the worlds."""
    critic_hidden_sizes: HiddenSizes = (32, 32)
    centralized_critic: Bool = False
    """Whether the critic observes the team and the other drones' actions, or only its own drone."""
    privileged_critic: Bool = False
    """Whether the critic takes privileged observations: without noise, and with drawn parameters."""
    target_kl: Positive = 0.02
    """Kullback-Leibler divergence of the updated policy from the behavior policy. After an update the learning rate
    falls if the divergence was above twice this value and rises if it was below half of it, between
    `min_learning_rate` and `max_learning_rate`."""
    min_learning_rate: Positive = 1e-5
    max_learning_rate: Positive = 5e-3
    anneal_fraction: Fraction = 0.3
    """Final fraction of the updates in which the upper bound of the learning rate falls to `min_learning_rate`, and
    that of the standard deviation of actions to `final_std`."""
    gae_lambda: Fraction = 0.99
    """Lambda of the generalized advantage estimation."""
    clip_epsilon: Positive = 0.2
    """Clipping range of the probability ratio of actions."""
    entropy_coef: NotNegative = 0.0
    value_coef: NotNegative = 0.5
    init_std: Positive = 0.4
    """Initial standard deviation of actions, and its upper bound before annealing."""
    min_std: Positive = 0.1
    """Lower bound of the standard deviation of actions until the upper bound is annealed below it. It keeps exploration
    alive."""
    final_std: Positive = 0.02
    """Upper bound of the standard deviation after the last update. It is small because fluctuating rotor speeds produce
    more thrust, which the mean action alone, as used after training, would lack."""

    def __post_init__(self):
        super().__post_init__()
        if is_concrete(self.min_learning_rate):
            low = float(self.min_learning_rate)
            check_number("max_learning_rate", self.max_learning_rate, "not below min_learning_rate", at_least=low)
        if self.worlds % self.minibatches:
            raise UserError(f"worlds is {self.worlds}; give a multiple of minibatches, {self.minibatches}")


class TrainState(result.TrainState):
    """Complete state of a training."""

    log_std: Array
    """(a,), or (n, a) with `per_agent`: logarithm of the standard deviation of actions."""
    critic: Any
    """Parameters of the value function."""
    learning_rate: Array
    """()"""


class Batch(PyTreeNode):
    """Training data of an update; leading axes (t, w, n)."""

    obs: Obs
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


def init(key: jax.Array, env: Env, config: Config, network: Any = None) -> TrainState:
    """State before the first update."""
    key, policy_key, critic_key = jax.random.split(key, 3)
    policy = result.init_policy(policy_key, env, config, network)
    shape = (env.drones, env.action_size) if config.per_agent else (env.action_size,)
    log_std = jnp.full(shape, jnp.log(config.init_std), float)
    critic = init_critic(critic_key, env, policy, config)
    return TrainState(
        step=jnp.zeros((), jnp.int32),
        key=key,
        policy=policy,
        opt_state=_optimizer(config).init((policy.params, log_std, critic)),
        worlds=collect.empty_worlds(env, config.worlds, policy),
        log_std=log_std,
        critic=critic,
        learning_rate=jnp.asarray(config.learning_rate, log_std.dtype),
    )


def update(env: Env, config: Config, state: TrainState) -> tuple[TrainState, dict[str, Array]]:
    """Collect a trajectory of all worlds, then take epochs of gradient steps on it."""
    key, restart_key, collect_key, critic_key, optimize_key = jax.random.split(state.key, 5)
    progress = collect.progress_of(env, config, state.step)
    worlds = collect.restart(restart_key, env, state.worlds, config.restart_fraction, progress)

    act = jax.tree_util.Partial(explore, state.policy, state.log_std)
    after, trajectory = collect.collect(
        collect_key, env, act, worlds, config.horizon, privileged=config.privileged_critic, progress=progress
    )
    batch = batch_of(critic_key, config, state, worlds.hidden_state, trajectory)
    (params, log_std, critic), opt_state, metrics = _optimize(optimize_key, config, state, batch)
    learning_rate = result.adapted_learning_rate(config, state.step + 1, state.learning_rate, metrics["kl"])
    max_std = result.annealed(config, state.step, config.init_std, config.final_std)
    log_std = jnp.clip(log_std, jnp.log(jnp.minimum(config.min_std, max_std)), jnp.log(max_std))
    obs_stats = collect.update_obs_stats(state.policy.obs_stats, trajectory, config, state.step)
    policy = state.policy.replace(params=params, obs_stats=obs_stats)
    after, measured = collect.measure(env, config, state.step, after, trajectory)
    metrics |= measured | {"action_std": jnp.mean(jnp.exp(log_std)), "learning_rate": learning_rate}
    return TrainState(state.step + 1, key, policy, opt_state, after, log_std, critic, learning_rate), metrics


def train(
    key: jax.Array,
    env: Env,
    config: Config,
    *,
    network: Any = None,
    callback: result.Callback | Sequence[result.Callback] = (),
    state: TrainState | None = None,
) -> result.Result:
    """Make all updates; see `learning.result.run_training`."""
    check_config(config, Config)
    return result.run_training(init, update, key, env, config, network=network, callback=callback, state=state)


def loss(config: Config, policy: Policy, log_std: Array, critic: Any, batch: Batch) -> tuple[Array, dict[str, Array]]:
    """Clipped surrogate loss, plus the weighted error of the values, minus the weighted entropy."""
    ratio, _ = _probability_ratio(policy, log_std, batch)
    clipped = jnp.clip(ratio, 1 - config.clip_epsilon, 1 + config.clip_epsilon)
    surrogate = jnp.mean(jnp.minimum(ratio * batch.advantage, clipped * batch.advantage))
    value_error = (1 - config.gamma) * (_value(config, critic, batch.critic_obs) - batch.value_target)
    value_loss = jnp.mean(value_error**2)
    entropy = jnp.mean(jnp.sum(log_std + 0.5 + HALF_LOG_2_PI, axis=-1))
    total = -surrogate + config.value_coef * value_loss - config.entropy_coef * entropy
    return total, {"value_loss": value_loss}


def divergence(policy: Policy, log_std: Array, batch: Batch) -> Array:
    """Non-negative estimate of the Kullback-Leibler divergence of a policy from the behavior policy."""
    ratio, log_ratio = _probability_ratio(policy, log_std, batch)
    return jnp.mean(ratio - 1 - log_ratio)


def _probability_ratio(policy: Policy, log_std: Array, batch: Batch) -> tuple[Array, Array]:
    """Probability ratio of the actions to the behavior policy, and its logarithm."""
    mean = policy.replay(jax.tree.map(lambda x: x[0], batch.hidden_state), batch.obs, batch.starts)
    log_ratio = log_prob(batch.action, mean, log_std) - batch.log_prob
    return jnp.exp(jnp.clip(log_ratio, -_MAX_LOG_RATIO, _MAX_LOG_RATIO)), log_ratio


def batch_of(
    key: jax.Array, config: Config, state: TrainState, hidden_state: Any, trajectory: collect.Trajectory
) -> Batch:
    """Transitions of a trajectory with normalized advantages and value targets.

    `hidden_state` (w, n, ...) is that of the policy before the trajectory, or `None`. The key is for the actions of a
    centralized critic after the last steps of episodes and of the trajectory.
    """
    policy = state.policy
    final_state, final_mean = policy.act(trajectory.hidden_state, trajectory.final_obs)
    action = final_action = None
    if config.centralized_critic:
        action, last = trajectory.action, trajectory.done.at[-1].set(True)[..., None, None]
        final_action = jnp.where(last, sample(key, final_mean, state.log_std), jnp.roll(action, -1, axis=0))
    critic_obs = critic_observation(policy, trajectory.obs, trajectory.hidden_state, trajectory.privileged, action)
    final_obs = critic_observation(policy, trajectory.final_obs, final_state, trajectory.final_privileged, final_action)
    value = _value(config, state.critic, critic_obs)
    next_value = _value(config, state.critic, final_obs)
    advantage = trajectory_advantages(trajectory, value, next_value, config.gamma, config.gae_lambda)
    return Batch(
        obs=trajectory.obs,
        action=trajectory.action,
        log_prob=trajectory.extras,
        critic_obs=critic_obs,
        advantage=(advantage - jnp.mean(advantage)) / (jnp.std(advantage) + 1e-6),
        value_target=value + advantage,
        hidden_state=jax.tree.map(lambda x: x[None], hidden_state),
        starts=None if hidden_state is None else jnp.roll(trajectory.done, 1, axis=0).at[0].set(False),
    )


def _optimize(key: jax.Array, config: Config, state: TrainState, batch: Batch):
    """Epochs of gradient steps: (policy parameters, log_std, critic), optimizer state, metrics."""
    w = batch.advantage.shape[1]
    *epoch_keys, last_key = jax.random.split(key, config.epochs + 1)

    def minibatches(key):
        # The worlds are cut into groups of neighbors, and each minibatch takes one world of every group: on several
        # devices, whose shares are neighbors too, no device needs the worlds of another.
        order = jnp.argsort(jax.random.uniform(key, (w // config.minibatches, config.minibatches)), axis=1)

        def cut(x):
            x = x.reshape(len(x), *order.shape, *x.shape[2:])
            return jax.vmap(lambda group, order: group[:, order], (1, 0), 2)(x, order).swapaxes(0, 1)

        return jax.tree.map(cut, batch)

    def cost(variables, minibatch):
        params, log_std, critic = variables
        return loss(config, state.policy.replace(params=params), log_std, critic, minibatch)

    def step(carry, minibatch):
        variables, opt_state = carry
        (_, metrics), gradient = jax.value_and_grad(cost, has_aux=True)(variables, minibatch)
        step, opt_state = _optimizer(config).update(gradient, opt_state)
        variables = jax.tree.map(lambda x, s: x - (state.learning_rate * s).astype(x.dtype), variables, step)
        return (variables, opt_state), (metrics, optax.tree.norm(gradient))

    def epoch(carry, key):
        return jax.lax.scan(step, carry, minibatches(key))

    carry = (state.policy.params, state.log_std, state.critic), state.opt_state
    carry, (metrics, norms) = jax.lax.scan(epoch, carry, jnp.stack(epoch_keys))
    params, log_std, _ = carry[0]
    policy = state.policy.replace(params=params)
    kl = jax.lax.map(lambda minibatch: divergence(policy, log_std, minibatch), minibatches(last_key))
    metrics = jax.tree.map(jnp.mean, metrics | {"kl": kl})
    return *carry, metrics | {"nonfinite_gradients": result.count_nonfinite(norms)}


def _value(config: Config, critic: Any, critic_obs: Obs) -> Array:
    return discounted_value(critic, critic_obs, config.critic_hidden_sizes, config.gamma, config.per_agent)


def _optimizer(config: Config) -> optax.GradientTransformation:
    return optax.flatten(optax.chain(result.clip_gradient(config.max_grad_norm), optax.scale_by_adam()))
