"""RLlib's PPO with a centralized critic for a team, and the start of ray."""

from __future__ import annotations

import atexit
import logging
import os
import secrets
import shutil
import tempfile
import warnings
from typing import Any

from jaxdrones.adapters.rllib import MultiAgentEnv
from jaxdrones.envs import Env
from jaxdrones.training.rllib.config import Config
from jaxdrones.training.rllib.learner import AdaptiveLearner
from jaxdrones.training.rllib.module import CentralizedCriticModule, centralized_space
from jaxdrones.training.rllib.runner import TeamEnvRunner

# isort: split
import ray
from ray.rllib.algorithms.ppo import PPO, PPOConfig
from ray.rllib.core.rl_module.multi_rl_module import MultiRLModuleSpec
from ray.rllib.core.rl_module.rl_module import RLModuleSpec

_OBJECT_STORE_BYTES = 200 * 2**20  # what a training puts into it is far smaller


class _PPO(PPO):
    """PPO that makes no folder in the home folder."""

    def _setup_logdir(self) -> None:
        self._logdir = tempfile.mkdtemp(prefix="rllib-")
        atexit.register(shutil.rmtree, self._logdir, ignore_errors=True)


def start_ray() -> None:
    """Start ray for this process alone, unless it runs, without dashboard and telemetry.

    Ray's processes listen on all network interfaces; they answer only who knows a random token, which is kept in the
    environment of this process. Ray's files are in a temporary folder, which is removed at the end of the process.
    """
    if ray.is_initialized():
        return
    os.environ.setdefault("RAY_AUTH_TOKEN", secrets.token_hex(32))  # otherwise ray writes one into the home folder
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    logging.getLogger("ray").setLevel(logging.ERROR)
    folder = tempfile.mkdtemp(prefix="ray-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    atexit.register(ray.shutdown)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "os.fork", RuntimeWarning)  # another program is executed at once
        ray.init(
            address="local",
            num_cpus=2,
            include_dashboard=False,
            log_to_driver=False,
            logging_level=logging.ERROR,
            object_store_memory=_OBJECT_STORE_BYTES,
            _node_ip_address="127.0.0.1",
            _temp_dir=folder,
        )
    for name in ("ray", "ray.rllib"):
        logging.getLogger(name).setLevel(logging.ERROR)


def build(env: Env, settings: Config, seed: int) -> PPO:
    """The algorithm before its first update.

    Args:
        env: environment to train in, without cameras.
        settings: settings.
        seed: seed of the networks, of exploration and of the starts of episodes.
    """
    return algorithm_config(env, settings).debugging(seed=seed).build_algo()


def algorithm_config(env: Env, settings: Config) -> PPOConfig:
    """The configuration of RLlib's PPO for a team: a module for every drone, whose critic is centralized."""
    spaces = MultiAgentEnv(env).action_spaces
    model = {
        "own_size": env.observation_size,
        "hidden_sizes": list(settings.hidden_sizes),
        "gamma": settings.gamma,
        "init_std": settings.init_std,
    }
    specs = {
        agent: RLModuleSpec(
            module_class=CentralizedCriticModule,
            observation_space=centralized_space(env),
            action_space=space,
            model_config=model,
        )
        for agent, space in spaces.items()
    }
    steps = settings.worlds * settings.horizon
    return (
        PPOConfig(_PPO)
        .environment(
            MultiAgentEnv,
            env_config={"env": env, "settings": settings},
            disable_env_checking=True,
        )
        .env_runners(
            env_runner_cls=TeamEnvRunner,
            num_env_runners=0,
            num_envs_per_env_runner=settings.worlds,
            rollout_fragment_length=settings.horizon,
        )
        .learners(num_learners=0)
        .multi_agent(policies=list(spaces), policy_mapping_fn=_module_of)
        .rl_module(rl_module_spec=MultiRLModuleSpec(rl_module_specs=specs))
        .training(
            learner_class=AdaptiveLearner,
            learner_config_dict={"settings": settings},
            train_batch_size=steps,
            minibatch_size=-(-steps // settings.minibatches),
            num_epochs=settings.epochs,
            lr=settings.learning_rate,
            gamma=settings.gamma,
            lambda_=settings.gae_lambda,
            clip_param=settings.clip_epsilon,
            use_kl_loss=True,  # so that the divergence is computed
            kl_coeff=0.0,
            entropy_coeff=settings.entropy_coef,
            vf_loss_coeff=settings.value_coef * (1 - settings.gamma) ** 2,
            vf_clip_param=float("inf"),
            grad_clip=settings.max_grad_norm,
            grad_clip_by="global_norm",
        )
        .debugging(log_level="ERROR", log_sys_usage=False)
    )


def _module_of(agent: str, *_: Any, **__: Any) -> str:
    """The name of the module of an agent, which is that of the agent."""
    return agent
