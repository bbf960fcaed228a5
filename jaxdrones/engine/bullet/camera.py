"""Bullet cameras: one on every drone, and a free one for films."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from jaxdrones.engine.bullet.client import GROUND, Client
from jaxdrones.params import Params
from jaxdrones.sensing import Camera, Scene
from jaxdrones.sensing.shapes import Obstacle
from jaxdrones.state import State

_BODY_MASK = (1 << 24) - 1  # the bits of Bullet's segmentation that name the body; those above name the link
# TinyRenderer does not return when a vertex lies behind the plane of the eye by less than 1e-8 m, but not by 0. A pose
# with 1e-17 in place of 0 leads there, so poses are rounded to a micrometer and a microradian.
_DIGITS = 6
_AWAY = [0.0, 0.0, -1e4]  # m; parking place of a drone while its own camera renders
_AHEAD = 1000.0  # m; how far in front of the eye the camera's target is
_TINY_PRINCIPAL_POINT = np.array([0.5, -0.5])  # pixels; TinyRenderer samples the lower left corners of pixels
_NOWHERE = -1
_EYE, _FORWARD, _UP, _NEAR, _INSIDE = slice(0, 3), slice(3, 6), slice(6, 9), 9, 10  # columns of a view


@functools.partial(jax.jit, static_argnames="camera")
def views(params: Params, state: State, scene: Scene, camera: Camera) -> Float[Array, "n 11"]:
    """Camera views of a team: eye, forward and up (world), `near`, and the label of a solid around the eye.

    The label is that of the segmentation, -1 for none. Meshes and URDF files are ignored, as they may be hollow.
    """
    n, dtype = len(state.pos), state.pos.dtype

    def one(params: Params, state: State) -> Array:
        eye, axes = camera.pose(params, state)

        def distance(solid: Obstacle) -> Array:
            return jnp.where(solid.active, solid.distance(solid.to_local(eye)), jnp.inf)

        distances = [jax.vmap(distance)(kind) for kind in scene.shapes(dtype)]
        solids = jnp.concatenate([eye[2:] if scene.ground else jnp.ones(1, dtype), *distances])
        first = jnp.argmax(solids < 0)
        label = jnp.where(solids[first] < 0, jnp.where(first == 0, GROUND, n + first), _NOWHERE)
        return jnp.concatenate([eye, axes[0], axes[2], jnp.stack([camera.near_of(params), label.astype(dtype)])])

    return jax.vmap(one)(params, state)


def drone_pictures(
    client: Client, body: np.ndarray, looks: np.ndarray, camera: Camera
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """RGBA, depth and segmentation of the camera of every drone, each (n, height, width, ...).

    The team has been placed at the poses `body` (n, 7+), and `looks` are its `views`. An eye inside a solid sees that
    solid, black, at `near`.
    """
    p, (width, height) = client.p, camera.resolution
    frames = []
    for drone, row, look in zip(client.drones, body, looks, strict=True):
        near, inside = float(look[_NEAR]), int(look[_INSIDE])
        if inside != _NOWHERE:
            black = np.tile(np.array([0, 0, 0, 255], np.uint8), (height, width, 1))
            frames.append((black, np.full((height, width), near), np.full((height, width), inside, np.int32)))
            continue
        if not camera.sees_self:
            p.resetBasePositionAndOrientation(drone, _AWAY, [0, 0, 0, 1], physicsClientId=client.id)
        eye, forward, up = (np.round(look[columns], _DIGITS) for columns in (_EYE, _FORWARD, _UP))
        frames.append(_picture(client, eye, forward, up, camera, near))
        if not camera.sees_self:
            p.resetBasePositionAndOrientation(drone, row[:3], row[3:7], physicsClientId=client.id)
    rgb, depth, segmentation = zip(*frames, strict=True)
    return np.stack(rgb), np.stack(depth), np.stack(segmentation)


def photo(client: Client, eye: ArrayLike, target: ArrayLike, camera: Camera) -> np.ndarray:
    """One picture from `eye` towards `target` (m, world), upright: RGB (height, width, 3) uint8."""
    eye, target = np.asarray(eye, float), np.asarray(target, float)
    assert camera.near is not None
    return _picture(client, eye, (target - eye) / _AHEAD, np.array([0, 0, 1.0]), camera, camera.near)[0][..., :3]


def _picture(
    client: Client, eye: np.ndarray, forward: np.ndarray, up: np.ndarray, camera: Camera, near: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """RGBA uint8, depth (m), segmentation int32."""
    p, (width, height), far = client.p, camera.resolution, camera.far
    view = p.computeViewMatrix(eye.tolist(), (eye + _AHEAD * forward).tolist(), up.tolist())
    _, _, rgb, depth, bodies = p.getCameraImage(
        width,
        height,
        view,
        p.computeProjectionMatrix(*_frustum(client, camera, near), near, far),
        renderer=client.renderer,
        physicsClientId=client.id,
    )
    depth = np.reshape(depth, (height, width)).astype(float)
    depth = np.minimum(far * near / (far - (far - near) * depth), far)
    bodies = np.reshape(bodies, depth.shape)
    labels = client.labels[np.where(bodies < 0, -1, bodies & _BODY_MASK)]
    return np.reshape(rgb, (height, width, 4)).astype(np.uint8), depth, labels


def _frustum(client: Client, camera: Camera, near: float) -> tuple[float, float, float, float]:
    """Left, right, bottom and top edge of the image in the plane at `near`, m."""
    own = _TINY_PRINCIPAL_POINT if client.renderer == client.p.ER_TINY_RENDERER else np.zeros(2)
    half = near * np.array(camera.slopes)
    x, y = 2 * half * (np.array(camera.principal_point) - own) / np.array(camera.resolution)
    return -half[0] - x, half[0] - x, -half[1] + y, half[1] + y
