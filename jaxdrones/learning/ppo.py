"""Proximal policy optimisation (Schulman et al. 2017), for teams and many worlds."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array

from jaxdrones.checks import check_key, check_keywords, check_number, is_known
from jaxdrones.envs import Env
from jaxdrones.envs.env import Obs
from jaxdrones.learning import collect
from jaxdrones.learning.networks import MLP, Policy, VisionMLP, apply, central, init_params, network_for, seen_by_one
from jaxdrones.learning.normalize import on_vector, vector
from jaxdrones.learning.result import Result, bounded, scan_updates
from jaxdrones.learning.returns import advantages
from jaxdrones.learning.settings import check_config, check_settings

_HALF_LOG_2_PI = math.log(2 * math.pi) / 2
_PACE = 1.2  # the learning rate grows or falls by
_LARGEST_CHANGE = 10.0  # of a logarithm, far beyond what is rewarded; its exponential stays finite


@check_keywords
@dataclasses.dataclass(frozen=True)
class Config:
    """Settings; the numbers that are not shapes may be traced, so that `vmap` tries many."""

    updates: int = 400
    worlds: int = 256
    horizon: int = 96
    """Control steps of an update; about a second, in which a rotor's speed comes to show in the position."""
    epochs: int = 4
    """Times that every step is learnt from."""
    batches: int = 8
    """Parts of the flown steps, each of which makes one gradient step; cut out of the worlds."""
    sizes: tuple[int, ...] = (32, 32)
    critic_hidden_sizes: tuple[int, ...] = (32, 32)
    memory: float = 1e9
    """Flights that the statistics of observations go back; early ones, far away, would blur what is near."""
    settle: float = 0.1
    """Share of the updates after which the statistics stay as they are."""
    per_agent: bool = False
    """A policy and a value function for every drone, else one of each for all."""
    centralized_critic: bool = False
    """Values are of all drones' observations and of the others' actions, else of a drone's own observation."""
    privileged_critic: bool = False
    """Values are of what a policy never sees: observations without noise, and drawn parameters (`Env.truth`)."""
    learning_rate: float = 2e-3
    """At the start; follows how much the policy changes in a gradient step."""
    change: float = 0.02
    """That is aimed at: divergence (KL) of the policy from the one that flew. The rate falls above twice of it and
    grows below half of it, within `min_learning_rate` and `max_learning_rate`."""
    min_learning_rate: float = 1e-5
    max_learning_rate: float = 5e-3
    cool: float = 0.3
    """Share of the updates, the last ones, in which the largest rate falls to the min_learning_rate, and the spread to `calm`."""
    discount: float = 0.99
    trace: float = 0.99
    """Lambda of the advantages."""
    clip_epsilon: float = 0.2
    """Largest change of an action's probability that is rewarded."""
    entropy: float = 0.0
    """Reward for the spread of actions."""
    value_coef: float = 0.5
    spread: float = 0.4
    """Standard deviation of actions at the start."""
    min_std: float = 0.1
    """The least it may become before the last updates; what is tried next to the mean is what a policy learns from."""
    calm: float = 0.02
    """What it falls to in the last updates: rotors that are shaken lift more, so the mean is off without shaking."""
    restart: float = 0.05
    """Share of the worlds that start afresh before an update, so that not all are of an age."""
    clip: float = 0.5
    """Largest norm of the gradient."""

    def __post_init__(self):
        check_settings(self, valued=True)
        if is_known(self.min_learning_rate):
            check_number(
                "max_learning_rate",
                self.max_learning_rate,
                "not slower than min_learning_rate",
                at_least=self.min_learning_rate,
            )
        if self.worlds % self.batches:
            raise ValueError(f"worlds is {self.worlds}; give a multiple of batches, {self.batches}")


class TrainState(flax.struct.PyTreeNode):
    """All that training needs to go on."""

    step: Array
    """() updates made."""
    key: Array
    policy: Policy
    log_std: Array
    """(a,), or (n, a) with `per_agent`: logarithm of the spread of actions."""
    critic: Any
    """Parameters of the value function."""
    optimiser: optax.OptState
    rate: Array
    """() learning rate."""
    worlds: collect.Worlds


class Sample(flax.struct.PyTreeNode):
    """What is learnt from; leading axes (t, w, n)."""

    obs: Obs
    action: Array
    log_prob: Array
    critic_obs: Obs
    advantage: Array
    target: Array


