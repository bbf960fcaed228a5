"""The layer on rclpy against a stand-in: that it calls what rclpy documents, with types that messages accept."""

import importlib
import sys

import fake_ros
import numpy as np
import pytest
from ros2_team import make_simulation

from jaxdrones.ros2 import Failsafe, Node, Peer, open_transport, topics
from jaxdrones.ros2 import messages as msg
from jaxdrones.ros2.topics import QoS, Topic


@pytest.fixture
def ros(monkeypatch):
    return fake_ros.install(monkeypatch)


def test_a_node_flies_over_rclpy_in_lockstep(ros):
    here, there = open_transport("rclpy"), open_transport("rclpy", "peer")
    node = Node(make_simulation(2), here, lockstep=True, failsafe=Failsafe("stop", wait=30))
    peer, alone = Peer(there, 2), make_simulation(2)
    node._publish()
    for _ in range(5):
        peer.fly_to([[0.2, 0.0, 1.0], [0.2, 0.5, 1.0]])
        heard = peer.step()
        alone.commands = list(node._flight.commands)
        alone.advance()
        np.testing.assert_array_equal(heard.pos, alone.state.pos)
    assert node.flown.steps == 5 and node.flown.received == 10
    here.close()
    there.close()
    assert not ros.running


def test_every_message_type_is_accepted_and_comes_back(ros):
    transport = open_transport("rclpy")
    for name in msg.MESSAGES:
        got, message = [], msg.message_class(name)()
        topic = Topic(f"t/{name.replace('/', '_')}", name, QoS(1))
        transport.subscribe(topic, got.append)
        transport.publisher(topic)(message)
        transport.spin(0)
        assert got == [message]


def test_the_wrong_type_of_a_peer_is_named_once(ros):
    here, there = open_transport("rclpy"), open_transport("rclpy")
    here.subscribe(topics.command(0, "cmd_vel"), print)
    there.publisher(Topic("drone_0/cmd_vel", msg.TwistStamped.NAME, QoS(1)))
    assert here.complaints() == [
        "a peer publishes /drone_0/cmd_vel as geometry_msgs/msg/TwistStamped; its type is geometry_msgs/msg/Twist"
    ]
    assert here.complaints() == []


def test_a_service_that_is_not_there_is_an_error(ros):
    with pytest.raises(TimeoutError, match="no server of the service 'step'"):
        open_transport("rclpy").call("step", 0.1)


@pytest.mark.parametrize(("module", "library"), [("rclpy_transport", "rclpy"), ("cyclone", "cyclonedds")])
def test_a_transport_that_is_not_installed_is_named(module, library, monkeypatch):
    for name in list(sys.modules):
        if name.partition(".")[0] == library:
            monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, library, None)
    monkeypatch.delitem(sys.modules, f"jaxdrones.ros2.{module}", raising=False)
    with pytest.raises(ImportError, match=f"{library} is not"):
        importlib.import_module(f"jaxdrones.ros2.{module}")
