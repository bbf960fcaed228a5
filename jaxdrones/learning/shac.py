"""Short-horizon actor-critic (Xu et al. 2022): backpropagation through short flights, a value at the end."""

from __future__ import annotations

import dataclasses
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array

from jaxdrones.checks import check_key, check_keywords
from jaxdrones.envs import Env
from jaxdrones.learning import collect
from jaxdrones.learning.bptt import discounted
from jaxdrones.learning.gradients import linked, with_gradient
from jaxdrones.learning.networks import MLP, Policy, init_params
from jaxdrones.learning.normalize import vector
from jaxdrones.learning.result import Result, descent, scan_updates
from jaxdrones.learning.returns import advantages
from jaxdrones.learning.settings import check_config, check_settings

_STEPS = 4  # control steps that a gradient step of the critic is taken on


@check_keywords
@dataclasses.dataclass(frozen=True)
class Config:
    """Settings; the numbers that are not shapes may be traced, so that `vmap` tries many."""

    updates: int = 220
    worlds: int = 256
    horizon: int = 64
    """Control steps that a gradient goes back through."""
    sizes: tuple[int, ...] = (32, 32)
    critic_hidden_sizes: tuple[int, ...] = (32, 32)
    memory: float = 1e9
    """Flights that the statistics of observations go back; early ones, far away, would blur what is near."""
    settle: float = 0.2
    """Share of the updates after which the statistics stay as they are."""
    per_agent: bool = False
    learning_rate: float = 2e-2
    """Of the policy, at the start; falls to zero along a cosine."""
    critic_rate: float = 5e-3
    """The same of the critic."""
    critic_steps: int = 8
    """Gradient steps of the critic in an update, each with four successive control steps of all worlds."""
    trust: float = 0.9
    """Share of the updates in which the value of the end grows from nothing to its full weight."""
    discount: float = 0.98
    trace: float = 0.95
    """Lambda of the critic's targets."""
    target_speed: float = 0.2
    """Share of the way that the target critic moves towards the critic in an update."""
    b2: float = 0.95
    """How long Adam remembers the squares of gradients; those of a flight shrink by orders of magnitude."""
    clip: float = 0.3
    """Largest norm of a gradient."""
    restart: float = 0.2
    """Share of the worlds that start afresh before an update; the others fly on."""
    gradient: str = "exact"
    """A name of `GRADIENTS`."""
    decay: float = 0.98
    """Of the gradient, per control step, with `gradient="decay"`."""
    surrogate: Any = None
    """Step of the backward pass with `gradient="surrogate"`; a rigid body with instant rotors when left out."""

    def __post_init__(self):
        check_settings(self, valued=True)


class TrainState(flax.struct.PyTreeNode):
    """All that training needs to go on."""

    step: Array
    """() updates made."""
    key: Array
    policy: Policy
    optimiser: optax.OptState
    critic: Any
    """Parameters of the value function."""
    target: Any
    """The same, some updates behind."""
    critic_optimiser: optax.OptState
    worlds: collect.Worlds


def init(key: jax.Array, env: Env, config: Config) -> TrainState:
    """Before the first update.

    Raises:
        ValueError: no random key, or settings of another learner.
    """
    check_key("key", key)
    check_config(config, Config)
    key, policy_key, critic_key = jax.random.split(key, 3)
    policy = Policy.init(policy_key, env, config.sizes, config.per_agent)
    critic = init_params(critic_key, _critic(config), jnp.zeros(env.observation_size))
    return TrainState(
        jnp.zeros((), jnp.int32),
        key,
        policy,
        _actor_descent(config).init(policy.params),
        critic,
        critic,
        _critic_descent(config).init(critic),
        collect.idle(env, config.worlds),
    )


