"""Shading: Lambert's law under one sun, a checkered ground, and a sky."""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float, Int, UInt8

from jaxdrones.sensing.frustum import Placed, Solids, View, chosen, fold
from jaxdrones.sensing.geometry import nonzero, product
from jaxdrones.vector import components, safe_sqrt

SUN = (-0.48, 0.36, 0.8)
"""Unit vector towards the sun, world: behind and to the left of a drone that flies along x."""
_AMBIENT = 0.45  # share of ambient light
_TILE = 0.5  # m
_DARK, _BRIGHT = (0.42, 0.46, 0.42), (0.62, 0.66, 0.60)  # red, green, blue of the tiles
_HORIZON, _ZENITH = (0.82, 0.88, 0.95), (0.35, 0.55, 0.85)


def shade(
    view: View,
    solids: Solids,
    colors: Float[Array, "k 3"],
    ground: int | None,
    index: Int[Array, "h w"],
    depth: Float[Array, "h w"],
) -> UInt8[Array, "h w 4"]:
    """Red, green, blue and opacity of every pixel, which shows the solid `index` at `depth` (m).

    Rounding of the depth is invisible. Colors are 0 to 1; `ground` is the index of the ground, the last of the solids.
    """
    color = _painted(view, solids if ground is None else solids[:-1], colors, index, depth)
    rays = [x + view.u * y + view.v * z for x, y, z in view.axes.T]  # world
    if ground is not None:
        x, y = (eye + depth * ray for eye, ray in zip(view.eye[:2], rays[:2], strict=True))
        footprint = depth * view.pixel * _length(rays) / jnp.maximum(jnp.abs(rays[2]), 1e-3)  # larger at grazing angles
        tiles = _mixed(_DARK, _BRIGHT, _checkered(x, y, footprint))
        color = jnp.where(index == ground, _number([_lit(SUN[2]) * channel for channel in tiles]), color)
    climb = rays[2] / _length(rays)
    sky = _number(_mixed(_HORIZON, _ZENITH, jnp.clip(climb, 0, 1)))
    color = jnp.where(index < len(colors), color, sky).astype(jnp.uint32)
    shifts = jnp.arange(0, 32, 8, dtype=jnp.uint32)[None, None]
    return ((color | jnp.uint32(255 << 24))[..., None] >> shifts).astype(jnp.uint8)


def _painted(view: View, solids: Solids, colors: Array, index: Array, depth: Array) -> Float[Array, "h w"]:
    """Numbers of the colors of the solids in the light of the sun."""
    sun = view.axes @ jnp.asarray(SUN, depth.dtype)
    colors = jnp.clip(colors, 0, 1)

    def choose(number: Array, solid: Placed, active: Array, i: Array) -> Array:
        normal = solid.normals(view.u, view.v, depth)
        length = safe_sqrt(product(normal, normal))
        light = _lit(product(normal, components(sun @ solid.axes)) / nonzero(length))
        return chosen(number, (index == i) & active, _number([light * channel for channel in components(colors[i])]))

    active = [jnp.ones(len(kind.pos), bool) for kind in solids]
    return fold(choose, jnp.full_like(depth, -jnp.inf), view, solids, active)


def _lit(cosine: Any) -> Any:
    """Light on a surface, given the cosine of the angle between its normal and the sun."""
    return _AMBIENT + (1 - _AMBIENT) * jnp.maximum(cosine, 0)


def _number(color: Sequence[Array]) -> Array:
    """Red, green and blue, 0 to 1, as one whole number of three bytes: exact in a float."""
    red, green, blue = (jnp.round(255 * channel) for channel in color)
    return red + 256 * green + 65536 * blue


def _mixed(a: tuple[float, float, float], b: tuple[float, float, float], share: Float[Array, "h w"]) -> list[Array]:
    return [x + share * (y - x) for x, y in zip(a, b, strict=True)]


def _checkered(x: Array, y: Array, footprint: Array) -> Array:
    """0 and 1 on the tiles of a checkered ground, averaged over the edge (m) of a pixel's footprint against flicker."""
    width = footprint / _TILE + 1e-3

    def wave(s: Array) -> Array:
        """Mean of a square wave of -1 and 1 over the footprint: the difference of a triangle wave."""
        low, high = ((s + side * width / 2) / 2 for side in (-1, 1))
        return 2 * (_triangle(high) - _triangle(low)) / width

    return (1 - wave(x / _TILE) * wave(y / _TILE)) / 2


def _triangle(s: Array) -> Array:
    """Triangle wave of period 1 from 0 to 1/2."""
    return 0.5 - jnp.abs(s - jnp.floor(s) - 0.5)


def _length(rays: list[Array]) -> Float[Array, "h w"]:
    x, y, z = rays
    return safe_sqrt(x * x + y * y + z * z)
