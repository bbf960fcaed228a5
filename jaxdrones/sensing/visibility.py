"""Ray casting: depth, solid and normal of every pixel by analytic rays.

Each quantity of an image is a pass over the solids with one number per pixel, which compiles to a loop over pixels
without intermediate arrays: the depth of the nearest surface, then the index of its solid. The gradient of the depth is
that of the visible surface. It has no contribution of silhouettes, where the depth jumps.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero
from jax.typing import DTypeLike
from jaxtyping import Array, Float, Int

from jaxdrones import rotation
from jaxdrones.pytree import PyTreeNode
from jaxdrones.sensing.geometry import Components, Interval, nonzero
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

    def interval(self, u: Array, v: Array) -> tuple[Array, Array]:
        """First and last depth of each pixel's ray inside the solid."""
        forward, left, up = (components(axis) for axis in components(self.axes))
        direction = [x + u * y + v * z for x, y, z in zip(forward, left, up, strict=True)]
        return self.solid.interval(components(self.origin), direction)

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

    def normal(self, u: Array, v: Array, depth: Array) -> tuple[Array, Array]:
        """Components to the left and up, over that along the ray, of the normals where the rays of pixels hit."""
        axes = [components(axis) for axis in components(self.axes)]
        ray = [x + u * y + v * z for x, y, z in zip(*axes, strict=True)]
        normal = self.solid.normals([o + depth * d for o, d in zip(components(self.origin), ray, strict=True)])
        forward, left, up = (sum(n * x for n, x in zip(normal, axis, strict=True)) for axis in axes)
        along = nonzero(forward + u * left + v * up)
        return left / along, up / along


class Ground(PyTreeNode):
    """Half space below z = 0 as a solid."""

    pos: Array
    """(3,) zero."""
    quat: Array
    """(4,) the identity."""

    @classmethod
    def of(cls, dtype: DTypeLike) -> Ground:
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


def _placed(view: View, solid: Any) -> Placed:
    """A solid in camera coordinates."""
    to_local = jax.vmap(functools.partial(rotation.rotate_inverse, solid.quat))
    return Placed(solid, solid.to_local(view.eye), to_local(view.axes))


@jax.custom_jvp
def depth(view: View, solids: Solids, active: list[Array]) -> Float[Array, "h w"]:
    """Depth of each pixel along the viewing axis, m; `far` for empty pixels.

    Args:
        view: rays.
        solids: visible solids.
        active: (k,) bool for each kind, the active solids.
    """

    def nearer(depth: Array, solid: Placed, active: Array, index: Array) -> Array:
        return jnp.minimum(depth, _first_hit(view, solid, active))

    return _pass(nearer, jnp.full_like(view.u + view.v, view.far), view, solids, active)


def visible(view: View, solids: Solids, active: list[Array]) -> Int[Array, "h w"]:
    """Index of each pixel's solid; the number of solids for empty pixels.

    Surfaces with depths within a relative 1e-5 (in float64, 1e-14) may be confused: a pass keeps one number, so the
    last bits of a depth are replaced by the index of its solid.
    """
    count = sum(len(kind.pos) for kind in solids)
    mask = (1 << count.bit_length()) - 1
    integer = jnp.int64 if view.eye.dtype == jnp.float64 else jnp.int32

    def key_of(depth: Array, index: Array | int) -> Array:  # a positive number grows with the integer of its bits
        return jax.lax.bitcast_convert_type(depth, integer) & ~mask | index

    def nearer(key: Array, solid: Placed, active: Array, index: Array) -> Array:
        return jnp.minimum(key, key_of(_first_hit(view, solid, active), index.astype(integer)))

    nothing = key_of(jnp.full_like(view.u + view.v, view.far), count)
    return (_pass(nearer, nothing, view, solids, active) & mask).astype(jnp.int32)


def normals(view: View, solids: Solids, index: Int[Array, "h w"], depth: Float[Array, "h w"]) -> Float[Array, "3 h w"]:
    """Normals of the visible surfaces in camera axes (forward, left, up), scaled to a product of 1 with (1, u, v).

    Args:
        view: rays.
        solids: visible solids.
        index: solid of each pixel.
        depth: of its surface, m.
    """
    active = [jnp.ones(len(kind.pos), bool) for kind in solids]

    def component(k: int) -> Array:
        def add(normal: Array, solid: Placed, active: Array, i: Array) -> Array:
            return jnp.where(index == i, solid.normal(view.u, view.v, depth)[k], normal)

        return _pass(add, jnp.zeros_like(depth), view, solids, active)

    left, up = component(0), component(1)
    return jnp.stack([1 - view.u * left - view.v * up, left, up])


