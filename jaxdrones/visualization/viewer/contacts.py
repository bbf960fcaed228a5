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
_rims, _axes = jax.jit(jax.vmap(rim)), jax.jit(jax.vmap(rotation.axes))


def contact_forces(log: FlightLog) -> np.ndarray | None:
    """(K, n, 3) forces of the ground and of obstacles on drones, N, world; `None` if there are none.

    A force is what thrust and weight lack to the mass times the acceleration, by differences of the logged velocities.
    It is zero where the rim of the drone touches nothing.
    """
    scene = only_shapes(log.scene)
    if len(log.t) < 2 or not (scene.ground or scene.has_obstacles):
        return None
    radius, ring = (np.asarray(x) for x in _rims(log.params))
    reach = radius + ring + np.abs(log.params.collision_offset) + _NEAR
    row, drone = np.nonzero((log.pos[..., 2] < reach) | scene.has_obstacles)
    if not len(row):
        return None
    params = jax.tree.map(lambda x: np.asarray(x, float)[drone], log.params.replace(aux={}))
    x, y, z = (np.asarray(axis, float) for axis in _axes(jnp.asarray(log.quat[row, drone])))
    with np.errstate(invalid="ignore", over="ignore"):
        acceleration = np.gradient(np.asarray(log.vel, float), log.t, axis=0)[row, drone]
        thrust = params.kf * np.sum(np.asarray(log.rpm[row, drone], float) ** 2, axis=-1)
        forces = params.mass[:, None] * acceleration + params.weight[:, None] * [0, 0, 1] - thrust[:, None] * z
        large = np.linalg.norm(forces, axis=-1) > _SMALLEST * params.weight
    if not large.any():
        return None
    row, drone, forces, x, y, z = (array[large] for array in (row, drone, forces, x, y, z))
    around = np.cos(_ANGLES)[:, None] * x[:, None] + np.sin(_ANGLES)[:, None] * y[:, None]
    center = log.pos[row, drone] + np.asarray(log.params.collision_offset)[drone, None] * z
    spheres = center[:, None] + ring[drone, None, None] * around
    distance = np.min(jax.jit(jax.vmap(jax.vmap(scene.distance)))(jnp.asarray(spheres)), axis=1)
    touching = distance < radius[drone] + _NEAR
    if not touching.any():
        return None
    found = np.zeros(log.pos.shape)
    found[row[touching], drone[touching]] = forces[touching]
    return found
