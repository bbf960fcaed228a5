"""Images of the drones' cameras as an observation (equation 9 of the paper)."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import numpy as np

from jaxdrones.engine.step import is_traced
from jaxdrones.params import Params
from jaxdrones.state import State
from jaxdrones.tasks.task import World

IMAGES = {"rgb": (np.uint8, 4), "depth": (np.float32, None), "segmentation": (np.int32, None)}


@dataclasses.dataclass(frozen=True)
class Vision:
    """Images of every drone's camera: `rgb` (n, 48, 64, 4), `depth` (n, 48, 64) (m), `segmentation` (n, 48, 64)."""

    physics: Any
    """A Bullet step, which renders the images."""
    every: int = 1
    """Control steps between images; in between the last one is observed again."""
    images: tuple[str, ...] = ("rgb",)
    """Which of `rgb`, `depth`, `segmentation`."""

    def look(self, params: Params, drones: State) -> dict[str, Any]:
        """The images of a state."""
        rgb, depth, segmentation = self.physics.camera(params, drones)
        pictures = {"rgb": rgb, "depth": depth, "segmentation": segmentation}
        return {name: pictures[name] for name in self.images}

    def next(self, world: World) -> dict[str, Any]:
        """The images after a control step."""
        due = world.step % self.every == 0
        if self.every == 1:
            return self.look(world.params, world.drones)
        if not is_traced((world.drones, due)):
            return self.look(world.params, world.drones) if due else world.images

        @jax.custom_batching.sequential_vmap  # else, of many worlds, each would render an image in every step
        def shown(due, params, drones, before):
            return jax.lax.cond(due, lambda: self.look(params, drones), lambda: before)

        return shown(due, world.params, world.drones, world.images)
