"""MSP, Betaflight's protocol of settings and status, over TCP."""

import functools
import operator
import socket
import time
from collections.abc import Callable, Iterator
from typing import NamedTuple

VARIANT, VERSION = 2, 3
RC_TUNING, STATUS, SET_RC_TUNING, SET_MODE_RANGE, SET_MIXER = 111, 150, 204, 35, 43
FAILSAFE, SET_FAILSAFE, SET_RX_FAIL, EEPROM_WRITE = 75, 76, 78, 250
ADVANCED, SET_ADVANCED, FILTERS, SET_FILTERS = 90, 91, 92, 93
PID, SET_PID = 112, 202
_HEAD, _TO, _FROM, _ERROR = b"$M", b"<", b">", b"!"
_TIMEOUT = 1.0  # s for an answer
_TRIES = 3


class Frame(NamedTuple):
    """Message of MSP."""

    command: int
    data: bytes
    failed: bool = False
    """Whether the request was rejected."""


class NoAnswer(Exception):
    """Missing answer, or rejected request."""


def encode(command: int, data: bytes = b"", direction: bytes = _TO) -> bytes:
    """Bytes of a request, or with another direction of an answer; `data` has at most 254 bytes."""
    body = bytes([len(data), command]) + data
    return _HEAD + direction + body + bytes([_checksum(body)])


def _checksum(body: bytes) -> int:
    return functools.reduce(operator.xor, body)


class Decoder:
    """Decoder of a stream; it skips bytes that are no answers."""

    def __init__(self) -> None:
        self._rest = b""

    def feed(self, data: bytes) -> Iterator[Frame]:
        """Answers that the next bytes complete."""
        self._rest += data
        while (at := self._rest.find(_HEAD)) >= 0:
            head = self._rest[at:]
            answers = head[2:3] in (_FROM, _ERROR)
            if len(head) < 3 or (answers and (len(head) < 6 or len(head) < 6 + head[3])):
                self._rest = head
                return
            if not answers or _checksum(head[3 : 5 + head[3]]) != head[5 + head[3]]:
                self._rest = head[2:]
                continue
            body = head[3 : 5 + head[3]]
            self._rest = head[6 + head[3] :]
            yield Frame(body[1], body[2:], head[2:3] == _ERROR)
        self._rest = self._rest[-1:]  # which may begin a frame


class Client:
    """Connection to a flight controller."""

    def __init__(self, connection: socket.socket, idle: Callable[[], None] = lambda: time.sleep(0.001)):
        """Use a connected socket, which the caller closes.

        While an answer is awaited, `idle` is called again and again; it takes about a millisecond.
        """
        self._socket, self._idle, self._decoder = connection, idle, Decoder()
        self._socket.setblocking(False)

    def request(self, command: int, data: bytes = b"") -> bytes:
        """Answer to a request.

        Raises:
            NoAnswer: three times no answer within a second, or a rejected request.
        """
        for _ in range(_TRIES):
            try:
                self._socket.sendall(encode(command, data))
                end = time.monotonic() + _TIMEOUT
                while time.monotonic() < end:
                    self._idle()
                    for frame in self._decoder.feed(self._received()):
                        if frame.command == command:
                            if frame.failed:
                                raise NoAnswer(f"Betaflight rejected MSP request {command}")
                            return frame.data
            except OSError as error:
                raise NoAnswer(f"Betaflight closed the MSP connection ({error.strerror or error})") from None
        raise NoAnswer(f"Betaflight did not answer MSP request {command} within {_TIMEOUT:g} s, {_TRIES} times")

    def _received(self) -> bytes:
        try:
            data = self._socket.recv(4096)
        except BlockingIOError:
            return b""
        if not data:
            raise ConnectionResetError(0, "end of the stream")
        return data
