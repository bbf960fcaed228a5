"""Figures of flights, in the layout of the gym-pybullet-drones paper. They need matplotlib (extra `cli`)."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from jaxdrones.flights.record import Record

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


def check_matplotlib() -> None:
    """Raise `ValueError` if no figure can be drawn.

    Raises:
        ValueError: matplotlib is not installed; says how to get it.
    """
    try:
        import matplotlib  # noqa: F401
    except ImportError:
        raise ValueError(
            'matplotlib is not installed, so no figure can be drawn; pip install "jaxdrones[cli]", or pass --no-figure'
        ) from None


def save_flight(record: Record, path: Path, title: str, panels: Sequence[str] = ()) -> None:
    """Draw a flight: one line per drone, the commanded values dashed.

    Args:
        record: the flight.
        path: path of the picture; its suffix chooses the format.
        title: title of the figure.
        panels: names of `PANELS`, or `error`; all `PANELS` when empty.
    """
    from matplotlib.figure import Figure  # importing it takes half a second

    panels = panels or list(PANELS)
    columns = 1 if len(panels) < 4 else 2
    rows = -(-len(panels) // columns)
    figure = Figure(figsize=(max(8, 5.5 * columns), 1.5 * rows + 1.2), layout="constrained")
    axes = figure.subplots(rows, columns, sharex=True, squeeze=False).ravel()
    targets = {"pos": record.target_pos, "vel": record.target_vel}
    for axis, name in zip(axes, panels, strict=False):
        array, column, label = (PANELS | ERROR)[name]
        for i, drone in enumerate(record.labels):
            (line,) = axis.plot(record.t, getattr(record, array)[:, i, column], linewidth=1, label=drone)
            if array in targets and np.isfinite(targets[array]).any():
                axis.plot(
                    record.t, targets[array][:, i, column], "--", linewidth=0.8, color=line.get_color(), alpha=0.6
                )
        axis.set_ylabel(label)
        axis.grid(linewidth=0.3)
    for axis in axes[-columns:]:
        axis.set_xlabel("t (s)")
    figure.suptitle(title, fontsize="medium")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    figure.savefig(path, dpi=120)


def save_curves(histories: dict[str, list[dict[str, float]]], path: Path, title: str) -> None:
    """Draw learning curves: one line per run, over the number of control steps.

    Args:
        histories: label -> rows of progress.csv, as `training.run.Run.history` returns them.
        path: path of the picture.
        title: title of the figure.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 6), layout="constrained")
    axes = figure.subplots(2, 2, sharex=True).ravel()
    panels = {
        "reward": "reward per step, in training",
        "evaluated_return": "return of an episode, evaluated",
        "success": "success, evaluated",
        "evaluated_error": "median error in the end (m), evaluated",
    }
    for axis, (name, label) in zip(axes, panels.items(), strict=True):
        for run, rows in histories.items():
            points = [(row["steps"], row[name]) for row in rows if name in row and np.isfinite(row[name])]
            marker = "o" if len(points) < len(rows) else None
            axis.plot(*(zip(*points, strict=True) if points else ((), ())), linewidth=1, marker=marker, ms=3, label=run)
            if name == "evaluated_error" and points and min(y for _, y in points) > 0:
                axis.set_yscale("log")
        axis.set_ylabel(label, fontsize="small")
        axis.grid(linewidth=0.3)
    axes[2].set_ylim(-0.03, 1.03)
    for axis in axes[2:]:
        axis.set_xlabel("control steps flown")
    figure.suptitle(title, fontsize="medium")
    if len(histories) > 1:
        figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=8)
    figure.savefig(path, dpi=120)