def _first_hit(view: View, solid: Placed, active: Array) -> Array:
    """Depth at which each pixel's ray enters a solid; infinity for a miss."""
    first, last = solid.interval(view.u, view.v)
    first = jnp.maximum(first, view.near)
    return jnp.where((last >= first) & active, first, jnp.inf)


def _pass(function: Callable[..., Array], start: Array, view: View, solids: Solids, active: list[Array]) -> Array:
    """Fold `(image, solid, active, index) -> image` over the solids in view."""
    image, count = start, 0
    for kind, mask in zip(solids, active, strict=True):
        size = len(mask)
        there = mask & jax.vmap(lambda solid: _placed(view, solid).in_view(view))(kind)
        following = jax.lax.cummin(jnp.where(there, jnp.arange(size), size), reverse=True)
        following = jnp.append(following, jnp.full(2, size))  # the first in view from each place on

        def turn(
            carry: tuple[Array, Array], kind=kind, size=size, count=count, following=following
        ) -> tuple[Array, Array]:
            at, image = carry
            for k in range(_UNROLL):
                solid = _placed(view, jax.tree.map(lambda x, at=at: x[at], kind))
                image = function(image, solid, k == 0 or at < size, count + at)
                at = following[at + 1]
            return at, image

        def goes_on(carry: tuple[Array, Array], size=size) -> Array:
            return carry[0] < size

        _, image = jax.lax.while_loop(goes_on, turn, (following[0], image))
        count += size
    return image


@functools.partial(depth.defjvp, symbolic_zeros=True)
def _depth_jvp(primals: tuple[View, Solids, list], tangents: tuple[View, Solids, list]) -> tuple[Array, Array]:
    """Tangent of a pixel's depth as camera and solids move: it stays in the tangent plane of the visible surface.

    With X = depth (1, u, v) on that plane, and W the plane's normal scaled so that W . (1, u, v) = 1, a displacement d
    of the plane relative to the camera, in camera axes, changes the depth by W . d.
    """
    view, solids, active = primals
    moved, changed, _ = tangents
    depths = depth(view, solids, active)
    index = visible(view, solids, active)
    free = (depths > view.near) & (depths < view.far)
    rate = jnp.zeros_like(depths)
    if not _is_zero((moved.eye, moved.axes)):
        w = normals(view, solids, index, depths)
        x = jnp.stack([jnp.ones_like(depths), depths, depths * view.u, depths * view.v])
        eye, axes = (_instantiated(t, p) for t, p in ((moved.eye, view.eye), (moved.axes, view.axes)))
        motion = view.axes @ jnp.concatenate([eye[None], axes]).T  # of the eye and of the rays, in camera axes
        rate = -jnp.sum(w * jnp.tensordot(motion, x, 1), axis=0)
    count = 0
    for kind, tangent in zip(solids, changed, strict=True):
        if not _is_zero(tangent):
            rate += _rate_of_solids(view, kind, tangent, index - count)
        count += len(kind.pos)
    return depths, jnp.where(free, rate, 0)


def _rate_of_solids(view: View, solids: Any, changed: Any, index: Int[Array, "h w"]) -> Float[Array, "h w"]:
    """Tangent of a pixel's depth with respect to the solids of one kind; zero where another kind is visible."""
    changed = jax.tree.map(_instantiated, changed, solids, is_leaf=lambda x: isinstance(x, SymbolicZero))
    placed, tangents = jax.jvp(jax.vmap(functools.partial(_placed, view)), (solids,), (changed,))

    @jax.checkpoint
    def add(rate: Array, solid: Placed, tangent: Placed, i: Array) -> Array:
        _, derivative = jax.jvp(lambda solid: solid.interval(view.u, view.v)[0], (solid,), (tangent,))
        return jnp.where(index == i, derivative, rate)

    xs = (placed, tangents, jnp.arange(len(solids.pos)))
    return jax.lax.scan(lambda rate, x: (add(rate, *x), None), jnp.zeros_like(view.u + view.v), xs)[0]


def _is_zero(tangents: Any) -> bool:
    leaves = jax.tree.leaves(tangents, is_leaf=lambda x: isinstance(x, SymbolicZero))
    return all(isinstance(leaf, SymbolicZero) for leaf in leaves)


def _instantiated(tangent: Any, primal: Array) -> Array:
    return jnp.zeros_like(primal) if isinstance(tangent, SymbolicZero) else tangent
