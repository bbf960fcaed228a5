"""Page of a training: flights of its evaluated policies beside its learning curve."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from jaxdrones.visualization.viewer.page import Page
from jaxdrones.visualization.viewer.payload import encode
from jaxdrones.visualization.viewer.show import LAYOUTS, records_of


def show_history(evaluated: Sequence[Any], best: int, label: str, title: str) -> Page:
    """Make a page that plays the flights of a training one after the other.

    Args:
        evaluated: policies of `training.history.fly_history`.
        best: number of updates of the policy that the training kept.
        label: name of the value; `success` is a fraction, 0 to 1.
        title: title of the page.

    Raises:
        ValueError: too much data for a browser.
    """
    records = [record for policy in evaluated for record in records_of(policy.flight, {})]
    values = [f"{100 * x.value:.1f} %" if label == "success" else f"{x.value:.4g}" for x in evaluated]
    names = [f"update {x.update}: {label} {value}" for x, value in zip(evaluated, values, strict=True)]
    points = [[x.update, x.value if math.isfinite(x.value) else None] for x in evaluated]
    history = {"label": label, "points": points, "best": best}
    payload = encode(records, names, title, layout=LAYOUTS["hidden"], play=True, history=history)
    return Page(title, payload)
