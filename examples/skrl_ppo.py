"""skrl's PPO in PyTorch on `gymnasium.make_vec`: hover from starts near the goal.

pip install jaxdrones torch skrl
python examples/skrl_ppo.py
"""

import argparse

import gymnasium
import torch
from skrl.agents.torch.ppo import PPO, PPO_CFG
from skrl.envs.wrappers.torch import wrap_env
from skrl.memories.torch import RandomMemory
from skrl.models.torch import DeterministicMixin, GaussianMixin, Model
from skrl.resources.preprocessors.torch import RunningStandardScaler
from skrl.trainers.torch import SequentialTrainer
from torch import nn

import jaxdrones.adapters.gymnasium  # noqa: F401, registers jaxdrones/Hover-v0


def network(inputs: int, outputs: int) -> nn.Sequential:
    """An MLP."""
    return nn.Sequential(nn.Linear(inputs, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, outputs))


class Policy(GaussianMixin, Model):
    """Gaussian policy with a constant standard deviation."""

    def __init__(self, observation_space, action_space, device):
        Model.__init__(self, observation_space=observation_space, action_space=action_space, device=device)
        GaussianMixin.__init__(self, clip_actions=False, clip_log_std=True, min_log_std=-4.0, max_log_std=0.0)
        self.net = network(self.num_observations, self.num_actions)
        self.log_std = nn.Parameter(torch.full((self.num_actions,), -1.0))

    def compute(self, inputs, role=""):
        """Mean action and logarithm of the standard deviation."""
        return self.net(inputs["observations"]), {"log_std": self.log_std}


class Value(DeterministicMixin, Model):
    """Value function."""

    def __init__(self, observation_space, action_space, device):
        Model.__init__(self, observation_space=observation_space, action_space=action_space, device=device)
        DeterministicMixin.__init__(self)
        self.net = network(self.num_observations, 1)

    def compute(self, inputs, role=""):
        """Value of the observation."""
        return self.net(inputs["observations"]), {}


def train(steps: int = 2_000_000, num_envs: int = 128, rollouts: int = 64, seed: int = 1) -> list[float]:
    """Train; return the mean return of the finished episodes of each tenth of the training."""
    torch.set_num_threads(1)
    torch.manual_seed(seed)
    starts = dict(reach=0.5, speed=0.3, omega=0.3, tilt=15.0)
    vector = gymnasium.make_vec("jaxdrones/Hover-v0", num_envs=num_envs, action="thrust_and_rates", **starts)
    counted = Returns(vector)
    env = wrap_env(counted)
    spaces = env.observation_space, env.action_space, env.device
    config = PPO_CFG(
        rollouts=rollouts,
        learning_epochs=4,
        mini_batches=8,
        learning_rate=1e-3,
        gae_lambda=0.97,
        value_loss_scale=0.5,
        time_limit_bootstrap=True,
        rewards_shaper=lambda rewards, *_: 0.1 * rewards,
        observation_preprocessor=RunningStandardScaler,
        observation_preprocessor_kwargs={"size": env.observation_space, "device": env.device},
        value_preprocessor=RunningStandardScaler,
        value_preprocessor_kwargs={"size": 1, "device": env.device},
    )
    config.experiment.write_interval = config.experiment.checkpoint_interval = 0
    agent = PPO(
        models={"policy": Policy(*spaces), "value": Value(*spaces)},
        memory=RandomMemory(memory_size=rollouts, num_envs=num_envs, device=env.device),
        cfg=config,
        observation_space=env.observation_space,
        action_space=env.action_space,
        device=env.device,
    )
    trainer = {"timesteps": steps // num_envs, "headless": True, "disable_progressbar": True}
    SequentialTrainer(env=env, agents=agent, cfg=trainer).train()
    returns = torch.tensor(counted.returns)
    return [part.mean().item() for part in returns.chunk(10)]


class Returns(gymnasium.vector.VectorWrapper):
    """Record the return of every episode."""

    def __init__(self, env: gymnasium.vector.VectorEnv):
        super().__init__(env)
        self.returns: list[float] = []

    def step(self, actions):
        """One control step."""
        obs, reward, terminated, truncated, info = self.env.step(actions)
        if "final_info" in info:
            self.returns += info["final_info"]["episode"]["r"][terminated | truncated].tolist()
        return obs, reward, terminated, truncated, info


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--steps", type=int, default=2_000_000)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    print("mean return in each tenth:", [round(x, 1) for x in train(arguments.steps, seed=arguments.seed)])
