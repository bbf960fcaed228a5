"""Camera of a drone and depth noise, for both backends."""

import dataclasses
import math
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdrones import rotation
from jaxdrones.arguments import checked, choice, number, quaternion
from jaxdrones.checks import check_number, check_whole, short_repr
from jaxdrones.errors import UserError
from jaxdrones.params import Params
from jaxdrones.state import State
from jaxdrones.vector import along_z, cross, safe_sqrt, unit

_POSITIVE = number(name="{argument} of a camera", above=0)


@checked
@dataclasses.dataclass(frozen=True, kw_only=True)
class Camera:
    """Pinhole camera on every drone of a team, fixed to the body unless `leveled`.

    The camera's x axis is the viewing direction; y points left and z up in the image, as in the body frame.
    """

    resolution: tuple[int, int] = (64, 48)
    """Width and height, pixels."""
    field_of_view: Annotated[float, number("degrees", "{argument} of a camera", above=0, below=180)] = 60.0
    """Vertical field of view, degrees."""
    aspect: Annotated[float | None, _POSITIVE] = None
    """Width over height of the view. The default is that of the resolution, which gives square pixels."""
    principal_point: tuple[float, float] = (0.0, 0.0)
    """Principal point, pixels to the right of and below the image center."""
    offset: tuple[float, float, float] | None = (0.0, 0.0, 0.0)
    """(3,) position of the eye relative to the center of mass, m, body axes; world axes if the camera is leveled.
    `None`: one arm of the drone above the center of mass."""
    orientation: Annotated[tuple[float, ...], quaternion("{argument} of a camera")] = (0.0, 0.0, 0.0, 1.0)
    """(4,) unit quaternion (x, y, z, w), camera to body."""
    leveled: bool = False
    """Whether the camera points along the body's x axis with the world's z axis up in the image, whatever the roll."""
    near: Annotated[float | None, _POSITIVE] = 0.05
    """Smallest visible depth, m. `None`: the arm of the drone."""
    far: float = 1000.0
    """Largest visible depth, m; also the depth of an empty pixel."""
    rate: Annotated[float | None, _POSITIVE] = None
    """Images per second. The default is one every control step."""
    latency: Annotated[float, number("s", "{argument} of a camera", at_least=0)] = 0.0
    """Age of an image when it is observed for the first time, s; in environments rounded to control steps."""
    sees_self: bool = False
    """Whether the drone with the camera is visible."""
    noise: Any = None
    """A model of the noise of the depth in environments, a `jaxdrones.sensing.DepthNoise` or another object with a
    method `apply(key, depth, camera) -> depth`."""

    def __post_init__(self):
        if not isinstance(self.resolution, tuple | list) or len(self.resolution) != 2:
            raise UserError(f"resolution of a camera is {short_repr(self.resolution)}; give (width, height) in pixels")
        for name, pixels in zip(("width", "height"), self.resolution, strict=True):
            check_whole(f"{name} of a camera", pixels)
        object.__setattr__(self, "resolution", tuple(self.resolution))
        check_number("far of a camera", self.far, "m", above=self.near or 0)
        if self.noise is not None and not callable(getattr(self.noise, "apply", None)):
            remedy = "give jaxdrones.sensing.DepthNoise(...), or another object with a method apply(key, depth, camera)"
            raise UserError(f"noise of a camera is {short_repr(self.noise)}; {remedy}")
        for name, length in ("principal_point", 2), ("offset", 3), ("orientation", 4):
            value = getattr(self, name)
            if value is not None:
                if np.shape(value) != (length,) or not np.isfinite(value).all():
                    raise UserError(f"{name} of a camera is {short_repr(value)}; give {length} numbers")
                object.__setattr__(self, name, tuple(map(float, value)))
        length = math.hypot(*self.orientation)
        object.__setattr__(self, "orientation", tuple(x / length for x in self.orientation))

    @property
    def slopes(self) -> tuple[float, float]:
        """Tangents of half the horizontal and of half the vertical field of view."""
        width, height = self.resolution
        vertical = math.tan(math.radians(self.field_of_view) / 2)
        return vertical * (width / height if self.aspect is None else self.aspect), vertical

    def pose(self, params: Params, state: State) -> tuple[Float[Array, "3"], Float[Array, "3 3"]]:
        """Position and axes of the camera of one drone.

        Returns:
            Position of the eye (3,), m, world; and the forward, left and up directions of the image as rows of a
            (3, 3) matrix, world. The directions of a leveled camera are undefined where the body's x axis is vertical.
        """
        arm = along_z(params.arm)
        offset = arm if self.offset is None else jnp.asarray(self.offset, arm.dtype)
        body = rotation.axes(state.quat)
        if self.leveled:
            left = unit(cross(along_z(jnp.ones_like(params.arm)), body[0]))
            body = [body[0], left, cross(body[0], left)]
        else:
            offset = rotation.rotate(state.quat, offset)
        mounted = rotation.axes(jnp.asarray(self.orientation, arm.dtype))
        axes = [sum(x * axis for x, axis in zip(direction, body, strict=True)) for direction in mounted]
        return state.pos + offset, jnp.stack(axes)

    def near_of(self, params: Params) -> Float[Array, ""]:
        """The smallest visible depth of the camera of one drone, m."""
        return params.arm if self.near is None else jnp.asarray(self.near, params.arm.dtype)


