"""Objects of users' Python files, named `file.py:name`."""

import contextlib
import functools
import hashlib
import inspect
import sys
import traceback
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax

from jaxdrones.checks import hint
from jaxdrones.errors import UserError

_modules: set[str] = set()  # names of the modules of users' files
_OF_TRACING = (jax.errors.ConcretizationTypeError, jax.errors.TracerArrayConversionError)


def is_reference(text: str) -> bool:
    """Whether a string names a Python file, or an object in it."""
    return ".py:" in text or text.endswith(".py")


def split_reference(reference: str) -> tuple[Path, str]:
    """Split `file.py:name` into file and name."""
    file, _, name = reference.rpartition(":")
    if not (file and name):
        file = reference.removesuffix(":")
        raise UserError(f"{reference} names only a file; give {file}:NAME, with the name of an object in the file")
    return Path(file), name


def read_text(file: Path) -> str:
    """Read the text of a user's file."""
    try:
        return file.read_text(encoding="utf-8")
    except OSError as error:
        raise UserError(f"{file}: cannot be read ({error.strerror}); give the path of a file") from None
    except UnicodeDecodeError as error:
        raise UserError(f"{file}: cannot be read ({error.reason}); save it as UTF-8") from None


def load(reference: str) -> Any:
    """Load the object `file.py:name` by executing the file."""
    file, name = split_reference(reference)
    return definition(file.name, read_text(file), name)


def definition(file: str, text: str, name: str) -> Any:
    """Object of a name in the text of a Python file; equal texts are executed once.

    The code may import libraries, but not files in the same folder; `file` is its name in messages.
    """
    module = _executed(file, text)
    if name not in vars(module):
        own = [key for key, x in vars(module).items() if getattr(x, "__module__", None) == module.__name__]
        raise UserError(f"{file} defines no {name!r}{hint(name, own)} (it defines {', '.join(own) or 'nothing'})")
    return vars(module)[name]


def blame(error: BaseException) -> str | None:
    """Location in a user's file and message of an error, on one line; `None` for other errors."""
    frames = [x for x in traceback.walk_tb(error.__traceback__) if x[0].f_globals.get("__name__") in _modules]
    if not frames:
        return None
    frame, line = frames[-1]
    code = frame.f_code
    within = "" if code.co_name.startswith("<") else f" ({code.co_name})"
    said = f": {error}" if isinstance(error, UserError) else f" raises {_said(error)}"
    return f"{code.co_filename}: line {line}{within}{said}"


def place(function: Any) -> str:
    """File and line of a function, such as `my_task.py, line 12`; empty if unknown."""
    code = getattr(inspect.unwrap(getattr(function, "func", function)), "__code__", None)
    return "" if code is None else f"{Path(code.co_filename).name}, line {code.co_firstlineno}"


def _said(error: BaseException) -> str:
    """Type and message of an error, with a hint for errors of JAX."""
    kind = type(error).__name__
    if isinstance(error, SystemExit):
        return f"{kind}({error.code!r}); your file must not exit the program"
    message, _, more = str(error).strip().partition("\n")
    if isinstance(error, _OF_TRACING):
        return f"{kind}: {message}; JAX compiles this function: use jax.numpy, and jax.numpy.where in place of if"
    return f"{kind}: {message}{' ...' * bool(more)}" if message else kind


@contextlib.contextmanager
def errors_of(called: str, remedy: str) -> Iterator[None]:
    """Context of a call of a user's function: an error becomes a `UserError` of one line with the remedy."""
    try:
        yield
    except UserError:
        raise
    except Exception as error:
        raise UserError(f"{called} raises {_said(error).rstrip('.')}; {remedy}") from error


@functools.cache
def _executed(file: str, text: str) -> types.ModuleType:
    digest = hashlib.sha256(text.encode()).hexdigest()[:12]
    module = types.ModuleType(f"{Path(file).stem}_{digest}")
    module.__file__ = file
    sys.modules[module.__name__] = module  # for the type lookup of dataclasses
    _modules.add(module.__name__)
    try:
        exec(compile(text, file, "exec", dont_inherit=True), vars(module))
    except (Exception, SystemExit) as error:
        del sys.modules[module.__name__]
        not_found = isinstance(error, ImportError) and (error.name or "").partition(".")[0] not in sys.modules
        alone = "; your file may import libraries, but not files in the same folder" * not_found
        if isinstance(error, SyntaxError) and error.filename == file:
            said = f"{file}: line {error.lineno} raises {type(error).__name__}: {error.msg}"
        else:  # text with a null byte is refused before any line of it
            said = blame(error) or f"{file}: {_said(error)}"
        raise UserError(said + alone) from error
    return module
