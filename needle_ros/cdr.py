"""
Numbers from serialized messages (CDR), a whole batch at once.

The messages of a topic are alike but for their numbers. So one of them is parsed, and where it
has its stamp and its numbers all those have theirs whose strings, lengths and byte order are the
same, byte for byte. What differs is parsed in its turn.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import count
import struct
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

JOINT_STATE: Final = 'sensor_msgs/msg/JointState'
WRENCH: Final = 'geometry_msgs/msg/WrenchStamped'
POSE: Final = 'geometry_msgs/msg/PoseStamped'
POINT: Final = 'geometry_msgs/msg/PointStamped'
TWIST: Final = 'geometry_msgs/msg/TwistStamped'
ODOMETRY: Final = 'nav_msgs/msg/Odometry'

#: Strings and numbers that follow the header, of the messages that have nothing else.
_BODIES: Final = {
    WRENCH: (0, 6),
    POSE: (0, 7),
    POINT: (0, 3),
    TWIST: (0, 6),
    ODOMETRY: (1, 7 + 36 + 6 + 36),
}

#: The types that are known here.
TYPES: Final = (JOINT_STATE, *_BODIES)

#: After so many kinds of message in one batch the rest are taken one by one.
_KINDS: Final = 32

#: Alignment of 8-byte numbers by encapsulation: plain CDR and plain XCDR2, big and little endian.
_WIDEST: Final = {0: 8, 1: 8, 6: 4, 7: 4}


class Layout(NamedTuple):
    """
    Where a message has what.

    ``arrays`` are offset and length of each array of numbers: the positions, velocities and
    efforts of a JointState, and all numbers of another message as one. ``fixed`` are the bytes
    that another message must share to be laid out alike.
    """

    order: str
    names: tuple[str, ...]
    arrays: tuple[tuple[int, int], ...]
    stamp: int
    fixed: NDArray[np.intp]


#: Chooses from a layout the offsets of the numbers wanted, -1 for one that is not there; None if
#: the message is of no interest.
Choice = Callable[[Layout], Sequence[int] | None]


class Decoded(NamedTuple):
    """Header stamps [ns], shape (n,), and numbers, shape (n, k), of the messages ``used``."""

    stamps: NDArray[np.int64]
    values: NDArray[np.float64]
    used: NDArray[np.intp]
    broken: int
    fault: str


class _Cursor:
    """Goes through a serialized message."""

    def __init__(self, message: bytes) -> None:
        kind = int.from_bytes(message[:2], 'big')
        if len(message) < 4 or kind not in _WIDEST:
            raise ValueError(f'begins with {message[:4].hex(" ") or "nothing"}, which is not CDR')
        self._message = message
        self._widest = _WIDEST[kind]
        self._position = 4
        self.order = '<' if kind % 2 else '>'
        self.fixed = [np.arange(2)]

    def take(self, size: int, number: int = 1) -> int:
        """Pass over numbers of a size [bytes]; return where they begin."""
        if number:
            self._position += -(self._position - 4) % min(size, self._widest)
        begin = self._position
        self._position += size * number
        if self._position > len(self._message):
            raise ValueError(f'ends after {len(self._message)} bytes')
        return begin

    def length(self) -> int:
        begin = self.take(4)
        self.fixed.append(np.arange(begin, begin + 4))
        return int(struct.unpack_from(f'{self.order}I', self._message, begin)[0])

    def string(self) -> str:
        length = self.length()
        begin = self.take(1, length)
        self.fixed.append(np.arange(begin, begin + length))
        return self._message[begin : begin + length].rstrip(b'\0').decode(errors='replace')

    def numbers(self, number: int) -> tuple[int, int]:
        return self.take(8, number), number

    def close(self) -> None:
        # Some middlewares fill the last word up.
        if len(self._message) - self._position > 3:
            raise ValueError(f"has {len(self._message)} bytes, {self._position} are its type's")


def layout(message: bytes, type_name: str) -> Layout:
    """
    Find the parts of a message.

    Raises
    ------
    ValueError
        If the bytes are not a message of this type.

    """
    cursor = _Cursor(message)
    stamp = cursor.take(4, 2)
    cursor.string()
    names: tuple[str, ...] = ()
    if type_name == JOINT_STATE:
        names = tuple(cursor.string() for _ in range(cursor.length()))
        arrays = tuple(cursor.numbers(cursor.length()) for _ in range(3))
    else:
        strings, numbers = _BODIES[type_name]
        for _ in range(strings):
            cursor.string()
        arrays = (cursor.numbers(numbers),)
    cursor.close()
    return Layout(cursor.order, names, arrays, stamp, np.concatenate(cursor.fixed))


def decode(
    data: NDArray[np.uint8],
    begin: NDArray[np.int64],
    end: NDArray[np.int64],
    type_name: str,
    choice: Choice,
    columns: int,
) -> Decoded:
    """
    Take stamps and numbers from serialized messages.

    Parameters
    ----------
    data : ndarray
        Bytes that hold the messages.
    begin, end : ndarray, shape (m,)
        Where each message begins and ends.
    type_name : str
        One of the types above.
    choice : callable
        Which numbers are wanted.
    columns : int
        How many.

    Returns
    -------
    Decoded
        In the order of the messages, without those that are broken or of no interest; numbers
        that a message does not have are nan.

    """
    stamps = np.zeros(len(begin), dtype=np.int64)
    values = np.full((len(begin), columns), np.nan)
    used = np.zeros(len(begin), dtype=np.bool_)
    pending = np.arange(len(begin))
    broken, fault = 0, ''
    for kind in count():
        if len(pending) == 0:
            break
        first = pending[0]
        message = data[begin[first] : end[first]]
        try:
            plan = layout(message.tobytes(), type_name)
        except ValueError as error:
            broken, fault = broken + 1, fault or str(error)
            pending = pending[1:]
            continue
        alike = pending[:1]
        if kind < _KINDS:
            alike = pending[(end - begin)[pending] == len(message)]
        rows = np.lib.stride_tricks.sliding_window_view(data, len(message))[begin[alike]]
        same = (rows[:, plan.fixed] == message[plan.fixed]).all(axis=1)
        if not same.all():
            alike, rows = alike[same], rows[same]
        offsets = choice(plan)
        if offsets is not None:
            used[alike] = True
            seconds = _column(rows, plan.stamp, f'{plan.order}i4').astype(np.int64)
            stamps[alike] = seconds * 1_000_000_000 + _column(
                rows, plan.stamp + 4, f'{plan.order}u4'
            )
            for k, offset in enumerate(offsets):
                if offset >= 0:
                    values[alike, k] = _column(rows, offset, f'{plan.order}f8')
        pending = np.setdiff1d(pending, alike, assume_unique=True)
    read = np.flatnonzero(used)
    return Decoded(stamps[read], values[read], read, broken, fault)


def _column(rows: NDArray[np.uint8], offset: int, kind: str) -> NDArray[Any]:
    size = np.dtype(kind).itemsize
    return np.ascontiguousarray(rows[:, offset : offset + size]).view(kind)[:, 0]
