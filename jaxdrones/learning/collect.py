"""Collection of trajectories in many worlds with consecutive episodes."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdrones.checks import takes
from jaxdrones.envs import AutoReset, Env
from jaxdrones.envs.autoreset import Episode
from jaxdrones.envs.env import Obs
from jaxdrones.envs.observations import PrivilegedObservation
from jaxdrones.learning import sharding
from jaxdrones.learning.layers import expand
from jaxdrones.learning.networks import Policy, set_zero
from jaxdrones.learning.normalize import RunningStatistics, state_vector
from jaxdrones.learning.settings import Scalar
from jaxdrones.pytree import PyTreeNode

Act = Callable[[jax.Array, Any, Obs], tuple[Any, Array, Any]]
"""(keys (w,), hidden state, observations (w, n, d)) -> hidden state, actions (w, n, a), and extras such as log
probabilities."""


class Worlds(PyTreeNode):
    """Batch of w worlds, each in the middle of an episode."""

    episodes: Episode
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
    """(t, w) whether the episode terminated; the state after it has no value."""
    truncated: Array
    """(t, w) whether the episode was truncated."""
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
    """(t, w) whether the episode had ended before the step, which is then invalid. Always false with `reset`."""
    hidden_state: Any = None
    """(t, w, n, ...) hidden state of the policy after the observations before the step; `None` without one."""

    @property
    def done(self) -> Array:
        """(t, w) whether the step ended the episode."""
        return self.terminated | self.truncated


def empty_worlds(env: Env, count: int, policy: Policy | None = None) -> Worlds:
    """Worlds before their first episode; `restart` starts one in each."""
    obs, episodes = jax.eval_shape(jax.vmap(AutoReset(env).reset), jax.random.split(jax.random.key(0), count))
    episodes, obs = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), (episodes, obs))
    hidden_state = None if policy is None else policy.initial_hidden_state((count, env.drones))
    none = jnp.zeros(count, episodes.episode_return.dtype)
    return Worlds(episodes, obs, jnp.ones(count, bool), none, none, hidden_state)


def restart(key: jax.Array, env: Env, worlds: Worlds, fraction: Scalar = 0.0, progress: Array | None = None) -> Worlds:
    """Start a new episode in every world with a finished episode, and in the others with a given probability.

    Args:
        key: random key.
        env: environment.
        worlds: worlds.
        fraction: probability of a new episode in the other worlds, which decorrelates the times of their episodes.
        progress: progress of training, see `progress_of`.
    """
    start_key, choice_key = jax.random.split(key)
    count = len(worlds.done)
    chosen = worlds.done | jax.random.bernoulli(choice_key, fraction, (count,))
    obs, episodes = jax.vmap(AutoReset(env, progress).reset)(jax.random.split(start_key, count))
    hidden_state = jax.tree.map(jnp.zeros_like, worlds.hidden_state)
    fresh = worlds.replace(episodes=episodes, obs=obs, done=jnp.zeros_like(chosen), hidden_state=hidden_state)
    return _select(chosen, fresh, worlds)


def collect(
    key: jax.Array,
    env: Env,
    act: Act,
    worlds: Worlds,
    length: int,
    reset: bool = True,
    between_steps: Callable[[Worlds], Worlds] = lambda worlds: worlds,
    privileged: bool = False,
    progress: Array | None = None,
) -> tuple[Worlds, Trajectory]:
    """Simulate all worlds for `length` control steps; with `jax.set_mesh` each device simulates its share.

    Args:
        key: random key.
        env: environment.
        act: function of the actions in all worlds. On several devices it is differentiated only with respect to the
            arguments of a `jax.tree_util.Partial`.
        worlds: worlds at the start of the trajectory.
        length: control steps.
        reset: whether a new episode starts in the step that ends one. Otherwise the drones are frozen, and all later
            steps are marked by `was_done`, until `restart` starts a new episode.
        between_steps: function of the worlds between steps, to change their gradient.
        privileged: whether to record privileged observations.
        progress: progress of training, see `progress_of`.
    """
    privileged_of = jax.vmap(env.privileged_observation) if privileged else lambda worlds: None

    def control_step(
        act: Act, index: Array, progress: Array | None, worlds: Worlds, key: jax.Array
    ) -> tuple[Worlds, Trajectory]:
        step = jax.vmap((AutoReset(env, progress) if reset else _NoReset(env)).step)
        act_keys, step_keys = (jax.vmap(jax.random.fold_in, (None, 0))(key, index) for key in jax.random.split(key))
        worlds = between_steps(worlds)
        hidden_state, action, extras = act(act_keys, worlds.hidden_state, worlds.obs)
        obs, episodes, reward, terminated, truncated, info = step(step_keys, worlds.episodes, action)
        recorded = Trajectory(
            obs=worlds.obs,
            action=action,
            extras=extras,
            reward=reward,
            terminated=terminated,
            truncated=truncated & ~terminated,
            final_obs=info["final_obs"],
            episode_return=info["episode"]["return"],
            length=info["episode"]["length"],
            error=info["metrics"]["error"],
            privileged=privileged_of(worlds.episodes.world),
            final_privileged=privileged_of(info["final_world"]),
            was_done=worlds.done,
            hidden_state=hidden_state,
        )
        ended = terminated | truncated
        if reset:
            hidden_state = set_zero(ended, hidden_state)
            return worlds.replace(episodes=episodes, obs=obs, hidden_state=hidden_state), recorded
        after = worlds.replace(episodes=episodes, obs=obs, done=worlds.done | ended, hidden_state=hidden_state)
        return _select(worlds.done, worlds, after), recorded  # otherwise a lost drone would fly on to infinity

    def control_steps(
        act: Act, keys: jax.Array, progress: Array | None, index: Array, worlds: Worlds
    ) -> tuple[Worlds, Trajectory]:
        return jax.lax.scan(functools.partial(control_step, act, index, progress), worlds, keys)

    control_steps = sharding.map_worlds(
        control_steps,
        (sharding.REPLICATED, sharding.REPLICATED, sharding.REPLICATED, sharding.WORLDS, sharding.WORLDS),
        (sharding.WORLDS, sharding.STEPS),
    )
    act = act if isinstance(act, jax.tree_util.Partial) else jax.tree_util.Partial(act)
    return control_steps(act, jax.random.split(key, length), progress, jnp.arange(len(worlds.done)), worlds)


def progress_of(env: Env, config: Any, step: Array) -> Array | None:
    """Progress of training in [0, 1] for a task with a curriculum; `None` for other tasks.

    Args:
        env: environment.
        config: settings of a learner; `updates` is used.
        step: () updates made.
    """
    task = getattr(env, "task", None)
    return (step / config.updates).astype(jnp.float32) if task and takes(task.start, "progress") else None


def deterministic(policy: Policy) -> Act:
    """Actions of the policy without exploration noise, and no extras."""
    return jax.tree_util.Partial(lambda policy, keys, hidden_state, obs: (*policy.act(hidden_state, obs), None), policy)


class _NoReset(AutoReset):
    """Episodes without automatic reset."""

    def step(self, key: jax.Array, episode: Episode, action: Array):
        obs, world, reward, terminated, truncated, info = self.env.step(key, episode.world, action)
        episode = Episode(world, episode.episode_return + reward, episode.length + 1)
        final = {"final_obs": obs, "final_world": world}
        info = info | final | {"episode": {"return": episode.episode_return, "length": episode.length}}
        return obs, episode, reward, terminated, truncated, info


def measure(
    env: Env, config: Any, step: Array, worlds: Worlds, trajectory: Trajectory
) -> tuple[Worlds, dict[str, Array]]:
    """Update the returns of the worlds after a trajectory, and compute the metrics of an update.

    The metrics are the mean reward and the mean error (m) of the valid steps, the fraction of them that terminated an
    episode, and the mean return. The latter is NaN before a whole episode can have ended, as only failed episodes have
    ended by then: in the first `env.steps` steps of a training, and always if every trajectory is shorter and starts
    new episodes in all worlds.

    Args:
        env: environment.
        config: settings of a learner; `horizon` and `restart_fraction` are used.
        step: () updates made before this one.
        worlds: worlds after the trajectory.
        trajectory: trajectory.
    """
    counts = ~trajectory.was_done
    worlds = with_returns(worlds, trajectory, config.restart_fraction)
    episodes_fit = config.horizon >= env.steps
    could_end = (config.restart_fraction < 1) & ((step + 1) * config.horizon >= env.steps) | episodes_fit
    return worlds, {
        "reward": jnp.mean(trajectory.reward, where=counts[..., None]),
        "error": jnp.mean(trajectory.error, where=counts[..., None]),
        "termination_rate": jnp.mean(trajectory.terminated.astype(trajectory.reward.dtype), where=counts),
        "return": jnp.where(could_end, mean_return(worlds), jnp.nan),
    }


def with_returns(worlds: Worlds, trajectory: Trajectory, restart_fraction: Scalar) -> Worlds:
    """Worlds with the return and the weight of the last finished episode in each.

    An episode of k updates survives `restart` with the probability (1 - restart_fraction)^k. The inverse is the weight
    that corrects for missing long episodes (Horvitz and Thompson 1952).

    Args:
        worlds: worlds after the trajectory.
        trajectory: trajectory.
        restart_fraction: probability of being cut before an update.
    """
    ended = trajectory.done & ~trajectory.was_done
    t = jnp.arange(len(ended))[:, None]
    last = jnp.max(jnp.where(ended, t, -1), axis=0)
    chosen = t == last[None]  # an index would make devices exchange worlds
    length = jnp.sum(jnp.where(chosen, trajectory.length, 0), axis=0)
    passed = -((last + 1 - length) // len(ended))  # updates since its first step
    weight = (1 - jnp.asarray(restart_fraction, trajectory.reward.dtype)) ** -passed
    returns = jnp.mean(jnp.sum(jnp.where(chosen[..., None], trajectory.episode_return, 0), axis=0), axis=-1)
    return worlds.replace(
        last_return=jnp.where(last >= 0, returns, worlds.last_return),
        last_weight=jnp.where(last >= 0, weight, worlds.last_weight),
    )


def mean_return(worlds: Worlds) -> Float[Array, ""]:
    """Mean return of the last finished episode over worlds and drones; NaN before the first.

    Every world counts once. A mean over all finished episodes would be biased towards short ones.
    """
    weight = jnp.sum(worlds.last_weight)
    mean = jnp.sum(worlds.last_weight * worlds.last_return) / jnp.where(weight > 0, weight, 1)
    return jnp.where(weight > 0, mean, jnp.nan)


def update_obs_stats(
    statistics: RunningStatistics, trajectory: Trajectory, config: Any, step: Array
) -> RunningStatistics:
    """Update the statistics with the observations of the valid steps of a trajectory, until they are frozen.

    Args:
        statistics: statistics so far.
        trajectory: trajectory.
        config: settings of a learner; `obs_stats_window`, `obs_stats_freeze` and `updates` are used.
        step: () updates made.
    """
    obs = state_vector(trajectory.obs)
    counts = jnp.broadcast_to(~trajectory.was_done[..., None], obs.shape[:-1])
    new = statistics.update(obs, window=config.obs_stats_window * obs[..., 0].size, where=counts)
    frozen = step >= config.obs_stats_freeze * config.updates
    return jax.tree.map(lambda new, old: jnp.where(frozen, old, new), new, statistics)


def _select(condition: Array, worlds: Worlds, others: Worlds) -> Worlds:
    """Worlds where the condition (w,) holds, else the others."""
    return jax.tree.map(lambda x, other: jnp.where(expand(condition, x.ndim), x, other), worlds, others)
