# SPDX-License-Identifier: Apache-2.0
"""Topics of a bag, the quality of service (QoS) of their publishers, batches of messages."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
import re
from typing import Any, Final, NamedTuple

from needle_identification.bags.compression import Budget, COSTLY, DAMAGED, decompress
from needle_ros.errors import shown
from needle_ros.files import DocumentError, read_document
from needle_ros.timing import NANOSECONDS
import numpy as np
from numpy.typing import NDArray

#: Policies of a QoS, with the names of rosbag2 for the numbers in older recordings.
WORDS: Final[Mapping[str, Mapping[Any, str]]] = {
    'reliability': {1: 'reliable', 2: 'best_effort'},
    'durability': {1: 'transient_local', 2: 'volatile'},
    'history': {1: 'keep_last', 2: 'keep_all'},
    'liveliness': {1: 'automatic', 3: 'manual_by_topic'},
}

DURATIONS: Final = ('deadline', 'lifespan', 'liveliness_lease_duration')  #: times of a QoS
UNLIMITED: Final = 2**63 - 1  #: value of the middleware for no limit [ns]

LARGEST_BATCH: Final = 2**14  #: largest number of messages in a batch
LATEST: Final = 2**62  #: upper limit of receive times: differences fit in 64 bits [ns]

#: Magic bytes of compressed messages; others begin with 0.
_COMPRESSED: Final = {b'\x28\xb5\x2f\xfd': 'zstd', b'\x04\x22\x4d\x18': 'lz4'}


class OfferedQos(NamedTuple):
    """Quality of service that a publisher offers, with the names of rosbag2; times in ns."""

    reliability: str = 'reliable'  # or best_effort
    durability: str = 'volatile'  # or transient_local
    history: str = 'keep_last'  # or keep_all
    depth: int = 10  # number of messages that are kept
    deadline: int = UNLIMITED  # longest time between messages
    lifespan: int = UNLIMITED  # longest lifetime of a message
    liveliness: str = 'automatic'  # or manual_by_topic
    liveliness_lease_duration: int = UNLIMITED  # longest time without a signal of the publisher

    def as_mapping(self) -> dict[str, Any]:
        times = {}
        for name in DURATIONS:
            sec, nsec = divmod(getattr(self, name), NANOSECONDS)
            times[name] = {'sec': sec, 'nsec': nsec}
        return {**self._asdict(), **times, 'avoid_ros_namespace_conventions': False}


def _stored(profile: Mapping[str, Any]) -> OfferedQos:
    """Return a profile in the storage format of rosbag2; older ones have no liveliness."""
    words = {
        name: known.get(profile[name], profile[name])
        for name, known in WORDS.items()
        if name in profile or name != 'liveliness'
    }
    times: dict[str, Any] = {name: _nanoseconds(profile.get(name)) for name in DURATIONS}
    return OfferedQos(depth=int(profile['depth']), **words, **times)


def _nanoseconds(time: Mapping[str, int] | None) -> int:
    """Convert a stored time to ns; None, zero and negative times mean no limit."""
    if time is None:
        return UNLIMITED
    found = int(time['sec']) * NANOSECONDS + int(time['nsec'])
    return found if 0 < found < UNLIMITED else UNLIMITED


@dataclass(frozen=True, slots=True)
class BagTopic:
    """A topic in a bag."""

    name: str  #: full name
    #: Type, such as ``sensor_msgs/msg/JointState``. A message encoding other than CDR (ROS 2)
    #: follows the type in brackets, which makes it an unknown type.
    type_name: str
    #: Language of the definition of the type, ``ros2msg`` or ``ros2idl``, and the definition.
    encoding: str = field(default='', compare=False)
    definition: str = field(default='', compare=False, repr=False)
    #: YAML of the QoS that the publishers offered, for `offered_qos`.
    profiles: str = field(default='', compare=False, repr=False)

    def __str__(self) -> str:
        return f'{self.name} ({self.type_name})'

    def offered_qos(self) -> tuple[OfferedQos, ...]:
        """Return the QoS that each publisher offered; empty if missing or not readable."""
        try:
            return tuple(map(_stored, read_document(self.profiles) or []))
        except (DocumentError, AttributeError, KeyError, TypeError, ValueError, OverflowError):
            return ()


def make_topic(
    name: str,
    type_name: str,
    message_encoding: str,
    encoding: str = '',
    definition: str = '',
    profiles: str = '',
) -> BagTopic:
    """Build a topic; ``std_msgs/String`` (ROS 1, some writers) becomes ``std_msgs/msg/String``."""
    full = re.sub(r'^(\w+)/(\w+)$', r'\1/msg/\2', type_name)
    full = full if message_encoding == 'cdr' else f'{full} [{message_encoding}]'
    # Escaped names keep error messages of damaged files on one line.
    return BagTopic(shown(name), shown(full), encoding, definition, profiles)


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
