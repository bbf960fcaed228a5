"""Common style of figures: fonts, lines, and limits of axes."""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from jaxdrones.visualization.palette import COLORS
from jaxdrones.writing import replaced

DPI = 110
TARGET: dict[str, Any] = {"linestyle": (0, (4, 2)), "linewidth": 1.3, "alpha": 0.75}
"""Style of a target, in the color of its drone."""
_WIDEST, _NARROWEST = 3.6, 1.4  # points
_KEPT = 0.95  # fraction of the samples of each line in view
_FLATTENED = 3.0  # largest ratio of the whole range to that of these samples
_LOOK: dict[str, Any] = {
    "font.size": 14,
    "axes.titlesize": 15,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.grid": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.formatter.useoffset": False,
    "grid.color": "#d9dde1",
    "grid.linewidth": 0.8,
    "lines.linewidth": 1.8,
    "legend.frameon": False,
    "figure.dpi": DPI,
    "figure.titleweight": "bold",
}


@contextlib.contextmanager
def figure(width: float, height: float) -> Iterator[Any]:
    """Context with an empty figure of a size in inches and the common style."""
    import matplotlib
    from cycler import cycler
    from matplotlib.figure import Figure  # importing it takes half a second

    look: Any = _LOOK | {"axes.prop_cycle": cycler(color=COLORS)}
    with matplotlib.rc_context(look):
        yield Figure(figsize=(width, height), layout="constrained")


def widths(count: int) -> np.ndarray:
    """(count,) widths of lines, points: earlier ones are wider, to be visible below later ones."""
    return np.linspace(_WIDEST, _NARROWEST, count) if count > 1 else np.array([_NARROWEST])


def save(figure: Any, path: str | os.PathLike) -> None:
    """Write a figure to a file; the suffix selects the format.

    Raises:
        OSError: the file cannot be written.
    """
    with replaced(path) as new:
        figure.savefig(new, dpi=DPI, format=Path(path).suffix[1:] or "png")


def limits(lines: np.ndarray, smallest: float = 0.0) -> tuple[float, float]:
    """Limits of an axis for lines (K, n), one a column, robust to short spikes; values that are not finite are ignored.

    They contain all samples, unless that is more than three times the range of the middle 95 % of each line. Then they
    contain those samples and half as much to both sides. They are at least `smallest` apart, against magnified noise.
    """
    lines = np.where(np.isfinite(lines), lines, np.nan)
    lines = lines[:, ~np.isnan(lines).all(axis=0)]
    if not lines.size:
        return 0.0, 1.0
    low, high = float(np.nanmin(lines)), float(np.nanmax(lines))
    ends = np.nanquantile(lines, [(1 - _KEPT) / 2, (1 + _KEPT) / 2], axis=0)
    inner_low, inner_high = float(ends[0].min()), float(ends[1].max())
    inner = max(inner_high - inner_low, smallest)
    if high - low > _FLATTENED * inner:
        low, high = max(low, inner_low - inner / 2), min(high, inner_high + inner / 2)
    middle, range_ = (low + high) / 2, max(high - low, smallest, 1e-9 * abs(low + high), 1e-12)
    return middle - 0.55 * range_, middle + 0.55 * range_
