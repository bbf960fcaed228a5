"""Bags: what is written is what is read, by this package and by a reader that knows nothing of it."""

import json

import numpy as np
import pytest
from in_process import InProcess, Peer, Wire
from ros2_team import make_simulation

from jaxdrones.cli import main
from jaxdrones.flights import read_log
from jaxdrones.flights.fly import fly
from jaxdrones.ros2 import Node, bag, convert, topics
from jaxdrones.ros2 import messages as msg
from jaxdrones.sensing import Camera

pytestmark = pytest.mark.needs("rosbags")


@pytest.fixture
def recorded(tmp_path):
    """A bag of a short flight with a camera and a command, and what was sent meanwhile."""
    wire = Wire()
    with bag.Recorder(tmp_path / "bag") as recorder:
        camera = Camera(resolution=(8, 6), rate=20.0)
        node = Node(make_simulation(2), InProcess(wire), clock=wire.clock, recorder=recorder, camera=camera)
        peer = Peer(wire)
        wire.script = [(0.042, lambda: peer.fly_to([[0.1, 0.0, 1.0], [0.1, 0.5, 1.0]]))]
        node.run(0.1)
    return tmp_path / "bag", wire


@pytest.mark.slow
def test_a_bag_holds_every_message_of_a_flight(recorded):
    path, wire = recorded
    read = {}
    for name, ns, message in bag.read(path):
        assert 0 <= ns <= 100_000_000
        read.setdefault(name, []).append(message)
    assert read == dict(wire.sent)
    assert [type(m) for m in read["drone_0/cmd_pose"]] == [msg.PoseStamped]


@pytest.mark.slow
@pytest.mark.needs("mcap_ros2")
def test_a_bag_opens_in_an_independent_reader(recorded):
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    path, wire = recorded
    (file,) = path.glob("*.mcap")
    found = {}
    with file.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        assert reader.get_header().profile == "ros2"
        for schema, channel, entry, message in reader.iter_decoded_messages():
            found.setdefault(channel.topic.removeprefix("/"), []).append((schema.name, entry.log_time, message))
    assert {name: len(entries) for name, entries in found.items()} == {
        name: len(sent) for name, sent in wire.sent.items()
    }
    (schema, ns, message), sent = found["drone_1/odom"][-1], wire.sent["drone_1/odom"][-1]
    assert (schema, ns) == ("nav_msgs/msg/Odometry", 100_000_000)
    assert message.pose.pose.position.y == sent.pose.pose.position.y
    assert message.header.stamp.nanosec == 100_000_000 and message.child_frame_id == "drone_1/base_link"
    (_, _, picture), pixels = found["drone_0/camera/image_raw"][0], wire.sent["drone_0/camera/image_raw"][0].data
    assert bytes(picture.data) == pixels and picture.encoding == "rgb8"


@pytest.mark.slow
def test_a_flight_comes_back_from_its_bag(tmp_path):
    record = fly("circle", drones=2, duration=0.25)
    bag.write_flight(record, tmp_path / "bag")
    back = read_log(tmp_path / "bag")
    np.testing.assert_allclose(back.t, record.t, atol=1e-9)
    for name in ("pos", "quat", "omega", "rpm"):
        np.testing.assert_array_equal(getattr(back, name), getattr(record, name))
    np.testing.assert_allclose(back.vel, record.vel, atol=1e-14)


@pytest.mark.slow
def test_a_bag_is_not_written_over(recorded):
    with pytest.raises(ValueError, match="exists already; give the path of a new bag"):
        bag.Recorder(recorded[0])


def test_what_is_no_bag_is_refused(tmp_path):
    with pytest.raises(ValueError, match="is not a ROS 2 bag"):
        list(bag.read(tmp_path / "nothing"))


