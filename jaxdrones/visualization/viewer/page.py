"""Viewer page as a file and in a notebook, and the page with a list of flights."""

import dataclasses
import functools
import html
import json
import os
from collections.abc import Sequence
from pathlib import Path

from jaxdrones.writing import write

_TEMPLATE, _GALLERY = (Path(__file__).with_name(name) for name in ("page.html", "gallery.html"))


@dataclasses.dataclass(frozen=True)
class Page:
    """Self-contained HTML page that plays flights, displayed by notebooks."""

    title: str
    payload: str
    """Result of `payload.encode`."""
    height: int = 600
    """Height in a notebook, pixels."""

    @property
    def html(self) -> str:
        """HTML text of the page."""
        return template().replace("@TITLE@", html.escape(self.title)).replace("@PAYLOAD@", self.payload)

    def save(self, path: str | os.PathLike) -> Path:
        """Write the page to a file, creating its folder; return its path.

        Raises:
            OSError: the file cannot be written.
        """
        path = Path(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        write(path, self.html.encode())
        return path

    def _repr_html_(self) -> str:
        return (
            f'<iframe srcdoc="{html.escape(self.html)}" title="{html.escape(self.title)}" sandbox="allow-scripts" '
            f'allow="fullscreen" style="width: 100%; height: {self.height}px; border: 0"></iframe>'
        )

    def __repr__(self) -> str:
        return f"Page({self.title!r}, {len(self.payload) / 1e6:.1f} MB of data)"


@functools.cache
def template() -> str:
    """HTML text of the player, with @TITLE@ and @PAYLOAD@ for the flight."""
    try:
        return _TEMPLATE.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise ImportError(
            f"the viewer's page is not built: {_TEMPLATE} is missing; run `make viewer` in the sources, which needs "
            "npm, or install the wheel"
        ) from None


@dataclasses.dataclass(frozen=True)
class Exhibit:
    """Flight in a gallery."""

    name: str
    """Title, and the part of the address after #."""
    about: str
    """Description of the flight and of its success, a few sentences."""
    command: str
    """Command that flies it."""
    payload: str
    """Result of `payload.encode`."""


def gallery(exhibits: Sequence[Exhibit]) -> str:
    """HTML text of a self-contained page that begins with the first flight."""
    data = {"player": template(), "exhibits": [dataclasses.asdict(exhibit) for exhibit in exhibits]}
    return _GALLERY.read_text(encoding="utf-8").replace("@DATA@", json.dumps(data).replace("<", "\\u003c"))


def read_exhibits(folder: Path) -> list[Exhibit]:
    """Flights of a folder, in the order of the names of its JSON files."""
    return [Exhibit(**json.loads(path.read_bytes())) for path in sorted(folder.glob("*.json"))]
