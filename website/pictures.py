"""Makes docs/images/tasks: a film of the flight in the demo, NAME.webp, or for other tasks the first moment, NAME.png.

    python website/pictures.py [NAME ...]

It needs Chromium or Chrome, the extra `video`, and the viewer's page, which `make viewer` builds.
"""

import dataclasses
import io
import sys
import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from PIL import Image

import jaxdrones as jd
from jaxdrones import assets
from jaxdrones.envs import TASKS
from jaxdrones.sensing import photograph
from jaxdrones.visualization import drawn_film
from jaxdrones.visualization.browser import open_tab
from jaxdrones.visualization.viewer.gallery import read_exhibits
from jaxdrones.visualization.viewer.page import Page
from jaxdrones.visualization.viewer.show import records_of

VIEWS = {  # task among obstacles -> where the camera is and what it looks at, m, world
    "gates": ((-2.6, -2.6, 2.4), (0.2, 0.0, 0.6)),
    "forest": ((-6.0, -9.0, 8.0), (8.0, 0.0, 0.0)),
}
_SIZE = (640, 360)  # pixels
_FPS, _LONGEST = 12, 6.0  # frames per second, and s, of a film


def main() -> None:
    """Write the pictures of the named tasks, by default of all."""
    folder = Path(__file__).parent.parent / "docs" / "images" / "tasks"
    folder.mkdir(parents=True, exist_ok=True)
    flights = {exhibit.name: exhibit for exhibit in read_exhibits(assets.folder() / "demo")}
    for name in sys.argv[1:] or TASKS:
        if name not in flights:
            Image.fromarray(_picture(name)).quantize(64).save(folder / f"{name}.png", optimize=True)
            continue
        first, *others = _film(Page(name, flights[name].payload))
        file = folder / f"{name}.webp"
        first.save(file, save_all=True, append_images=others, duration=1000 / _FPS, loop=0, quality=50, method=6)
        print(f"wrote {file.name}, {file.stat().st_size / 1e3:.0f} kB")


def _film(page: Page) -> list[Image.Image]:
    """Frames of the page, the whole flight in real time, or its first seconds."""
    with open_tab() as tab, tempfile.TemporaryDirectory() as folder:
        tab.open(page.save(Path(folder) / "page.html"), *_SIZE)
        tab.run("jaxdrones.film('orbit')")
        tab.press("l")  # no names
        count = round(_FPS * min(_LONGEST, tab.run("jaxdrones.player.end")))
        frames = []
        for k in range(count):
            tab.run(f"jaxdrones.frameAt({k / _FPS}, {1 / _FPS})")
            frames.append(Image.open(io.BytesIO(tab.screenshot())).convert("RGB"))
    return frames


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
