"""Flights of many worlds at once, whose episodes follow one another."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdrones.envs import AutoReset, Env
from jaxdrones.envs.autoreset import Episode
from jaxdrones.envs.env import Obs
from jaxdrones.envs.privileged import PrivilegedObservation
from jaxdrones.learning import sharding
from jaxdrones.learning.networks import Policy
from jaxdrones.learning.normalize import Statistics

Act = Callable[[jax.Array, Obs], tuple[Array, Any]]
"""(a key for each world (w,), observations (w, n, d)) -> actions (w, n, a), and what is to be kept of the decision."""


class Worlds(flax.struct.PyTreeNode):
    """w worlds in flight."""

    episodes: Episode
    obs: Obs
    """(w, n, d) what is seen now; here and below, with cameras, a dictionary of that and of images."""
    ended: Array
    """(w,) whether the episode is over, and a new one has to be started."""


class Flight(flax.struct.PyTreeNode):
    """t control steps of w worlds."""

    obs: Obs
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
    final_obs: Obs
    """(t, w, n, d) what was seen after the step, before a new episode started."""
    returned: Array
    """(t, w, n) sum of rewards of the episode so far."""
    error: Array
    """(t, w, n) distance from the target, m."""
    truth: PrivilegedObservation | None
    """(t, w, n, ...) before the step, where it was asked for."""
    final_truth: PrivilegedObservation | None
    """(t, w, n, ...) after the step, before a new episode started."""
    over: Array
    """(t, w) the episode was over before the step, which does not count; never so where episodes are reset."""

    @property
    def ended(self) -> Array:
        """(t, w)."""
        return self.terminated | self.truncated


def idle(env: Env, worlds: int) -> Worlds:
    """Worlds in which nothing has begun yet."""
    obs, episodes = jax.eval_shape(jax.vmap(AutoReset(env).reset), jax.random.split(jax.random.key(0), worlds))
    episodes, obs = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), (episodes, obs))
    return Worlds(episodes, obs, ended=jnp.ones(worlds, bool))


def restart(key: jax.Array, env: Env, worlds: Worlds, share: float = 0.0) -> Worlds:
    """A fresh episode where one is over, and with probability `share` elsewhere: so that not all are of an age."""
    start_key, choice_key = jax.random.split(key)
    w = len(worlds.ended)
    chosen = worlds.ended | jax.random.bernoulli(choice_key, share, (w,))
    obs, episodes = jax.vmap(AutoReset(env).reset)(jax.random.split(start_key, w))
    fresh = Worlds(episodes, obs, jnp.zeros_like(chosen))
    return _where(chosen, fresh, worlds)


def fly(
    key: jax.Array,
    env: Env,
    act: Act,
    worlds: Worlds,
    length: int,
    reset: bool = True,
    link: Callable = lambda worlds: worlds,
    informed: bool = False,
) -> tuple[Worlds, Flight]:
    """Fly on; each device its share of the worlds, where `jax.set_mesh` was given several.

    Args:
        key: random key.
        env: environment.
        act: the pilot of all worlds; where several devices fly, it is differentiated by the arguments of a
            `jax.tree_util.Partial` alone.
        worlds: in flight.
        length: control steps.
        reset: start a new episode in the step in which one ends; else that is left to `restart`, the drones stay as
            they are, and everything from there on is marked as over.
        link: applied to the worlds between steps; changes their gradients, not their values.
        informed: keep the truth beside what is seen.
    """
    truth = jax.vmap(env.privileged_observation) if informed else lambda worlds: None
    step = jax.vmap((AutoReset(env) if reset else _Endless(env)).step)

    def control_step(act: Act, index: Array, worlds: Worlds, key: jax.Array) -> tuple[Worlds, Flight]:
        act_keys, step_keys = (jax.vmap(jax.random.fold_in, (None, 0))(key, index) for key in jax.random.split(key))
        worlds = link(worlds)
        action, kept = act(act_keys, worlds.obs)
        obs, episodes, reward, terminated, truncated, info = step(step_keys, worlds.episodes, action)
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
            truth=truth(worlds.episodes.world),
            final_truth=truth(info["final_world"]),
            over=worlds.ended,
        )
        if reset:
            return Worlds(episodes, obs, worlds.ended), flown
        after = Worlds(episodes, obs, worlds.ended | terminated | truncated)
        return _where(worlds.ended, worlds, after), flown  # a drone that is left to spin flies to infinity

    def flown(act: Act, keys: jax.Array, index: Array, worlds: Worlds) -> tuple[Worlds, Flight]:
        return jax.lax.scan(functools.partial(control_step, act, index), worlds, keys)

    flown = sharding.each_device(
        flown, (sharding.SAME, sharding.SAME, sharding.WORLDS, sharding.WORLDS), (sharding.WORLDS, sharding.STEPS)
    )
    act = act if isinstance(act, jax.tree_util.Partial) else jax.tree_util.Partial(act)
    return flown(act, jax.random.split(key, length), jnp.arange(len(worlds.ended)), worlds)


def piloted(policy: Policy) -> Act:
    """The policy's own actions; nothing is kept."""
    return jax.tree_util.Partial(lambda policy, keys, obs: (policy(obs), None), policy)


class _Endless(AutoReset):
    """Episodes that are not reset."""

    def step(self, key: jax.Array, episode: Episode, action: Array):
        obs, world, reward, terminated, truncated, info = self.env.step(key, episode.world, action)
        episode = Episode(world, episode.episode_return + reward, episode.length + 1)
        last = {"final_obs": obs, "final_world": world}
        info = info | last | {"episode": {"return": episode.episode_return, "length": episode.length}}
        return obs, episode, reward, terminated, truncated, info


def progress(flight: Flight) -> dict[str, Array]:
    """What a learner reports of a flight, over the steps that count.

    Reward per step, error (m), share of steps in which a drone crashed, and the return of the episodes that ended.
    """
    counts = ~flight.over
    ended = flight.ended & counts
    return {
        "reward": jnp.mean(flight.reward, where=counts[..., None]),
        "error": jnp.mean(flight.error, where=counts[..., None]),
        "crashes": jnp.mean(flight.terminated.astype(flight.reward.dtype), where=counts),
        "return": jnp.sum(flight.returned, where=ended[..., None])
        / jnp.maximum(jnp.sum(ended), 1)
        / flight.reward.shape[2],
    }


def remember(statistics: Statistics, seen: Float[Array, "t w n d"], config: Any, step: Array) -> Statistics:
    """The statistics of what was seen so far with those of a flight, until they are settled.

    Args:
        statistics: so far.
        seen: in the flight.
        config: settings: `memory` in flights, `settle` as a share of `updates`.
        step: () updates made.
    """
    new = statistics.update(seen, memory=config.memory * seen[..., 0].size)
    settling = step < config.settle * config.updates
    return jax.tree.map(lambda new, old: jnp.where(settling, new, old), new, statistics)


def _where(chosen: Array, these: Worlds, others: Worlds) -> Worlds:
    """These worlds where chosen (w,), else the others."""

    def pick(this: Array, other: Array) -> Array:
        return jnp.where(chosen.reshape(chosen.shape + (1,) * (this.ndim - 1)), this, other)

    return jax.tree.map(pick, these, others)
