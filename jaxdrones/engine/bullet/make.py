"""`make_step` of the Bullet backend."""

from collections.abc import Sequence
from typing import Annotated

import jax

from jaxdrones.arguments import Count, TimeStep, checked, choice, number
from jaxdrones.dynamics.model import Model
from jaxdrones.dynamics.rotors import instant_rotors
from jaxdrones.engine.bullet.client import BALLS, CYLINDER, EGL, TINY, Client
from jaxdrones.engine.bullet.step import BulletStep
from jaxdrones.engine.neighbors import NeighborGrid
from jaxdrones.engine.physics import Physics, Rotors
from jaxdrones.engine.step import is_traced
from jaxdrones.engine.wrenches import Effect, Pair, TeamEffect, describe
from jaxdrones.errors import UserError
from jaxdrones.sensing import Scene
from jaxdrones.sensing.scene import AnyScene


@checked
def make_step(
    effects: Sequence[Effect] = (),
    pairs: Sequence[Pair] = (),
    rotors: Rotors = instant_rotors,
    dt: TimeStep = 1 / 240,
    substeps: Count = 1,
    *,
    team_effects: Sequence[TeamEffect] = (),
    models: Sequence[Model] = (),
    neighbors: NeighborGrid | None = None,
    scene: AnyScene | None = None,
    damping: Annotated[float, number("1/s", at_least=0)] = 0.0,
    collision: Annotated[str, choice("collision shape", (BALLS, CYLINDER))] = BALLS,
    renderer: Annotated[str, choice("renderer", (TINY, EGL))] = TINY,
    gui: bool = False,
) -> BulletStep:
    """Build the step of a world with Bullet as integrator and contact solver.

    Arguments are those of the explicit backend, without `ground_contact`, `obstacle_contact` and `drone_contact`. By
    default there is a ground plane. The states of models take explicit Euler steps of `dt`, as rotors do. `damping` is
    Bullet's linear and angular damping, 1/s; that of gym-pybullet-drones is 0.04. `collision` is `balls`, a ring of
    balls on a disc, stable at rest and in rebounds, or `cylinder`, the shape in gym-pybullet-drones. The `renderer` of
    cameras is `tiny`, on the CPU, or `egl`, on a GPU. `gui` opens a window, in which the cameras then render, too.

    Returns:
        `step(params, state, rpm) -> state`, a context manager that closes the connection. Rotor speeds are limited to
        [0, `params.max_rpm`].

    Raises:
        ValueError: an argument out of range, or contact as an effect: Bullet resolves it already.
        ImportError: pybullet is not installed.
        OSError: `gui` without a display.
    """
    physics = Physics(effects, pairs, team_effects, models, rotors, neighbors)
    contacts = physics.contacts("ground", "obstacles", "drones")
    if contacts:
        raise UserError(
            f"{describe(contacts)} is given and Bullet resolves contacts by itself, so drones would touch twice; "
            "leave it out"
        )
    scene = Scene() if scene is None else scene
    if is_traced(scene):
        raise UserError(
            "the scene is traced by jit, vmap or grad and has no values yet; make the step outside, of a scene of "
            "numbers, and give the traced one to its calls"
        )
    client = Client(dt, damping, collision, renderer, gui)
    return BulletStep(client, physics, substeps, dt, jax.device_get(scene))
