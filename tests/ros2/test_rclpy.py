"""Nodes in a real graph of ROS 2, with peers that know rclpy alone; by `make test-ros2`."""

import functools
import json
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from ros2_team import HZ, make_simulation, nanoseconds

from jaxdrones.ros2 import Failsafe, Node, QoS, Topic, convert, topics
from jaxdrones.ros2 import messages as msg

pytestmark = [
    pytest.mark.needs("rclpy", "rosbags"),
    pytest.mark.filterwarnings("default"),
    pytest.mark.usefixtures("ros"),
]
PEER = Path(__file__).parents[1] / "rclpy_peer.py"


@pytest.fixture
def join():
    """Nodes of this process."""
    from jaxdrones.ros2.rclpy_transport import RclpyTransport

    joined = []

    def transport(name="jaxdrones"):
        joined.append(RclpyTransport(name))
        return joined[-1]

    yield transport
    for one in reversed(joined):  # the first one started rclpy
        one.close()


@pytest.fixture
def start():
    """Start a process; those that still run at the end are killed."""
    running = []

    def begin(*command):
        heed = functools.partial(signal.signal, signal.SIGINT, signal.SIG_DFL)  # also where tests run in the background
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
        running.append(subprocess.Popen(command, preexec_fn=heed, **pipes))
        return running[-1]

    yield begin
    for process in running:
        process.kill()
        process.communicate()


def peer(start, *arguments):
    return start(sys.executable, str(PEER), *map(str, arguments))


def command_line(start, *arguments):
    code = "import sys; from jaxdrones.cli import main; sys.exit(main(sys.argv[1:]))"
    return start(sys.executable, "-c", code, "ros2", "--json", *arguments)


def until(condition, *transports, timeout=180.0):
    """Spin transports until a condition holds, or fail."""
    end = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < end, "it did not happen in time"
        for transport in transports:
            transport.spin(0.02)
        if not transports:
            time.sleep(0.02)


def subscribers(transport):
    """Whether every topic that a transport publishes has a subscriber."""
    return all(publisher.get_subscription_count() for publisher in transport._publishers)


def test_messages_arrive_in_order_and_none_is_lost(join):
    here, there, got = join(), join("peer"), []
    topic = topics.output(0, "odom")
    there.subscribe(topic, got.append)
    publish = here.publisher(topic)
    until(lambda: subscribers(here), here)
    sent = [msg.Odometry(msg.Header(convert.stamp(k), "world")) for k in range(150)]
    for message in sent:
        publish(message)
    until(lambda: len(got) >= 150, there)
    assert got == sent


def test_an_incompatible_quality_of_service_is_named_once(join):
    node, other, found, received = join(), join("peer"), [], []
    node.subscribe(topics.command(0, "cmd_vel"), received.append)
    publish = other.publisher(Topic("drone_0/cmd_vel", msg.Twist.NAME, QoS(10, reliable=False)))

    def complained():
        publish(msg.Twist())
        found.extend(node.complaints())
        return bool(found)

    until(complained, node)
    (text,) = found
    assert text.startswith("a peer publishes /drone_0/cmd_vel with an incompatible quality of service: ")
    assert "best effort" in text.lower() and received == []
    node._looked -= 10
    assert node.complaints() == []


