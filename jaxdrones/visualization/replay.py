"""Films of recorded flights of either backend, from outside or from on board. They need the extra `bullet`."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from jaxdrones.engine import bullet
from jaxdrones.flights.record import Record
from jaxdrones.params import repeat
from jaxdrones.sensing import Scene, camera_2021
from jaxdrones.state import State
from jaxdrones.urdf import load_params
from jaxdrones.visualization import video

FPS = 24  # frames per simulated second; the camera rate of gym-pybullet-drones (2021)

_DIRECTION = np.array([-0.6, -0.7, 0.4])  # from the middle of the flight to the camera
_DISTANCE = 1.6  # of the camera, over the extent of the flight
_MIN_EXTENT = 0.6  # m
_FAR = 1e6  # m; states beyond are not shown


def film(record: Record, path: Path, scene: Scene | None = None, fps: int = FPS) -> int:
    """Write a film of a flight from a camera that shows all of it; one frame per 1/fps of simulated time.

    Args:
        record: the flight.
        path: path of the film, .mp4 or .gif.
        scene: obstacles and ground; a bare ground plane when left out.
        fps: frames per second.

    Returns:
        The number of frames.

    Raises:
        ValueError: no state of the flight is finite.
    """
    video.check_video(path)
    if not len(_finite(record)):
        raise ValueError(f"{path} is not written: no state of the flight is finite")
    pos = record.pos[_finite(record)]
    low, high = pos.min(axis=(0, 1)), pos.max(axis=(0, 1))
    middle = (low + high) / 2
    eye = middle + _DIRECTION * _DISTANCE * max(_MIN_EXTENT, float(np.linalg.norm(high - low)))
    with bullet.make_step(scene=scene) as step:
        params = _params(record)
        frames = (step.photo(params, state, eye, middle) for state in _states(record, fps))
        return video.write(frames, path, fps)


def save_cameras(record: Record, folder: Path, scene: Scene | None = None, fps: int = FPS) -> int:
    """Write the pictures of every drone's camera as `drone 0/00000.png` and so on; returns their number."""
    from matplotlib.image import imsave

    count = 0
    with bullet.make_step(scene=scene) as step:
        params = _params(record)
        for frame, state in enumerate(_states(record, fps)):
            for label, picture in zip(record.labels, step.camera(params, state, camera_2021).rgb, strict=True):
                (folder / label).mkdir(parents=True, exist_ok=True)
                imsave(folder / label / f"{frame:05d}.png", picture)
                count += 1
    return count


def _params(record: Record):
    return repeat(load_params(record.conditions.vehicle), len(record.labels))


def _finite(record: Record) -> np.ndarray:
    """Rows in which the pose of every drone is a number that Bullet can show."""
    poses = np.concatenate([record.pos, record.quat], axis=-1)
    return np.flatnonzero((np.abs(poses) < _FAR).all(axis=(1, 2)))


def _states(record: Record, fps: int) -> Iterator[State]:
    """The recorded state nearest to every frame's time, out of those that can be shown; at least one."""
    rows = _finite(record)
    for time in np.arange(max(1, round(record.t[-1] * fps))) / fps:
        k = rows[np.abs(record.t[rows] - time).argmin()]
        yield State(record.pos[k], record.quat[k], record.vel[k], record.omega[k], record.rpm[k])
