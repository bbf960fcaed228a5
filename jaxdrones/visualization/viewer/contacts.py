"""Forces of contact with the ground and with obstacles, estimated from a log."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from jaxdrones import rotation
from jaxdrones.dynamics.contact import rim
from jaxdrones.flights.log import FlightLog
from jaxdrones.visualization.shots import only_shapes

_NEAR = 5e-3  # m: distance below which a drone touches a surface
_SMALLEST = 0.1  # of the weight; drag and downwash are mostly smaller
_ANGLES = np.arange(8) * np.pi / 4


def contact_forces(log: FlightLog) -> np.ndarray | None:
    """(K, n, 3) forces of the ground and of obstacles on drones, N, world; `None` if there are none.

    A force is what thrust and weight lack to the mass times the acceleration, by differences of the logged velocities.
    It is zero where the rim of the drone touches nothing.
    """
    scene = only_shapes(log.scene)
    if len(log.t) < 2 or not (scene.ground or scene.has_obstacles):
        return None
    params = jax.tree.map(np.asarray, log.params.replace(aux={}))
    x, y, z = (np.asarray(axis, float) for axis in jax.vmap(jax.vmap(rotation.axes))(jnp.asarray(log.quat)))
    with np.errstate(invalid="ignore", over="ignore"):
        acceleration = np.gradient(np.asarray(log.vel, float), log.t, axis=0) + params.gravity[:, None] * [0, 0, 1]
        thrust = (params.kf * np.sum(np.asarray(log.rpm, float) ** 2, axis=-1))[..., None] * z
        forces = params.mass[:, None] * acceleration - thrust
        large = np.linalg.norm(forces, axis=-1) > _SMALLEST * params.mass * params.gravity
    row, drone = np.nonzero(large)
    if not len(row):
        return None
    radius, ring = (np.asarray(a)[drone, None, None] for a in jax.vmap(rim)(log.params))
    cos, sin = np.cos(_ANGLES)[:, None], np.sin(_ANGLES)[:, None]
    around = ring * (cos * x[row, drone][:, None] + sin * y[row, drone][:, None])
    centers = (log.pos + params.collision_offset[:, None] * z)[row, drone][:, None] + around
    distances = np.asarray(jax.jit(jax.vmap(jax.vmap(scene.distance)))(jnp.asarray(centers)))
    touching = np.zeros(large.shape, bool)
    touching[row, drone] = np.min(distances, axis=1) < radius[:, 0, 0] + _NEAR
    return np.where(touching[..., None], forces, 0) if touching.any() else None
