"""Proximal policy optimization (Schulman et al. 2017), for teams and many worlds."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array

from jaxdrones import arguments
from jaxdrones.arguments import Scalar, checked
from jaxdrones.checks import check_number, is_concrete
from jaxdrones.envs import Env
from jaxdrones.errors import UserError
from jaxdrones.learning import collect, result, settings, sharding
from jaxdrones.learning.batch import Batch, batch_of, minibatches
from jaxdrones.learning.critic import discounted_value, init_critic
from jaxdrones.learning.exploration import HALF_LOG_2_PI, explore, log_prob
from jaxdrones.learning.metrics import measure
from jaxdrones.learning.networks import Policy

_MAX_RATE_RATIO = 20.0  # of the learning rates of critic and policy
_MAX_LOG_RATIO = 10.0  # far beyond the clipping range, with a finite exponential


@checked
@dataclasses.dataclass(frozen=True)
class Config(settings.Config):
    """Settings; numbers that are not shapes may be traced, for `vmap` over many values."""

    updates: arguments.TracedCount = 200
    horizon: arguments.Count = 96
    """Control steps of a trajectory. Rotor speeds affect the position within about one second."""
    obs_stats_freeze: arguments.Fraction = 0.1
    """Fraction of the updates after which the statistics of observations are frozen."""
    learning_rate: arguments.Positive = 4e-3
    """Initial learning rate; it adapts to `target_kl`."""
    gamma: arguments.BelowOne = 0.99
    """Discount factor."""
    restart_fraction: arguments.Fraction = 0.05
    """Fraction of the worlds that start a new episode before an update; the others continue theirs."""
    max_grad_norm: arguments.PositiveOrInfinite = 0.5
    epochs: arguments.Count = 2
    """Passes over each trajectory."""
    minibatches: arguments.Count = 8
    """Minibatches of an epoch, each with all steps of a subset of the worlds."""
    critic_hidden_sizes: arguments.HiddenSizes = (32, 32)
    critic_learning_rate: arguments.NotNegative = 0.0
    """Learning rate of the critic, but not more than 20 times that of the policy; 0 for that of the policy, which
    `target_kl` may keep too low for the values of random vehicles."""
    centralized_critic: arguments.Switch = False
    """Whether the critic observes the team and the other drones' actions, or only its own drone."""
    privileged_critic: arguments.Switch = False
    """Whether the critic takes privileged observations: without noise, and with drawn parameters."""
    target_kl: arguments.Positive = 0.02
    """Kullback-Leibler divergence of the behavior policy from the updated one, a mean over the actions of the first
    minibatch. If it is above twice this value after an update, the learning rate of the next update is lower by a
    factor of 1.2, and higher if it is below half of it, between `min_learning_rate` and `max_learning_rate`."""
    min_learning_rate: arguments.Positive = 1e-5
    max_learning_rate: arguments.Positive = 1.5e-2
    anneal_fraction: arguments.Fraction = 0.3
    """Final fraction of the updates in which the upper bound of the learning rate falls to `min_learning_rate`, and
    that of the standard deviation of actions to `final_std`."""
    gae_lambda: arguments.Fraction = 0.99
    """Lambda of the generalized advantage estimation."""
    clip_epsilon: arguments.Positive = 0.2
    """Clipping range of the probability ratio of actions."""
    entropy_coef: arguments.NotNegative = 0.0
    value_coef: arguments.NotNegative = 0.5
    init_std: arguments.Positive = 0.4
    """Initial standard deviation of actions, and its upper bound before annealing."""
    min_std: arguments.Positive = 0.1
    """Lower bound of the standard deviation of actions until the upper bound is annealed below it. It keeps exploration
    alive."""
    final_std: arguments.Positive = 0.02
    """Upper bound of the standard deviation after the last update. It is small because fluctuating rotor speeds produce
    more thrust, which the mean action alone, as used after training, would lack."""

    def __post_init__(self):
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
    key, start_key, restart_key, noise_key, collect_key = jax.random.split(state.key, 5)
    starts = collect.draw_starts(start_key, env, config.worlds, collect.progress_of(env, config, state.step))
    worlds = collect.restart(restart_key, state.worlds, starts, config.restart_fraction)
    ends = _most_truncations(env, config.horizon) + 1
    shape = (config.horizon + ends, config.worlds, env.drones, env.action_size)
    noise = jax.random.normal(noise_key, shape, state.log_std.dtype)

    after, trajectory = collect.collect(
        collect_key,
        env,
        jax.tree_util.Partial(explore, state.policy, state.log_std),
        worlds,
        config.horizon,
        noise=noise[ends:],
        starts=starts,
        privileged=config.privileged_critic,
    )
    learn = sharding.map_worlds(
        functools.partial(_learn, config, env.task.ends == "drone"),
        (sharding.REPLICATED, sharding.WORLDS, sharding.STEPS, sharding.STEPS),
        sharding.REPLICATED,
    )
    (params, log_std, critic), opt_state, metrics = learn(
        state.replace(worlds=None), worlds.hidden_state, trajectory, noise[:ends]
    )
    updates = state.step + 1
    learning_rate = result.adapted_learning_rate(config, updates, state.learning_rate, metrics["kl"])
    max_std = result.annealed(config, updates, config.init_std, config.final_std)
    log_std = jnp.clip(log_std, jnp.log(jnp.minimum(config.min_std, max_std)), jnp.log(max_std))
    obs_stats = collect.update_obs_stats(state.policy.obs_stats, trajectory, config, state.step)
    policy = state.policy.replace(params=params).with_obs_stats(obs_stats)
    after, measured = measure(env, config, state.step, after, trajectory)
    metrics |= measured | {"action_std": jnp.mean(jnp.exp(log_std)), "learning_rate": learning_rate}
    return TrainState(updates, key, policy, opt_state, after, log_std, critic, learning_rate), metrics