@pytest.mark.slow
def test_a_lockstep_flight_equals_the_flight_without_ros_bit_for_bit(tmp_path, join, start, drones=4, steps=3000):
    transport = join()
    patient = Failsafe("stop", timeout=60, wait=120)  # also on a busy computer
    node = Node(make_simulation(drones), transport, lockstep=True, failsafe=patient)
    outsider = peer(start, tmp_path / "peer.npz", drones, steps)
    begin = time.monotonic()
    flown = node.run(steps / HZ)
    spent = time.monotonic() - begin
    until(lambda: outsider.poll() is not None, transport)
    assert outsider.returncode == 0, outsider.communicate()
    assert (flown.steps, flown.received, flown.refused, flown.lost) == (steps, drones * steps, 0, 0)
    seen = np.load(tmp_path / "peer.npz")
    after = seen["t"] > 0
    assert np.all(np.diff(seen["t"][0][after[0]]) == 1_000_000_000 // HZ)
    pos = np.stack([seen["pos"][i][after[i]] for i in range(drones)], axis=1)
    np.testing.assert_array_equal(pos, flown_alone(drones, steps))
    print(f"{1e3 * spent / steps:.2f} ms a step")


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


@pytest.mark.slow
def test_a_killed_peer_is_missed_and_another_one_continues(tmp_path, join, start):
    warnings, simulation = [], make_simulation(1)
    failsafe = Failsafe("hover", timeout=0.5, wait=60)
    node = Node(simulation, join(), lockstep=True, failsafe=failsafe, warn=warnings.append)
    first = peer(start, tmp_path / "first.npz", 1, 100_000)
    flight = threading.Thread(target=lambda: node.run(1e4 / HZ), daemon=True)
    flight.start()
    until(lambda: node.flown.received > 20)
    first.send_signal(signal.SIGKILL)
    first.wait()
    until(lambda: any("step service was not called" in text for text in warnings))
    steps = node.flown.steps
    second = peer(start, tmp_path / "second.npz", 1, 50)
    until(lambda: any("called again" in text for text in warnings))
    assert second.wait(60) == 0
    assert node.flown.steps >= steps + 50
    assert np.all(np.isfinite(simulation.state.pos))
    simulation.control_hz = 1  # the thread ends at its next look at the time
    node.flown.landed = True
    flight.join(10)


class Commander:
    """Commands positions to a team of another process, and keeps the times and positions that it publishes."""

    def __init__(self, transport, drones):
        self.transport, self.odom = transport, [[] for _ in range(drones)]
        for i, seen in enumerate(self.odom):
            transport.subscribe(topics.output(i, "odom"), seen.append)
        self.publish = [transport.publisher(topics.command(i, "cmd_pose")) for i in range(drones)]
        until(lambda: subscribers(transport) and all(map(self.hears, range(drones))), transport)
        for seen in self.odom:  # states before both sides know each other may be missing
            del seen[:-1]

    def hears(self, i):
        """Whether the newest states of a drone came one after the other."""
        return list(np.diff(self.times(i)[-20:])) == 19 * [10_000_000]

    def fly_to(self, pos, seconds):
        """Command positions (n, 3), at 100 Hz or as fast as this computer can; returns how many to each drone."""
        due, count = time.monotonic(), round(100 * seconds)
        for _ in range(count):
            for publish, target in zip(self.publish, pos, strict=True):
                publish(msg.PoseStamped(pose=msg.Pose(msg.Point(*target))))
            due += 0.01
            while (left := due - time.monotonic()) > 0:
                self.transport.spin(left)
            self.transport.spin(0)
        self.transport.flush(20)
        arrived = self.times(0)[-1]
        until(lambda: self.times(0)[-1] > arrived + 50_000_000, self.transport)  # a step takes all that has arrived
        return count

    def times(self, i):
        return [nanoseconds(message.header.stamp) for message in self.odom[i]]

    def at(self, pos):
        now = [convert.numbers(seen[-1].pose.pose.position) for seen in self.odom]
        return np.allclose(now, pos, atol=0.05)


def interrupted(node):
    """End a flight by Ctrl-C; returns its report and what it wrote to stderr."""
    node.send_signal(signal.SIGINT)
    out, err = node.communicate(timeout=120)
    assert node.returncode == 130 and err.endswith("jaxdrones: interrupted\n") and "Traceback" not in err
    return json.loads(out), err


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["explicit", pytest.param("bullet", marks=pytest.mark.needs("pybullet"))])
def test_two_processes_lose_no_command_of_four_drones_at_100_hz(backend, join, start):
    node = command_line(start, "--drones", "4", "--timeout", "60", "--backend", backend)
    commander = Commander(join(), 4)
    target = [[0.5, 0.5 * i, 1.3] for i in range(4)]
    sent = commander.fly_to(target, 6.0)
    until(lambda: commander.at(target), commander.transport)
    out, _ = interrupted(node)
    assert (out["received"], out["refused"], out["lost"]) == (4 * sent, 0, 0)
    for i in range(4):
        assert len(commander.odom[i]) > 100 and set(np.diff(commander.times(i))) == {10_000_000}


@pytest.mark.slow
@pytest.mark.parametrize("action", ["stop", "land", "hover"])
def test_the_failsafe_of_a_killed_peer_is_that_of_the_command_line(action, join, start, tmp_path):
    node = command_line(
        start, "--drones", "2", "--duration", "40", "--failsafe", action, "--timeout", "1", "--wait", "120"
    )
    code = f"import sys; sys.path.insert(0, {str(PEER.parent)!r}); import rclpy_peer; rclpy_peer.stream(2)"
    outsider = start(sys.executable, "-c", code)
    for _ in range(20):
        assert outsider.stdout.readline() == "sent\n"
    outsider.send_signal(signal.SIGKILL)
    out, err = node.communicate(timeout=180)
    assert "no command for drone_0 for 1 s" in err
    report = json.loads(out)
    assert report["received"] >= 2 * 15 and report["lost"] >= 1
    assert node.returncode == (1 if action == "stop" else 0)
    assert report["landed"] == (action == "land") and (report["steps"] == 4000) == (action == "hover")


@pytest.mark.slow
def test_a_late_peer_is_heard_and_a_wrong_type_is_named(join, start):
    node = command_line(start, "--wait", "0.5", "--timeout", "60")
    transport = join()
    commander = Commander(transport, 1)
    publish = transport.publisher(Topic("drone_0/cmd_rates", msg.TwistStamped.NAME, QoS(10)))
    until(lambda: commander.times(0)[-1] > 1_500_000_000, transport)
    publish(msg.TwistStamped())
    sent = commander.fly_to([[0.3, 0.0, 1.0]], 4.0)
    until(lambda: commander.at([[0.3, 0.0, 1.0]]), transport)
    out, err = interrupted(node)
    assert out["received"] == sent
    for line in (
        "no command for drone_0 for 0.5 s; it hovers",
        "commands for drone_0 arrive",
        "publishes /drone_0/cmd_rates as geometry_msgs/msg/TwistStamped; its type is geometry_msgs/msg/Twist",
    ):
        assert line in err
