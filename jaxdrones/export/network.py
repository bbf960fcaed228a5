"""Layers of a policy, the common input of all targets except StableHLO."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np

from jaxdrones.envs.env import RowSet
from jaxdrones.errors import UserError
from jaxdrones.export import layers
from jaxdrones.export.layers import Graph, Layer, Tensor
from jaxdrones.learning.layers import MLP, Network
from jaxdrones.learning.networks import OwnNetwork, Policy


class _Layers:
    """Layers in the order of computation, with numbered names."""

    def __init__(self) -> None:
        self.layers: list[Layer] = []

    def add(self, kind: Any, inputs: tuple[Tensor, ...], shape: tuple[int, ...], **settings: Any) -> Tensor:
        word = kind.__name__.lower()
        number = sum(type(layer) is kind for layer in self.layers)
        output = Tensor(f"{word}_{number}", shape)
        self.layers.append(kind(inputs, output, **settings))
        return output

    def dense(self, x: Tensor, weights: Mapping[str, Any]) -> Tensor:
        constants = {name: _float32(weights[name]) for name in ("kernel", "bias") if name in weights}
        return self.add(layers.Dense, (x,), (*x.shape[:-1], constants["kernel"].shape[1]), constants=constants)

    def activation(self, x: Tensor, function: str) -> Tensor:
        return self.add(layers.Activation, (x,), x.shape, function=function)

    def sets(self, x: Tensor, sets: Sequence[RowSet], params: Mapping[str, Any]) -> Tensor:
        """Entries outside of the sets, and the features of each set."""
        ends = [(at, at + rows * size) for at, rows, size, _ in sets]
        borders = [0, *(border for end in ends for border in end), x.size]
        pieces = zip(borders[::2], borders[1::2], strict=True)
        own = self.concatenate(tuple(self.add(layers.Slice, (x,), (b - a,), start=a) for a, b in pieces if b > a))
        encoded = []
        for i, (at, count, size, reach) in enumerate(sets):
            weights = params[f"SetEncoder_{i}"]
            rows = self.add(layers.Slice, (x,), (count, size), start=at)
            both = self.dense(rows, weights["Dense_0"]), self.dense(own, weights["Dense_1"])
            features = self.add(layers.AddToRows, both, both[0].shape)
            for j in range(2, len(weights)):
                features = self.dense(self.activation(features, "tanh"), weights[f"Dense_{j}"])
            features = self.activation(features, "tanh")
            encoded.append(self.add(layers.SumOfRows, (features, rows), features.shape[1:], reach=reach))
        return self.concatenate((own, *encoded))

    def concatenate(self, tensors: tuple[Tensor, ...]) -> Tensor:
        if len(tensors) == 1:
            return tensors[0]
        size = sum(x.shape[-1] for x in tensors)
        return self.add(layers.Concatenate, tensors, (*tensors[0].shape[:-1], size))

    def mlp(self, x: Tensor, network: MLP | Network, params: Mapping[str, Any]) -> Tensor:
        for i in range(len(network.hidden_sizes)):
            x = self.activation(self.dense(x, params[f"Dense_{i}"]), network.activation)
        return self.dense(x, params[f"Dense_{len(network.hidden_sizes)}"])

    def image_features(self, images: tuple[Tensor, ...], network: Network, params: Mapping[str, Any]) -> Tensor:
        channels = []
        for image in images:
            if image.name == "depth":
                shape = (*image.shape, 1)
                channels.append(self.add(layers.Nearness, (image,), shape, depth_scale=network.depth_scale))
            else:
                channels.append(self.add(layers.Color, (image,), (*image.shape[:2], 3)))
        x = self.concatenate(tuple(channels))
        for i, (size, stride) in enumerate(zip(network.channels, network.strides, strict=True)):
            rows, columns = (math.ceil(length / stride) for length in x.shape[:2])
            constants = {name: _float32(params[f"Dense_{i}"][name]) for name in ("kernel", "bias")}
            x = self.add(layers.Convolution, (x,), (rows, columns, size), constants=constants, stride=stride)
            x = self.activation(x, "relu")
        x = self.add(layers.Flatten, (x,), (x.size,))
        return self.activation(self.dense(x, params[f"Dense_{len(network.channels)}"]), "relu")

    def gru(self, x: Tensor, hidden_state: Tensor, params: Mapping[str, Any]) -> Tensor:
        gates = self.dense(x, params["Dense_0"]), self.dense(hidden_state, {"kernel": params["recurrent_kernel"]})
        return self.add(layers.Gates, (*gates, hidden_state), hidden_state.shape)


def layers_of(policy: Policy, images: tuple[Tensor, ...]) -> Graph:
    """Layers of a policy with a network of this library that all drones share.

    It observes the images, in the order of their names: `depth` (height, width) and `rgb` (height, width, 4).
    """
    assert not policy.per_agent, "give the policy of one drone"
    network = policy.network
    if isinstance(network, OwnNetwork):
        name = type(network.module).__name__
        raise UserError(f"the policy has a network of your own, {name}, whose layers are unknown; give --to stablehlo")
    built, params = _Layers(), policy.params["params"]
    obs = Tensor("obs", np.shape(policy.obs_stats.mean))
    inputs: tuple[Tensor, ...] = (obs, *images)
    constants = {"mean": _float32(policy.obs_stats.mean), "scale": _float32(policy.obs_stats.scale)}
    x, next_hidden_state = built.add(layers.Normalize, (obs,), obs.shape, constants=constants), None
    if isinstance(network, Network):
        if network.sets:
            x = built.sets(x, network.sets, params)
        if images:
            x = built.concatenate((x, built.image_features(images, network, params["CNN_0"])))
        if network.recurrent_size:
            hidden_state = Tensor("hidden_state", (network.recurrent_size,))
            inputs += (hidden_state,)
            next_hidden_state = built.gru(x, hidden_state, params["GRU_0"])
            x = built.concatenate((x, next_hidden_state))
        params = params["MLP_0"]
    action = built.activation(built.mlp(x, network, params), "tanh")
    graph = Graph(inputs, tuple(built.layers), action, next_hidden_state)
    if graph.weights - 2 * obs.size != sum(x.size for x in jax.tree.leaves(policy.params)):
        raise UserError("the policy has layers without an exporter; give --to stablehlo")
    return graph


def _float32(x: Any) -> np.ndarray:
    return np.asarray(x, np.float32)
