"""Distances of points from what stands around."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float
from numpy.typing import ArrayLike

from jaxdrones.checks import check_shape
from jaxdrones.sensing.scene import Scene, check_scene


def distance(scene: Scene, point: ArrayLike) -> Float[Array, ""]:
    """Signed distance of a point from the nearest surface of a scene, m; negative inside an obstacle or underground.

    It is differentiable in the point and in the scene. Of obstacles that overlap, the one in which the point is deepest
    counts.

    Args:
        scene: of one world.
        point: (3,) m, world; for many points use `jax.vmap`.

    Returns:
        () m; infinity in a scene without anything.

    Raises:
        ValueError: a wrong shape, or a mesh or URDF file in the scene.
    """
    check_scene(scene)
    point = as_floats(point)
    check_shape("point", point, (3,), "x, y, z of one point; for many use jax.vmap")
    distances = [jnp.full((), jnp.inf, point.dtype)]
    if scene.ground:
        distances.append(point[2])
    for shapes in scene.shapes(point.dtype):
        distances.append(jnp.min(jax.vmap(lambda shape: shape.distance(shape.to_local(point)))(shapes)))
    return jnp.min(jnp.stack(distances))


def contains(scene: Scene, point: ArrayLike) -> Bool[Array, ""]:
    """Whether a point (3,) (m, world) is inside an obstacle or underground."""
    return distance(scene, point) < 0


def as_floats(x: ArrayLike) -> Array:
    """An array of real numbers, in the precision that it has."""
    x = jnp.asarray(x)
    return x.astype(jnp.result_type(x, 1.0))
