"""A transport within one process, with a clock that only spinning moves: quick, and without sockets."""

from collections import defaultdict

from jaxdrones.ros2 import topics


class Wire:
    """What the transports on it share: the clock, s, and what is on its way."""

    def __init__(self):
        self.now = 0.0
        self.subscribers = defaultdict(list)
        self.services = {}
        self.sent = defaultdict(list)
        self.script = []  # (time, function): what other processes do

    def clock(self):
        return self.now


class InProcess:
    """Messages arrive at once; a spin advances the clock to the next event of the script, or by its timeout."""

    def __init__(self, wire):
        self.wire = wire

    def publisher(self, topic):
        def publish(message):
            assert message.NAME == topic.type
            self.wire.sent[topic.name].append(message)
            for receive in self.wire.subscribers[topic.name]:
                receive(message)

        return publish

    def subscribe(self, topic, receive):
        self.wire.subscribers[topic.name].append(receive)

    def serve(self, name, answer):
        self.wire.services[name] = answer

    def call(self, name, timeout):
        if name not in self.wire.services:
            raise TimeoutError(f"no server of the service {name!r}")
        return self.wire.services[name]()

    def connect(self, topic, timeout):
        return topic.name in self.wire.subscribers

    def flush(self, timeout):
        return True

    def spin(self, timeout):
        end = self.wire.now + timeout
        if self.wire.script and self.wire.script[0][0] <= end:
            time, do = self.wire.script.pop(0)
            self.wire.now = max(time, self.wire.now)
            do()
        else:
            self.wire.now = end + 1e-9

    def complaints(self):
        found, self.wire.wrong = getattr(self.wire, "wrong", []), []
        return found

    def close(self):
        pass


def positions(wire, i):
    return [message.pose.position for message in wire.sent[topics.output(i, "pose").name]]
