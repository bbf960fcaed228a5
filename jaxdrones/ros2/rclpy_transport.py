"""Transport by rclpy, for computers with an installed and sourced ROS 2."""

from __future__ import annotations

import array
import importlib
import time
from collections.abc import Callable
from typing import Any

try:
    import rclpy
    import rclpy.duration
    import rclpy.executors
    import rclpy.qos
    import rclpy.signals
except ImportError as error:
    raise ImportError(
        "rclpy is not there; it comes with ROS 2 (source its setup.bash), or take the transport 'cyclonedds'"
    ) from error

from jaxdrones.ros2 import messages as msg
from jaxdrones.ros2.topics import QoS, Topic
from jaxdrones.ros2.transport import Answer

_TYPECODES = {"uint8": "B", "float32": "f", "float64": "d"}
_LOOK = 1.0  # s between checks of the other endpoints


class RclpyTransport:
    """Node of rclpy, spun by the thread that calls `spin`."""

    def __init__(self, name: str = "jaxdrones"):
        """Start rclpy if necessary, and a node of this name."""
        self._began = not rclpy.ok()
        if self._began:  # without its handler of Ctrl-C, which ends the network before the flight
            rclpy.init(signal_handler_options=rclpy.signals.SignalHandlerOptions.NO)
        self._node = rclpy.create_node(name)
        self._executor = rclpy.executors.SingleThreadedExecutor()
        self._executor.add_node(self._node)
        self._topics: list[tuple[Topic, bool]] = []
        self._publishers: dict[str, Any] = {}
        self._clients: dict[str, Any] = {}
        self._said: set[str] = set()
        self._looked = -_LOOK

    def publisher(self, topic: Topic) -> Callable[[msg.Message], None]:
        """Function that publishes messages."""
        publisher = self._node.create_publisher(ros_class(topic.type), f"/{topic.name}", _ros_qos(topic.qos))
        self._publishers[topic.name] = publisher
        self._topics.append((topic, True))
        return lambda message: publisher.publish(msg.encode(message, ros_class, _ros_array))

    def subscribe(self, topic: Topic, receive: Callable[[Any], None]) -> None:
        """Call a function with every message of a topic."""

        def received(message: Any) -> None:
            receive(msg.decode(topic.type, message))

        self._node.create_subscription(ros_class(topic.type), f"/{topic.name}", received, _ros_qos(topic.qos))
        self._topics.append((topic, False))

    def serve(self, name: str, answer: Answer) -> None:
        """Offer a service. A pending request is answered after the first pending message of each topic."""

        def respond(request: Any, response: Any) -> Any:
            response.success, response.message = answer()
            return response

        self._node.create_service(_trigger(), f"/{name}", respond)

    def call(self, name: str, timeout: float) -> tuple[bool, str]:
        """Call a service of another process.

        Raises:
            TimeoutError: no answer within `timeout` s.
        """
        if name not in self._clients:
            self._clients[name] = self._node.create_client(_trigger(), f"/{name}")
        client = self._clients[name]
        if not client.wait_for_service(timeout_sec=timeout):
            raise TimeoutError(f"no server of the service {name!r} within {timeout:g} s; is the node there?")
        future = client.call_async(_trigger().Request())
        self._executor.spin_until_future_complete(future, timeout_sec=timeout)
        if not future.done():
            raise TimeoutError(f"the service {name!r} did not answer within {timeout:g} s")
        reply = future.result()
        return reply.success, reply.message

    def connect(self, topic: Topic, timeout: float) -> bool:
        """Wait at most `timeout` s for a subscriber; return whether there is one."""
        end = time.monotonic() + timeout
        while not self._publishers[topic.name].get_subscription_count():
            if time.monotonic() > end:
                return False
            self.spin(0.01)
        return True

    def flush(self, timeout: float) -> bool:
        """Wait at most `timeout` s for delivery to all readers; return whether it succeeded."""
        end = time.monotonic() + timeout

        def acknowledged(publisher: Any) -> bool:
            left = max(end - time.monotonic(), 1e-3)
            return publisher.wait_for_all_acked(rclpy.duration.Duration(seconds=left))

        return all(map(acknowledged, self._publishers.values()))

    def spin(self, timeout: float) -> None:
        """Deliver received messages; wait up to `timeout` s for one."""
        self._executor.spin_once(timeout_sec=max(timeout, 0.0))

    def complaints(self) -> list[str]:
        """New mismatches with endpoints of other processes, such as another type."""
        if time.monotonic() < self._looked + _LOOK:
            return []
        self._looked = time.monotonic()
        found = []
        for topic, published in self._topics:
            name = f"/{topic.name}"
            look = self._node.get_subscriptions_info_by_topic if published else self._node.get_publishers_info_by_topic
            does = "subscribes to" if published else "publishes"
            for end in look(name):
                text = f"a peer {does} {name} as {end.topic_type}; its type is {topic.type}"
                if end.topic_type != topic.type and text not in self._said:
                    self._said.add(text)
                    found.append(text)
        return found

    def close(self) -> None:
        """Leave the network, and stop rclpy if it was started here."""
        self._executor.shutdown()
        self._node.destroy_node()
        if self._began:
            rclpy.shutdown()


def ros_class(kind: str) -> Any:
    """Class of a message type in the installed ROS 2.

    Raises:
        ImportError: its package is not installed.
    """
    package, _, name = kind.split("/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), name)
    except ImportError as error:
        raise ImportError(f"{kind} is not there; install the ROS 2 package {package}") from error


def _trigger() -> Any:
    return importlib.import_module("std_srvs.srv").Trigger


def _ros_array(field: msg.Field, given: Any) -> Any:
    """Array of numbers for rclpy: a list for a fixed length, else an `array.array`."""
    return list(given) if field.length else array.array(_TYPECODES[field.kind], given)


def _ros_qos(qos: QoS) -> Any:
    policy = rclpy.qos.ReliabilityPolicy
    return rclpy.qos.QoSProfile(depth=qos.depth, reliability=policy.RELIABLE if qos.reliable else policy.BEST_EFFORT)
