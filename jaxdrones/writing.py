"""Atomic writing of files by renaming, and JSON."""

import contextlib
import json
import math
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any


@contextlib.contextmanager
def replaced(file: str | os.PathLike) -> Iterator[Path]:
    """Context with a temporary path that replaces the file at its end.

    If the context raises, or the process is killed, the old file is unchanged. Special files, such as /dev/stdout, are
    written in place.
    """
    file = Path(file)
    if file.exists() and not file.is_file():
        yield file
        return
    new = beside(file)
    try:
        yield new
        rename(file)
    except OSError as error:  # the error of a full disk names no file
        new.unlink(missing_ok=True)
        if error.filename in (None, str(new)):
            raise OSError(error.errno, error.strerror or str(error), str(file)) from error
        raise
    except BaseException:
        new.unlink(missing_ok=True)
        raise


def write(file: Path, content: bytes) -> None:
    """Write a file atomically."""
    with replaced(file) as new:
        new.write_bytes(content)


def beside(file: Path) -> Path:
    """Temporary path of an incomplete file: `state.new.json` for `state.json`."""
    target = _target(file)
    return target.with_name(f"{target.stem}.new{target.suffix}")


def rename(file: Path) -> None:
    """Flush the new file beside a file to the disk, and rename it."""
    new = beside(file)
    flush(new)
    os.replace(new, _target(file))
    _synchronize(new.parent, os.O_RDONLY)


def flush(file: Path) -> None:
    """Flush the content of a file to the disk."""
    _synchronize(file, os.O_RDWR)


def _target(file: Path) -> Path:
    """Target of a link, to keep the link."""
    return file.resolve() if file.is_symlink() else file


def _synchronize(path: Path, mode: int) -> None:
    """Flush the content of a file, or the names in a folder, to the disk."""
    descriptor = os.open(path, mode)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def as_json(tree: Any, indent: int | None = None) -> str:
    """JSON, by default in one line, with null for numbers that are not finite."""
    return json.dumps(finite(tree), indent=indent, allow_nan=False)


def finite(tree: Any) -> Any:
    """The same dictionaries and lists with `None` for numbers that are not finite."""
    if isinstance(tree, dict):
        return {name: finite(x) for name, x in tree.items()}
    if isinstance(tree, list | tuple):
        return [finite(x) for x in tree]
    return None if isinstance(tree, float) and not math.isfinite(tree) else tree
