"""A flight that diverged is told from one that flew well."""

import dataclasses
import re

import numpy as np
import pytest

from jaxdrones.flights import read_log, save_npz
from jaxdrones.flights.conditions import Conditions
from jaxdrones.flights.files import arrays_of
from jaxdrones.flights.log import FlightLog
from jaxdrones.flights.results import definitions, diverged, divergence, results
from jaxdrones.params import repeat
from jaxdrones.urdf import load_params


def hovering(steps=100, drones=2, commanded="position"):
    """A level flight with a steady error of 0.1 m, or 0.1 m/s."""
    shape = (steps, drones)
    zeros, missing = np.zeros((*shape, 3), np.float32), np.full((*shape, 3), np.nan, np.float32)
    level = np.zeros((*shape, 4), np.float32)
    level[..., 3] = 1
    position = commanded == "position"
    return FlightLog(
        t=0.01 * np.arange(1, steps + 1),
        pos=zeros + np.float32([0.1, 0, 1]),
        quat=level,
        vel=zeros + np.float32([0.1, 0, 0]),
        omega=zeros,
        rpm=np.full((*shape, 4), 14_000, np.float32),
        target_pos=zeros + np.float32([0, 0, 1]) if position else missing,
        target_vel=missing if position else zeros,
        labels=tuple(f"drone {i}" for i in range(drones)),
        conditions=Conditions("circle"),
        params=repeat(load_params("cf2x"), drones),
    )


def changed(record, name, rows, value):
    array = np.array(getattr(record, name))
    array[rows, 1] = value
    return dataclasses.replace(record, **{name: array})


@pytest.mark.parametrize("commanded", ["position", "velocity"])
def test_a_steady_error_is_no_divergence(commanded):
    assert diverged(hovering(commanded=commanded)) == {}


@pytest.mark.parametrize(
    ("commanded", "name", "value", "message"),
    [
        ("position", "pos", [359, 0, 1], "drone 1 is 359 m off its command"),
        ("position", "pos", [1.2, 0, 1], "drone 1 is 1.2 m off its command"),
        ("position", "pos", [0, 0, -3e38], "drone 1 is 3e+38 m off its command"),
        ("velocity", "vel", [0, 0, -30], "drone 1 is 30 m/s off its command"),
        ("position", "quat", [1, 0, 0, 0], "drone 1 is upside down"),
        ("velocity", "quat", [0, 0.8, 0, 0.6], "drone 1 is upside down"),
        ("position", "pos", [np.nan, 0, 1], "the state of drone 1 is not finite from t = 0.910 s on"),
        ("position", "vel", [np.inf, 0, 1], "the state of drone 1 is not finite from t = 0.910 s on"),
        ("velocity", "omega", [0, np.nan, 1], "the state of drone 1 is not finite from t = 0.910 s on"),
        ("velocity", "rpm", [0, 0, 0, np.nan], "the state of drone 1 is not finite from t = 0.910 s on"),
    ],
)
def test_a_drone_that_is_lost_at_the_end_diverged(commanded, name, value, message):
    record = changed(hovering(commanded=commanded), name, slice(90, None), value)
    assert diverged(record) == {"drone 1": message}
    assert record.not_finite() == ({"drone 1": message} if "finite" in message else {})


@pytest.mark.parametrize(("name", "value"), [("pos", [5, 0, 1]), ("quat", [1, 0, 0, 0])])
def test_a_drone_that_was_lost_and_came_back_did_not_diverge(name, value):
    assert diverged(changed(hovering(), name, slice(20, 60), value)) == {}


def test_a_drone_that_starts_far_from_its_target_and_comes_nearer_did_not_diverge():
    record = changed(hovering(), "pos", slice(None), [9, 0, 1])
    assert diverged(changed(record, "pos", slice(50, None), [8, 0, 1])) == {}


def test_a_state_that_is_not_finite_for_a_moment_is_named():
    assert "t = 0.060 s" in diverged(changed(hovering(), "pos", 5, np.nan))["drone 1"]


@pytest.mark.parametrize("begin", [1e3, 1.7e9])
def test_a_flight_by_another_clock_has_the_same_results(begin):
    """Its last quarter and its settling do not count from a zero that it never saw."""
    record = changed(hovering(steps=400), "pos", slice(0, 150), [1.0, 0, 1])
    late = dataclasses.replace(record, t=record.t + begin)
    for found, expected in zip(results(late, 1.005), results(record, 1.005), strict=True):
        assert found.pop("drone") == expected.pop("drone")
        assert found.pop("settled_after_s") == pytest.approx(expected.pop("settled_after_s"), abs=0.02)
        assert found == pytest.approx(expected, rel=0.01)
    assert late.begin == late.t[0] and record.begin == 0
    assert "all other numbers count from 1001.0" in definitions(dataclasses.replace(record, t=record.t + 1e3), 1.005)


