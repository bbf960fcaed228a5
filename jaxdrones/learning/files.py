"""Files with a sidecar: a JSON file beside each file that describes it and holds its checksum.

The sidecar holds the SHA-256 checksum of the file and one of its own content, so that a file that was changed,
truncated or taken from elsewhere is refused. The sidecar decides which content is valid: that of the file, or that of
the file beside it (`state.new.msgpack`) that a process leaves when it is killed between two renames.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
from pathlib import Path
from typing import Any

from jaxdrones import writing
from jaxdrones.errors import UserError

FORMAT = 4
"""Version of the format; files of another version are refused."""

ADVICE = "take another checkpoint, or train anew"


def save_bytes(file: Path, content: bytes, **about: Any) -> None:
    """Write a file and its sidecar; a crash leaves both of the new files or both of the old ones."""
    sidecar = {name: _plain(x) for name, x in about.items()} | {"format": FORMAT, "sha256": _digest(content)}
    sidecar = json.loads(json.dumps(sidecar, default=str))
    sidecar["sidecar_sha256"] = _sidecar_digest(sidecar)
    file.parent.mkdir(parents=True, exist_ok=True)
    new = writing.beside(file)
    _finish(file)
    try:
        new.write_bytes(content)
        writing.write(file.with_suffix(".json"), json.dumps(sidecar, indent=2).encode())
    except OSError as error:  # that of a full disk names no file
        new.unlink(missing_ok=True)
        raise OSError(error.errno, error.strerror, str(file)) from error
    writing.rename(file)  # after a crash before this line, `load_bytes` finds the content beside the file


def load_bytes(file: Path, sidecar: dict[str, Any]) -> bytes:
    """The content of the file that `save_bytes` wrote.

    Args:
        file: path with its ending.
        sidecar: content of its sidecar, from `read_sidecar`.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it cannot be read, or is not the file that the sidecar describes.
    """
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
    """The content of the sidecar of a checkpoint.

    Raises:
        FileNotFoundError: there is no checkpoint.
        ValueError: the sidecar is damaged, or of another version of this library.
    """
    path = Path(path)
    file = _sidecar_file(path)
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
            f"{file} has format {repr(sidecar.get('format'))[:20]}, this version reads {FORMAT}; train anew"
        )
    if expected != found:
        raise UserError(f"{file} is damaged, or was edited after it was saved: its checksum differs; {ADVICE}")
    return sidecar


def one_line(error: Exception) -> str:
    """The message of an error in one line of at most 120 characters."""
    return " ".join(str(error).split())[:120] or type(error).__name__


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def _sidecar_digest(sidecar: dict[str, Any]) -> str:
    """Checksum of the entries of a sidecar, which does not depend on their layout."""
    return _digest(json.dumps(sidecar, sort_keys=True).encode())


def _read(file: Path) -> bytes | None:
    """The content of a file; `None` if there is no such file."""
    try:
        return file.read_bytes()
    except FileNotFoundError:
        return None
    except OSError as error:
        raise UserError(f"{file} cannot be read: {error.strerror}; {ADVICE}") from error


def _finish(file: Path) -> None:
    """Rename the content that a killed process left beside the file, if it is the one that the sidecar describes."""
    left = _read(writing.beside(file))
    if left is None:
        return
    try:
        valid = _digest(left) == read_sidecar(file.with_suffix(""))["sha256"]
    except (FileNotFoundError, KeyError, ValueError):
        valid = False
    if valid:
        writing.rename(file)


def _sidecar_file(path: Path) -> Path:
    return path.with_name(path.name + ".json")


def _plain(x):
    return dataclasses.asdict(x) if dataclasses.is_dataclass(x) else x