def init(key: jax.Array, env: Env, config: Config) -> TrainState:
    """Before the first update.

    Raises:
        ValueError: no random key, or settings of another learner.
    """
    check_key("key", key)
    check_config(config, Config)
    key, policy_key, critic_key = jax.random.split(key, 3)
    policy = Policy.init(policy_key, env, config.sizes, config.per_agent)
    n, a = env.drones, env.action_size
    d = env.observation_size + (env.privileged_size if config.privileged_critic else 0)
    log_std = jnp.full((n, a) if config.per_agent else (a,), jnp.log(config.spread))
    inputs = n * d + (n - 1) * a if config.centralized_critic else d
    obs = on_vector(lambda _: jnp.zeros(inputs), seen_by_one(env))
    critic = init_params(critic_key, _critic(config, obs), obs, n if config.per_agent else None)
    optimiser = _descent(config).init((policy.params, log_std, critic))
    rate = jnp.asarray(config.learning_rate, log_std.dtype)
    worlds = collect.idle(env, config.worlds)
    return TrainState(jnp.zeros((), jnp.int32), key, policy, log_std, critic, optimiser, rate, worlds)


def update(env: Env, config: Config, state: TrainState) -> tuple[TrainState, dict[str, Array]]:
    """Fly, then learn from what was flown."""
    check_config(config, Config)
    key, restart_key, fly_key, learn_key = jax.random.split(state.key, 4)
    worlds = collect.restart(restart_key, env, state.worlds, config.restart)

    def act(policy, log_std, keys, obs):
        mean = policy(obs)
        std = jnp.broadcast_to(jnp.exp(log_std), mean.shape)
        noise = jax.vmap(lambda key: jax.random.normal(key, mean.shape[1:], mean.dtype))(keys)
        action = mean + std * noise
        return action, log_prob(action, mean, log_std)

    pilot = jax.tree_util.Partial(act, state.policy, state.log_std)
    worlds, flight = collect.fly(fly_key, env, pilot, worlds, config.horizon, informed=config.privileged_critic)
    sample = _judged(config, state, flight)
    learnt, optimiser, rate, losses = _learn(learn_key, config, state, sample)
    params, log_std, critic = learnt
    widest = _falling(config, state.step, config.spread, config.calm)
    log_std = jnp.clip(log_std, jnp.log(jnp.minimum(config.min_std, widest)), jnp.log(widest))
    statistics = collect.remember(state.policy.statistics, vector(flight.obs), config, state.step)
    policy = state.policy.replace(params=params, statistics=statistics)
    metrics = collect.progress(flight) | losses | {"spread": jnp.mean(jnp.exp(log_std)), "rate": rate}
    return TrainState(state.step + 1, key, policy, log_std, critic, optimiser, rate, worlds), metrics


def train(key: jax.Array, env: Env, config: Config) -> Result:
    """All updates as one program."""
    return scan_updates(update, env, config, init(key, env, config))


def log_prob(action: Array, mean: Array, log_std: Array) -> Array:
    """(*batch, n) logarithm of the density of (*batch, n, a) actions, normally distributed about their means."""
    log_std = jnp.broadcast_to(log_std, mean.shape)
    terms = -(((action - mean) * jnp.exp(-log_std)) ** 2) / 2 - log_std - _HALF_LOG_2_PI
    return jnp.sum(terms, axis=-1)


def loss(config: Config, policy: Policy, log_std: Array, critic: Any, sample: Sample) -> tuple[Array, dict[str, Array]]:
    """What PPO descends: the clipped surrogate of the return, the error of the values, minus entropy."""
    change = log_prob(sample.action, policy(sample.obs), log_std) - sample.log_prob
    ratio = jnp.exp(jnp.clip(change, -_LARGEST_CHANGE, _LARGEST_CHANGE))
    clipped = jnp.clip(ratio, 1 - config.clip_epsilon, 1 + config.clip_epsilon)
    gain = jnp.mean(jnp.minimum(ratio * sample.advantage, clipped * sample.advantage))
    miss = (1 - config.discount) * (_value(config, critic, sample.critic_obs) - sample.target)
    value_loss = jnp.mean(miss**2)
    entropy = jnp.mean(jnp.sum(log_std + 0.5 + _HALF_LOG_2_PI, axis=-1))
    total = -gain + config.value_coef * value_loss - config.entropy * entropy
    kl = jnp.mean(ratio - 1 - change)
    return total, {"value_loss": value_loss, "kl": kl}


