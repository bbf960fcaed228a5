"""CycloneDDS over the loopback address: within one process, and (slow) between processes of the command line."""

import json
import os
import signal
import subprocess
import sys
import time

import jax
import numpy as np
import pytest
from ros2_team import make_simulation

from jaxdrones.errors import UserError
from jaxdrones.ros2 import Peer, QoS, Topic, convert, topics
from jaxdrones.ros2 import messages as msg

pytestmark = [
    pytest.mark.needs("cyclonedds"),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),  # of CycloneDDS when it is freed
]
_domain = 7 * os.getpid()  # other tests that run on this computer have others


@pytest.fixture
def domain(monkeypatch):
    """A domain of DDS for one test, on this computer only, for this process and its children."""
    global _domain
    _domain += 1
    monkeypatch.setenv("ROS_DOMAIN_ID", str(1 + _domain % 100))
    monkeypatch.setenv("ROS_LOCALHOST_ONLY", "1")
    monkeypatch.delenv("CYCLONEDDS_URI", raising=False)


@pytest.fixture
def join(domain):
    from jaxdrones.ros2.cyclone import CycloneTransport

    joined = []

    def transport():
        joined.append(CycloneTransport())
        return joined[-1]

    yield transport
    for one in joined:
        one.close()


def until(condition, *transports, timeout=20.0):
    """Spin transports until a condition holds, or fail."""
    end = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        for transport in transports:
            transport.spin(0.01)


def test_messages_arrive_in_order_and_none_is_lost(join):
    here, there, got = join(), join(), []
    topic = topics.output(0, "odom")
    publish = here.publisher(topic)
    there.subscribe(topic, got.append)
    sent = [msg.Odometry(msg.Header(convert.stamp(k), "world")) for k in range(150)]

    assert here.connect(topic, 20)
    for message in sent:
        publish(message)
    assert here.flush(5)
    until(lambda: len(got) >= 150, there)
    assert got == sent


def test_a_service_that_nobody_offers_is_an_error_in_time(join):
    start = time.monotonic()
    with pytest.raises(TimeoutError, match=r"no server of the service 'step' within 0\.2 s"):
        join().call("step", 0.2)
    assert time.monotonic() < start + 5


def test_a_peer_whose_node_is_not_there_is_an_error_in_time(join):
    with pytest.raises(TimeoutError, match=r"the state of the team did not arrive within 0\.2 s"):
        Peer(join(), 1).state(0.2)


@pytest.mark.parametrize(
    ("topic", "says"),
    [
        (Topic("drone_0/cmd_vel", msg.TwistStamped.NAME, QoS(10)), "as geometry_msgs/msg/TwistStamped; its type is"),
        (Topic("drone_0/cmd_vel", msg.Twist.NAME, QoS(10, reliable=False)), "as best effort"),
    ],
)
def test_the_wrong_end_of_a_topic_is_named(topic, says, join):
    node, peer, found, received = join(), join(), [], []
    node.subscribe(topics.command(0, "cmd_vel"), received.append)
    publish = peer.publisher(topic)

    def complained():
        publish(msg.message_class(topic.type)())
        found.extend(node.complaints())
        return bool(found)

    until(complained, node)
    assert len(found) == 1 and f"a peer publishes /drone_0/cmd_vel {says}" in found[0] and received == []
    node.spin(0.1)
    assert node.complaints() == []


def test_a_reader_that_does_not_answer_ends_a_flush_in_time(join, monkeypatch):
    from cyclonedds.core import DDSException
    from cyclonedds.pub import DataWriter

    here, there = join(), join()
    topic = topics.output(0, "pose")
    here.publisher(topic)
    there.subscribe(topic, print)
    assert here.connect(topic, 20) and here.flush(1)
    monkeypatch.setattr(DataWriter, "_wait_for_acks", lambda *_: DDSException.DDS_RETCODE_TIMEOUT)
    assert not here.flush(0.1)


def test_commands_to_nobody_are_an_error_in_time(join):
    with pytest.raises(TimeoutError, match=r"no subscriber of /drone_0/cmd_vel within 0\.1 s"):
        Peer(join(), 1).send(0, "cmd_vel", msg.Twist(), timeout=0.1)


