"""Films of recorded flights, by the viewer's page in a browser or by the JAX renderer."""

import contextlib
from collections.abc import Callable, Generator, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from jaxdrones.checks import check_choice
from jaxdrones.errors import UserError
from jaxdrones.flights.log import FlightLog
from jaxdrones.visualization import video
from jaxdrones.visualization.browser import find_browser
from jaxdrones.visualization.shots import shoot

RENDERERS = ("page", "jax", "bullet")
"""Renderers of films: the viewer's page in Chromium, the JAX renderer, or Bullet's TinyRenderer."""
FPS = 24
SIZE = (1280, 720)


def choose_renderer(renderer: str | None, path: Path) -> str:
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


def film(
    record: FlightLog,
    path: Path,
    title: str,
    renderer: str | None = None,
    fps: int = FPS,
    size: tuple[int, int] = SIZE,
    on_frame: Callable[[float], Any] = lambda share: None,
) -> int:
    """Write a film of a flight with colored drones, trails, targets and a clock; return its number of frames.

    Bullet draws all drones alike, without trails, targets or clock. The default renderer is that of `choose_renderer`;
    `fps` counts frames per simulated second, `size` is width and height in pixels, both even, and `on_frame` is called
    with the completed fraction after every frame.

    Raises:
        ValueError: a missing dependency, or no finite state in the flight.
        OSError: the film cannot be written.
    """
    frames = _frames(choose_renderer(renderer, path), record, title, fps, size)

    def reported() -> Iterator[np.ndarray]:
        for k, frame in enumerate(frames):
            yield frame
            on_frame(min(1.0, (k + 1) / max(1, round((record.t[-1] - record.begin) * fps))))

    with contextlib.closing(frames):
        return video.write(reported(), path, fps)


def _frames(renderer: str, record: FlightLog, title: str, fps: int, size: tuple[int, int]) -> Generator[np.ndarray]:
    if renderer == "page":
        from jaxdrones.visualization.viewer import film, show

        shot = shoot(record, fps, size[0] / size[1])
        return film.frames(show(record, scene=shot.scene, title=title), fps, size, shot)
    if renderer == "jax":
        from jaxdrones.visualization import drawn_film  # needs Pillow

        return drawn_film.frames(record, title, fps, size)
    from jaxdrones.visualization import replay  # needs pybullet

    return replay.frames(record, title, fps, size)
