import dataclasses
import os
import subprocess
import sys

import numpy as np
import pytest
from helpers import mostly_slow

from jaxdrones.sensing import Box, Cylinder, Scene, Sphere
from jaxdrones.visualization import paths, plots, style
from jaxdrones.visualization.palette import colors


def test_every_quantity_of_the_state_has_a_panel(record):
    assert len(plots.PANELS) == 16  # position, velocity, angles, rates, four motors
    units = {"pos": "(m)", "vel": "(m/s)", "rpy": "(rad)", "omega": "(rad/s)", "rpm": "(RPM)"}
    axes = {"rpy": ("roll", "pitch", "yaw"), "rpm": ("P0", "P1", "P2", "P3")}
    for array, column, label in plots.PANELS.values():
        assert np.isfinite(getattr(record, array)[:, :, column]).all()
        name, unit = label.split()
        assert name.endswith(axes.get(array, "xyz")[column]) and unit == units[array]


def test_the_command_of_a_velocity_is_a_velocity(record):
    flown = dataclasses.replace(record, target_vel=np.full_like(record.vel, 0.3))
    with style.figure(3, 3) as figure:
        axis = figure.subplots()
        plots._draw_signal(axis, flown, "vy", colors(2))
    dashed, line = axis.lines[2:]
    assert dashed.is_dashed() and (dashed.get_ydata() == flown.target_vel[0, 0, 0]).all()
    np.testing.assert_array_equal(line.get_ydata(), flown.vel[:, 1, 1])


PANELS = [(), ("z",), ("z", "vz", "rpm0"), ("x", "vx", "z", "vz"), plots.POLICY_PANELS]


@pytest.mark.parametrize("panels", mostly_slow(PANELS, [(), ("z",)]))
def test_a_figure_shows_everything_and_all_of_it_can_be_read_at_half_size(record, tmp_path, panels, figures):
    from matplotlib.image import imread
    from matplotlib.text import Text

    plots.save_flight(record, tmp_path / "flight.png", "a title", panels)
    picture = imread(tmp_path / "flight.png")
    assert picture[..., :3].std() > 0.05
    (figure,) = figures
    assert len(figure.axes) == 2 + len(panels or plots.PANELS)
    texts = [text for text in figure.findobj(Text) if text.get_visible() and text.get_text().strip()]
    assert min(text.get_fontsize() * style.DPI / 72 / 2 for text in texts) >= 8  # pixels
    height, width = picture.shape[:2]
    (legend,) = figure.legends
    for text in [
        *legend.get_texts(),
        *(axis.yaxis.label for axis in figure.axes),
        *(axis.title for axis in figure.axes),
    ]:
        box = text.get_window_extent()
        assert box.x0 >= 0 and box.y0 >= 0 and box.x1 <= width and box.y1 <= height


def test_the_legend_names_every_drone_and_explains_what_is_dashed(record, tmp_path, figures):
    plots.save_flight(record, tmp_path / "flight.png", "a title", ("z",))
    entries = dict(
        zip(
            (text.get_text() for text in figures[0].legends[0].get_texts()),
            figures[0].legends[0].get_lines(),
            strict=True,
        )
    )
    assert list(entries) == ["drone 0", "drone 1", "commanded", "last target", "start", "end"]
    assert [entries[name].get_color() for name in record.labels] == list(colors(2))
    assert entries["commanded"].is_dashed() and not entries["drone 0"].is_dashed()


def test_a_panel_holds_nearly_all_samples_and_says_what_it_leaves_out(record, tmp_path, figures):
    rpm = np.full_like(record.rpm, 14_000)
    rpm[0, 0] = rpm[1, 1] = 30_000
    plots.save_flight(dataclasses.replace(record, rpm=rpm), tmp_path / "flight.png", "a title", ("rpm0",))
    axis = figures[0].axes[-1]
    low, high = axis.get_ylim()
    assert low < 14_000 < high < 20_000
    assert [text.get_text() for text in axis.texts] == ["outside: 30,000, first at 0.01 s"]


