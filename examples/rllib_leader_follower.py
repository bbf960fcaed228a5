"""Leader and follower of Panerati et al. 2021 by RLlib's PPO with centralized critics.

`make rllib` trains three seeds. The best policy of each is saved in the format of `jaxdrones train`, for `jaxdrones
eval` and `jaxdrones fly --policy` without ray; the learning curves are in curve.png.
"""

import argparse
import functools
import itertools
import math
import os
import secrets
import time
from pathlib import Path

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import ray
import torch
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.algorithms.ppo.torch.ppo_torch_learner import PPOTorchLearner
from ray.rllib.core.rl_module.apis.value_function_api import ValueFunctionAPI
from ray.rllib.core.rl_module.multi_rl_module import MultiRLModuleSpec
from ray.rllib.core.rl_module.rl_module import RLModuleSpec
from ray.rllib.core.rl_module.torch import TorchRLModule
from ray.rllib.env.multi_agent_env_runner import MultiAgentEnvRunner
from ray.rllib.env.multi_agent_episode import MultiAgentEpisode
from ray.rllib.env.single_agent_episode import SingleAgentEpisode
from ray.rllib.utils.metrics import NUM_ENV_STEPS_SAMPLED, NUM_ENV_STEPS_SAMPLED_LIFETIME

from jaxdrones.adapters.rllib import MultiAgentEnv
from jaxdrones.learning import collect, evaluate
from jaxdrones.learning.critic import centralized_input
from jaxdrones.learning.exploration import explore
from jaxdrones.learning.normalize import RunningStatistics
from jaxdrones.learning.weights import mlp_policy
from jaxdrones.training.recipe import Recipe
from jaxdrones.training.run import Run
from jaxdrones.visualization.learning_curves import save_curves

RECIPE = Recipe.of("leader-follower", "ppo")
SPACE = gymnasium.spaces.Box(-math.inf, math.inf, (25,))  # all observations, and the action of the other drone
HIDDEN, GAMMA, MINIBATCHES = (64, 64), 0.99, 8
PPO = dict(num_epochs=5, gamma=GAMMA, lambda_=1.0, clip_param=0.2, grad_clip=0.5, grad_clip_by="global_norm")
PPO |= dict(vf_loss_coeff=0.5 * (1 - GAMMA) ** 2, vf_clip_param=math.inf, use_kl_loss=False)
RATES = (2e-3, 1e-5)  # learning rate: first, last
STDS = (0.05, 0.2, 0.5)  # standard deviation of actions: last, lowest before it is annealed, first
ANNEALED, RESTARTED = 0.4, 0.05  # fractions of annealing updates, and of restarted worlds in each


class CentralizedCritic(TorchRLModule, ValueFunctionAPI):
    """Policy of a drone's own observation, the first entries, and critic of all observations and other actions."""

    def setup(self):
        actions, self.own_size = self.action_space.shape[0], self.model_config["own_size"]
        self.policy = mlp((self.own_size, *HIDDEN, actions))
        self.critic = mlp((self.observation_space.shape[0], *HIDDEN, 1))
        self.log_std = torch.nn.Parameter(torch.full((actions,), math.log(STDS[2])))

    def _forward(self, batch, **_):
        mean = torch.tanh(self.policy(batch["obs"][..., : self.own_size]))
        return {"action_dist_inputs": torch.cat([mean, self.log_std.expand_as(mean)], dim=-1)}

    def compute_values(self, batch, embeddings=None):
        return self.critic(batch["obs"]).squeeze(-1) / (1 - GAMMA)


def mlp(sizes):
    """Linear layers with tanh between them; initial outputs are near zero, for hover."""
    layers = [layer for pair in itertools.pairwise(sizes) for layer in (torch.nn.Linear(*pair), torch.nn.Tanh())]
    for parameter in layers[-2].parameters():
        parameter.data *= 0.01
    return torch.nn.Sequential(*layers[:-1])


class AnnealingLearner(PPOTorchLearner):
    """PPO with annealed exploration in the last updates."""

    def after_gradient_based_update(self, *, timesteps):
        super().after_gradient_based_update(timesteps=timesteps)
        done = timesteps[NUM_ENV_STEPS_SAMPLED_LIFETIME] / self.config.learner_config_dict["steps"]
        highest = STDS[0] * (STDS[2] / STDS[0]) ** min(1.0, max(0.0, 1 - done) / ANNEALED)
        for name in self.module.keys():
            self.module[name].unwrapped().log_std.data.clamp_(math.log(min(STDS[1], highest)), math.log(highest))


