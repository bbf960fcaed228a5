"""A transport within one process, with a clock that only spinning moves: quick, and without sockets."""

from collections import defaultdict

import numpy as np

from jaxdrones import State, rotation
from jaxdrones.ros2 import convert, topics
from jaxdrones.ros2 import messages as msg


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

    def flush(self, timeout):
        pass

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


class Peer:
    """Who commands the team on a wire, and reads its latest state there."""

    def __init__(self, wire, drones=2):
        self.wire, self.team, self.transport = wire, range(drones), InProcess(wire)

    def send(self, i, name, message):
        self.transport.publisher(topics.command(i, name))(message)

    def fly_to(self, pos, yaw=0.0):
        turned = msg.Quaternion(z=float(np.sin(yaw / 2)), w=float(np.cos(yaw / 2)))
        for i, target in zip(self.team, np.asarray(pos, float).tolist(), strict=True):
            self.send(i, "cmd_pose", msg.PoseStamped(pose=msg.Pose(msg.Point(*target), turned)))

    def step(self):
        done, _ = self.wire.services[topics.STEP_SERVICE]()
        assert done
        return self.state()

    def state(self):
        return from_messages([{name: self.latest(i, name) for name in ("odom", "motors")} for i in self.team])

    def latest(self, i, name):
        return self.wire.sent[topics.output(i, name).name][-1]


def from_messages(sent):
    """State of a team from the messages of its drones; the inverse of `convert.state_messages`."""
    odom = [messages["odom"] for messages in sent]
    quat = np.array([convert.numbers(m.pose.pose.orientation) for m in odom])
    vel = np.array([convert.numbers(m.twist.twist.linear) for m in odom])
    return State(
        pos=np.array([convert.numbers(m.pose.pose.position) for m in odom]),
        quat=quat,
        vel=np.stack([rotation.to_matrix(q) @ v for q, v in zip(quat, vel, strict=True)]),
        omega=np.array([convert.numbers(m.twist.twist.angular) for m in odom]),
        rpm=np.array([messages["motors"].data for messages in sent]),
    )


def positions(wire, i):
    return [message.pose.position for message in wire.sent[topics.output(i, "pose").name]]
