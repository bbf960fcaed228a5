"""Policies and value functions: multilayer perceptrons of normalised observations."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import flax.linen as nn
import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdrones.envs import Env
from jaxdrones.learning.normalize import Statistics

ACTIVATIONS = {"tanh": nn.tanh, "relu": nn.relu, "elu": nn.elu, "silu": nn.silu}


class MLP(nn.Module):
    """Layers of the given sizes, and a linear one that starts near zero where `scale` is small."""

    sizes: Sequence[int]
    outputs: int
    scale: float = 1.0
    activation: str = "tanh"

    @nn.compact
    def __call__(self, x: Float[Array, "*batch d"]) -> Array:
        """(*batch, outputs)."""
        for size in self.sizes:
            x = ACTIVATIONS[self.activation](nn.Dense(size, kernel_init=_init(1.0))(x))
        return nn.Dense(self.outputs, kernel_init=_init(self.scale))(x)


def _init(scale: float):
    """Normally distributed, so that outputs have the inputs' variance times `scale`^2; compiles fast."""
    return nn.initializers.variance_scaling(scale**2, "fan_in", "normal")


class Policy(flax.struct.PyTreeNode):
    """What flies: observations of a team to its actions. A pytree, so it can be saved, mapped and differentiated."""

    params: Any
    """Of the network; with `per_role` one set per drone, along a leading axis."""
    statistics: Statistics
    network: MLP = flax.struct.field(pytree_node=False)
    per_role: bool = flax.struct.field(pytree_node=False, default=False)

    @classmethod
    def init(cls, key: jax.Array, env: Env, sizes: Sequence[int], per_role: bool = False) -> Policy:
        """A policy whose actions are nearly zero, which with most action types is to hover.

        Args:
            key: random key.
            env: what it is to fly.
            sizes: of the hidden layers.
            per_role: a network for every drone, else one for all.
        """
        network = MLP(tuple(sizes), env.action_size, scale=0.01)
        params = init_params(key, network, env.observation_size, env.drones if per_role else None)
        return cls(params, Statistics.none(env.observation_size), network, per_role)

    def __call__(self, obs: Float[Array, "*batch n d"]) -> Float[Array, "*batch n a"]:
        """The action, in (-1, 1)."""
        x = self.statistics.normalize(obs)
        return jnp.tanh(apply(self.network, self.params, x, self.per_role))


def init_params(key: jax.Array, network: MLP, inputs: int, roles: int | None = None) -> Any:
    """Parameters of a network, or one set per role along a leading axis."""
    example = jnp.zeros(inputs)
    if roles is None:
        return network.init(key, example)
    return jax.vmap(network.init, in_axes=(0, None))(jax.random.split(key, roles), example)


def apply(network: MLP, params: Any, x: Float[Array, "*batch n d"], per_role: bool) -> Array:
    """The network of every drone, or the one for all."""
    if not per_role:
        return network.apply(params, x)
    return jax.vmap(network.apply, in_axes=(0, -2), out_axes=-2)(params, x)


def central(obs: Float[Array, "*batch n d"], action: Float[Array, "*batch n a"]) -> Float[Array, "*batch n e"]:
    """What a central critic sees of every drone: all observations, its own first, then the actions of the others.

    Two drones of the paper's leader-follower: 12 + 12 + 1 = 25 numbers.
    """
    n = obs.shape[-2]
    own_first = [jnp.roll(obs, -i, axis=-2).reshape(*obs.shape[:-2], -1) for i in range(n)]
    others = [jnp.roll(action, -i, axis=-2)[..., 1:, :].reshape(*action.shape[:-2], -1) for i in range(n)]
    return jnp.concatenate([jnp.stack(own_first, axis=-2), jnp.stack(others, axis=-2)], axis=-1)
