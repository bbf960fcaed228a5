"""CycloneDDS transport, with the DDS names of ROS 2. Needs the extra `ros2`."""

from __future__ import annotations

import os
import random
import time
from collections.abc import Callable
from typing import Any

from jaxdrones.errors import UserError, install

try:
    from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication, BuiltinTopicDcpsSubscription
    from cyclonedds.core import DDSException, InstanceState, Policy, Qos, ReadCondition, SampleState, ViewState, WaitSet
    from cyclonedds.domain import Domain, DomainParticipant
    from cyclonedds.pub import DataWriter
    from cyclonedds.sub import DataReader
    from cyclonedds.topic import Topic as DdsTopic
    from cyclonedds.util import duration
except ImportError as error:
    raise ImportError(f"cyclonedds is not installed; {install('ros2')}, or source a ROS 2") from error

from jaxdrones.limits import check_at_most
from jaxdrones.ros2 import idl
from jaxdrones.ros2 import messages as msg
from jaxdrones.ros2.topics import QoS, Topic
from jaxdrones.ros2.transport import Answer

LOOPBACK = """<CycloneDDS><Domain>
<General><Interfaces><NetworkInterface name="lo" multicast="false"/></Interfaces>
<AllowMulticast>false</AllowMulticast></General>
<Discovery><ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>30</MaxAutoParticipantIndex>
<Peers><Peer address="127.0.0.1"/></Peers></Discovery>
</Domain></CycloneDDS>"""
"""Configuration for local communication."""

_LARGEST_DOMAIN = 232  # whose ports are below 65,536
_MOST = 1000  # messages taken at once
_SERVICE = QoS(depth=10)
_BLOCK = 0.1  # s, wait of a writer for slow readers
_ANY = ViewState.Any | InstanceState.Any | SampleState.Any
_domains: dict[int, Domain] = {}  # configured by this process; a domain can be configured once


def _local_only() -> bool:
    """Whether ROS 2 is restricted to this computer, without a configuration of CycloneDDS."""
    told = os.environ.get("ROS_LOCALHOST_ONLY") == "1"
    told = told or os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "").upper() == "LOCALHOST"
    return told and "CYCLONEDDS_URI" not in os.environ


