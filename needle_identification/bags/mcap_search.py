# SPDX-License-Identifier: Apache-2.0
"""Find the next record of an MCAP file after damaged bytes."""

from __future__ import annotations

from collections.abc import Collection
import struct
from typing import Any, Final

from mcap.opcode import Opcode
from needle_identification.bags import compression
from needle_identification.bags.compression import Budget
import numpy as np

HEAD: Final = struct.Struct('<BQ')  #: opcode and length of a record
CHUNK: Final = struct.Struct('<QQQII')  #: start, end, size, checksum, length of compression
PRIVATE: Final = 0x80  #: least opcode of records of other programs

_CHANNEL: Final = struct.Struct('<H')

#: Smallest length of the records of a file, by opcode [bytes].
_LEAST: Final = {
    Opcode.SCHEMA: 14,
    Opcode.CHANNEL: 16,
    Opcode.MESSAGE: 22,
    Opcode.CHUNK: CHUNK.size + 8,
    Opcode.MESSAGE_INDEX: 6,
    Opcode.CHUNK_INDEX: 60,
    Opcode.STATISTICS: 46,
    Opcode.DATA_END: 4,
}

#: Records at which reading continues.
_FIRST: Final = (
    Opcode.SCHEMA,
    Opcode.CHANNEL,
    Opcode.MESSAGE,
    Opcode.CHUNK,
    Opcode.MESSAGE_INDEX,
    Opcode.DATA_END,
)
_IS_FIRST: Final = np.isin(np.arange(256), _FIRST)

_LONGEST: Final = 2**24  # longest record that is found [bytes]
_CHAIN: Final = 3  # number of successive records that are no coincidence
_WINDOW: Final = 2**10  # size of the first block that is searched; it grows [bytes]


def is_record(opcode: int, length: int) -> bool:
    """Return whether opcode and length are of a record of the format."""
    known = Opcode.HEADER <= opcode <= Opcode.DATA_END
    return known and length >= _LEAST.get(Opcode(opcode), 0)


def find_record(
    data: bytes, begin: int, channels: Collection[int], budget: Budget, *, is_end: bool
) -> tuple[int, bool]:
    """
    Return the first position from `begin` where records follow, or else the end of the search.

    The second value is whether there are records. Messages must be of known channels. Unless
    `is_end`, the search stops where it depends on bytes after the data.
    """
    size, window = len(data), _WINDOW
    budget.spend(0, compression.COSTLY)
    last = size - HEAD.size + 1
    while begin < last:
        end = min(begin + window, last)
        block = np.frombuffer(
            data, dtype=np.uint8, count=end - begin + HEAD.size - 1, offset=begin
        )
        is_found = _IS_FIRST[block[: end - begin]]
        # The upper four bytes of the length are zero.
        for k in range(5, HEAD.size):
            is_found &= block[k : k + end - begin] == 0
        found = np.flatnonzero(is_found)
        budget.spend(0, len(found))
        for at in (found + begin).tolist():
            follows = _chain(data, at, channels, is_end=is_end)
            if follows is not False:
                return at, follows is True
        begin, window = end, 2 * window
    return max(begin, 0), False


def _chain(data: bytes, at: int, channels: Collection[int], *, is_end: bool) -> bool | None:
    """Return whether successive records begin at a position; None if that needs more data."""
    size = len(data)
    for number in range(_CHAIN):
        if at + HEAD.size > size:
            # The end of the data, or a truncated head.
            return number > 0 and (at == size or number > 1) if is_end else None
        opcode, length = HEAD.unpack_from(data, at)
        if opcode not in _LEAST or not _LEAST[opcode] <= length <= _LONGEST:
            return False
        body = at + HEAD.size
        has_channel = opcode == Opcode.MESSAGE and body + _CHANNEL.size <= size
        if has_channel and _CHANNEL.unpack_from(data, body)[0] not in channels:
            return False
        at = body + length
        if opcode == Opcode.DATA_END:
            return True
        if at > size:
            return number > 1 if is_end else None
    return True


class Rereadable:
    """Binary stream to which bytes can be returned, to be read again."""

    def __init__(self, stream: Any) -> None:
        self._stream = stream
        self._returned: list[memoryview] = []

    def put_back(self, data: bytes) -> None:
        if data:
            self._returned.append(memoryview(data))

    def read(self, size: int) -> bytes:
        if not self._returned:
            part: bytes = self._stream.read(size)
            return part
        data = self._returned.pop()
        if len(data) > size:
            self._returned.append(data[size:])
        return bytes(data[:size])

    def find(self, channels: Collection[int], budget: Budget) -> int | None:
        """Skip to the next records; return the number of skipped bytes, None without records."""
        skipped, data, begin, more = 0, b'', 0, _WINDOW
        while True:
            part = compression.read_up_to(self, more)
            is_end, data = len(part) < more, data[begin:] + part
            begin, follows = find_record(data, 0, channels, budget, is_end=is_end)
            skipped += begin
            if follows:
                self.put_back(data[begin:])
                return skipped
            if is_end:
                return None
            more = max(_WINDOW, min(2 * more, compression.BLOCK))
