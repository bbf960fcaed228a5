"""Signed distances and nearest points of solids."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import ArrayLike

from jaxdrones import rotation
from jaxdrones.pytree import PyTreeNode
from jaxdrones.sensing.geometry import Number, Point, length
from jaxdrones.sensing.shapes import Obstacle
from jaxdrones.vector import along_z


class Surface(PyTreeNode):
    """Nearest point of a surface to a query point."""

    distance: Array
    """() signed distance of the query point, m; negative inside. Infinity where there is no surface."""
    point: Array
    """(3,) the nearest point of the surface, m, world; infinity where there is none."""
    normal: Array
    """(3,) outward unit normal of the surface there, world; zero where there is none."""


class Solid(Obstacle, kw_only=True):
    """Box, sphere, cylinder or capsule in one representation."""

    half: Any = None
    """(3,) half of the core's extents along x, y and z, m."""
    is_round: Any = False
    """() bool: whether the core is a cylinder along z."""
    rounding: Any = 0.0
    """() distance of the surface from the core, m."""


def merged(kinds: list[Any]) -> list[Any]:
    """Merge obstacles of several kinds, each with a leading axis, into one kind, in the same order.

    Fewer arrays compile faster.
    """

    def as_solid(obstacle: Obstacle) -> Solid:
        rounding = jnp.asarray(obstacle.rounding, obstacle.pos.dtype)
        own = {name: getattr(obstacle, name) for name in ("pos", "quat", "active", "half")}
        return Solid(**own, color=None, is_round=jnp.asarray(obstacle.is_round), rounding=rounding)

    solids = [jax.vmap(as_solid)(kind) for kind in kinds]
    return [jax.tree.map(lambda *x: jnp.concatenate(x), *solids)] if solids else []


def distance_of(kinds: list[Any], ground: bool, point: Point) -> Number:
    """Signed distance of a point from the nearest of some solids, m; infinity where there are none."""
    distances = [jnp.full((), jnp.inf, point.dtype)]
    if ground:
        distances.append(point[2])
    distances += [_distance_of_kind(kind, point) for kind in kinds]
    return functools.reduce(lambda a, b: jnp.where(b < a, b, a), distances)


def nearest_of(kinds: list[Any], ground: bool, point: Point) -> Surface:
    """The nearest surface of some solids; arguments as for `distance_of`."""
    surfaces = [_no_surface(point)]
    if ground:
        surfaces.append(_nearest_on_ground(point))
    surfaces += [_surface(_nearest_obstacle(kind, point), point) for kind in kinds]
    return functools.reduce(_nearer, surfaces)


def nearest_few_of(kinds: list[Any], ground: bool, point: Point, count: int) -> Surface:
    """The nearest surfaces of each of the `count` nearest solids, nearest first.

    The leading axis has length `count`; the last ones of a smaller scene have no surface.
    """
    missing = jax.tree.map(lambda x: jnp.broadcast_to(x, (count, *x.shape)), _no_surface(point))
    surfaces = [missing] + [jax.vmap(_surface, in_axes=(0, None))(kind, point) for kind in kinds]
    if ground:
        surfaces.append(jax.tree.map(lambda x: x[None], _nearest_on_ground(point)))
    every = jax.tree.map(lambda *x: jnp.concatenate(x), *surfaces)
    index = jax.lax.top_k(-jax.lax.stop_gradient(every.distance), count)[1]
    return jax.tree.map(lambda x: x[index], every)


def touched_of(kind: Any, points: Float[Array, "m 3"], within: Number) -> Surface:
    """Nearest surface to each of several points close together, where it is nearer than `within` (m).

    Where nothing is nearer, it is the surface of an arbitrary obstacle.
    """
    index = _nearest_within(*jax.lax.stop_gradient((kind, points, within)))
    return jax.vmap(_surface)(jax.tree.map(lambda x: x[index], kind), points)


def as_floats(x: ArrayLike) -> Array:
    """Real array in its own precision."""
    x = jnp.asarray(x)
    return x.astype(jnp.result_type(x, 1.0))


