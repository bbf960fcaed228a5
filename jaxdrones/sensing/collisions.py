"""Who touches something, from the poses alone, so that it is the same on every backend."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdrones import rotation
from jaxdrones.checks import check_shape
from jaxdrones.params import Params
from jaxdrones.sensing.scene import Box, Cylinder, Obstacle, Scene, Sphere
from jaxdrones.state import State
from jaxdrones.vector import components, cross, dot, safe_sqrt, unit

_MARGIN = 1e-3  # m; a drone at rest is 0.01 mm (Bullet) or 1.5 mm (`ground_contact`) inside the ground
_PROJECTIONS = 8  # to and fro; of random pairs of cf2x within 0.2 m 0.5 % then touch up to 6 mm too early
_BARE = Scene()


class Collisions(flax.struct.PyTreeNode):
    """What each drone of a team touches."""

    ground: Array
    """(n,) bool."""
    drones: Array
    """(n,) bool: another drone of the team."""
    scene: Array
    """(n,) bool: an obstacle."""


def collisions(params: Params, state: State, scene: Scene = _BARE, margin: float = _MARGIN) -> Collisions:
    """Who of a team touches the ground, another drone, an obstacle.

    A drone is its collision cylinder; the `balls` that touch in either backend lie inside it, and reach its faces and
    its rim but not its edges.

    Args:
        params: of a team of n drones.
        state: of the team; only its poses matter.
        scene: static; boxes, spheres and cylinders, and whether there is a ground.
        margin: gap that still counts as touching, m.

    Raises:
        ValueError: a wrong shape, a mesh or URDF in the scene, or a negative margin.
    """
    _check(params, state, scene, margin)
    n = len(state.pos)
    bodies = jax.vmap(_body)(params, state)
    return Collisions(
        ground=jax.vmap(_lowest)(bodies) <= margin if scene.ground else jnp.zeros(n, bool),
        drones=_touch_each_other(bodies, margin),
        scene=jax.vmap(lambda body: _touches_any(body, scene.obstacles, margin))(bodies),
    )


class _Cylinder(NamedTuple):
    pos: Array
    """Centre, m, world."""
    axis: Array
    """Unit vector, world."""
    radius: Array
    half: Array
    """Half the height, m."""

    def nearest(self, point: Float[Array, "3"]) -> Float[Array, "3"]:
        """The point of the body that is nearest to a point."""
        offset = point - self.pos
        height = dot(offset, self.axis)
        radial = offset - height * self.axis
        inward = jnp.minimum(1, self.radius / jnp.maximum(safe_sqrt(dot(radial, radial)), self.radius))
        return self.pos + inward * radial + jnp.clip(height, -self.half, self.half) * self.axis

    def reach(self, direction: Float[Array, "3"]) -> Float[Array, ""]:
        """How far the body extends from its centre along a unit vector: its support function."""
        along = dot(direction, self.axis)
        return self.half * jnp.abs(along) + self.radius * safe_sqrt(1 - along**2)

    def directions(self, towards: Float[Array, "3"]) -> list[Float[Array, "3"]]:
        """In which something beside it is likely to be farthest from it."""
        offset = towards - self.pos
        return [self.axis, offset - dot(offset, self.axis) * self.axis]


class _Box(NamedTuple):
    pos: Array
    """Centre, m, world."""
    quat: Array
    """Box to world."""
    half: Array
    """(3,) half the edges, m."""

    def nearest(self, point: Float[Array, "3"]) -> Float[Array, "3"]:
        offset = rotation.rotate_inverse(self.quat, point - self.pos)
        return self.pos + rotation.rotate(self.quat, jnp.clip(offset, -self.half, self.half))

    def reach(self, direction: Float[Array, "3"]) -> Float[Array, ""]:
        return dot(jnp.abs(rotation.rotate_inverse(self.quat, direction)), self.half)

    def directions(self, towards: Float[Array, "3"]) -> list[Float[Array, "3"]]:
        return rotation.axes(self.quat)


def _body(params: Params, state: State) -> _Cylinder:
    axis = rotation.z_axis(state.quat)
    center = state.pos + params.collision_offset * axis
    return _Cylinder(center, axis, params.collision_radius, params.collision_height / 2)


def _lowest(body: _Cylinder) -> Float[Array, ""]:
    """World z of the lowest point, m."""
    _, _, z = components(body.pos)
    return z - body.reach(jnp.array([0, 0, 1], body.pos.dtype))


def _touch_each_other(bodies: _Cylinder, margin: float) -> Array:
    index = jnp.arange(len(bodies.pos))

    def with_other(i, body, j, other):
        return (i != j) & (_gap(body, other, [cross(body.axis, other.axis)]) <= margin)

    with_others = jax.vmap(with_other, (None, None, 0, 0))
    return jnp.any(jax.vmap(with_others, (0, 0, None, None))(index, bodies, index, bodies), axis=1)


def _touches_any(body: _Cylinder, obstacles: Sequence[Obstacle], margin: float) -> Array:
    dtype, touches = body.pos.dtype, jnp.zeros((), bool)

    def column(values) -> Array:
        return jnp.asarray(np.array(values), dtype)

    if boxes := [o for o in obstacles if isinstance(o, Box)]:
        sides = [(o.pos, _unit(o.quat), np.array(o.size) / 2) for o in boxes]
        blocks = _Box(*(column(x) for x in zip(*sides, strict=True)))
        touches |= jnp.any(jax.vmap(lambda box: _gap(body, box, []))(blocks) <= margin)
    if cylinders := [o for o in obstacles if isinstance(o, Cylinder)]:
        sizes = [(o.pos, _z_axis(o.quat), o.radius, o.height / 2) for o in cylinders]
        pillars = _Cylinder(*(column(x) for x in zip(*sizes, strict=True)))
        touches |= jnp.any(jax.vmap(lambda c: _gap(body, c, [cross(body.axis, c.axis)]))(pillars) <= margin)
    if spheres := [o for o in obstacles if isinstance(o, Sphere)]:
        centers, radii = column([o.pos for o in spheres]), column([o.radius for o in spheres])
        apart = jax.vmap(lambda center: center - body.nearest(center))(centers)
        touches |= jnp.any(jax.vmap(dot)(apart, apart) <= (radii + margin) ** 2)
    return touches


def _gap(a: _Cylinder | _Box, b: _Cylinder | _Box, more: list[Float[Array, "3"]]) -> Float[Array, ""]:
    """The distance of two convex bodies, m; not positive if they overlap.

    The widest gap in any of some directions, which bounds the distance from below: those in which such bodies mostly
    are apart, and that between the points that projecting from one body to the other and back leads to, where they are
    nearest.
    """
    apart = b.pos - a.pos
    on_b = jax.lax.fori_loop(0, _PROJECTIONS, lambda _, point: b.nearest(a.nearest(point)), b.pos)
    directions = [on_b - a.nearest(on_b), apart, *a.directions(b.pos), *b.directions(a.pos), *more]

    def along(direction: Float[Array, "3"]) -> Float[Array, ""]:
        return jnp.abs(dot(direction, apart)) - a.reach(direction) - b.reach(direction)

    return jnp.max(jax.vmap(lambda v: along(unit(v)))(jnp.stack(directions)))


def _unit(quat: Sequence[float]) -> np.ndarray:
    return np.array(quat) / np.linalg.norm(quat)


def _z_axis(quat: Sequence[float]) -> np.ndarray:
    x, y, z, w = _unit(quat)
    return np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])


def _check(params: Params, state: State, scene: Scene, margin: float) -> None:
    hint = "one row per drone, at least one drone; for many worlds use jax.vmap"
    check_shape("state.pos", state.pos, ("n", 3), hint)
    n = len(state.pos)
    check_shape("state.quat", state.quat, (n, 4), f"state.pos has {n} drones")
    for name in "collision_radius", "collision_height", "collision_offset":
        hint = f"state.pos has {n} drones; make a team with jaxdrones.repeat or jaxdrones.stack"
        check_shape(f"params.{name}", getattr(params, name), (n,), hint)
    if not isinstance(scene, Scene):
        raise ValueError(f"scene is {scene!r}; give a jaxdrones.sensing.scene.Scene")
    for i, obstacle in enumerate(scene.obstacles):
        if not isinstance(obstacle, Box | Sphere | Cylinder):
            raise ValueError(
                f"obstacle {i} is a {type(obstacle).__name__}; collisions are found with Box, Sphere and Cylinder; "
                "for other shapes ask the Bullet backend: step.contacts(params, state)"
            )
    if not isinstance(margin, jax.core.Tracer) and not margin >= 0:
        raise ValueError(f"margin is {margin}; give a number of at least 0 (m)")
