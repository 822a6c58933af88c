# SPDX-License-Identifier: Apache-2.0
"""Batches of messages of one topic as arrays, and counts of the messages read from a file."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

from needle_identification.bags.compression import Budget, COSTLY, DAMAGED, decompress
from needle_identification.bags.topics import BagTopic
import numpy as np
from numpy.typing import NDArray

LARGEST_BATCH: Final = 2**14  #: largest number of messages in a batch
LATEST: Final = 2**62  #: upper limit of receive times: differences fit in 64 bits [ns]

#: Magic bytes of compressed messages; others begin with 0.
_COMPRESSED: Final = {b'\x28\xb5\x2f\xfd': 'zstd', b'\x04\x22\x4d\x18': 'lz4'}


class MessageBatch(NamedTuple):
    """Messages (m,) of one topic, in the order of the file."""

    topic: BagTopic
    received: NDArray[np.int64]  # receive times [ns]
    data: NDArray[np.uint8]  # bytes of the messages
    begin: NDArray[np.int64]  # offset of each message
    end: NDArray[np.int64]

    @classmethod
    def joined(
        cls, topic: BagTopic, received: NDArray[np.int64], messages: Sequence[bytes]
    ) -> MessageBatch:
        """Build a batch from separate messages and their receive times [ns], shape (m,)."""
        lengths = np.array([len(message) for message in messages], dtype=np.int64)
        end = np.cumsum(lengths)
        data = np.frombuffer(b''.join(messages), dtype=np.uint8)
        return cls(topic, received, data, end - lengths, end)

    @classmethod
    def of_times(
        cls, topic: BagTopic, times: Sequence[Any], messages: Sequence[Any]
    ) -> MessageBatch:
        """Build a batch from values of a file; invalid times are 0, invalid messages empty."""
        valid = [min(max(t, -LATEST), LATEST) if isinstance(t, int) else 0 for t in times]
        stamps = np.array(valid, dtype=np.int64)
        return cls.joined(topic, stamps, [m if isinstance(m, bytes) else b'' for m in messages])

    def messages(self) -> Iterator[tuple[int, bytes]]:
        for received, begin, end in zip(self.received, self.begin, self.end, strict=True):
            yield int(received), self.data[begin:end].tobytes()

    def decompressed(self, budget: Budget) -> MessageBatch:
        """Decompress messages that were compressed one by one; a damaged message becomes empty."""
        compression = _COMPRESSED.get(next(self.messages())[1][:4])
        if compression is None:
            return self
        parts = [b''] * len(self.received)
        for k, (_, data) in enumerate(self.messages()):
            with suppress(*DAMAGED):
                parts[k] = decompress(compression, data, budget.largest_message)
            budget.spend(len(parts[k]), COSTLY)
        return MessageBatch.joined(self.topic, self.received, parts)


def grouped(rows: Iterable[tuple[Any, Any, Any]]) -> dict[Any, list[tuple[Any, Any]]]:
    """Group rows (key, time, message) by the key of their topic, in the order of the file."""
    groups: dict[Any, list[tuple[Any, Any]]] = {}
    for key, received, data in rows:
        groups.setdefault(key, []).append((received, data))
    return groups


@dataclass(slots=True)
class Tally:
    """Counts of the messages read from a file."""

    counts: dict[BagTopic, int]
    wanted: Callable[[BagTopic], bool]  # whether to read the messages of a topic
    faults: list[str]
    budget: Budget
    count: int = 0  # messages read of known topics
    written: int | None = None  # messages by the statistics of the file
    piece: int = 0  # number of the piece of the file, in order of time

    def __str__(self) -> str:
        of = '' if self.written is None else f' of {self.written}'
        return f'{self.count}{of} messages'

    def enter(self, topic: BagTopic | None, number: int) -> bool:
        """Count messages of a topic (None: unknown, a fault); return whether it is selected."""
        self.budget.spend(0, COSTLY)
        if topic is None:
            self.faults.append(f'is damaged: {number} messages of an unknown topic')
            return False
        self.counts[topic] = self.counts.get(topic, 0) + number
        self.count += number
        return self.wanted(topic)
