"""Backpropagation through time: gradients of the rewards through physics and policy (analytic policy gradient)."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array

from jaxdrones.arguments import TracedCount, checked
from jaxdrones.envs import Env
from jaxdrones.learning import collect, result
from jaxdrones.learning.gradients import GradientConfig, gradient_between_steps, with_gradient
from jaxdrones.learning.metrics import measure
from jaxdrones.learning.networks import Policy
from jaxdrones.learning.returns import discounted_rewards

S = TypeVar("S", bound=result.TrainState)


@checked
@dataclasses.dataclass(frozen=True)
class Config(GradientConfig):
    """Settings; numbers that are not shapes may be traced, so that `vmap` trains with many values at once."""

    updates: TracedCount = 180


def init(key: jax.Array, env: Env, config: Config, network: Any = None) -> result.TrainState:
    """State before the first update."""
    key, policy_key = jax.random.split(key)
    policy = result.init_policy(policy_key, env, config, network)
    opt_state = optimizer(config).init(policy.params)
    worlds = collect.empty_worlds(env, config.worlds, policy)
    return result.TrainState(jnp.zeros((), jnp.int32), key, policy, opt_state, worlds)


def update(env: Env, config: Config, state: result.TrainState) -> tuple[result.TrainState, dict[str, Array]]:
    """Simulate a trajectory of all worlds and take one gradient step on its rewards."""
    return gradient_step(env, config, state)


def gradient_step(
    env: Env,
    config: Config,
    state: S,
    *,
    act: Callable[[Policy], collect.Act] = collect.deterministic,
    learning: slice = slice(None),
) -> tuple[S, dict[str, Array]]:
    """Simulate a trajectory of all worlds and take one gradient step on its rewards.

    The policy acts for all drones by `act`; the rewards of the drones in `learning` count.
    """
    key, *keys = jax.random.split(state.key, 4)

    def cost(policy: Policy, trajectory: collect.Trajectory) -> Array:
        return -jnp.mean(discounted_rewards(trajectory, config.gamma)[..., learning])

    state, _, metrics = policy_step(env, config, state, keys, cost, act=act)
    return state.replace(key=key), metrics


def policy_step(
    env: Env,
    config: GradientConfig,
    state: S,
    keys: Sequence[jax.Array],
    cost: Callable[[Policy, collect.Trajectory], Array],
    *,
    act: Callable[[Policy], collect.Act] = collect.deterministic,
    privileged: bool = False,
) -> tuple[S, collect.Trajectory, dict[str, Array]]:
    """Simulate a trajectory of all worlds and take one gradient step of the policy on its cost.

    The keys are those of starts, restarts and steps. The state keeps its own key.
    """
    start_key, restart_key, collect_key = keys
    progress = collect.progress_of(env, config, state.step)
    starts = collect.draw_starts(start_key, env, config.worlds, progress)
    worlds = collect.restart(restart_key, state.worlds, starts, config.restart_fraction)
    env = with_gradient(env, config)
    between_steps = gradient_between_steps(config)

    def loss(params):
        policy = state.policy.replace(params=params)
        after, trajectory = collect.collect(
            collect_key,
            env,
            act(policy),
            worlds,
            config.horizon,
            between_steps=between_steps,
            privileged=privileged,
        )
        return cost(policy, trajectory), (after, trajectory)

    (_, (worlds, trajectory)), gradient = jax.value_and_grad(loss, has_aux=True)(state.policy.params)
    step, opt_state = optimizer(config).update(gradient, state.opt_state)
    obs_stats = collect.update_obs_stats(state.policy.obs_stats, trajectory, config, state.step)
    policy = state.policy.replace(params=optax.apply_updates(state.policy.params, step)).with_obs_stats(obs_stats)
    norm = optax.tree.norm(gradient)
    metrics = {"gradient_norm": norm, "nonfinite_gradients": result.count_nonfinite(norm)}
    worlds, measured = measure(env, config, state.step, worlds, trajectory)
    state = state.replace(step=state.step + 1, policy=policy, opt_state=opt_state, worlds=worlds)
    return state, trajectory, metrics | measured


train = result.make_train(Config, init, update)


def optimizer(config: GradientConfig) -> optax.GradientTransformation:
    """Optimizer of the policy."""
    return result.cosine_adam(config.learning_rate, config.updates, config.max_grad_norm, config.adam_b2)
