"""Films of the page, by a headless Chromium."""

from __future__ import annotations

import contextlib
import io
import tempfile
from collections.abc import Generator, Iterator
from pathlib import Path

import numpy as np

from jaxdrones.visualization import video
from jaxdrones.visualization.browser import Tab, open_tab
from jaxdrones.visualization.shots import Shot
from jaxdrones.visualization.viewer.page import Page

CAMERAS = ("orbit", "follow", "board")


def film(page: Page, path: Path, fps: int = 24, size: tuple[int, int] = (1280, 720), camera: str = "orbit") -> int:
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
