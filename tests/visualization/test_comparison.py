"""A comparison shows every flight, and says what every line is."""

import dataclasses
import json

import numpy as np
import pytest
from helpers import mostly_slow

from jaxdrones.cli import main
from jaxdrones.flights import read_log
from jaxdrones.visualization import comparison, style
from jaxdrones.visualization.palette import colors


def moved(record, by):
    return dataclasses.replace(record, pos=record.pos + np.float32(by))


@pytest.mark.slow
def test_two_flights_are_shown_with_their_errors_and_the_distance_between_them(record, tmp_path, figures):
    other = moved(record, [0.03, 0.0, 0.04])
    comparison.save_comparison({"one": record, "other": other}, tmp_path / "compare.png", "a title")
    (figure,) = figures
    path, error, apart = figure.axes
    assert [axis.get_title("left") for axis in figure.axes] == [
        "path from above",
        "distance to the target",
        "distance between the two flights",
    ]
    drawn = {line.get_color(): line.get_ydata() for line in error.lines}
    for tint, flight in zip(colors(2), (record, other), strict=True):
        np.testing.assert_allclose(drawn[tint], flight.error[..., 0].mean(axis=1), rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(apart.lines[0].get_ydata(), 0.05, rtol=1e-4)
    assert sum(line.get_color() == colors(2)[1] for line in path.lines) == 2 + 1  # drones, and their ends


def test_the_legend_names_the_flights_and_what_is_dashed_and_can_be_read_at_half_size(record, tmp_path, figures):
    from matplotlib.image import imread
    from matplotlib.text import Text

    records = {name: moved(record, 0.01 * i) for i, name in enumerate(("pid", "geometric", "lqr", "mellinger"))}
    comparison.save_comparison(records, tmp_path / "compare.png", "a title")
    (figure,) = figures
    assert len(figure.axes) == 2  # more than two flights have no distance between them
    (legend,) = figure.legends
    entries = {text.get_text(): line for text, line in zip(legend.get_texts(), legend.get_lines(), strict=True)}
    assert list(entries) == [*records, "commanded", "start", "end"]
    assert [entries[name].get_color() for name in records] == list(colors(4))
    assert entries["commanded"].is_dashed() and not entries["lqr"].is_dashed()
    widths = [entries[name].get_linewidth() for name in records]
    assert widths == sorted(widths, reverse=True) and widths[0] > widths[-1]  # what is covered is seen beside it
    texts = [text for text in figure.findobj(Text) if text.get_visible() and text.get_text().strip()]
    assert min(text.get_fontsize() * style.DPI / 72 / 2 for text in texts) >= 8  # pixels
    height, width = imread(tmp_path / "compare.png").shape[:2]
    for text in [*legend.get_texts(), *(axis.title for axis in figure.axes)]:
        box = text.get_window_extent()
        assert box.x0 >= 0 and box.y0 >= 0 and box.x1 <= width and box.y1 <= height


def test_bands_and_distances_are_those_of_all_drones(record):
    """Of which one flew 2 cm away, and the other 5 cm."""
    pos = np.float32([[0.02, 0, 0], [0.05, 0, 0]])
    flown = dataclasses.replace(record, pos=record.target_pos + pos, target_vel=np.full_like(record.vel, np.nan))
    with style.figure(4, 4) as figure:
        error, apart = figure.subplots(2)
        comparison._draw_errors(error, {"one": flown}, colors(1), 0.0)
        comparison._draw_distance(apart, flown, moved(flown, -pos), 0.0)
    (band,) = error.collections
    edges = band.get_paths()[0].vertices[:, 1]
    np.testing.assert_allclose(
        [edges.min(), edges.max(), *apart.lines[0].get_ydata()[:1]], [0.02, 0.05, 0.05], rtol=1e-3
    )
    assert (error.get_title("left"), error.get_ylabel()) == ("distance to the target", "error (m)")


def test_a_spike_of_one_flight_does_not_flatten_the_errors(record, tmp_path, figures):
    pos = record.pos.copy()
    pos[3] += 100.0
    spiked = dataclasses.replace(record, pos=pos)
    comparison.save_comparison({"one": record, "spiked": spiked}, tmp_path / "compare.png", "a title")
    assert figures[0].axes[1].get_ylim()[1] < 1.0


def test_the_panels_over_time_leave_out_the_transient_and_rounding(record, tmp_path, figures):
    pos = record.pos.copy()
    pos[:10] += 0.5  # a transient
    pos[10:] += np.float32(1e-3)
    pos[40] = record.pos[40] + np.float32(1e-20)
    other = dataclasses.replace(record, pos=pos)
    start = float(record.t[10])
    comparison.save_comparison({"one": record, "other": other}, tmp_path / "compare.png", "a title", after=start)
    _, error, apart = figures[0].axes
    for axis in (error, apart):
        assert axis.lines[0].get_xdata()[0] == pytest.approx(start)
    assert error.get_ylim()[1] < 0.5 and apart.get_ylim()[0] >= 1e-4
    assert apart.get_xlabel() == f"t (s), from {start:g} s on"


def test_what_is_commanded_to_many_drones_on_one_path_is_drawn_once():
    t = np.linspace(0, 2 * np.pi, 400)
    circles = np.stack([np.stack([np.cos(t + k), np.sin(t + k)], axis=-1) for k in range(4)], axis=1)
    shown = [np.isfinite(line).all(axis=1).sum() for line in comparison._once(circles)]
    assert shown == [400, 0, 0, 0]
    apart = np.stack([circles[:, 0], 3 + circles[:, 0]], axis=1)
    assert [np.isfinite(line).all(axis=1).sum() for line in comparison._once(apart)] == [400, 400]


@pytest.mark.parametrize("broken", mostly_slow([np.nan, np.inf, 3e38], [3e38]))
def test_flights_that_break_or_have_no_target_are_drawn(record, tmp_path, broken):
    pos = record.pos.copy()
    pos[20:, 1] = broken
    flights = {"one": record, "broken": dataclasses.replace(record, pos=pos)}
    comparison.save_comparison(flights, tmp_path / "compare.png", "a title")
    velocity = dataclasses.replace(record, target_pos=np.full_like(pos, np.nan), target_vel=np.zeros_like(pos))
    comparison.save_comparison({"one": velocity, "same": velocity}, tmp_path / "same.png", "a title")


@pytest.mark.slow
def test_the_command_line_compares_controllers(tmp_path, capsys):
    short = ["--duration", "0.2", "--output", str(tmp_path)]
    assert main(["compare", "circle", "--controllers", "pid,geometric", *short, "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["controllers"] == ["pid", "geometric"]
    assert [row["controller"] for row in report["results"]] == ["pid", "geometric"]
    logs = [read_log(tmp_path / name / "log.npz") for name in report["controllers"]]
    assert all(log.conditions.as_dict()["feedforward"] for log in logs)
    for row, log in zip(report["results"], logs, strict=True):
        peak = log.error[log.t >= 0.1].max()  # the flight is shorter than it takes to settle: its second half counts
        assert row["peak_error_m"] == pytest.approx(peak, rel=1e-4)
    assert report["files"][-1] == str(tmp_path / "compare.png") and (tmp_path / "compare.png").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--controllers", "pid"], "give two or more, for example pid,lqr"),
        (["--controllers", "pid,pid"], "give two different ones"),
        (["--controllers", "pid,lqg"], "unknown controller 'lqg'"),
        (["--controllers", "pid,lqr", "--controller", "pid"], "--controller pid is given beside --controllers"),
        (["--controllers", "pid,lqr", "--backends", "explicit,bullet"], "is given beside --controllers"),
        (["--controllers", "pid,lqr", "--output", "/proc/none"], "/proc/none"),
        (["--controllers", "pid,lqr", "--control-hz", "0"], "control rate (Hz) is 0"),
    ],
)
def test_a_comparison_that_cannot_be_is_refused_in_one_line(arguments, message, capsys):
    assert main(["compare", "circle", *arguments]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
