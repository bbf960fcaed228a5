"""The surroundings as data: a ground plane and obstacles that do not move, for every backend and every camera."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np

from jaxdrones.checks import check_finite, check_positive, check_quaternion

Vector = tuple[float, float, float]
Color = tuple[float, float, float, float]

_GREY = (0.6, 0.6, 0.6, 1.0)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Obstacle:
    """Something solid at a place."""

    pos: Vector
    """m, world."""
    quat: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    """Attitude (x, y, z, w), obstacle to world."""
    color: Color = _GREY
    """Red, green, blue, opacity; 0 to 1."""

    def __post_init__(self):
        for name, length in ("pos", 3), ("quat", 4), ("color", 4):
            value = getattr(self, name)
            if np.shape(value) != (length,):
                raise ValueError(f"{name} of {type(self).__name__} is {value!r}; give {length} numbers")
            check_finite(f"{name} of {type(self).__name__}", value)
        check_quaternion(f"quat of {type(self).__name__}", self.quat)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Box(Obstacle):
    """A cuboid about `pos`."""

    size: Vector
    """Edge lengths, m."""

    def __post_init__(self):
        super().__post_init__()
        for edge in self.size:
            check_positive("size of Box", edge, "m")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Sphere(Obstacle):
    """A ball about `pos`."""

    radius: float
    """m."""

    def __post_init__(self):
        super().__post_init__()
        check_positive("radius of Sphere", self.radius, "m")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Cylinder(Obstacle):
    """A cylinder about `pos`, its axis along its z."""

    radius: float
    """m."""
    height: float
    """m."""

    def __post_init__(self):
        super().__post_init__()
        check_positive("radius of Cylinder", self.radius, "m")
        check_positive("height of Cylinder", self.height, "m")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Mesh(Obstacle):
    """A triangle mesh from a file (.obj, .stl, .dae)."""

    path: str | Path
    scale: float = 1.0
    """Length of the file's unit, m."""

    def __post_init__(self):
        super().__post_init__()
        check_positive("scale of Mesh", self.scale, "m")
        _check_file(self.path)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Urdf(Obstacle):
    """A body from a URDF, fixed at `pos`; keeps its own colours."""

    path: str | Path

    def __post_init__(self):
        super().__post_init__()
        _check_file(self.path)


@dataclasses.dataclass(frozen=True)
class Scene:
    """Obstacles, and a ground plane at z = 0 unless left out."""

    obstacles: tuple[Obstacle, ...] = ()
    ground: bool = True

    @property
    def has_obstacles(self) -> bool:
        """Whether something stands around."""
        return bool(self.obstacles)

    def __post_init__(self):
        for obstacle in self.obstacles:
            if not isinstance(obstacle, Obstacle):
                raise ValueError(f"{obstacle!r} is not an obstacle; give Box, Sphere, Cylinder, Mesh or Urdf")


def gate(
    pos: Vector, yaw: float = 0.0, opening: float = 0.4, frame: float = 0.16, depth: float = 0.05
) -> tuple[Box, ...]:
    """Four boxes around a square opening that is centred on `pos` and crossed along the heading `yaw` (rad); m.

    The default size is that of the gates of lsy_drone_racing: 0.4 m inside, 0.72 m outside.
    """
    quat = (0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2))
    outer, offset = opening + 2 * frame, (opening + frame) / 2
    color = (0.9, 0.35, 0.1, 1.0)

    def beam(left: float, up: float, width: float, height: float) -> Box:
        x, y, z = pos
        place = (x - left * math.sin(yaw), y + left * math.cos(yaw), z + up)
        return Box(pos=place, quat=quat, size=(depth, width, height), color=color)

    return (
        beam(0.0, offset, outer, frame),
        beam(0.0, -offset, outer, frame),
        beam(offset, 0.0, frame, opening),
        beam(-offset, 0.0, frame, opening),
    )


def contains(obstacle: Obstacle, point: np.ndarray) -> bool:
    """Whether a point (3,) (m, world) is inside a box, sphere or cylinder; False for meshes and URDFs."""
    x, y, z, w = obstacle.quat
    offset = np.asarray(point) - obstacle.pos
    t = 2 * np.cross(offset, [x, y, z])  # R^T offset, with the conjugate quaternion
    local = offset + w * t + np.cross(t, [x, y, z])
    match obstacle:
        case Box(size=size):
            return bool(np.all(np.abs(local) < np.asarray(size) / 2))
        case Sphere(radius=radius):
            return bool(local @ local < radius**2)
        case Cylinder(radius=radius, height=height):
            return bool(local[:2] @ local[:2] < radius**2 and abs(local[2]) < height / 2)
    return False


def paper_obstacles() -> Scene:
    """Counterparts of the paper's default obstacles: at their places, of their size, made of primitives.

    The walls of a courtyard around the origin, a duck at (-0.5, -0.5), a cube of 1 m at (-0.5, -2.5), a ball of 1 m
    at (0, 2).
    """
    wall = (0.55, 0.3, 0.25, 1.0)
    return Scene(
        (
            Box(pos=(6.0, 0.0, 1.0), size=(0.3, 12.0, 2.0), color=wall),
            Box(pos=(-6.0, 0.0, 1.0), size=(0.3, 12.0, 2.0), color=wall),
            Sphere(pos=(-0.5, -0.5, 0.05), radius=0.05, color=(1.0, 0.85, 0.0, 1.0)),
            Box(pos=(-0.5, -2.5, 0.5), size=(1.0, 1.0, 1.0), color=(0.4, 0.6, 0.9, 1.0)),
            Sphere(pos=(0.0, 2.0, 0.5), radius=0.5, color=(0.95, 0.95, 0.95, 1.0)),
        )
    )


def _check_file(path: str | Path) -> None:
    if not Path(path).is_file():
        raise ValueError(f"{path}: there is no such file; give the path of a mesh or URDF that exists")
