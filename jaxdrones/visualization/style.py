"""What all figures have in common: fonts that are readable at half size, lines, and limits of axes."""

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
"""How a target is drawn, in the color of its drone."""
_KEPT = 0.95  # share of the samples of each line that is shown
_FLATTENED = 3.0  # times that the whole range is larger than that of the kept samples from which on it is not shown
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
    """A context with an empty figure of a size in inches; everything drawn in it has the common look."""
    import matplotlib
    from cycler import cycler
    from matplotlib.figure import Figure  # importing it takes half a second

    look: Any = _LOOK | {"axes.prop_cycle": cycler(color=COLORS)}
    with matplotlib.rc_context(look):
        yield Figure(figsize=(width, height), layout="constrained")


def save(figure: Any, path: str | os.PathLike) -> None:
    """Write a figure as a file, whose suffix chooses the format.

    Raises:
        OSError: the file cannot be written.
    """
    with replaced(path) as new:
        figure.savefig(new, dpi=DPI, format=Path(path).suffix[1:] or "png")


def limits(lines: np.ndarray, smallest: float = 0.0) -> tuple[float, float]:
    """Limits of an axis, which a short spike does not flatten.

    They hold everything, unless that is more than three times the range of the middle 95 % of each line. Then they
    hold those samples and half as much to both sides.

    Args:
        lines: (K, n) one column per line; what is not finite is not counted.
        smallest: smallest range, so that noise is not magnified.
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
