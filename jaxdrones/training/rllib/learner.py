"""RLlib's PPO with an adaptive learning rate and the exploration annealed."""

from __future__ import annotations

from typing import Any

from jaxdrones.training.rllib.config import Config
from jaxdrones.training.rllib.module import CentralizedCriticModule

# isort: split
from ray.rllib.algorithms.ppo.ppo import LEARNER_RESULTS_KL_KEY
from ray.rllib.algorithms.ppo.torch.ppo_torch_learner import PPOTorchLearner
from ray.rllib.utils.metrics import NUM_ENV_STEPS_SAMPLED_LIFETIME
from ray.rllib.utils.numpy import convert_to_numpy


class AdaptiveLearner(PPOTorchLearner):
    """The learner of RLlib's PPO, whose learning rates and standard deviations of actions follow a `Config`.

    Where RLlib would adapt the weight of the divergence in the loss, this adapts the learning rate of each module.
    `learner_config_dict` holds `settings`, the `Config`.
    """

    def after_gradient_based_update(self, *, timesteps: dict[str, Any]) -> None:
        """Adapt the learning rates, and move the standard deviations into the bounds of this update."""
        settings: Config = self.config.learner_config_dict["settings"]
        rates = {name: self.learning_rate(name) for name in self.module.keys()}
        super().after_gradient_based_update(timesteps=timesteps)  # resets the learning rates
        update = timesteps[NUM_ENV_STEPS_SAMPLED_LIFETIME] / (settings.worlds * settings.horizon)
        for name, rate in rates.items():
            module = self.module[name].unwrapped()
            assert isinstance(module, CentralizedCriticModule)
            module.limit_std(*settings.std_bounds(update))
            kl = float(convert_to_numpy(self.metrics.peek((name, LEARNER_RESULTS_KL_KEY))))
            for group in self.get_optimizer(name).param_groups:
                group["lr"] = settings.adapted_learning_rate(update, rate, kl)

    def learning_rate(self, name: str) -> float:
        """The learning rate of a module."""
        return self.get_optimizer(name).param_groups[0]["lr"]
