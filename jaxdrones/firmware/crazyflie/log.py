"""Log blocks: groups of variables that are sent periodically."""

import dataclasses
import struct
from collections.abc import Iterator

from jaxdrones.firmware.crazyflie.packet import E2BIG, EEXIST, ENOENT, ENOEXEC, ENOMEM, MAX_DATA, Packet, Port
from jaxdrones.firmware.crazyflie.toc import LOG_TYPES, Toc, Type
from jaxdrones.firmware.crazyflie.variables import VARIABLES, Readings

_TABLE, _CONTROL, _DATA = range(3)
_CREATE, _APPEND, _DELETE, _START, _STOP, _RESET, _CREATE_V2, _APPEND_V2 = range(8)
_MAX_BLOCKS, _MAX_VARIABLES = 16, 128
_ROWS_MS = 10  # unit of periods, ms
TOC = Toc({name: variable.kind.log for name, variable in VARIABLES.items()}, bytes([_MAX_BLOCKS, _MAX_VARIABLES]))
"""Table of the log variables."""


@dataclasses.dataclass
class Block:
    """Log block of one client."""

    columns: list[tuple[str, Type]] = dataclasses.field(default_factory=list)
    """Names of the variables and the types in which they are sent."""
    period: int = 0
    """Rows of 10 ms between packets; 0 while it is stopped."""


class Log:
    """Log blocks of one client."""

    def __init__(self) -> None:
        self._blocks: dict[int, Block] = {}

    def answer(self, channel: int, data: bytes) -> bytes:
        """Answer to a packet; empty for an invalid one."""
        if channel == _TABLE:
            return TOC.answer(data)
        if channel != _CONTROL or not data:
            return b""
        if data[0] == _RESET:
            self._blocks.clear()
            return bytes([_RESET, 0, 0])
        if len(data) < 2:
            return b""
        return bytes([data[0], data[1], self._control(data[0], data[1], data[2:])])

    def rows(self, row: int, now: Readings) -> Iterator[Packet]:
        """Packets that are due at a row (10 ms each)."""
        for number, block in self._blocks.items():
            if block.period and row % block.period == 0:
                values = b"".join(kind.pack(VARIABLES[name].read(now)) for name, kind in block.columns)
                stamp = struct.pack("<I", row * _ROWS_MS & 0xFFFFFF)[:3]
                yield Packet(Port.LOG, _DATA, bytes([number]) + stamp + values)

    def _control(self, command: int, number: int, data: bytes) -> int:
        """Change a block; the error number."""
        if command in (_CREATE, _CREATE_V2):
            if number in self._blocks:
                return EEXIST
            if len(self._blocks) >= _MAX_BLOCKS:
                return ENOMEM
            self._blocks[number] = Block()
            error = self._append(number, data, command == _CREATE_V2)
            if error:
                del self._blocks[number]
            return error
        if number not in self._blocks:
            return ENOENT
        if command in (_APPEND, _APPEND_V2):
            return self._append(number, data, command == _APPEND_V2)
        if command == _DELETE:
            del self._blocks[number]
        elif command == _START and len(data) == 1:
            self._blocks[number].period = data[0]
        elif command == _STOP:
            self._blocks[number].period = 0
        else:
            return ENOEXEC
        return 0

    def _append(self, number: int, data: bytes, wide: bool) -> int:
        """Add variables, each given by its type and its number of two bytes, or of one unless `wide`."""
        size, columns = 3 if wide else 2, list(self._blocks[number].columns)
        for at in range(0, len(data) - size + 1, size):
            kind = LOG_TYPES.get(data[at] & 0x0F)
            index = int.from_bytes(data[at + 1 : at + size], "little")
            if kind is None or index >= len(TOC.names):
                return ENOENT
            columns.append((TOC.names[index], kind))
        if sum(kind.size for _, kind in columns) > MAX_DATA - 4:
            return E2BIG
        others = sum(len(block.columns) for other, block in self._blocks.items() if other != number)
        if others + len(columns) > _MAX_VARIABLES:
            return ENOMEM
        self._blocks[number].columns = columns
        return 0