_AMOUNT = number(name="{argument} of {function}", at_least=0)
_SHARE = number("a fraction", "{argument} of {function}", at_least=0, at_most=1)


@checked
@dataclasses.dataclass(frozen=True, kw_only=True)
class DepthNoise:
    """Depth noise of a stereo camera: depth = focal length times baseline / disparity.

    Noise of the disparity gives a standard deviation of the depth that grows with the square of the depth. The order
    is that of a camera: scatter, rounding of the disparity, limits of the depth, missing pixels. Empty pixels stay at
    `far`.
    """

    spread: Annotated[float, _AMOUNT] = 0.0
    """Standard deviation of the depth at 1 m, m; at z m it is z^2 times as large. About 0.002 for stereo cameras of
    5 cm baseline and 640 pixels a row (a tenth of a pixel)."""
    constant_spread: Annotated[float, _AMOUNT] = 0.0
    """Standard deviation independent of the depth, m, added in quadrature."""
    disparity_step: Annotated[float, _AMOUNT] = 0.0
    """Resolution of 1 / depth, 1/m; zero for none. For a stereo camera it is the resolution of the disparity (pixels)
    over focal length (pixels) times baseline (m)."""
    dropout: Annotated[float, _SHARE] = 0.0
    """Fraction of the pixels without a value."""
    missing: Annotated[str, choice("value of a missing pixel", ("zero", "far"))] = "zero"
    """Value of a missing pixel: `zero`, as in most drivers, or `far`."""

    def apply(self, key: jax.Array, depth: Float[Array, "*images h w"], camera: Camera) -> Float[Array, "*images h w"]:
        """Depth with noise, m; the `far` of the camera is the depth of an empty pixel.

        The gradient with respect to the true depth is that of the scatter. Rounding has a straight-through gradient.
        Missing pixels have a zero gradient.
        """
        scatter_key, dropout_key = jax.random.split(key)
        far = jnp.asarray(camera.far, depth.dtype)
        seen = depth < far
        noisy = depth
        if self.spread or self.constant_spread:
            deviation = safe_sqrt((self.spread * depth**2) ** 2 + self.constant_spread**2)
            noisy += deviation * jax.random.normal(scatter_key, depth.shape, depth.dtype)
        near = 0 if camera.near is None else camera.near
        noisy = jnp.clip(noisy, near, far)
        if self.disparity_step:
            noisy += jax.lax.stop_gradient(jnp.maximum(self._rounded(noisy, far), near) - noisy)
        noisy = jnp.where(seen, noisy, far)
        if self.dropout:
            lost = jax.random.bernoulli(dropout_key, self.dropout, depth.shape)
            noisy = jnp.where(lost, far if self.missing == "far" else jnp.zeros_like(far), noisy)
        return noisy

    def _rounded(self, depth: Array, far: Array) -> Array:
        """Depth with its inverse rounded to whole steps; `far` where that is zero."""
        steps = jnp.round(1 / (jnp.maximum(depth, jnp.finfo(depth.dtype).tiny) * self.disparity_step))
        return jnp.where(steps > 0, jnp.minimum(1 / (jnp.maximum(steps, 1) * self.disparity_step), far), far)


camera_2021 = Camera(leveled=True, aspect=1.0, principal_point=(0.5, -0.5), offset=None, near=None)
"""The camera of gym-pybullet-drones (2021), whose pixels are not square. Its renderer samples the lower left
corners of the pixels in place of their centers."""


def _check_camera(name: str, camera: Any) -> None:
    if not isinstance(camera, Camera):
        raise UserError(f"{name} is {short_repr(camera)}; give for example jaxdrones.Camera(resolution=(16, 12))")


OneCamera = Annotated[Camera, _check_camera]
