"""Figures of identification: open-loop errors by horizon, and recorded and simulated paths."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from jaxdrones.flights import HORIZONS, QUANTITIES, ClosedLoopResult
from jaxdrones.flights.preparation import PERIOD
from jaxdrones.visualization import style
from jaxdrones.visualization.palette import COLORS, colors

_UNITS = {"pos": "position (m)", "vel": "velocity (m/s)", "rot": "attitude (rad)", "omega": "rates (rad/s)"}
_COLUMNS = 4


def save_errors(errors: dict[str, np.ndarray], path: Path) -> None:
    """Draw the open-loop errors of flights over the horizon.

    Args:
        errors: open-loop errors (horizons, 4) by flight.
        path: path of the picture.
    """
    t = np.array(HORIZONS) * PERIOD
    with style.figure(16, 5) as figure:
        axes = figure.subplots(1, len(QUANTITIES))
        for i, (axis, quantity) in enumerate(zip(axes, QUANTITIES, strict=True)):
            for color, (flight, table) in zip(colors(len(errors)), errors.items(), strict=True):
                axis.plot(t, table[:, i], "o-", color=color, label=flight.removesuffix(".npz"))
            axis.set(xlabel="after (s)", title=_UNITS[quantity], xticks=t, ylim=(0, None))
        figure.legend(*axes[0].get_legend_handles_labels(), loc="outside right center", fontsize="small")
        style.save(figure, path)


def save_paths(results: Sequence[ClosedLoopResult], path: Path) -> None:
    """Draw the recorded and simulated horizontal paths of flights and their set-points.

    Args:
        results: closed-loop simulations of the flights.
        path: path of the picture.
    """
    columns = min(len(results), _COLUMNS)
    rows = -(-len(results) // columns)
    with style.figure(5 * columns, 5 * rows + 0.5) as figure:
        axes = figure.subplots(rows, columns, squeeze=False).ravel()
        for axis, result in zip(axes, results, strict=False):
            axis.plot(*result.ref_pos[:, :2].T, color="#b4bac1", label="set-points")
            axis.plot(*result.pos[:, :2].T, color=COLORS[0], label="recorded")
            axis.plot(*result.sim_pos[:, :2].T, color=COLORS[1], label="simulated")
            axis.set(aspect="equal", xlabel="x (m)", ylabel="y (m)", title=result.flight.removesuffix(".npz"))
        for axis in axes[len(results) :]:
            axis.set_axis_off()
        entries_in_a_row = 1 if columns == 1 else 3  # all three are wider than one panel
        figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=entries_in_a_row)
        style.save(figure, path)
