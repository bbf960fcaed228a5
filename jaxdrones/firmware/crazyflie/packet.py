"""Packets of CRTP, the Crazyflie's protocol: one in each datagram, with a header of one byte."""

import enum
from typing import NamedTuple

MAX_DATA = 30
"""Largest payload, bytes."""
NULL = b"\xff"
"""Packet without content, which is also a probe for vehicles."""
ENOENT, ENOEXEC, E2BIG, ENOMEM, EEXIST = 2, 8, 7, 12, 17
"""Error numbers of answers."""
_RESERVED = 0b1100


class Port(enum.IntEnum):
    """Subsystem of a packet."""

    CONSOLE = 0
    PARAMETERS = 2
    SETPOINT = 3
    MEMORY = 4
    LOG = 5
    LOCALIZATION = 6
    GENERIC_SETPOINT = 7
    HIGH_LEVEL = 8
    SUPERVISOR = 9
    PLATFORM = 13
    LINK = 15


class Packet(NamedTuple):
    """Packet of a port and one of its four channels."""

    port: int
    channel: int
    data: bytes


def encode(packet: Packet) -> bytes:
    """Datagram of a packet."""
    return bytes([packet.port << 4 | _RESERVED | packet.channel]) + packet.data


def decode(datagram: bytes) -> Packet | None:
    """Packet in a datagram; `None` if it is empty or too long."""
    if not 1 <= len(datagram) <= 1 + MAX_DATA:
        return None
    return Packet(datagram[0] >> 4, datagram[0] & 0b11, datagram[1:])