def test_a_damaged_bag_is_refused(tmp_path):
    """Cut anywhere, or with a byte of its index changed, a bag is a mistake in one sentence."""
    with bag.Recorder(tmp_path / "bag") as recorder:
        for ns in range(20):
            recorder.write(topics.CLOCK, msg.Clock(convert.stamp(ns)), ns)
    (file,) = (tmp_path / "bag").glob("*.mcap")
    whole = file.read_bytes()
    damaged = [whole[:cut] for cut in (0, 1, 8, 9, 100, len(whole) // 2, len(whole) - 1)]
    for at in range(9, len(whole), 50):
        damaged.append(whole[:at] + bytes([whole[at] ^ 0xFF]) + whole[at + 1 :])
    refused = 0
    for data in damaged:
        file.write_bytes(data)
        try:
            list(bag.read(tmp_path / "bag"))
        except ValueError as error:
            assert "is not a ROS 2 bag, or is damaged" in str(error)
            refused += 1
    assert refused >= 7


def test_the_velocity_in_a_bag_is_that_of_the_body(tmp_path):
    """Of a drone that has turned left by a quarter, and then flies ahead and climbs."""
    pose = msg.Pose(msg.Point(1.0, 2.0, 3.0), msg.Quaternion(0.0, 0.0, 0.5**0.5, 0.5**0.5))
    twist = msg.Twist(msg.Vector3(2.0, 0.0, 0.5), msg.Vector3(0.1, 0.2, 0.3))
    state = msg.Odometry(pose=msg.PoseWithCovariance(pose), twist=msg.TwistWithCovariance(twist))
    with bag.Recorder(tmp_path / "bag") as recorder:
        recorder.write(topics.output(0, "odom"), state, 5)
        recorder.write(topics.output(0, "motors"), msg.Float64MultiArray(data=(1.0,) * 4), 5)
    log = read_log(tmp_path / "bag")
    np.testing.assert_allclose(log.vel, [[[0, 2, 0.5]]], atol=1e-12)
    np.testing.assert_array_equal(log.omega, [[[0.1, 0.2, 0.3]]])
    np.testing.assert_array_equal(log.pos, [[[1, 2, 3]]])


def test_a_bag_without_a_flight_is_refused(tmp_path):
    with bag.Recorder(tmp_path / "bag") as recorder:
        recorder.write(topics.CLOCK, msg.Clock(convert.stamp(5)), 5)
    with pytest.raises(ValueError, match="has no flight"):
        read_log(tmp_path / "bag")


@pytest.mark.parametrize(
    ("late", "speeds", "said"),
    [(0, 4, None), (7, 4, "of its 1 drones have no time in common"), (0, 3, "/motors does not have 4 numbers")],
)
def test_a_flight_is_that_of_the_drones_whatever_else_a_bag_holds(late, speeds, said, tmp_path):
    odom, motors = topics.output(0, "odom"), topics.output(0, "motors")
    other = topics.Topic("cart/odom", odom.type, odom.qos)
    with bag.Recorder(tmp_path / "bag") as recorder:
        for ns in 5, 10, 15:
            recorder.write(odom, msg.Odometry(), ns)
            recorder.write(motors, msg.Float64MultiArray(data=(1.0,) * (speeds if ns == 10 else 4)), ns + late)
            recorder.write(other, msg.Odometry(), ns + 1)
    if said is None:
        assert len(read_log(tmp_path / "bag").t) == 3
    else:
        with pytest.raises(ValueError, match=said):
            read_log(tmp_path / "bag")


@pytest.fixture
def wired(monkeypatch):
    """The command line on a transport within this process."""
    wire = Wire()
    monkeypatch.setattr("jaxdrones.cli.ros2.join", lambda: InProcess(wire))
    monkeypatch.setattr("time.monotonic", wire.clock)
    return wire


@pytest.mark.parametrize(
    ("before", "after", "speed"), [([], [], 1), ([], ["--speed", "4"], 4), (["--speed", "4"], [], 4)]
)
def test_a_bag_is_replayed_at_its_pace(tmp_path, wired, capsys, before, after, speed):
    sent = {
        "clock": [msg.Clock(convert.stamp(ns)) for ns in (0, 50_000_000, 100_000_000)],
        "drone_0/cmd_pose": [msg.PoseStamped(pose=msg.Pose(msg.Point(x=float(k)))) for k in range(3)],
    }
    with bag.Recorder(tmp_path / "bag") as recorder:
        for k, (clock, pose) in enumerate(zip(*sent.values(), strict=True)):
            recorder.write(topics.CLOCK, clock, k * 50_000_000)
            recorder.write(topics.command(0, "cmd_pose"), pose, k * 50_000_000)
    assert main(["ros2", *before, "replay", str(tmp_path / "bag"), *after, "--json"]) == 0
    assert dict(wired.sent) == sent
    assert json.loads(capsys.readouterr().out) == {"published": 6, "simulated_s": 0.1}
    assert wired.now == pytest.approx(0.1 / speed, abs=0.01)
