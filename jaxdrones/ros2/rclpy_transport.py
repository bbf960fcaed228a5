"""Transport by rclpy, the Python library of ROS 2."""

import importlib
import time
from collections.abc import Callable, Iterator
from typing import Any

try:
    import rclpy
    import rclpy.duration
    import rclpy.executors
    import rclpy.qos
    import rclpy.signals
except ImportError as error:
    raise ImportError(
        "rclpy is not installed; source the setup.bash of a ROS 2, or pip install ros-rclpy ros-rmw-fastrtps-cpp "
        "ros-std-msgs ros-sensor-msgs ros-geometry-msgs ros-nav-msgs ros-std-srvs ros-rosgraph-msgs"
    ) from error

from jaxdrones.ros2 import messages as msg
from jaxdrones.ros2.topics import Answer, QoS, Topic

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
        self._publishers: list[Any] = []
        self._said: set[str] = set()
        self._looked = -_LOOK
        self._subscriptions: list[tuple[Any, int, Callable[[Any], None]]] = []

    def publisher(self, topic: Topic) -> Callable[[msg.Message], None]:
        """Function that publishes messages."""
        publisher = self._node.create_publisher(ros_class(topic.type), f"/{topic.name}", _ros_qos(topic.qos))
        self._publishers.append(publisher)
        self._topics.append((topic, True))
        return lambda message: publisher.publish(msg.serialize(message))

    def subscribe(self, topic: Topic, receive: Callable[[Any], None]) -> None:
        """Call a function with every message of a topic."""

        def received(message: Any) -> None:
            receive(msg.decode(topic.type, message))

        qos = _ros_qos(topic.qos)
        end = self._node.create_subscription(ros_class(topic.type), f"/{topic.name}", received, qos)
        self._subscriptions.append((end, topic.qos.depth, received))
        self._topics.append((topic, False))

    def serve(self, name: str, answer: Answer) -> None:
        """Offer a service. Messages before a request are delivered before its answer."""

        def respond(request: Any, response: Any) -> Any:
            self._deliver()
            response.success, response.message = answer()
            return response

        self._node.create_service(importlib.import_module("std_srvs.srv").Trigger, f"/{name}", respond)

    def _deliver(self) -> None:
        """Deliver all received messages.

        An executor delivers one message of a topic at a time, and may deliver a request before earlier messages.
        """
        for end, depth, received in self._subscriptions:
            for _ in range(depth):
                if (taken := end.handle.take_message(end.msg_type, False)) is None:
                    break
                received(taken[0])

    def flush(self, timeout: float) -> None:
        """Wait at most `timeout` s for delivery to all readers."""
        end = time.monotonic() + timeout
        for publisher in self._publishers:
            left = max(end - time.monotonic(), 1e-3)
            publisher.wait_for_all_acked(rclpy.duration.Duration(seconds=left))

    def spin(self, timeout: float) -> None:
        """Deliver all received messages; wait up to `timeout` s for one."""
        self._executor.spin_once(timeout_sec=max(timeout, 0.0))
        self._deliver()

    def complaints(self) -> list[str]:
        """New mismatches with endpoints of other processes: another type, or an incompatible quality of service."""
        if time.monotonic() < self._looked + _LOOK:
            return []
        self._looked = time.monotonic()
        texts = [text for topic, published in self._topics for text in self._mismatches(topic, published)]
        found = [text for text in dict.fromkeys(texts) if text not in self._said]
        self._said.update(found)
        return found

    def _mismatches(self, topic: Topic, published: bool) -> Iterator[str]:
        """Mismatches of the endpoints of other processes with a topic of this node."""
        look = self._node.get_subscriptions_info_by_topic if published else self._node.get_publishers_info_by_topic
        who, own = f"a peer {'subscribes to' if published else 'publishes'} /{topic.name}", _ros_qos(topic.qos)
        for end in look(f"/{topic.name}"):
            if end.topic_type != topic.type:
                yield f"{who} as {end.topic_type}; its type is {topic.type}"
            given = end.qos_profile  # with infinite deadlines, which do not compare with the unspecified ones of `own`
            other = rclpy.qos.QoSProfile(depth=1, reliability=given.reliability, durability=given.durability)
            offered, requested = (own, other) if published else (other, own)
            compatible, reason = rclpy.qos.qos_check_compatible(offered, requested)
            if compatible == rclpy.qos.QoSCompatibility.ERROR:
                yield f"{who} with an incompatible quality of service: {reason.removeprefix('ERROR: ').rstrip(';')}"

    def close(self) -> None:
        """Leave the network, and stop rclpy if it was started here."""
        self._executor.shutdown()
        self._node.destroy_node()
        if self._began:
            rclpy.shutdown()


def ros_class(kind: str) -> Any:
    """Class of a message type in the installed ROS 2."""
    package, _, name = kind.split("/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), name)
    except ImportError as error:
        raise ImportError(f"{kind} is not installed; install the ROS 2 package {package}") from error


def _ros_qos(qos: QoS) -> Any:
    policy = rclpy.qos.ReliabilityPolicy
    return rclpy.qos.QoSProfile(depth=qos.depth, reliability=policy.RELIABLE if qos.reliable else policy.BEST_EFFORT)
