"""The policy and the centralized critic of one drone as an RLModule, and the policies of a team in JAX."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Any

import gymnasium
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxdrones.adapters import rllib as _  # noqa: F401, says what to install, so it comes before the libraries
from jaxdrones.envs import Env
from jaxdrones.learning.networks import MLP, Policy
from jaxdrones.learning.normalize import RunningStatistics

# isort: split
import torch
from ray.rllib.core.columns import Columns
from ray.rllib.core.rl_module.apis.value_function_api import ValueFunctionAPI
from ray.rllib.core.rl_module.torch import TorchRLModule

_OUTPUT_SCALE = 0.01  # with which drones hover, nearly, before they have learned


class CentralizedCriticModule(TorchRLModule, ValueFunctionAPI):
    """A policy that reads a drone's own observation, and a critic that reads all observations and the others' actions.

    The observation of the module is what the critic reads, normalized, with the drone's own observation first; see
    `jaxdrones.learning.critic.centralized_input`. `model_config` holds `own_size`, the number of entries of the drone's
    own observation, `hidden_sizes`, `gamma` and `init_std`.
    """

    def setup(self) -> None:
        """Make the networks."""
        config = self.model_config
        hidden, actions = tuple(config["hidden_sizes"]), self.action_space.shape[0]
        self.own_size: int = config["own_size"]
        self.policy = _mlp((self.own_size, *hidden, actions))
        self.critic = _mlp((self.observation_space.shape[0], *hidden, 1))
        self.log_std = torch.nn.Parameter(torch.full((actions,), math.log(config["init_std"])))

    def _forward(self, batch: dict[str, Any], **kwargs: Any) -> dict[str, torch.Tensor]:
        """Mean and logarithm of the standard deviation of the actions, side by side."""
        mean = torch.tanh(self.policy(batch[Columns.OBS][..., : self.own_size]))
        return {Columns.ACTION_DIST_INPUTS: torch.cat([mean, self.log_std.expand_as(mean)], dim=-1)}

    def compute_values(self, batch: dict[str, Any], embeddings: Any = None) -> torch.Tensor:
        """The discounted sum of future rewards; the network's output is that sum times one minus `gamma`."""
        return self.critic(batch[Columns.OBS]).squeeze(-1) / (1 - self.model_config["gamma"])

    @torch.no_grad()
    def limit_std(self, low: float, high: float) -> None:
        """Move the standard deviation of actions into these bounds."""
        self.log_std.clamp_(math.log(low), math.log(high))


def centralized_space(env: Env) -> gymnasium.spaces.Box:
    """The observation space of a drone's module: all observations, its own first, then the others' actions."""
    others = np.ones((env.drones - 1) * env.action_size)
    bound = np.concatenate([np.tile(env.observation_bound, env.drones), others]).astype(np.float32)
    return gymnasium.spaces.Box(-bound, bound, dtype=np.float32)


def policy_of(modules: Sequence[CentralizedCriticModule], obs_stats: RunningStatistics) -> Policy:
    """The policies of the drones' modules as one policy of JAX, without exploration.

    Args:
        modules: module of each drone.
        obs_stats: statistics that normalize what the modules observe.
    """
    linear = [[layer for layer in module.policy if isinstance(layer, torch.nn.Linear)] for module in modules]
    params = {
        f"Dense_{i}": {
            "kernel": jnp.stack([to_jax(layer.weight).T for layer in layers]),
            "bias": jnp.stack([to_jax(layer.bias) for layer in layers]),
        }
        for i, layers in enumerate(zip(*linear, strict=True))
    }
    network = MLP(tuple(layer.out_features for layer in linear[0][:-1]), linear[0][-1].out_features)
    return Policy({"params": params}, obs_stats, network, per_agent=True)


def to_jax(x: torch.Tensor) -> Array:
    """A copy of a tensor as an array."""
    return jnp.array(x.detach().cpu().numpy())


def _mlp(sizes: tuple[int, ...]) -> torch.nn.Sequential:
    """Linear layers with tanh between them, whose first outputs are small."""
    layers: list[torch.nn.Module] = []
    for inputs, outputs in itertools.pairwise(sizes):
        linear = torch.nn.Linear(inputs, outputs)
        scale = _OUTPUT_SCALE if len(layers) == 2 * len(sizes) - 4 else 1.0
        torch.nn.init.normal_(linear.weight, std=scale / math.sqrt(inputs))
        torch.nn.init.zeros_(linear.bias)
        layers += [linear, torch.nn.Tanh()]
    return torch.nn.Sequential(*layers[:-1])
