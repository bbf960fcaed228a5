"""Network of a policy as a list of layers, from which C, JavaScript and ONNX are written."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from jaxdrones.errors import UserError
from jaxdrones.learning.layers import MLP, Network
from jaxdrones.learning.networks import OwnNetwork, Policy
from jaxdrones.learning.normalize import CLIP

_BYTES = 4  # of a weight, float32


@dataclasses.dataclass(frozen=True)
class Tensor:
    """Input, output or intermediate result of a network, of one drone."""

    name: str
    shape: tuple[int, ...]
    dtype: str = "float32"
    """`float32`; `uint8` of a color image."""

    @property
    def size(self) -> int:
        """Number of entries."""
        return math.prod(self.shape)


@dataclasses.dataclass(frozen=True, eq=False)
class Layer:
    """Function of tensors; images have the axes (height, width, channels)."""

    inputs: tuple[Tensor, ...]
    output: Tensor
    constants: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict)
    """Weights by name, float32."""

    @property
    def multiply_adds(self) -> int:
        """Number of products that are added up."""
        return 0


@dataclasses.dataclass(frozen=True, eq=False)
class Normalize(Layer):
    """`(x - mean) * scale`, clipped."""

    clip: float = CLIP

    @property
    def multiply_adds(self) -> int:  # noqa: D102
        return self.output.size


class Dense(Layer):
    """`x @ kernel + bias` with a kernel (inputs, outputs); the bias may be missing."""

    @property
    def multiply_adds(self) -> int:  # noqa: D102
        return self.constants["kernel"].size


@dataclasses.dataclass(frozen=True, eq=False)
class Convolution(Layer):
    """Convolution whose kernel (height * width * channels, outputs) is as wide as its stride.

    The image is padded with zeros to a multiple of the stride, with the smaller half of the margin above and left.
    """

    stride: int = 1

    @property
    def margin(self) -> tuple[tuple[int, int], tuple[int, int]]:
        """Rows of zeros above and below, columns of zeros left and right."""
        rows, columns = (-size % self.stride for size in self.inputs[0].shape[:2])
        return (rows // 2, rows - rows // 2), (columns // 2, columns - columns // 2)

    @property
    def multiply_adds(self) -> int:  # noqa: D102
        rows, columns, _ = self.output.shape
        return rows * columns * self.constants["kernel"].size


@dataclasses.dataclass(frozen=True, eq=False)
class Activation(Layer):
    """Elementwise `tanh`, `relu`, `elu` or `silu`."""

    function: str = "tanh"


class Gates(Layer):
    """Next hidden state of a gated recurrent unit.

    The inputs are the gates' parts from the input and from the hidden state, each (3 * size,) in the order reset,
    keep, new, and the hidden state (size,)::

        keep = sigmoid(keep_in + keep_state)
        new = tanh(new_in + sigmoid(reset_in + reset_state) * new_state)
        hidden = keep * hidden + (1 - keep) * new
    """


@dataclasses.dataclass(frozen=True, eq=False)
class Nearness(Layer):
    """Channel (height, width, 1) of a depth image, m: `depth_scale / (depth_scale + max(depth, 0))`."""

    depth_scale: float = 1.0


class Color(Layer):
    """Channels (height, width, 3) in [0, 1] of red, green, blue and opacity in bytes."""


class Concatenate(Layer):
    """Concatenation along the last axis."""


class Flatten(Layer):
    """Vector of an image, row by row, with the channels last."""


@dataclasses.dataclass(frozen=True, eq=False)
class Graph:
    """Deterministic policy of one drone: the layers from its observation to its action."""

    inputs: tuple[Tensor, ...]
    """`obs`, then the images by name, then `hidden_state` of a recurrent policy."""
    layers: tuple[Layer, ...]
    """In the order of computation."""
    action: Tensor
    """In (-1, 1)."""
    next_hidden_state: Tensor | None

    @property
    def hidden_size(self) -> int:
        """Length of the hidden state; 0 without one."""
        return self.next_hidden_state.size if self.next_hidden_state else 0

    @property
    def multiply_adds(self) -> int:
        """Multiply-adds of one step, without those of activations and gates."""
        return sum(layer.multiply_adds for layer in self.layers)

    @property
    def weight_bytes(self) -> int:
        """Bytes of all weights and of the normalization."""
        return _BYTES * sum(x.size for layer in self.layers for x in layer.constants.values())


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
        return self.add(Dense, (x,), (*x.shape[:-1], constants["kernel"].shape[1]), constants=constants)

    def activation(self, x: Tensor, function: str) -> Tensor:
        return self.add(Activation, (x,), x.shape, function=function)

    def concatenate(self, tensors: tuple[Tensor, ...]) -> Tensor:
        size = sum(x.shape[-1] for x in tensors)
        return self.add(Concatenate, tensors, (*tensors[0].shape[:-1], size))

    def mlp(self, x: Tensor, network: MLP | Network, params: Mapping[str, Any]) -> Tensor:
        for i in range(len(network.hidden_sizes)):
            x = self.activation(self.dense(x, params[f"Dense_{i}"]), network.activation)
        return self.dense(x, params[f"Dense_{len(network.hidden_sizes)}"])

    def image_features(self, images: tuple[Tensor, ...], network: Network, params: Mapping[str, Any]) -> Tensor:
        channels = []
        for image in images:
            if image.name == "depth":
                shape = (*image.shape, 1)
                channels.append(self.add(Nearness, (image,), shape, depth_scale=network.depth_scale))
            else:
                channels.append(self.add(Color, (image,), (*image.shape[:2], 3)))
        x = channels[0] if len(channels) == 1 else self.concatenate(tuple(channels))
        for i, (size, stride) in enumerate(zip(network.channels, network.strides, strict=True)):
            rows, columns = (math.ceil(length / stride) for length in x.shape[:2])
            constants = {name: _float32(params[f"Dense_{i}"][name]) for name in ("kernel", "bias")}
            x = self.add(Convolution, (x,), (rows, columns, size), constants=constants, stride=stride)
            x = self.activation(x, "relu")
        x = self.add(Flatten, (x,), (x.size,))
        return self.activation(self.dense(x, params[f"Dense_{len(network.channels)}"]), "relu")

    def gru(self, x: Tensor, hidden_state: Tensor, params: Mapping[str, Any]) -> Tensor:
        gates = self.dense(x, params["Dense_0"]), self.dense(hidden_state, {"kernel": params["recurrent_kernel"]})
        return self.add(Gates, (*gates, hidden_state), hidden_state.shape)


def layers_of(policy: Policy, images: tuple[Tensor, ...]) -> Graph:
    """Layers of a policy whose drones share one network.

    Args:
        policy: policy with a network of this library.
        images: images that it observes, in the order of their names: `depth` (height, width) and `rgb`
            (height, width, 4).

    Raises:
        ValueError: a user's network, whose layers are unknown.
    """
    assert not policy.per_agent, "give the policy of one drone"
    network = policy.network
    if isinstance(network, OwnNetwork):
        name = type(network.module).__name__
        raise UserError(f"the policy has a network of your own, {name}, whose layers are unknown; give --to stablehlo")
    layers, params = _Layers(), policy.params["params"]
    obs = Tensor("obs", np.shape(policy.obs_stats.mean))
    inputs: tuple[Tensor, ...] = (obs, *images)
    constants = {"mean": _float32(policy.obs_stats.mean), "scale": _float32(policy.obs_stats.scale)}
    x, next_hidden_state = layers.add(Normalize, (obs,), obs.shape, constants=constants), None
    if isinstance(network, Network):
        if images:
            x = layers.concatenate((x, layers.image_features(images, network, params["CNN_0"])))
        if network.recurrent_size:
            hidden_state = Tensor("hidden_state", (network.recurrent_size,))
            inputs += (hidden_state,)
            next_hidden_state = layers.gru(x, hidden_state, params["GRU_0"])
            x = layers.concatenate((x, next_hidden_state))
        params = params["MLP_0"]
    action = layers.activation(layers.mlp(x, network, params), "tanh")
    return Graph(inputs, tuple(layers.layers), action, next_hidden_state)


def _float32(x: Any) -> np.ndarray:
    return np.asarray(x, np.float32)
