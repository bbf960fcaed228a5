"""Solids in the view of a camera: rays of pixels, culling, and passes over the solids that are left.

A pass has one number per pixel, or two as a complex number, and compiles to a loop over pixels without intermediate
arrays. If each solid ends in a minimum or a maximum, images of a batch that have no solid left cost nothing on a CPU.
"""

import functools
from collections.abc import Callable
from typing import Any, Self

import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Float

from jaxdrones import rotation
from jaxdrones.pytree import PyTreeNode
from jaxdrones.sensing.geometry import Components, Interval, nonzero, product
from jaxdrones.sensing.shapes import Obstacle
from jaxdrones.vector import components, dot

_UNROLL = 2  # solids per iteration; with all in one iteration compilers keep the image of each
_SLACK = 1e-4  # relative margin for rounding by which the view and the solids are enlarged


class View(PyTreeNode):
    """Pose of a camera and rays of its pixels; the ray of a pixel is axes^T (1, u, v).

    The image has h rows and w columns, or is one row of h w pixels.
    """

    eye: Array
    """(3,) m, world."""
    axes: Array
    """(3, 3) forward, left and up, one in each row, world."""
    u: Array
    """(1, w) tangent of a pixel's ray to the left."""
    v: Array
    """(h, 1), or (1, w) for one row: tangent of a pixel's ray upward."""
    pixel: Array
    """() height of a pixel at 1 m, m."""
    near: Array
    """() smallest visible depth, m."""
    far: Array
    """() largest visible depth, m."""


class Placed(PyTreeNode):
    """A solid in camera coordinates."""

    solid: Obstacle
    origin: Array
    """(3,) the eye in the frame of the solid, m."""
    axes: Array
    """(3, 3) forward, left and up of the camera in the frame of the solid, one in each row."""

    def rays(self, u: Array, v: Array) -> Components:
        """Direction of each pixel's ray, in the frame of the solid."""
        return [x + u * y + v * z for x, y, z in zip(*map(components, components(self.axes)), strict=True)]

    def interval(self, u: Array, v: Array) -> Interval:
        """First and last depth of each pixel's ray inside the solid."""
        return self.solid.interval(components(self.origin), self.rays(u, v))

    def normals(self, u: Array, v: Array, depth: Array) -> Components:
        """Outward normals of any length where the rays of pixels hit, in the frame of the solid."""
        return self.solid.normals(
            [o + depth * d for o, d in zip(components(self.origin), self.rays(u, v), strict=True)]
        )

    def in_view(self, view: View) -> Array:
        """Whether the solid may intersect the view frustum: not all of it is beyond one side."""
        forward, left, up = components(self.axes)
        width, height = ((1 + _SLACK) * jnp.max(jnp.abs(x)) for x in (view.u, view.v))

        def is_beyond(outward: Array, offset: Array | float) -> Array:
            reach = (1 + _SLACK) * (self.solid.extent(outward) + self.solid.rounding)
            return -dot(outward, self.origin) - reach > offset

        def tilted(across: Array, slope: Array) -> Array:
            return (across - slope * forward) / jnp.sqrt(1 + slope**2)

        sides = [tilted(left, width), tilted(-left, width), tilted(up, height), tilted(-up, height)]
        beyond = [
            is_beyond(-forward, -view.near),
            is_beyond(forward, view.far),
            *(is_beyond(side, 0) for side in sides),
        ]
        return ~functools.reduce(jnp.logical_or, beyond)

    def slopes(self, u: Array, v: Array, depth: Array) -> tuple[Array, Array]:
        """Components to the left and up, over that along the ray, of the normals where the rays of pixels hit."""
        normal = self.normals(u, v, depth)
        forward, left, up = (product(normal, components(axis)) for axis in components(self.axes))
        along = nonzero(forward + u * left + v * up)
        return left / along, up / along


class Ground(PyTreeNode):
    """Half space below z = 0 as a solid."""

    pos: Array
    """(3,) zero."""
    quat: Array
    """(4,) the identity."""

    @classmethod
    def of(cls, dtype: DTypeLike) -> Self:
        """Ground with a leading axis of length 1."""
        return cls(jnp.zeros((1, 3), dtype), jnp.array([[0, 0, 0, 1]], dtype))

    rounding = 0.0

    def to_local(self, point: Float[Array, "3"]) -> Float[Array, "3"]:
        """The same point."""
        return point

    def extent(self, direction: Float[Array, "3"]) -> Float[Array, ""]:
        """Infinity."""
        return jnp.full((), jnp.inf, direction.dtype)

    def normals(self, point: Components) -> Components:
        """The vertical."""
        zero = jnp.zeros_like(point[2])
        return [zero, zero, jnp.ones_like(zero)]

    def interval(self, origin: Components, direction: Components) -> Interval:
        """Interval of lines underground."""
        z, climb = origin[2], nonzero(direction[2])
        crossing = -z / climb
        return jnp.where(climb < 0, crossing, -jnp.inf), jnp.where(climb < 0, jnp.inf, crossing)


Solids = list[Obstacle | Ground]
"""Kinds of solids; arrays of each have a leading axis over the solids of the kind."""


def placed_in(view: View, solid: Any) -> Placed:
    """A solid in camera coordinates."""
    to_local = jax.vmap(functools.partial(rotation.rotate_inverse, solid.quat))
    return Placed(solid, solid.to_local(view.eye), to_local(view.axes))


def fold(function: Callable[..., Array], start: Array, view: View, solids: Solids, active: list[Array]) -> Array:
    """Fold `(image, solid, active, index) -> image` over the solids in view; an image ignores one that is inactive."""
    image, count = start, 0
    for kind, mask in zip(solids, active, strict=True):
        size = len(mask)
        there = mask & jax.vmap(lambda solid: placed_in(view, solid).in_view(view))(kind)
        following = jax.lax.cummin(jnp.where(there, jnp.arange(size), size), reverse=True)
        following = jnp.append(following, jnp.full(2, size))  # the first in view from each place on

        def turn(
            carry: tuple[Array, Array], kind=kind, size=size, count=count, following=following
        ) -> tuple[Array, Array]:
            at, image = carry
            for k in range(_UNROLL):
                solid = placed_in(view, jax.tree.map(lambda x, at=at: x[at], kind))
                image = function(image, solid, k == 0 or at < size, count + at)
                at = following[at + 1]
            return at, image

        def is_unfinished(carry: tuple[Array, Array], size=size) -> Array:
            return carry[0] < size

        _, image = jax.lax.while_loop(is_unfinished, turn, (following[0], image))
        count += size
    return image


def chosen(number: Array, here: Array, new: Array) -> Array:
    """The new number where it is `here`, for numbers that begin at minus infinity."""
    return jnp.maximum(number, jnp.where(here, new, -jnp.inf))
