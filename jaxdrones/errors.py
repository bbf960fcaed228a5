"""The error of a user's mistake, and the command that installs an extra."""

from __future__ import annotations

import importlib.metadata
import json
import urllib.parse
from pathlib import Path


class UserError(ValueError):
    """A mistake in what was asked for, which the message explains: what was wrong, what was given, what to do.

    The command line prints it as one line. Any other exception is a fault of this library, or of a user's own code, and
    is shown with its traceback.
    """


def install(extra: str) -> str:
    """The command that installs an extra, from the checkout or the wheel that this package comes from."""
    place = Path(__file__).parents[1]
    if (place / "pyproject.toml").is_file():
        return f'pip install "{place}[{extra}]"'
    try:
        origin = importlib.metadata.distribution("jaxdrones").read_text("direct_url.json")
    except importlib.metadata.PackageNotFoundError:
        origin = None
    url = urllib.parse.urlsplit(json.loads(origin or "{}").get("url", ""))
    return f'pip install "{urllib.parse.unquote(url.path) or "WHEEL"}[{extra}]"'
