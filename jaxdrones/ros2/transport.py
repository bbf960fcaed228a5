"""What a node needs of whatever carries its messages."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from jaxdrones.ros2.messages import Message
from jaxdrones.ros2.topics import Topic

Answer = Callable[[], tuple[bool, str]]
"""What a `std_srvs/srv/Trigger` service does: () -> (success, message)."""


class Transport(Protocol):
    """Publishers, subscriptions and services of type `std_srvs/srv/Trigger`; nothing runs but within `spin`."""

    def publisher(self, topic: Topic) -> Callable[[Message], None]:
        """A function that publishes messages."""

    def subscribe(self, topic: Topic, receive: Callable[[Any], None]) -> None:
        """Have every message of a topic handed to a function."""

    def serve(self, name: str, answer: Answer) -> None:
        """Offer a service. It answers after the messages that arrived before its request are handed over."""

    def call(self, name: str, timeout: float) -> tuple[bool, str]:
        """Call a service of another process.

        Raises:
            TimeoutError: there was no answer within `timeout` s.
        """

    def connect(self, topic: Topic, timeout: float) -> bool:
        """Whether a subscriber is there, after at most `timeout` s, that hears what is published from now on."""

    def flush(self, timeout: float) -> bool:
        """Whether every reader there is received what was published, after at most `timeout` s."""

    def spin(self, timeout: float) -> None:
        """Hand over what has arrived; wait up to `timeout` s if nothing has."""

    def complaints(self) -> list[str]:
        """What is wrong with other processes' ends of the topics here, such as another type; each is said once."""

    def close(self) -> None:
        """Leave the network."""
