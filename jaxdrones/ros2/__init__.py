"""ROS 2 interface of a simulated team: messages, node, transport, bags, and a backend for Crazyswarm2."""

from jaxdrones.ros2.command import Command, Mode
from jaxdrones.ros2.failsafe import Failsafe, PeerLost
from jaxdrones.ros2.node import Flown, Node
from jaxdrones.ros2.simulation import Simulation
from jaxdrones.ros2.topics import QoS, Topic, Transport

__all__ = ["Command", "Failsafe", "Flown", "Mode", "Node", "PeerLost", "Simulation"]
__all__ += ["QoS", "Topic", "Transport"]