def update(env: Env, config: Config, state: TrainState) -> tuple[TrainState, dict[str, Array]]:
    """One flight of all worlds, one step of the policy along its gradient, some of the critic towards its returns."""
    check_config(config, Config)
    key, restart_key, fly_key, critic_key = jax.random.split(state.key, 4)
    worlds = collect.restart(restart_key, env, state.worlds, config.restart)
    env = with_gradient(env, config)

    trust = jnp.minimum(state.step / (config.trust * config.updates), 1)

    def value(params, obs):
        """In mean rewards: the sum times one minus the discount."""
        return _critic(config).apply(params, state.policy.statistics.normalize(obs))[..., 0] / (1 - config.discount)

    def loss(params):
        policy = state.policy.replace(params=params)
        after, flight = collect.fly(
            fly_key, env, collect.piloted(policy), worlds, config.horizon, False, linked(config)
        )
        ahead = trust * config.discount * value(state.target, flight.final_obs)
        last = flight.truncated.at[-1].set(~flight.terminated[-1])
        reward = flight.reward + jnp.where(last[..., None], ahead, 0)
        worth = jnp.mean(jnp.sum(discounted(flight.replace(reward=reward), config.discount), axis=0))
        return -worth / config.horizon, (after, flight)

    (_, (worlds, flight)), gradient = jax.value_and_grad(loss, has_aux=True)(state.policy.params)
    step, optimiser = _actor_descent(config).update(gradient, state.optimiser)
    critic, critic_optimiser, critic_loss = _fit(critic_key, config, state, value, flight)
    target = optax.incremental_update(critic, state.target, config.target_speed)
    policy = state.policy.replace(
        params=optax.apply_updates(state.policy.params, step),
        statistics=collect.remember(state.policy.statistics, vector(flight.obs), config, state.step),
    )
    metrics = collect.progress(flight) | {"gradient_norm": optax.tree.norm(gradient), "critic_loss": critic_loss}
    return TrainState(state.step + 1, key, policy, optimiser, critic, target, critic_optimiser, worlds), metrics


def train(key: jax.Array, env: Env, config: Config) -> Result:
    """All updates as one program."""
    return scan_updates(update, env, config, init(key, env, config))


def _fit(key, config: Config, state: TrainState, value, flight: collect.Flight):
    """The critic after some steps towards the TD(lambda) returns of the flight."""
    now, later = value(state.target, flight.obs), value(state.target, flight.final_obs)
    team = (
        jnp.broadcast_to(flight.terminated[..., None], now.shape),
        jnp.broadcast_to(flight.truncated[..., None], now.shape),
    )
    goal = now + advantages(flight.reward, now, later, *team, config.discount, config.trace)
    counts = jnp.broadcast_to(~flight.over[..., None], now.shape)
    flown = jax.lax.stop_gradient((flight.obs, goal, counts.astype(goal.dtype)))
    length = min(_STEPS, config.horizon)

    def loss(params, obs, goal, counts):
        miss = (1 - config.discount) * (value(params, obs) - goal)
        return jnp.mean(counts * miss**2)

    def step(carry, key):
        params, optimiser = carry
        start = jax.random.randint(key, (), 0, config.horizon - length + 1)
        batch = jax.tree.map(lambda x: jax.lax.dynamic_slice_in_dim(x, start, length), flown)
        cost, gradient = jax.value_and_grad(loss)(params, *batch)
        change, optimiser = _critic_descent(config).update(gradient, optimiser)
        return (optax.apply_updates(params, change), optimiser), cost

    carry = (state.critic, state.critic_optimiser)
    (critic, optimiser), cost = jax.lax.scan(step, carry, jax.random.split(key, config.critic_steps))
    return critic, optimiser, jnp.mean(cost)


def _critic(config: Config) -> MLP:
    return MLP(config.critic_hidden_sizes, 1, scale=0.01)


def _actor_descent(config: Config) -> optax.GradientTransformation:
    return descent(config.learning_rate, config.updates, config.clip, b2=config.b2)


def _critic_descent(config: Config) -> optax.GradientTransformation:
    return descent(config.critic_rate, config.updates * config.critic_steps, config.clip)
