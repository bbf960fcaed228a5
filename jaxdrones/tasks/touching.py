"""Collision flags of a world, and their use as task variables."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxdrones.accelerate.where_needed import where_needed
from jaxdrones.dynamics.contact import rim
from jaxdrones.params import Params
from jaxdrones.sensing import Collisions, Scene, collisions
from jaxdrones.sensing.collisions import met_on_the_way
from jaxdrones.sensing.distances import merged
from jaxdrones.sensing.sweep import Disc, meets
from jaxdrones.state import State
from jaxdrones.tasks import shaping
from jaxdrones.tasks.task import Task, World, norm
from jaxdrones.vector import safe_sqrt

_MARGIN = 1e-3  # m: largest gap that counts as contact
_ONE_IN = 8  # worlds: in forests and rooms usually fewer have something nearby


def touches(
    world: World, before: Float[Array, "n 3"], scene: Scene | None = None, *, passing: bool = False
) -> Collisions:
    """Collision flags of a world by `jaxdrones.sensing.collisions`, with a sweep from the positions `before`.

    Under `vmap`, only worlds with something within reach are computed. By default the scene is that of the world. The
    sweep is among obstacles, and with `passing` among the drones, too.
    """
    scene = world.scene if scene is None else scene
    args = jax.lax.stop_gradient((world.params, world.drones, before, scene))
    found = _found_also_passing if passing and len(before) > 1 else _found
    return Collisions(*where_needed(found, one_in=_ONE_IN)(jnp.any(_near(*args)), *args))


def balls_meet(world: World, before: Float[Array, "n 3"]) -> Bool[Array, " n"]:
    """Whether the ball of a collision radius about each drone met an obstacle or the ground on the straight way.

    The way begins at the positions `before`. Obstacles are swept only in worlds in which one is within reach.
    """
    params, pos = world.params, world.drones.pos
    gap = shaping.gap(params, pos, world.scene)

    def swept(radius: Array, scene: Scene, before: Array, pos: Array) -> Array:
        kinds = merged(scene.shapes(pos.dtype))
        zero, level = jnp.zeros((), pos.dtype), jnp.array([0.0, 0, 0, 1], pos.dtype)

        def meets_obstacle(radius: Array, before: Array, pos: Array) -> Array:
            start, end = (Disc.of(at, level, zero, zero, radius) for at in (before, pos))
            return meets(kinds, start, end)

        return jax.vmap(meets_obstacle)(radius, before, pos)

    within_reach = jnp.any(gap <= norm(pos - before))
    args = jax.lax.stop_gradient((params.collision_radius, world.scene, before, pos))
    return (gap < 0) | where_needed(swept, one_in=_ONE_IN)(within_reach, *args)


def variables(params: Params, pos: Float[Array, "n 3"], scene: Scene) -> dict[str, Array]:
    """Variables of `advance` at the start of an episode, at these positions."""
    gap = shaping.gap(params, pos, scene)
    return {"pos": pos, "clearance": gap, "touched": jnp.zeros(len(pos), bool)}


def advance(task: Task, world: World) -> dict[str, Array]:
    """Task variables after a step: positions `pos`, smallest `clearance` (m) so far, and whether a drone `touched`."""
    before, pos = world.variables, world.drones.pos
    found = touches(world, before["pos"], passing=True)
    return before | {
        "pos": pos,
        "clearance": jnp.minimum(before["clearance"], shaping.gap(world.params, pos, world.scene)),
        "touched": before["touched"] | found.ground | found.drones | found.scene,
    }


METRICS = {
    "touched": shaping.variable("touched", "One if the drone has touched something."),
    "clearance": shaping.variable("clearance", "Smallest distance from obstacles and ground so far, m."),
}
"""Metrics of the variables of `advance`."""


def _found(params: Params, drones: State, before: Array, scene: Scene) -> tuple[Array, Array, Array]:
    found = collisions(params, drones, scene, _MARGIN)
    if not scene.has_obstacles:
        return found.ground, found.drones, found.scene
    kinds = merged(scene.shapes(before.dtype))

    def meets_obstacle(params: Params, drone: State, before: Array) -> Array:
        radius, ring = rim(params)
        start, end = (
            Disc.of(pos, drone.quat, params.collision_offset, ring, radius + _MARGIN) for pos in (before, drone.pos)
        )
        return meets(kinds, start, end)

    return found.ground, found.drones, found.scene | jax.vmap(meets_obstacle)(params, drones, before)


def _found_also_passing(params: Params, drones: State, before: Array, scene: Scene) -> tuple[Array, Array, Array]:
    ground, others, obstacles = _found(params, drones, before, scene)
    return ground, others | met_on_the_way(params, drones, before, _MARGIN), obstacles


def _near(params: Params, drones: State, before: Array, scene: Scene) -> Bool[Array, " n"]:
    """Whether an obstacle, the ground or another drone is within the ball about each drone."""
    half = params.collision_height / 2
    ball = jnp.abs(params.collision_offset) + safe_sqrt(params.collision_radius**2 + half**2) + _MARGIN
    reach = ball + norm(drones.pos - before)
    near = jax.vmap(scene.distance)(drones.pos) <= reach
    for k in range(1, len(reach)):
        near |= norm(jnp.roll(drones.pos, k, axis=0) - drones.pos) <= jnp.roll(reach, k) + reach
    return near