@pytest.mark.parametrize(
    ("given", "message"),
    [("ten", "'ten'; give a whole number"), ("-1", "'-1'; give a whole number"), ("233", "233; give at most 232")],
)
def test_a_domain_that_there_is_not_is_refused(given, message, domain, monkeypatch):
    from jaxdrones.ros2.cyclone import CycloneTransport

    monkeypatch.setenv("ROS_DOMAIN_ID", given)
    with pytest.raises(UserError, match=f"^ROS_DOMAIN_ID is {message}"):
        CycloneTransport()


@pytest.fixture
def start():
    """Start the command line in a process of its own; what still runs at the end is killed."""
    running = []

    def begin(*arguments):
        code = "import sys; from jaxdrones.cli import main; sys.exit(main(sys.argv[1:]))"
        command = [sys.executable, "-c", code, "ros2", "--transport", "cyclonedds", *arguments]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        running.append(process)
        return process

    yield begin
    for process in running:
        process.kill()
        process.communicate()


def commanding(transport, peer, target, seconds):
    """Command positions, at 100 Hz or as fast as this computer can; returns how many were sent to each drone."""
    due, count = time.monotonic(), round(100 * seconds)
    for _ in range(count):
        peer.fly_to(target)
        due += 0.01
        while (left := due - time.monotonic()) > 0:
            transport.spin(left)
        transport.spin(0)
    assert transport.flush(5)
    return count


def interrupted(node):
    """End a flight by Ctrl-C; returns its report and what it wrote to stderr."""
    node.send_signal(signal.SIGINT)
    out, err = node.communicate(timeout=120)
    assert out, err
    return json.loads(out), err


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["explicit", pytest.param("bullet", marks=pytest.mark.needs("pybullet"))])
def test_two_processes_lose_no_message_of_four_drones_at_100_hz(backend, start, join):
    n = 4
    node = start("--drones", str(n), "--json", "--timeout", "60", "--backend", backend)
    transport = join()
    peer = Peer(transport, n)
    peer.state(120)
    target = np.array([[0.5, 0.5 * i, 1.3] for i in range(n)])
    sent = commanding(transport, peer, target, 6.0)
    until(lambda: np.allclose(peer.state(60).pos, target, atol=0.05), transport, timeout=120)
    out, err = interrupted(node)
    last = round(1e9 * out["simulated_s"]) - 10_000_000  # the interrupted step may be unpublished
    until(lambda: all(stamps[-1] >= last for stamps in peer.stamps), transport)
    assert (node.returncode, err) == (130, "jaxdrones: interrupted\n")
    assert (out["received"], out["refused"], out["lost"]) == (n * sent, 0, 0)
    for stamps in peer.stamps:
        assert len(stamps) > 400 and set(np.diff(stamps)) == {10_000_000}


@pytest.mark.slow
@pytest.mark.float32
def test_lockstep_between_processes_is_bit_for_bit_the_flight_of_the_engine_alone(start, join):
    n, steps = 4, 300
    node = start("--drones", str(n), "--lockstep", "--duration", "3", "--json", "--wait", "120")
    transport = join()
    peer = Peer(transport, n)
    alone = _like_the_command_line(n)
    rng = np.random.default_rng(0)
    tape = rng.uniform(0.95, 1.05, (steps, n, 4)) * np.asarray(alone.params.hover_rpm)[:, None]
    for rpm in tape:
        for i in range(n):
            peer.send(i, "cmd_motors", convert.motors(rpm[i]))
        heard = peer.step(timeout=120)
        alone.commands = [convert.to_command("cmd_motors", convert.motors(rpm[i])) for i in range(n)]
        alone.advance()
        for name in ("pos", "quat", "omega", "rpm"):
            np.testing.assert_array_equal(getattr(heard, name), np.asarray(getattr(alone.state, name), float))
        np.testing.assert_array_equal(heard.vel, convert.to_world(heard.quat, np.asarray(alone.measure().vel, float)))
    out, _ = node.communicate(timeout=60)
    assert node.returncode == 0 and json.loads(out)["steps"] == steps
    assert all(stamps[-steps:] == [(k + 1) * 10_000_000 for k in range(steps)] for stamps in peer.stamps)


