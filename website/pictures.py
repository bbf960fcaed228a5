"""Makes docs/images/tasks/NAME.png: the start of an episode of every task.

python website/pictures.py [NAME ...]
"""

import dataclasses
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from PIL import Image

import jaxdrones as jd
from jaxdrones.envs import TASKS
from jaxdrones.sensing import photograph
from jaxdrones.visualization import drawn_film
from jaxdrones.visualization.viewer.show import records_of

VIEWS = {  # task among obstacles -> where the camera is and what it looks at, m, world
    "gates": ((-2.6, -2.6, 2.4), (0.2, 0.0, 0.6)),
    "forest": ((-6.0, -9.0, 8.0), (8.0, 0.0, 0.0)),
}
_SIZE = (640, 360)  # pixels


def main() -> None:
    """Write the pictures of the named tasks, by default of all."""
    folder = Path(__file__).parent.parent / "docs" / "images" / "tasks"
    folder.mkdir(parents=True, exist_ok=True)
    for name in sys.argv[1:] or TASKS:
        Image.fromarray(_picture(name)).quantize(64).save(folder / f"{name}.png", optimize=True)


def _picture(name: str) -> np.ndarray:
    """Start of an episode: with obstacles from a suitable viewpoint, else the first frame of a film."""
    with jd.make(name) as env:
        world = jax.jit(env.reset)(jax.random.key(0))[1]
        target = np.asarray(env.task.target_now(world).pos)
    if name in VIEWS:
        eye, middle = map(jnp.asarray, VIEWS[name])
        camera = jd.Camera(resolution=_SIZE, field_of_view=60.0)
        return np.asarray(photograph(world.scene, world.params, world.drones, eye, middle, camera))
    row = jax.tree.map(lambda x: np.asarray(x)[None], world.drones)
    given = {"params": world.params, "dt": env.dt, "targets": target, "labels": None, "images": None}
    (record,) = records_of(row, given)
    return next(drawn_film.frames(dataclasses.replace(record, scene=world.scene), name, 1, _SIZE))


if __name__ == "__main__":
    main()
