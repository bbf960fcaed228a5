"""Makes docs/images/tasks/NAME.png: the start of an episode of gates and forest.

python website/pictures.py [NAME ...]
"""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from PIL import Image

import jaxdrones as jd
from jaxdrones.sensing import photograph

VIEWS = {  # task -> where the camera is and what it looks at, m, world
    "gates": ((-2.6, -2.6, 2.4), (0.2, 0.0, 0.6)),
    "forest": ((-6.0, -9.0, 8.0), (8.0, 0.0, 0.0)),
}
CAMERA = jd.Camera(resolution=(640, 360), field_of_view=60.0)


def main() -> None:
    """Write the pictures of the tasks that are named, or of all."""
    folder = Path(__file__).parent.parent / "docs" / "images" / "tasks"
    folder.mkdir(parents=True, exist_ok=True)
    for name in sys.argv[1:] or VIEWS:
        env = jd.make(name)
        world = jax.jit(env.reset)(jax.random.key(0))[1]
        eye, target = map(jnp.asarray, VIEWS[name])
        picture = np.asarray(photograph(world.scene, world.params, world.drones, eye, target, CAMERA))
        Image.fromarray(picture).quantize(64).save(folder / f"{name}.png", optimize=True)


if __name__ == "__main__":
    main()
