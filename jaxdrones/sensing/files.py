"""Obstacles that are read from files; only Bullet can show them and let drones touch them."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from jaxdrones.checks import check_finite, check_positive, check_quaternion
from jaxdrones.sensing.shapes import GREY, LENGTHS


@dataclasses.dataclass(frozen=True, kw_only=True)
class File:
    """A solid from a file, at a fixed place; of plain numbers, as Bullet reads it once."""

    path: str | Path
    pos: tuple[float, ...]
    """(3,) m, world."""
    quat: tuple[float, ...] = (0.0, 0.0, 0.0, 1.0)
    """(4,) attitude, unit quaternion (x, y, z, w), obstacle to world."""
    color: tuple[float, ...] = GREY
    """(4,) red, green, blue, opacity, each 0 to 1."""

    def __post_init__(self):
        for name in "pos", "quat", "color":
            value, what = np.asarray(getattr(self, name), float), f"{name} of {type(self).__name__}"
            if value.shape != (LENGTHS[name],):
                raise ValueError(f"{what} has shape {value.shape}; give {LENGTHS[name]} numbers")
            check_finite(what, value)
            object.__setattr__(self, name, tuple(value.tolist()))
        check_quaternion(f"quat of {type(self).__name__}", self.quat)
        if not Path(self.path).is_file():
            raise ValueError(f"{self.path}: there is no such file; give the path of a mesh or URDF that exists")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Mesh(File):
    """A triangle mesh (.obj, .stl, .dae), of which Bullet lets drones touch the convex hull."""

    scale: float = 1.0
    """Length of the file's unit, m."""

    def __post_init__(self):
        super().__post_init__()
        check_positive("scale of Mesh", self.scale, "m")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Urdf(File):
    """A body from a URDF, which keeps its own colors."""
