"""Flights of many worlds at once, whose episodes follow one another."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxdrones.envs import Env, autoreset
from jaxdrones.envs.autoreset import Episode

Act = Callable[[jax.Array, Array], tuple[Array, Any]]
"""(key, observations (w, n, d)) -> actions (w, n, a), and what is to be kept of the decision."""


class Worlds(flax.struct.PyTreeNode):
    """w worlds in flight."""

    episodes: Episode
    obs: Array
    """(w, n, d) what is seen now."""


class Flight(flax.struct.PyTreeNode):
    """t control steps of w worlds."""

    obs: Array
    """(t, w, n, d) what was seen before the step."""
    action: Array
    """(t, w, n, a)"""
    kept: Any
    """What `act` wanted to be kept."""
    reward: Array
    """(t, w, n)"""
    terminated: Array
    """(t, w) what follows has no value."""
    truncated: Array
    """(t, w) the episode was cut, though it could go on."""
    final_obs: Array
    """(t, w, n, d) what was seen after the step, before a new episode started."""
    returned: Array
    """(t, w, n) sum of rewards of the episode so far."""
    error: Array
    """(t, w, n) distance from the target, m."""

    @property
    def ended(self) -> Array:
        """(t, w)."""
        return self.terminated | self.truncated


def begin(key: jax.Array, env: Env, worlds: int) -> Worlds:
    """Worlds at the start of their first episodes."""
    obs, episodes = jax.vmap(autoreset(env).reset)(jax.random.split(key, worlds))
    return Worlds(episodes, obs)


def restart(key: jax.Array, env: Env, worlds: Worlds, share: float) -> Worlds:
    """A fresh episode in some worlds, each with probability `share`: so that they are not all of the same age."""
    start_key, choice_key = jax.random.split(key)
    w = len(worlds.obs)
    chosen = jax.random.bernoulli(choice_key, share, (w,))
    fresh = begin(start_key, env, w)
    return jax.tree.map(lambda new, old: jnp.where(_rows(chosen, old), new, old), fresh, worlds)


def fly(
    key: jax.Array, env: Env, act: Act, worlds: Worlds, length: int, link: Callable = lambda worlds: worlds
) -> tuple[Worlds, Flight]:
    """Fly on.

    Args:
        key: random key.
        env: environment.
        act: the pilot of all worlds.
        worlds: in flight.
        length: control steps.
        link: applied to the worlds between steps; changes their gradients, not their values.
    """
    step = jax.vmap(autoreset(env).step)

    def control_step(worlds: Worlds, key: jax.Array) -> tuple[Worlds, Flight]:
        act_key, step_key = jax.random.split(key)
        worlds = link(worlds)
        action, kept = act(act_key, worlds.obs)
        keys = jax.random.split(step_key, len(worlds.obs))
        obs, episodes, reward, terminated, truncated, info = step(keys, worlds.episodes, action)
        flown = Flight(
            obs=worlds.obs,
            action=action,
            kept=kept,
            reward=reward,
            terminated=terminated,
            truncated=truncated & ~terminated,
            final_obs=info["final_obs"],
            returned=info["episode"]["return"],
            error=info["metrics"]["error"],
        )
        return Worlds(episodes, obs), flown

    return jax.lax.scan(control_step, worlds, jax.random.split(key, length))


def progress(flight: Flight) -> dict[str, Array]:
    """What a learner reports of a flight: reward per step, mean error (m), share of steps that crashed."""
    ended = flight.ended[..., None]
    return {
        "reward": jnp.mean(flight.reward),
        "error": jnp.mean(flight.error),
        "crashes": jnp.mean(flight.terminated.astype(flight.reward.dtype)),
        "return": jnp.sum(flight.returned * ended) / jnp.maximum(jnp.sum(ended * flight.returned.shape[-1]), 1),
    }


def _rows(chosen: Array, leaf: Array) -> Array:
    return chosen.reshape(chosen.shape + (1,) * (leaf.ndim - 1))
