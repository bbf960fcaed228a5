"""`jaxdrones ros2` and the files that start it."""

import json
import shlex
import sys
import xml.etree.ElementTree
from pathlib import Path

import pytest
from in_process import InProcess, Wire

from jaxdrones.cli import main, make_parser

FILES = Path(__file__).parents[2] / "ros2"


@pytest.fixture
def wire(monkeypatch):
    wire = Wire()
    monkeypatch.setattr("jaxdrones.cli.ros2.join", lambda: InProcess(wire))
    return wire


@pytest.mark.slow
def test_a_flight_is_reported(wire, capsys):
    assert main(["ros2", "--drones", "2", "--duration", "0.05", "--camera", "8x6", "--speed", "10", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["steps"] == 5 and report["simulated_s"] == 0.05
    assert report["published"] == sum(map(len, wire.sent.values()))
    assert len(wire.sent["drone_1/camera/image_raw"]) == 1


@pytest.mark.slow
def test_a_lost_peer_stops_the_flight_with_exit_code_1(wire, capsys):
    assert main(["ros2", "--lockstep", "--failsafe", "stop", "--wait", "0.01", "--duration", "1"]) == 1
    said = capsys.readouterr()
    assert "the step service was not called for 0.01 s; the flight stops" in said.err and said.err.count("\n") == 1
    assert "steps 0" in said.out


@pytest.mark.slow
def test_a_landing_is_reported_as_json(wire, capsys):
    short = ["--lockstep", "--wait", "0.01", "--height", "0.03", "--speed", "20"]
    assert main(["ros2", "--failsafe", "land", *short, "--json"]) == 0
    said = capsys.readouterr()
    assert json.loads(said.out)["landed"] is True and "the flight continues by the clock" in said.err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--drones", "0"], "drones is 0"),
        (["--failsafe", "pray"], "unknown failsafe 'pray'"),
        (["--timeout", "0"], "timeout is 0.0"),
        (["--camera", "big"], "--camera is 'big'; give width and height"),
        (["--camera-hz", "5"], "--camera-hz 5 is given without --camera; give both or none"),
        (["--control-hz", "0"], "control rate (Hz) is 0"),
        (["--duration", "-1"], "duration is -1.0"),
        (["--speed", "0"], "speed is 0.0"),
        (["--backend", "gazebo"], "unknown backend 'gazebo'"),
        (["--controller", "none"], "unknown controller 'none'"),
        (["--lockstep", "--real-time"], "not allowed with"),
        (["replay", "nothing"], "nothing is not a ROS 2 bag"),
        (["replay", "nothing", "--speed", "0"], "speed is 0.0"),
        (["--lockstep", "replay", "nothing"], "--lockstep is an option of flights"),
    ],
)
def test_a_mistake_is_one_line_and_exit_code_2(arguments, message, wire, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    if "replay" in arguments:
        pytest.importorskip("rosbags")
    try:
        code = main(["ros2", *arguments])
    except SystemExit as stop:
        code = stop.code
    said = capsys.readouterr()
    assert code == 2 and message in said.err and said.err.count("\n") == 1


def test_without_rclpy_the_remedy_is_named(capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "rclpy", None)
    monkeypatch.delitem(sys.modules, "jaxdrones.ros2.rclpy_transport", raising=False)
    assert main(["ros2"]) != 0
    said = capsys.readouterr().err
    assert "rclpy is not installed; source the setup.bash of a ROS 2" in said and said.count("\n") == 1


def test_the_launch_file_starts_a_command_that_exists():
    root = xml.etree.ElementTree.parse(FILES / "launch" / "jaxdrones.launch.xml").getroot()
    defaults = {arg.get("name"): arg.get("default") for arg in root.findall("arg")}
    (executable,) = root.findall("executable")
    command = executable.get("cmd")
    for name, default in defaults.items():
        command = command.replace(f"$(var {name})", default)
    assert "$(" not in command
    program, *arguments = shlex.split(command)
    assert program == "jaxdrones" and make_parser().parse_args(arguments).drones == int(defaults["drones"])
