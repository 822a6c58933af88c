"""Batches: many messages of one topic, as arrays; and the count of what was read of a file."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

from needle_identification.bags.compression import DAMAGED, decompress
from needle_identification.bags.limits import Budget
from needle_identification.bags.topics import Topic
import numpy as np
from numpy.typing import NDArray

#: Largest number of messages in a batch.
LARGEST_BATCH: Final = 2**14

#: Receive times are limited to this, so that their differences fit in 64 bits [ns].
LATEST: Final = 2**62

#: How compressed messages begin; others begin with 0.
_COMPRESSED: Final = {b'\x28\xb5\x2f\xfd': 'zstd', b'\x04\x22\x4d\x18': 'lz4'}


class Batch(NamedTuple):
    """
    Messages of one topic, in order.

    Attributes
    ----------
    topic : Topic
        The topic.
    received : ndarray of int64, shape (m,)
        Receive times [ns].
    data, begin, end : ndarray
        Bytes that hold the messages, and where each begins and ends, shape (m,).

    """

    topic: Topic
    received: NDArray[np.int64]
    data: NDArray[np.uint8]
    begin: NDArray[np.int64]
    end: NDArray[np.int64]

    @classmethod
    def joined(cls, topic: Topic, received: NDArray[np.int64], messages: Sequence[bytes]) -> Batch:
        """
        Make a batch of separate messages.

        Parameters
        ----------
        topic : Topic
            The topic.
        received : ndarray of int64, shape (m,)
            Receive times [ns].
        messages : sequence of bytes
            The messages.

        Returns
        -------
        Batch
            The batch.

        """
        lengths = np.array([len(message) for message in messages], dtype=np.int64)
        end = np.cumsum(lengths)
        data = np.frombuffer(b''.join(messages), dtype=np.uint8)
        return cls(topic, received, data, end - lengths, end)

    @classmethod
    def of_times(cls, topic: Topic, times: Sequence[Any], messages: Sequence[Any]) -> Batch:
        """
        Make a batch of what a file holds, which may be of another kind than it should.

        Parameters
        ----------
        topic : Topic
            The topic.
        times : sequence of object
            Receive times [ns]; 0 for what is no whole number.
        messages : sequence of object
            The messages; an empty one for what is not bytes.

        Returns
        -------
        Batch
            The batch.

        """
        stamps = np.array(
            [min(max(t, -LATEST), LATEST) if isinstance(t, int) else 0 for t in times],
            dtype=np.int64,
        )
        return cls.joined(topic, stamps, [m if isinstance(m, bytes) else b'' for m in messages])

    def messages(self) -> Iterator[tuple[int, bytes]]:
        """
        Go through the messages.

        Yields
        ------
        int, bytes
            Receive time [ns] and bytes.

        """
        for received, begin, end in zip(self.received, self.begin, self.end, strict=True):
            yield int(received), self.data[begin:end].tobytes()

    def decompressed(self, budget: Budget) -> Batch:
        """
        Decompress messages that were compressed one by one.

        Parameters
        ----------
        budget : Budget
            What they may unfold to.

        Returns
        -------
        Batch
            The same messages; a damaged one is empty.

        Raises
        ------
        RecordingError
            If they unfold to too much.

        """
        compression = _COMPRESSED.get(next(self.messages())[1][:4])
        if compression is None:
            return self
        parts = [b''] * len(self.received)
        for k, (_, data) in enumerate(self.messages()):
            with suppress(*DAMAGED):
                parts[k] = decompress(compression, data, budget.largest_message)
            budget.spend(len(parts[k]))
        return Batch.joined(self.topic, self.received, parts)


def grouped(rows: Iterable[tuple[Any, Any, Any]]) -> dict[Any, list[tuple[Any, Any]]]:
    """
    Group messages by topic.

    Parameters
    ----------
    rows : iterable of (key, time, message)
        Messages in the order of a file.

    Returns
    -------
    dict
        Times and messages by the key of their topic, in that order.

    """
    groups: dict[Any, list[tuple[Any, Any]]] = {}
    for key, received, data in rows:
        groups.setdefault(key, []).append((received, data))
    return groups


@dataclass(slots=True)
class Tally:
    """
    Counts what is read of a file.

    Attributes
    ----------
    counts : dict
        Messages by topic.
    wanted : callable
        Tells whether the messages of a topic are wanted.
    faults : list of str
        What is wrong with the file.
    budget : Budget
        What the file may unfold to.
    count, written : int
        Messages read of known topics, and messages that the file should have, if it says so.
    piece : int
        Number of the piece that is being read; the pieces of a file are in order of time.

    """

    counts: dict[Topic, int]
    wanted: Callable[[Topic], bool]
    faults: list[str]
    budget: Budget
    count: int = 0
    written: int | None = None
    piece: int = 0

    def __str__(self) -> str:
        of = '' if self.written is None else f' of {self.written}'
        return f'{self.count}{of} messages'

    def enter(self, topic: Topic | None, number: int) -> bool:
        """
        Count messages.

        Parameters
        ----------
        topic : Topic or None
            Their topic; None if it is unknown, which is a fault.
        number : int
            Number of messages.

        Returns
        -------
        bool
            Whether they are wanted.

        """
        if topic is None:
            self.faults.append(f'is damaged: {number} messages of an unknown topic')
            return False
        self.counts[topic] = self.counts.get(topic, 0) + number
        self.count += number
        return self.wanted(topic)
