# SPDX-License-Identifier: Apache-2.0
"""
Parsing and serialization of CDR messages: stamp and numbers of a message or of a batch.

Messages of a topic differ only in their stamp and numbers: the first is a template with their
positions, for all messages with the same other bytes. It takes a tenth of the time of rclpy.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import count
from math import nan
import struct
from typing import Any, Final, NamedTuple

from needle_ros.errors import MessageError, ShapeError
from needle_ros.timing import NANOSECONDS
import numpy as np
from numpy.typing import NDArray

JOINT_STATE: Final = 'sensor_msgs/msg/JointState'
WRENCH: Final = 'geometry_msgs/msg/WrenchStamped'
POSE: Final = 'geometry_msgs/msg/PoseStamped'
POINT: Final = 'geometry_msgs/msg/PointStamped'
TWIST: Final = 'geometry_msgs/msg/TwistStamped'
ODOMETRY: Final = 'nav_msgs/msg/Odometry'


class _Fields(NamedTuple):
    names: bool = False
    strings: int = 0
    sequences: int = 0
    numbers: int = 0


_FIELDS: Final = {
    JOINT_STATE: _Fields(names=True, sequences=3),
    WRENCH: _Fields(numbers=6),
    POSE: _Fields(numbers=7),
    POINT: _Fields(numbers=3),
    TWIST: _Fields(numbers=6),
    ODOMETRY: _Fields(strings=1, numbers=7 + 36 + 6 + 36),
}

TYPES: Final = tuple(_FIELDS)  #: Supported message types.

#: Alignment of 8-byte numbers by encapsulation: plain CDR and plain XCDR2, big and little endian.
_WIDEST: Final = {0: 8, 1: 8, 6: 4, 7: 4}

#: Encapsulation of written messages: plain CDR, little endian, no options.
_HEAD: Final = b'\0\1\0\0'

_STAMP: Final = 4  #: Position of the stamp (seconds, nanoseconds) after the encapsulation [bytes].

#: Maximum padding of the last word by some middlewares, and additional bytes after the message for
#: each empty array: rclpy aligns it in the size of its buffer, but not in the message [bytes].
_PADDING, _EXCESS = 3, 8

#: Number of templates in a batch after which messages are parsed one by one.
_TEMPLATES: Final = 32


class Reading(NamedTuple):
    """Content of a message."""

    stamp: int  #: Time of the header [ns].
    frame: str  #: Frame of the header.
    names: tuple[str, ...]  #: Joints; empty if the type has no such field.
    #: Positions, velocities and efforts of a JointState; else one tuple of all numbers, in the
    #: order of the fields.
    values: tuple[tuple[float, ...], ...]

    def joint(self, name: str) -> tuple[float, float, float] | None:
        """Return position, velocity and effort of a joint, NaN if missing; None without it."""
        if name not in self.names:
            return None
        k = self.names.index(name)
        positions, velocities, efforts = self.values
        return (
            positions[k] if k < len(positions) else nan,
            velocities[k] if k < len(velocities) else nan,
            efforts[k] if k < len(efforts) else nan,
        )


class _Cursor:
    """Cursor over the fields of a message: parses it, or writes given values, numbers as zero."""

    def __init__(self, message: bytes, given: Iterable[str | int] | None = None) -> None:
        kind = int.from_bytes(message[:2], 'big')
        if len(message) < 4 or kind not in _WIDEST:
            raise MessageError(
                f'begins with {message[:4].hex(" ") or "nothing"}, which is not CDR '
                '(00 00, 00 01) or XCDR2 (00 06, 00 07)'
            )
        self.message = bytearray(message)
        self.order = '<' if kind % 2 else '>'
        #: Begin and end of the bytes other than the stamp and the numbers.
        self.fixed = [(0, 2)]
        self._widest, self._padding = _WIDEST[kind], _PADDING
        self._end = 4
        self._given: Iterator[Any] | None = None if given is None else iter(given)

    def take(self, size: int, number: int = 1) -> int:
        """Advance over numbers of a size [bytes]; return their position."""
        if number:
            self._end += -(self._end - 4) % min(size, self._widest)
        begin = self._end
        self._end += size * number
        if self._given is not None:
            self.message.extend(bytes(self._end - len(self.message)))
        if self._end > len(self.message):
            raise MessageError(f'ends after {len(self.message)} bytes')
        return begin

    def count(self, given: int | None = None) -> int:
        begin = self.take(4)
        if self._given is not None:
            value = next(self._given) if given is None else given
            struct.pack_into(f'{self.order}I', self.message, begin, value)
        self.fixed.append((begin, begin + 4))
        return int(struct.unpack_from(f'{self.order}I', self.message, begin)[0])

    def elements(self) -> int:
        """Return the length of an array of strings or messages; XCDR2 has its size before it."""
        if self._widest < 8:
            self.count()
        return self.count()

    def string(self) -> str:
        text = b'' if self._given is None else next(self._given).encode() + b'\0'
        length = self.count(len(text))
        begin = self.take(1, length)
        if text:
            self.message[begin : begin + length] = text
        self.fixed.append((begin, begin + length))
        return self.message[begin : begin + length].rstrip(b'\0').decode(errors='replace')

    def numbers(self, number: int) -> tuple[int, int]:
        self._padding += 0 if number else _EXCESS
        return self.take(8, number), number

    def close(self) -> None:
        if len(self.message) - self._end > self._padding:
            raise MessageError(f'has {len(self.message)} bytes, {self._end} expected')


class Template:
    """
    Message with a header as a template with a variable stamp and variable numbers.

    Padding is written as zeros (rmw writes uninitialized memory) and is not compared on reading.
    `type_name` is one of `TYPES`; `names` are the joints of a JointState, and `counts` the numbers
    of its positions, velocities and efforts.
    """

    def __init__(
        self,
        type_name: str,
        frame: str = '',
        *,
        names: Sequence[str] = (),
        counts: Sequence[int] = (0, 0, 0),
    ) -> None:
        fields = _FIELDS[type_name]
        described = [len(names), *names, *counts] if fields.names else [''] * fields.strings
        self._walk(type_name, _Cursor(_HEAD, [frame, *described]))

    @classmethod
    def of(cls, message: bytes, type_name: str) -> Template:
        """Create a template from a serialized message; `MessageError` if its type is different."""
        template = cls.__new__(cls)
        template._walk(type_name, _Cursor(message))
        return template

    def _walk(self, type_name: str, cursor: _Cursor) -> None:
        fields = _FIELDS[type_name]
        cursor.take(4, 2)
        self.frame = cursor.string()
        names = range(cursor.elements() if fields.names else 0)
        self.names = tuple([cursor.string() for _ in names])
        for _ in range(fields.strings):
            cursor.string()
        arrays = [cursor.numbers(cursor.count()) for _ in range(fields.sequences)]
        if fields.numbers:
            arrays.append(cursor.numbers(fields.numbers))
        cursor.close()
        #: Position in the message [bytes] and length of each array of numbers (positions,
        #: velocities and efforts of a JointState, else one array), and byte order, ``<`` or ``>``.
        self.arrays, self.order = tuple(arrays), cursor.order
        self._fixed, self._message = cursor.fixed, bytes(cursor.message)
        #: Created on first use; a batch does not need it.
        self._format: _Format | None = None

    @property
    def fixed(self) -> NDArray[np.bool_]:
        """Whether each byte is equal in all messages of the template."""
        found = np.zeros(len(self._message), dtype=np.bool_)
        for begin, end in self._fixed:
            found[begin:end] = True
        return found

    def _made(self) -> _Format:
        self._format = _Format(self._message, self.order, self._fixed, self.arrays)
        return self._format

    def serialize(self, stamp: int, *values: float) -> bytes:
        """Serialize a message with a stamp [ns] and all numbers, in the order of the fields."""
        form = self._format or self._made()
        if len(values) != form.count:
            raise ShapeError(f'the message has {form.count} values, got {len(values)}')
        parts = form.parts
        parts[1], parts[2] = divmod(stamp, NANOSECONDS)
        for place, own in form.places:
            parts[place] = values[own]
        return form.pack(*parts)

    def read(self, message: bytes) -> Reading | None:
        """Parse a serialized message; None if its fixed bytes differ from the template."""
        form = self._format or self._made()
        # A longer message with the same prefix has other counts, except for padding.
        if len(message) < form.size or form.unpack_fixed(message) != form.fixed:
            return None
        found = form.unpack_numbers(message)
        return Reading(
            found[0] * NANOSECONDS + found[1],
            self.frame,
            self.names,
            tuple(map(found.__getitem__, form.blocks)),
        )


class MessageReader:
    """Parser of the messages of a topic, with the template of the previous message."""

    def __init__(self, type_name: str) -> None:
        self._type_name = type_name
        self._template = Template(type_name)

    def read(self, message: bytes) -> Reading:
        """Parse a serialized message; `MessageError` if it is not of the expected type."""
        reading = self._template.read(message)
        while reading is None:
            self._template = Template.of(message, self._type_name)
            reading = self._template.read(message)
        return reading


class _Format:
    """Structs of a template: whole message, fixed bytes, and variable numbers."""

    def __init__(
        self,
        message: bytes,
        order: str,
        fixed: Sequence[tuple[int, int]],
        arrays: Sequence[tuple[int, int]],
    ) -> None:
        #: Values of the whole message, and positions of the numbers in it.
        self.parts: list[Any] = [message[:2], 0, 0]
        self.places: list[tuple[slice, slice]] = []
        blocks: list[slice] = []
        whole, stays, changes = '2s2xiI', '2s10x', '4xiI'
        end, self.count = _STAMP + 8, 0
        # In message order; an empty array may be at any position.
        pieces = [(begin, end, False) for begin, end in fixed[1:]]
        pieces += [(begin, begin + 8 * number, True) for begin, number in arrays]
        for begin, after, changing in sorted(pieces):
            gap, size = f'{begin - end}x', after - begin
            if begin < end:
                gap = ''
            whole += gap + (f'{size // 8}d' if changing else f'{size}s')
            stays += gap + (f'{size}x' if changing else f'{size}s')
            changes += gap + (f'{size // 8}d' if changing else f'{size}x')
            if changing:
                first, number = len(self.parts), size // 8
                self.places.append(
                    (slice(first, first + number), slice(self.count, self.count + number))
                )
                # After the two numbers of the stamp.
                blocks.append(slice(2 + self.count, 2 + self.count + number))
                self.parts += [0.0] * number
                self.count += number
            else:
                self.parts.append(message[begin:after])
            end = max(end, after)
        writer = struct.Struct(order + whole)
        self.pack, self.size = writer.pack, writer.size
        self.unpack_fixed = struct.Struct(order + stays).unpack_from
        self.unpack_numbers = struct.Struct(order + changes).unpack_from
        self.blocks, self.fixed = blocks, self.unpack_fixed(message)


#: Selects numbers of the messages of a template: the position of each number [bytes], -1 for a
#: missing number; None discards the messages.
Choice = Callable[[Template], Sequence[int] | None]


class Decoded(NamedTuple):
    """Content of a batch of messages."""

    stamps: NDArray[np.int64]  #: Stamps of the headers [ns], shape (n,).
    #: The selected numbers, nan where a message has no such number, shape (n, k).
    values: NDArray[np.float64]
    used: NDArray[np.intp]  #: Indices of these messages in the batch, shape (n,).
    #: Number of invalid messages, and error of the first.
    invalid: int
    fault: str


def decode(
    data: NDArray[np.uint8],
    begin: NDArray[np.int64],
    end: NDArray[np.int64],
    type_name: str,
    choice: Choice,
    columns: int,
) -> Decoded:
    """
    Parse stamps and selected numbers of a batch of messages.

    `data` are the bytes of all messages, `begin` and `end`, shape (m,), the first byte and the end
    of each. `choice` selects `columns` numbers of a message; other messages are left out.
    """
    stamps = np.zeros(len(begin), dtype=np.int64)
    values = np.full((len(begin), columns), np.nan)
    used = np.zeros(len(begin), dtype=np.bool_)
    unread, pending = ~used, np.arange(len(begin))
    invalid, fault = 0, ''
    for number in count():
        if len(pending) == 0:
            break
        first = pending[0]
        message = data[begin[first] : end[first]]
        try:
            template = Template.of(message.tobytes(), type_name)
        except MessageError as error:
            invalid, fault = invalid + 1, fault or str(error)
            pending = pending[1:]
            continue
        alike = pending[:1]
        if number < _TEMPLATES:
            alike = pending[(end - begin)[pending] == len(message)]
        rows = np.lib.stride_tricks.sliding_window_view(data, len(message))[begin[alike]]
        differs = (rows != message) & template.fixed
        if differs.any():
            same = ~differs.any(axis=1)
            alike, rows = alike[same], rows[same]
        wanted = choice(template)
        if wanted is not None:
            used[alike] = True
            order = template.order
            seconds = _column(rows, _STAMP, f'{order}i4').astype(np.int64)
            stamps[alike] = seconds * NANOSECONDS + _column(rows, _STAMP + 4, f'{order}u4')
            for k, position in enumerate(wanted):
                if position >= 0:
                    values[alike, k] = _column(rows, position, f'{order}f8')
        unread[alike] = False
        pending = pending[unread[pending]]
    read = np.flatnonzero(used)
    return Decoded(stamps[read], values[read], read, invalid, fault)


def _column(rows: NDArray[np.uint8], position: int, kind: str) -> NDArray[Any]:
    size = np.dtype(kind).itemsize
    return np.ascontiguousarray(rows[:, position : position + size]).view(kind)[:, 0]


def read_string(message: bytes) -> str:
    return _Cursor(message).string()


def read_line(message: bytes) -> tuple[str, NDArray[np.float64]]:
    """Parse a line of a visualization_msgs Marker: namespace and points (n, 3) [m]."""
    cursor = _Cursor(message)
    cursor.take(4, 2)
    cursor.string()
    name = cursor.string()
    # Number, kind and action; pose and scale; color and lifetime; whether it is locked.
    for size, number in ((4, 3), (8, 10), (4, 6), (1, 1)):
        cursor.take(size, number)
    count = cursor.elements()
    begin = cursor.take(8, 3 * count)
    points = np.frombuffer(message, f'{cursor.order}f8', 3 * count, begin)
    return name, points.reshape(count, 3).astype(np.float64)
