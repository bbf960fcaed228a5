"""Figures of recorded and simulated paths."""

import types
from pathlib import Path

import numpy as np
import pytest

from jaxdrones.visualization import style
from jaxdrones.visualization.residuals import save_errors, save_paths


def flight(name, shift, height):
    """Ellipse of 2 by `height` m as set-points, and recorded and simulated paths beside it."""
    angle = np.linspace(0, 2 * np.pi, 50)
    path = np.stack([np.cos(angle), height / 2 * np.sin(angle), np.ones(50)], axis=1)
    return types.SimpleNamespace(flight=name, ref_pos=path, pos=path + 0.1, sim_pos=path + shift)


@pytest.mark.parametrize(("flights", "shape"), [(1, (1, 1)), (5, (2, 3)), (9, (3, 3))])
def test_panels_are_squares_that_hold_all_paths_and_the_record_is_on_top(figures, monkeypatch, flights, shape):
    monkeypatch.setattr(style, "save", lambda figure, path: None)
    nominal = [flight(f"flight {i}.npz", 0.3, 2.0 / (1 + i)) for i in range(flights)]
    fitted = [flight(f"flight {i}.npz", -0.2, 2.0 / (1 + i)) for i in range(flights)]
    save_paths({"cf2x": nominal, "runs/fit": fitted}, Path("paths.png"))
    (figure,) = figures
    grid = figure.axes[0].get_subplotspec().get_gridspec()
    assert (grid.nrows, grid.ncols) == shape
    for axis in figure.axes[:flights]:
        (left, right), (low, high) = axis.get_xlim(), axis.get_ylim()
        assert right - left == pytest.approx(high - low)
        for line in axis.lines:
            x, y = line.get_data()
            assert left < x.min() and x.max() < right and low < y.min() and y.max() < high
        assert [line.get_label() for line in axis.lines][-1] == "recorded"
        x, y = next(line for line in axis.lines if line.get_label() == "cf2x, simulated").get_data()
        assert abs(np.mean(x) - np.mean(y)) < 0.05 and np.ptp(y) < 2.01  # both shifted alike, of the ellipse
        assert {"cf2x, simulated", "runs/fit, simulated"} <= {line.get_label() for line in axis.lines}


def test_errors_are_drawn_after_their_times_with_their_units(figures, monkeypatch):
    monkeypatch.setattr(style, "save", lambda figure, path: None)
    table = np.arange(12.0).reshape(3, 4)
    save_errors({"flight.npz": table}, Path("errors.png"))
    (figure,) = figures
    titles = ["position (m)", "velocity (m/s)", "attitude (rad)", "rates (rad/s)"]
    for i, (axis, title) in enumerate(zip(figure.axes, titles, strict=True)):
        assert axis.get_title("left") == title and axis.get_xlabel() == "after (s)"
        np.testing.assert_allclose(axis.lines[0].get_xydata(), np.column_stack([[0.1, 0.25, 0.5], table[:, i]]))