def _distances(kind: Obstacle, point: Point) -> Array:
    def one(obstacle: Obstacle) -> Number:
        return jnp.where(obstacle.active, obstacle.distance(obstacle.to_local(point)), jnp.inf)

    return jax.vmap(one)(kind)


@jax.custom_jvp
def _distance_of_kind(kind: Any, point: Point) -> Number:
    return jnp.min(_distances(kind, point))


@_distance_of_kind.defjvp
def _distance_of_kind_jvp(primals: tuple, tangents: tuple) -> tuple[Number, Number]:
    def to_nearest(kind: Any, point: Point) -> Number:
        obstacle = _nearest_obstacle(kind, point)
        return jnp.where(obstacle.active, obstacle.distance(obstacle.to_local(point)), jnp.inf)

    return jax.jvp(to_nearest, primals, tangents)


def _no_surface(point: Point) -> Surface:
    return Surface(jnp.full((), jnp.inf, point.dtype), jnp.full_like(point, jnp.inf), jnp.zeros_like(point))


def _nearest_on_ground(point: Point) -> Surface:
    height = point[2]
    return Surface(height, point - along_z(height), along_z(jnp.ones_like(height)))


def _nearest_obstacle(kind: Any, point: Point) -> Any:
    """The obstacle of a kind that is nearest to a point.

    It is chosen by its index: the gradient of a minimum compares for equality, which fails where a compiler rounds the
    same number in two ways.
    """
    index = jnp.argmin(jax.lax.stop_gradient(_distances(kind, point)))
    return jax.tree.map(lambda x: x[index], kind)


def _nearest_within(kind: Any, points: Float[Array, "m 3"], within: Number) -> Int[Array, " m"]:
    """Index of the nearest obstacle to each point; arbitrary where none is nearer than `within`.

    Distances are 1-Lipschitz, so a distance from the center of the points rules out most obstacles.
    """
    center = jnp.mean(points, axis=0)
    reach = within + jnp.max(jax.vmap(length)(points - center[None]))

    def look(found: tuple[Array, Array], obstacle: Any, i: Int[Array, ""]) -> tuple[Array, Array]:
        nearest, index = found
        distances = jax.vmap(lambda point: obstacle.distance(obstacle.to_local(point)))(points)
        nearer = distances < nearest
        return jnp.where(nearer, distances, nearest), jnp.where(nearer, i, index)

    nearest = jnp.full(len(points), jnp.inf, points.dtype)
    index = jnp.zeros(len(points), jnp.argmin(nearest).dtype)
    return fold_near(kind, center, reach, look, (nearest, index))[1]


def fold_near(kind: Any, point: Point, reach: Number, look: Callable[[Any, Any, Any], Any], found: Any) -> Any:
    """Fold a function over the obstacles of a kind within `reach` (m) of a point, the nearest first; no gradient.

    `look(found, obstacle, index)` returns the next value of `found`.
    """
    kind, point, reach = jax.lax.stop_gradient((kind, point, reach))

    def is_left(carry: tuple) -> Bool[Array, ""]:
        return jnp.min(carry[0]) < reach

    def look_at_next(carry: tuple) -> tuple:
        away, found = carry
        i = jnp.argmin(away)
        return away.at[i].set(jnp.inf), look(found, jax.tree.map(lambda x: x[i], kind), i)

    return jax.lax.while_loop(is_left, look_at_next, (_distances(kind, point), found))[1]


def _surface(obstacle: Any, point: Point) -> Surface:
    local = obstacle.to_local(point)
    distance = obstacle.distance(local)
    normal = rotation.rotate(obstacle.quat, obstacle.outward(local))
    there = obstacle.active
    return Surface(
        jnp.where(there, distance, jnp.inf),
        jnp.where(there, point - distance * normal, jnp.inf),
        jnp.where(there, normal, 0),
    )


def _nearer(a: Surface, b: Surface) -> Surface:
    return jax.tree.map(functools.partial(jnp.where, b.distance < a.distance), b, a)
