"""Camera images as observations (equation 9 of Panerati et al. 2021), on either backend."""

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Annotated, Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdrones.accelerate.where_needed import where_needed
from jaxdrones.arguments import checked, choices
from jaxdrones.engine.step import HostStep, Step, is_traced
from jaxdrones.envs.functions import DrawScene
from jaxdrones.errors import UserError
from jaxdrones.params import Params
from jaxdrones.sensing import Camera, Images, Scene, render
from jaxdrones.sensing.camera import OneCamera
from jaxdrones.sensing.sensor import is_due
from jaxdrones.state import State
from jaxdrones.tasks.task import IMAGES, World

_PIXELS = 16384  # computed at a time, to fit in a cache
_PIXELS_OF_STARTS = 2048  # the same for starts of episodes, which are few in a step


class ImageSpace(NamedTuple):
    """Space of an image of one drone."""

    shape: tuple[int, ...]
    dtype: type
    low: float
    high: float
    meaning: str
    """Meaning and unit of a value."""


@dataclasses.dataclass(frozen=True)
class Vision:
    """Images of the camera on every drone of a team, with the camera's rate, latency and noise.

    An image is taken at the end of a control step, observed after the latency, and held until the next one. The first
    image is from the start of the episode.
    """

    images: tuple[str, ...]
    """Any of `rgb`, `depth`, `segmentation`."""
    camera: Camera
    render: Callable[[Params, State, Scene], Images]
    """Function that renders the images of a team."""
    on_host: bool
    """Whether `render` runs outside of JAX, one image after the other."""

    def __str__(self) -> str:
        width, height = self.camera.resolution
        rate = f" at {self.camera.rate:g} images/s" if self.camera.rate else ""
        late = f", {self.camera.latency:g} s late" if self.camera.latency else ""
        return f"{' and '.join(self.images)} of {width} x {height} pixels{rate}{late}"

    def every(self, dt: float) -> float:
        """Control steps of `dt` (s) between images; the k-th one is from the first step at or after k times as many.

        Raises:
            ValueError: more images than control steps.
        """
        every = 1.0 if self.camera.rate is None else 1 / (self.camera.rate * dt)
        every = round(every) if abs(every - round(every)) < 1e-6 * every else every
        if every < 1:
            raise UserError(
                f"the rate of the camera is {self.camera.rate:g} images/s; give at most the control rate, {1 / dt:g}, "
                "or a higher control_hz"
            )
        return every

    def delay(self, dt: float) -> int:
        """Control steps of `dt` (s) between the exposure and the observation of an image."""
        return round(self.camera.latency / dt)

    def is_due(self, step: Array, dt: float) -> Array:
        """Whether a new image is observed after a control step of `dt` (s)."""
        exposed = step - self.delay(dt)
        return is_due(exposed, self.every(dt)) & (exposed > 0)

    def look(self, params: Params, drones: State, scene: Scene) -> dict[str, Array]:
        """Images of a state, without noise."""
        images = self.render(params, drones, scene)
        return {name: getattr(images, name) for name in self.images}

    def first(self, key: Any, world: World) -> World:
        """World at the start of an episode with its images."""
        pose = _pose(world.drones)
        poses = jnp.tile(pose[None], (self.delay(world.dt), 1, 1))
        return world.replace(images=self._exposed(key, world.params, pose, world.scene), poses=poses)

    def next(self, key: Any, world: World) -> World:
        """World after a control step with its images."""
        poses = jnp.concatenate([world.poses, _pose(world.drones)[None]])
        if self.every(world.dt) == 1:
            images = self._exposed(key, world.params, poses[0], world.scene)
        else:
            images = self._where(self.is_due(world.step, world.dt), _PIXELS, key, world, poses[0])
        return world.replace(images=images, poses=poses[1:])

    def renewed(self, key: Any, world: World, ended: Array) -> World:
        """World with initial images where an episode has ended."""
        pose = _pose(world.drones)
        poses = jnp.where(ended, pose[None], world.poses)
        return world.replace(images=self._where(ended, _PIXELS_OF_STARTS, key, world, pose), poses=poses)

    def spaces(self, drones: int, obstacles: int) -> dict[str, ImageSpace]:
        """Spaces of the images of one drone, by name."""
        width, height = self.camera.resolution
        shape = (height, width)
        known = {
            "rgb": ImageSpace((*shape, 4), np.uint8, 0, 255, "red, green, blue and opacity"),
            "depth": ImageSpace(
                shape, np.float32, 0.0, self.camera.far, "m along the viewing axis; the upper bound for the background"
            ),
            "segmentation": ImageSpace(
                shape, np.int32, -1, drones + obstacles, "-1 background, 0 ground, then the drones, then the obstacles"
            ),
        }
        return {name: known[name] for name in self.images}

    def _where(self, due: Any, pixels: int, key: Any, world: World, pose: Array) -> dict[str, Array]:
        """New images where they are due, in chunks of pixels; elsewhere the images of the world."""
        args = key, world.params, pose, world.scene
        if self.on_host and not is_traced((due, world.images, args)):
            return self._exposed(*args) if due else world.images
        worlds = 1 if self.on_host else max(1, pixels // (len(pose) * math.prod(self.camera.resolution)))
        return where_needed(self._exposed, chunk=worlds)(due, *args, otherwise=world.images)

    def _exposed(self, key: Any, params: Params, pose: Float[Array, "n 7"], scene: Scene) -> dict[str, Array]:
        """Images from these poses, with noise."""
        images = self.look(params, State.at_rest(pose[:, :3]).replace(quat=pose[:, 3:]), scene)
        if self.camera.noise is not None and "depth" in images:
            images["depth"] = self.camera.noise.apply(key, images["depth"], self.camera)
        return images


def observation(vector: Float[Array, "n d"], world: World) -> Any:
    """Observation vector, or with images a dictionary of `state` and the images."""
    return {"state": vector, **world.images} if world.images else vector


@checked
def make_vision(
    step: Step,
    images: Annotated[Sequence[str], choices("image", IMAGES, "'depth'")],
    camera: OneCamera,
    scene: Scene | DrawScene,
) -> Vision:
    """Build the vision of an environment: images of the camera on every drone.

    A Bullet step renders the images itself, and was built with the scene unless that is random.
    """
    drawn = not isinstance(scene, Scene)

    def take(params: Params, drones: State, scene: Scene) -> Images:
        if isinstance(step, HostStep):
            return step.camera(params, drones, camera, scene if drawn else None)
        return render(scene, params, drones, camera)

    return Vision(tuple(images), camera, take, isinstance(step, HostStep))


def _pose(drones: State) -> Float[Array, "n 7"]:
    return jnp.concatenate([drones.pos, drones.quat], axis=-1)
