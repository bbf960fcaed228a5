"""Ground and obstacles in a Bullet world."""

import contextlib
import ctypes
import os
import sys
from collections.abc import Iterator
from types import ModuleType
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxdrones.errors import UserError
from jaxdrones.sensing import Scene, Urdf
from jaxdrones.sensing.files import Mesh
from jaxdrones.sensing.shapes import Box, Capsule, Cylinder, Sphere

_STATIC = 2  # Bullet's collision group of bodies that do not move, which do not collide with each other
_GROUND_FRICTION = 1.0  # as in gym-pybullet-drones (2021)


class _Placed(NamedTuple):
    """Obstacle in Bullet's world."""

    shape: Any
    """Everything but the pose; a body with an equal entry is reused."""
    pose: tuple[list[float], list[float]]
    """Position (3,), m, and attitude (4,)."""


class Surroundings:
    """Static bodies of a scene."""

    def __init__(self, p: ModuleType, client: int):
        self.p, self.id = p, client
        self.ground: int | None = None
        self.obstacles: dict[int, int] = {}  # number -> body
        self._placed: dict[int, _Placed] = {}  # by number
        self._scene: Scene | None = None
        self._structure: Any = jax.tree.structure(None)
        self._numbers = np.zeros(0)
        self._boxes = np.zeros((0, 2, 3))  # around the obstacles: lowest and highest corner, m, world

    def set(self, scene: Scene) -> bool:
        """Set the scene, of NumPy arrays; return whether anything changed.

        Obstacles of the same shape are moved, others are created.
        """
        if scene is self._scene:
            return False
        leaves, structure = jax.tree.flatten(scene)
        numbers = np.concatenate([np.zeros(0), *map(np.ravel, leaves)])
        same = structure == self._structure and np.array_equal(numbers, self._numbers)
        self._scene, self._structure, self._numbers = scene, structure, numbers
        if same:
            return False
        if self.ground is None and scene.ground:
            self.ground = self._add_ground()
        elif self.ground is not None and not scene.ground:
            self.p.removeBody(self.ground, physicsClientId=self.id)
            self.ground = None
        obstacles = scene.numbered
        for number in self.obstacles.keys() - obstacles.keys():
            self._remove(number)
        for number, obstacle in obstacles.items():
            self._place(number, obstacle)
        for body in self.obstacles.values() if self.ground is None else (self.ground, *self.obstacles.values()):
            self._register(body)
        self._boxes = np.array([self._box(body) for body in self.obstacles.values()]).reshape(-1, 2, 3)
        return True

    def near(self, pos: np.ndarray, reach: np.ndarray) -> np.ndarray:
        """Which balls (n,) with centers (n, 3) and radii (n,), m, meet the box around an obstacle."""
        low, high = self._boxes[:, 0], self._boxes[:, 1]
        outside = np.maximum(np.maximum(low - pos[:, None], pos[:, None] - high), 0)
        return ((outside**2).sum(axis=-1) <= reach[:, None] ** 2).any(axis=-1)

    def _box(self, body: int) -> np.ndarray:
        """Lowest and highest corner (2, 3) of a body with its links, m, world."""
        links = range(-1, self.p.getNumJoints(body, self.id))
        corners = np.array([self.p.getAABB(body, link, self.id) for link in links])
        return np.stack([corners[:, 0].min(axis=0), corners[:, 1].max(axis=0)])

    def _register(self, body: int) -> None:
        """Register a body again: Bullet resolves contacts in the order of registration."""
        self.p.setCollisionFilterGroupMask(body, -1, 0, 0, self.id)
        self.p.setCollisionFilterGroupMask(body, -1, _STATIC, ~_STATIC, self.id)

    def _place(self, number: int, obstacle: Any) -> None:
        fields = {name: np.asarray(x).tolist() for name, x in vars(obstacle).items() if name not in ("pos", "quat")}
        pose = np.asarray(obstacle.pos, float).tolist(), np.asarray(obstacle.quat, float).tolist()
        new, old = _Placed((type(obstacle), fields), pose), self._placed.get(number)
        if old is None or new.shape != old.shape:
            if old is not None:
                self._remove(number)
            self.obstacles[number] = self._add(obstacle, *pose)
        elif new.pose != old.pose:
            self.p.resetBasePositionAndOrientation(self.obstacles[number], *pose, self.id)
        self._placed[number] = new

    def _remove(self, number: int) -> None:
        self.p.removeBody(self.obstacles.pop(number), physicsClientId=self.id)
        del self._placed[number]

    def _add_ground(self) -> int:
        p = self.p
        plane = p.createCollisionShape(p.GEOM_PLANE, physicsClientId=self.id)
        ground = p.createMultiBody(0, plane, physicsClientId=self.id)
        p.changeDynamics(ground, -1, lateralFriction=_GROUND_FRICTION, physicsClientId=self.id)
        return ground

    def _add(self, obstacle: Any, pos: list[float], quat: list[float]) -> int:
        p = self.p
        if isinstance(obstacle, Urdf):
            with quiet():
                return p.loadURDF(str(obstacle.path), pos, quat, useFixedBase=True, physicsClientId=self.id)
        shape = _shape_of(p, obstacle)
        collision = p.createCollisionShape(**shape, physicsClientId=self.id)
        if "height" in shape:
            shape["length"] = shape.pop("height")  # Bullet has two names for it
        visual = p.createVisualShape(**shape, rgbaColor=obstacle.color, physicsClientId=self.id)
        return p.createMultiBody(0, collision, visual, pos, quat, physicsClientId=self.id)


def _shape_of(p: ModuleType, obstacle: Any) -> dict[str, Any]:
    """Arguments of `createCollisionShape` for a single concrete obstacle."""
    match obstacle:
        case Box(size=size):
            return dict(shapeType=p.GEOM_BOX, halfExtents=[edge / 2 for edge in size])
        case Sphere(radius=radius):
            return dict(shapeType=p.GEOM_SPHERE, radius=radius)
        case Cylinder(radius=radius, height=height):
            return dict(shapeType=p.GEOM_CYLINDER, radius=radius, height=height)
        case Capsule(radius=radius, height=height):
            return dict(shapeType=p.GEOM_CAPSULE, radius=radius, height=height)
        case Mesh(path=path, scale=scale):
            return dict(shapeType=p.GEOM_MESH, fileName=str(path), meshScale=[scale] * 3)
    raise UserError(f"Bullet has no shape for a {type(obstacle).__name__}; leave it out of the scene")


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Silence the output of Bullet's C code on stdout, where a caller may be writing JSON, and on stderr."""
    sys.stdout.flush()
    sys.stderr.flush()
    with open(os.devnull, "w") as nowhere:
        kept = {number: os.dup(number) for number in (1, 2)}
        try:
            for number in kept:
                os.dup2(nowhere.fileno(), number)
            yield
        finally:
            ctypes.CDLL(None).fflush(None)
            for number, copy in kept.items():
                os.dup2(copy, number)
                os.close(copy)
