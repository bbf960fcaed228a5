"""Overlays of a film: trails, targets, names, title and clock. Needs Pillow (extra `video`)."""

from typing import Any, NamedTuple

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from jaxdrones.flights.log import FlightLog
from jaxdrones.visualization.palette import as_rgb, colors

_MOST_NAMED = 8  # drones with names in the picture
_CROWD, _SHORT = 24, 2.0  # drones above which trails are short, and their length then, s
_LEGS = 300  # largest number of segments of a trail
_BEHIND = 1.02  # a point is hidden beyond this many times the depth of its pixel
_WHITE, _INK = (255, 255, 255, 200), (29, 37, 44, 255)


class Lens(NamedTuple):
    """Pose and field of view of a picture."""

    eye: np.ndarray
    """(3,) m, world."""
    target: np.ndarray
    """(3,) center of the picture, m, world."""
    field_of_view: float
    """Vertical, degrees."""
    size: tuple[int, int]
    """Width and height, pixels."""

    @staticmethod
    def axes_of(eye: Any, target: Any, xp: Any = np) -> tuple[Any, Any, Any]:
        """Forward, left and up directions (3,) of a picture, world."""
        forward = (target - eye) / xp.linalg.norm(target - eye)
        left = xp.stack([-forward[1], forward[0], xp.zeros_like(forward[0])])
        left = left / xp.linalg.norm(left)
        return forward, left, xp.cross(forward, left)

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pixels (..., 2), from the upper left corner, and depths (...,), m, of points (..., 3), m, world.

        Pixels of points behind the camera are NaN.
        """
        width, height = self.size
        depth, left, up = (np.asarray(points - self.eye) @ axis for axis in self.axes_of(self.eye, self.target))
        focal = height / 2 / np.tan(np.deg2rad(self.field_of_view) / 2)  # pixels
        ahead = np.where(depth > 1e-3, depth, np.nan)
        return np.stack([width / 2 - focal * left / ahead, height / 2 - focal * up / ahead], axis=-1), depth


class Overlay:
    """Overlay for the pictures of one flight."""

    def __init__(self, record: FlightLog, title: str, scale: float) -> None:
        """Prepare for a record, with drones enlarged by `scale`."""
        self._record, self._title = record, title
        self._colors = [(*as_rgb(color).tolist(), 255) for color in colors(len(record.labels))]
        self._radius = scale * float(np.max(np.linalg.norm(record.params.rotor_pos, axis=-1)))
        if scale > 1:
            self._title += f" (drones {scale:g} times as large as they are)"

    def draw(self, picture: np.ndarray, depth: np.ndarray, lens: Lens, row: int, time: float) -> np.ndarray:
        """Draw the overlay on a picture (h, w, 3) uint8 with depths (h, w), m, of a row of the record and a time, s."""
        width, height = lens.size
        fine = Image.new("RGBA", (2 * width, 2 * height))
        brush = ImageDraw.Draw(fine)
        for i, color in enumerate(self._colors):
            self._trail(brush, self._path(i, row), color, depth, lens)
            self._target(brush, self._record.target_pos[row, i], color, depth, lens)
        image = Image.fromarray(picture)
        lines = fine.reduce(2)
        image.paste(lines, mask=lines.getchannel("A"))
        self._texts(ImageDraw.Draw(image, "RGBA"), lens, row, time)
        return np.asarray(image)

    def _path(self, i: int, row: int) -> np.ndarray:
        """(m, 3) positions of a drone up to a row."""
        record, first = self._record, 0
        if len(self._colors) > _CROWD:
            first = int(np.searchsorted(record.t, record.t[row] - _SHORT))
        every = max(1, len(record.t) // _LEGS)
        return np.concatenate([record.pos[first:row:every, i], record.pos[row : row + 1, i]])

    def _trail(self, brush: Any, path: np.ndarray, color: tuple, depth: np.ndarray, lens: Lens) -> None:
        pixels, _ = lens.project(path)
        visible = _visible(path, depth, lens).astype(int)
        runs = np.flatnonzero(np.diff(np.concatenate([[0], visible, [0]]))).reshape(-1, 2)  # start and stop of each
        for begin, end in runs:
            if end - begin > 1:
                brush.line((2 * pixels[begin:end]).ravel().tolist(), fill=color, width=5, joint="curve")

    def _target(self, brush: Any, point: np.ndarray, color: tuple, depth: np.ndarray, lens: Lens) -> None:
        """Hollow diamond of half the size of a drone."""
        if np.isfinite(point).all() and _visible(point[None], depth, lens)[0]:
            (x, y), away = lens.project(point)
            r = max(7.0, 0.5 * self._radius * lens.size[1] / 2 / np.tan(np.deg2rad(lens.field_of_view) / 2) / away)
            corners = [(x, y - r), (x + 0.7 * r, y), (x, y + r), (x - 0.7 * r, y), (x, y - r)]
            brush.line([(2 * a, 2 * b) for a, b in corners], fill=color, width=4, joint="curve")

    def _texts(self, brush: Any, lens: Lens, row: int, time: float) -> None:
        width, height = lens.size
        unit = height / 720
        if len(self._colors) <= _MOST_NAMED:
            above = self._record.pos[row] + [0, 0, 1.2 * self._radius]
            for (x, y), name, color in zip(lens.project(above)[0], self._record.labels, self._colors, strict=True):
                if np.isfinite([x, y]).all():
                    box = _text(brush, (x, y), name, 18 * unit, "mb")
                    brush.line([box[0], box[3], box[2], box[3]], fill=color, width=max(2, round(3 * unit)))
        title = self._title
        while len(title) > 10 and brush.textlength(title, font=_font(20 * unit)) > 0.96 * width:
            title = title[:-5].rstrip(" ….") + " …"
        _text(brush, (12 * unit, 10 * unit), title, 20 * unit, "la")
        _text(brush, (width - 12 * unit, height - 12 * unit), f"{time:.2f} s", 28 * unit, "rd")


def _visible(points: np.ndarray, depth: np.ndarray, lens: Lens) -> np.ndarray:
    """Mask of the visible points (m, 3)."""
    pixels, away = lens.project(points)
    width, height = lens.size
    with np.errstate(invalid="ignore"):
        inside = np.logical_and(pixels >= 0, pixels < (width, height)).all(axis=-1)
    column, line = np.where(np.reshape(inside, (-1, 1)), pixels, 0).astype(int).T
    return inside & (away < _BEHIND * depth[line, column])


def _text(brush: Any, at: tuple[float, float], text: str, size: float, anchor: str) -> tuple[float, ...]:
    """Write text on a light background; return its box."""
    box = brush.textbbox(at, text, font=_font(size), anchor=anchor)
    box = (box[0] - 5, box[1] - 3, box[2] + 5, box[3] + 3)
    brush.rounded_rectangle(box, 3, fill=_WHITE)
    brush.text(at, text, fill=_INK, font=_font(size), anchor=anchor)
    return box


def _font(size: float) -> Any:
    return ImageFont.load_default(max(8, round(size)))
