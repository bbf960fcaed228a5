"""Figures of flights: paths, and the panels of the gym-pybullet-drones paper. They need matplotlib (extra `cli`)."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxdrones.errors import UserError, install
from jaxdrones.flights.log import FlightLog
from jaxdrones.visualization import paths, style
from jaxdrones.visualization.palette import colors

# panel: (array of the record, column, label); the order alternates between left and right column
PANELS = {
    "x": ("pos", 0, "x (m)"),
    "vx": ("vel", 0, "vx (m/s)"),
    "y": ("pos", 1, "y (m)"),
    "vy": ("vel", 1, "vy (m/s)"),
    "z": ("pos", 2, "z (m)"),
    "vz": ("vel", 2, "vz (m/s)"),
    "roll": ("rpy", 0, "roll (rad)"),
    "omega_x": ("omega", 0, "ωx (rad/s)"),
    "pitch": ("rpy", 1, "pitch (rad)"),
    "omega_y": ("omega", 1, "ωy (rad/s)"),
    "yaw": ("rpy", 2, "yaw (rad)"),
    "omega_z": ("omega", 2, "ωz (rad/s)"),
    "rpm0": ("rpm", 0, "P0 (RPM)"),
    "rpm1": ("rpm", 1, "P1 (RPM)"),
    "rpm2": ("rpm", 2, "P2 (RPM)"),
    "rpm3": ("rpm", 3, "P3 (RPM)"),
}
ERROR = {"error": ("error", 0, "error (m)")}
POLICY_PANELS = ("x", "rpm0", "y", "rpm1", "z", "rpm2", "vz", "rpm3", "error", "yaw")
_SMALLEST = {"pos": 0.02, "vel": 0.02, "rpy": 0.02, "omega": 0.05, "rpm": 200.0, "error": 0.01}  # ranges of axes
_BANDS = ((0.0, 1.0, 0.15), (0.05, 0.95, 0.3))  # lower and upper quantile, opacity
_BAND = colors(1)[0]
_WIDTH, _PATHS, _ROW = 13.0, 5.4, 1.6  # in


SUFFIXES = (".png", ".pdf")
"""Endings of pictures."""


def check_matplotlib() -> None:
    """Raise `ValueError` where matplotlib is not installed, or its settings are invalid."""
    try:
        import matplotlib  # noqa: F401
    except ValueError as error:  # in MPLBACKEND or in its file of settings
        raise UserError(f"matplotlib does not start: {error}; correct MPLBACKEND, or draw no figure") from None
    except ImportError:
        raise UserError(
            f"matplotlib is not installed, so no figure can be drawn; {install('cli')}, or draw no figure"
        ) from None


def save_flight(record: FlightLog, path: Path, title: str, panels: Sequence[str] = ()) -> None:
    """Draw paths and signals of a flight over time, with one color per drone and commands dashed.

    The panels are names of `PANELS`, or `error`; by default all `PANELS`.
    """
    panels = panels or list(PANELS)
    columns = 1 if len(panels) < 4 else 2
    rows = -(-len(panels) // columns)
    tints = colors(len(record.labels))
    with style.figure(_WIDTH, _PATHS + _ROW * rows + 1.3) as figure:
        above, below = figure.subfigures(2, 1, height_ratios=(_PATHS, _ROW * rows + 0.6))
        paths.draw_space(above.add_subplot(1, 2, 1, projection="3d"), record, tints)
        paths.draw_plane(above.add_subplot(1, 2, 2), record, tints)
        axes = below.subplots(rows, columns, sharex=True, squeeze=False).ravel()
        for axis, name in zip(axes, panels, strict=False):
            _draw_signal(axis, record, name, tints)
        for axis in axes[len(panels) :]:
            axis.set_axis_off()
        for axis in axes[max(0, len(panels) - columns) : len(panels)]:
            axis.set_xlabel("t (s)")
            axis.tick_params(labelbottom=True)
        figure.align_ylabels(list(axes))
        figure.suptitle(title + "\n")
        figure.legend(handles=_handles(record, tints), loc="outside lower center", ncols=4)
        style.save(figure, path)


def _draw_signal(axis: Any, record: FlightLog, name: str, tints: Sequence[str]) -> None:
    """Draw one panel over time, with a note on values outside of the axes."""
    array, column, label = (PANELS | ERROR)[name]
    signal = np.asarray(getattr(record, array), float)[..., column]
    targets = {"pos": record.target_pos, "vel": record.target_vel}
    command = np.asarray(targets[array], float)[..., column] if array in targets else np.full_like(signal, np.nan)
    if len(tints) > paths.MOST_NAMED:
        _draw_bands(axis, record.t, signal)
    else:
        for i, tint in enumerate(tints):
            axis.plot(record.t, command[:, i], color=tint, **style.TARGET)
            axis.plot(record.t, signal[:, i], color=tint)
    low, high = style.limits(np.concatenate([signal, command], axis=1), _SMALLEST[array])
    axis.set_ylim(low, high)
    axis.set_ylabel(label)
    axis.locator_params(axis="y", nbins=4)
    with np.errstate(invalid="ignore"):
        outside = np.isfinite(signal) & ((signal < low) | (signal > high))
    if outside.any():
        text = f"outside: {_range(signal[outside])}, first at {record.t[outside.any(axis=1)][0]:.2f} s"
        box = {"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 1.5}
        axis.text(0.995, 0.97, text, transform=axis.transAxes, ha="right", va="top", fontsize=11.5, bbox=box)


def _draw_bands(axis: Any, t: np.ndarray, signal: np.ndarray) -> None:
    """Draw the median of a signal (time, drones) over bands of its quantiles."""
    for low, high, opacity in _BANDS:
        edges = np.nanquantile(signal, (low, high), axis=1)
        axis.fill_between(t, *edges, color=_BAND, alpha=opacity, linewidth=0)
    axis.plot(t, np.nanmedian(signal, axis=1), color=_BAND)


def _range(values: np.ndarray) -> str:
    ends = [f"{x:,.0f}" if 1e3 <= abs(x) < 1e6 else f"{x:.2g}" for x in (values.min(), values.max())]
    return " to ".join(dict.fromkeys(ends))


def _handles(record: FlightLog, tints: Sequence[str]) -> list[Any]:
    """Legend: drones, dashed lines, start and end."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    if len(tints) > paths.MOST_NAMED:
        bands = [Patch(color=_BAND, alpha=a, label=f"{100 * (b - c):.0f} % of the drones") for c, b, a in _BANDS[::-1]]
        return [
            Line2D([], [], color=_BAND, label=f"median of {len(tints)} drones"),
            *bands,
            *paths.legend_handles(record),
        ]
    named = [Line2D([], [], color=tint, label=drone) for tint, drone in zip(tints, record.labels, strict=True)]
    return named + paths.legend_handles(record)
