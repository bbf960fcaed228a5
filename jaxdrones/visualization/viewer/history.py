"""Page of a training: flights of its evaluated policies beside its learning curve."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from jaxdrones.visualization.viewer.page import Page
from jaxdrones.visualization.viewer.payload import encode
from jaxdrones.visualization.viewer.show import LAYOUTS, check_size, looks, records_of


def show_history(flights: Sequence[Any], curve: Sequence[tuple[int, float]], best: int, label: str, title: str) -> Page:
    """Make a page that plays the flights of a training one after the other.

    Args:
        flights: arguments of `show` with one world, one for each point of the curve.
        curve: numbers of updates, and evaluated values.
        best: number of updates of the policy that the training kept.
        label: name of the value; `success` is a fraction, 0 to 1.
        title: title of the page.

    Raises:
        ValueError: too much data for a browser.
    """
    records = [record for flight in flights for record in records_of(flight, {})]
    check_size(*(record.pos for record in records))
    names = [f"update {update}: {label} {_text(value, label)}" for update, value in curve]
    points = [[update, value if math.isfinite(value) else None] for update, value in curve]
    history = {"label": label, "points": points, "best": best}
    payload = encode(records, names, title, layout=LAYOUTS["hidden"], play=True, history=history, **looks(records))
    return Page(title, payload)


def _text(value: float, label: str) -> str:
    return f"{100 * value:.1f} %" if label == "success" else f"{value:.4g}"
