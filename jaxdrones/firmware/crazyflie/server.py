"""Link of a simulated Crazyflie over UDP, and its flight in real time."""

import contextlib
import dataclasses
import select
import socket
import time
from collections.abc import Callable
from typing import Any

from jaxdrones.errors import UserError
from jaxdrones.firmware.crazyflie.firmware import Crazyflie
from jaxdrones.firmware.crazyflie.packet import NULL, decode, encode
from jaxdrones.firmware.crazyflie.vehicle import PERIOD, Sample, Target
from jaxdrones.firmware.drone import LATE, Pace

HOST = "127.0.0.1"
PORT = 19850
"""First of the ten ports that cflib scans."""
_MOST_AT_ONCE = 200  # packets between two periods


@dataclasses.dataclass
class Flown(Pace):
    """Statistics of a flight."""

    received: int = 0
    sent: int = 0
    invalid: int = 0
    """Datagrams that are no packets."""


class Server(contextlib.AbstractContextManager["Server"]):
    """Socket of a simulated Crazyflie, on the loopback address only."""

    def __init__(self, crazyflie: Crazyflie, port: int = PORT):
        """Open the port.

        Raises:
            UserError: a port in use.
        """
        self._crazyflie = crazyflie
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind((HOST, port))
        except OSError as error:
            self._socket.close()
            raise UserError(f"port {port} cannot be opened: {error.strerror}; choose another one") from None
        self._socket.setblocking(False)
        self.port: int = self._socket.getsockname()[1]
        self.flown = Flown()

    def __exit__(self, *_: Any) -> None:
        self._socket.close()

    def run(
        self,
        duration: float | None = None,
        speed: float = 1.0,
        on_row: Callable[[float, Sample, Target], None] = lambda t, sample, target: None,
    ) -> Flown:
        """Fly and answer packets for a simulated time (s), by default until it is interrupted.

        The clocks of scripts do not follow the real-time factor `speed`. `on_row` is called with time (s), measurements
        and set-point every 10 ms of simulated time.
        """
        begin = due = time.monotonic()
        rows = 0
        while duration is None or rows * PERIOD < duration - 1e-9:
            due += PERIOD / speed
            self._serve_until(due)
            for client, packet in self._crazyflie.advance(time.monotonic()):
                self._send(encode(packet), client)
            rows += 1
            on_row(self._crazyflie.time, self._crazyflie.vehicle.sample, self._crazyflie.target)
            now = time.monotonic()
            self.flown.simulated_s, self.flown.real_s = rows * PERIOD, now - begin
            if now > due + LATE:
                self.flown.late += 1
                due = now
        return self.flown

    def _serve_until(self, due: float) -> None:
        """Answer packets until a time (s), and those that wait then."""
        for _ in range(_MOST_AT_ONCE):
            if not select.select([self._socket], [], [], max(due - time.monotonic(), 0))[0]:
                return
            self._receive()
        time.sleep(max(due - time.monotonic(), 0))

    def _receive(self) -> None:
        try:
            datagram, client = self._socket.recvfrom(2048)
        except OSError:  # a client's port was closed, or there is no datagram after all
            return
        self.flown.received += 1
        if datagram == NULL:
            self._send(NULL, client)
            return
        packet = decode(datagram)
        if packet is None:
            self.flown.invalid += 1
            return
        for answer in self._crazyflie.answer(packet, client, time.monotonic()):
            self._send(encode(answer), client)

    def _send(self, datagram: bytes, client: Any) -> None:
        try:
            self._socket.sendto(datagram, client)
            self.flown.sent += 1
        except OSError:
            self._crazyflie.forget(client)
