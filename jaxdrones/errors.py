"""Error of users' mistakes, and installation hints."""

import contextlib
import importlib.metadata
import json
import urllib.parse
from collections.abc import Iterator
from pathlib import Path


class UserError(ValueError):
    """Invalid argument, with a message of the problem, the given value and the remedy.

    The command line prints it as one line, and any other exception with its traceback.
    """


def install(extra: str) -> str:
    """Command that installs an extra, from the checkout or the wheel of this package."""
    place = Path(__file__).parents[1]
    if (place / "pyproject.toml").is_file():
        return f'pip install "{place}[{extra}]"'
    try:
        origin = importlib.metadata.distribution("jaxdrones").read_text("direct_url.json")
    except importlib.metadata.PackageNotFoundError:
        origin = None
    url = urllib.parse.urlsplit(json.loads(origin or "{}").get("url", ""))
    return f'pip install "{urllib.parse.unquote(url.path) or "WHEEL"}[{extra}]"'


@contextlib.contextmanager
def needs(package: str, extra: str, kind: type[Exception] = ImportError) -> Iterator[None]:
    """Context of imports of an optional package; an error of this kind tells how to install its extra."""
    try:
        yield
    except ImportError as error:
        raise kind(f"{package} is not installed; {install(extra)}") from error
