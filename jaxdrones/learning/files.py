"""Files with a JSON sidecar of metadata and checksums.

The sidecar has the SHA-256 checksums of the file and of its own content, so modified, truncated and mismatched files
are rejected. After a crash between two renames, the sidecar decides which content is valid: that of the file, or of
the new file beside it (`state.new.msgpack`).
"""

import dataclasses
import hashlib
import json
import os
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxdrones import writing
from jaxdrones.checks import short_repr
from jaxdrones.errors import UserError

FORMAT = 4
"""Version of the format; files of other versions are rejected."""

ADVICE = "use another checkpoint, or train again"


def save_bytes(file: Path, content: bytes, **about: Any) -> None:
    """Write a file and its sidecar atomically.

    Raises:
        ValueError: an entry of `about` that JSON cannot hold, and that would not be the same when it is read.
    """
    sidecar = {name: _plain(x) for name, x in about.items()} | {"format": FORMAT, "sha256": _digest(content)}
    sidecar = json.loads(json.dumps(sidecar, default=_as_json))
    sidecar["sidecar_sha256"] = _sidecar_digest(sidecar)
    file.parent.mkdir(parents=True, exist_ok=True)
    new = writing.beside(file)
    _finish(file)
    try:
        new.write_bytes(content)
        writing.flush(new)
        writing.write(file.with_suffix(".json"), json.dumps(sidecar, indent=2).encode())
    except OSError as error:  # the error of a full disk names no file
        new.unlink(missing_ok=True)
        raise OSError(error.errno, error.strerror, str(file)) from error
    writing.rename(file)  # after a crash before this line, `load_bytes` finds the content beside the file


def load_bytes(file: Path, sidecar: dict[str, Any]) -> bytes:
    """Content of a file of `save_bytes` (with its suffix) that must match its sidecar, from `read_sidecar`."""
    found = [content for content in map(_read, (file, writing.beside(file))) if content is not None]
    for content in found:
        if _digest(content) == sidecar["sha256"]:
            return content
    path = file.with_suffix("")
    if not found:
        raise FileNotFoundError(f"no checkpoint at {path}: {file} does not exist")
    raise UserError(
        f"{file} is damaged, or of another checkpoint than {file.with_suffix('.json').name}: its checksum differs; "
        + ADVICE
    )


def read_sidecar(path: str | os.PathLike) -> dict[str, Any]:
    """Content of the sidecar of a checkpoint."""
    path = Path(path)
    file = path.with_name(path.name + ".json")
    content = _read(file)
    if content is None:
        raise FileNotFoundError(f"no checkpoint at {path}: {file} does not exist")
    try:
        sidecar = json.loads(content)
        if not isinstance(sidecar, dict):
            raise UserError("it holds no JSON object")
        expected, found = sidecar.pop("sidecar_sha256", None), _sidecar_digest(sidecar)
    except (ValueError, RecursionError) as error:
        raise UserError(f"{file} is damaged: {one_line(error)}; {ADVICE}") from None
    if sidecar.get("format") != FORMAT:
        raise UserError(
            f"{file} has format {repr(sidecar.get('format'))[:20]}, this version reads {FORMAT}; train again"
        )
    if expected != found:
        raise UserError(f"{file} is damaged, or was edited after it was saved: its checksum differs; {ADVICE}")
    return sidecar


def one_line(error: Exception) -> str:
    """Message of an error in one line of at most 120 characters."""
    return " ".join(str(error).split())[:120] or type(error).__name__


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def _sidecar_digest(sidecar: dict[str, Any]) -> str:
    """Checksum of the entries of a sidecar, independent of their layout."""
    return _digest(json.dumps(sidecar, sort_keys=True).encode())


def _read(file: Path) -> bytes | None:
    try:
        return file.read_bytes()
    except FileNotFoundError:
        return None
    except OSError as error:
        raise UserError(f"{file} cannot be read: {error.strerror}; {ADVICE}") from error


def _finish(file: Path) -> None:
    """Complete an interrupted rename if the new content matches the sidecar."""
    left = _read(writing.beside(file))
    if left is None:
        return
    try:
        valid = _digest(left) == read_sidecar(file.with_suffix(""))["sha256"]
    except (FileNotFoundError, KeyError, ValueError):
        valid = False
    if valid:
        writing.rename(file)


def _plain(x):
    return dataclasses.asdict(x) if dataclasses.is_dataclass(x) else x


def _as_json(x: Any) -> Any:
    """Number or list in place of an array or a number of NumPy or JAX, and string in place of a path."""
    if isinstance(x, np.generic | np.ndarray | jax.Array):
        return np.asarray(x).tolist()
    if isinstance(x, os.PathLike):
        return os.fspath(x)
    raise UserError(f"{short_repr(x)} cannot be saved beside a policy; give numbers, strings, or lists of them")
