"""Collection of trajectories in many worlds with consecutive episodes."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxdrones.arguments import Scalar
from jaxdrones.checks import takes
from jaxdrones.envs import AutoReset, Env
from jaxdrones.envs.autoreset import Episode
from jaxdrones.envs.env import Obs
from jaxdrones.envs.observations import PrivilegedObservation
from jaxdrones.learning import sharding
from jaxdrones.learning.layers import expand
from jaxdrones.learning.networks import Policy
from jaxdrones.learning.normalize import RunningStatistics, state_vector
from jaxdrones.pytree import PyTreeNode

Act = Callable[[Any, Any, Obs], tuple[Any, Array, Any]]
"""(noise, hidden state, observations (w, n, d)) -> hidden state, actions (w, n, a), and extras such as log
probabilities."""

Starts = tuple[Obs, Episode]
"""First observations (w, n, d) and episodes of w worlds, without the constant fields of the world."""


class Worlds(PyTreeNode):
    """Batch of w worlds, each in the middle of an episode."""

    episodes: Episode
    """Without the fields of the world that are constant over episodes, which are those of the environment."""
    obs: Obs
    """(w, n, d) current observations; here and below, with cameras, a dictionary of such an array and of images."""
    done: Array
    """(w,) whether the episode has ended and a restart is due."""
    last_return: Array
    """(w,) return of the last finished episode, mean over drones; 0 before the first."""
    last_weight: Array
    """(w,) weight of that episode in the mean return; 0 before the first. See `mean_return`."""
    hidden_state: Any = None
    """(w, n, ...) hidden state of the policy before the observations; `None` without one."""


class Trajectory(PyTreeNode):
    """Trajectory of t control steps of w worlds."""

    obs: Obs
    """(t, w, n, d) observations before the step."""
    action: Array
    """(t, w, n, a)"""
    extras: Any
    """Extras from `act`."""
    reward: Array
    """(t, w, n)"""
    terminated: Array
    """(t, w, n) whether the episode of the drone terminated; the state after it has no value."""
    truncated: Array
    """(t, w, n) whether the episode of the drone was truncated."""
    done: Array
    """(t, w) whether the step ended the episode of the team."""
    final_obs: Obs
    """(t, w, n, d) observations after the step, before a new episode starts."""
    episode_return: Array
    """(t, w, n) sum of the rewards of the episode so far."""
    length: Array
    """(t, w) control steps of the episode so far."""
    error: Array
    """(t, w, n) distance from the target, m."""
    privileged: PrivilegedObservation | None
    """(t, w, n, ...) privileged observations before the step; `None` unless requested."""
    final_privileged: PrivilegedObservation | None
    """(t, w, n, ...) privileged observations after the step, before a new episode starts."""
    was_done: Array
    """(t, w, n) whether the episode of the drone had ended before the step, which is then invalid. Always false with
    `starts`, unless drones end alone."""
    hidden_state: Any = None
    """(t, w, n, ...) hidden state of the policy after the observations before the step; `None` without one."""


def empty_worlds(env: Env, count: int, policy: Policy | None = None) -> Worlds:
    """Worlds before their first episode; `restart` starts one in each."""
    shapes = jax.eval_shape(lambda: draw_starts(jax.random.key(0), env, count))
    obs, episodes = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
    hidden_state = None if policy is None else policy.initial_hidden_state((count, env.drones))
    none = jnp.zeros(count, episodes.episode_return.dtype)
    return Worlds(episodes, obs, jnp.ones(count, bool), none, none, hidden_state)


def draw_starts(key: jax.Array, env: Env, count: int, progress: Array | None = None) -> Starts:
    """Draw the starts of episodes in `count` worlds; `progress` is that of `progress_of`."""
    obs, episodes = jax.vmap(AutoReset(env, progress).reset)(jax.random.split(key, count))
    return sharding.on_every_device((obs, _without_constants(env, episodes)))


def restart(key: jax.Array, worlds: Worlds, starts: Starts, fraction: Scalar = 0.0) -> Worlds:
    """Start a new episode in every world with a finished episode, and in the others with the probability `fraction`.

    New episodes in the others decorrelate the times of their episodes.
    """
    chosen = worlds.done | jax.random.bernoulli(key, fraction, worlds.done.shape)
    return _select(chosen, _started(worlds, starts), worlds)


def collect(
    key: jax.Array,
    env: Env,
    act: Act,
    worlds: Worlds,
    length: int,
    *,
    noise: Any = None,
    starts: Starts | None = None,
    between_steps: Callable[[Worlds], Worlds] = lambda worlds: worlds,
    privileged: bool = False,
) -> tuple[Worlds, Trajectory]:
    """Simulate all worlds for `length` control steps; with `jax.set_mesh` each device simulates its share.

    On several devices `act`, the actions in all worlds, is differentiated only with respect to the arguments of a
    `jax.tree_util.Partial`. Its first argument in every step is a row of `noise` (length, w, ...).

    With `starts` of further episodes, a world whose episode ends continues from the start of another world, of a
    different one in every step, so that hard starts do not repeat themselves. By default the drones are frozen after
    the end of an episode, and all later steps are marked by `was_done`, until `restart` starts a new one.

    `between_steps` is a function of the worlds between steps, to change their gradient; `privileged` records privileged
    observations.
    """

    def one_step(key: jax.Array, episode: Episode, action: Array) -> tuple:
        obs, episode, *outcome = AutoReset(env).step_without_reset(key, _with_constants(env, episode), action)
        return obs, _without_constants(env, episode), *outcome

    def privileged_of(episodes: Episode) -> PrivilegedObservation | None:
        if not privileged:
            return None
        return jax.vmap(lambda episode: env.privileged_observation(_with_constants(env, episode).world))(episodes)

    def control_step(
        act: Act, index: Array, starts: Starts | None, worlds: Worlds, inputs: tuple
    ) -> tuple[Worlds, Trajectory]:
        t, key, noise = inputs
        worlds = between_steps(worlds)
        hidden_state, action, extras = act(noise, worlds.hidden_state, worlds.obs)
        keys = jax.vmap(jax.random.fold_in, (None, 0))(key, index)
        obs, episodes, reward, terminated, truncated, info = jax.vmap(one_step)(keys, worlds.episodes, action)
        recorded = Trajectory(
            obs=worlds.obs,
            action=action,
            extras=extras,
            reward=reward,
            terminated=info["terminated"],
            truncated=info["truncated"] & ~info["terminated"],
            done=terminated | truncated,
            final_obs=obs,
            episode_return=info["episode"]["return"],
            length=info["episode"]["length"],
            error=info["metrics"]["error"],
            privileged=privileged_of(worlds.episodes),
            final_privileged=privileged_of(episodes),
            was_done=worlds.done[:, None] | ~info["active"],
            hidden_state=hidden_state,
        )
        after = worlds.replace(episodes=episodes, obs=obs, hidden_state=hidden_state)
        if starts is not None:
            first = (index[0] + t + 1) % count
            following = jax.tree.map(lambda x: jax.lax.dynamic_slice_in_dim(x, first, len(keys)), starts)
            return _select(recorded.done, _started(after, following), after), recorded
        after = after.replace(done=worlds.done | recorded.done)
        return _select(worlds.done, worlds, after), recorded  # otherwise a lost drone would fly on to infinity

    def control_steps(
        act: Act, keys: jax.Array, index: Array, starts: Starts | None, noise: Any, worlds: Worlds
    ) -> tuple[Worlds, Trajectory]:
        starts = jax.tree.map(lambda x: jnp.concatenate([x, x]), starts)
        inputs = jnp.arange(length), keys, noise
        return jax.lax.scan(functools.partial(control_step, act, index, starts), worlds, inputs)

    count = len(worlds.done)
    replicated, by_worlds, by_steps = sharding.REPLICATED, sharding.WORLDS, sharding.STEPS
    control_steps = sharding.map_worlds(
        control_steps, (replicated, replicated, by_worlds, replicated, by_steps, by_worlds), (by_worlds, by_steps)
    )
    act = act if isinstance(act, jax.tree_util.Partial) else jax.tree_util.Partial(act)
    return control_steps(act, jax.random.split(key, length), jnp.arange(count), starts, noise, worlds)


def _started(worlds: Worlds, starts: Starts) -> Worlds:
    obs, episodes = starts
    hidden_state = jax.tree.map(jnp.zeros_like, worlds.hidden_state)
    return worlds.replace(episodes=episodes, obs=obs, done=jnp.zeros_like(worlds.done), hidden_state=hidden_state)


def _without_constants(env: Env, episode: Episode) -> Episode:
    return episode.replace(world=episode.world.replace(**dict.fromkeys(env.constant_fields)))


def _with_constants(env: Env, episode: Episode) -> Episode:
    return episode.replace(world=episode.world.replace(**{name: getattr(env, name) for name in env.constant_fields}))


def progress_of(env: Env, config: Any, step: Array) -> Array | None:
    """Progress of training in [0, 1] after `step` updates for a task with a curriculum; `None` for others."""
    return (step / config.updates).astype(jnp.float32) if takes(env.task.start, "progress") else None


def deterministic(policy: Policy) -> Act:
    """Actions of the policy without exploration noise, and no extras."""

    def act(policy: Policy, noise: Any, hidden_state: Any, obs: Obs) -> tuple[Any, Array, Any]:
        return *policy.act(hidden_state, obs), None

    return jax.tree_util.Partial(act, policy)


def update_obs_stats(
    statistics: RunningStatistics, trajectory: Trajectory, config: Any, step: Array
) -> RunningStatistics:
    """Update the statistics with the observations of the valid steps of a trajectory, until they are frozen."""
    obs = state_vector(trajectory.obs)
    new = statistics.update(obs, window=config.obs_stats_window * obs[..., 0].size, where=~trajectory.was_done)
    frozen = step >= config.obs_stats_freeze * config.updates
    return jax.tree.map(lambda new, old: jnp.where(frozen, old, new), new, statistics)


def _select(condition: Array, worlds: Worlds, others: Worlds) -> Worlds:
    """Worlds where the condition (w,) holds, else the others."""
    return jax.tree.map(lambda x, other: jnp.where(expand(condition, x.ndim), x, other), worlds, others)