class CycloneTransport:
    """DDS participant with the topics and services of a ROS 2 node.

    The network is that of `CYCLONEDDS_URI`; without it, `ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST` or
    `ROS_LOCALHOST_ONLY=1` restrict it to this computer. Services are encoded as in rmw_cyclonedds.
    """

    def __init__(self, domain: int | None = None):
        """Join a domain, by default that of `ROS_DOMAIN_ID`.

        Raises:
            ValueError: a domain that is not an integer from 0 to 232, or cannot be joined.
        """
        given: Any = (os.environ.get("ROS_DOMAIN_ID") or "0") if domain is None else domain
        number = int(given) if isinstance(given, str) and given.isdecimal() else given
        check_at_most("ROS_DOMAIN_ID" if domain is None else "domain", number, _LARGEST_DOMAIN, 0)
        if _local_only() and number not in _domains:
            _domains[number] = Domain(number, LOOPBACK)
        try:
            self._participant = DomainParticipant(number)
        except DDSException as error:
            raise UserError(f"domain {number} of ROS 2 cannot be joined: {error}; check CYCLONEDDS_URI") from error
        self._wake = WaitSet(self._participant)
        self._readers: list[tuple[DataReader, type, Callable[[Any], None]]] = []
        self._services: list[tuple[DataReader, DataWriter, Answer]] = []
        self._clients: dict[str, tuple[DataWriter, DataReader]] = {}
        self._writers: dict[str, DataWriter] = {}
        self._topics: dict[str, tuple[Topic, bool]] = {}  # by DDS name, and whether it is published here
        self._ends: list[tuple[Any, bool]] = []  # discovered, and whether they publish
        self._objections: list[str] = []
        self._said: set[str] = set()
        self._guid, self._seq = random.getrandbits(63), 0
        self._peers = [
            (BuiltinDataReader(self._participant, BuiltinTopicDcpsPublication), True),
            (BuiltinDataReader(self._participant, BuiltinTopicDcpsSubscription), False),
        ]
        self._conditions = [self._watch(reader) for reader, _ in self._peers]

    def publisher(self, topic: Topic) -> Callable[[msg.Message], None]:
        """Function that publishes messages."""
        name = f"rt/{topic.name}"
        self._topics[name] = topic, True
        writer = self._writer(name, idl.idl_type(topic.type), topic.qos)
        self._writers[topic.name] = writer

        def publish(message: msg.Message) -> None:
            try:
                writer.write(idl.encode(message))
            except DDSException as error:
                if error.code != DDSException.DDS_RETCODE_TIMEOUT:
                    raise
                self._objections.append(f"a subscriber of /{topic.name} does not keep up; it loses messages")

        return publish

    def subscribe(self, topic: Topic, receive: Callable[[Any], None]) -> None:
        """Call a function with every message of a topic."""
        name, kind = f"rt/{topic.name}", idl.idl_type(topic.type)
        self._topics[name] = topic, False
        reader = self._reader(name, kind, topic.qos)
        self._readers.append((reader, kind, lambda sample: receive(msg.decode(topic.type, sample))))

    def serve(self, name: str, answer: Answer) -> None:
        """Offer a service. Messages before a request are delivered before its answer."""
        reader = self._reader(f"rq/{name}Request", idl.REQUEST, _SERVICE)
        self._services.append((reader, self._writer(f"rr/{name}Reply", idl.REPLY, _SERVICE), answer))

    def call(self, name: str, timeout: float) -> tuple[bool, str]:
        """Call a service of another process.

        Raises:
            TimeoutError: no answer within `timeout` s.
        """
        end = time.monotonic() + timeout
        if name not in self._clients:
            writer = self._writer(f"rq/{name}Request", idl.REQUEST, _SERVICE)
            replies = self._reader(f"rr/{name}Reply", idl.REPLY, _SERVICE)
            there = self._connect(writer, idl.REQUEST(0, 0, 0), timeout)
            while there and not replies.get_matched_publications():
                there = time.monotonic() < end
                self.spin(0.01)
            if not there:
                raise TimeoutError(f"no server of the service {name!r} within {timeout:g} s; is the node there?")
            self._clients[name] = writer, replies
        writer, replies = self._clients[name]
        self._seq += 1
        writer.write(idl.REQUEST(guid=self._guid, seq=self._seq, structure_needs_at_least_one_member=0))
        while True:
            for reply in _taken(replies, idl.REPLY):
                if (reply.guid, reply.seq) == (self._guid, self._seq):
                    return reply.success, reply.message
            left = end - time.monotonic()
            if left < 0:
                raise TimeoutError(f"the service {name!r} did not answer within {timeout:g} s")
            self.spin(left)

    def connect(self, topic: Topic, timeout: float) -> bool:
        """Wait at most `timeout` s for a connected subscriber; return whether there is one."""
        return self._connect(self._writers[topic.name], idl.encode(msg.message_class(topic.type)()), timeout)

    def _connect(self, writer: DataWriter, sample: Any, timeout: float) -> bool:
        """Wait until a reader has discovered a writer.

        Until then a reader misses messages. The writer sends a dispose note, which is not delivered, and waits for its
        acknowledgment.
        """
        end = time.monotonic() + timeout
        while not writer.get_matched_subscriptions():
            if time.monotonic() > end:
                return False
            self.spin(0.01)
        writer.dispose(sample)
        return _acknowledged(writer, end - time.monotonic())

    def flush(self, timeout: float) -> bool:
        """Wait at most `timeout` s for delivery to all readers; return whether it succeeded."""
        end = time.monotonic() + timeout
        return all(_acknowledged(writer, end - time.monotonic()) for writer in self._writers.values())

    def spin(self, timeout: float) -> None:
        """Deliver received messages; wait up to `timeout` s for one."""
        self._wake.wait(duration(seconds=max(timeout, 1e-6)))
        requests = [(request, *service) for service in self._services for request in _taken(service[0], idl.REQUEST)]
        for reader, kind, receive in self._readers:
            for sample in _taken(reader, kind):
                receive(sample)
        for reader, publishes in self._peers:
            self._ends += [(end, publishes) for end in reader.take(_MOST)]
        for request, _, replies, answer in requests:
            success, message = answer()
            replies.write(idl.REPLY(guid=request.guid, seq=request.seq, success=success, message=message))

    def complaints(self) -> list[str]:
        """New mismatches with endpoints of other processes, such as another type."""
        ends = [(end, way) for end, way in self._ends if getattr(end, "topic_name", None) in self._topics]
        texts = self._objections + [text for end, way in ends if (text := self._mismatch(end, way))]
        found = [text for text in dict.fromkeys(texts) if text not in self._said]
        self._said.update(found)
        self._ends, self._objections = [], []
        return found

    def close(self) -> None:
        """Leave the network."""
        self._readers, self._services, self._peers, self._conditions = [], [], [], []
        self._clients, self._writers = {}, {}
        del self._wake, self._participant

    def _mismatch(self, end: Any, publishes: bool) -> str | None:
        """Mismatch of an endpoint of another process with its topic here."""
        topic, published = self._topics[end.topic_name]
        does = "publishes" if publishes else "subscribes to"
        who = f"a peer {does} /{topic.name}"
        if end.type_name != idl.dds_name(topic.type):
            return f"{who} as {_ros_name(end.type_name)}; its type is {topic.type}"
        if publishes and not published and Policy.Reliability.BestEffort in end.qos:
            return f"{who} as best effort, and the node asks for reliable messages; publish reliably"
        if not publishes and published and not topic.qos.reliable and Policy.Reliability.BestEffort not in end.qos:
            return f"{who} reliably, and the node publishes as best effort; subscribe as best effort (sensor data)"
        if not publishes and published and Policy.Durability.Volatile not in end.qos:
            return f"{who} and asks for messages of the past (transient local); subscribe with volatile durability"
        return None

    def _writer(self, name: str, kind: Any, qos: QoS) -> DataWriter:
        return DataWriter(self._participant, DdsTopic(self._participant, name, kind), qos=_dds_qos(qos))

    def _reader(self, name: str, kind: Any, qos: QoS) -> DataReader:
        reader = DataReader(self._participant, DdsTopic(self._participant, name, kind), qos=_dds_qos(qos))
        self._conditions.append(self._watch(reader))
        return reader

    def _watch(self, reader: Any) -> ReadCondition:
        condition = ReadCondition(reader, _ANY)
        self._wake.attach(condition)
        return condition


def _dds_qos(qos: QoS) -> Qos:
    reliability = (
        Policy.Reliability.Reliable(duration(seconds=_BLOCK)) if qos.reliable else Policy.Reliability.BestEffort
    )
    return Qos(reliability, Policy.Durability.Volatile, Policy.History.KeepLast(qos.depth))


def _acknowledged(writer: DataWriter, timeout: float) -> bool:
    """Wait at most `timeout` s for the acknowledgments of all readers of a writer."""
    try:
        return writer.wait_for_acks(duration(seconds=max(timeout, 1e-3)))
    except AttributeError:  # cyclonedds 11.0.1 looks for the code of a timeout in Python's own Exception
        return False


def _taken(reader: DataReader, kind: type) -> list[Any]:
    """Pending messages of a reader, without dispose notes."""
    return [sample for sample in reader.take(_MOST) if isinstance(sample, kind)]


def _ros_name(dds: str) -> str:
    return dds.replace("::dds_::", "/").replace("::", "/").removesuffix("_")
