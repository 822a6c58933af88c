"""Messages with a header as bytes (CDR), of which only the stamp and values change."""

from __future__ import annotations

from collections.abc import Sequence
import struct
from typing import Any, Final, NamedTuple

from needle_ros.errors import (
    ShapeError,
)
from needle_ros.timing import NANOSECONDS

#: Little-endian CDR; two bytes of options follow, which say nothing of such messages.
_ENCODING: Final = b'\0\1'


class Reading(NamedTuple):
    """
    What a message says.

    Attributes
    ----------
    stamp : int
        Time of the header [ns].
    frame : str
        Frame of the header.
    names : tuple of str
        Joints, none if the message has no such field.
    values : tuple of tuple of float
        Positions, speeds and efforts of joints; else one tuple of all numbers, in the order of
        the fields.

    """

    stamp: int
    frame: str
    names: tuple[str, ...]
    values: tuple[tuple[float, ...], ...]


class Layout:
    """
    Where the stamp and the values of a message are, among bytes that stay.

    To write or to read them takes a tenth of what rclpy takes to convert the message. Gaps
    before aligned fields are written as zeros, where rmw leaves what was in memory, and read as
    whatever they are.

    Parameters
    ----------
    frame : str
        Frame of the header.
    names : sequence of str, optional
        A sequence of strings after the header.
    counts : sequence of int
        Lengths of the sequences of doubles that follow.
    numbers : int
        How many single doubles follow.

    """

    def __init__(
        self,
        frame: str,
        *,
        names: Sequence[str] | None = None,
        counts: Sequence[int] = (),
        numbers: int = 0,
    ) -> None:
        self._frame, self._names = frame, tuple(names or ())
        #: Encoding, stamp [s] and [ns], then bytes and values in turn; where values go in it.
        self._parts: list[Any] = [_ENCODING, 0, 0]
        self._places: list[tuple[slice, slice]] = []
        blocks: list[slice] = []
        # The whole, what stays and what changes; x is a byte that is passed over.
        whole, stays, changes = '<2s2xiI', '<2s10x', '<4xiI'
        taken = 0
        for form, size, data in _fields(frame, names, counts, numbers):
            whole += f'{size}{form}'
            stays += f'{8 * size}x' if form == 'd' else f'{size}{form}'
            changes += f'{size}x' if form == 's' else f'{size}{form}'
            if form == 's':
                self._parts.append(data)
            elif form == 'd':
                first = len(self._parts)
                self._places.append((slice(first, first + size), slice(taken, taken + size)))
                # Behind the two numbers of the stamp.
                blocks.append(slice(2 + taken, 2 + taken + size))
                self._parts += [0.0] * size
                taken += size
        self._blocks, self._count = tuple(blocks), taken
        self._whole, self._stays, self._changes = map(struct.Struct, (whole, stays, changes))
        self._bytes = self._stays.unpack(self._whole.pack(*self._parts))

    def serialize(self, stamp: int, *values: float) -> bytes:
        """Return the message with a stamp [ns] and values, in the order of its fields."""
        if len(values) != self._count:
            raise ShapeError(f'the message has {self._count} values, got {len(values)}')
        parts = self._parts
        parts[1], parts[2] = divmod(stamp, NANOSECONDS)
        for place, own in self._places:
            parts[place] = values[own]
        return self._whole.pack(*parts)

    def deserialize(self, data: bytes) -> Reading | None:
        """Return what a message says, None if it is not of this layout."""
        # A message that begins alike and is longer cannot be: its counts would be others.
        if len(data) < self._whole.size or self._stays.unpack_from(data) != self._bytes:
            return None
        found = self._changes.unpack_from(data)
        return Reading(
            found[0] * NANOSECONDS + found[1],
            self._frame,
            self._names,
            tuple([found[block] for block in self._blocks]),
        )


def _fields(
    frame: str, names: Sequence[str] | None, counts: Sequence[int], numbers: int
) -> list[tuple[str, int, bytes]]:
    """Return what follows the stamp: bytes (s), gaps (x) and runs of doubles (d), with lengths."""
    fields: list[tuple[str, int, bytes]] = []
    end = 8

    def put(form: str, size: int, to: int, data: bytes = b'') -> None:
        nonlocal end
        gap = -end % to
        if gap:
            fields.append(('x', gap, b''))
        elif form == 's' and fields and fields[-1][0] == 's':
            data = fields.pop()[2] + data
            end -= len(data) - size
            size = len(data)
        fields.append((form, size, data))
        end += gap + (8 * size if form == 'd' else size)

    def count(value: int) -> None:
        put('s', 4, 4, struct.pack('<I', value))

    def text(value: str) -> None:
        encoded = value.encode() + b'\0'
        count(len(encoded))
        put('s', len(encoded), 1, encoded)

    text(frame)
    if names is not None:
        count(len(names))
        for name in names:
            text(name)
    for many in counts:
        count(many)
        put('d', many, 8 if many else 1)
    if numbers:
        put('d', numbers, 8)
    return fields
