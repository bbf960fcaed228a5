"""Films of recorded flights and of pages, by the viewer's page in a browser or by the JAX renderer."""

import contextlib
import io
import os
import tempfile
from collections.abc import Callable, Generator, Iterator
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from jaxdrones.arguments import Count, checked, choice
from jaxdrones.checks import check_choice, short_repr
from jaxdrones.errors import UserError
from jaxdrones.flights.log import FlightLog
from jaxdrones.visualization import video
from jaxdrones.visualization.browser import Tab, find_browser, open_tab
from jaxdrones.visualization.shots import Shot, shoot
from jaxdrones.visualization.viewer import Page, show

RENDERERS = ("page", "jax", "bullet")
"""Renderers of films: the viewer's page in Chromium, the JAX renderer, or Bullet's TinyRenderer."""
CAMERAS = ("orbit", "follow", "board")
"""Cameras of the page."""
FPS = 24
SIZE = (1280, 720)


def check_size(name: str, size: Any) -> None:
    """Raise unless a size is width and height in pixels, both even."""
    fits = isinstance(size, tuple) and len(size) == 2 and all(isinstance(x, int) and x > 0 == x % 2 for x in size)
    if not fits:
        raise UserError(f"{name} is {short_repr(size)}; give width and height, two even numbers of pixels")


def choose_renderer(renderer: str | None, path: str | os.PathLike) -> str:
    """Renderer of a film, by default the page if there is a browser, else JAX.

    Raises:
        ValueError: an unknown renderer, or a missing dependency.
    """
    video.check_video(path)
    if renderer is None:
        return "page" if find_browser() else "jax"
    check_choice("renderer", renderer, RENDERERS)
    if renderer == "page" and not find_browser():
        raise UserError("there is no Chromium for --renderer page; install it, or take --renderer jax")
    if renderer == "bullet":
        from jaxdrones.visualization import replay  # noqa: F401  says which extra to install
    return renderer


@checked
def film(
    record: FlightLog,
    path: str | os.PathLike,
    title: str,
    renderer: str | None = None,
    fps: Count = FPS,
    size: Annotated[tuple[int, int], check_size] = SIZE,
    on_frame: Callable[[float], Any] = lambda share: None,
) -> int:
    """Write a film of a flight with colored drones, trails, targets and a clock; return its number of frames.

    Bullet draws all drones alike, without trails, targets or clock. The default renderer is that of `choose_renderer`;
    `fps` counts frames per simulated second, `size` is width and height in pixels, both even, and `on_frame` is called
    with the completed fraction after every frame.

    Raises:
        ValueError: a missing dependency, an odd size, or no finite state in the flight.
        OSError: the film cannot be written.
    """
    video.check_video(path, fps)
    frames = _frames(choose_renderer(renderer, path), record, title, fps, size)

    def reported() -> Iterator[np.ndarray]:
        for k, frame in enumerate(frames):
            yield frame
            on_frame(min(1.0, (k + 1) / max(1, round((record.t[-1] - record.begin) * fps))))

    with contextlib.closing(frames):
        return video.write(reported(), path, fps)


def _frames(renderer: str, record: FlightLog, title: str, fps: int, size: tuple[int, int]) -> Generator[np.ndarray]:
    if renderer == "page":
        shot = shoot(record, fps, size[0] / size[1])
        return page_frames(show(record, scene=shot.scene, title=title), fps, size, shot)
    if renderer == "jax":
        from jaxdrones.visualization import drawn_film  # needs Pillow

        return drawn_film.frames(record, title, fps, size)
    from jaxdrones.visualization import replay  # needs pybullet

    return replay.frames(record, fps, size)


@checked
def film_page(
    page: Page,
    path: str | os.PathLike,
    fps: Count = FPS,
    size: Annotated[tuple[int, int], check_size] = SIZE,
    camera: Annotated[str, choice("camera", CAMERAS)] = "orbit",
) -> int:
    """Write a film of a page, one frame per 1/fps of simulated time, in a few tenths of a second each.

    Args:
        page: result of `show`, or of `show_history`, whose policies fly one after the other.
        path: path of the film, .mp4 or .gif.
        fps: frames per second.
        size: width and height, pixels; even numbers.
        camera: `orbit` shows the whole flight, `follow` the first drone, `board` its own view.

    Returns:
        The number of frames.

    Raises:
        ValueError: an unknown suffix or camera, an odd size, a package that is not installed, or no browser.
        OSError: the film cannot be written.
    """
    video.check_video(path, fps)
    with contextlib.closing(page_frames(page, fps, size, camera)) as pictures:
        return video.write(pictures, path, fps)


def page_frames(page: Page, fps: int, size: tuple[int, int], camera: str | Shot) -> Generator[np.ndarray]:
    """Frames (height, width, 3) uint8 of a film of a page, by one of its cameras or by a given one."""
    from PIL import Image  # of the extra `video`

    with open_tab() as tab, tempfile.TemporaryDirectory() as folder:
        tab.open(page.save(Path(folder) / "page.html"), *size)
        for script in _scripts(tab, fps, camera):
            tab.run(script)
            with Image.open(io.BytesIO(tab.screenshot())) as picture:
                yield np.asarray(picture.convert("RGB"))


def _scripts(tab: Tab, fps: int, camera: str | Shot) -> Iterator[str]:
    """Scripts that draw the frames; the page of a training shows one policy after the other."""
    if isinstance(camera, Shot):
        tab.run(f"jaxdrones.film('orbit', {camera.scale:g})")
        for k, (eye, target) in enumerate(zip(camera.eyes, camera.targets, strict=True)):
            yield f"jaxdrones.frameAt({k / fps}, {1 / fps}, {eye.tolist()}, {target.tolist()})"
        return
    tab.run(f"jaxdrones.film({camera!r})")
    policies = tab.run("jaxdrones.player.history ? jaxdrones.player.worlds.length : 0")
    for policy in range(policies or 1):
        if policies:
            tab.run(f"jaxdrones.player.chooseWorld({policy})")
        for k in range(max(1, round(tab.run("jaxdrones.player.end") * fps))):
            yield f"jaxdrones.frameAt({k / fps}, {1 / fps})"
