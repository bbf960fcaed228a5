"""What the drones of a world touch."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from jaxdrones.accelerate.where_needed import where_needed
from jaxdrones.params import Params
from jaxdrones.sensing import Collisions, Scene, collisions
from jaxdrones.state import State
from jaxdrones.tasks.task import World, norm
from jaxdrones.vector import safe_sqrt

_MARGIN = 1e-3  # m: gap that still counts as touching
_ONE_IN = 8  # worlds: in forests and rooms something is mostly near in fewer


def touches(world: World, scene: Scene | None = None) -> Collisions:
    """The collision flags of a world, by `jaxdrones.sensing.collisions`.

    Of many worlds, only those are computed in which something is so near that it may be touched.

    Args:
        world: of which only the poses matter.
        scene: what may be touched; that of the world when left out.
    """
    scene = world.scene if scene is None else scene
    params, drones, scene = jax.lax.stop_gradient((world.params, world.drones, scene))
    found = where_needed(_found, one_in=_ONE_IN)(jnp.any(_near(params, drones, scene)), params, drones, scene)
    return Collisions(*found)


def _found(params: Params, drones: State, scene: Scene) -> tuple[Array, Array, Array]:
    found = collisions(params, drones, scene, _MARGIN)
    return found.ground, found.drones, found.scene


def _near(params: Params, drones: State, scene: Scene) -> Bool[Array, " n"]:
    """Whether an obstacle, the ground or another drone is within the ball about each drone."""
    half = params.collision_height / 2
    ball = jnp.abs(params.collision_offset) + safe_sqrt(params.collision_radius**2 + half**2) + _MARGIN
    near = jax.vmap(scene.distance)(drones.pos) <= ball
    for k in range(1, len(ball)):
        near |= norm(jnp.roll(drones.pos, k, axis=0) - drones.pos) <= jnp.roll(ball, k) + ball
    return near