train = result.make_train(Config, init, update)


def loss(config: Config, policy: Policy, log_std: Array, critic: Any, batch: Batch) -> tuple[Array, dict[str, Array]]:
    """Clipped surrogate loss, plus the weighted error of the values, minus the weighted entropy.

    The metrics are the error of the values and the Kullback-Leibler divergence of the behavior policy from the policy,
    by a non-negative estimate (k3 of Schulman 2020, "Approximating KL divergence"). On several devices these are
    shares, see `sharding.share_of_mean`.
    """
    mean = policy.replay(jax.tree.map(lambda x: x[0], batch.hidden_state), batch.obs, batch.starts)
    log_ratio = log_prob(batch.action, mean, log_std) - batch.log_prob
    ratio = jnp.exp(jnp.clip(log_ratio, -_MAX_LOG_RATIO, _MAX_LOG_RATIO))
    clipped = jnp.clip(ratio, 1 - config.clip_epsilon, 1 + config.clip_epsilon)
    mean_of = functools.partial(sharding.share_of_mean, where=batch.valid)
    surrogate = mean_of(jnp.minimum(ratio * batch.advantage, clipped * batch.advantage))
    value_error = (1 - config.gamma) * (discounted_value(config, critic, batch.critic_obs) - batch.value_target)
    value_loss = mean_of(value_error**2)
    entropy = jnp.mean(jnp.sum(log_std + 0.5 + HALF_LOG_2_PI, axis=-1))
    total = -surrogate + config.value_coef * value_loss - config.entropy_coef * entropy
    return total, {"value_loss": value_loss, "kl": mean_of(ratio - 1 - log_ratio)}


def _most_truncations(env: Env, horizon: int) -> int:
    """Largest number of truncated episodes in one trajectory."""
    return horizon if env.task.truncations else -(-horizon // env.steps)


def _learn(
    config: Config,
    ends_alone: bool,
    state: TrainState,
    hidden_state: Any,
    trajectory: collect.Trajectory,
    noise: Array,
):
    """Epochs of gradient steps on a trajectory: (policy parameters, log_std, critic), optimizer state, metrics."""
    batch = minibatches(config, batch_of(config, state, hidden_state, trajectory, noise, ends_alone))
    rates = _rates(config, state.learning_rate)

    def cost(variables, minibatch):
        params, log_std, critic = variables
        return loss(config, state.policy.replace(params=params), log_std, critic, minibatch)

    def step(carry, minibatch):
        variables, opt_state = carry
        gradient, metrics = sharding.mean_over_devices(jax.grad(cost, has_aux=True)(variables, minibatch))
        steps, opt_state = _optimizer(config).update(gradient, opt_state)
        variables = tuple(map(_moved, rates, variables, steps))
        return (variables, opt_state), (metrics["value_loss"], optax.tree.norm(gradient))

    carry = (state.policy.params, state.log_std, state.critic), state.opt_state
    epochs = jax.lax.scan(lambda carry, _: jax.lax.scan(step, carry, batch), carry, length=config.epochs)
    carry, (value_losses, norms) = epochs
    kl = sharding.mean_over_devices(cost(carry[0], jax.tree.map(lambda x: x[0], batch))[1]["kl"])
    metrics = {"value_loss": jnp.mean(value_losses), "kl": kl}
    return *carry, metrics | {"nonfinite_gradients": result.count_nonfinite(norms)}


def _rates(config: Config, rate: Array) -> tuple[Array, Array, Array]:
    """Learning rates of policy, standard deviations and critic."""
    own = config.critic_learning_rate
    return rate, rate, jnp.where(own > 0, jnp.minimum(own, _MAX_RATE_RATIO * rate), rate)


def _moved(rate: Scalar, variables: Any, step: Any) -> Any:
    return jax.tree.map(lambda x, s: x - (rate * s).astype(x.dtype), variables, step)


def _optimizer(config: Config) -> optax.GradientTransformation:
    return optax.flatten(optax.chain(result.clip_gradient(config.max_grad_norm), optax.scale_by_adam()))
