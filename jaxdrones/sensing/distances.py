"""Distances of points from the surfaces of solids, and where these are nearest."""

from __future__ import annotations

import functools
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array
from numpy.typing import ArrayLike

from jaxdrones import rotation
from jaxdrones.sensing.geometry import Number, Point
from jaxdrones.sensing.shapes import Obstacle
from jaxdrones.vector import along_z


class Surface(flax.struct.PyTreeNode):
    """The point of a surface that is nearest to some point."""

    distance: Array
    """() signed distance of that point from the surface, m; negative inside. Infinity where there is no surface."""
    point: Array
    """(3,) the nearest point of the surface, m, world; infinity where there is none."""
    normal: Array
    """(3,) outward unit normal of the surface there, world; zero where there is none."""


def distance_of(kinds: list[Any], ground: bool, point: Point) -> Number:
    """Signed distance of a point from the nearest of some solids, m; infinity where there are none.

    Args:
        kinds: obstacles, each kind with a leading axis.
        ground: whether all points below z = 0 are a solid, too.
        point: (3,) m, world.
    """
    distances = [jnp.full((), jnp.inf, point.dtype)]
    if ground:
        distances.append(point[2])
    distances += [jnp.min(_distances(kind, point)) for kind in kinds]
    return jnp.min(jnp.stack(distances))


def nearest_of(kinds: list[Any], ground: bool, point: Point) -> Surface:
    """The nearest surface of some solids; arguments as for `distance_of`."""
    surfaces = [Surface(jnp.full((), jnp.inf, point.dtype), jnp.full_like(point, jnp.inf), jnp.zeros_like(point))]
    if ground:
        height = point[2]
        up = along_z(jnp.ones_like(height))
        surfaces.append(Surface(height, point - along_z(height), up))
    surfaces += [_nearest_of_kind(kind, point) for kind in kinds]
    return functools.reduce(_nearer, surfaces)


def as_floats(x: ArrayLike) -> Array:
    """An array of real numbers, in the precision that it has."""
    x = jnp.asarray(x)
    return x.astype(jnp.result_type(x, 1.0))


def _distances(kind: Obstacle, point: Point) -> Array:
    """Signed distances of a point from all obstacles of a kind, m."""

    def one(obstacle: Obstacle) -> Number:
        return jnp.where(obstacle.active, obstacle.distance(obstacle.to_local(point)), jnp.inf)

    return jax.vmap(one)(kind)


def _nearest_of_kind(kind: Any, point: Point) -> Surface:
    index = jnp.argmin(jax.lax.stop_gradient(_distances(kind, point)))
    obstacle = jax.tree.map(lambda x: x[index], kind)
    local = obstacle.to_local(point)
    distance = obstacle.distance(local)
    normal = rotation.rotate(obstacle.quat, obstacle.normal(local))
    there = obstacle.active
    return Surface(
        jnp.where(there, distance, jnp.inf),
        jnp.where(there, point - distance * normal, jnp.inf),
        jnp.where(there, normal, 0),
    )


def _nearer(a: Surface, b: Surface) -> Surface:
    return jax.tree.map(functools.partial(jnp.where, b.distance < a.distance), b, a)
