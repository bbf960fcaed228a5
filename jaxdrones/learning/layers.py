"""The layers of networks: multilayer perceptrons, convolutions of images of any resolution, gated recurrent units."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

ACTIVATIONS = {"tanh": nn.tanh, "relu": nn.relu, "elu": nn.elu, "silu": nn.silu}
_SMALL_IMAGE = 100  # places, below which a stride is 2 instead of 4
_LARGEST_GRID = 20  # places that the last convolution leaves at most


class MLP(nn.Module):
    """A multilayer perceptron with a linear output layer, whose initial outputs are near zero if `output_scale` is."""

    hidden_sizes: Sequence[int]
    output_size: int
    output_scale: float = 1.0
    activation: str = "tanh"

    @nn.compact
    def __call__(self, x: Float[Array, "*batch d"]) -> Array:
        """(*batch, output_size)."""
        for size in self.hidden_sizes:
            x = ACTIVATIONS[self.activation](nn.Dense(size, kernel_init=_kernel_init(1.0))(x))
        return nn.Dense(self.output_size, kernel_init=_kernel_init(self.output_scale))(x)


class CNN(nn.Module):
    """Features of an image: convolutions, and a dense layer over all their outputs.

    Kernels are as wide as their strides, so that a convolution is a product of matrices, which is far faster on a CPU
    than overlapping kernels are.
    """

    channels: Sequence[int]
    strides: Sequence[int]
    features: int

    @nn.compact
    def __call__(self, image: Float[Array, "*batch h w c"]) -> Float[Array, "*batch features"]:
        """Features of an image of any height and width, in which 0 means that nothing is there."""
        for channels, stride in zip(self.channels, self.strides, strict=True):
            image = nn.relu(nn.Dense(channels)(_patches(image, stride)))
        return nn.relu(nn.Dense(self.features)(image.reshape(*image.shape[:-3], -1)))


def convolutions(height: int, width: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Channels and strides of a CNN for images of this resolution.

    The strides leave at most 20 places, on which a dense layer is cheap: 3 x 4 of images of 12 x 16 and of 48 x 64.
    """
    strides: list[int] = []
    while height * width > _LARGEST_GRID:
        strides.append(2 if height * width < _SMALL_IMAGE else 4)
        height, width = -(-height // strides[-1]), -(-width // strides[-1])
    return tuple(16 if i == 0 else 32 for i in range(len(strides))), tuple(strides)


def _patches(image: Float[Array, "*batch h w c"], stride: int) -> Array:
    """(*batch, ceil(h / stride), ceil(w / stride), stride^2 c): the image cut into squares, each a vector.

    An image whose sides are no multiples of the stride gets a margin of zeros, half of it on each side.
    """
    *batch, h, w, c = image.shape
    margins = [(margin // 2, margin - margin // 2) for margin in (-h % stride, -w % stride)]
    if any(map(any, margins)):
        image = jnp.pad(image, [(0, 0)] * len(batch) + margins + [(0, 0)])
    rows, columns = -(-h // stride), -(-w // stride)
    squares = image.reshape(*batch, rows, stride, columns, stride, c)
    return jnp.moveaxis(squares, -4, -3).reshape(*batch, rows, columns, -1)


class GRU(nn.Module):
    """A gated recurrent unit (Cho et al. 2014): a memory, and gates that decide how much of it to keep."""

    size: int

    @nn.compact
    def __call__(
        self, x: Float[Array, "*batch d"], memory: Array | None = None, starts: Array | None = None
    ) -> Float[Array, "*batch size"]:
        """The memory after each input.

        Args:
            x: inputs; with `starts` sequences of them, along the leading axis.
            memory: (..., size) memory before the (first) input; zero, as at the start of an episode, when left out.
            starts: (t, ...) whether an episode starts at this input, so that the memory before it is zero.
        """
        # At first the memory keeps three quarters in every step, so that what was seen long ago has a gradient.
        bias = jnp.repeat(jnp.array([0.0, 1.0, 0.0]), self.size)
        gates = nn.Dense(3 * self.size, kernel_init=_kernel_init(1.0), bias_init=lambda k, s, dtype: bias.astype(dtype))
        inputs, kernel = gates(x), self.param("recurrent_kernel", _orthogonal_gates, self.size, gates.param_dtype)

        def step(memory: Array, inputs: Array) -> Array:
            reset_in, keep_in, new_in = jnp.split(inputs, 3, axis=-1)
            reset_mem, keep_mem, new_mem = jnp.split(memory @ kernel, 3, axis=-1)
            keep = nn.sigmoid(keep_in + keep_mem)
            new = nn.tanh(new_in + nn.sigmoid(reset_in + reset_mem) * new_mem)
            return (keep * memory + (1 - keep) * new).astype(memory.dtype)

        if memory is None:
            memory = jnp.zeros((*x.shape[starts is not None : -1], self.size), x.dtype)
        if starts is None:
            return step(memory, inputs)

        def restarted_step(memory: Array, step_inputs: tuple[Array, Array]) -> tuple[Array, Array]:
            inputs, start = step_inputs
            start = start.reshape(start.shape + (1,) * (memory.ndim - start.ndim))
            memory = step(jnp.where(start, 0, memory), inputs)
            return memory, memory

        return jax.lax.scan(restarted_step, memory, (inputs, starts))[1]


def image_channels(images: Mapping[str, Array], depth_scale: float) -> Float[Array, "*batch h w c"]:
    """The images of an observation as channels in [0, 1], side by side in the order of their names.

    Args:
        images: some of the images of `IMAGE_CHANNELS`.
        depth_scale: depth at which the nearness is 1/2, m.
    """
    return jnp.concatenate([IMAGE_CHANNELS[name](images[name], depth_scale) for name in sorted(images)], axis=-1)


def _normalize_rgb(rgb: Array, depth_scale: float) -> Float[Array, "*batch h w 3"]:
    """Red, green and blue in [0, 1] of an image (*batch, h, w, 4) of bytes; the opacity is dropped."""
    return rgb[..., :3].astype(jnp.float32) / 255


def _nearness(depth: Array, depth_scale: float) -> Float[Array, "*batch h w 1"]:
    """1 at the camera, 1/2 at `depth_scale`, 0 infinitely far away, of depths (*batch, h, w) in m.

    Far away this is proportional to the inverse depth. Unlike a clipped inverse depth it has a gradient everywhere,
    which is at most `1 / depth_scale`.
    """
    return (depth_scale / (depth_scale + jnp.maximum(depth, 0)))[..., None]


IMAGE_CHANNELS: dict[str, Callable[[Array, float], Array]] = {"rgb": _normalize_rgb, "depth": _nearness}
"""The images that policies take, each with the function that makes channels in [0, 1] of it."""


def _kernel_init(scale: float):
    """Normally distributed weights, with which the variance of the outputs is `scale`^2 times that of the inputs."""
    return nn.initializers.variance_scaling(scale**2, "fan_in", "normal")


def _orthogonal_gates(key: jax.Array, size: int, dtype: Any) -> Float[Array, "size 3*size"]:
    """An orthogonal matrix for each of the three gates, side by side."""
    orthogonal = nn.initializers.orthogonal()
    return jnp.concatenate([orthogonal(key, (size, size), dtype) for key in jax.random.split(key, 3)], axis=1)
