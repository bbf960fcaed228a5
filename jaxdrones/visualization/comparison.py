"""Comparison of flights of the same example: paths, and errors over time."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxdrones.flights import results
from jaxdrones.flights.log import FlightLog
from jaxdrones.visualization import paths, style
from jaxdrones.visualization.palette import colors

_COMMANDED: dict[str, Any] = style.TARGET | {"color": "#222222", "zorder": 4}
_MOST_BANDED = 3  # flights with a band over the drones
_SMALLEST = 0.01  # m or m/s: range of an axis
_CELLS = 100  # cells along each side of a panel: commands are drawn once in each, to keep dashes


def save_comparison(records: Mapping[str, FlightLog], path: Path, title: str, after: float = 0.0) -> None:
    """Draw flights of the same example: a color for each flight, with commands dashed.

    Beside the paths are the errors of each flight over time, mean and range over its drones, and for two flights with
    the same times the distance between them, largest over the drones. `after` is the start of these panels, s, as in
    `jaxdrones.flights.results.results`.
    """
    tints = colors(len(records))
    flights = list(records.values())
    apart = len(flights) == 2 and np.array_equal(flights[0].t, flights[1].t)
    start = results.counted_from(flights[0], after)
    with style.figure(13, 7.2) as figure:
        axes = figure.subplot_mosaic([["path", "error"], ["path", "apart" if apart else "error"]])
        _draw_paths(axes["path"], flights, tints)
        _draw_errors(axes["error"], records, tints, start)
        if apart:
            _draw_distance(axes["apart"], flights[0], flights[1], start)
            axes["error"].tick_params(labelbottom=False)
            figure.align_ylabels([axes["error"], axes["apart"]])
        axes["apart" if apart else "error"].set_xlabel("t (s)" if start == 0 else f"t (s), from {start:g} s on")
        figure.suptitle(title + "\n")
        handles = axes["error"].get_legend_handles_labels()[0] + _handles(flights)
        figure.legend(handles=handles, loc="outside lower center", ncols=min(6, len(handles)))
        style.save(figure, path)


def _draw_paths(axis: Any, flights: list[FlightLog], tints: tuple[str, ...]) -> None:
    """Draw the paths of all drones in their widest plane, at equal scales."""
    plane = paths.prepare_plane(axis, flights)
    for record, tint, width in zip(flights, tints, style.widths(len(flights)), strict=True):
        for i in range(len(record.labels)):
            axis.plot(*record.pos[:, i, plane].T, color=tint, linewidth=width)
        axis.plot(*record.pos[-1][:, plane].T, color=tint, **paths.END)
    for target in _once(flights[0].target_pos[..., plane].astype(float)):
        axis.plot(*target.T, **_COMMANDED)
    axis.plot(*flights[0].pos[0][:, plane].T, color="#222222", **paths.START)


def _once(lines: np.ndarray) -> list[np.ndarray]:
    """Lines (K, n, 2) of n drones, without points near an earlier line."""
    points = lines.reshape(-1, 2)
    if not np.isfinite(points).any():
        return []
    low, span = np.nanmin(points, axis=0), max(np.nanmax(np.ptp(points[np.isfinite(points).all(axis=1)], axis=0)), 1e-9)
    seen = np.zeros((_CELLS + 3, _CELLS + 3), bool)
    shown = []
    for line in np.swapaxes(lines, 0, 1):
        known = np.isfinite(line).all(axis=1)
        x, y = 1 + (np.where(known[:, None], line - low, 0) / span * _CELLS).astype(int).T
        shown.append(np.where((known & ~seen[x, y])[:, None], line, np.nan))
        for dx in (-1, 0, 1):
            for dy in (-1, 0, 1):
                seen[x[known] + dx, y[known] + dy] = True
    return shown


def _draw_errors(axis: Any, records: Mapping[str, FlightLog], tints: tuple[str, ...], start: float) -> None:
    """Draw mean and range over the drones of the distance to the target position, or of the difference in velocity."""
    ends = []
    for (name, record), tint, width in zip(records.items(), tints, style.widths(len(records)), strict=True):
        difference, unit = record.difference()
        with np.errstate(over="ignore", invalid="ignore"):
            error = np.linalg.norm(difference.astype(float), axis=-1)[record.t >= start]
        t = record.t[record.t >= start]
        if len(records) <= _MOST_BANDED:
            axis.fill_between(t, error.min(axis=1), error.max(axis=1), color=tint, alpha=0.2, linewidth=0)
        axis.plot(t, error.mean(axis=1), color=tint, linewidth=width, label=name)
        ends.append(style.limits(error, _SMALLEST))
    axis.set_ylim(max(min(low for low, _ in ends), -0.02 * ends[0][1]), max(high for _, high in ends))
    what = "distance to the target" if unit == "m" else "difference to the commanded velocity"
    axis.set(title=what, ylabel=f"error ({unit})")


def _draw_distance(axis: Any, first: FlightLog, second: FlightLog, start: float) -> None:
    """Draw the distance between equal drones of two flights, largest over the drones, on a logarithmic axis.

    The axis begins at the rounding of the logged positions.
    """
    from matplotlib.ticker import LogLocator, NullFormatter

    with np.errstate(over="ignore", invalid="ignore"):
        apart = np.linalg.norm(first.pos.astype(float) - second.pos, axis=-1).max(axis=1)
        rounding = np.spacing(np.float32(np.nanmax(np.abs(first.pos[np.isfinite(first.pos)]), initial=0)))
    counted = first.t >= start
    axis.plot(first.t[counted], np.where(apart > rounding, apart, np.nan)[counted], color="#222222")
    seen = apart[counted & np.isfinite(apart) & (apart > rounding)]
    if seen.size:
        axis.set_yscale("log")
        axis.set_ylim(10 ** np.floor(np.log10(seen.min())), 10 ** np.ceil(np.log10(1.01 * seen.max())))
        axis.yaxis.set_major_locator(LogLocator(numticks=6))
        axis.yaxis.set_minor_formatter(NullFormatter())
    axis.set(title="distance between the two flights", ylabel="largest (m)")


def _handles(flights: list[FlightLog]) -> list[Any]:
    """Legend beside the flights: dashed lines, start and end, and the band."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles: list[Any] = []
    if np.isfinite(flights[0].target_pos).any():
        handles.append(Line2D([], [], label="commanded", **_COMMANDED))
    handles += [Line2D([], [], color="#555555", label=label, **look) for label, look in paths.ENDS.items()]
    if len(flights) <= _MOST_BANDED and len(flights[0].labels) > 1:
        handles.append(Patch(facecolor="#555555", alpha=0.2, label="range of the drones"))
    return handles
