"""A flight to draw, and the figures that a test has drawn."""

import contextlib
import dataclasses

import jax
import pytest

from jaxdrones.flights.fly import fly
from jaxdrones.flights.log import OPTIONAL, STATE
from jaxdrones.visualization import style


@pytest.fixture(scope="session")
def record():
    return fly("circle", drones=2, duration=0.5)


@pytest.fixture(scope="session")
def part_of_circle():
    """The first seconds of a flight of four drones, and some of its drones."""
    whole = fly("circle", drones=4, duration=4.0)

    def part(drones, seconds):
        rows = slice(round(seconds * 120))
        arrays = {name: getattr(whole, name)[rows, :drones] for name in STATE | OPTIONAL}
        params = jax.tree.map(lambda x: x[:drones], whole.params)
        return dataclasses.replace(whole, t=whole.t[rows], labels=whole.labels[:drones], params=params, **arrays)

    return part


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