def test_a_team_of_many_drones_is_a_median_with_bands(record, tmp_path, figures):
    many = {name: np.repeat(getattr(record, name), 15, axis=1) for name in ("pos", "quat", "vel", "omega", "rpm")}
    many |= {name: np.repeat(getattr(record, name), 15, axis=1) for name in ("target_pos", "target_vel")}
    many["pos"] = many["pos"] + np.arange(30)[None, :, None]
    crowd = dataclasses.replace(record, **many, labels=tuple(f"drone {i}" for i in range(30)))
    plots.save_flight(crowd, tmp_path / "flight.png", "a title", ("z",))
    named = [text.get_text() for text in figures[0].legends[0].get_texts()]
    assert named[:3] == ["median of 30 drones", "90 % of the drones", "100 % of the drones"]
    axis, height = figures[0].axes[-1], crowd.pos[..., 2]
    np.testing.assert_allclose(axis.lines[0].get_ydata(), np.median(height, axis=1), rtol=1e-6)
    edges = [band.get_paths()[0].vertices[:, 1] for band in axis.collections]
    assert edges[0].max() == pytest.approx(height.max()) and edges[0].min() == pytest.approx(height.min())
    assert height.min() < edges[1].min() < edges[1].max() < height.max()
    path = figures[0].axes[1]
    assert len([line for line in path.lines if len(line.get_xdata()) > 2]) == 30 and "commanded" not in named


@pytest.mark.parametrize(
    ("extent", "plane"),
    [((1, 1, 0.1), (0, 1)), ((1, 0, 0.5), (0, 2)), ((0, 1, 2), (1, 2)), ((0, 0, 1), (0, 2)), ((1, 0, 0), (0, 1))],
)
def test_the_path_is_drawn_in_the_plane_in_which_it_is_largest(extent, plane):
    t = np.linspace(0, 1, 50)[:, None]
    assert paths.widest_plane((np.sin(7 * t + [0, 1, 2]) * extent)[:, None]) == plane


@pytest.mark.parametrize(
    ("axes", "title", "labels"), [([0, 1, 2], "above", ("x", "y")), ([2, 0, 1], "the side", ("y", "z"))]
)
def test_a_plane_is_named_with_its_axes(axes, title, labels, record):
    flown = dataclasses.replace(record, pos=record.pos[..., axes], target_pos=record.target_pos[..., axes])
    with style.figure(3, 3) as figure:
        axis = figure.subplots()
        paths.prepare_plane(axis, [flown])
    assert axis.get_title("left") == f"path from {title}"
    assert (axis.get_xlabel(), axis.get_ylabel()) == tuple(f"{label} (m)" for label in labels)


def test_a_path_in_space_ends_where_the_panel_does():
    path = np.array([[0.0, 0, 0], [0, 9, 0], [1, 1, 1]])
    np.testing.assert_array_equal(paths._inside(path, [(-1, 1)] * 3), [[0, 0, 0], [np.nan] * 3, [1, 1, 1]])


def test_outlines_of_obstacles_have_their_area():
    turned = (0.0, 0.0, np.sin(0.3), np.cos(0.3))
    scene = Scene.of(
        Box(pos=(1.0, 0.0, 0.5), size=(0.4, 1.0, 2.0), quat=turned),
        Sphere(pos=(0.0, 2.0, 0.5), radius=0.3),
        Cylinder(pos=(-1.0, 0.0, 1.0), radius=0.2, height=2.0),
    )

    def area(outline):
        x, y = outline.T
        return abs(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))) / 2

    x, y, z = np.eye(3)
    box, sphere, cylinder = paths.outlines(scene, x, y)
    np.testing.assert_allclose([area(box), area(sphere), area(cylinder)], [0.4, 0.09 * np.pi, 0.04 * np.pi], rtol=0.02)
    np.testing.assert_allclose(cylinder.mean(axis=0), [-1, 0], atol=1e-6)
    np.testing.assert_allclose(area(paths.outlines(scene, x, z)[2]), 0.8, rtol=0.02)


@pytest.mark.slow
def test_invalid_settings_of_matplotlib_are_a_users_mistake():
    """In a process of its own, as they are read when it is imported."""
    script = "from jaxdrones.visualization import plots; plots.check_matplotlib()"
    environ = os.environ | {"MPLBACKEND": "nonsense"}
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, env=environ, check=False)
    assert "UserError: matplotlib does not start: Key backend: 'nonsense'" in done.stderr


def test_without_matplotlib_the_error_names_the_extra(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "matplotlib", None)
    with pytest.raises(ValueError, match=r'pip install ".*\[cli\]"'):
        plots.check_matplotlib()
