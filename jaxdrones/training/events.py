"""Event files for TensorBoard, written without TensorBoard.

An event file is a sequence of records. Each is a length with its checksum, and an `Event` protocol buffer with its own.
Format: tensorflow/core/lib/io/record_writer.h and tensorflow/core/util/event.proto.
"""

from __future__ import annotations

import math
import struct
import time
from collections.abc import Mapping
from pathlib import Path

_MAX_FLOAT32 = 3.4e38
PREFIX = "events.out.tfevents"
"""Start of the name of an event file, by which TensorBoard finds it."""


class EventFile:
    """An event file in a folder."""

    def __init__(self, folder: Path):
        """Start a new file; older ones remain."""
        self._file = (folder / f"{PREFIX}.{time.time_ns() // 1000:020d}.jaxdrones").open("wb")
        self._record(_event(0) + _bytes(3, b"brain.Event:2"))

    def add(self, step: int, scalars: Mapping[str, float]) -> None:
        """Write the scalars of one step."""
        values = (_bytes(1, _bytes(1, name.encode()) + b"\x15" + _float(x)) for name, x in scalars.items())
        self._record(_event(step) + _bytes(5, b"".join(values)))

    def flush(self) -> None:
        """Make everything that was added visible to readers."""
        self._file.flush()

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _record(self, event: bytes) -> None:
        length = struct.pack("<Q", len(event))
        self._file.write(length + _checksum(length) + event + _checksum(event))


def _event(step: int) -> bytes:
    """The fields `wall_time` and `step` of an event."""
    return b"\x09" + struct.pack("<d", time.time()) + b"\x10" + _varint(step)


def _bytes(field: int, content: bytes) -> bytes:
    return _varint(field << 3 | 2) + _varint(len(content)) + content


def _float(x: float) -> bytes:
    return struct.pack("<f", math.copysign(math.inf, x) if abs(x) > _MAX_FLOAT32 else x)


def _varint(x: int) -> bytes:
    out = bytearray()
    while x > 0x7F:
        out.append(x & 0x7F | 0x80)
        x >>= 7
    return bytes([*out, x])


def _crc_table() -> list[int]:
    table = []
    for byte in range(256):
        for _ in range(8):
            byte = byte >> 1 ^ (0x82F63B78 if byte & 1 else 0)  # CRC-32C, Castagnoli
        table.append(byte)
    return table


_TABLE = _crc_table()


def _checksum(content: bytes) -> bytes:
    """CRC-32C, masked as records require."""
    crc = 0xFFFFFFFF
    for byte in content:
        crc = _TABLE[(crc ^ byte) & 0xFF] ^ crc >> 8
    crc ^= 0xFFFFFFFF
    return struct.pack("<I", (crc >> 15 | crc << 17 & 0xFFFFFFFF) + 0xA282EAD8 & 0xFFFFFFFF)