def test_extremes_count_from_the_given_time_on():
    record = changed(hovering(), "pos", slice(0, 50), [9, 0, -9])
    for rows, height, climb in (slice(0, 50), -9, 9), (slice(60, 62), 3, 4), (slice(62, 64), 0.5, -5):
        record = changed(changed(record, "pos", rows, [9, 0, height]), "vel", rows, [0, 0, climb])
    found = results(record, 0.505)[1]
    assert found["lowest_z_m"] == 0.5 and found["highest_z_m"] == 3 and found["peak_vz_m_s"] == 4
    assert found["peak_speed_m_s"] == 5 and found["peak_error_m"] == pytest.approx(np.hypot(9, 2))


@pytest.mark.parametrize(("last", "settled"), [(150, 1.5), (1, 0.01), (0, 0.0), (310, None)])
def test_a_drone_has_settled_where_its_error_stays_in_the_band_for_the_first_time(last, settled):
    """Its error leaves the band in row `last` - 1 for the last time; the last quarter begins in row 299."""
    record = hovering(steps=400)
    for rows in slice(0, max(last - 20, 0)), slice(max(last - 1, 0), last):
        record = changed(record, "pos", rows, [1.0, 0, 1])
    found = results(record, 0.0)[1]["settled_after_s"]
    assert found == (None if settled is None else pytest.approx(settled + 0.01 * (last > 0)))


def test_flights_differ_by_the_largest_distances_and_angles_over_the_drones():
    """The second drone is 5 m off, and turned by 0.3 rad; the sign of a quaternion has no meaning."""
    record, turned = hovering(), [0, 0, -np.sin(0.15), -np.cos(0.15)]
    other = changed(changed(record, "quat", slice(None), turned), "pos", slice(None), [0.1 + 3, 4, 1])
    table = divergence(record, other)
    assert [row["t_s"] for row in table] == sorted({row["t_s"] for row in table}) and len(table) == 12
    for row in table:
        assert row["pos_m"] == pytest.approx(5) and row["angle_rad"] == pytest.approx(0.3)
        assert row["vel_m_s"] == row["omega_rad_s"] == row["rpm"] == 0


def test_pwm_is_of_a_crazyflie():
    record = dataclasses.replace(hovering(), conditions=Conditions("circle", vehicle="racer"))
    assert "pwm" in arrays_of(hovering(), pwm=True)
    with pytest.raises(ValueError, match="PWM is requested for 'racer'; it is known for cf2x and cf2p only"):
        arrays_of(record, pwm=True)


@pytest.mark.parametrize("after", [0.3, 99.0])
def test_the_words_below_a_table_say_from_when_its_numbers_count(after):
    """A peak just before the time that they name is not counted, one at that time is."""
    record = hovering()
    steady, settled, others = definitions(record, after).splitlines()
    begin, last = (float(re.search(r"from (\d+\.\d+) s on", line)[1]) for line in (others, steady))
    assert begin == (0.3 if after < 1 else 0.5) and last == 0.75 and "10 % or 5 mm " in settled
    at = int(np.searchsorted(record.t, begin - 1e-9))
    peaks = [results(changed(record, "pos", row, [3, 0, 1]), after)[1]["peak_error_m"] for row in (at - 1, at)]
    np.testing.assert_allclose(peaks, [0.1, 3], rtol=1e-6)
    assert "mm/s" in definitions(hovering(commanded="velocity"), after)


def broken(array, row, value):
    array = np.array(array)
    array[row] = value
    return array


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda a: a.update(params="{}"), "the log is damaged"),
        (lambda a: a.update(params="[]"), "the log is damaged"),
        (lambda a: a.update(params="{"), "the log is damaged"),
        (lambda a: a.update(scene="[]"), "the log is damaged"),
        (lambda a: a.update(scene='{"ground": true, "obstacles": [{"kind": "Cat"}]}'), "'Cat' is missing"),
        (lambda a: a.update(scene='{"ground": true}'), "'obstacles' is missing"),
        (lambda a: a.pop("vel"), "has no column 'vel'"),
        (lambda a: a.update(t=a["t"][::-1]), "time goes from .* sort the rows"),
        (lambda a: a.update(t=broken(a["t"], 5, np.nan)), "time goes from .* sort the rows"),
        (
            lambda a: a.update(pos=a["pos"][:3]),
            r"pos is float32 of shape \(3, 2, 3\); give numbers of shape \(100, 2, 3\)",
        ),
        (lambda a: a.update(quat=a["quat"][..., :3]), r"quat is float32 of shape \(100, 2, 3\)"),
        (lambda a: a.update(labels=a["labels"][:1]), "100 times, 2 drones and 1 labels"),
        (lambda a: a.update(pos=broken(a["pos"], (5, 1), np.nan)), "drone 1 is not finite before row 6"),
        (lambda a: a.update(vel=broken(a["vel"], slice(None), np.inf)), "drone 0 is not finite in row 0"),
    ],
)
def test_a_damaged_log_is_refused(tmp_path, change, says):
    arrays = arrays_of(hovering())
    change(arrays)
    np.savez(tmp_path / "log.npz", **arrays)
    with pytest.raises(ValueError, match=says):
        read_log(tmp_path / "log.npz")


def test_a_flight_that_diverged_is_read(tmp_path):
    """Its states are not finite from some time on, to the end."""
    save_npz(changed(hovering(), "pos", slice(90, None), np.nan), tmp_path / "log.npz")
    assert list(read_log(tmp_path / "log.npz").not_finite()) == ["drone 1"]
