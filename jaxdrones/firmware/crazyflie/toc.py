"""Tables of contents: the parameters and the log variables of the vehicle, with their types."""

import struct
import zlib
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from jaxdrones.firmware.crazyflie.packet import ENOENT

_FLOATS = {"e": 65504.0, "f": 3.4e38}  # format of `struct` -> largest number
_ITEM, _INFO, _ITEM_V2, _INFO_V2 = range(4)


class Type(NamedTuple):
    """Type of a number."""

    name: str
    """Name in C."""
    code: str
    """Format character of `struct`."""
    log: int
    """Number in the log."""
    parameter: int
    """Number as a parameter."""

    @property
    def size(self) -> int:
        """Bytes."""
        return struct.calcsize("<" + self.code)

    def pack(self, value: float) -> bytes:
        """Bytes of a number, limited to the range of the type; an integer of NaN is zero."""
        low, high = self._range
        if value != value:
            return struct.pack("<" + self.code, value if self.code in _FLOATS else 0)
        limited = min(max(value, low), high)
        return struct.pack("<" + self.code, limited if self.code in _FLOATS else int(limited))

    @property
    def _range(self) -> tuple[float, float]:
        if self.code in _FLOATS:
            return -_FLOATS[self.code], _FLOATS[self.code]
        bits = 8 * self.size
        return (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) if self.code.islower() else (0, 2**bits - 1)

    def unpack(self, data: bytes) -> float:
        """Number from its bytes."""
        return struct.unpack("<" + self.code, data)[0]


TYPES = {
    kind.name: kind
    for kind in (
        Type("uint8_t", "B", 1, 8),
        Type("uint16_t", "H", 2, 9),
        Type("uint32_t", "I", 3, 10),
        Type("int8_t", "b", 4, 0),
        Type("int16_t", "h", 5, 1),
        Type("int32_t", "i", 6, 2),
        Type("float", "f", 7, 6),
        Type("FP16", "e", 8, 5),
    )
}
LOG_TYPES = {kind.log: kind for kind in TYPES.values()}
"""Types by their number in the log."""


class Toc:
    """Table of contents, downloaded entry by entry; its checksum tells a client whether it knows the table."""

    def __init__(self, types: Mapping[str, int], limits: bytes = b""):
        """Build a table of the `types` of entries `group.name`, in the order of their numbers.

        `limits` are further bytes of its description.
        """
        self.names: Sequence[str] = tuple(types)
        self._items = [
            bytes([kind]) + b"".join(part.encode() + b"\0" for part in name.split(".")) for name, kind in types.items()
        ]
        self._checksum = zlib.crc32(b"".join(self._items))
        self._limits = limits

    def answer(self, request: bytes) -> bytes:
        """Answer to a request on the channel of the table; empty for an invalid request."""
        if not request:
            return b""
        command, index = request[0], int.from_bytes(request[1:3] if request[0] == _ITEM_V2 else request[1:2], "little")
        if command == _INFO:
            return struct.pack("<BBI", _INFO, min(len(self.names), 255), self._checksum) + self._limits
        if command == _INFO_V2:
            return struct.pack("<BHI", _INFO_V2, len(self.names), self._checksum) + self._limits
        if command not in (_ITEM, _ITEM_V2):
            return b""
        if index >= len(self.names):
            return bytes([command, ENOENT])
        number = struct.pack("<H" if command == _ITEM_V2 else "<B", index)
        return bytes([command]) + number + self._items[index]
