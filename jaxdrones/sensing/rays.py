"""Rays through what stands around: what a range finder or a camera sees."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from jaxdrones import rotation
from jaxdrones.checks import check_shape
from jaxdrones.sensing.distances import as_floats
from jaxdrones.sensing.scene import Scene, check_scene
from jaxdrones.sensing.shapes import Obstacle
from jaxdrones.vector import components


def ray(scene: Scene, origin: ArrayLike, direction: ArrayLike) -> Float[Array, ""]:
    """Distance along a ray to the first surface of a scene that it hits, m; zero where it starts inside.

    It is differentiable in the ray and in the scene.

    Args:
        scene: of one world.
        origin: (3,) m, world; for many rays use `jax.vmap`.
        direction: (3,) unit vector, world. If it has another length, the distance is in multiples of that length.

    Returns:
        () m; infinity, with a zero gradient, where nothing is hit.

    Raises:
        ValueError: a wrong shape, or a mesh or URDF file in the scene.
    """
    check_scene(scene)
    origin, direction = as_floats(origin), as_floats(direction)
    for name, value in ("origin", origin), ("direction", direction):
        check_shape(name, value, (3,), "x, y, z of one ray; for many use jax.vmap")
    hits = [jnp.full((), jnp.inf, origin.dtype)]
    if scene.ground:
        hits.append(_to_ground(origin, direction))
    for shapes in scene.shapes(origin.dtype):
        hits.append(jnp.min(jax.vmap(_to_shape, (0, None, None))(shapes, origin, direction)))
    return jnp.min(jnp.stack(hits))


def _to_shape(shape: Obstacle, origin: Float[Array, "3"], direction: Float[Array, "3"]) -> Float[Array, ""]:
    local_origin, local_direction = shape.to_local(origin), rotation.rotate_inverse(shape.quat, direction)
    first, last = shape.interval(components(local_origin), components(local_direction))
    return jnp.where((first <= last) & (last >= 0) & shape.active, jnp.maximum(first, 0), jnp.inf)


def _to_ground(origin: Float[Array, "3"], direction: Float[Array, "3"]) -> Float[Array, ""]:
    height, climb = origin[2], direction[2]
    descends = climb < -jnp.finfo(climb.dtype).eps
    far = jnp.where(descends, -height / jnp.where(descends, climb, -1), jnp.inf)
    return jnp.where(height > 0, far, 0)
