"""Ray casting: depth, solid and normal of every pixel by analytic rays.

The gradient of the depth is that of the visible surface. It has no contribution of silhouettes, where the depth jumps.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float, Int

from jaxdrones.sensing.frustum import Placed, Solids, View, chosen, fold, placed_in
from jaxdrones.sensing.geometry import Components, product
from jaxdrones.vector import components

_FEW = 128  # solids whose index fits into the last 7 of 23 bits of a depth


@jax.custom_jvp
def depth(view: View, solids: Solids, active: list[Array]) -> Float[Array, "h w"]:
    """Depth along the viewing axis of each pixel that shows an active solid, m; `far` for empty pixels."""

    def nearer(depth: Array, solid: Placed, active: Array, index: Array) -> Array:
        return jnp.minimum(depth, _first_hit(view, solid, active))

    return fold(nearer, jnp.full_like(view.u + view.v, view.far), view, solids, active)


def visible(view: View, solids: Solids, active: list[Array]) -> tuple[Int[Array, "h w"], Float[Array, "h w"]]:
    """Index of each pixel's solid, the number of solids for empty pixels; and its depth, m, to a relative 2e-5.

    A pass keeps one number if solids are few: the last bits of a depth are replaced by the index of its solid. Surfaces
    with depths within a relative 2e-5 (in float64, 3e-14) may be confused.
    """
    count = sum(len(kind.pos) for kind in solids)
    if count >= _FEW:
        depth, index = surfaces(view, solids, active)
        return index, depth
    mask = (1 << count.bit_length()) - 1
    integer = jnp.int64 if view.eye.dtype == jnp.float64 else jnp.int32

    def key_of(depth: Array, index: Array | int) -> Array:  # a positive number grows with the integer of its bits
        return jax.lax.bitcast_convert_type(depth, integer) & ~mask | index

    def nearer(key: Array, solid: Placed, active: Array, index: Array) -> Array:
        return jnp.minimum(key, key_of(_first_hit(view, solid, active), index.astype(integer)))

    nothing = key_of(jnp.full_like(view.u + view.v, view.far), count)
    key = fold(nearer, nothing, view, solids, active)
    return (key & mask).astype(jnp.int32), jax.lax.bitcast_convert_type(key & ~mask, view.eye.dtype)


def surfaces(view: View, solids: Solids, active: list[Array]) -> tuple[Float[Array, "h w"], Int[Array, "h w"]]:
    """Depth and index of each pixel's solid, as from `depth` and `visible`, in one pass of complex numbers."""

    def nearer(surface: Array, solid: Placed, active: Array, index: Array) -> Array:
        depth, seen = surface.real, surface.imag
        first = _first_hit(view, solid, active)
        return jax.lax.complex(jnp.minimum(depth, first), jnp.where(first < depth, index.astype(seen.dtype), seen))

    nothing = jnp.full_like(view.u + view.v, view.far)
    count = sum(len(kind.pos) for kind in solids)
    found = fold(nearer, jax.lax.complex(nothing, jnp.full_like(nothing, count)), view, solids, active)
    return found.real, found.imag.astype(jnp.int32)


def normals(view: View, solids: Solids, index: Int[Array, "h w"], depth: Float[Array, "h w"]) -> Components:
    """Normals of the visible surfaces in camera axes (forward, left, up), scaled to a product of 1 with (1, u, v)."""

    def choose(slopes: Array, solid: Placed, active: Array, i: Array) -> Array:
        left, up = solid.slopes(view.u, view.v, depth)
        here = (index == i) & active
        return jax.lax.complex(chosen(slopes.real, here, left), chosen(slopes.imag, here, up))

    active = [jnp.ones(len(kind.pos), bool) for kind in solids]
    none = jnp.full_like(depth, -jnp.inf)
    slopes = fold(choose, jax.lax.complex(none, none), view, solids, active)
    left, up = (jnp.where(part > -jnp.inf, part, 0) for part in (slopes.real, slopes.imag))
    return [1 - view.u * left - view.v * up, left, up]


def _first_hit(view: View, solid: Placed, active: Array) -> Array:
    """Depth at which each pixel's ray enters a solid; infinity for a miss."""
    first, last = solid.interval(view.u, view.v)
    first = jnp.maximum(first, view.near)
    return jnp.where((last >= first) & active, first, jnp.inf)


@functools.partial(depth.defjvp, symbolic_zeros=True)
def _depth_jvp(primals: tuple[View, Solids, list], tangents: tuple[View, Solids, list]) -> tuple[Array, Array]:
    """Tangent of a pixel's depth as camera and solids move: it stays in the tangent plane of the visible surface.

    With X = depth (1, u, v) on that plane, and W the plane's normal scaled so that W . (1, u, v) = 1, a displacement d
    of the plane relative to the camera, in camera axes, changes the depth by W . d.
    """
    view, solids, active = primals
    moved, changed, _ = tangents
    depths, index = surfaces(view, solids, active)
    free = (depths > view.near) & (depths < view.far)
    rate = jnp.zeros_like(depths)
    if not _is_zero((moved.eye, moved.axes)):
        w = normals(view, solids, index, depths)
        pixels = jnp.stack([jnp.ones_like(depths), *jnp.broadcast_arrays(view.u, view.v)])
        eye, axes = (_instantiated(t, p) for t, p in ((moved.eye, view.eye), (moved.axes, view.axes)))
        shift, turn = view.axes @ eye, view.axes @ axes.T
        turned = jnp.tensordot(turn, pixels, 1)
        rate = -product(w, [x + depths * y for x, y in zip(components(shift), components(turned), strict=True)])
    count = 0
    for kind, tangent in zip(solids, changed, strict=True):
        if not _is_zero(tangent):
            rate += _rate_of_solids(view, kind, tangent, index - count)
        count += len(kind.pos)
    return depths, jnp.where(free, rate, 0)


def _rate_of_solids(view: View, solids: Any, changed: Any, index: Int[Array, "h w"]) -> Float[Array, "h w"]:
    """Tangent of a pixel's depth with respect to the solids of one kind; zero where another kind is visible."""
    changed = jax.tree.map(_instantiated, changed, solids, is_leaf=lambda x: isinstance(x, SymbolicZero))
    placed, tangents = jax.jvp(jax.vmap(functools.partial(placed_in, view)), (solids,), (changed,))

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
