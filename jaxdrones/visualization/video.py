"""Write films as MP4 (extra `video`) or GIF."""

import os
import warnings
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from jaxdrones.arguments import Count, checked
from jaxdrones.errors import UserError, install
from jaxdrones.writing import replaced

SUFFIXES = (".mp4", ".gif")
_FASTEST_GIF = 50  # frames per second; browsers show a frame of less than 2/100 s for 1/10 s


def check_video(path: str | os.PathLike, fps: int = 1) -> None:
    """Raise `ValueError` for an unknown suffix, too many frames per second or a package that is not installed."""
    path = Path(path)
    if path.suffix not in SUFFIXES:
        raise UserError(f"{path}: films end in {' or '.join(SUFFIXES)}")
    if path.suffix == ".gif" and fps > _FASTEST_GIF:
        raise UserError(
            f"{path}: a GIF has at most {_FASTEST_GIF} frames per second, not {fps}; give fewer, or an .mp4"
        )
    try:
        import PIL  # noqa: F401

        if path.suffix == ".mp4":
            import imageio_ffmpeg  # noqa: F401
    except ImportError as error:
        raise UserError(f"{error.name} is not installed, so {path} cannot be written; {install('video')}") from None


@checked
def write(frames: Iterable[np.ndarray], path: str | os.PathLike, fps: Count) -> int:
    """Write RGB frames as a film; return their number.

    Args:
        frames: (height, width, 3) uint8 each, at least one; they may be made one after the other by a generator.
        path: .mp4 or .gif; missing folders are created.
        fps: frames per second.

    Raises:
        ValueError: frames that are not such arrays, no frame, an unknown suffix, too many frames per second, or a
            package that is not installed.
        OSError: the file cannot be written.
    """
    path = Path(path)
    check_video(path, fps)
    path.parent.mkdir(parents=True, exist_ok=True)
    return (_write_mp4 if path.suffix == ".mp4" else _write_gif)(_valid(frames), path, fps)


def _valid(frames: Iterable[np.ndarray]) -> Iterator[np.ndarray]:
    """Validated frames."""
    first = None
    for k, frame in enumerate(frames):
        array = np.asarray(frame)
        if array.ndim != 3 or array.shape[-1] != 3 or 0 in array.shape or array.dtype != np.uint8:
            example = "(255 * frame).astype(numpy.uint8) for colors from 0 to 1"
            raise UserError(
                f"frame {k} is an array {array.shape} of {array.dtype}; give (height, width, 3) of uint8, {example}"
            )
        first = first or array.shape
        if array.shape != first:
            raise UserError(f"frame {k} has shape {array.shape}, the first {first}; give frames of one size")
        yield array
    if first is None:
        raise UserError("there are no frames; give at least one")


def _write_mp4(frames: Iterable[np.ndarray], path: Path, fps: int) -> int:
    import imageio_ffmpeg

    new = path.absolute().with_name(f".{path.stem.replace('%', '')}.new.mp4")  # absolute: not an option, no protocol
    writer: Any = None
    count = 0
    try:
        for frame in frames:
            if writer is None:
                size = frame.shape[1::-1]
                writer = imageio_ffmpeg.write_frames(
                    str(new), size, fps=fps, quality=7, macro_block_size=2, ffmpeg_log_level="quiet"
                )
                with warnings.catch_warnings():  # about forking a process with threads: it becomes ffmpeg at once
                    warnings.simplefilter("ignore", RuntimeWarning)
                    writer.send(None)
            writer.send(np.ascontiguousarray(frame))
            count += 1
        writer.close()
        if imageio_ffmpeg.count_frames_and_secs(new)[0] != count:
            raise OSError("frames are missing")
        new.replace(path)
    except (OSError, RuntimeError) as error:  # RuntimeError: invalid film
        raise OSError(f"{path} cannot be written, ffmpeg failed; is the disk full, or the folder read-only?") from error
    finally:
        if writer is not None:
            writer.close()
        new.unlink(missing_ok=True)
    return count


def _write_gif(frames: Iterable[np.ndarray], path: Path, fps: int) -> int:
    from PIL import Image

    images = [Image.fromarray(frame) for frame in frames]
    ends = 10 * np.round(100 * np.arange(len(images) + 1) / fps)  # ms; GIF counts in hundredths of a second
    durations = np.diff(ends).astype(int).tolist()
    with replaced(path) as new:
        images[0].save(new, save_all=True, append_images=images[1:], duration=durations, loop=0)
    return len(images)
