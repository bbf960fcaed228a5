"""Random obstacles: trunks, balls and boxes between two corners of a cuboid."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxdrones import rotation
from jaxdrones.sensing.shapes import Box, Cylinder, Obstacle, Sphere
from jaxdrones.vector import sin_cos

_WOOD, _GREEN, _STONE = (0.4, 0.28, 0.18, 1.0), (0.2, 0.5, 0.2, 1.0), (0.5, 0.5, 0.55, 1.0)  # red, green, blue, opacity
_SPHERE_RADIUS = (0.2, 0.5)  # m
_BOX_EDGE = (0.3, 1.0)  # m


def trunks(
    key: jax.Array, count: int, corners: Float[Array, "2 3"], radius: tuple[float, float], tilt: float = 0.0
) -> Cylinder:
    """Cylinders at random places between two corners, which reach from the ground to the height of the second one."""
    place_key, radius_key, tilt_key, axis_key = jax.random.split(key, 4)
    height = corners[1, 2]
    foot = _places(place_key, count, corners) * jnp.array([[1, 1, 0]])
    sin, cos = sin_cos(jax.random.uniform(axis_key, (count,), maxval=2 * jnp.pi))
    angle = jnp.radians(jax.random.uniform(tilt_key, (count, 1), maxval=tilt))
    quat = jax.vmap(rotation.exp)(angle * jnp.stack([cos, sin, 0 * sin], axis=-1))
    return Cylinder(
        pos=foot + height / 2 * jax.vmap(rotation.z_axis)(quat),
        quat=quat,
        radius=jax.random.uniform(radius_key, (count,), minval=radius[0], maxval=radius[1]),
        height=jnp.full(count, height),
        color=jnp.tile(jnp.array([_WOOD]), (count, 1)),
    )


def spheres(key: jax.Array, count: int, corners: Float[Array, "2 3"]) -> Sphere:
    """Balls at random places between two corners."""
    place_key, radius_key = jax.random.split(key)
    low, high = _SPHERE_RADIUS
    return Sphere(
        pos=_places(place_key, count, corners),
        quat=_level(jnp.zeros(count)),
        radius=jax.random.uniform(radius_key, (count,), minval=low, maxval=high),
        color=jnp.tile(jnp.array([_GREEN]), (count, 1)),
    )


def boxes(key: jax.Array, count: int, corners: Float[Array, "2 3"]) -> Box:
    """Boxes of any heading at random places between two corners."""
    place_key, size_key, yaw_key = jax.random.split(key, 3)
    low, high = _BOX_EDGE
    return Box(
        pos=_places(place_key, count, corners),
        quat=_level(jax.random.uniform(yaw_key, (count,), maxval=2 * jnp.pi)),
        size=jax.random.uniform(size_key, (count, 3), minval=low, maxval=high),
        color=jnp.tile(jnp.array([_STONE]), (count, 1)),
    )


def _places(key: jax.Array, count: int, corners: Float[Array, "2 3"]) -> Float[Array, "k 3"]:
    return jax.random.uniform(key, (count, 3), minval=corners[:1], maxval=corners[1:])


def _level(yaw: Float[Array, " k"]) -> Float[Array, "k 4"]:
    """Quaternions of headings, rad."""
    sin, cos = sin_cos(yaw / 2)
    return jnp.stack([0 * sin, 0 * sin, sin, cos], axis=-1)


def is_free(solids: Obstacle, points: Float[Array, "k 3"], clearance: float) -> Bool[Array, " n"]:
    """Whether each obstacle of a kind is far enough from all points."""

    def gap(solid: Obstacle, point: Array) -> Array:
        return solid.distance(solid.to_local(point))

    gaps = jax.vmap(jax.vmap(gap, (None, 0)), (0, None))(solids, points)
    return jnp.all(gaps >= clearance, axis=1)
