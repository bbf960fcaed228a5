"""Forces of contact with the ground, with obstacles and with other drones, estimated from a log."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxdrones import rotation
from jaxdrones.dynamics.contact import contact_radius, gap, rim
from jaxdrones.flights.log import FlightLog
from jaxdrones.state import State
from jaxdrones.visualization.shots import only_shapes

_NEAR = 5e-3  # m: distance below which a drone touches a surface or another drone
_SMALLEST = 0.1  # of the weight; drag and downwash are mostly smaller
_ANGLES = np.arange(8) * np.pi / 4


def contact_forces(log: FlightLog) -> np.ndarray | None:
    """(K, n, 3) forces of the ground, of obstacles and of other drones on drones, N, world; `None` if there are none.

    A force is the mass times the acceleration, from differences of the logged velocities, less thrust and weight. It is
    zero where the collision shape of the drone touches nothing.
    """
    scene = only_shapes(log.scene)
    team = len(log.labels) > 1
    if len(log.t) < 2 or not (scene.ground or scene.has_obstacles or team):
        return None
    radius, ring = (np.asarray(x) for x in _rims(log.params))
    reach = radius + ring + np.abs(log.params.collision_offset) + _NEAR
    row, drone = np.nonzero((log.pos[..., 2] < reach) | scene.has_obstacles | team)
    if not len(row):
        return None
    params = log.params
    in_air = params.kf * params.relative_density
    mass, weight, kf = (np.asarray(x, float)[drone] for x in (params.mass, params.weight, in_air))
    x, y, z = (np.asarray(axis, float) for axis in _axes(np.asarray(log.quat[row, drone])))
    with np.errstate(invalid="ignore", over="ignore"):
        acceleration = np.gradient(np.asarray(log.vel, float), log.t, axis=0)[row, drone]
        thrust = kf * np.sum(np.asarray(log.rpm[row, drone], float) ** 2, axis=-1)
        forces = mass[:, None] * acceleration + weight[:, None] * [0, 0, 1] - thrust[:, None] * z
        large = np.linalg.norm(forces, axis=-1) > _SMALLEST * weight
    if not large.any():
        return None
    row, drone, forces, x, y, z = (array[large] for array in (row, drone, forces, x, y, z))
    touching = np.zeros(len(row), bool)
    if scene.ground or scene.has_obstacles:
        around = np.cos(_ANGLES)[:, None] * x[:, None] + np.sin(_ANGLES)[:, None] * y[:, None]
        center = log.pos[row, drone] + np.asarray(log.params.collision_offset)[drone, None] * z
        spheres = center[:, None] + ring[drone, None, None] * around
        touching |= np.min(_distances(spheres, scene=scene), axis=1) < radius[drone] + _NEAR
    if team:
        touching |= _touching_each_other(log, row, drone)
    if not touching.any():
        return None
    found = np.zeros(log.pos.shape)
    found[row[touching], drone[touching]] = forces[touching]
    return found


def _touching_each_other(log: FlightLog, row: np.ndarray, drone: np.ndarray) -> np.ndarray:
    """Mask of the entries (row, drone) of a log that touch another entry of the same row."""
    pos = np.asarray(log.pos, float)[row, drone]
    params = log.params.replace(aux={})
    pairs = _close_pairs(row, pos, 2 * float(jnp.max(jax.vmap(contact_radius)(params))) + _NEAR)
    touching = np.zeros(len(row), bool)
    if len(pairs):
        bodies: list[Any] = []
        for entry in pairs.T:
            state = {name: getattr(log, name)[row[entry], drone[entry]] for name in ("quat", "vel", "omega", "rpm")}
            bodies += [jax.tree.map(lambda x, i=drone[entry]: np.asarray(x)[i], params), State(pos[entry], **state)]
        touching[pairs[_gaps(*bodies) < _NEAR]] = True
    return touching


def _close_pairs(row: np.ndarray, pos: np.ndarray, reach: float) -> np.ndarray:
    """(m, 2) indices of points (k, 3) of the same row that are closer than `reach` m; each pair once."""
    from scipy.spatial import KDTree  # loading it takes a tenth of a second

    finite = np.flatnonzero(np.isfinite(pos).all(axis=1))
    apart = 2 * reach * row[finite, None]  # points of different rows are far apart along a fourth axis
    return finite[KDTree(np.hstack([pos[finite], apart])).query_pairs(reach, output_type="ndarray")]


def _mapped(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compiled map of a function over the rows of its arguments, with constants by name.

    The number of rows is rounded up to a power of two, at least 64, because each number is compiled.
    """
    compiled = jax.jit(lambda rows, constants: jax.vmap(lambda row: function(*row, **constants))(rows))

    def mapped(*rows: Any, **constants: Any) -> Any:
        count = len(jax.tree.leaves(rows)[0])
        more = max(64, 1 << (count - 1).bit_length()) - count

        def padded(x: Any) -> np.ndarray:
            return np.pad(x, [(0, more)] + [(0, 0)] * (np.ndim(x) - 1), mode="edge")

        return jax.tree.map(lambda x: np.asarray(x)[:count], compiled(jax.tree.map(padded, rows), constants))

    return mapped


_rims = jax.jit(jax.vmap(rim))
_axes = _mapped(rotation.axes)
_distances = _mapped(lambda points, scene: jax.vmap(scene.distance)(points))
_gaps = _mapped(gap)
