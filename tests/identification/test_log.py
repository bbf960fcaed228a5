"""Logs of flights are loaded, and invalid ones are refused."""

import io
import zipfile

import numpy as np
import pytest

from jaxdrones.identification import FlightLog


def written(folder, columns):
    np.savez(folder / "flight.npz", **columns)
    return FlightLog.load(folder / "flight.npz")


def test_a_log_is_read_as_it_was_written(columns, tmp_path):
    log = written(tmp_path, columns)
    np.testing.assert_array_equal(log.rpm, columns["rpm"])
    assert log.name == "flight.npz" and log.has_rotor_speeds and not log.has_setpoints


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda c: c.pop("vel"), "has no column 'vel'"),
        (lambda c: c.pop("rpm"), r"has no column 'pwm' \(or rpm\)"),
        (lambda c: c.update(t=c["t"][::-1]), "time goes from 2.99 to 2.98 s in row 1"),
        (lambda c: c.update(t=2 * c["t"]), "rows are 0.02 s apart; resample"),
        (lambda c: c["pos"].__setitem__((7, 1), np.nan), "pos is not finite in row 7"),
        (lambda c: c.update(omega=np.rad2deg(c["omega"]) + 100), "looks like degrees/s; give rad/s"),
        (lambda c: c.update(rpm=c["rpm"] / 9.549), "looks like rad/s; give RPM"),
        (lambda c: c.update(pwm=c.pop("rpm") / 300, vbat=np.full(300, 3.7)), "pwm .* looks like percent"),
        (lambda c: c.update(pwm=c.pop("rpm"), vbat=np.full(300, 3700.0)), "vbat .* looks like millivolts"),
        (lambda c: c.update(quat=c["quat"] * 2), "looks like no unit quaternion"),
        (lambda c: c.update({k: v[:50] for k, v in c.items()}), "has 50 rows; give at least 100"),
        (lambda c: c.update(pos=c["pos"][:, :2]), r"pos is float64 of shape \(300, 2\); give numbers of shape"),
    ],
)
def test_what_no_flight_has_is_named(columns, tmp_path, change, says):
    change(columns)
    with pytest.raises(ValueError, match=says):
        written(tmp_path, columns)


def test_what_is_no_file_of_arrays_is_named(tmp_path):
    (tmp_path / "text.npz").write_text("t, pos")
    with pytest.raises(ValueError, match=r"is not an \.npz file"):
        FlightLog.load(tmp_path / "text.npz")
    with pytest.raises(ValueError, match="cannot be read"):
        FlightLog.load(tmp_path / "missing.npz")


def test_headers_that_claim_too_much_and_plain_arrays_are_refused(columns, tmp_path):
    """A header of 8 TB over a few bytes allocates nothing; a .npy is no .npz."""
    np.savez(tmp_path / "flight.npz", **columns)
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (10**12,)})
    with zipfile.ZipFile(tmp_path / "huge.npz", "w") as archive:
        archive.writestr("t.npy", header.getvalue() + b"few bytes")
    with pytest.raises(ValueError, match="t claims 8,000,000,000,000 bytes"):
        FlightLog.load(tmp_path / "huge.npz")
    np.save(tmp_path / "plain.npy", columns["pos"])
    with pytest.raises(ValueError, match=r"is not an \.npz file"):
        FlightLog.load(tmp_path / "plain.npy")
    whole = (tmp_path / "flight.npz").read_bytes()
    for cut in (0, 1, 100, len(whole) // 2, len(whole) - 1):
        (tmp_path / "cut.npz").write_bytes(whole[:cut])
        with pytest.raises(ValueError, match=r"is not an \.npz file"):
            FlightLog.load(tmp_path / "cut.npz")
