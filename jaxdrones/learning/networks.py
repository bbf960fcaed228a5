"""Policies and value functions: multilayer perceptrons of normalised observations, which see images through a CNN."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
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
from jaxdrones.learning.normalize import Statistics, on_vector, vector

ACTIVATIONS = {"tanh": nn.tanh, "relu": nn.relu, "elu": nn.elu, "silu": nn.silu}
_FAR = 5.0  # m; beyond, all depths look the same


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


class CNN(nn.Module):
    """What is in a picture: convolutions, and a layer over all that they find.

    Kernels are as wide as their strides, so that a convolution is a product of matrices. For the gradient of 3x3
    kernels of stride 2, XLA takes 80 times as long on a CPU.
    """

    channels: Sequence[int]
    strides: Sequence[int]
    features: int

    @nn.compact
    def __call__(self, picture: Float[Array, "*batch h w c"]) -> Float[Array, "*batch features"]:
        """Of numbers in [0, 1]; h and w are multiples of the product of the strides."""
        for channels, stride in zip(self.channels, self.strides, strict=True):
            picture = nn.relu(nn.Dense(channels)(_patches(picture, stride)))
        return nn.relu(nn.Dense(self.features)(picture.reshape(*picture.shape[:-3], -1)))


def _patches(picture: Float[Array, "*batch h w c"], stride: int) -> Array:
    """(*batch, h / stride, w / stride, stride^2 c): side by side, what was in a square."""
    *batch, h, w, c = picture.shape
    squares = picture.reshape(*batch, h // stride, stride, w // stride, stride, c)
    return jnp.moveaxis(squares, -4, -3).reshape(*batch, h // stride, w // stride, -1)


class VisionMLP(nn.Module):
    """An MLP of the vector of an observation and, beside it, of what a CNN finds in its images."""

    sizes: Sequence[int]
    outputs: int
    scale: float = 1.0
    activation: str = "tanh"
    channels: Sequence[int] = (16, 32, 32)
    strides: Sequence[int] = (4, 2, 2)
    features: int = 32

    @nn.compact
    def __call__(self, obs: dict[str, Array]) -> Array:
        """(*batch, outputs)."""
        pictures = [SCALES[name](obs[name]) for name in sorted(obs.keys() - {"state"})]
        found = CNN(self.channels, self.strides, self.features)(jnp.concatenate(pictures, axis=-1))
        mlp = MLP(self.sizes, self.outputs, self.scale, self.activation)
        return mlp(jnp.concatenate([obs["state"], found], axis=-1))


def network_for(obs: Obs, sizes: Sequence[int], outputs: int, scale: float) -> MLP | VisionMLP:
    """The kind of network that such observations need.

    Raises:
        ValueError: they have images that no network takes.
    """
    if not isinstance(obs, dict):
        return MLP(tuple(sizes), outputs, scale)
    for name in obs.keys() - {"state"}:
        check_choice("image for a policy", name, SCALES)
    return VisionMLP(tuple(sizes), outputs, scale)


def _colours(rgb: Array) -> Float[Array, "*batch h w 3"]:
    """Red, green, blue of (*batch, h, w, 4) bytes, in [0, 1]."""
    return rgb[..., :3].astype(jnp.float32) / 255


def _nearness(depth: Array) -> Float[Array, "*batch h w 1"]:
    """Of (*batch, h, w) m: 1 at the eye, 0 far away."""
    return 1 - jnp.clip(depth, 0, _FAR)[..., None] / _FAR


SCALES: dict[str, Callable[[Array], Array]] = {"rgb": _colours, "depth": _nearness}
"""Images that policies take, to channels in [0, 1]."""


def _init(scale: float):
    """Normally distributed, so that outputs have the inputs' variance times `scale`^2; compiles fast."""
    return nn.initializers.variance_scaling(scale**2, "fan_in", "normal")


class Policy(flax.struct.PyTreeNode):
    """What flies: observations of a team to its actions. A pytree, so it can be saved, mapped and differentiated."""

    params: Any
    """Of the network; with `per_agent` one set per drone, along a leading axis."""
    statistics: Statistics
    network: MLP | VisionMLP = flax.struct.field(pytree_node=False)
    per_agent: bool = flax.struct.field(pytree_node=False, default=False)

    @classmethod
    def init(cls, key: jax.Array, env: Env, sizes: Sequence[int], per_agent: bool = False) -> Policy:
        """A policy whose actions are nearly zero, which with most action types is to hover.

        Args:
            key: random key.
            env: what it is to fly.
            sizes: of the hidden layers.
            per_agent: a network for every drone, else one for all.
        """
        obs = seen_by_one(env)
        network = network_for(obs, sizes, env.action_size, scale=0.01)
        params = init_params(key, network, obs, env.drones if per_agent else None)
        return cls(params, Statistics.none(env.observation_size), network, per_agent)

    def __repr__(self) -> str:
        layers = (*np.shape(self.statistics.mean)[-1:], *self.network.sizes, self.network.outputs)
        numbers = sum(math.prod(np.shape(x)) for x in jax.tree.leaves(self.params))
        seen = self.statistics.count
        known = isinstance(seen, jax.Array | np.ndarray) and is_known(seen) and seen.ndim == 0
        counted = f", statistics of {float(seen):,.0f} observations" if known else ""
        images = f" and images by {self.network.channels}" if isinstance(self.network, VisionMLP) else ""
        whose = ", one network per drone" if self.per_agent else ""
        return (
            f"<Policy {' -> '.join(map(str, layers))}{images}, {self.network.activation}, "
            f"{numbers:,} parameters{whose}{counted}>"
        )

    def __call__(self, obs: Obs) -> Float[Array, "*batch n a"]:
        """The action, in (-1, 1), of observations (*batch, n, d), or of a dictionary of such arrays with images."""
        x = on_vector(self.statistics.normalize, obs)
        return jnp.tanh(apply(self.network, self.params, x, self.per_agent))


def seen_by_one(env: Env) -> Obs:
    """An observation of one drone, all zero."""
    obs, _ = jax.eval_shape(env.reset, jax.random.key(0))
    return jax.tree.map(lambda x: jnp.zeros(x.shape[1:], x.dtype), obs)


def init_params(key: jax.Array, network: MLP | VisionMLP, example: Obs, roles: int | None = None) -> Any:
    """Parameters of a network for inputs like the example, or one set per role along a leading axis."""
    if roles is None:
        return network.init(key, example)
    return jax.vmap(network.init, in_axes=(0, None))(jax.random.split(key, roles), example)


def apply(network: MLP | VisionMLP, params: Any, x: Obs, per_agent: bool) -> Array:
    """The network of every drone, or the one for all."""
    if not per_agent:
        return cast(Array, network.apply(params, x))
    drones = vector(x).ndim - 2
    return cast(Array, jax.vmap(network.apply, in_axes=(0, drones), out_axes=drones)(params, x))


def central(obs: Float[Array, "*batch n d"], action: Float[Array, "*batch n a"]) -> Float[Array, "*batch n e"]:
    """What a central critic sees of every drone: all observations, its own first, then the actions of the others.

    Two drones of the paper's leader-follower: 12 + 12 + 1 = 25 numbers.
    """
    n = obs.shape[-2]
    own_first = [jnp.roll(obs, -i, axis=-2).reshape(*obs.shape[:-2], -1) for i in range(n)]
    others = [jnp.roll(action, -i, axis=-2)[..., 1:, :].reshape(*action.shape[:-2], -1) for i in range(n)]
    return jnp.concatenate([jnp.stack(own_first, axis=-2), jnp.stack(others, axis=-2)], axis=-1)
