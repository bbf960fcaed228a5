import numpy as np
import pytest

from jaxdrones.flights.fly import fly
from jaxdrones.visualization import plots


@pytest.fixture(scope="module")
def record():
    return fly("circle", drones=2, duration=0.5)


def test_every_quantity_of_the_state_has_a_panel(record):
    assert len(plots.PANELS) == 16  # position, velocity, angles, rates, four motors
    for array, column, _ in plots.PANELS.values():
        assert np.isfinite(getattr(record, array)[:, :, column]).all()


@pytest.mark.parametrize("panels", [(), ("z",), ("z", "vz", "rpm0"), ("x", "vx", "z", "vz")])
def test_a_figure_shows_something_for_any_choice_of_panels(record, tmp_path, panels):
    from matplotlib.image import imread

    plots.save_flight(record, tmp_path / "flight.png", "a title", panels)
    picture = imread(tmp_path / "flight.png")
    assert picture.shape[0] > 200 and picture[..., :3].std() > 0.05


def test_without_matplotlib_the_error_names_the_extra(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "matplotlib", None)
    with pytest.raises(ValueError, match=r'pip install "jaxdrones\[cli\]"'):
        plots.check_matplotlib()
