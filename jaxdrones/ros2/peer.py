"""Python client of a team's topics, without ROS."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Sequence

import numpy as np

from jaxdrones.ros2 import convert, topics
from jaxdrones.ros2 import messages as msg
from jaxdrones.ros2.transport import Transport
from jaxdrones.state import State


class Peer:
    """Client that commands a team of n drones and receives its state."""

    def __init__(self, transport: Transport, drones: int):
        """Subscribe to the state of a team.

        Args:
            transport: transport of messages, closed by the caller.
            drones: size of the team.
        """
        self._transport, self._drones = transport, drones
        self._publishers: dict[str, Callable[[msg.Message], None]] = {}
        self._odometry: dict[int, msg.Odometry] = {}  # latest of each drone
        self._motors: dict[int, msg.Float64MultiArray] = {}
        self.stamps: list[list[int]] = [[] for _ in range(drones)]
        """Times of all odometry of each drone, ns."""
        for i in range(drones):  # odometry first, so that the motor speeds, sent before it, are complete with it
            transport.subscribe(topics.output(i, "odom"), functools.partial(self._keep, i))
            transport.subscribe(topics.output(i, "motors"), functools.partial(self._motors.__setitem__, i))

    def _keep(self, i: int, message: msg.Odometry) -> None:
        self._odometry[i] = message
        self.stamps[i].append(convert.nanoseconds(message.header.stamp))

    def send(self, i: int, name: str, message: msg.Message, timeout: float = 30.0) -> None:
        """Publish a message on a topic of `topics.COMMANDS` of drone `i`; the first one waits for the node.

        Raises:
            TimeoutError: no node within `timeout` s.
        """
        topic = topics.command(i, name)
        if topic.name not in self._publishers:
            publish = self._transport.publisher(topic)
            if not self._transport.connect(topic, timeout):
                raise TimeoutError(f"no subscriber of /{topic.name} within {timeout:g} s; is the node there?")
            self._publishers[topic.name] = publish
        self._publishers[topic.name](message)

    def fly_to(self, pos: Sequence[Sequence[float]] | np.ndarray, yaw: float = 0.0) -> None:
        """Publish positions (n, 3), m, and a heading, rad."""
        turned = msg.Quaternion(z=float(np.sin(yaw / 2)), w=float(np.cos(yaw / 2)))
        for i, target in enumerate(np.asarray(pos, float).tolist()):
            self.send(
                i, "cmd_pose", msg.PoseStamped(msg.Header(frame_id=topics.WORLD), msg.Pose(msg.Point(*target), turned))
            )

    def step(self, timeout: float = 5.0) -> State:
        """Step a flight in lockstep with all commands sent so far; return the state after it.

        Raises:
            TimeoutError: no delivery, answer or state within `timeout` s.
            RuntimeError: rejected by the node.
        """
        if not self._transport.flush(timeout):
            raise TimeoutError(f"commands did not arrive within {timeout:g} s; is the node still there?")
        done, text = self._transport.call(topics.STEP_SERVICE, timeout)
        if not done:
            raise RuntimeError(f"the step was rejected: {text}")
        seconds, _, fraction = text.partition(".")
        return self.state(timeout, since=int(seconds) * 1_000_000_000 + int(fraction))

    def state(self, timeout: float = 5.0, since: int = 0) -> State:
        """Latest complete state of the team at or after the time `since`, ns.

        Raises:
            TimeoutError: no state within `timeout` s.
        """
        end, team = time.monotonic() + timeout, range(self._drones)
        while True:
            if all(stamps and stamps[-1] >= since for stamps in self.stamps) and len(self._motors) == self._drones:
                return convert.to_state([self._odometry[i] for i in team], [self._motors[i] for i in team])
            left = end - time.monotonic()
            if left < 0:
                raise TimeoutError(f"the state of the team did not arrive within {timeout:g} s; is the node there?")
            self._transport.spin(left)
