"""Page with a list of flights, of which it plays one at a time."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path

from jaxdrones.visualization.viewer.page import template

_TEMPLATE = Path(__file__).with_name("gallery.html")


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
    return _TEMPLATE.read_text(encoding="utf-8").replace("@DATA@", json.dumps(data).replace("<", "\\u003c"))


def read_exhibits(folder: Path) -> list[Exhibit]:
    """Flights of a folder, in the order of the names of its JSON files."""
    return [Exhibit(**json.loads(path.read_bytes())) for path in sorted(folder.glob("*.json"))]
