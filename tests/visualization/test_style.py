"""Limits of axes show what is to be seen."""

import numpy as np
import pytest

from jaxdrones.visualization import style


def waves(seed, steps=400, lines=3):
    random = np.random.default_rng(seed)
    t = np.linspace(0, 6, steps)[:, None]
    return (
        random.normal(size=lines) + np.sin(random.uniform(1, 5, lines) * t) + 0.1 * random.normal(size=(steps, lines))
    )


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("spikes", [0, 1, 8])
@pytest.mark.parametrize("size", [1.0, 30.0, 1e4, 1e30])
def test_limits_hold_95_percent_of_the_samples_of_every_line(seed, spikes, size):
    lines = waves(seed)
    lines[:spikes] += size
    low, high = style.limits(lines)
    assert ((lines >= low) & (lines <= high)).mean(axis=0).min() >= 0.95


def test_a_spike_in_the_first_sample_does_not_flatten_the_axis():
    lines = waves(0)
    without = np.ptp(style.limits(lines))
    lines[0] = 1e4
    low, high = style.limits(lines)
    assert high - low < 2 * without and low == pytest.approx(lines.min() - (high - low) / 22)  # no space below


def test_numbers_at_an_axis_are_whole_and_not_from_an_offset():
    with style.figure(1, 1) as figure:
        assert not figure.subplots().yaxis.get_major_formatter().get_useOffset()


def test_everything_is_shown_where_nothing_stands_out():
    lines = waves(1)
    low, high = style.limits(lines)
    assert low < lines.min() < lines.max() < high
    assert np.ptp(lines) > 0.9 * (high - low)


def test_noise_is_not_magnified_and_what_is_not_finite_is_not_counted():
    lines = 5 + 1e-9 * waves(2)
    lines[3:7], lines[9, 1] = np.nan, np.inf
    low, high = style.limits(lines, smallest=0.02)
    assert high - low == pytest.approx(0.022) and low < 5 < high
    assert style.limits(np.full((3, 2), np.nan)) == (0.0, 1.0)
    low, high = style.limits(np.full((3, 2), 14_000.0))
    assert low < 14_000 < high
