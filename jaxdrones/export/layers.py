"""Layers of an exported network, from which C, JavaScript and ONNX are written."""

import dataclasses
import math
from collections.abc import Mapping

import numpy as np

from jaxdrones.learning.normalize import CLIP

BYTES = 4
"""Of a weight or another number, float32."""


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
        return self.output.size * len(self.constants["kernel"]) if "kernel" in self.constants else 0


@dataclasses.dataclass(frozen=True, eq=False)
class Normalize(Layer):
    """`(x - mean) * scale`, clipped."""

    clip: float = CLIP

    @property
    def multiply_adds(self) -> int:  # noqa: D102
        return self.output.size


class Dense(Layer):
    """`x @ kernel + bias` of a vector or of rows, with a kernel (inputs, outputs); the bias may be missing."""

    @property
    def rows(self) -> int:
        """Number of rows; 1 of a vector."""
        return math.prod(self.output.shape[:-1])


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


@dataclasses.dataclass(frozen=True, eq=False)
class Slice(Layer):
    """Entries of a vector from `start` on, in the shape of the output."""

    start: int = 0


class AddToRows(Layer):
    """Sum of each row (k, size) of the first input and the second input (size,)."""


@dataclasses.dataclass(frozen=True, eq=False)
class SumOfRows(Layer):
    """Sum of rows of features (k, size), weighted by the nearness of the rows (k, n) that they are features of.

    The weight is `clip(FADE * (1 - away / reach), 0, 1)`, where `away` is the length of the first three entries; see
    `jaxdrones.learning.layers.SetEncoder`.
    """

    reach: float = math.inf

    @property
    def multiply_adds(self) -> int:  # noqa: D102
        return self.inputs[0].size


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
    def weights(self) -> int:
        """Number of all weights, with those of the normalization."""
        return sum(x.size for layer in self.layers for x in layer.constants.values())

    @property
    def arguments(self) -> list[str]:
        """Names of the inputs in C and JavaScript."""
        return ["hidden" if x.name == "hidden_state" else x.name for x in self.inputs]
