"""Checks of the starts of episodes against random vehicles and the scene."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxdrones import vehicles
from jaxdrones.checks import is_concrete
from jaxdrones.envs.randomize import AnyVehicle
from jaxdrones.errors import UserError
from jaxdrones.params import Params
from jaxdrones.sensing import Scene
from jaxdrones.tasks.task import Randomization, Task

_DRAWS = 16


def check_starts(randomize: Sequence[Randomization], task: Task, params: Params, scene: Scene) -> None:
    """Raise if the drones of a team would start in each other with the largest vehicle that an episode may draw."""
    heaviest = next((one.heaviest for one in randomize if isinstance(one, AnyVehicle)), None)
    if heaviest is None or len(params.mass) == 1:
        return
    radius = jnp.full_like(params.collision_radius, vehicles.largest_radius(heaviest))
    widest = params.replace(collision_radius=radius)
    try:
        jax.eval_shape(lambda key, scene: task.begin(key, widest, scene, 1.0), jax.random.key(0), scene)
    except UserError as error:
        raise UserError(f"with AnyVehicle(heaviest={heaviest:g}) {error}") from None


def check_free_starts(task: Task, params: Params, scene: Scene) -> None:
    """Raise if some drone starts inside an obstacle of a concrete scene in every one of 16 starts.

    Scenes with meshes or URDF files have no distances, and are not checked.
    """
    if not scene.has_obstacles or scene.meshes or scene.urdfs or not all(map(is_concrete, jax.tree.leaves(scene))):
        return

    def inside(key: jax.Array) -> Array:
        drones, _ = task.begin(key, params, scene, 1.0)
        return jnp.any(jax.vmap(scene.contains)(drones.pos))

    found = jax.jit(jax.vmap(inside))(jax.random.split(jax.random.key(0), _DRAWS))
    if is_concrete(found) and np.all(np.asarray(found)):
        raise UserError(
            f"scene: in each of {_DRAWS} starts of {task.name} a drone is inside an obstacle; move the obstacles, or "
            "give a task with another start"
        )
