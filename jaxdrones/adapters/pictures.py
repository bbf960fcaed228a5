"""Pictures of teams from the side, for `render_mode="rgb_array"`."""

from typing import Annotated, Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdrones.arguments import choice
from jaxdrones.engine.step import HostStep
from jaxdrones.envs import Env
from jaxdrones.sensing import Camera, photograph
from jaxdrones.tasks.task import World

MODES = ["rgb_array"]
RenderMode = Annotated[str | None, choice("render_mode", MODES)]
_CAMERA = Camera(resolution=(640, 480), field_of_view=60.0)
_DIRECTION = np.array([-1.2, 0.9, 0.6])  # from the middle of the team to the camera, with the sun behind it
_AT_A_TIME = 8  # pictures of worlds at a time, to fit in a cache


def wanted(render_mode: str | None, begun: bool, error: type[Exception] = gymnasium.error.ResetNeeded) -> bool:
    """Whether `render` draws; a warning without a render mode, and the error before the first reset."""
    if render_mode is None:
        gymnasium.logger.warn('render is called without a render mode; make it with render_mode="rgb_array"')
    elif not begun:
        raise error("render is called before reset; call reset")
    return render_mode is not None


def of_world(env: Env, world: World) -> np.ndarray:
    """Picture of a team, RGB (480, 640, 3) uint8, by the explicit renderer, or by Bullet on its backend."""
    if not isinstance(env.physics, HostStep):
        return np.array(_picture(world))
    eye, center = map(np.asarray, _side(world))
    bullet: Any = env.physics
    return bullet.photo(world.params, world.drones, eye, center, _CAMERA, scene=world.scene)


def of_worlds(env: Env, worlds: World) -> np.ndarray:
    """Pictures of worlds with a leading axis: (worlds, 480, 640, 3)."""
    if not isinstance(env.physics, HostStep):
        return np.array(_pictures(worlds))
    count = len(worlds.drones.pos)
    return np.stack([of_world(env, jax.tree.map(lambda x, i=i: x[i], worlds)) for i in range(count)])


def _side(world: World) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
    """Position of a camera that sees the whole team, and the middle of the team, m, world.

    Drones that left the world, which are far away, do not count, unless all have left.
    """
    pos, shown = world.drones.pos, (world.active | ~jnp.any(world.active))[:, None]
    center = jnp.mean(pos, axis=0, where=shown)
    reach = 1.0 + jnp.max(jnp.where(shown, jnp.abs(pos - center[None]), 0))
    return center + reach * jnp.asarray(_DIRECTION, pos.dtype), center


def _of(world: World) -> Array:
    return photograph(world.scene, world.params, world.drones, *_side(world), _CAMERA)


_picture = jax.jit(_of)
_pictures = jax.jit(lambda worlds: jax.lax.map(_of, worlds, batch_size=_AT_A_TIME))
