"""Network layers: multilayer perceptrons, convolutions of images, gated recurrent units."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdrones.checks import look_up
from jaxdrones.envs.env import Obs, RowSet
from jaxdrones.errors import UserError
from jaxdrones.learning.normalize import CLIP

ACTIVATIONS = {"tanh": nn.tanh, "relu": nn.relu, "elu": nn.elu, "silu": nn.silu}
OUTPUT_SCALE = 0.01  # of the initial outputs of policies, so that actions are near zero
_SMALL_IMAGE = 100  # pixels, below which a stride is 2 instead of 4
SMALL_SQUARE = 1e-8  # m^2, for the gradient of a length at zero
FADE = 1.5  # inverse of the share of its reach in which a row of a set fades out
_LARGEST_GRID = 20  # largest number of pixels after the last convolution


class MLP(nn.Module):
    """Multilayer perceptron with a linear output layer; `output_scale` scales the initial outputs."""

    hidden_sizes: Sequence[int]
    output_size: int
    output_scale: float = 1.0
    activation: str = "tanh"

    @nn.compact
    def __call__(self, x: Float[Array, "*batch d"]) -> Array:
        """Outputs (*batch, output_size)."""
        batch, x = x.shape[:-1], x.reshape(-1, x.shape[-1])  # matrices are faster than arrays of more axes
        for size in self.hidden_sizes:
            x = ACTIVATIONS[self.activation](nn.Dense(size, kernel_init=_kernel_init(1.0))(x))
        return nn.Dense(self.output_size, kernel_init=_kernel_init(self.output_scale))(x).reshape(*batch, -1)


class CNN(nn.Module):
    """Features of an image: convolutions, and a dense layer over all their outputs.

    Kernels are as wide as their strides, which makes a convolution a matrix product, faster on a CPU than overlapping
    kernels.
    """

    channels: Sequence[int]
    strides: Sequence[int]
    features: int

    @nn.compact
    def __call__(self, image: Float[Array, "*batch h w c"]) -> Float[Array, "*batch features"]:
        """Features of an image of any height and width, in which 0 means empty space."""
        for channels, stride in zip(self.channels, self.strides, strict=True):
            image = nn.relu(nn.Dense(channels)(_patches(image, stride)))
        return nn.relu(nn.Dense(self.features)(image.reshape(*image.shape[:-3], -1)))


def convolutions(height: int, width: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Channels and strides of a CNN for images of this resolution.

    The strides leave at most 20 pixels, for which a dense layer is cheap: 3 x 4 of images of 12 x 16 and of 48 x 64.
    """
    strides: list[int] = []
    while height * width > _LARGEST_GRID:
        strides.append(2 if height * width < _SMALL_IMAGE else 4)
        height, width = -(-height // strides[-1]), -(-width // strides[-1])
    return tuple(16 if i == 0 else 32 for i in range(len(strides))), tuple(strides)


def _patches(image: Float[Array, "*batch h w c"], stride: int) -> Array:
    """(*batch, ceil(h / stride), ceil(w / stride), stride^2 c): square patches of the image, padded with zeros."""
    *batch, h, w, c = image.shape
    margins = [(margin // 2, margin - margin // 2) for margin in (-h % stride, -w % stride)]
    if any(map(any, margins)):
        image = jnp.pad(image, [(0, 0)] * len(batch) + margins + [(0, 0)])
    rows, columns = -(-h // stride), -(-w // stride)
    squares = image.reshape(*batch, rows, stride, columns, stride, c)
    return jnp.moveaxis(squares, -4, -3).reshape(*batch, rows, columns, -1)


class GRU(nn.Module):
    """Gated recurrent unit (Cho et al. 2014)."""

    size: int

    @nn.compact
    def __call__(
        self, x: Float[Array, "*batch d"], hidden_state: Array | None = None, starts: Array | None = None
    ) -> Float[Array, "*batch size"]:
        """Hidden state (..., size) after each input, at first zero by default.

        With `starts` (t, ...), whether an episode starts at an input, the inputs are sequences along the leading axis.
        """
        # Initially 73 to 95 % of the hidden state are kept in every step, so early inputs have a gradient.
        zero = jnp.zeros(self.size)
        bias = jnp.concatenate([zero, jnp.linspace(1.0, 3.0, self.size), zero])
        gates = nn.Dense(3 * self.size, kernel_init=_kernel_init(1.0), bias_init=lambda k, s, dtype: bias.astype(dtype))
        inputs, kernel = gates(x), self.param("recurrent_kernel", _orthogonal_gates, self.size, gates.param_dtype)

        def step(state: Array, inputs: Array) -> Array:
            reset_in, keep_in, new_in = jnp.split(inputs, 3, axis=-1)
            reset_state, keep_state, new_state = jnp.split(state @ kernel, 3, axis=-1)
            keep = nn.sigmoid(keep_in + keep_state)
            new = nn.tanh(new_in + nn.sigmoid(reset_in + reset_state) * new_state)
            return (keep * state + (1 - keep) * new).astype(state.dtype)

        if hidden_state is None:
            hidden_state = jnp.zeros((*x.shape[starts is not None : -1], self.size), x.dtype)
        if starts is None:
            return step(hidden_state, inputs)

        def restarted_step(state: Array, step_inputs: tuple[Array, Array]) -> tuple[Array, Array]:
            inputs, start = step_inputs
            state = step(jnp.where(expand(start, state.ndim), 0, state), inputs)
            return state, state

        return jax.lax.scan(restarted_step, hidden_state, (inputs, starts))[1]


class SetEncoder(nn.Module):
    """Sum over the rows of a set of a network of the row and the drone's own observation (Zaheer et al. 2017).

    A row fades out at `reach` (m), the length of its first three entries. The result does not depend on the order of
    the rows, nor on their number.
    """

    sizes: Sequence[int]
    reach: float

    @nn.compact
    def __call__(self, own: Float[Array, "*batch d"], rows: Float[Array, "*batch k f"]) -> Float[Array, "*batch size"]:
        """Features of the set."""
        x = nn.Dense(self.sizes[0])(rows) + jnp.expand_dims(nn.Dense(self.sizes[0], use_bias=False)(own), -2)
        for size in self.sizes[1:]:
            x = nn.Dense(size)(nn.tanh(x))
        away = jnp.sqrt(jnp.sum(rows[..., :3] ** 2, axis=-1, keepdims=True) + SMALL_SQUARE)
        weight = jnp.clip(FADE * (1 - away / self.reach), 0, 1)
        return jnp.sum(weight * nn.tanh(x), axis=-2)


def split_sets(sets: Sequence[RowSet], x: Float[Array, "*batch d"]) -> tuple[Array, list[Array]]:
    """Entries (*batch, e) of an observation outside of its sets, and rows (*batch, k, f) of each set."""
    ends = [(at, at + rows * size) for at, rows, size, _ in sets]
    borders = [0, *(border for end in ends for border in end), x.shape[-1]]
    own = jnp.concatenate([x[..., a:b] for a, b in zip(borders[::2], borders[1::2], strict=True)], axis=-1)
    each = zip(ends, sets, strict=True)
    return own, [x[..., a:b].reshape(*x.shape[:-1], rows, size) for (a, b), (_, rows, size, _) in each]


class Network(nn.Module):
    """MLP of the observed vector, the features of its sets and of images, and the hidden state of a GRU."""

    hidden_sizes: Sequence[int]
    output_size: int
    output_scale: float = 1.0
    activation: str = "tanh"
    channels: Sequence[int] = ()
    strides: Sequence[int] = ()
    features: int = 64
    depth_scale: float = 3.0
    """Depth that maps to a nearness of 1/2, m; 0.3, 5 and 10 m map to 0.91, 0.38 and 0.23."""
    recurrent_size: int = 0
    sets: Sequence[RowSet] = ()
    set_sizes: Sequence[int] = ()

    @nn.compact
    def __call__(
        self, obs: Obs, hidden_state: Array | None = None, starts: Array | None = None
    ) -> tuple[Array | None, Array]:
        """Hidden state after the observations, and outputs (*batch, output_size); see `GRU`."""
        x = obs["state"] if isinstance(obs, dict) else obs
        if self.sets:
            x, rows = split_sets(self.sets, x)
            encoded = [SetEncoder(self.set_sizes, s[-1])(x, r) for s, r in zip(self.sets, rows, strict=True)]
            x = jnp.concatenate([x, *encoded], axis=-1)
        if isinstance(obs, dict):
            images = image_channels({name: x for name, x in obs.items() if name != "state"}, self.depth_scale)
            features = CNN(self.channels, self.strides, self.features)(images)
            x = jnp.concatenate([x, features], axis=-1)
        if self.recurrent_size:
            hidden_state = GRU(self.recurrent_size)(x, hidden_state, starts)
            x = jnp.concatenate([x, hidden_state], axis=-1)
        return hidden_state, MLP(self.hidden_sizes, self.output_size, self.output_scale, self.activation)(x)


def make_network(
    obs: Obs,
    hidden_sizes: Sequence[int],
    output_size: int,
    output_scale: float,
    recurrent_size: int = 0,
    sets: Sequence[RowSet] = (),
    set_sizes: Sequence[int] = (),
) -> MLP | Network:
    """Network for the given observations, with a CNN for the resolution of the images.

    `recurrent_size` is 0 without a GRU; `set_sizes` are those of the layers that encode a row of the sets in the
    observation.

    Raises:
        ValueError: a set with a finite reach beyond the range of positions that a network sees.
    """
    for *_, reach in sets:
        if CLIP < reach < math.inf:
            raise UserError(
                f"a set of the observation has a reach of {reach:g} m, and networks see positions up to {CLIP:g} m "
                f"along each axis, so farther rows would count; give a reach of at most {CLIP:g} m"
            )
    channels: tuple[int, ...] = ()
    strides: tuple[int, ...] = ()
    if isinstance(obs, dict):
        names = sorted(obs.keys() - {"state"})
        batch = obs["state"].ndim - 1
        channels, strides = convolutions(*obs[names[0]].shape[batch : batch + 2])
    elif not (recurrent_size or sets):
        return MLP(tuple(hidden_sizes), output_size, output_scale)
    return Network(
        tuple(hidden_sizes),
        output_size,
        output_scale,
        channels=channels,
        strides=strides,
        recurrent_size=recurrent_size,
        sets=tuple(sets),
        set_sizes=tuple(set_sizes),
    )


def image_channels(images: Mapping[str, Array], depth_scale: float) -> Float[Array, "*batch h w c"]:
    """Images as concatenated channels in [0, 1]; `depth_scale` is the depth with a nearness of 1/2, m."""
    channels = {name: look_up("image for a policy", name, IMAGE_CHANNELS) for name in sorted(images)}
    return jnp.concatenate([channel(images[name], depth_scale) for name, channel in channels.items()], axis=-1)


def _normalize_rgb(rgb: Array, depth_scale: float) -> Float[Array, "*batch h w 3"]:
    """Red, green and blue in [0, 1] of an image (*batch, h, w, 4) of bytes, without opacity."""
    return rgb[..., :3].astype(jnp.float32) / 255


def _nearness(depth: Array, depth_scale: float) -> Float[Array, "*batch h w 1"]:
    """Nearness of depths (*batch, h, w), m: 1 at the camera, 1/2 at `depth_scale`, 0 at infinity; bounded gradient."""
    return (depth_scale / (depth_scale + jnp.maximum(depth, 0)))[..., None]


IMAGE_CHANNELS: dict[str, Callable[[Array, float], Array]] = {"rgb": _normalize_rgb, "depth": _nearness}
"""Conversion of each kind of image to channels in [0, 1]."""


def expand(x: Array, ndim: int) -> Array:
    """Array with trailing axes of length one."""
    return x.reshape(x.shape + (1,) * (ndim - x.ndim))


def set_zero(where: Array, tree: Any) -> Any:
    """Tree with zeros where the condition over its leading axes holds."""
    return jax.tree.map(lambda x: jnp.where(expand(where, x.ndim), 0, x), tree)


def _kernel_init(scale: float):
    return nn.initializers.variance_scaling(scale**2, "fan_in", "normal")


def _orthogonal_gates(key: jax.Array, size: int, dtype: Any) -> Float[Array, "size 3*size"]:
    """Concatenated orthogonal matrices of the three gates."""
    orthogonal = nn.initializers.orthogonal()
    return jnp.concatenate([orthogonal(key, (size, size), dtype) for key in jax.random.split(key, 3)], axis=1)
