"""Sockets between a simulator and Betaflight's SITL, on the loopback address."""

import contextlib
import select
import socket
from typing import Any

import numpy as np

from jaxdrones.errors import UserError
from jaxdrones.firmware.betaflight.packets import MOTOR_PORT, MSP_PORT, RC_PORT, STATE_PORT, motor_outputs

HOST = "127.0.0.1"


class Link(contextlib.AbstractContextManager["Link"]):
    """Datagrams to and from Betaflight; its ports are fixed, so there is one flight on a computer at a time."""

    def __init__(self) -> None:
        """Open the port of the motors.

        Raises:
            UserError: a port in use.
        """
        self._motors = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._motors.bind((HOST, MOTOR_PORT))
        except OSError as error:
            self.close()
            raise UserError(
                f"port {MOTOR_PORT} of the motors cannot be opened: {error.strerror}; end the other simulator"
            ) from None
        self._motors.setblocking(False)

    def __exit__(self, *_: Any) -> None:
        self.close()

    def close(self) -> None:
        """Close the sockets."""
        self._motors.close()
        self._sender.close()

    def send_state(self, packet: bytes) -> None:
        """Send a state packet."""
        self._send(packet, STATE_PORT)

    def send_sticks(self, packet: bytes) -> None:
        """Send a packet of the receiver."""
        self._send(packet, RC_PORT)

    def outputs(self, wait: float = 0.0) -> list[np.ndarray]:
        """Motor outputs (4,) that have arrived, oldest first; for at most `wait` (s) until there are some."""
        found = []
        ready = select.select([self._motors], [], [], wait)[0]
        while ready:
            try:
                outputs = motor_outputs(self._motors.recv(2048))
            except OSError:
                break
            if outputs is not None:
                found.append(outputs)
        return found

    def _send(self, packet: bytes, port: int) -> None:
        with contextlib.suppress(OSError):  # nobody listens
            self._sender.sendto(packet, (HOST, port))


def connect_msp() -> socket.socket | None:
    """Connection of MSP; `None` without a flight controller."""
    try:
        return socket.create_connection((HOST, MSP_PORT), timeout=1.0)
    except OSError:
        return None
