"""Topics of a team, names, standard message types and quality of service, and the interface of their transport.

Frames follow REP-103: `world` is east, north, up (the world frame of the simulator), a body has x forward, y left and z
up, and a camera's optical frame has x right, y down and z forward. Units are SI, except for rotor speeds in RPM.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, Protocol

from jaxdrones.ros2.messages import Message

WORLD = "world"
"""Frame of positions."""
STEP_SERVICE = "step"
"""`std_srvs/srv/Trigger`: advance the flight by one control step and answer when its messages are published."""


@dataclasses.dataclass(frozen=True)
class QoS:
    """Quality of service: reliability and queue length."""

    depth: int
    reliable: bool = True


_STREAM = QoS(depth=500)  # 5 s at 100 Hz: Fast DDS sends lost messages again after up to 3 s
_IMAGE = QoS(depth=5, reliable=False)  # sensor data in ROS: a slow subscriber loses images without blocking others


@dataclasses.dataclass(frozen=True)
class Topic:
    """Topic by its full name without the leading slash."""

    name: str
    type: str
    """Name of the message type."""
    qos: QoS


CLOCK = Topic("clock", "rosgraph_msgs/msg/Clock", _STREAM)

OUTPUTS = {
    "pose": ("geometry_msgs/msg/PoseStamped", _STREAM),
    "twist": ("geometry_msgs/msg/TwistStamped", _STREAM),
    "odom": ("nav_msgs/msg/Odometry", _STREAM),
    "imu": ("sensor_msgs/msg/Imu", _STREAM),
    "motors": ("std_msgs/msg/Float64MultiArray", _STREAM),
    "battery": ("sensor_msgs/msg/BatteryState", _STREAM),
    "camera/image_raw": ("sensor_msgs/msg/Image", _IMAGE),
    "camera/camera_info": ("sensor_msgs/msg/CameraInfo", _IMAGE),
}
"""Outputs of every drone, in its namespace."""

COMMANDS = {
    "cmd_pose": ("geometry_msgs/msg/PoseStamped", _STREAM),
    "cmd_vel": ("geometry_msgs/msg/Twist", _STREAM),
    "cmd_rates": ("geometry_msgs/msg/Twist", _STREAM),
    "cmd_motors": ("std_msgs/msg/Float64MultiArray", _STREAM),
}
"""Command topics of every drone, in its namespace; the latest message of any of them applies."""


def drone(i: int) -> str:
    """Name of a drone, the namespace of its topics and frames: `base_link` and `camera_optical_frame`."""
    return f"drone_{i}"


def output(i: int, name: str) -> Topic:
    """Output topic of a drone; `name` is a key of `OUTPUTS`."""
    return Topic(f"{drone(i)}/{name}", *OUTPUTS[name])


def command(i: int, name: str) -> Topic:
    """Command topic of a drone; `name` is a key of `COMMANDS`."""
    return Topic(f"{drone(i)}/{name}", *COMMANDS[name])


Answer = Callable[[], tuple[bool, str]]
"""Handler of a `std_srvs/srv/Trigger` service: () -> (success, message)."""


class Transport(Protocol):
    """Publishers, subscriptions and services of type `std_srvs/srv/Trigger`; callbacks run only in `spin`."""

    def publisher(self, topic: Topic) -> Callable[[Message], None]:
        """Function that publishes messages."""

    def subscribe(self, topic: Topic, receive: Callable[[Any], None]) -> None:
        """Call a function with every message of a topic."""

    def serve(self, name: str, answer: Answer) -> None:
        """Offer a service. Messages before a request are delivered before its answer."""

    def flush(self, timeout: float) -> None:
        """Wait at most `timeout` s for delivery to all readers."""

    def spin(self, timeout: float) -> None:
        """Deliver received messages; wait up to `timeout` s for one."""

    def complaints(self) -> list[str]:
        """New mismatches with endpoints of other processes, such as another type."""

    def close(self) -> None:
        """Leave the network."""
