"""Films and on-board pictures of recorded flights, rendered by Bullet (extra `bullet`)."""

from collections.abc import Generator
from pathlib import Path

import numpy as np

from jaxdrones.engine import bullet
from jaxdrones.flights.log import FlightLog, ImageSequence
from jaxdrones.sensing import Camera, camera_2021
from jaxdrones.visualization.shots import FIELD_OF_VIEW, rows_of_frames, shoot

FPS = 24  # frames per simulated second; the camera rate of gym-pybullet-drones (2021)


def frames(record: FlightLog, fps: int, size: tuple[int, int]) -> Generator[np.ndarray]:
    """Frames (height, width, 3) uint8 of a film by Bullet."""
    shot = shoot(record, fps, size[0] / size[1])
    camera = Camera(resolution=size, field_of_view=FIELD_OF_VIEW, near=0.02)
    with bullet.make_step(scene=record.scene) as step:
        for row, eye, target in zip(shot.rows, shot.eyes, shot.targets, strict=True):
            yield step.photo(record.params, record.state(row), eye, target, camera)


def save_cameras(record: FlightLog, folder: Path, fps: int = FPS) -> ImageSequence:
    """Write the images of every drone's camera as `drone 0/00000.png` etc., in place of earlier ones; return them."""
    from matplotlib.image import imsave

    for earlier in folder.glob(f"drone */{5 * '[0-9]'}.png"):
        earlier.unlink()
    t, pictures = [], []
    with bullet.make_step(scene=record.scene) as step:
        for frame, row in enumerate(rows_of_frames(record, fps)):
            rgb = step.camera(record.params, record.state(row), camera_2021).rgb
            for label, picture in zip(record.labels, rgb, strict=True):
                (folder / label).mkdir(parents=True, exist_ok=True)
                imsave(folder / label / f"{frame:05d}.png", picture)
            t.append(record.begin + frame / fps)
            pictures.append(np.asarray(rgb))
    return ImageSequence(np.array(t), np.stack(pictures))
