"""An EnvRunner of RLlib in which many worlds, the policies and the exploration are one compiled program."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxdrones.adapters.rllib import MultiAgentEnv
from jaxdrones.envs import Env
from jaxdrones.learning import collect, compilation
from jaxdrones.learning.critic import critic_observation
from jaxdrones.learning.exploration import explore, sample
from jaxdrones.learning.networks import Policy
from jaxdrones.learning.normalize import RunningStatistics
from jaxdrones.pytree import PyTreeNode
from jaxdrones.training.rllib.config import Config
from jaxdrones.training.rllib.module import centralized_space, policy_of, to_jax

# isort: split
from ray.rllib.core.columns import Columns
from ray.rllib.env.multi_agent_env_runner import MultiAgentEnvRunner
from ray.rllib.env.multi_agent_episode import MultiAgentEpisode
from ray.rllib.env.single_agent_episode import SingleAgentEpisode
from ray.rllib.utils.metrics import NUM_AGENT_STEPS_SAMPLED, NUM_ENV_STEPS_SAMPLED, NUM_ENV_STEPS_SAMPLED_LIFETIME


class Steps(PyTreeNode):
    """t control steps of w worlds with n drones."""

    columns: dict[str, Any]
    """(t, w, n, ...) what RLlib learns from."""
    terminated: Any
    """(t, w)"""
    truncated: Any
    """(t, w)"""


class TeamEnvRunner(MultiAgentEnvRunner):
    """Simulates `num_envs_per_env_runner` worlds for `rollout_fragment_length` control steps in every call of `sample`.

    `env_config` holds `env`, a jaxdrones environment without cameras, and `settings`, a `Config`. Each drone is an
    agent and has a `CentralizedCriticModule` of the same name. The runner normalizes observations; connectors between
    environment and module are not used.
    """

    def make_env(self) -> None:
        """Prepare the worlds."""
        self.env = MultiAgentEnv(self.config.env_config["env"])  # one world, for its names and spaces
        env, self.num_envs = self.env.env, self.config.num_envs_per_env_runner
        space = centralized_space(env)
        self.env.observation_space = gymnasium.spaces.Dict({agent: space for agent in self.env.possible_agents})
        self.env.action_space = gymnasium.spaces.Dict(self.env.action_spaces)
        self._worlds = collect.empty_worlds(env, self.num_envs)
        self._key = jax.random.key(self._seed or 0)
        self._updates = 0
        self.obs_stats = RunningStatistics.empty(env.observation_size)

    def get_spaces(self) -> dict[str, tuple[gymnasium.Space, gymnasium.Space]]:
        """The spaces of each module."""
        return {agent: (self.env.observation_space[agent], space) for agent, space in self.env.action_spaces.items()}

    def sample(self, **kwargs: Any) -> list[MultiAgentEpisode]:
        """The control steps of every world, cut where episodes end."""
        self._key, key = jax.random.split(self._key)
        modules = [self.module[agent] for agent in self.env.possible_agents]
        log_std = jnp.stack([to_jax(module.log_std) for module in modules])
        self._worlds, self.obs_stats, steps, metrics = _compiled_simulation()(
            self.env.env,
            self.config.env_config["settings"],
            key,
            policy_of(modules, self.obs_stats),
            log_std,
            self._worlds,
            jnp.asarray(self._updates),
        )
        self._updates += 1
        steps, metrics = jax.device_get((steps, metrics))
        self._log(steps, metrics)
        return [self._episode(steps, *part) for part in _parts(steps.terminated | steps.truncated)]

    def get_state(self, *args: Any, **kwargs: Any) -> dict[str, Any]:
        """The state of the runner, with the statistics of observations."""
        return super().get_state(*args, **kwargs) | {"obs_stats": jax.device_get(self.obs_stats)}

    def set_state(self, state: dict[str, Any]) -> None:
        """Take over a state, or parts of one."""
        super().set_state(state)
        self.obs_stats = state.get("obs_stats", self.obs_stats)

    def get_metrics(self) -> Any:
        """The metrics of the steps since the last call."""
        return self.metrics.reduce()

    def _episode(self, steps: Steps, world: int, begin: int, end: int) -> MultiAgentEpisode:
        """The control steps of one world from `begin` to before `end`."""
        episode = MultiAgentEpisode()
        episode.env_t = end - begin
        episode.is_terminated = bool(steps.terminated[end - 1, world])
        episode.is_truncated = bool(steps.truncated[end - 1, world])
        for i, agent in enumerate(self.env.possible_agents):
            x = {name: column[begin:end, world, i] for name, column in steps.columns.items()}
            episode.agent_episodes[agent] = SingleAgentEpisode(
                agent_id=agent,
                module_id=agent,
                multi_agent_episode_id=episode.id_,
                observations=np.concatenate([x["obs"], x["final_obs"][-1:]]),
                infos=[{}] * (end - begin + 1),
                actions=x["action"],
                rewards=x["reward"],
                extra_model_outputs={
                    Columns.ACTION_DIST_INPUTS: x["distribution"],
                    Columns.ACTION_LOGP: x["log_prob"],
                },
                terminated=episode.is_terminated,
                truncated=episode.is_truncated,
                len_lookback_buffer=0,
            )
        return episode

    def _log(self, steps: Steps, metrics: dict[str, np.ndarray]) -> None:
        count = steps.terminated.size
        self.metrics.log_value(NUM_ENV_STEPS_SAMPLED, count, reduce="sum")
        self.metrics.log_value(NUM_ENV_STEPS_SAMPLED_LIFETIME, count, reduce="lifetime_sum", with_throughput=True)
        for agent in self.env.possible_agents:
            self.metrics.log_value((NUM_AGENT_STEPS_SAMPLED, agent), count, reduce="sum")
        for name, x in metrics.items():
            self.metrics.log_value(name, float(x), window=1)


@functools.cache
def _compiled_simulation() -> Any:
    """`_simulate` for all runners: environments that were made of equal arguments share a program."""
    return compilation.jit(_simulate, static_argnums=(0, 1))


def _simulate(
    env: Env,
    settings: Config,
    key: jax.Array,
    policy: Policy,
    log_std: Array,
    worlds: collect.Worlds,
    update: Array,
) -> tuple[collect.Worlds, RunningStatistics, Steps, dict[str, Array]]:
    """The worlds after some control steps, the statistics of observations, these steps, and their metrics."""
    restart_key, collect_key, final_key = jax.random.split(key, 3)
    worlds = collect.restart(restart_key, env, worlds, settings.restart_fraction)
    act = jax.tree_util.Partial(explore, policy, log_std)
    worlds, trajectory = collect.collect(collect_key, env, act, worlds, settings.horizon)
    mean, final_action = policy(trajectory.obs), sample(final_key, policy(trajectory.final_obs), log_std)
    columns = {
        "obs": critic_observation(policy, trajectory.obs, None, action=trajectory.action),
        "final_obs": critic_observation(policy, trajectory.final_obs, None, action=final_action),
        "action": trajectory.action,
        "distribution": jnp.concatenate([mean, jnp.broadcast_to(log_std, mean.shape)], axis=-1),
        "log_prob": trajectory.extras,
        "reward": trajectory.reward,
    }
    obs_stats = collect.update_obs_stats(policy.obs_stats, trajectory, settings, update)
    worlds, metrics = collect.measure(env, settings, update, worlds, trajectory)
    steps = Steps(columns, trajectory.terminated, trajectory.truncated)
    return worlds, obs_stats, steps, metrics


def _parts(done: np.ndarray) -> Iterator[tuple[int, int, int]]:
    """World, first step and end of the parts into which episodes' ends cut the steps of each world.

    Args:
        done: (t, w) whether an episode ended with the step.
    """
    for world in range(done.shape[1]):
        ends = {*(int(k) + 1 for k in np.flatnonzero(done[:, world])), len(done)}
        begin = 0
        for end in sorted(ends):
            yield world, begin, end
            begin = end
