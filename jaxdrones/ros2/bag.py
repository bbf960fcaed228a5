"""ROS 2 bags: write and read flights as MCAP files. Needs the extra `ros2`."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from jaxdrones.errors import UserError
from jaxdrones.ros2 import convert, topics
from jaxdrones.ros2 import messages as msg
from jaxdrones.ros2.topics import Topic

if TYPE_CHECKING:
    from jaxdrones.flights.log import FlightLog


class Recorded(NamedTuple):
    """One message of a bag."""

    topic: str  # without the leading slash
    ns: int  # simulated time
    message: msg.Message


class Recorder(contextlib.AbstractContextManager["Recorder"]):
    """Writer of messages to a new bag; a context manager that finishes it."""

    def __init__(self, path: Path):
        """Start a bag in a new folder: an MCAP file and `metadata.yaml`."""
        msg.typestore()
        from rosbags.rosbag2 import StoragePlugin, Writer

        path = Path(path)
        if path.exists():
            raise UserError(f"{path} exists already; give the path of a new bag")
        self._writer = Writer(path, version=9, storage_plugin=StoragePlugin.MCAP)
        self._connections: dict[str, Any] = {}
        try:
            self._writer.open()
        except OSError as error:
            raise UserError(f"{path} cannot be written: {error.strerror}; choose another") from None

    def __exit__(self, *_) -> None:
        self._writer.close()

    def write(self, topic: Topic, message: msg.Message, ns: int) -> None:
        """Write a message of a topic at a simulated time, ns."""
        if topic.name not in self._connections:
            self._connections[topic.name] = self._writer.add_connection(
                f"/{topic.name}", topic.type, typestore=msg.typestore()
            )
        self._writer.write(self._connections[topic.name], ns, msg.serialize(message))


def read(path: Path) -> Iterator[Recorded]:
    """Read the messages of a bag in the order of their times; unknown types are skipped."""
    msg.typestore()
    from rosbags.rosbag2 import Reader

    try:
        with Reader(path) as reader:
            known = [connection for connection in reader.connections if connection.msgtype in msg.MESSAGES]
            for connection, ns, data in reader.messages(known):
                message = msg.deserialize(data, connection.msgtype)
                yield Recorded(connection.topic.removeprefix("/"), ns, message)
    except Exception as error:  # the reader raises errors of any type on damaged bytes
        raise UserError(f"{path} is not a ROS 2 bag, or is damaged: {error}; give the folder of a bag") from None


def write_flight(record: FlightLog, path: Path) -> None:
    """Write the log of a flight as a bag: clock, poses, twists, odometry and rotor speeds."""
    with Recorder(path) as recorder:
        for k, t in enumerate(np.asarray(record.t, float)):
            ns = round(t * 1e9)
            recorder.write(topics.CLOCK, msg.Clock(convert.stamp(ns)), ns)
            vel = convert.to_body(record.quat[k], record.vel[k])
            now = convert.Measurement(
                record.pos[k], record.quat[k], vel, record.omega[k], acc=None, rpm=record.rpm[k], battery=None
            )
            for i in range(record.pos.shape[1]):
                for name, message in convert.state_messages(now, i, ns).items():
                    recorder.write(topics.output(i, name), message, ns)
