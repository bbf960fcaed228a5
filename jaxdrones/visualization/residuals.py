"""Figures of identification: open-loop errors by horizon, and recorded and simulated paths."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from jaxdrones.flights import HORIZONS, QUANTITIES, ClosedLoopResult
from jaxdrones.flights.log import PERIOD
from jaxdrones.visualization import style
from jaxdrones.visualization.palette import colors

_UNITS = {"pos": "position (m)", "vel": "velocity (m/s)", "rot": "attitude (rad)", "omega": "rates (rad/s)"}
_COLUMNS = 4  # at most
_HALF = 0.54  # of the extent of a path: half of the width and height of its panel


def save_errors(errors: dict[str, np.ndarray], path: Path) -> None:
    """Draw the open-loop errors of flights, (horizons, 4) each, over the horizon."""
    t = np.array(HORIZONS) * PERIOD
    with style.figure(16, 5) as figure:
        axes = figure.subplots(1, len(QUANTITIES))
        for i, (axis, quantity) in enumerate(zip(axes, QUANTITIES, strict=True)):
            for color, (flight, table) in zip(colors(len(errors)), errors.items(), strict=True):
                axis.plot(t, table[:, i], "o-", color=color, label=flight.removesuffix(".npz"))
            axis.set(xlabel="after (s)", title=_UNITS[quantity], xticks=t, ylim=(0, None))
        figure.legend(*axes[0].get_legend_handles_labels(), loc="outside right center", fontsize="small")
        style.save(figure, path)


def save_paths(simulated: Mapping[str, Sequence[ClosedLoopResult]], path: Path) -> None:
    """Draw recorded and, by vehicle, simulated horizontal paths of flights, and their set-points."""
    flights = list(zip(*simulated.values(), strict=True))
    rows = -(-len(flights) // _COLUMNS)
    columns = -(-len(flights) // rows)
    recorded, *tints = colors(1 + len(simulated))
    widths = style.widths(len(simulated))
    with style.figure(max(5 * columns, 9), 5 * rows + 0.7) as figure:
        axes = figure.subplots(rows, columns, squeeze=False).ravel()
        for axis, results in zip(axes, flights, strict=False):
            axis.plot(*results[0].ref_pos[:, :2].T, color="#b4bac1", linewidth=5, label="set-points")
            for name, result, tint, width in zip(simulated, results, tints, widths, strict=True):
                axis.plot(*result.sim_pos[:, :2].T, color=tint, linewidth=width, label=f"{name}, simulated")
            axis.plot(*results[0].pos[:, :2].T, color=recorded, linewidth=1.2, label="recorded")
            axis.set(aspect="equal", xlabel="x (m)", ylabel="y (m)", title=results[0].flight.removesuffix(".npz"))
            drawn = np.concatenate([results[0].ref_pos, results[0].pos, *(result.sim_pos for result in results)])
            low, high = drawn[:, :2].min(axis=0), drawn[:, :2].max(axis=0)
            half, (x, y) = np.max(high - low) * _HALF, (low + high) / 2
            axis.set(xlim=(x - half, x + half), ylim=(y - half, y + half))
        for axis in axes[len(flights) :]:
            axis.set_axis_off()
        figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
        style.save(figure, path)
