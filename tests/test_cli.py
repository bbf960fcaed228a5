"""The command line as a user meets it."""

import csv
import dataclasses
import json
import os

import jax
import numpy as np
import pytest
from helpers import mostly_slow

from jaxdrones.cli import bench, common, compare, main
from jaxdrones.cli.flight_options import warn
from jaxdrones.cli.options import parse_pixels
from jaxdrones.cli.report import listed, summary, table
from jaxdrones.flights.conditions import Conditions
from jaxdrones.flights.fly import fly
from jaxdrones.training import algorithms

FILMS = pytest.mark.needs("pybullet", "imageio_ffmpeg")
SHORT = ["--duration", "0.25", "--drones", "2"]


def test_fly_prints_a_table_and_writes_log_and_figure(tmp_path, capsys):
    (tmp_path / "log.csv").touch()  # of an earlier flight, which is replaced
    assert main(["fly", "circle", *SHORT, "--output", str(tmp_path)]) == 0
    out = capsys.readouterr().out
    assert "circle: 2 x cf2x, pid at 120 Hz, semi_implicit_euler at 240 Hz" in out
    assert "rms (m)" in out and "drone 1" in out
    assert (tmp_path / "flight.png").read_bytes().startswith(b"\x89PNG") and not (tmp_path / "log.csv").exists()
    log = np.load(tmp_path / "log.npz")
    assert log["pos"].shape == (30, 2, 3) and log["rpm"].shape == (30, 2, 4)
    assert json.loads(str(log["conditions"]))["control_hz"] == 120


def test_many_drones_are_three_rows():
    rows = [{"drone": f"drone {i}", "rms_error_m": float(i), "settled_after_s": None if i else 2.0} for i in range(5)]
    lowest, median, highest = summary(rows)
    assert lowest == {"drone": "lowest", "rms_error_m": 0.0, "settled_after_s": 2.0}
    assert (median["rms_error_m"], highest["rms_error_m"], highest["drone"]) == (2.0, 4.0, "highest")
    assert "-" in table(summary([row | {"settled_after_s": None} for row in rows]))


def test_counts_are_printed_with_all_digits():
    assert listed({"published": 1_234_567, "landed": True, "simulated_s": 2.5}) == (
        "published 1234567, landed 1, simulated s 2.5"
    )


@pytest.mark.parametrize(
    ("command", "defaults"),
    [("betaflight", ("(racer)", "(0,0,1.5)", "(1000)", "(30)")), ("fly", ("(cf2x)", "(explicit)", "(instant)"))],
)
def test_the_help_shows_the_defaults_of_a_command(command, defaults, capsys):
    with pytest.raises(SystemExit, match="0"):
        main([command, "--help"])
    shown = capsys.readouterr().out
    assert all(default in shown for default in defaults) and "None" not in shown and "[]" not in shown


