"""The camera of a drone, for both backends."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdrones import rotation
from jaxdrones.checks import (
    check_callable,
    check_finite,
    check_number,
    check_positive,
    check_quaternion,
    check_switch,
    check_whole,
    shown,
)
from jaxdrones.errors import UserError
from jaxdrones.params import Params
from jaxdrones.state import State
from jaxdrones.vector import along_z, cross, unit


@dataclasses.dataclass(frozen=True, kw_only=True)
class Camera:
    """A pinhole camera on every drone of a team, fixed to the body unless it is `levelled`.

    A camera looks along its own x axis, with y to the left and z up in the image, as a body does.
    """

    resolution: tuple[int, int] = (64, 48)
    """Width and height, pixels."""
    field_of_view: float = 60.0
    """Vertical field of view, degrees."""
    aspect: float | None = None
    """Width over height of the view; that of the resolution, which makes square pixels, when left out."""
    principal_point: tuple[float, float] = (0.0, 0.0)
    """Where the optical axis meets the image, pixels to the right of and below the middle of the image."""
    offset: tuple[float, float, float] | None = (0.0, 0.0, 0.0)
    """(3,) position of the eye relative to the center of mass, m, body axes; world axes if the camera is levelled.
    `None`: one arm of the drone above the center of mass."""
    orientation: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    """(4,) unit quaternion (x, y, z, w), camera to body."""
    levelled: bool = False
    """Whether the camera looks along the body's x axis with the world's z axis up in the image, whatever the roll."""
    near: float | None = 0.05
    """Smallest depth that is visible, m. `None`: the arm of the drone."""
    far: float = 1000.0
    """Largest depth that is visible, m; also the depth of a pixel that shows nothing."""
    rate: float | None = None
    """Images per second; one every control step when left out."""
    latency: float = 0.0
    """Age of an image when it is observed for the first time, s."""
    sees_self: bool = False
    """Whether the drone that carries the camera is visible."""
    noise: Any = None
    """A model of the noise of the depth in environments, a `jaxdrones.sensing.DepthNoise` or another object with a
    method `apply(key, depth, camera) -> depth`."""

    def __post_init__(self):
        if not isinstance(self.resolution, tuple | list) or len(self.resolution) != 2:
            raise UserError(f"resolution of a camera is {shown(self.resolution)}; give (width, height) in pixels")
        for name, pixels in zip(("width", "height"), self.resolution, strict=True):
            check_whole(f"{name} of a camera", pixels)
        object.__setattr__(self, "resolution", tuple(self.resolution))
        check_number("field_of_view of a camera", self.field_of_view, "degrees", above=0, below=180)
        for name, unit_of in ("aspect", ""), ("near", "m"), ("rate", "1/s"):
            value = getattr(self, name)
            if value is not None:
                check_positive(f"{name} of a camera", value, unit_of)
        check_number("far of a camera", self.far, "m", above=self.near or 0)
        check_number("latency of a camera", self.latency, "s", at_least=0)
        check_switch("levelled of a camera", self.levelled)
        check_switch("sees_self of a camera", self.sees_self)
        for name, length in ("principal_point", 2), ("offset", 3), ("orientation", 4):
            value = getattr(self, name)
            if value is None and name == "offset":
                continue
            if np.shape(value) != (length,):
                raise UserError(f"{name} of a camera is {shown(value)}; give {length} numbers")
            check_finite(f"{name} of a camera", value)
            object.__setattr__(self, name, tuple(map(float, value)))
        check_quaternion("orientation of a camera", self.orientation)
        length = math.hypot(*self.orientation)
        object.__setattr__(self, "orientation", tuple(x / length for x in self.orientation))
        if self.noise is not None:
            check_callable(
                "apply of the noise of a camera", getattr(self.noise, "apply", None), "that of a DepthNoise()"
            )

    @property
    def slopes(self) -> tuple[float, float]:
        """Tangents of half the horizontal and of half the vertical field of view."""
        width, height = self.resolution
        vertical = math.tan(math.radians(self.field_of_view) / 2)
        return vertical * (width / height if self.aspect is None else self.aspect), vertical

    def pose(self, params: Params, state: State) -> tuple[Float[Array, "3"], Float[Array, "3 3"]]:
        """Where the camera of one drone is and how it is turned.

        Returns:
            Position of the eye (3,), m, world; and the directions (3, 3) that are forward, left and up in the image,
            one in each row, world. Those of a levelled camera have no value where the body's x axis is vertical.
        """
        arm = along_z(params.arm)
        offset = arm if self.offset is None else jnp.asarray(self.offset, arm.dtype)
        body = rotation.axes(state.quat)
        if self.levelled:
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


camera_2021 = Camera(levelled=True, aspect=1.0, principal_point=(0.5, -0.5), offset=None, near=None)
"""The camera of gym-pybullet-drones (2021), whose pixels are not square. Its renderer looks through the lower left
corners of the pixels in place of their centers."""


def check_camera(camera: Any) -> None:
    """Raise unless `camera` is a camera."""
    if not isinstance(camera, Camera):
        raise UserError(f"camera is {shown(camera)}; give a jaxdrones.Camera, for example Camera(resolution=(16, 12))")
