"""Client of a Bullet world, and the only import of pybullet."""

import contextlib
import importlib.util
import os
import sys
import weakref
from types import ModuleType

import numpy as np

from jaxdrones.engine.bullet.arrays import NEAR, START_OMEGA, reach
from jaxdrones.engine.bullet.surroundings import Surroundings, quiet
from jaxdrones.errors import UserError, install
from jaxdrones.sensing import Scene
from jaxdrones.sensing.images import BACK, FRONT, HUB

BALLS, CYLINDER = "balls", "cylinder"
TINY, EGL = "tiny", "egl"
BACKGROUND, GROUND = -1, 0  # of a segmentation; drone i is 1 + i, obstacle i is 1 + number of drones + i
_BALLS = 8
_DISC = 0.1  # thickness of the disc as a share of the height of the collision cylinder
_SHAPE, _INERTIAL = slice(0, 16), slice(16, 20)  # columns of a team
_DRONE_FRICTION = 0.5  # as in gym-pybullet-drones (2021)


def import_pybullet() -> ModuleType:
    """Import pybullet without printing its greeting."""
    if "pybullet" in sys.modules:
        return sys.modules["pybullet"]
    with quiet():
        try:
            import pybullet
        except ImportError:
            raise ImportError(
                f"pybullet is not installed; {install('bullet')} "
                f"(it has wheels up to CPython 3.11, this is {sys.version_info.major}.{sys.version_info.minor})"
            ) from None
    return pybullet


