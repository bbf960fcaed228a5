"""Selection of the transport."""

from __future__ import annotations

import importlib.util

from jaxdrones.checks import check_choice
from jaxdrones.ros2.transport import Transport

TRANSPORTS = ("auto", "cyclonedds", "rclpy")


def open_transport(name: str = "auto", node: str = "jaxdrones") -> Transport:
    """Join the network of ROS 2 with the domain of `ROS_DOMAIN_ID`.

    Args:
        name: `cyclonedds`, `rclpy`, or `auto`: rclpy if installed, else CycloneDDS.
        node: name of the node, if the transport has names of nodes.

    Raises:
        ValueError: an unknown name.
        ImportError: the library is not installed.
    """
    check_choice("transport", name, TRANSPORTS)
    if name == "rclpy" or (name == "auto" and importlib.util.find_spec("rclpy")):
        from jaxdrones.ros2.rclpy_transport import RclpyTransport

        return RclpyTransport(node)
    from jaxdrones.ros2.cyclone import CycloneTransport

    return CycloneTransport()
