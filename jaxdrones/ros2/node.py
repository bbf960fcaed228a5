"""ROS 2 node of a simulated team, in real time or in lockstep."""

import dataclasses
import functools
import time
from collections.abc import Callable, Hashable
from typing import Any

from jaxdrones.errors import UserError
from jaxdrones.ros2 import convert, topics
from jaxdrones.ros2 import messages as msg
from jaxdrones.ros2.bag import Recorder
from jaxdrones.ros2.command import Mode
from jaxdrones.ros2.failsafe import Failsafe, PeerLost, Watch, hover, sink
from jaxdrones.ros2.simulation import Simulation
from jaxdrones.ros2.topics import Topic, Transport
from jaxdrones.sensing import Camera

_LATE = 0.1  # s, largest lag behind the clock before the schedule restarts
_FAREWELL = 2.0  # s, timeout of the last messages


@dataclasses.dataclass
class Flown:
    """Statistics of a flight."""

    steps: int = 0
    published: int = 0
    received: int = 0
    """Valid commands."""
    refused: int = 0
    late: int = 0
    """Number of times that the flight fell behind the clock by 0.1 s."""
    lost: int = 0
    """Number of expired timeouts of commands or of steps in lockstep."""
    landed: bool = False


class Node:
    """Node that publishes the state of a team and executes received commands.

    In real time the flight follows the clock. In lockstep it advances by one control step for each call of the service
    `topics.STEP_SERVICE`, and answers once the messages of that step are published.
    """

    def __init__(
        self,
        simulation: Simulation,
        transport: Transport,
        *,
        lockstep: bool = False,
        failsafe: Failsafe | None = None,
        speed: float = 1.0,
        camera: Camera | None = None,
        recorder: Recorder | None = None,
        warn: Callable[[str], None] = lambda text: None,
        clock: Callable[[], float] = time.monotonic,
    ):
        """Offer the topics of a team.

        Args:
            simulation: team in flight.
            transport: transport of messages, closed by the caller.
            lockstep: whether the flight waits for the step service.
            failsafe: action without commands, which must be repeated within the timeout. In lockstep the timeout is
                    that of the step service.
            speed: real-time factor.
            camera: on every drone, at its `rate` or every control step; by default no images.
            recorder: recorder of all messages.
            warn: function of a line of text for warnings.
            clock: time, s.

        Raises:
            UserError: a camera with more images than control steps.
        """
        if camera is not None and camera.rate is not None and camera.rate > simulation.control_hz:
            raise UserError(
                f"the rate of the camera is {camera.rate:g} images/s; give at most the control rate, "
                f"{simulation.control_hz}"
            )
        self._flight, self._transport, self._lockstep = simulation, transport, lockstep
        self._failsafe = failsafe or Failsafe()
        self._speed, self._camera, self._recorder = speed, camera, recorder
        self._warn, self._clock = warn, clock
        self.flown = Flown()
        self._publishers: dict[str, Callable[[msg.Message], None]] = {}
        self._publishers[topics.CLOCK.name] = transport.publisher(topics.CLOCK)
        for i in range(simulation.drones):
            for name in topics.OUTPUTS:
                if self._has(name):
                    topic = topics.output(i, name)
                    self._publishers[topic.name] = transport.publisher(topic)
            for name in topics.COMMANDS:
                topic = topics.command(i, name)
                transport.subscribe(topic, functools.partial(self._receive, i, name, topic))
        if lockstep:
            transport.serve(topics.STEP_SERVICE, self._answer)
        self._said: set[Hashable] = set()

    def run(self, duration: float | None = None) -> Flown:
        """Fly until the simulated time `duration` (s), by default forever, or until all drones have landed.

        Raises:
            PeerLost: missing or invalid commands with the failsafe `stop`.
        """
        steps = None if duration is None else round(duration * self._flight.control_hz)
        now = self._clock()
        self._watches = [Watch(self._failsafe, now) for _ in range(self._flight.drones)]
        self._stepper, self._due = Watch(self._failsafe, now), now
        self._publish()
        try:
            while not self.flown.landed and (steps is None or self.flown.steps < steps):
                if self._lockstep and not self._stepper.lost:
                    self._await_stepper()
                else:
                    self._await_clock()
                for text in self._transport.complaints():
                    self._object(text, text)
        finally:
            self._transport.flush(_FAREWELL)
        return self.flown

    def _has(self, name: str) -> bool:
        if name.startswith("camera/"):
            return self._camera is not None
        return name != "battery" or self._flight.has_battery

    def _receive(self, i: int, name: str, topic: Topic, message: Any) -> None:
        if self._recorder is not None:
            self._recorder.write(topic, message, self._flight.ns)
        try:
            command = convert.to_command(name, message)
        except convert.Refused as error:
            self.flown.refused += 1
            self._object(f"a message on /{topic.name} is rejected: {error}", (topic.name, error.kind))
            return
        self.flown.received += 1
        self._flight.commands[i] = command
        if self._watches[i].hear(self._clock()):
            self._warn(f"commands for {topics.drone(i)} arrive; it follows them")

    def _answer(self) -> tuple[bool, str]:
        """Step service: one control step; the answer has the simulated time."""
        if self._stepper.hear(self._clock()):
            self._warn("the step service is called again; the flight is in lockstep")
            for watch in self._watches:
                watch.lost = False
        self._step()
        now = convert.stamp(self._flight.ns)
        return True, f"{now.sec}.{now.nanosec:09d}"

    def _await_stepper(self) -> None:
        self._transport.spin(max(self._stepper.remaining(self._clock()), 0))
        if self._stepper.lose(self._clock()):
            self.flown.lost += 1
            silent = f"the step service was not called for {self._stepper.limit:g} s"
            self._give_up(silent, "the flight continues by the clock")
            self._due = self._clock()
            for i, watch in enumerate(self._watches):
                watch.lost = True  # until a command arrives, which is followed by the clock
                self._flight.commands[i] = hover(self._flight.commands[i], self._flight.state, i)

    def _await_clock(self) -> None:
        dt = 1 / self._flight.control_hz
        self._due += dt / self._speed
        while True:
            self._transport.spin(max(self._due - self._clock(), 0))
            if self._clock() >= self._due:
                break
        if self._lockstep and not self._stepper.lost:  # called in the meantime
            return
        self._guard(dt)
        self._step()
        if self._clock() > self._due + _LATE:
            self.flown.late += 1
            self._due = self._clock()

    def _guard(self, dt: float) -> None:
        """Apply the failsafe to drones without commands."""
        flight, now = self._flight, self._clock()
        down = 0
        for i, watch in enumerate(self._watches):
            if watch.lose(now):
                self.flown.lost += 1
                silent = f"no command for {topics.drone(i)} for {watch.limit:g} s"
                self._give_up(silent, f"it {self._failsafe.action}s")
                flight.commands[i] = hover(flight.commands[i], flight.state, i)
            if self._failsafe.action == "land" and watch.lost:
                flight.commands[i] = sink(flight.commands[i], flight.params, flight.state, i, dt)
                down += int(flight.commands[i].mode == Mode.MOTORS)
        self.flown.landed = down == flight.drones

    def _give_up(self, what: str, then: str) -> None:
        if self._failsafe.action == "stop":
            raise PeerLost(f"{what}; the flight stops by its failsafe 'stop'")
        self._warn(f"{what}; {then}")

    def _object(self, text: str, kind: Hashable) -> None:
        """Warn once for each kind of problem with a peer, or stop."""
        if kind not in self._said:
            self._said.add(kind)
            self._give_up(text, "the flight continues without it")

    def _step(self) -> None:
        self._flight.advance()
        self.flown.steps += 1
        self._publish()

    def _publish(self) -> None:
        flight, ns = self._flight, self._flight.ns
        self._send(topics.CLOCK, msg.Clock(convert.stamp(ns)))
        now = flight.measure()
        for i in range(flight.drones):
            for name, message in convert.state_messages(now, i, ns).items():
                self._send(topics.output(i, name), message)
        if self._camera is not None and self._image_is_due(self._camera):
            for i, picture in enumerate(flight.images(self._camera)):
                for name, message in convert.image_messages(picture, self._camera, i, ns).items():
                    self._send(topics.output(i, name), message)

    def _image_is_due(self, camera: Camera) -> bool:
        if camera.rate is None:
            return True
        per_step, k = camera.rate / self._flight.control_hz, self._flight.steps
        return k == 0 or int(k * per_step + 1e-6) > int((k - 1) * per_step + 1e-6)

    def _send(self, topic: Topic, message: msg.Message) -> None:
        self._publishers[topic.name](message)
        self.flown.published += 1
        if self._recorder is not None:
            self._recorder.write(topic, message, self._flight.ns)
