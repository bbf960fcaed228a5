"""Backpropagation through time: the gradient of the flown rewards, through physics and policy."""

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
from jaxdrones.learning.gradients import linked, with_gradient
from jaxdrones.learning.networks import Policy
from jaxdrones.learning.normalize import vector
from jaxdrones.learning.result import Result, descent, scan_updates
from jaxdrones.learning.settings import check_config, check_settings


@check_keywords
@dataclasses.dataclass(frozen=True)
class Config:
    """Settings; the numbers that are not shapes may be traced, so that `vmap` tries many."""

    updates: int = 180
    worlds: int = 256
    horizon: int = 64
    """Control steps that a gradient goes back through."""
    sizes: tuple[int, ...] = (32, 32)
    memory: float = 1e9
    """Flights that the statistics of observations go back; early ones, far away, would blur what is near."""
    settle: float = 0.2
    """Share of the updates after which the statistics stay as they are."""
    per_agent: bool = False
    learning_rate: float = 2e-2
    """At the start; falls to zero along a cosine."""
    discount: float = 1.0
    b2: float = 0.95
    """How long Adam remembers the squares of gradients; those of a flight shrink by orders of magnitude."""
    clip: float = 0.3
    """Largest norm of the gradient."""
    restart: float = 0.2
    """Share of the worlds that start afresh before an update; the others fly on."""
    gradient: str = "exact"
    """A name of `GRADIENTS`."""
    decay: float = 0.98
    """Of the gradient, per control step, with `gradient="decay"`."""
    surrogate: Any = None
    """Step of the backward pass with `gradient="surrogate"`; a rigid body with instant rotors when left out."""

    def __post_init__(self):
        check_settings(self)


class TrainState(flax.struct.PyTreeNode):
    """All that training needs to go on."""

    step: Array
    """() updates made."""
    key: Array
    policy: Policy
    optimiser: optax.OptState
    worlds: collect.Worlds


def init(key: jax.Array, env: Env, config: Config) -> TrainState:
    """Before the first update.

    Raises:
        ValueError: no random key, or settings of another learner.
    """
    check_key("key", key)
    check_config(config, Config)
    key, policy_key = jax.random.split(key)
    policy = Policy.init(policy_key, env, config.sizes, config.per_agent)
    return TrainState(
        jnp.zeros((), jnp.int32), key, policy, _optimiser(config).init(policy.params), collect.idle(env, config.worlds)
    )


def update(env: Env, config: Config, state: TrainState) -> tuple[TrainState, dict[str, Array]]:
    """One flight of all worlds and one step along its gradient."""
    check_config(config, Config)
    key, restart_key, fly_key = jax.random.split(state.key, 3)
    worlds = collect.restart(restart_key, env, state.worlds, config.restart)
    env = with_gradient(env, config)

    def loss(params):
        policy = state.policy.replace(params=params)
        after, flight = collect.fly(
            fly_key, env, collect.piloted(policy), worlds, config.horizon, reset=False, link=linked(config)
        )
        return -jnp.mean(discounted(flight, config.discount)), (after, flight)

    (_, (worlds, flight)), gradient = jax.value_and_grad(loss, has_aux=True)(state.policy.params)
    step, optimiser = _optimiser(config).update(gradient, state.optimiser)
    policy = state.policy.replace(
        params=optax.apply_updates(state.policy.params, step),
        statistics=collect.remember(state.policy.statistics, vector(flight.obs), config, state.step),
    )
    metrics = collect.progress(flight) | {"gradient_norm": optax.tree.norm(gradient)}
    return TrainState(state.step + 1, key, policy, optimiser, worlds), metrics


def train(key: jax.Array, env: Env, config: Config) -> Result:
    """All updates as one program."""
    return scan_updates(update, env, config, init(key, env, config))


def discounted(flight: collect.Flight, discount: float) -> Array:
    """(t, w, n) rewards until the episode ends, discounted from the start of the flight."""
    weight = discount ** jnp.arange(len(flight.reward), dtype=flight.reward.dtype)
    return jnp.where(flight.over[..., None], 0, weight[:, None, None] * flight.reward)


def _optimiser(config: Config) -> optax.GradientTransformation:
    return descent(config.learning_rate, config.updates, config.clip, b2=config.b2)
