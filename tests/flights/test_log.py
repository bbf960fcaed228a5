"""Logs of flights are loaded, and invalid ones are refused."""

import dataclasses
import io
import json
import zipfile

import numpy as np
import pytest

from jaxdrones.cli import main
from jaxdrones.firmware.drone import Recorder, Sample
from jaxdrones.flights import FlightLog, load_flights, read_log, save_csv, save_npz
from jaxdrones.flights.log import OPTIONAL, STATE, ImageSequence
from jaxdrones.urdf import load_params


def written(folder, columns):
    np.savez(folder / "flight.npz", **columns)
    (log,) = load_flights(folder / "flight.npz")
    return log


def test_a_log_is_read_as_it_was_written(columns, tmp_path):
    log = written(tmp_path, columns)
    np.testing.assert_array_equal(log.rpm[:, 0], columns["rpm"])
    assert log.name == "flight.npz" and log.has("rpm") and not log.has("target_pos")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda c: c.pop("vel"), "has no column 'vel'"),
        (lambda c: c.pop("rpm"), r"has no column 'pwm' \(or rpm\)"),
        (lambda c: c.update(t=c["t"][::-1]), "time goes from 2.99 to 2.98 s in row 1"),
        (lambda c: c.update(t=np.append(c["t"][:-1], np.inf)), "time goes from 2.98 to inf s in row 299"),
        (lambda c: c.update(t=np.full(300, np.nan)), "time is nan s in row 0"),
        (lambda c: c.update(t=c["t"] + np.inf), "time is inf s in row 0"),
        (lambda c: c.update({k: v[:1] for k, v in c.items()}, t=np.array([np.nan])), "time is nan s in row 0"),
        (lambda c: c.update(quat=c["quat"] * 1e300), "has a length of (inf|1e.300) in row 0"),
        (lambda c: c.update(t=2 * c["t"]), "rows are 0.02 s apart; record them"),
        (
            lambda c: c.update(pos=np.where(np.arange(300)[:, None] == 7, np.nan, c["pos"])),
            "the state of drone 0 is not finite before row 8",
        ),
        (lambda c: c.update(omega=np.rad2deg(c["omega"]) + 100), "looks like degrees/s; give rad/s"),
        (lambda c: c.update(rpm=c["rpm"] / 9.549), "looks like rad/s; give RPM"),
        (lambda c: c.update(pwm=c.pop("rpm") / 300, vbat=np.full(300, 3.7)), "pwm .* looks like percent"),
        (lambda c: c.update(pwm=c.pop("rpm") / 80, vbat=np.full(300, 3.7)), "pwm .* 8 bits"),
        (lambda c: c.update(pwm=1000 + c.pop("rpm") / 20, vbat=np.full(300, 3.7)), "pwm .* microseconds"),
        (
            lambda c: c.update(quat=c["quat"] * (np.arange(300) != 9)[:, None]),
            "length of 0 in row 9, but a unit quaternion",
        ),
        (lambda c: c.update(labels=np.array(["a", "b"])), "has 300 times, 1 drones and 2 labels"),
        (lambda c: c.update(pwm=c.pop("rpm"), vbat=np.full(300, 3700.0)), "vbat .* looks like millivolts"),
        (lambda c: c.update(quat=c["quat"] * 2), "has a length of 2 in row 0, but a unit quaternion"),
        (lambda c: c.update({k: v[:50] for k, v in c.items()}), "has 50 rows, 0.49 s; give at least one second"),
        (
            lambda c: c.update(pos=c["pos"][:, :2]),
            r"pos is float64 of shape \(300, 2\); give numbers of shape \(300, 1, 3\)",
        ),
        (lambda c: c.update(load_pos=c["pos"][:, :2]), r"load_pos is .*give numbers .*position of the load"),
    ],
)
def test_what_no_flight_has_is_named(columns, tmp_path, change, says):
    change(columns)
    with pytest.raises(ValueError, match=says):
        written(tmp_path, columns)


def test_what_is_no_file_of_arrays_is_named(tmp_path):
    (tmp_path / "text.npz").write_text("t, pos")
    with pytest.raises(ValueError, match=r"is not an \.npz file"):
        read_log(tmp_path / "text.npz")
    with pytest.raises(ValueError, match="does not exist; fly first"):
        read_log(tmp_path / "missing.npz")


