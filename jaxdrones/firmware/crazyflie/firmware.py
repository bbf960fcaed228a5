"""Simulated Crazyflie: its answers to packets, and its flight in steps of 10 ms."""

import dataclasses
import struct
from collections.abc import Callable, Hashable, Iterator

from jaxdrones.firmware.crazyflie.commander import Commander
from jaxdrones.firmware.crazyflie.high_level import MEMORY_BYTES, HighLevel
from jaxdrones.firmware.crazyflie.log import Log
from jaxdrones.firmware.crazyflie.packet import ENOENT, Packet, Port
from jaxdrones.firmware.crazyflie.parameters import Parameters
from jaxdrones.firmware.crazyflie.supervisor import Supervisor
from jaxdrones.firmware.crazyflie.variables import Readings
from jaxdrones.firmware.crazyflie.vehicle import PERIOD, Target, Vehicle, motors_off

PROTOCOL = 12
"""Version of CRTP: the first with a port of the supervisor."""
_SOURCE = b"Bitcraze Crazyflie".ljust(30, b"\0")
_HELLO = b"jaxdrones: a simulated Crazyflie\n"
_TRAJECTORIES = 0x12  # type of a memory
_MOST_READ = 24  # bytes of a memory in a packet
_SILENT_AFTER = 5.0  # s of real time after which a client is gone
_MOST_CLIENTS = 8
_EMERGENCY, _EMERGENCY_WATCHDOG = 3, 4


@dataclasses.dataclass
class _Client:
    """Client of the link."""

    heard: float
    """Time of its last packet, s of real time."""
    log: Log = dataclasses.field(default_factory=Log)


class Crazyflie:
    """Vehicle, its controller and its protocol, without a link.

    The commander and the parameters are shared by all clients; each has log blocks of its own.
    """

    def __init__(self, vehicle: Vehicle):
        """Start on the ground; the vehicle must not be used elsewhere."""
        self.vehicle = vehicle
        self.rows = 0
        """Number of simulated periods of 10 ms."""
        self.parameters = Parameters(vehicle.gains, self._set_gains)
        self.high_level = HighLevel(self.parameters.values)
        self.commander = Commander(self.parameters, self.high_level)
        self.supervisor = Supervisor()
        self.target: Target = motors_off()
        self._clients: dict[Hashable, _Client] = {}
        self._answers: dict[int, Callable[[_Client, int, bytes], bytes | None]] = {
            Port.PARAMETERS: lambda client, channel, data: self.parameters.answer(channel, data),
            Port.SETPOINT: lambda client, channel, data: self.commander.rpyt(data, self.time),
            Port.MEMORY: self._answer_memory,
            Port.LOG: lambda client, channel, data: client.log.answer(channel, data),
            Port.LOCALIZATION: self._hear_position,
            Port.GENERIC_SETPOINT: lambda client, channel, data: self.commander.generic(channel, data, self.time),
            Port.HIGH_LEVEL: lambda client, channel, data: self.commander.plan(data, self.time, vehicle.sample),
            Port.SUPERVISOR: lambda client, channel, data: self.supervisor.answer(
                channel, data, self.time, self.status
            ),
            Port.PLATFORM: self._answer_platform,
            Port.LINK: lambda client, channel, data: {0: data, 1: _SOURCE}.get(channel),
        }

    @property
    def time(self) -> float:
        """Simulated time, s."""
        return self.rows * PERIOD

    @property
    def status(self) -> int:
        """State bits of the supervisor."""
        planned = self.high_level.trajectory is not None
        return self.supervisor.status(self.vehicle.sample, planned, self.high_level.finished(self.time))

    def answer(self, packet: Packet, client: Hashable, now: float) -> Iterator[Packet]:
        """Answers to a packet of a client at a real time (s)."""
        if client not in self._clients:
            if len(self._clients) >= _MOST_CLIENTS:
                return
            self._clients[client] = _Client(now)
            yield Packet(Port.CONSOLE, 0, _HELLO[:30])
            yield Packet(Port.CONSOLE, 0, _HELLO[30:])
        self._clients[client].heard = now
        port, channel, data = packet
        handler = self._answers.get(port)
        answer = handler(self._clients[client], channel, data) if handler else None
        if answer:
            yield Packet(port, channel, answer)

    def advance(self, now: float) -> Iterator[tuple[Hashable, Packet]]:
        """Fly for 10 ms; log packets of each client. Clients silent for 5 s of real time are dropped."""
        wanted = self.commander.target(self.time)
        self.target = wanted if self.supervisor.can_fly else motors_off()
        if not self.supervisor.can_fly:
            self.commander.off()
        if self.supervisor.recovery_asked:
            self.vehicle.set_upright()
            self.supervisor.recovery_asked = False
        sample = self.vehicle.advance(self.target)
        self.rows += 1
        self.supervisor.watch(sample, self.time, PERIOD)
        self._clients = {name: c for name, c in self._clients.items() if now - c.heard < _SILENT_AFTER}
        readings = Readings(sample, self.target, self.status)
        for name, client in self._clients.items():
            for packet in client.log.rows(self.rows, readings):
                yield name, packet

    def forget(self, client: Hashable) -> None:
        """Drop a client whose address does not exist any more."""
        self._clients.pop(client, None)

    def _set_gains(self, gains) -> None:
        self.vehicle.gains = gains

    def _answer_platform(self, client: _Client, channel: int, data: bytes) -> bytes | None:
        if channel == 1 and data[:1] == b"\0":
            return bytes([0, PROTOCOL])
        if channel == 1 and data[:1] == b"\1":
            return b"\1jaxdrones\0"
        if channel == 0 and len(data) == 2 and data[0] == 1:  # arming before the port of the supervisor
            return self.supervisor.answer(1, data, self.time, self.status) and data
        return data if channel == 0 else None

    def _hear_position(self, client: _Client, channel: int, data: bytes) -> None:
        """Emergency stops; external positions are ignored, because the state is known."""
        if channel == 1 and data[:1] in (bytes([_EMERGENCY]), bytes([_EMERGENCY_WATCHDOG])):
            self.supervisor.emergency(data[0] == _EMERGENCY_WATCHDOG, self.time)

    def _answer_memory(self, client: _Client, channel: int, data: bytes) -> bytes | None:
        """Number and description of memories, of which there is one, for trajectories; reading and writing."""
        if channel == 0:
            if data[:1] == b"\1":
                return bytes([1, 1])
            if data == b"\2\0":
                return struct.pack("<BBBI8x", 2, 0, _TRAJECTORIES, MEMORY_BYTES)
            return data[:2] if data[:1] == b"\2" else None
        if len(data) < 5:
            return None
        number, address = struct.unpack("<BI", data[:5])
        size = data[5] if channel == 1 and len(data) == 6 else len(data) - 5
        most = {1: _MOST_READ, 2: MEMORY_BYTES}.get(channel, -1)  # a write is as long as its packet
        if number != 0 or address + size > MEMORY_BYTES or size > most:
            return data[:5] + bytes([ENOENT])
        memory = self.high_level.memory
        if channel == 1:
            return data[:5] + b"\0" + bytes(memory[address : address + size])
        memory[address : address + size] = data[5:]
        return data[:5] + b"\0"