def _like_the_command_line(n):
    import contextlib

    from jaxdrones.cli import _parser, ros2

    with contextlib.ExitStack() as stack:
        return ros2._simulation(_parser().parse_args(["ros2", "--drones", str(n)]), stack)


@pytest.mark.slow
@pytest.mark.parametrize("action", ["stop", "land", "hover"])
def test_a_killed_peer_is_reported_and_the_flight_ends_as_configured(action, start, domain):
    node = start("--drones", "2", "--duration", "40", "--failsafe", action, "--timeout", "1", "--wait", "120", "--json")
    code = (
        "import time; from jaxdrones.ros2 import Peer, open_transport\n"
        "t = open_transport('cyclonedds'); p = Peer(t, 2); p.state(120)\n"
        "while True: p.fly_to([[0.0, -0.25, 0.6], [0.0, 0.25, 0.6]]); print('sent', flush=True); time.sleep(0.05)"
    )
    peer = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    try:
        for _ in range(20):
            assert peer.stdout.readline() == "sent\n"
    finally:
        peer.send_signal(signal.SIGKILL)
        peer.communicate()
    out, err = node.communicate(timeout=120)
    assert "no command for drone_0 for 1 s" in err
    assert out, err
    report = json.loads(out)
    assert report["received"] >= 2 * 15 and report["lost"] >= 1
    assert node.returncode == (1 if action == "stop" else 0)
    assert report["landed"] == (action == "land") and (report["steps"] == 4000) == (action == "hover")


@pytest.mark.slow
def test_a_late_peer_is_heard_and_a_wrong_type_is_named_over_the_network(start, join):
    node = start("--wait", "0.5", "--timeout", "60", "--json")
    transport = join()
    peer = Peer(transport, 1)
    publish = transport.publisher(Topic("drone_0/cmd_rates", msg.TwistStamped.NAME, QoS(10)))
    until(lambda: peer.stamps[0] and peer.stamps[0][-1] > 1_000_000_000, transport, timeout=120)
    publish(msg.TwistStamped())
    commanding(transport, peer, np.array([[0.3, 0.0, 1.0]]), 4.0)
    until(lambda: np.allclose(peer.state(60).pos, [[0.3, 0.0, 1.0]], atol=0.03), transport, timeout=120)
    out, err = interrupted(node)
    assert node.returncode == 130 and out["received"] == 400
    for line in (
        "no command for drone_0 for 0.5 s; it hovers",
        "commands for drone_0 are back",
        "publishes /drone_0/cmd_rates as geometry_msgs/msg/TwistStamped; its type is geometry_msgs/msg/Twist",
    ):
        assert line in err


@pytest.mark.slow
def test_in_process_and_over_dds_a_step_is_the_same(join):
    """The quick sibling of lockstep: node and peer in one process, by threads, over the loopback address."""
    import threading

    from jaxdrones.ros2 import Failsafe, Node

    steps = 10
    node = Node(make_simulation(2), join(), lockstep=True, failsafe=Failsafe("stop", wait=60, timeout=60))
    flight = threading.Thread(target=lambda: node.run(steps / 100))
    with jax.enable_x64(True):
        flight.start()
    peer, alone = Peer(join(), 2), make_simulation(2)
    target = np.array([[0.2, 0.0, 1.0], [0.0, 0.5, 1.2]])
    header = msg.Header(frame_id=topics.WORLD)
    alone.commands = [
        convert.to_command("cmd_pose", msg.PoseStamped(header, msg.Pose(msg.Point(*place))))
        for place in target.tolist()
    ]
    for _ in range(steps):
        peer.fly_to(target)
        heard = peer.step(30)
        alone.advance()
        np.testing.assert_array_equal(heard.pos, alone.state.pos)
    flight.join(30)
    assert not flight.is_alive()
