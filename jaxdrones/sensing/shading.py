"""Shading: Lambert's law under one sun, a checkered ground, and a sky."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float, Int, UInt8

from jaxdrones.sensing.visibility import Solids, View, normals
from jaxdrones.vector import safe_sqrt

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
    """Red, green, blue and opacity of every pixel.

    Args:
        view: rays.
        solids: visible solids.
        colors: of every solid, 0 to 1.
        ground: index of the ground among the solids, if there is one.
        index: solid of each pixel.
        depth: of its surface, m.
    """
    normal = -normals(view, solids, index, depth)  # towards the camera
    facing = jnp.tensordot(view.axes @ jnp.asarray(SUN, depth.dtype), normal, 1)
    cosine = facing / safe_sqrt(jnp.sum(normal**2, axis=0))
    light = _AMBIENT + (1 - _AMBIENT) * jnp.maximum(cosine, 0)
    rays = [x + view.u * y + view.v * z for x, y, z in view.axes.T]  # world
    color = colors[jnp.minimum(index, len(colors) - 1)]
    if ground is not None:
        x, y = (eye + depth * ray for eye, ray in zip(view.eye[:2], rays[:2], strict=True))
        tiles = _mixed(_DARK, _BRIGHT, _checkered(x, y, _footprint(view, depth, rays)))
        color = jnp.where((index == ground)[..., None], tiles, color)
    color = color * light[..., None]
    climb = rays[2] / _length(rays)
    sky = _mixed(_HORIZON, _ZENITH, jnp.clip(climb, 0, 1))
    color = jnp.where((index < len(colors))[..., None], color, sky)
    opaque = jnp.ones_like(color[..., :1])
    return jnp.round(255 * jnp.clip(jnp.concatenate([color, opaque], axis=-1), 0, 1)).astype(jnp.uint8)


def _mixed(a: tuple[float, float, float], b: tuple[float, float, float], share: Float[Array, "h w"]) -> Array:
    """(h, w, 3) linear interpolation between colors a and b."""
    first, second = jnp.asarray(a, share.dtype), jnp.asarray(b, share.dtype)
    return first[None, None] + share[..., None] * (second - first)[None, None]


def _footprint(view: View, depth: Float[Array, "h w"], rays: list[Array]) -> Float[Array, "h w"]:
    """Edge of a pixel's footprint on the ground, m; larger at grazing angles."""
    return depth * view.pixel * _length(rays) / jnp.maximum(jnp.abs(rays[2]), 1e-3)


def _checkered(x: Array, y: Array, footprint: Array) -> Array:
    """0 and 1 on the tiles of a checkered ground, averaged over the footprint of a pixel against flicker."""
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
