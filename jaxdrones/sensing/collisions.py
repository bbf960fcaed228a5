"""Collision flags of a team; they depend on poses alone and are the same on every backend."""

from typing import Annotated

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from jaxdrones import rotation
from jaxdrones.arguments import checked, number
from jaxdrones.checks import check_shape
from jaxdrones.params import Params
from jaxdrones.pytree import PyTreeNode
from jaxdrones.sensing.distances import fold_near, merged
from jaxdrones.sensing.geometry import around_z, length
from jaxdrones.sensing.scene import AnalyticScene, Scene
from jaxdrones.sensing.shapes import Cylinder, Obstacle
from jaxdrones.state import State, TeamState
from jaxdrones.vector import dot, safe_sqrt, unit

_MARGIN = 1e-3  # m; a drone at rest is 0.01 mm (Bullet) or 1.5 mm (`ground_contact`) inside the ground
_ROUNDING = 1e-3  # m: the search reaches a little farther than contact
_PROJECTIONS = 8  # of random pairs of cf2x within 0.2 m 0.5 % then touch up to 6 mm too early
_BARE = Scene()


class Collisions(PyTreeNode):
    """Contacts of each drone of a team with the ground, other drones and obstacles."""

    ground: Array
    """(n,) bool."""
    drones: Array
    """(n,) bool: another drone of the team."""
    scene: Array
    """(n,) bool: an obstacle."""


@checked
def collisions(
    params: Params,
    state: TeamState,
    scene: AnalyticScene = _BARE,
    margin: Annotated[ArrayLike, number("m", at_least=0)] = _MARGIN,
) -> Collisions:
    """Compute which drones of a team touch the ground, another drone or an obstacle; velocities do not matter.

    A drone is its collision cylinder. The contact `balls` of both backends lie inside it; they reach its faces and rim,
    not its edges. `margin` is the largest gap that counts as contact, m.

    Raises:
        ValueError: a wrong shape, a mesh or URDF file in the scene, or a negative margin.
    """
    n = len(state.pos)
    hint = f"state.pos has {n} drones; make a team with jaxdrones.repeat or jaxdrones.stack"
    for name in "collision_radius", "collision_height", "collision_offset":
        check_shape(f"params.{name}", getattr(params, name), (n,), hint)
    bodies = _bodies(params, state)
    touched = jnp.zeros(n, bool)
    for obstacles in merged(scene.shapes(bodies.pos.dtype)):
        touched |= _touch_any(bodies, obstacles, margin)
    return Collisions(
        ground=jax.vmap(_lowest)(bodies) <= margin if scene.ground else jnp.zeros_like(touched),
        drones=_touch_each_other(bodies, margin),
        scene=touched,
    )


def _bodies(params: Params, state: State) -> Cylinder:
    """The collision cylinders of a team: one obstacle each, with a leading axis over the drones."""

    def body(params: Params, state: State) -> Cylinder:
        center = state.pos + params.collision_offset * rotation.z_axis(state.quat)
        return Cylinder(pos=center, quat=state.quat, radius=params.collision_radius, height=params.collision_height)

    return jax.vmap(body)(params, state)


def _lowest(body: Cylinder) -> Float[Array, ""]:
    """World z of the lowest point, m."""
    up = jnp.array([0, 0, 1], body.pos.dtype)
    return body.pos[2] - body.extent(rotation.rotate_inverse(body.quat, up))


def met_on_the_way(params: Params, state: State, before: Float[Array, "n 3"], margin: ArrayLike) -> Bool[Array, " n"]:
    """Which drones of a team touched another one where their centers were closest on straight ways from `before`, m.

    All keep the attitude of the `state` at the end. Bodies that only graze each other may have touched elsewhere.
    """
    return _touch_each_other(_bodies(params, state), margin, state.pos - before)


def _touch_each_other(
    bodies: Cylinder, margin: ArrayLike, ways: Float[Array, "n 3"] | None = None
) -> Bool[Array, " n"]:
    """Whether each drone touches another one; with `ways` (m) at the closest approach of their centers on these."""
    index = jnp.arange(len(bodies.pos))
    ways = jnp.zeros_like(bodies.pos) if ways is None else ways

    def with_other(i, body, way, j, other, other_way):
        moved = way - other_way
        square = dot(moved, moved)
        back = jnp.clip(dot(body.pos - other.pos, moved) / jnp.where(square > 0, square, 1), 0, 1)
        return (i != j) & (_gap(body.replace(pos=body.pos - back * moved), other) <= margin)

    with_others = jax.vmap(with_other, (None, None, None, 0, 0, 0))
    touch = jax.vmap(with_others, (0, 0, 0, None, None, None))(index, bodies, ways, index, bodies, ways)
    return jnp.any(touch, axis=1)


def _touch_any(bodies: Cylinder, obstacles: Obstacle, margin: ArrayLike) -> Bool[Array, " n"]:
    """Whether each drone touches any of the obstacles of a kind."""

    def touches_one(body: Cylinder) -> Bool[Array, ""]:
        def look(touched: Array, obstacle: Obstacle, _: Array) -> Array:
            return touched | (_gap(body, obstacle) <= obstacle.rounding + margin)

        farthest = length(jnp.stack([body.radius, body.height / 2]))  # point of the body from its center
        return fold_near(obstacles, body.pos, farthest + margin + _ROUNDING, look, jnp.zeros((), bool))

    return jax.vmap(touches_one)(jax.lax.stop_gradient(bodies))


def _gap(body: Cylinder, obstacle: Obstacle) -> Float[Array, ""]:
    """Distance of a drone from the core of an obstacle, m; not positive if they overlap.

    It is the widest gap along a set of candidate directions, a lower bound of the distance: the usual separating
    directions of such bodies, and that between the nearest points, found by alternating projections.
    """
    center = obstacle.to_local(body.pos)
    axis = rotation.rotate_inverse(obstacle.quat, rotation.z_axis(body.quat))
    half_height = body.height / 2

    def nearest_of_body(point: Float[Array, "3"]) -> Float[Array, "3"]:
        offset = point - center
        height = dot(offset, axis)
        radial = offset - height * axis
        inward = jnp.minimum(1, body.radius / jnp.maximum(safe_sqrt(dot(radial, radial)), body.radius))
        return center + inward * radial + jnp.clip(height, -half_height, half_height) * axis

    def along(direction: Float[Array, "3"]) -> Float[Array, ""]:
        cosine = dot(direction, axis)
        extent = half_height * jnp.abs(cosine) + body.radius * safe_sqrt(1 - cosine**2)
        return jnp.abs(dot(direction, center)) - extent - obstacle.extent(direction)

    def project(_, point: Float[Array, "3"]) -> Float[Array, "3"]:
        return obstacle.nearest(nearest_of_body(point))

    on_obstacle = jax.lax.fori_loop(0, _PROJECTIONS, project, jnp.zeros_like(center))
    radial = center - dot(center, axis) * axis
    directions = [on_obstacle - nearest_of_body(on_obstacle), center, axis, radial, *around_z(center, axis)]
    directions += list(jnp.eye(3, dtype=center.dtype)[:2])
    return jnp.max(jax.vmap(lambda direction: along(unit(direction)))(jnp.stack(directions)))
