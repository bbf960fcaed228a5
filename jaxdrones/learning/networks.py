"""Policies and value functions: multilayer perceptrons of normalized observations, with a CNN for images."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, cast

import flax.linen as nn
import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdrones.checks import check_choice, is_known
from jaxdrones.envs import Env
from jaxdrones.envs.env import Obs
from jaxdrones.learning.layers import CNN, IMAGE_CHANNELS, MLP, convolutions, image_channels
from jaxdrones.learning.normalize import RunningStatistics, map_state_vector, state_vector


class VisionMLP(nn.Module):
    """An MLP of the vector of an observation and of the features that a CNN extracts from its images."""

    hidden_sizes: Sequence[int]
    output_size: int
    output_scale: float = 1.0
    activation: str = "tanh"
    channels: Sequence[int] = ()
    strides: Sequence[int] = ()
    features: int = 64
    depth_scale: float = 3.0
    """Depth that the network takes for a nearness of 1/2, m; of 0.3, 5 and 10 m it makes 0.91, 0.38 and 0.23."""

    @nn.compact
    def __call__(self, obs: dict[str, Array]) -> Array:
        """(*batch, output_size)."""
        images = image_channels({name: x for name, x in obs.items() if name != "state"}, self.depth_scale)
        features = CNN(self.channels, self.strides, self.features)(images)
        mlp = MLP(self.hidden_sizes, self.output_size, self.output_scale, self.activation)
        return mlp(jnp.concatenate([obs["state"], features], axis=-1))


def make_network(obs: Obs, hidden_sizes: Sequence[int], output_size: int, output_scale: float) -> MLP | VisionMLP:
    """A network of the kind that such observations need, with a CNN that suits the resolution of images.

    Raises:
        ValueError: the observations have images that no network takes.
    """
    if not isinstance(obs, dict):
        return MLP(tuple(hidden_sizes), output_size, output_scale)
    names = sorted(obs.keys() - {"state"})
    for name in names:
        check_choice("image for a policy", name, IMAGE_CHANNELS)
    batch = obs["state"].ndim - 1
    channels, strides = convolutions(*obs[names[0]].shape[batch : batch + 2])
    return VisionMLP(tuple(hidden_sizes), output_size, output_scale, channels=channels, strides=strides)


class Policy(flax.struct.PyTreeNode):
    """A function from a team's observations to its actions; a pytree, which can be saved, mapped and differentiated."""

    params: Any
    """Parameters of the network; with `per_agent` one set for each drone, along a leading axis."""
    obs_stats: RunningStatistics
    """Statistics that normalize the observations."""
    network: MLP | VisionMLP = flax.struct.field(pytree_node=False)
    per_agent: bool = flax.struct.field(pytree_node=False, default=False)

    @classmethod
    def init(cls, key: jax.Array, env: Env, hidden_sizes: Sequence[int], per_agent: bool = False) -> Policy:
        """A policy whose actions are nearly zero, with which drones hover in most action types.

        Args:
            key: random key.
            env: environment that the policy is for.
            hidden_sizes: sizes of the hidden layers.
            per_agent: whether every drone has a network of its own; otherwise all drones share one.
        """
        obs = example_observation(env)
        network = make_network(obs, hidden_sizes, env.action_size, output_scale=0.01)
        params = init_params(key, network, obs, env.drones if per_agent else None)
        return cls(params, RunningStatistics.empty(env.observation_size), network, per_agent)

    def __repr__(self) -> str:
        layers = (*np.shape(self.obs_stats.mean)[-1:], *self.network.hidden_sizes, self.network.output_size)
        numbers = sum(math.prod(np.shape(x)) for x in jax.tree.leaves(self.params))
        count = self.obs_stats.count
        known = isinstance(count, jax.Array | np.ndarray) and is_known(count) and count.ndim == 0
        counted = f", statistics of {float(count):,.0f} observations" if known else ""
        images = f" and images by {self.network.channels}" if isinstance(self.network, VisionMLP) else ""
        whose = ", one network per drone" if self.per_agent else ""
        return (
            f"<Policy {' -> '.join(map(str, layers))}{images}, {self.network.activation}, "
            f"{numbers:,} parameters{whose}{counted}>"
        )

    def __call__(self, obs: Obs) -> Float[Array, "*batch n a"]:
        """Actions in (-1, 1) for observations (*batch, n, d), or for a dictionary of such an array and of images."""
        x = map_state_vector(self.obs_stats.normalize, obs)
        return jnp.tanh(apply(self.network, self.params, x, self.per_agent))


def example_observation(env: Env) -> Obs:
    """An observation of one drone, all zero."""
    obs, _ = jax.eval_shape(env.reset, jax.random.key(0))
    return jax.tree.map(lambda x: jnp.zeros(x.shape[1:], x.dtype), obs)


def init_params(key: jax.Array, network: MLP | VisionMLP, example: Obs, agents: int | None = None) -> Any:
    """Parameters of a network for inputs like the example; with `agents` one set for each, along a leading axis."""
    if agents is None:
        return network.init(key, example)
    return jax.vmap(network.init, in_axes=(0, None))(jax.random.split(key, agents), example)


def apply(network: MLP | VisionMLP, params: Any, x: Obs, per_agent: bool) -> Array:
    """Outputs of the network that all drones share, or of the network of each drone."""
    if not per_agent:
        return cast(Array, network.apply(params, x))
    agent_axis = state_vector(x).ndim - 2
    return cast(Array, jax.vmap(network.apply, in_axes=(0, agent_axis), out_axes=agent_axis)(params, x))


def centralized_input(
    obs: Float[Array, "*batch n d"], action: Float[Array, "*batch n a"]
) -> Float[Array, "*batch n e"]:
    """Input of a centralized critic for each drone: all observations, its own first, then the others' actions.

    For two drones of the leader-follower task (2021) these are 12 + 12 + 1 = 25 numbers.
    """
    n = obs.shape[-2]
    own_first = [jnp.roll(obs, -i, axis=-2).reshape(*obs.shape[:-2], -1) for i in range(n)]
    others = [jnp.roll(action, -i, axis=-2)[..., 1:, :].reshape(*action.shape[:-2], -1) for i in range(n)]
    return jnp.concatenate([jnp.stack(own_first, axis=-2), jnp.stack(others, axis=-2)], axis=-1)
