"""Learning curves show what runs have in common and how far they differ."""

import numpy as np
import pytest
from helpers import mostly_slow

from jaxdrones.visualization import learning_curves
from jaxdrones.visualization.learning_curves import PANELS, save_curves, spread


def history(seed, updates=12):
    random = np.random.default_rng(seed)
    rows = []
    for update in range(updates + 1):
        row = {"update": float(update), "steps": 1000.0 * update}
        if update:
            row["reward"] = float(random.normal())
        if update % 3 == 0:
            row |= {"evaluated_return": 10.0 * update, "success": update / updates, "evaluated_error": 1 / (1 + update)}
        rows.append(row)
    return rows


def test_the_band_holds_every_run_and_the_median_is_in_it():
    random = np.random.default_rng(0)
    curves = [np.stack([np.linspace(0, 10, k), random.normal(size=k)], axis=1) for k in (5, 8, 11)]
    steps, median, lowest, highest = spread(curves)
    for points in curves:
        values = np.interp(steps, *points.T)
        assert (lowest <= values).all() and (values <= highest).all()
        assert np.isin(points[:, 0], steps).all()
    np.testing.assert_array_equal(median, np.median([np.interp(steps, *points.T) for points in curves], axis=0))
    assert (lowest < median).any() and (median < highest).any()


def test_the_band_is_where_all_runs_have_values():
    short, long = (np.array([[0.0, 1.0], [end, 1.0]]) for end in (4, 9))
    steps, median, lowest, highest = spread([short, long])
    assert steps[0] == 0 and steps[-1] == 4 and (median == 1).all() and (highest - lowest == 0).all()
    assert spread([short, np.array([[5.0, 1.0], [9.0, 1.0]])])[0].size == 0


@pytest.mark.parametrize("runs", mostly_slow([0, 1, 3, 9], [3]))
def test_a_figure_is_drawn_of_any_number_of_runs(runs, tmp_path):
    from matplotlib.image import imread

    histories = {f"seed {seed}": history(seed) for seed in range(runs)}
    kept = {"seed 0": 6, "seed 1": 9, "seed 2": 0}
    save_curves(histories, tmp_path / "curve.png", "a title", lambda success: (success - 0.1, success + 0.1), kept)
    assert imread(tmp_path / "curve.png").shape[:2] == (990, 1430)


def test_a_run_that_was_never_evaluated_is_drawn(tmp_path):
    save_curves({"seed 0": history(0, updates=2)}, tmp_path / "curve.png", "a title")
    assert (tmp_path / "curve.png").stat().st_size > 1000


def test_panels_say_what_was_evaluated():
    assert [name for name, label in PANELS.items() if "evaluated" not in label] == ["reward"]


@pytest.fixture
def drawn(monkeypatch):
    """Figures in place of their files."""
    figures = []
    monkeypatch.setattr(learning_curves.style, "save", lambda figure, path: figures.append(figure))
    return figures


def test_the_best_policy_is_marked_where_it_was_evaluated(drawn, tmp_path):
    save_curves({"a": history(0), "b": history(1)}, tmp_path / "curve.png", "", kept={"a": 6, "b": 0})
    (figure,) = drawn
    stars = [[line.get_xydata().tolist() for line in axis.lines if line.get_marker() == "*"] for axis in figure.axes]
    assert stars == [[], *([[[6000, kept]], [[0, untrained]]] for kept, untrained in ((60, 0), (0.5, 0), (1 / 7, 1)))]
    assert "best policy" in [text.get_text() for text in figure.legends[0].get_texts()]


def test_success_rates_have_error_bars_of_their_intervals_also_before_training(drawn, tmp_path):
    def interval(success):
        return 0.9 * success, min(1.0, success + 0.125)

    save_curves({"a": history(0)}, tmp_path / "curve.png", "", interval, {"a": 12})
    (figure,) = drawn
    (bars,) = figure.axes[2].containers
    (lines,) = bars.lines[2]
    assert [segment.tolist() for segment in lines.get_segments()] == [
        [[1000 * update, interval(update / 12)[0]], [1000 * update, interval(update / 12)[1]]]
        for update in (0, 3, 6, 9, 12)
    ]
    texts = [text.get_text() for text in figure.legends[0].get_texts()]
    assert texts == ["95 % interval, of the best policy 90.0 to 100.0 %", "best policy"]


def test_a_figure_that_cannot_be_drawn_leaves_the_old_one(tmp_path):
    (tmp_path / "curve.png").write_text("old")
    with pytest.raises(KeyError):
        save_curves({"a": [{"steps": 1.0}, {"reward": 1.0}]}, tmp_path / "curve.png", "")
    assert [file.read_text() for file in tmp_path.iterdir()] == ["old"]
