"""RLlib's PPO with an adaptive learning rate and the exploration annealed."""

from __future__ import annotations

from typing import Any

from jaxdrones.learning.result import adapted_learning_rate
from jaxdrones.training.rllib.config import Config
from jaxdrones.training.rllib.module import CentralizedCriticModule

# isort: split
import torch
from ray.rllib.algorithms.ppo.ppo import LEARNER_RESULTS_KL_KEY
from ray.rllib.algorithms.ppo.torch.ppo_torch_learner import PPOTorchLearner
from ray.rllib.utils.metrics import NUM_ENV_STEPS_SAMPLED_LIFETIME
from ray.rllib.utils.numpy import convert_to_numpy


class AdaptiveLearner(PPOTorchLearner):
    """The learner of RLlib's PPO, whose learning rates and standard deviations of actions follow a `Config`.

    Where RLlib would adapt the weight of the divergence in the loss, this adapts the learning rate of each module.
    `learner_config_dict` holds `settings`, the `Config`.
    """

    nonfinite_gradients = 0
    """Number of gradients of a module whose norm was not finite; they were replaced by zero."""

    def postprocess_gradients_for_module(self, *, module_gradients_dict: dict[Any, Any], **kwargs: Any) -> dict:
        """Count a gradient that is not finite and replace it by zero, as our own learners do; clip the others."""
        norm = torch.stack([gradient.norm() for gradient in module_gradients_dict.values()]).norm()
        if not torch.isfinite(norm):
            self.nonfinite_gradients += 1
            module_gradients_dict = {name: torch.zeros_like(x) for name, x in module_gradients_dict.items()}
        return super().postprocess_gradients_for_module(module_gradients_dict=module_gradients_dict, **kwargs)

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
                group["lr"] = float(adapted_learning_rate(settings, update, rate, kl))

    def learning_rate(self, name: str) -> float:
        """The learning rate of a module."""
        return self.get_optimizer(name).param_groups[0]["lr"]
