"""Cameras of Bullet: one on every drone, and a free one for films."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import ArrayLike

from jaxdrones.checks import check_positive, check_whole
from jaxdrones.engine.bullet.client import Client

_BODY_MASK = (1 << 24) - 1  # the bits of Bullet's segmentation that name the body; those above name the link
# TinyRenderer does not return when a vertex lies behind the plane of the eye by less than 1e-8 m, but not by 0. A pose
# with 1e-17 in place of 0 leads there, so poses are rounded to a micrometre and a microradian.
_DIGITS = 6
_AWAY = [0.0, 0.0, -1e4]  # m; where a drone waits while its own camera looks
_AHEAD = 1000.0  # m; how far in front of the eye the camera's target is


@dataclasses.dataclass(frozen=True)
class Camera:
    """A pinhole camera. The default is that of gym-pybullet-drones (2021), but with square pixels."""

    width: int = 64
    """Pixels."""
    height: int = 48
    """Pixels."""
    fov: float = 60.0
    """Vertical field of view, degrees."""
    aspect: float | None = None
    """Width over height of the view; that of the picture when left out. With 1, as in gym-pybullet-drones, the
    picture is squeezed."""
    near: float | None = None
    """Nearest visible distance, m; the drone's arm when left out."""
    far: float = 1000.0
    """Farthest visible distance, m."""
    shadows: bool = False
    """Whether bodies cast shadows, which takes twice the time."""

    def __post_init__(self):
        check_whole("width", self.width)
        check_whole("height", self.height)
        check_positive("far", self.far, "m")
        if not 0 < self.fov < 180:
            raise ValueError(f"fov is {self.fov}; give an angle between 0 and 180 degrees")


def drone_pictures(
    client: Client, body: np.ndarray, arms: np.ndarray, camera: Camera, raw_depth: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """RGBA, depth and segmentation that every drone of a team sees along its body x, each (n, height, width, ...).

    The team has been placed. The eye is one arm above the center of mass along world z, and up is world z. A drone does
    not see itself.
    """
    p = client.p
    frames = []
    forward = np.round(client.matrices(body[:, 3:7])[:, :, 0], _DIGITS)
    for drone, row, arm, x in zip(client.drones, body, arms, forward, strict=True):
        eye = np.round(row[:3] + np.array([0, 0, arm]), _DIGITS)
        p.resetBasePositionAndOrientation(drone, _AWAY, [0, 0, 0, 1], physicsClientId=client.id)
        _check_outside(client, drone, eye)
        near = arm if camera.near is None else camera.near
        frames.append(picture(client, eye, eye + _AHEAD * x, camera, near, raw_depth))
        p.resetBasePositionAndOrientation(drone, row[:3], row[3:7], physicsClientId=client.id)
    rgb, depth, segmentation = zip(*frames, strict=True)
    return np.stack(rgb), np.stack(depth), np.stack(segmentation)


def picture(
    client: Client, eye: ArrayLike, target: ArrayLike, camera: Camera, near: float, raw_depth: bool = False
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """One picture from `eye` towards `target` (m, world): RGBA uint8, depth float32 (m or raw), segmentation int32."""
    p = client.p
    view = p.computeViewMatrix(np.asarray(eye).tolist(), np.asarray(target).tolist(), [0, 0, 1])
    aspect = camera.width / camera.height if camera.aspect is None else camera.aspect
    projection = p.computeProjectionMatrixFOV(camera.fov, aspect, near, camera.far)
    _, _, rgb, depth, bodies = p.getCameraImage(
        camera.width,
        camera.height,
        view,
        projection,
        shadow=camera.shadows,
        renderer=client.renderer,
        physicsClientId=client.id,
    )
    rgb = np.reshape(rgb, (camera.height, camera.width, 4)).astype(np.uint8)
    depth = np.reshape(depth, (camera.height, camera.width)).astype(float)
    if not raw_depth:
        depth = camera.far * near / (camera.far - (camera.far - near) * depth)
    bodies = np.reshape(bodies, depth.shape)
    return rgb, depth.astype(np.float32), client.labels[np.where(bodies < 0, -1, bodies & _BODY_MASK)]


def _check_outside(client: Client, drone: int, eye: np.ndarray) -> None:
    """Raise if the eye is inside a body, as the renderer would look through that body."""
    inside = [f"obstacle {i}" for i in client.solids_at(eye.tolist())]
    if client.ground is not None and eye[2] < 0:
        inside.append("the ground")
    if inside:
        raise ValueError(
            f"the camera of drone {client.drones.index(drone)} is inside {inside[0]}, at {eye.round(3).tolist()} m; "
            "move the drone or the obstacle"
        )
