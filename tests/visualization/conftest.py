"""A flight to draw, and the figures that a test has drawn."""

import contextlib

import pytest

from jaxdrones.flights.fly import fly
from jaxdrones.visualization import style


@pytest.fixture(scope="session")
def record():
    return fly("circle", drones=2, duration=0.5)


@pytest.fixture
def figures(monkeypatch):
    """The figures that are drawn in a test."""
    drawn = []
    original = style.figure

    @contextlib.contextmanager
    def kept(width, height):
        with original(width, height) as figure:
            drawn.append(figure)
            yield figure

    monkeypatch.setattr(style, "figure", kept)
    return drawn
