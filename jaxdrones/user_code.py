"""What a user's Python file defines, named as `file.py:name`."""

from __future__ import annotations

import functools
import hashlib
import sys
import traceback
import types
from pathlib import Path
from typing import Any

from jaxdrones.checks import hint
from jaxdrones.errors import UserError


def is_reference(text: str) -> bool:
    """Whether a text names a file of Python, or something in it."""
    return ".py:" in text or text.endswith(".py")


def split_reference(reference: str) -> tuple[Path, str]:
    """The file of `file.py:name`, and the name.

    Raises:
        ValueError: the name is missing.
    """
    file, _, name = reference.rpartition(":")
    if not (file and name):
        file = reference.removesuffix(":")
        raise UserError(f"{reference} names a file alone; give {file}:NAME, with the name of what the file defines")
    return Path(file), name


def read_text(file: Path) -> str:
    """The text of a user's file.

    Raises:
        ValueError: the file cannot be read.
    """
    try:
        return file.read_text(encoding="utf-8")
    except OSError as error:
        raise UserError(f"{file}: cannot be read ({error.strerror}); give the path of a file") from None
    except UnicodeDecodeError as error:
        raise UserError(f"{file}: cannot be read ({error.reason}); save it as UTF-8") from None


def load(reference: str) -> Any:
    """What `file.py:name` names; the file is executed.

    Raises:
        ValueError: the file cannot be read or executed, or does not define the name.
    """
    file, name = split_reference(reference)
    return definition(file.name, read_text(file), name)


def definition(file: str, text: str, name: str) -> Any:
    """What the text of a Python file defines under a name; equal texts are executed once.

    Args:
        file: name of the file, for errors.
        text: what is executed. It stands alone: it may import libraries, but no files beside it.
        name: of a function, for example.

    Raises:
        ValueError: the text cannot be executed, or does not define the name.
    """
    module = _executed(file, text)
    if name not in vars(module):
        own = [key for key, x in vars(module).items() if getattr(x, "__module__", None) == module.__name__]
        raise UserError(f"{file} defines no {name!r}{hint(name, own)} (it defines {', '.join(own) or 'nothing'})")
    return vars(module)[name]


@functools.cache
def _executed(file: str, text: str) -> types.ModuleType:
    """The module that the text of a file is."""
    digest = hashlib.sha256(text.encode()).hexdigest()[:12]
    module = types.ModuleType(f"{Path(file).stem}_{digest}")
    module.__file__ = file
    sys.modules[module.__name__] = module  # where dataclasses look for the types that they name
    try:
        exec(compile(text, file, "exec", dont_inherit=True), vars(module))
    except Exception as error:
        del sys.modules[module.__name__]
        lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == file]
        line = error.lineno if isinstance(error, SyntaxError) else lines[-1] if lines else None
        what = f"{type(error).__name__}: {error.msg if isinstance(error, SyntaxError) else error}"
        alone = "; a file of yours may import libraries, but no files beside it" * isinstance(error, ImportError)
        raise UserError(f"{file}: line {line} raises {what}{alone}") from error
    return module
