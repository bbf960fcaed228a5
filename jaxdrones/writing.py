"""Whole files: written beside their place and then renamed, so that a crash leaves the old file or the new one."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def replaced(file: str | os.PathLike) -> Iterator[Path]:
    """A context with the path to write to; what was written there replaces the file at the end of the context.

    If the context raises, or the process is killed, the old file stays as it was. What is no ordinary file, such as
    /dev/stdout, is written in place.

    Raises:
        OSError: the file cannot be written; the error names it.
    """
    file = Path(file)
    if file.exists() and not file.is_file():
        yield file
        return
    new = beside(file)
    try:
        yield new
        rename(file)
    except OSError as error:  # that of a full disk names no file
        new.unlink(missing_ok=True)
        if error.filename in (None, str(new)):
            raise OSError(error.errno, error.strerror or str(error), str(file)) from error
        raise
    except BaseException:
        new.unlink(missing_ok=True)
        raise


def write(file: Path, content: bytes) -> None:
    """Write a whole file, or nothing if that fails.

    Raises:
        OSError: the file cannot be written; the error names it.
    """
    with replaced(file) as new:
        new.write_bytes(content)


def beside(file: Path) -> Path:
    """The path of a file until it is complete: `state.new.json` of `state.json`."""
    target = _target(file)
    return target.with_name(f"{target.stem}.new{target.suffix}")


def rename(file: Path) -> None:
    """Replace a file by the complete one beside it, when that is on the disk."""
    new = beside(file)
    _synchronize(new, os.O_RDWR)
    os.replace(new, _target(file))
    _synchronize(new.parent, os.O_RDONLY)


def _target(file: Path) -> Path:
    """The file that a link leads to, which stays a link."""
    return file.resolve() if file.is_symlink() else file


def _synchronize(path: Path, mode: int) -> None:
    """Wait until the content of a file, or the names in a folder, are on the disk."""
    descriptor = os.open(path, mode)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
