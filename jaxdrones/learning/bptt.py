"""Backpropagation through time: the gradient of the rewards through physics and policy (analytic policy gradient)."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array

from jaxdrones.checks import check_key, check_keywords
from jaxdrones.envs import Env
from jaxdrones.learning import collect
from jaxdrones.learning.gradients import gradient_between_steps, with_gradient
from jaxdrones.learning.networks import Policy
from jaxdrones.learning.result import Result, cosine_adam, count_nonfinite, run_training
from jaxdrones.learning.returns import discounted_rewards
from jaxdrones.learning.settings import (
    BelowOne,
    Count,
    CountOrNone,
    Fraction,
    Gradient,
    HiddenSizes,
    Positive,
    PositiveOrInfinite,
    Surrogate,
    Switch,
    TracedCount,
    check_config,
    check_settings,
)
from jaxdrones.pytree import PyTreeNode


@check_keywords
@dataclasses.dataclass(frozen=True)
class Config:
    """Settings; the numbers that are not shapes may be traced, so that `vmap` trains with many values at once."""

    updates: TracedCount = 180
    worlds: Count = 256
    horizon: Count = 64
    """Control steps that the gradient goes back through."""
    hidden_sizes: HiddenSizes = (32, 32)
    recurrent_size: CountOrNone = 0
    """Size of the memory that each drone's policy has, of a gated recurrent unit (GRU); 0 for none."""
    obs_stats_window: PositiveOrInfinite = 1e9
    """Number of trajectories whose observations the statistics remember."""
    obs_stats_freeze: Fraction = 0.2
    """Fraction of the updates after which the statistics of observations no longer change."""
    per_agent: Switch = False
    """Whether every drone has a policy of its own; otherwise all drones share one."""
    learning_rate: Positive = 2e-2
    """Learning rate at the start; it falls to zero along a cosine."""
    gamma: Fraction = 1.0
    """Discount factor."""
    adam_b2: BelowOne = 0.95
    """Decay rate of Adam's mean of squared gradients. It is low because gradients shrink by orders of magnitude while
    the policy learns."""
    max_grad_norm: PositiveOrInfinite = 0.3
    restart_fraction: Fraction = 0.2
    """Fraction of the worlds that start a new episode before an update; the others continue theirs."""
    gradient: Gradient = "exact"
    """How the flight is differentiated; see `learning.gradients`."""
    gradient_decay: Fraction = 0.98
    """Factor on the gradient per control step with `gradient="decay"`."""
    surrogate: Surrogate = None
    """Step whose derivatives are taken with `gradient="surrogate"`; a rigid body with instant rotors when left out."""
    image_gradient: Switch = True
    """Whether the gradient goes through the images of cameras, or takes them for constants."""

    def __post_init__(self):
        check_settings(self)


class TrainState(PyTreeNode):
    """Everything that training needs to continue."""

    step: Array
    """() updates made."""
    key: Array
    policy: Policy
    opt_state: optax.OptState
    worlds: collect.Worlds


def init(key: jax.Array, env: Env, config: Config) -> TrainState:
    """The state before the first update.

    Raises:
        ValueError: no random key, or settings of another learner.
    """
    check_key("key", key)
    check_config(config, Config)
    key, policy_key = jax.random.split(key)
    policy = Policy.init(policy_key, env, config.hidden_sizes, config.per_agent, config.recurrent_size)
    return TrainState(
        step=jnp.zeros((), jnp.int32),
        key=key,
        policy=policy,
        opt_state=_optimizer(config).init(policy.params),
        worlds=collect.empty_worlds(env, config.worlds, policy),
    )


def update(env: Env, config: Config, state: TrainState) -> tuple[TrainState, dict[str, Array]]:
    """Simulate a trajectory of all worlds and make one step along the gradient of its rewards."""
    check_config(config, Config)
    key, restart_key, collect_key = jax.random.split(state.key, 3)
    worlds = collect.restart(restart_key, env, state.worlds, config.restart_fraction)
    env = with_gradient(env, config.gradient, config.surrogate, config.image_gradient)
    between_steps = gradient_between_steps(config.gradient, config.gradient_decay)

    def loss(params):
        act = collect.deterministic(state.policy.replace(params=params))
        after, trajectory = collect.collect(
            collect_key, env, act, worlds, config.horizon, reset=False, between_steps=between_steps
        )
        return -jnp.mean(discounted_rewards(trajectory, config.gamma)), (after, trajectory)

    (_, (worlds, trajectory)), gradient = jax.value_and_grad(loss, has_aux=True)(state.policy.params)
    step, opt_state = _optimizer(config).update(gradient, state.opt_state)
    policy = state.policy.replace(
        params=optax.apply_updates(state.policy.params, step),
        obs_stats=collect.update_obs_stats(state.policy.obs_stats, trajectory, config, state.step),
    )
    norm = optax.tree.norm(gradient)
    metrics = {"gradient_norm": norm, "nonfinite_gradients": count_nonfinite(norm)}
    worlds, measured = collect.measure(env, config, state.step, worlds, trajectory)
    metrics |= measured
    return TrainState(state.step + 1, key, policy, opt_state, worlds), metrics


def train(key: jax.Array, env: Env, config: Config) -> Result:
    """Make all updates in one compiled program; see `learning.result.run_training`."""
    check_key("key", key)
    check_config(config, Config)
    return run_training(init, update, key, env, config)


def _optimizer(config: Config) -> optax.GradientTransformation:
    return cosine_adam(config.learning_rate, config.updates, config.max_grad_norm, config.adam_b2)