def _judged(config: Config, state: TrainState, flight: collect.Flight) -> Sample:
    """The flown steps with their advantages."""
    policy = state.policy

    def seen(obs, truth, action):
        """What the critic sees, where the policy sees `obs`."""
        if config.privileged_critic:
            obs = on_vector(lambda _: truth.obs, obs)
        obs = on_vector(policy.statistics.normalize, obs)
        if config.privileged_critic:
            obs = on_vector(lambda x: jnp.concatenate([x, truth.params], axis=-1), obs)
        return on_vector(lambda x: central(x, action), obs) if config.centralized_critic else obs

    critic_obs = seen(flight.obs, flight.truth, flight.action)
    final_action = policy(flight.final_obs) if config.centralized_critic else None
    final_obs = seen(flight.final_obs, flight.final_truth, final_action)
    value = _value(config, state.critic, critic_obs)
    next_value = _value(config, state.critic, final_obs)
    terminated, truncated = (jnp.broadcast_to(x[..., None], value.shape) for x in (flight.terminated, flight.truncated))
    advantage = advantages(flight.reward, value, next_value, terminated, truncated, config.discount, config.trace)
    target = value + advantage
    advantage = (advantage - jnp.mean(advantage)) / (jnp.std(advantage) + 1e-6)
    return Sample(flight.obs, flight.action, flight.kept, critic_obs, advantage, target)


def _learn(key: jax.Array, config: Config, state: TrainState, sample: Sample):
    """Some epochs of gradient steps, each on the steps of some of the worlds."""
    t, w = sample.advantage.shape[:2]

    def cost(learnt, batch):
        params, log_std, critic = learnt
        return loss(config, state.policy.replace(params=params), log_std, critic, batch)

    max_learning_rate = _falling(config, state.step, config.max_learning_rate, config.min_learning_rate)

    def step(carry, batch):
        learnt, optimiser, rate = carry
        (_, losses), gradient = jax.value_and_grad(cost, has_aux=True)(learnt, batch)
        step, optimiser = _descent(config).update(gradient, optimiser)
        slower, faster = losses["kl"] > 2 * config.change, losses["kl"] < config.change / 2
        rate = jnp.clip(
            rate * jnp.where(slower, 1 / _PACE, jnp.where(faster, _PACE, 1)),
            config.min_learning_rate,
            max_learning_rate,
        )
        learnt = jax.tree.map(lambda x, s: x - rate.astype(x.dtype) * s, learnt, step)
        return (learnt, optimiser, rate), losses

    def epoch(carry, key):
        # One world of every group goes into each batch: neighbours change places, so that no device needs another's.
        order = jnp.argsort(jax.random.uniform(key, (w // config.batches, config.batches)), axis=1)

        def batches(x):
            x = x.reshape(t, *order.shape, *x.shape[2:])
            return jax.vmap(lambda group, order: group[:, order], (1, 0), 2)(x, order).swapaxes(0, 1)

        return jax.lax.scan(step, carry, jax.tree.map(batches, sample))

    carry = ((state.policy.params, state.log_std, state.critic), state.optimiser, state.rate)
    (learnt, optimiser, rate), losses = jax.lax.scan(epoch, carry, jax.random.split(key, config.epochs))
    return learnt, optimiser, rate, jax.tree.map(jnp.mean, losses)


def _falling(config: Config, step: Array, high: float, low: float) -> Array:
    """`high`, but from there to `low` in the last updates, by the same factor in each."""
    left = jnp.clip((1 - step / config.updates) / config.cool, 0, 1)
    return low * (high / low) ** left


def _critic(config: Config, critic_obs: Obs) -> MLP | VisionMLP:
    return network_for(critic_obs, config.critic_hidden_sizes, 1, scale=0.01)


def _value(config: Config, critic: Any, critic_obs: Obs) -> Array:
    """(*batch, n) discounted sum of rewards to come; the network's output is a mean reward."""
    return apply(_critic(config, critic_obs), critic, critic_obs, config.per_agent)[..., 0] / (1 - config.discount)


def _descent(config: Config) -> optax.GradientTransformation:
    return optax.flatten(optax.chain(bounded(config.clip), optax.scale_by_adam()))
