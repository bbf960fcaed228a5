"""Camera of a film: close to the whole team, with an unobstructed view."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxdrones.errors import UserError
from jaxdrones.flights.log import FlightLog
from jaxdrones.sensing import Mesh, Scene, Urdf, from_urdf, ray

FIELD_OF_VIEW = 45.0  # degrees, vertical
_SLOPE = float(np.tan(np.deg2rad(FIELD_OF_VIEW) / 2))  # half of the height of a picture at 1 m, m
_FAR = 1e6  # m; states beyond are not shown
_FILLED = 0.85  # largest fraction of the picture, along each side, for the team
_LARGE = 0.06  # smallest height of a drone over that of the picture for a static camera
_WINDOW = 1.2  # s around each time with all positions in view, for a smooth camera motion
_SCALES = (1.0, 3.0, 10.0)  # of the size of drones
_SMALL = 0.03  # height of a drone over that of the picture below which it is enlarged
_ELEVATIONS = (0.46, 0.9)  # rad, of the camera above the team
_AZIMUTHS = np.deg2rad([229, 139, 319, 49, 184, 274, 94, 4])  # of the camera, in order of preference
_LOOKS, _LOOKED_AT = 24, 8  # times and drones of the sight lines
_POINTS = 3000  # largest number of points of a flight to keep in view
_CORNERS = np.stack(np.meshgrid(*[[-0.5, 0.5]] * 3), axis=-1).reshape(-1, 3)  # of a box of size 1
_BLOCKING = 0.2  # fraction of obstructed sight lines above which an obstacle is left out


class Shot(NamedTuple):
    """Camera and scene of a film of F frames."""

    rows: np.ndarray
    """(F,) row of the record in every frame."""
    eyes: np.ndarray
    """(F, 3) position of the camera, m, world."""
    targets: np.ndarray
    """(F, 3) center of the picture, m, world."""
    scene: Scene
    """Boxes, spheres, cylinders and capsules, without those that hide the team."""
    scale: float
    """Enlargement of drones, above 1 if they are too small otherwise."""


def shoot(record: FlightLog, fps: int, aspect: float) -> Shot:
    """Choose the camera of a film with a frame for every 1/fps of simulated time, at least one.

    The camera is static if the whole flight fits with large enough drones. Otherwise it follows the bounding box of the
    team. Its direction is that with the fewest obstructed sight lines; an obstacle that still obstructs a fifth of
    them, such as a ceiling, is left out. `aspect` is the width of the picture over its height.

    Raises:
        ValueError: no finite state in the flight.
    """
    finite, rows = _finite_rows(record), rows_of_frames(record, fps)
    reach = float(np.max(np.linalg.norm(record.params.rotor_pos, axis=-1).max(-1) + record.params.prop_radius))
    directions = [  # from the team to the camera, in order of preference
        np.array([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)])
        for up in _ELEVATIONS
        for around in _AZIMUTHS
    ]
    everything = np.concatenate([record.pos[finite], record.target_pos[finite]], axis=1).reshape(-1, 3).astype(float)
    everything = everything[np.isfinite(everything).all(axis=1)]
    everything = everything[:: max(1, len(everything) // _POINTS)]
    middle = (everything.min(axis=0) + everything.max(axis=0)) / 2
    points = (everything - middle)[None]
    if reach / (_distance(points, reach, directions[0], aspect)[0] * _SLOPE) >= _LARGE:
        middle, points = (np.broadcast_to(x, (len(rows), *x.shape[-k:])) for x, k in ((middle, 1), (points, 2)))
    else:
        team = record.pos[rows].astype(float)
        low, high = _calm(team.min(axis=1), team.max(axis=1), round(_WINDOW / 2 * fps))
        middle, points = (low + high) / 2, (high - low)[:, None] * _CORNERS
    scene = only_shapes(record.scene)
    some = np.unique(np.linspace(0, len(rows) - 1, _LOOKS).round().astype(int))
    seen = record.pos[rows[some], :_LOOKED_AT]
    eyes = np.stack([middle + _distance(points, reach, d, aspect)[:, None] * d for d in directions])
    hidden = _hidden(scene, eyes[:, some], seen)  # (obstacles, directions, sight lines)
    best = int(np.argmin(hidden.any(axis=0).mean(axis=-1).round(1)))
    blocking = hidden[:, best].mean(axis=-1) > _BLOCKING
    kept = [solid for i, solid in scene.numbered.items() if not blocking[i]]
    scene = Scene.of(*kept, ground=scene.ground)
    smallest = reach / (np.linalg.norm(eyes[best] - middle, axis=1).max() * _SLOPE)
    scale = next((scale for scale in _SCALES if scale * smallest > _SMALL), _SCALES[-1])
    return Shot(rows, eyes[best], middle, scene, scale)


def rows_of_frames(record: FlightLog, fps: int) -> np.ndarray:
    """Row (F,) with finite poses nearest to the time of every frame, at least one.

    Raises:
        ValueError: no finite state in the flight.
    """
    finite = _finite_rows(record)
    if not len(finite):
        raise UserError("the film is not written: no state of the flight is finite")
    times = record.begin + np.arange(max(1, round((record.t[-1] - record.begin) * fps))) / fps
    return finite[[int(np.abs(record.t[finite] - time).argmin()) for time in times]]


def _finite_rows(record: FlightLog) -> np.ndarray:
    """Rows with finite poses of every drone."""
    poses = np.concatenate([record.pos, record.quat], axis=-1)
    return np.flatnonzero((np.abs(poses) < _FAR).all(axis=(1, 2)))


def only_shapes(scene: Scene) -> Scene:
    """Convert a scene to basic shapes: a mesh to its bounding box, a URDF to its collision elements."""
    solids: list = []
    for solid in scene.numbered.values():
        if isinstance(solid, Urdf):
            solids += only_shapes(from_urdf(solid.path, solid.pos, solid.quat, ground=False)).numbered.values()
        else:
            solids.append(solid.bounding_box() if isinstance(solid, Mesh) else solid)
    return Scene.of(*solids, ground=scene.ground)


def _calm(low: np.ndarray, high: np.ndarray, half: int) -> tuple[np.ndarray, np.ndarray]:
    """Smoothed bounding boxes: means of boxes that contain all within `half` frames."""
    from scipy import ndimage  # loading it takes a tenth of a second

    window: Any = dict(size=2 * half + 1, axis=0, mode="nearest")
    widest = ndimage.minimum_filter1d(low, **window), ndimage.maximum_filter1d(high, **window)
    return ndimage.uniform_filter1d(widest[0], **window), ndimage.uniform_filter1d(widest[1], **window)


def _distance(points: np.ndarray, reach: float, direction: np.ndarray, aspect: float) -> np.ndarray:
    """Distances (F,) of a camera in a direction with points (F, m, 3), and `reach` m around them, in view, m."""
    right = np.cross([0, 0, 1.0], direction)
    right /= np.linalg.norm(right)
    up = np.cross(direction, right)
    tall = _FILLED * _SLOPE
    across = np.maximum((np.abs(points @ right) + reach) / (tall * aspect), (np.abs(points @ up) + reach) / tall)
    return (across + points @ direction).max(axis=1)


def _hidden(scene: Scene, eyes: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """(k, d, F n) mask of k obstacles between the camera (d, F, 3), in d directions, and the drones (F, n, 3)."""
    ends = jnp.asarray(np.broadcast_to(seen, (len(eyes), *seen.shape)).reshape(-1, 3))
    begins = jnp.asarray(np.repeat(eyes[:, :, None], seen.shape[1], axis=2).reshape(-1, 3))

    def hits(begin: Float[jax.Array, "3"], end: Float[jax.Array, "3"], solid) -> jax.Array:
        return ray(Scene.of(solid, ground=False), begin, end - begin) < 1

    lines = jax.vmap(hits, (0, 0, None))
    found = [jax.jit(jax.vmap(lines, (None, None, 0)))(begins, ends, kind) for kind in scene.shapes(ends.dtype)]
    none = np.zeros((0, len(ends)), bool)
    return np.concatenate([none, *found]).reshape(-1, len(eyes), seen.shape[0] * seen.shape[1])
