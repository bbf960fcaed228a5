"""The scene of an environment: the same in every episode, or drawn anew, and who honors its obstacles."""

from __future__ import annotations

from collections.abc import Callable

import jax

from jaxdrones.checks import shown
from jaxdrones.engine.step import HostStep, Step
from jaxdrones.errors import UserError
from jaxdrones.sensing import Scene
from jaxdrones.tasks.task import Task, World

DrawScene = Callable[[jax.Array], Scene]
"""(key) -> the scene of an episode."""


def example_of(scene: Scene | DrawScene) -> Scene:
    """A scene as it may be in an episode, of shapes and types if it is drawn.

    Raises:
        ValueError: it is neither a scene nor a function that draws one.
    """
    if isinstance(scene, Scene):
        return scene
    if not callable(scene):
        raise UserError(f"scene is {shown(scene)}; give a jaxdrones.sensing.Scene, or a function of a key")
    example = jax.eval_shape(scene, jax.random.key(0))
    if not isinstance(example, Scene):
        returned = shown(scene(jax.random.key(0)))
        raise UserError(f"the function that draws the scene returned {returned}; return a jaxdrones.sensing.Scene")
    return example


def are_solid(scene: Scene | DrawScene, task: Task) -> bool:
    """Whether obstacles act on drones by forces: those of a scene, unless touching them ends an episode of the task."""
    return example_of(scene).has_obstacles and ("obstacles" in task.contact or not task.obstacles_terminate)


def check_scene(scene: Scene | DrawScene, step: Step, task: Task) -> int:
    """The number of obstacles in a scene.

    Raises:
        ValueError: it is none, or neither the step nor the terminations of the task honor its obstacles.
    """
    example = example_of(scene)
    if are_solid(scene, task) and not (isinstance(step, HostStep) or step.physics.takes_scene):
        raise UserError(
            "the scene has obstacles and on the explicit backend drones would fly through them; give an effect that "
            "takes the scene, such as obstacle_contact, a task whose terminations find obstacles "
            "(obstacles_terminate), no obstacles, or take the bullet backend"
        )
    return example.count


def scene_for_step(step: Step, scene: Scene | DrawScene, world: World) -> Scene | None:
    """What a step is given at every call, of the scene of its environment; none if it needs none or was built with it.

    Args:
        step: of either backend.
        scene: of the environment.
        world: an episode of it.
    """
    if isinstance(step, HostStep):
        return None if isinstance(scene, Scene) else world.scene
    return step.physics.seen(world.scene)
