"""Interface of transports."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from jaxdrones.ros2.messages import Message
from jaxdrones.ros2.topics import Topic

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
