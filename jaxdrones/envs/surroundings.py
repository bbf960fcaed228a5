"""The scene of an environment: the same in every episode, or drawn anew, and who honors its obstacles."""

from __future__ import annotations

from collections.abc import Callable

import jax

from jaxdrones.checks import shown
from jaxdrones.engine.step import HostStep, Step
from jaxdrones.sensing import Scene
from jaxdrones.tasks.task import Task, World

DrawScene = Callable[[jax.Array], Scene]
"""(key) -> the scene of an episode."""


def check_scene(scene: Scene | DrawScene, step: Step, task: Task) -> None:
    """Raise `ValueError` unless the step or the terminations of the task honor the obstacles of a scene."""
    if isinstance(scene, Scene):
        example = scene
    elif callable(scene):
        example = jax.eval_shape(scene, jax.random.key(0))
    else:
        raise ValueError(f"scene is {shown(scene)}; give a jaxdrones.sensing.Scene, or a function of a key")
    if not isinstance(example, Scene):
        returned = shown(scene(jax.random.key(0)))
        raise ValueError(f"the function that draws the scene returned {returned}; return a jaxdrones.sensing.Scene")
    if isinstance(step, HostStep):
        if scene is not example:
            raise ValueError(
                "scene is a function that draws it for every episode, and Bullet builds it once; give a Scene, or take "
                "the explicit backend"
            )
    elif example.has_obstacles and not (step.physics.takes_scene or task.obstacles_terminate):
        raise ValueError(
            "the scene has obstacles and on the explicit backend drones would fly through them; give an effect "
            "(params, state, scene) -> Wrench, a task whose terminations find obstacles (obstacles_terminate), no "
            "obstacles, or take the bullet backend"
        )


def scene_for_step(step: Step, world: World) -> Scene | None:
    """The scene that a step is given at every call; none where it was built with it, or no effect takes it."""
    return None if isinstance(step, HostStep) or not step.physics.takes_scene else world.scene
