"""The topics of a team: names, standard message types and quality of service, whatever transports them.

Frames follow REP-103: `world` is east, north, up (the world frame of the simulator), a body has x forward, y left and z
up, and a camera's optical frame has x right, y down and z forward. Units are SI; rotor speeds are RPM, as everywhere in
this package.
"""

from __future__ import annotations

import dataclasses

WORLD = "world"
"""Frame of positions."""
STEP_SERVICE = "step"
"""`std_srvs/srv/Trigger`: advance the flight by one control step and answer when its messages are out."""


@dataclasses.dataclass(frozen=True)
class QoS:
    """Quality of service: delivery, and how many messages wait for a reader or a writer."""

    depth: int
    reliable: bool = True


_STATE = QoS(
    depth=200
)  # 2 s at 100 Hz; the messages that wait stay below the 500 kB at which CycloneDDS holds a writer
_COMMAND = QoS(depth=100)
_IMAGE = QoS(depth=5, reliable=False)  # sensor data in ROS: a slow subscriber loses images and holds up nobody


@dataclasses.dataclass(frozen=True)
class Topic:
    """A topic by its full name without the leading slash."""

    name: str
    type: str
    """Name of the message type."""
    qos: QoS


CLOCK = Topic("clock", "rosgraph_msgs/msg/Clock", _STATE)

OUTPUTS = {
    "pose": ("geometry_msgs/msg/PoseStamped", _STATE),
    "twist": ("geometry_msgs/msg/TwistStamped", _STATE),
    "odom": ("nav_msgs/msg/Odometry", _STATE),
    "imu": ("sensor_msgs/msg/Imu", _STATE),
    "motors": ("std_msgs/msg/Float64MultiArray", _STATE),
    "battery": ("sensor_msgs/msg/BatteryState", _STATE),
    "camera/image_raw": ("sensor_msgs/msg/Image", _IMAGE),
    "camera/camera_info": ("sensor_msgs/msg/CameraInfo", _IMAGE),
}
"""What every drone publishes, below its own name."""

COMMANDS = {
    "cmd_pose": ("geometry_msgs/msg/PoseStamped", _COMMAND),
    "cmd_vel": ("geometry_msgs/msg/Twist", _COMMAND),
    "cmd_rates": ("geometry_msgs/msg/Twist", _COMMAND),
    "cmd_motors": ("std_msgs/msg/Float64MultiArray", _COMMAND),
}
"""What every drone listens to, below its own name; the latest message of any of them is flown."""


def drone(i: int) -> str:
    """The name of a drone, which is the namespace of its topics."""
    return f"drone_{i}"


def body_frame(i: int) -> str:
    """Frame of the body of a drone: x forward, y left, z up."""
    return f"{drone(i)}/base_link"


def optical_frame(i: int) -> str:
    """Frame of the images of a drone: x right, y down, z forward."""
    return f"{drone(i)}/camera_optical_frame"


def output(i: int, name: str) -> Topic:
    """A topic that a drone publishes; `name` is a key of `OUTPUTS`."""
    return Topic(f"{drone(i)}/{name}", *OUTPUTS[name])


def command(i: int, name: str) -> Topic:
    """A topic that a drone listens to; `name` is a key of `COMMANDS`."""
    return Topic(f"{drone(i)}/{name}", *COMMANDS[name])
