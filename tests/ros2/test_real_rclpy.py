"""A node in a real graph of ROS 2, with a peer that knows rclpy alone; by `make test-ros2`."""

import os
import signal
import subprocess
import sys
import threading
import time
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from ros2_team import HZ, make_simulation

pytestmark = [pytest.mark.slow, pytest.mark.needs("rclpy"), pytest.mark.filterwarnings("default")]
PEER = Path(__file__).with_name("rclpy_peer.py")


@pytest.fixture(autouse=True)
def domain(monkeypatch):
    """A graph of this test alone, on this computer."""
    monkeypatch.setenv("ROS_DOMAIN_ID", str(1 + (os.getpid() + time.monotonic_ns()) % 100))
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")


def start_peer(path, drones, steps):
    return subprocess.Popen([sys.executable, str(PEER), str(path), str(drones), str(steps)])


def flown_alone(drones, steps):
    """Positions (steps, n, 3) of the same commands without ROS."""
    from rclpy_peer import target

    from jaxdrones.ros2.command import Command, Mode

    simulation, pos = make_simulation(drones), []
    for step in range(steps):
        simulation.commands = [Command.zero(Mode.POSITION, pos=target(step, i)) for i in range(drones)]
        simulation.advance()
        pos.append(np.asarray(simulation.state.pos))
    return np.stack(pos)


@pytest.mark.parametrize(("drones", "steps"), [(4, 3000)])
def test_a_lockstep_flight_equals_the_flight_without_ros_bit_for_bit(tmp_path, drones, steps):
    from jaxdrones.ros2 import Failsafe, Node, open_transport

    with closing(open_transport("rclpy")) as transport:
        patient = Failsafe("stop", timeout=60, wait=120)  # also on a busy computer
        node = Node(make_simulation(drones), transport, lockstep=True, failsafe=patient)
        peer = start_peer(tmp_path / "peer.npz", drones, steps)
        start = time.monotonic()
        flown = node.run(steps / HZ)
        spent = time.monotonic() - start
        end = time.monotonic() + 30
        while peer.poll() is None and time.monotonic() < end:
            transport.spin(0.05)
        assert peer.wait(1) == 0
    assert (flown.steps, flown.received, flown.refused, flown.lost) == (steps, drones * steps, 0, 0)
    seen = np.load(tmp_path / "peer.npz")
    after = seen["t"] > 0
    assert np.all(np.diff(seen["t"][0][after[0]]) == 1_000_000_000 // HZ)
    pos = np.stack([seen["pos"][i][after[i]] for i in range(drones)], axis=1)
    np.testing.assert_array_equal(pos, flown_alone(drones, steps))
    print(f"{1e3 * spent / steps:.2f} ms a step")


def test_a_killed_peer_is_missed_and_another_one_continues(tmp_path):
    from jaxdrones.ros2 import Failsafe, Node, open_transport

    warnings = []
    with closing(open_transport("rclpy")) as transport:
        simulation = make_simulation(1)
        node = Node(
            simulation, transport, lockstep=True, failsafe=Failsafe("hover", timeout=0.5, wait=60), warn=warnings.append
        )
        first = start_peer(tmp_path / "first.npz", 1, 100_000)
        flight = threading.Thread(target=lambda: node.run(1e4 / HZ), daemon=True)
        flight.start()
        wait_for(lambda: node.flown.received > 20)
        first.send_signal(signal.SIGKILL)
        first.wait()
        wait_for(lambda: any("step service was not called" in text for text in warnings))
        steps = node.flown.steps
        second = start_peer(tmp_path / "second.npz", 1, 50)
        wait_for(lambda: any("called again" in text for text in warnings))
        assert second.wait(60) == 0
        assert node.flown.steps >= steps + 50
        simulation.control_hz = 1  # the thread ends at its next look at the time
        assert np.all(np.isfinite(simulation.state.pos))
        node.flown.landed = True
        flight.join(10)


def test_ctrl_c_ends_a_flight_without_a_traceback():
    from jaxdrones.ros2 import open_transport, topics

    clock = []
    with closing(open_transport("rclpy", "watcher")) as transport:
        transport.subscribe(topics.CLOCK, clock.append)
        command = [sys.executable, "-m", "jaxdrones.cli", "ros2", "--transport", "rclpy", "--drones", "2"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as flight:
            try:
                wait_for(lambda: transport.spin(0.1) or len(clock) > 20)
                flight.send_signal(signal.SIGINT)
                _, errors = flight.communicate(timeout=60)
            finally:
                flight.kill()
    assert "Traceback" not in errors, errors


def wait_for(condition, timeout=180.0):
    end = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < end, "it did not happen in time"
        time.sleep(0.02)
