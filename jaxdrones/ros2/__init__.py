"""ROS 2 interface of a simulated team: messages, node, transports, bags, and a backend for Crazyswarm2."""

from jaxdrones.ros2.command import Command, Mode
from jaxdrones.ros2.failsafe import Failsafe, PeerLost
from jaxdrones.ros2.network import open_transport
from jaxdrones.ros2.node import Flown, Node
from jaxdrones.ros2.peer import Peer
from jaxdrones.ros2.simulation import Simulation
from jaxdrones.ros2.topics import QoS, Topic
from jaxdrones.ros2.transport import Transport

__all__ = [
    "Command",
    "Failsafe",
    "Flown",
    "Mode",
    "Node",
    "Peer",
    "PeerLost",
    "QoS",
    "Simulation",
    "Topic",
    "Transport",
    "open_transport",
]
