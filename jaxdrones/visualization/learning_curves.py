"""Learning curves over seeds. They need matplotlib (extra `cli`)."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxdrones.visualization import style
from jaxdrones.visualization.palette import COLORS, colors

PANELS = {
    "reward": "reward per step, in training",
    "evaluated_return": "return of an episode, evaluated",
    "success": "success, evaluated",
    "evaluated_error": "median final error (m), evaluated",
}
_MEDIAN, _BAND = COLORS[-1], "#b4bac1"
_STAR: Any = dict(marker="*", markersize=18, color="#f2b705", markeredgecolor="black", zorder=5, clip_on=False)
_INTERVAL: dict[str, Any] = {"linestyle": "none", "ecolor": _MEDIAN, "elinewidth": 1.2, "capsize": 5, "capthick": 1.2}
_GRID = 400
_MOST_NAMED = 7  # runs with their own lines and names


def save_curves(
    histories: Mapping[str, Sequence[Mapping[str, float]]],
    path: Path,
    title: str,
    interval: Callable[[float], tuple[float, float]] | None = None,
    kept: Mapping[str, int] | None = None,
) -> None:
    """Draw learning curves over the number of control steps.

    Each run of `histories`, label -> rows of progress.csv, is a line. Several runs also have their median, and a band
    from lowest to highest. The success rate of a single run has error bars of its confidence intervals, by the function
    `interval`. A star marks the evaluation of the best policy of each run, by its update in `kept`.
    """
    from matplotlib.ticker import EngFormatter

    best = {
        run: row for run, rows in histories.items() for row in rows if kept and row.get("update") == kept.get(run, "")
    }
    tints = dict(zip(histories, _tints(len(histories)), strict=True))
    with style.figure(13, 9) as figure:
        axes = figure.subplots(2, 2, sharex=True).ravel()
        for axis, (name, label) in zip(axes, PANELS.items(), strict=True):
            curves = {run: points for run, rows in histories.items() if len(points := _points(rows, name))}
            for run, points in curves.items():
                marker, width = "o" if len(points) < 60 else None, 1.8 if len(histories) == 1 else 1.2
                axis.plot(*points.T, color=tints[run], linewidth=width, marker=marker, markersize=4)
            if name != "reward":
                for run in filter(best.get, curves):
                    for point in _points([best[run]], name):
                        axis.plot(*point, linestyle="none", **_STAR)
            if len(curves) > 1:
                steps, median, lowest, highest = spread(list(curves.values()))
                axis.fill_between(steps, lowest, highest, color=_BAND, alpha=0.5, linewidth=0)
                axis.plot(steps, median, color=_MEDIAN, linewidth=2.6)
            elif curves and name == "success" and interval is not None:
                points = next(iter(curves.values()))
                low, high = np.transpose([interval(success) for success in points[:, 1]])
                axis.errorbar(*points.T, np.abs([points[:, 1] - low, high - points[:, 1]]), **_INTERVAL)
            if name == "evaluated_error" and curves and min(points[:, 1].min() for points in curves.values()) > 0:
                axis.set_yscale("log")
                axis.yaxis.set_major_formatter("{x:g}")
            elif name == "reward" and curves:
                longest = max(map(len, curves.values()))
                padded = [np.pad(x[:, 1], (0, longest - len(x)), constant_values=np.nan) for x in curves.values()]
                axis.set_ylim(*style.limits(np.stack(padded, axis=1)))
            axis.set_title(label)
        axes[2].set_ylim(-0.03, 1.03)
        axes[2].yaxis.set_major_formatter("{x:.0%}")
        for axis in axes[2:]:
            axis.set_xlabel("control steps flown")
            axis.xaxis.set_major_formatter(EngFormatter(sep=" "))
        figure.suptitle(title + "\n")
        handles = _handles(list(histories), interval, list(best.values()))
        if handles:
            figure.legend(handles=handles, loc="outside lower center", ncols=6)
        style.save(figure, path)


def spread(curves: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Median, lowest and highest of several curves (p, 2), number of steps and value, over their common range.

    Returns:
        Numbers of steps, medians, lowest and highest values, each (s,); empty without overlap.
    """
    begin, end = max(points[0, 0] for points in curves), min(points[-1, 0] for points in curves)
    between = np.linspace(begin, max(begin, end), _GRID)  # where curves cross between their points
    steps = np.unique(np.concatenate([between, *(points[:, 0] for points in curves)]))
    steps = steps[(steps >= begin) & (steps <= end)]
    values = np.stack([np.interp(steps, *points.T) for points in curves])
    return steps, np.median(values, axis=0), values.min(axis=0), values.max(axis=0)


def _points(rows: Sequence[Mapping[str, float]], name: str) -> np.ndarray:
    """(p, 2) numbers of steps and values, without missing values."""
    points = [(row["steps"], row[name]) for row in rows if name in row and np.isfinite(row[name])]
    return np.array(sorted(points)).reshape(-1, 2)


def _tints(runs: int) -> tuple[str, ...]:
    return colors(runs) if runs <= _MOST_NAMED else (_BAND,) * runs


def _handles(
    names: Sequence[str],
    interval: Callable[[float], tuple[float, float]] | None,
    best: Sequence[Mapping[str, float]],
) -> list[Any]:
    """Entries of the legend, with the interval of the best policy of a single run in numbers."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    star = [Line2D([], [], linestyle="none", label="best policy", **_STAR)] * bool(best)
    if len(names) == 1:
        if interval is None:
            return star
        text = "95 % interval"
        if best and "success" in best[0]:
            low, high = interval(best[0]["success"])
            text += f", of the best policy {100 * low:.1f} to {100 * high:.1f} %"
        bar = Line2D([], [], color=_MEDIAN, linestyle="none", marker="$\u2336$", markersize=12, label=text)
        return [bar, *star]
    runs = [Line2D([], [], color=tint, label=name) for tint, name in zip(_tints(len(names)), names, strict=True)]
    median = Line2D([], [], color=_MEDIAN, linewidth=2.6, label=f"median of {len(names)}")
    band = Patch(facecolor=_BAND, alpha=0.5, label="lowest to highest")
    return [*(runs if len(names) <= _MOST_NAMED else []), median, band, *star]
