"""Obstacles from mesh and URDF files, for the Bullet backend only."""

import dataclasses
from pathlib import Path
from typing import Annotated

import jax.numpy as jnp
import numpy as np

from jaxdrones import rotation
from jaxdrones.arguments import Range, checked, number, quaternion, shape
from jaxdrones.errors import UserError
from jaxdrones.sensing.shapes import GREY, Box

_NAME = "{argument} of {function}"


def _numbers(length: int) -> Range:
    return shape(length, meaning="of one body", name=_NAME, finite=True)


@dataclasses.dataclass(frozen=True, kw_only=True)
class File:
    """Static solid from a file; its numbers are concrete, as Bullet reads them once."""

    path: str | Path
    pos: Annotated[tuple[float, ...], _numbers(3)]
    """(3,) m, world."""
    quat: Annotated[tuple[float, ...], _numbers(4), quaternion(_NAME)] = (0.0, 0.0, 0.0, 1.0)
    """(4,) attitude, unit quaternion (x, y, z, w), obstacle to world."""
    color: Annotated[tuple[float, ...], _numbers(4)] = GREY
    """(4,) red, green, blue, opacity, each 0 to 1."""

    def __post_init__(self):
        for name in "pos", "quat", "color":
            object.__setattr__(self, name, tuple(np.asarray(getattr(self, name), float).tolist()))
        if not Path(self.path).is_file():
            raise UserError(f"{self.path}: there is no such file; give the path of a mesh or URDF that exists")


@checked
@dataclasses.dataclass(frozen=True, kw_only=True)
class Mesh(File):
    """Triangle mesh (.obj, .stl, .dae); Bullet collides with its convex hull."""

    scale: Annotated[float, number("m", _NAME, above=0)] = 1.0
    """Length of the file's unit, m."""

    def bounding_box(self) -> Box:
        """Bounding box along the mesh's own axes: an obstacle for both backends.

        Raises:
            ValueError: the file is neither .obj nor .stl, or holds no points.
        """
        points = self.scale * _points(Path(self.path))
        low, high = points.min(axis=0), points.max(axis=0)
        pos = np.asarray(self.pos) + np.asarray(rotation.rotate(jnp.asarray(self.quat), jnp.asarray((low + high) / 2)))
        size = np.maximum(high - low, _THINNEST)
        return Box(pos=tuple(pos.tolist()), quat=self.quat, size=tuple(size.tolist()), color=self.color)


@checked
@dataclasses.dataclass(frozen=True, kw_only=True)
class Urdf(File):
    """Body from a URDF, with its own colors."""


_THINNEST = 1e-3  # m: a flat mesh becomes a thin box
_STL_HEADER = 84  # bytes: a text and the number of triangles
_STL_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def _points(path: Path) -> np.ndarray:
    """Corners (k, 3) of a mesh, in units of its file."""
    data, kind = path.read_bytes(), path.suffix.lower()
    if kind not in (".obj", ".stl"):
        raise UserError(f"{path}: the bounding box of {kind or 'such a'} file is not known; give an .obj or .stl")
    count = int.from_bytes(data[80:_STL_HEADER], "little")
    if kind == ".stl" and len(data) == _STL_HEADER + count * _STL_TRIANGLE.itemsize:
        points = np.frombuffer(data, _STL_TRIANGLE, count, _STL_HEADER)["corners"].reshape(-1, 3).astype(float)
    else:
        word = "v" if kind == ".obj" else "vertex"
        lines = (line.split() for line in data.decode(errors="replace").splitlines())
        points = np.array([line[1:4] for line in lines if line and line[0] == word], float).reshape(-1, 3)
    if not len(points):
        raise UserError(f"{path}: it holds no points; give a mesh of triangles")
    return points