def test_headers_that_claim_too_much_and_plain_arrays_are_refused(columns, tmp_path):
    """A header of 8 TB over a few bytes allocates nothing; a .npy is no .npz."""
    np.savez(tmp_path / "flight.npz", **columns)
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (10**12,)})
    with zipfile.ZipFile(tmp_path / "huge.npz", "w") as archive:
        archive.writestr("t.npy", header.getvalue() + b"few bytes")
    with pytest.raises(ValueError, match=r"is not an \.npz file"):
        read_log(tmp_path / "huge.npz")
    np.save(tmp_path / "plain.npy", columns["pos"])
    with pytest.raises(ValueError, match=r"is not an \.npz file"):
        read_log(tmp_path / "plain.npy")
    whole = (tmp_path / "flight.npz").read_bytes()
    for cut in (0, 1, 100, len(whole) // 2, len(whole) - 1):
        (tmp_path / "cut.npz").write_bytes(whole[:cut])
        with pytest.raises(ValueError, match=r"is not an \.npz file"):
            read_log(tmp_path / "cut.npz")


def test_a_log_is_made_of_arrays_with_a_drone_axis_and_saved_to_a_new_folder(columns, tmp_path):
    arrays = {name: np.asarray(columns[name])[:, None] for name in STATE}
    save_npz(FlightLog(columns["t"], **arrays), f"{tmp_path}/new/log.npz")
    np.testing.assert_array_equal(read_log(tmp_path / "new").pos, arrays["pos"])
    for name, wrong in ("pos", columns["pos"]), ("quat", columns["quat"]), ("vel", arrays["vel"][1:]):
        with pytest.raises(ValueError, match=rf"{name} of a log has shape \(.*; give \(K, n, \d\) of K times and n"):
            FlightLog(columns["t"], **(arrays | {name: wrong}))


def test_the_log_of_a_drone_of_a_team_has_its_images_and_is_read_as_it_was_written(columns, tmp_path):
    arrays = {name: np.repeat(np.asarray(columns[name])[:, None], 2, axis=1) for name in STATE}
    frames = np.arange(3 * 2 * 4 * 5, dtype=np.float32).reshape(3, 2, 4, 5)
    team = FlightLog(columns["t"], **arrays, images={"depth": ImageSequence(np.arange(3.0), frames)})
    save_npz(team.drone(1), tmp_path / "log.npz")
    np.testing.assert_array_equal(read_log(tmp_path / "log.npz").images["depth"].frames, frames[:, 1:])


def test_a_table_of_one_drone_or_of_a_team_is_read_as_it_was_written(columns, tmp_path):
    one = written(tmp_path, columns)
    twice = {name: np.repeat(getattr(one, name), 2, axis=1) for name in STATE | OPTIONAL}
    for log in (one, dataclasses.replace(one, **twice, labels=("a", "b"), params=None)):
        save_csv(log, tmp_path / "flight.csv")
        read = read_log(tmp_path / "flight.csv")
        assert read.labels == log.labels
        for name in ("t", *STATE, "rpm"):
            np.testing.assert_allclose(getattr(read, name), getattr(log, name), rtol=1e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda line: line.replace(line.split(",")[3], "", 1), r"column 'pos_y' has '' in line 5"),
        (lambda line: line.replace(line.split(",")[3], "far", 1), r"column 'pos_y' has 'far' in line 5"),
    ],
)
def test_an_entry_of_a_table_that_is_no_number_is_named(change, message, columns, tmp_path):
    save_csv(written(tmp_path, columns), tmp_path / "flight.csv")
    lines = (tmp_path / "flight.csv").read_text().splitlines()
    lines[4] = change(lines[4])
    (tmp_path / "flight.csv").write_text("\n".join(lines))
    with pytest.raises(ValueError, match=message):
        read_log(tmp_path / "flight.csv")


def test_a_table_with_semicolons_is_refused(tmp_path):
    (tmp_path / "flight.csv").write_text("t;pos_x\n0.0;1.0\n")
    with pytest.raises(
        ValueError, match=r"flight\.csv: is not a table of numbers \(columns are separated by semicolons;"
    ):
        read_log(tmp_path / "flight.csv")


def test_a_table_that_mixes_drones_or_times_is_refused(columns, tmp_path):
    """Rows of two drones belong together by time; a table says which is whose, so no other order is guessed."""
    one = written(tmp_path, columns)
    twice = {name: np.repeat(getattr(one, name), 2, axis=1) for name in STATE | OPTIONAL}
    save_csv(dataclasses.replace(one, **twice, labels=("a", "b"), params=None), tmp_path / "flight.csv")
    head, *rows = (tmp_path / "flight.csv").read_text().splitlines()
    orders = {
        "swapped": [*rows[:4], rows[5], rows[4], *rows[6:]],
        "missing": rows[:-1],
        "other times": [*rows[:4], rows[4].replace(rows[4].split(",")[0], "0.0201", 1), *rows[5:]],
    }
    for name, lines in orders.items():
        (tmp_path / f"{name}.csv").write_text("\n".join([head, *lines]))
        with pytest.raises(
            ValueError, match="one row for each time and drone" if name != "missing" else "is not a table"
        ):
            read_log(tmp_path / f"{name}.csv")
    (tmp_path / "marked.csv").write_text("\n".join([head, *rows]), encoding="utf-8-sig")  # as spreadsheets write it
    assert read_log(tmp_path / "marked.csv").labels == ("a", "b")


