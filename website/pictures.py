"""Makes docs/images/tasks: a film of the flight in the demo, NAME.webp, or for other tasks the start, NAME.png.

    python website/pictures.py [NAME ...]

It needs Chromium or Chrome, the extra `video`, and the viewer's page, which `make viewer` builds.
"""

import io
import sys
import tempfile
from pathlib import Path

import jax
import numpy as np
from PIL import Image

import jaxdrones as jd
from jaxdrones import assets
from jaxdrones.envs import TASKS
from jaxdrones.visualization.browser import open_tab
from jaxdrones.visualization.viewer.page import Page, read_exhibits

_SIZE = (640, 360)  # pixels
_FPS, _LONGEST = 12, 6.0  # frames per second, and s, of a film


def main() -> None:
    """Write the pictures of the named tasks, by default of all."""
    folder = Path(__file__).parent.parent / "docs" / "images" / "tasks"
    folder.mkdir(parents=True, exist_ok=True)
    flights = {exhibit.name: exhibit for exhibit in read_exhibits(assets.folder() / "demo")}
    for name in sys.argv[1:] or TASKS:
        if name not in flights:
            _frames(_start(name), 1)[0].quantize(256, Image.Quantize.MAXCOVERAGE).save(
                folder / f"{name}.png", optimize=True
            )
            print(f"wrote {name}.png")
            continue
        first, *others = _frames(Page(name, flights[name].payload), round(_FPS * _LONGEST))
        file = folder / f"{name}.webp"
        first.save(file, save_all=True, append_images=others, duration=1000 / _FPS, loop=0, quality=50, method=6)
        print(f"wrote {file.name}, {file.stat().st_size / 1e3:.0f} kB")


def _frames(page: Page, most: int) -> list[Image.Image]:
    """Frames of the page in real time, at most some number."""
    with open_tab() as tab, tempfile.TemporaryDirectory() as folder:
        tab.open(page.save(Path(folder) / "page.html"), *_SIZE)
        tab.run("jaxdrones.film('orbit')")
        tab.press("l")  # no names
        count = max(1, min(most, round(_FPS * tab.run("jaxdrones.player.end"))))
        frames = []
        for k in range(count):
            tab.run(f"jaxdrones.frameAt({k / _FPS}, {1 / _FPS})")
            frames.append(Image.open(io.BytesIO(tab.screenshot())).convert("RGB"))
    return frames


def _start(name: str) -> Page:
    """Page of the start of an episode."""
    with jd.make(name) as env:
        world = jax.jit(env.reset)(jax.random.key(0))[1]
        target = np.asarray(env.task.target_now(world).pos)
    row = jax.tree.map(lambda x: np.asarray(x)[None], world.drones)
    return jd.show(row, world.params, dt=env.dt, targets=target, scene=world.scene, title=name)


if __name__ == "__main__":
    main()
