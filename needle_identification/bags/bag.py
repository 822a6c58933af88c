# SPDX-License-Identifier: Apache-2.0
"""Read topics and messages of bags, also of incomplete or damaged bags."""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from heapq import heappop, heappush
from pathlib import Path
import sqlite3
from typing import Any, Final, NamedTuple

from needle_identification.bags.batch import MessageBatch, Tally
from needle_identification.bags.compression import Budget
from needle_identification.bags.files import files_of, form_of
from needle_identification.bags.mcap_file import DAMAGED_MCAP, indexed_topics, mcap_batches
from needle_identification.bags.sqlite_file import sqlite_batches
from needle_identification.bags.topics import BagTopic
from needle_identification.errors import RecordingError

_WINDOW: Final = 2**22  # size of the buffer for sorting messages by receive time [bytes]


def _ros1_batches(file: Path, tally: Tally) -> Iterator[MessageBatch]:
    # Lazy import: large, and needed for ROS 1 only.
    from needle_identification.bags.ros1_file import ros1_batches

    return ros1_batches(file, tally)


#: Readers by storage format.
_BATCHES: Final = {'.mcap': mcap_batches, '.db3': sqlite_batches, '.bag': _ros1_batches}


class Recorded(NamedTuple):
    """A message of a bag: receive time [ns], topic, and serialized message (CDR)."""

    received: int
    topic: BagTopic
    data: bytes


class Bag:
    """
    A recording on disk.

    Parameters
    ----------
    path : Path or str
        A rosbag2 folder, an ``.mcap`` or a ``.db3`` file, compressed or not, possibly
        truncated; or a ``.bag`` file of ROS 1.

    Examples
    --------
    >>> bag = Bag('bags/friction_01')
    >>> [topic.name for topic in bag.topics()]
    ['/base_wrench', '/joint_states', '/joint_trajectory', '/plant/configuration']
    >>> messages = bag.messages(lambda topic: topic.name == '/base_wrench')
    >>> next(messages).topic.type_name
    'geometry_msgs/msg/WrenchStamped'

    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        try:
            self._files, self._missing = files_of(self.path)
        except OSError as error:
            raise RecordingError(f'cannot read {path}: {error.strerror or error}') from error
        #: Number of messages by topic, and missing or damaged parts, up to the present position
        #: of `batches`.
        self.counts: dict[BagTopic, int] = {}
        self.losses = list(self._missing)

    def __repr__(self) -> str:
        return f'<Bag {self.path}>'

    def topics(self) -> tuple[BagTopic, ...]:
        """Return the topics with messages, by name; raise a `RecordingError` if there are none."""
        found: set[BagTopic] = set()
        for file in self._files:
            indexed = indexed_topics(file) if file.suffix == '.mcap' else None
            if indexed is None:
                found.update(self._count())
                break
            found.update(indexed)
        if not found:
            raise _empty(self)
        return tuple(sorted(found, key=lambda topic: (topic.name, topic.type_name)))

    def _count(self) -> Mapping[BagTopic, int]:
        for _ in self.batches(lambda _topic: False):
            pass
        return self.counts

    def batches(self, wanted: Callable[[BagTopic], bool]) -> Iterator[MessageBatch]:
        """Yield batches of messages of the selected topics, from the start of the bag."""
        for _, batch in self._pieces(wanted):
            yield batch

    def messages(self, wanted: Callable[[BagTopic], bool]) -> Iterator[Recorded]:
        """Yield messages of the selected topics in the order of receive time."""
        # A message stored more than 4 MB after its place in this order is yielded when it is read.
        waiting: list[tuple[int, int, BagTopic, bytes]] = []
        size = order = 0
        piece: tuple[Path, int] | None = None
        for current, batch in self._pieces(wanted):
            # Within a piece the messages are sorted by topic.
            while current != piece and size > _WINDOW:
                received, _, topic, data = heappop(waiting)
                size -= len(data)
                yield Recorded(received, topic, data)
            piece = current
            for received, data in batch.messages():
                # `order` keeps the order of the file at equal times.
                heappush(waiting, (received, order, batch.topic, data))
                size += len(data)
                order += 1
        while waiting:
            received, _, topic, data = heappop(waiting)
            yield Recorded(received, topic, data)

    def _pieces(
        self, wanted: Callable[[BagTopic], bool]
    ) -> Iterator[tuple[tuple[Path, int], MessageBatch]]:
        """Yield each batch with its file and its piece of the file."""
        self.counts.clear()
        self.losses[:] = self._missing
        for file in self._files:
            faults: list[str] = []
            tally = Tally(self.counts, wanted, faults, Budget(file))
            try:
                for batch in _BATCHES[form_of(file)](file, tally):
                    yield (file, tally.piece), batch
            except RecordingError as error:
                self.losses.append(str(error))
                continue
            except OSError as error:
                faults.append(f'cannot be read: {error.strerror or error}')
            except (*DAMAGED_MCAP, sqlite3.Error) as error:
                faults.append(f'is damaged: {error}')
            if faults:
                self.losses.append(f'{file.name} {faults[0]}; {tally} read'.replace('\n', ' '))


def message_counts(path: Path | str) -> dict[str, int]:
    """Return the number of messages of a bag by topic name, sorted by name."""
    bag = Bag(path)
    counts = Counter[str]()
    for topic, number in sorted(bag._count().items(), key=lambda item: item[0].name):
        counts[topic.name] += number
    if not counts:
        raise _empty(bag)
    return dict(counts)


def _empty(bag: Bag) -> RecordingError:
    return RecordingError('; '.join([f'{bag.path} holds no messages', *bag.losses]))


def read_topic(path: Path | str, topic: str) -> list[tuple[int, Any]]:
    """Return receive time [ns] and deserialized message of a topic, by its full name."""
    # Lazy import: large, and needed for deserialization only.
    from needle_identification.bags.messages import deserialize

    bag = Bag(path)
    topics = bag.topics()
    if topic not in (known.name for known in topics):
        listing = ', '.join(map(str, topics))
        raise RecordingError(f'{path} has no topic {topic}; it has {listing}')
    messages: list[tuple[int, Any]] = []
    try:
        for batch in bag.batches(lambda known: known.name == topic):
            for received, data in batch.messages():
                messages.append((received, deserialize(batch.topic, data)))
    except RecordingError as error:
        raise RecordingError(f'{path}: message {len(messages)} of {topic} {error}') from error
    return messages