class TeamRunner(MultiAgentEnvRunner):
    """EnvRunner with many worlds, policies and exploration in one compiled program."""

    def make_env(self):
        self.team, self.horizon = RECIPE.env(), self.config.rollout_fragment_length
        self.env, self.num_envs = MultiAgentEnv(self.team), self.config.num_envs_per_env_runner
        self.env.observation_space = gymnasium.spaces.Dict(dict.fromkeys(self.env.agents, SPACE))
        self.env.action_space = gymnasium.spaces.Dict(self.env.action_spaces)
        self.worlds, self.key = collect.empty_worlds(self.team, self.num_envs), jax.random.key(self._seed or 0)
        self.statistics = RunningStatistics.empty(self.team.observation_size)

    def get_spaces(self):
        return {name: (SPACE, space) for name, space in self.env.action_spaces.items()}

    def policy(self):
        """Policies of all drones in JAX, without exploration."""
        layers = zip(*(self.module[name].policy[::2] for name in self.env.agents), strict=True)
        weights = [(stacked(x.weight for x in drones), stacked(x.bias for x in drones)) for drones in layers]
        return mlp_policy(weights, obs_stats=self.statistics, per_agent=True)

    def sample(self, **_):
        """Control steps of an update; each part of an episode is an episode of RLlib."""
        self.key, key = jax.random.split(self.key)
        log_std = stacked(self.module[name].log_std for name in self.env.agents)
        self.worlds, raw, steps = simulate(self.team, self.horizon, key, self.policy(), log_std, self.worlds)
        self.statistics, steps = self.statistics.update(raw), jax.device_get(steps)
        for name, reduce in ((NUM_ENV_STEPS_SAMPLED, "sum"), (NUM_ENV_STEPS_SAMPLED_LIFETIME, "lifetime_sum")):
            self.metrics.log_value(name, self.num_envs * self.horizon, reduce=reduce)
        self.metrics.log_value("reward", float(steps["rewards"].mean()), window=1)
        return [
            self.episode(steps, world, begin, end)
            for world, done in enumerate((steps["terminated"] | steps["truncated"]).T)
            for begin, end in itertools.pairwise(sorted({0, self.horizon, *(np.flatnonzero(done) + 1).tolist()}))
        ]

    def episode(self, steps, world, begin, end):
        """Control steps of one world from `begin` to before `end`."""
        episode = MultiAgentEpisode()
        ends = {name: bool(steps[name][end - 1, world]) for name in ("terminated", "truncated")}
        episode.env_t, episode.is_terminated, episode.is_truncated = end - begin, *ends.values()
        for i, name in enumerate(self.env.agents):
            x = {column: steps[column][begin:end, world, i] for column in steps.keys() - ends.keys()}
            ids = {"agent_id": name, "module_id": name, "multi_agent_episode_id": episode.id_, "len_lookback_buffer": 0}
            obs, infos = np.concatenate([x.pop("obs"), x.pop("final")[-1:]]), [{}] * (end - begin + 1)
            own = {column: x.pop(column) for column in ("actions", "rewards")}
            agent = SingleAgentEpisode(observations=obs, infos=infos, extra_model_outputs=x, **own, **ends, **ids)
            episode.agent_episodes[name] = agent
        return episode

    def get_metrics(self):
        return self.metrics.reduce()


def stacked(tensors):
    """Stack tensors of the drones to one array."""
    return jnp.stack([jnp.array(x.detach().numpy()) for x in tensors])


@functools.partial(jax.jit, static_argnums=(0, 1))
def simulate(env, horizon, key, policy, log_std, worlds):
    """Worlds after some control steps, all observations, and (t, w, n, ...) training data."""
    start_key, restart_key, key, noise_key = jax.random.split(key, 4)
    act = jax.tree_util.Partial(explore, policy, log_std)
    starts = collect.draw_starts(start_key, env, len(worlds.done))
    worlds = collect.restart(restart_key, worlds, starts, RESTARTED)
    noise = jax.random.normal(noise_key, (2 * horizon, len(worlds.done), env.drones, env.action_size))
    worlds, x = collect.collect(key, env, act, worlds, horizon, noise=noise[:horizon], starts=starts)
    final_actions = act(noise[horizon:], None, x.final_obs)[1]
    obs, final_obs = map(policy.obs_stats.normalize, (x.obs, x.final_obs))
    mean = policy(x.obs)
    steps = {"obs": centralized_input(obs, x.action), "final": centralized_input(final_obs, final_actions)}
    steps |= {"actions": x.action, "rewards": x.reward}
    steps |= {"terminated": x.terminated[..., 0], "truncated": x.truncated[..., 0]}  # all drones end at once
    inputs = jnp.concatenate([mean, jnp.broadcast_to(log_std, mean.shape)], axis=-1)
    return worlds, x.obs, steps | {"action_dist_inputs": inputs, "action_logp": x.extras}


