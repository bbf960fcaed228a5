"""Noise of depth cameras: ranges that scatter, disparities in steps, pixels without a value."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdrones.checks import check_choice, check_number
from jaxdrones.sensing.camera import Camera


@dataclasses.dataclass(frozen=True, kw_only=True)
class DepthNoise:
    """A stereo camera: depth = focal length times baseline / disparity, and the disparity is known imperfectly.

    A disparity with a standard deviation has a depth with one that grows with the square of the depth. The order is
    that of a camera: scatter, rounding of the disparity, the limits of depth, missing pixels. Pixels that show nothing
    stay at `far`.
    """

    spread: float = 0.0
    """Standard deviation of the depth at 1 m, m; at z m it is z^2 times as large. About 0.002 for stereo cameras of
    5 cm baseline and 640 pixels a row (a tenth of a pixel)."""
    constant_spread: float = 0.0
    """Standard deviation that does not depend on the depth, m, added in quadrature."""
    disparity_step: float = 0.0
    """Step in which 1 / depth is known, 1/m; zero for none. Of a stereo camera it is the step of the disparity, pixels,
    over focal length (pixels) times baseline (m)."""
    dropout: float = 0.0
    """Share of the pixels that have no value."""
    missing: str = "zero"
    """What such a pixel reads: `zero`, as in most drivers, or `far`."""

    def __post_init__(self):
        for name, unit in ("spread", "m"), ("constant_spread", "m"), ("disparity_step", "1/m"):
            check_number(f"{name} of a depth noise", getattr(self, name), unit, at_least=0)
        check_number("dropout of a depth noise", self.dropout, "", at_least=0, at_most=1)
        check_choice("value of missing pixels", self.missing, ("zero", "far"))

    def apply(self, key: jax.Array, depth: Float[Array, "*images h w"], camera: Camera) -> Float[Array, "*images h w"]:
        """The depth that such a camera reads, m.

        The gradient with respect to the true depth is that of the scatter; rounding passes it on unchanged, as its own
        is zero almost everywhere. Missing pixels have none.

        Args:
            key: random key of these images.
            depth: true depth, m.
            camera: that took them; its `far` is the depth of a pixel that shows nothing.
        """
        scatter_key, dropout_key = jax.random.split(key)
        far = jnp.asarray(camera.far, depth.dtype)
        seen = depth < far
        noisy = depth
        if self.spread or self.constant_spread:
            deviation = jnp.sqrt((self.spread * depth**2) ** 2 + self.constant_spread**2)
            noisy += deviation * jax.random.normal(scatter_key, depth.shape, depth.dtype)
        noisy = jnp.clip(noisy, 0 if camera.near is None else camera.near, far)
        if self.disparity_step:
            noisy += jax.lax.stop_gradient(self._rounded(noisy, far) - noisy)
        noisy = jnp.where(seen, noisy, far)
        if self.dropout:
            lost = jax.random.bernoulli(dropout_key, self.dropout, depth.shape)
            noisy = jnp.where(lost, far if self.missing == "far" else jnp.zeros_like(far), noisy)
        return noisy

    def _rounded(self, depth: Array, far: Array) -> Array:
        """Depths whose inverse is a whole number of steps, the nearest ones; `far` where that number is zero."""
        steps = jnp.round(1 / (jnp.maximum(depth, jnp.finfo(depth.dtype).tiny) * self.disparity_step))
        return jnp.where(steps > 0, jnp.minimum(1 / (jnp.maximum(steps, 1) * self.disparity_step), far), far)