class Client:
    """Connection to Bullet; `set_scene` and `set_team` create its bodies."""

    def __init__(self, dt: float, damping: float, collision: str, renderer: str, gui: bool):
        self.p = import_pybullet()
        self.drones: list[int] = []
        self._damping = float(np.float32(damping))  # Bullet's default of 0.04 is in single precision
        self._collision = collision
        self._team, self._reach = np.empty((0, 20)), np.empty(0)
        self._colliding: list[bool] = []  # drones in the collision world
        if gui and sys.platform == "linux" and not os.environ.get("DISPLAY"):  # Bullet would end the process
            raise OSError("no window can be opened without a display; start one (or use xvfb-run), or leave gui out")
        self.id = self.p.connect(self.p.GUI if gui else self.p.DIRECT)
        self._disconnect = weakref.finalize(self, _disconnect, self.p, self.id)
        self.p.setTimeStep(dt, physicsClientId=self.id)
        self.p.setPhysicsEngineParameter(deterministicOverlappingPairs=1, physicsClientId=self.id)
        self.p.setGravity(0, 0, 0, physicsClientId=self.id)  # every drone's weight is part of its wrench
        self.surroundings = Surroundings(self.p, self.id)
        self.renderer = self.p.ER_BULLET_HARDWARE_OPENGL if gui or renderer == EGL else self.p.ER_TINY_RENDERER
        if renderer == EGL:
            self._load_egl()

    @property
    def closed(self) -> bool:
        """Whether the connection is gone."""
        return not self._disconnect.alive

    def close(self) -> None:
        """End the connection; more than once is fine."""
        self._disconnect()

    def check_open(self) -> None:
        """Raise if the connection is gone."""
        if self.closed:
            raise UserError("this Bullet step is closed; make a new one, and use it inside its `with` block")

    def names(self) -> dict[int, str]:
        """Name of every body: `ground`, `drone i`, `obstacle i`; the order is that of segmentations."""
        around = self.surroundings
        ground = {} if around.ground is None else {around.ground: "ground"}
        drones = {body: f"drone {i}" for i, body in enumerate(self.drones)}
        return ground | drones | {body: f"obstacle {i}" for i, body in around.obstacles.items()}

    def set_scene(self, scene: Scene) -> None:
        """Set the scene, of NumPy arrays."""
        if self.surroundings.set(scene):
            self.labels = self._labels()

    def set_team(self, team: np.ndarray) -> None:
        """Set the bodies of the drones.

        Columns of (n, 20): collision radius, height, offset; propeller radius, rotor positions (12), for the eye;
        mass, principal moments of inertia (3).
        """
        if np.array_equal(team, self._team):
            return
        if team.shape != self._team.shape or not np.array_equal(team[:, _SHAPE], self._team[:, _SHAPE]):
            for drone in self.drones:
                self.p.removeBody(drone, physicsClientId=self.id)
            self.drones = [self._add_drone(*shape) for shape in team[:, _SHAPE].tolist()]
            self._colliding = [True] * len(team)
            self._reach = reach(*team[:, :3].T)
        for drone, (mass, *inertia) in zip(self.drones, team[:, _INERTIAL].tolist(), strict=True):
            self.p.changeDynamics(
                drone,
                -1,
                mass=mass,
                localInertiaDiagonal=inertia,
                linearDamping=self._damping,
                angularDamping=self._damping,
                physicsClientId=self.id,
            )
        self._team = team.copy()
        self.labels = self._labels()

    def _labels(self) -> np.ndarray:
        """Bullet's body -> segmentation label; the last entry, at -1, is the background."""
        around = self.surroundings
        labels = np.full(max(self.names(), default=0) + 2, BACKGROUND, np.int32)
        labels[self.drones] = 1 + np.arange(len(self.drones))
        for number, body in around.obstacles.items():
            labels[body] = 1 + len(self.drones) + number
        if around.ground is not None:
            labels[around.ground] = GROUND
        return labels

    def place(self, body: np.ndarray) -> None:
        """Set the position and attitude (n, 7+) of the drones, world."""
        for drone, row in zip(self.drones, body.tolist(), strict=True):
            self.p.resetBasePositionAndOrientation(drone, row[:3], row[3:7], self.id)

    def advance(self, team: np.ndarray, loads: np.ndarray) -> np.ndarray:
        """Bodies (n, 13) of a team (n, 13+) after one physics step under `loads` (n, 10+); see `arrays` for columns."""
        p, client, world = self.p, self.id, self.p.WORLD_FRAME
        near, before = self._near(team, loads), self._colliding
        given = zip(self.drones, team.tolist(), loads.tolist(), near, before, strict=True)
        for drone, row, load, is_near, was_near in given:
            # Contact manifolds outlive a change of pose. Removing a drone from the collision world and adding it again
            # clears them, so the result does not depend on earlier steps. Drones that can touch nothing stay outside.
            if is_near or was_near:
                p.setCollisionFilterGroupMask(drone, -1, int(is_near), -int(is_near), client)
            pos = row[:3]  # the client by position: pybullet reads keywords a third slower
            p.resetBasePositionAndOrientation(drone, pos, row[3:7], client)
            p.resetBaseVelocity(drone, row[7:10], load[START_OMEGA], client)
            p.applyExternalForce(drone, -1, load[:3], pos, world, client)
            p.applyExternalTorque(drone, -1, load[3:6], world, client)
        self._colliding = near
        p.stepSimulation(client)
        after: list[float] = []
        for drone in self.drones:
            pos, quat = p.getBasePositionAndOrientation(drone, client)
            vel, omega = p.getBaseVelocity(drone, client)
            after += pos + quat + vel + in_body(quat, omega)
        return np.array(after).reshape(-1, 13)

    def _near(self, team: np.ndarray, loads: np.ndarray) -> list[bool]:
        """Which drones of a team under `loads` may touch something."""
        near = loads[:, NEAR] > 0
        if self.surroundings.obstacles:
            near |= self.surroundings.near(team[:, :3], self._reach)
        return near.tolist()

    def _load_egl(self) -> None:
        spec = importlib.util.find_spec("eglRenderer")
        if spec is None or self.p.loadPlugin(spec.origin, "_eglRendererPlugin", physicsClientId=self.id) < 0:
            raise OSError("Bullet's EGL renderer cannot be loaded; give renderer='tiny', or install a GPU driver")

    def _add_drone(self, radius: float, height: float, offset: float, prop_radius: float, *rotor_pos: float) -> int:
        p = self.p
        if self._collision == CYLINDER:
            shapes, radii, lengths, places = [p.GEOM_CYLINDER], [radius], [height], [[0, 0, offset]]
        else:
            # Contact manifolds are cleared at every step. Without their memory a cylinder on a plane sinks in and
            # spins up, and one that is hit on its side is hit at an edge and tumbles. Balls as high as the cylinder
            # touch in separate points, half-way up; the disc fills the rim between them.
            ball = min(height, radius) / 2
            ring = [(radius - ball) * np.exp(2j * np.pi * k / _BALLS) for k in range(_BALLS)]
            shapes, radii = [p.GEOM_CYLINDER] + [p.GEOM_SPHERE] * _BALLS, [radius] + [ball] * _BALLS
            lengths = [_DISC * height] + [0.0] * _BALLS
            places = [[0, 0, offset]] + [[place.real, place.imag, offset] for place in ring]
        collision = p.createCollisionShapeArray(
            shapeTypes=shapes,
            radii=radii,
            lengths=lengths,
            halfExtents=[[0, 0, 0]] * len(shapes),
            collisionFramePositions=places,
            physicsClientId=self.id,
        )
        visual = self._drone_visual(height, offset, prop_radius, np.reshape(rotor_pos, (4, 3)))
        drone = p.createMultiBody(1.0, collision, visual, physicsClientId=self.id)
        p.changeDynamics(
            drone,
            -1,
            lateralFriction=_DRONE_FRICTION,
            restitution=0,
            rollingFriction=0,
            spinningFriction=0,
            physicsClientId=self.id,
        )
        return drone

    def _drone_visual(self, height: float, offset: float, prop_radius: float, rotor_pos: np.ndarray) -> int:
        """A hub and four discs, red in front."""
        p = self.p
        hub = np.abs(rotor_pos[:, :2]).max() / 2
        return p.createVisualShapeArray(
            shapeTypes=[p.GEOM_BOX] + [p.GEOM_CYLINDER] * 4,
            halfExtents=[[hub, hub, height / 4]] + [[0, 0, 0]] * 4,
            radii=[0.0] + [prop_radius] * 4,
            lengths=[0.0] + [height / 5] * 4,
            visualFramePositions=[[0, 0, offset], *(rotor_pos + np.array([0, 0, offset + height / 3])).tolist()],
            rgbaColors=[HUB, *(FRONT if x > 1e-6 else BACK for x in rotor_pos[:, 0])],
            physicsClientId=self.id,
        )


def _disconnect(p: ModuleType, client: int) -> None:
    with contextlib.suppress(p.error):
        p.disconnect(client)


def in_body(quat: tuple, vector: tuple) -> tuple[float, float, float]:
    """R^T v: a vector from the world frame to the body frame, v + w t + t x u with t = 2 v x u and q = (u, w)."""
    x, y, z, w = quat
    a, b, c = vector
    tx, ty, tz = 2 * (b * z - c * y), 2 * (c * x - a * z), 2 * (a * y - b * x)
    return a + w * tx + ty * z - tz * y, b + w * ty + tz * x - tx * z, c + w * tz + tx * y - ty * x