def build(env, seed, updates, worlds, horizon):
    """RLlib's PPO, with a module for each drone."""
    steps, own = worlds * horizon, {"own_size": env.observation_size}
    specs = {
        name: RLModuleSpec(CentralizedCritic, observation_space=SPACE, action_space=actions, model_config=own)
        for name, actions in MultiAgentEnv(env).action_spaces.items()
    }
    config = PPOConfig().environment(MultiAgentEnv, disable_env_checking=True)
    config.env_runners(env_runner_cls=TeamRunner, num_env_runners=0)
    config.env_runners(num_envs_per_env_runner=worlds, rollout_fragment_length=horizon)
    config.learners(num_learners=0, learner_class=AnnealingLearner, learner_config_dict={"steps": updates * steps})
    config.multi_agent(policies=list(specs), policy_mapping_fn=lambda agent, *_, **__: agent)
    config.rl_module(rl_module_spec=MultiRLModuleSpec(rl_module_specs=specs))
    rates = [[0, RATES[0]], [(1 - ANNEALED) * updates * steps, RATES[0]], [updates * steps, RATES[1]]]
    config.training(train_batch_size=steps, minibatch_size=-(-steps // MINIBATCHES), lr=rates, **PPO)
    return config.debugging(seed=seed, log_level="ERROR", log_sys_usage=False).build_algo()


def train(seed, updates, worlds, horizon, folder):
    """Train a seed; return its rows of progress, and the best policy with its return and update."""
    env, start, rows, best = RECIPE.env(), time.perf_counter(), [], (-math.inf, None, 0)
    algorithm = build(env, seed, updates, worlds, horizon)
    for update in range(1, updates + 1):
        row = {"update": update, "steps": update * worlds * horizon * env.drones}
        rows.append(row | {"reward": algorithm.train()["env_runners"]["reward"]})
        if update % max(1, updates // 20) == 0 or update == updates:
            policy = algorithm.env_runner.policy()
            report = evaluate(env, policy, jax.random.key(seed), episodes=1)  # starts and physics are not random
            score, error = report.mean_return, report.final_error_percentiles[50]
            rows[-1] |= {"evaluated_return": score, "success": report.success, "evaluated_error": error}
            best = max(best, (score, policy, update), key=lambda x: x[0])
            when = f"seed {seed}, update {update}, {time.perf_counter() - start:.0f} s"
            print(f"{when}: return {score:.2f}, {100 * error:.2f} cm from the set-points in the end", flush=True)
    algorithm.stop()
    Run(folder).save_policy("best", best[1], recipe=RECIPE.as_dict(), update=best[2])
    return rows, best


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, default in (("seeds", 3), ("updates", 200), ("worlds", 128), ("horizon", 128)):
        parser.add_argument(f"--{name}", type=int, default=default)
    parser.add_argument("--output", type=Path, default=Path("runs/leader-follower-rllib"))
    options = parser.parse_args()
    torch.set_num_threads(1)  # JAX uses the other cores
    os.environ.setdefault("RAY_AUTH_TOKEN", secrets.token_hex(32))  # without one, ray writes one into the home folder
    ray.init(address="local", include_dashboard=False, log_to_driver=False, _node_ip_address="127.0.0.1")
    sizes = options.updates, options.worlds, options.horizon
    trained = {f"seed {i}": train(i, *sizes, options.output / f"seed-{i}") for i in range(options.seeds)}
    _, policy, update = max((best for _, best in trained.values()), key=lambda x: x[0])
    Run(options.output).save_policy("best", policy, recipe=RECIPE.as_dict(), update=update)
    histories = {name: rows for name, (rows, _) in trained.items()}
    kept = {name: best[2] for name, (_, best) in trained.items()}
    save_curves(histories, options.output / "curve.png", "leader-follower by RLlib's PPO", kept=kept)


if __name__ == "__main__":
    main()
