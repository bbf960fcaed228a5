"""Depth images in NumPy, independent of the package's rays: steps along each ray by the distance from all surfaces."""

import numpy as np

from jaxdrones.sensing import Box, Capsule, Cylinder, Sphere
from jaxdrones.sensing.shapes import single as one_of


def single(stack) -> list:
    """The obstacles of a kind, one by one."""
    return [one_of(stack, i) for i in range(len(stack.pos))]


def depth(view, obstacles, far: float, ground: bool = True, steps: int = 4000) -> np.ndarray:
    """(h, w) depth along the viewing axis of the first surface in front of a camera, m."""
    u, v, axes = (np.asarray(x) for x in (view.u, view.v, view.axes))
    u, v = np.broadcast_arrays(u, v)
    rays = axes[0] + u[..., None] * axes[1] + v[..., None] * axes[2]
    length = np.linalg.norm(rays, axis=-1)
    depths = np.full(u.shape, float(view.near))
    for _ in range(steps):
        points = np.asarray(view.eye) + depths[..., None] * rays
        distances = [_distance(obstacle, points) for obstacle in obstacles]
        distances += [points[..., 2]] if ground else []
        gap = np.min(distances, axis=0)
        depths = np.minimum(depths + gap / length, far)
        if np.all((np.abs(gap) < 1e-9) | (depths >= far)):
            break
    return depths


def _distance(obstacle, points: np.ndarray) -> np.ndarray:
    """Signed distance, after the formulas of Quilez (iquilezles.org, "distance functions")."""
    x, y, z, w = np.asarray(obstacle.quat)
    turn = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    p = (points - np.asarray(obstacle.pos)) @ turn
    match obstacle:
        case Box(size=size):
            q = np.abs(p) - np.asarray(size) / 2
        case Sphere(radius=radius):
            return np.linalg.norm(p, axis=-1) - float(radius)
        case Cylinder(radius=radius, height=height):
            q = np.stack([np.hypot(p[..., 0], p[..., 1]) - float(radius), np.abs(p[..., 2]) - float(height) / 2], -1)
        case Capsule(radius=radius, height=height):
            p[..., 2] -= np.clip(p[..., 2], -float(height) / 2, float(height) / 2)
            return np.linalg.norm(p, axis=-1) - float(radius)
    return np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(np.max(q, axis=-1), 0)
