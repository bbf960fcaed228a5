"""Films of the page, by a headless Chromium."""

from __future__ import annotations

import contextlib
import io
import tempfile
from collections.abc import Generator
from pathlib import Path

import numpy as np

from jaxdrones.visualization import video
from jaxdrones.visualization.browser import open_tab
from jaxdrones.visualization.shots import Shot
from jaxdrones.visualization.viewer.page import Page

CAMERAS = ("orbit", "follow", "board")


def film(page: Page, path: Path, fps: int = 24, size: tuple[int, int] = (1280, 720), camera: str = "orbit") -> int:
    """Write a film of a page, one frame per 1/fps of simulated time, in a few tenths of a second each.

    Args:
        page: result of `show`.
        path: path of the film, .mp4 or .gif.
        fps: frames per second.
        size: width and height, pixels; even numbers.
        camera: `orbit` shows the whole flight, `follow` the first drone, `board` its own view.

    Returns:
        The number of frames.

    Raises:
        ValueError: an unknown suffix, a package that is not installed, or no browser.
        OSError: the film cannot be written.
    """
    video.check_video(path)
    with contextlib.closing(frames(page, fps, size, camera)) as pictures:
        return video.write(pictures, path, fps)


def frames(page: Page, fps: int, size: tuple[int, int], camera: str | Shot) -> Generator[np.ndarray]:
    """Frames (height, width, 3) uint8 of a film of a page, by one of its cameras or by a given one."""
    from PIL import Image  # of the extra `video`

    with open_tab() as tab, tempfile.TemporaryDirectory() as folder:
        tab.open(page.save(Path(folder) / "page.html"), *size)
        if isinstance(camera, Shot):
            tab.run(f"jaxdrones.film('orbit', {camera.scale:g})")
            places = [f", {x.tolist()}, {y.tolist()}" for x, y in zip(camera.eyes, camera.targets, strict=True)]
        else:
            tab.run(f"jaxdrones.film({camera!r})")
            places = [""] * max(1, round(tab.run("jaxdrones.player.end") * fps))
        for k, place in enumerate(places):
            tab.run(f"jaxdrones.frameAt({k / fps}, {1 / fps}{place})")
            with Image.open(io.BytesIO(tab.screenshot())) as picture:
                yield np.asarray(picture.convert("RGB"))