def test_a_table_whose_lines_or_columns_do_not_fit_is_refused(columns, tmp_path):
    """A line that was cut off has no NaN at its end, and one with decimal commas is not read shifted."""
    save_csv(written(tmp_path, columns), tmp_path / "flight.csv")
    head, *rows = (tmp_path / "flight.csv").read_text().splitlines()
    tables = {
        "cut": [head, *rows[:-1], rows[-1].rpartition(",")[0]],
        "commas": [head, *rows[:4], rows[4].replace(".", ","), *rows[5:]],
        "twice": [head + ",pos_x", *(row + ",7" for row in rows)],
    }
    for name, lines in tables.items():
        (tmp_path / f"{name}.csv").write_text("\n".join(lines))
        with pytest.raises(ValueError, match="two columns" if name == "twice" else "has not .* entries"):
            read_log(tmp_path / f"{name}.csv")


def test_blanks_beside_the_commas_of_a_table_do_not_matter(columns, tmp_path):
    log = written(tmp_path, columns)
    save_csv(log, tmp_path / "flight.csv")
    (tmp_path / "blanks.csv").write_text((tmp_path / "flight.csv").read_text().replace(",", " , "))
    np.testing.assert_allclose(read_log(tmp_path / "blanks.csv").pos, log.pos, rtol=1e-6)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda rows: [], "it has no rows"),
        (lambda rows: rows[:1], "it has no rows"),
        (lambda rows: [rows[0].replace("quat_x", "qx"), *rows[1:]], r"some columns of 'quat' .*; quat_x is missing"),
        (lambda rows: [rows[0].replace("rpm_0", "rpm_4"), *rows[1:]], r"some columns of 'rpm' .*; rpm_0 is missing"),
        (lambda rows: [*rows[:4], "nan," + rows[4].partition(",")[2], *rows[5:]], "goes from .* to nan s in row 3"),
    ],
)
def test_a_table_that_lacks_rows_columns_or_times_is_refused(change, says, columns, tmp_path):
    save_csv(written(tmp_path, columns), tmp_path / "flight.csv")
    (tmp_path / "flight.csv").write_text("\n".join(change((tmp_path / "flight.csv").read_text().splitlines())))
    with pytest.raises(ValueError, match=says):
        read_log(tmp_path / "flight.csv")


def test_a_name_of_a_single_drone_is_its_label(columns, tmp_path):
    np.savez(tmp_path / "flight.npz", **columns, labels=np.asarray("scout"))
    assert read_log(tmp_path / "flight.npz").labels == ("scout",)


@pytest.mark.parametrize(
    ("t", "frames"),
    [(["a", "b"], (2, 1, 4, 4, 3)), ([0.0, 1.0], (2, 1)), ([0.0, 1.0], (3, 1, 4, 4)), ([0.0], (1, 2, 4, 4))],
)
def test_images_that_are_none_are_refused(columns, tmp_path, t, frames):
    images = {"images/rgb/t": np.array(t), "images/rgb/frames": np.zeros(frames, np.uint8)}
    np.savez(tmp_path / "flight.npz", **columns, **images)
    with pytest.raises(ValueError, match=r"images 'rgb' are uint8 of shape .*; give numbers"):
        read_log(tmp_path / "flight.npz")


@pytest.mark.slow
def test_what_fly_wrote_is_fitted(tmp_path, capsys):
    """The thrust of the vehicle that flew, from the log of each drone of a team at 120 Hz."""
    assert main(["fly", "circle", "--drones", "2", "--duration", "3", "--output", str(tmp_path), "--no-figure"]) == 0
    capsys.readouterr()
    assert main(["fit", str(tmp_path), "--parameters", "kf", "--output", str(tmp_path / "fit"), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert set(report["errors"]) == {"log.npz, drone 0", "log.npz, drone 1"}
    estimate = report["parameters"]["kf"]
    assert estimate["identifiable"] and estimate["value"] == pytest.approx(float(load_params("cf2x").kf), rel=0.01)


def test_a_recorded_flight_keeps_its_targets_where_some_rows_have_none():
    recorder, zero, place = Recorder(), np.zeros(3), np.array([0.0, 1, 2])
    for target in (None, place, None):
        recorder.add(0.01 * len(recorder), Sample(zero, np.eye(4)[3], zero, zero, np.ones(4), zero), target)
    log = recorder.log(load_params("racer"), {}, "a flight")
    difference, unit = log.difference()
    np.testing.assert_allclose(difference[:, 0], [np.full(3, np.nan), -place, np.full(3, np.nan)])
    assert unit == "m" and log.has("target_pos")
