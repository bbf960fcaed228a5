"""A figure with both axes logarithmic."""

from collections.abc import Mapping, Sequence


def loglog(path: str, curves: Mapping[str, Sequence[tuple[float, float]]], x: str, y: str) -> None:
    """Write a PNG with a line for every curve, points (x, y)."""
    from matplotlib.figure import Figure  # only if a figure is asked for

    figure = Figure(figsize=(6, 4), layout="constrained")
    axes = figure.add_subplot(xscale="log", yscale="log", xlabel=x, ylabel=y)
    for name, points in curves.items():
        axes.plot(*zip(*points, strict=True), marker="o", markersize=4, label=name)
    axes.grid(which="both", alpha=0.2)
    axes.legend(frameon=False)
    figure.savefig(path, dpi=120)