@pytest.mark.slow
def test_json_is_one_object_and_nothing_else_on_stdout(tmp_path, capsys):
    assert main(["fly", "downwash", "--duration", "0.2", "--json", "--output", str(tmp_path)]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["effects"] == ["downwash_2021"] and len(report["results"]) == 2
    assert report["files"] == [str(tmp_path / "log.npz"), str(tmp_path / "flight.png")]


@pytest.mark.slow
def test_csv_and_pwm_come_on_request(tmp_path):
    (tmp_path / "flight.png").touch()  # of an earlier flight
    assert main(["fly", "circle", *SHORT, "--csv", "--pwm", "--no-figure", "--output", str(tmp_path)]) == 0
    log = np.load(tmp_path / "log.npz")
    np.testing.assert_allclose(0.2685 * log["pwm"] + 4070.3, log["rpm"], rtol=1e-6)
    with (tmp_path / "log.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 60
    assert float(rows[-1]["pos_z"]) == pytest.approx(log["pos"][-1, 1, 2])
    assert float(rows[-1]["pwm_3"]) == pytest.approx(log["pwm"][-1, 1, 3])
    assert not (tmp_path / "flight.png").exists()


def test_a_flight_of_several_that_diverges_is_named(capsys):
    assert (warn({}, "pid"), warn({"drone 0": "drone 0 is upside down"}, "pid")) == (0, 1)
    assert "the flight of pid diverged: drone 0 is upside down" in capsys.readouterr().err
    warn({"drone 0": "drone 0 is upside down", "drone 1": "drone 1 is upside down"})
    assert "drone 0 is upside down (and 1 more)" in capsys.readouterr().err


def test_a_long_message_keeps_its_beginning_and_its_end():
    assert common.shortened(600 * "a" + "\n" + 600 * "b") == f"{500 * 'a'} ... {500 * 'b'}"


def test_pixels_are_width_and_height():
    assert parse_pixels("--size", "64x48", "") == (64, 48)


def test_the_line_to_share_has_the_best_rate_of_each_kind():
    rows = [{"what": "plant", "worlds": worlds, "per_s": rate} for worlds, rate in ((1, 2e6), (8, 3e6), (9, 1e6))]
    about = {"versions": dict.fromkeys(("jaxdrones", "jax", "jaxlib", "python"), "1"), "dtype": "float32"}
    line = bench._line(about | {"rates": rows, "devices": ["cpu: cpu"], "processor": "fast", "cores": 2})
    assert line.startswith("jaxdrones bench: plant 3 M steps/s (8 worlds); float32; fast, 2 cores;")


def test_a_controller_is_as_good_as_on_its_worst_drone_if_all_settle(monkeypatch):
    drones = [
        {"rms_error_m": x, "lowest_z_m": x, "settled_after_s": y} for x, y in ((1.0, 2.0), (3.0, None), (2.0, 1.0))
    ]
    monkeypatch.setattr(compare.results, "results", lambda record, after: drones)
    assert compare._results({"pid": None}, 0.0) == [{"controller": "pid", "rms_error_m": 3.0, "settled_after_s": None}]


@pytest.mark.slow
def test_every_controller_whose_flight_diverges_is_named(tmp_path, capsys):
    own = "def gains():\n    pass\ndef init():\n    pass\ndef control(gains, params, memory, state, setpoint, dt):\n"
    for name in ("first", "second"):
        (tmp_path / f"{name}.py").write_text(f"{own}    return memory, float('nan') * state.rpm\n")
    names = f"{tmp_path}/first.py,pid,{tmp_path}/second.py"
    assert main(["compare", "circle", "--duration", "0.1", "--drones", "1", "--controllers", names]) == 1
    first, second = capsys.readouterr().err.splitlines()
    assert "the flight of first diverged: the state of drone 0" in first and "the flight of second diverged" in second


def test_a_flight_that_breaks_is_logged_and_reported(tmp_path, capsys, monkeypatch):
    record = fly("circle", drones=2, duration=0.25)
    pos = np.array(record.pos)
    pos[12:, 1] = np.nan
    monkeypatch.setattr("jaxdrones.cli.flight_options.fly", lambda *_, **__: dataclasses.replace(record, pos=pos))
    assert main(["fly", "circle", "--no-figure", "--json", "--output", str(tmp_path)]) == 1
    captured = capsys.readouterr()
    assert "the state of drone 1 is not finite from t = 0.108 s on" in captured.err
    assert captured.err.count("\n") == 1
    report = json.loads(captured.out)
    assert list(report["diverged"]) == ["drone 1"]
    rows = report["results"]
    assert rows[0]["rms_error_m"] > 0 and rows[1]["rms_error_m"] is None
    assert (tmp_path / "log.npz").exists()


@pytest.mark.parametrize("flight", mostly_slow(["circle", "velocity"], ["circle"]))
@pytest.mark.slow
def test_a_flight_that_diverges_is_logged_and_reported(flight, tmp_path, capsys):
    slow = ["fly", flight, "--drones", "2", "--control-hz", "7", "--duration", "4", "--output", str(tmp_path)]
    assert main([*slow, "--json"]) == 1
    captured = capsys.readouterr()
    assert "the flight diverged: drone 0 is" in captured.err and "try a higher --control-hz" in captured.err
    assert captured.err.count("\n") == 1
    assert set(json.loads(captured.out)["diverged"]) <= {"drone 0", "drone 1"}
    assert (tmp_path / "log.npz").exists() and (tmp_path / "flight.png").exists()


@pytest.mark.slow
def test_a_flight_that_goes_well_diverged_nowhere(tmp_path, capsys):
    assert main(["fly", "circle", *SHORT, "--json", "--no-figure", "--output", str(tmp_path)]) == 0
    assert json.loads(capsys.readouterr().out)["diverged"] == {}


@pytest.mark.slow
@pytest.mark.float32
def test_no_flight_computes_what_is_not_a_number(tmp_path):
    with jax.debug_nans(True):
        assert main(["fly", "circle", *SHORT, "--json", "--no-figure", "--output", str(tmp_path)]) == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["fly", "cirle"], "did you mean 'circle'"),
        (["fly", ""], "unknown flight ''"),
        (["fly", "circle", "--duration", "inf"], "duration is inf"),
        (["fly", "circle", "--duration", "1e12"], "duration is 1000000000000.0 s; give at most 100000 s"),
        (["fly", "circle", "--duration", "99999", "--control-hz", "20000"], "needs about 3.2e+03 GB of memory"),
        (["fly", "circle", "--duration", "1e308"], "duration is 1e+308; give"),
        (["fly", "circle", "--drones", "2000000000"], "a flight of 2000000000 drones"),
        (["fly", "circle", "--drones", "9" * 400], "give at most 2147483647"),
        (["fly", "circle", "--drones", "9" * 5000], "invalid int value"),
        (["fly", "circle", "--drones", "999999", "--duration", "0.1", "--effects", "downwash"], "GB of memory"),
        (["fly", "circle", "--control-hz", "1000000000"], "control rate (Hz) is 1000000000; give at most 20000"),
        (["fly", "circle", "--control-hz", "0"], "control rate (Hz) is 0"),
        (["fly", "circle", "--seed", "-1"], "seed is -1"),
        (["fly", "circle", "--seed", str(2**70)], "give at most 2147483647"),
        (["fly", "circle", "--effects", "drag,drag"], "effect 'drag' is given twice"),
        (["fly", "circle", "--effects", "drag,drag_world_axes"], "'drag_world_axes' is given beside 'drag'"),
        (["fly", "circle", "--effects", "downwash_2021,downwash"], "'downwash' is given beside 'downwash_2021'"),
        (["fly", "circle", "--effects", "drag,"], "unknown effect ''"),
        (["fly", "circle", "--effects", ""], "unknown effect ''"),
        (["fly", "circle", "--effects", "none,drag"], "--effects is 'none,drag'; give none alone"),
        (["fly", "circle", "--effects", "drag,none"], "--effects is 'drag,none'; give none alone"),
        (["fly", "circle", "--pwm", "--vehicle", "racer"], "PWM is requested for 'racer'"),
        pytest.param(
            ["fly", "circle", "--video", "folder.mp4"],
            "--video folder.mp4 cannot be written: Is a directory",
            marks=FILMS,
        ),
        pytest.param(
            ["fly", "circle", "--video", "file/film.mp4"], "--video file/film.mp4 cannot be written", marks=FILMS
        ),
        pytest.param(
            ["fly", "circle", "--video", "/proc/film.mp4"], "--video /proc/film.mp4 cannot be written", marks=FILMS
        ),
        (["fly", "circle", "--video", ""], "the path is empty"),
        (["fly", "circle", "--output", ""], "the path is empty"),
        (["fly", "--policy", ""], "the path is empty"),
        (["fly", "--policy", "file"], "file/best.json cannot be read: Not a directory"),
        (["compare", "circle", "--backends", "explicit,explicit"], "give two different ones"),
        (["compare", "circle", "--backends", "explicit,gazebo"], "unknown backend 'gazebo'"),
        (["fly", "circle", "--vehicle", "cf9"], "unknown vehicle 'cf9'"),
        (["fly", "circle", "--effects", "drag,magic"], "unknown effect 'magic'"),
        (["fly", "circle", "--integrator", "rk9"], "unknown integrator 'rk9'"),
        (["fly", "circle", "--drones", "zero"], "invalid int value: 'zero'"),
        (["fly", "circle", "--drones", "0"], "drones is 0"),
        (["fly", "circle", "--duration", "-2"], "duration is -2.0"),
        (["fly", "circle", "--duration", "nan"], "duration is nan"),
        (["fly", "circle", "--vehicle", "missing.urdf"], "missing.urdf: cannot be read"),
        (["fly", "circle", "--backend", "gazebo"], "unknown backend 'gazebo'"),
        (["fly", "circle", "--backend", "bullet", "--integrator", "rk4"], "bullet backend integrates by itself"),
        (["fly", "circle", "--obstacles"], "use the bullet backend"),
        (["fly", "circle", "--gui"], "only the bullet backend has one"),
        (["fly", "circle", "--video", "film.avi"], "films end in .mp4 or .gif"),
        (["compare", "circle", "--backends", "explicit"], "give two"),
        (["explain", "hoover"], "unknown task 'hoover'; did you mean 'hover'"),
        (["explain", "hover", "--set", "speeed=1"], "did you mean 'speed'"),
        (["explain", "hover", "--backend", "gazebo"], "unknown backend 'gazebo'"),
        (["score", "B3_figure8_slow_rep2", "--vehicle", "cf2x", "--figure", "a.jpgg"], "ends in .png or .pdf"),
        (["bench", "--worlds", "many"], "'many' is given; give whole numbers"),
        (["fly"], "required: FLIGHT"),
        (["soar"], "invalid choice: 'soar'"),
    ],
)
def test_a_mistake_is_one_line_on_stderr_and_exit_code_2(arguments, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("jaxdrones.cli.flight_options.fly", refused_flight)
    monkeypatch.setattr("jaxdrones.limits.memory", lambda: 10**10)
    (tmp_path / "file").touch()
    (tmp_path / "folder.mp4").mkdir()
    try:
        code = main(arguments)
    except SystemExit as stop:
        code = stop.code
    captured = capsys.readouterr()
    assert code == 2 and captured.out == ""
    assert message in captured.err and captured.err.count("\n") == 1 and len(captured.err) < 1200


def refused_flight(flight, gui=False, progress=None, watch=None, **options):
    """In place of `fly`, which would take long where a mistake is not seen at once."""
    Conditions(flight, **options)
    if not gui:
        raise AssertionError("flown")
    return fly(flight, gui, progress, watch, **options)


@pytest.mark.needs("pybullet")
@pytest.mark.parametrize("name", ["", "log.npz", "log.csv", "flight.png", "cameras"])
def test_an_output_that_cannot_be_written_is_refused_before_the_flight(name, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("jaxdrones.cli.flight_options.fly", refused_flight)
    output = tmp_path / "output"
    if name in ("", "cameras"):
        (output / name).parent.mkdir(exist_ok=True)
        (output / name).touch()
    else:
        (output / name).mkdir(parents=True)
    assert main(["fly", "circle", "--csv", "--cameras", "--output", str(output)]) == 2
    said = capsys.readouterr().err
    assert f"{output / name}: " in said and "choose another --output" in said and said.count("\n") == 1


def test_list_names_what_can_be_chosen(capsys):
    assert main(["list", "--json"]) == 0
    names = json.loads(capsys.readouterr().out)
    assert {"cf2x", "cf2p", "hb", "racer", "cf21", "bebop"} <= set(names["vehicles"])
    assert {"drag", "ground_effect", "downwash", "downwash_2021"} <= set(names["effects"])
    assert names["algorithms"] == list(algorithms.ALGORITHMS)
    assert main(["list"]) == 0
    assert "integrators" in capsys.readouterr().out


@pytest.mark.parametrize("words", [["list"], ["explain", "hover", "--set", "drones=300"]])
def test_a_reader_that_ends_early_is_no_error(words, capsys, monkeypatch):
    """`jaxdrones list | head -1`: output that fits into the buffer, and output that does not."""
    reader, writer = os.pipe()
    os.close(reader)
    with open(writer, "w") as pipe:
        monkeypatch.setattr("sys.stdout", pipe)
        assert main(words) == 141
    assert capsys.readouterr().err == ""


def test_explain_tells_what_the_numbers_are(capsys):
    assert main(["explain", "hover", "--set", "drones=2", "--set", "reach=0.5"]) == 0
    out = capsys.readouterr().out
    assert "hover: fly to the goal" in out and "+-0.5 m of the goal" in out and "2 x cf2x" in out
    assert main(["explain", "hover", "--realistic", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    first = told["observation"][0]
    assert first["name"] == "x of the target, from the drone" and (first["unit"], first["frame"]) == ("m", "world")
    assert told["physics"]["delay"].startswith("0 to 0.04 s") and told["rewards"][0]["weight"] == 2


@pytest.mark.slow
@pytest.mark.needs("pybullet")
def test_compare_prints_how_the_backends_part(capsys):
    assert main(["compare", "ground-effect", "--duration", "0.1", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["backends"] == ["explicit", "bullet"] and len(report["divergence"]) == 12
    last = report["divergence"][-1]
    assert last["t_s"] == pytest.approx(0.1) and last["pos_m"] < 1e-6
    assert main(["compare", "ground-effect", "--duration", "0.1"]) == 0
    assert "attitude (rad)" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.needs("pybullet", "imageio_ffmpeg")
@pytest.mark.filterwarnings("ignore::ResourceWarning")  # of imageio-ffmpeg's pipes
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_flight_in_bullet_is_filmed(tmp_path, capsys):
    film = tmp_path / "new" / "flight.mp4"
    arguments = ["fly", "circle", *SHORT, "--backend", "bullet", "--obstacles", "--video", str(film)]
    arguments += ["--renderer", "bullet", "--cameras"]
    assert main([*arguments, "--no-figure", "--output", str(tmp_path)]) == 0
    about = next(__import__("imageio_ffmpeg").read_frames(str(film)))
    assert about["size"] == (1280, 720) and (tmp_path / "cameras" / "drone 0" / "00000.png").exists()
    assert "Bullet at 240 Hz" in capsys.readouterr().out
