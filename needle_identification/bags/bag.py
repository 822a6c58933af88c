# SPDX-License-Identifier: Apache-2.0
"""Read topics, messages and columns of bags, also of incomplete or damaged bags."""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, is_dataclass
from heapq import heappop, heappush
from itertools import pairwise
from pathlib import Path
import re
import sqlite3
from typing import Any, Final, NamedTuple

from needle_dynamics.display import Displayed
from needle_identification.bags.compression import Budget, COMPRESSED
from needle_identification.bags.mcap_file import (
    DAMAGED_MCAP,
    indexed_span,
    indexed_topics,
    mcap_batches,
)
from needle_identification.bags.sqlite_file import sqlite_batches
from needle_identification.bags.topics import BagTopic, MessageBatch, Tally
from needle_identification.errors import RecordingError, UnknownNameError
from needle_ros.errors import printable
from needle_ros.files import DocumentError, LARGEST, read_document
from needle_ros.timing import NANOSECONDS
import numpy as np
from numpy.typing import NDArray

METADATA: Final = 'metadata.yaml'  #: lists the other files, written at the end
LOST: Final = 'messages lost'  #: key of the metadata for the messages that the recorder lost

_FORMS: Final = ('.mcap', '.db3', '.bag')

#: Suffixes of tables, which take the place of a bag in some identifications.
MATLAB: Final = '.mat'
TABLES: Final = ('.csv', '.tsv', '.txt', '.dat', MATLAB)

_BAGS: Final = 'valid: a rosbag2 folder, an .mcap or a .db3 file, or a .bag file of ROS 1'
_VALID: Final = f'{_BAGS}; for friction, steering and sensor also a table ({", ".join(TABLES)})'

_PAUSE: Final = NANOSECONDS  # between parts of one recording, this long or longer [ns]

_WINDOW: Final = 2**22  # size of the buffer for sorting messages by receive time [bytes]

_MOST: Final = 64  #: largest number of elements of a sequence that are columns of their own
_LABELS: Final = ('name', 'names', 'joint_names')  # names of elements of other fields


def form_of(file: Path) -> str:
    """Return the storage format by file name: ``.mcap``, ``.db3``, ``.bag`` (ROS 1), or ''."""
    suffix = _uncompressed(file).suffix
    return suffix if suffix in _FORMS else ''


def _uncompressed(file: Path) -> Path:
    return file.with_suffix('') if file.suffix in COMPRESSED else file


def files_of(path: Path) -> tuple[list[Path], list[str]]:
    """List the files of a bag in the order of recording, and its missing or foreign files."""
    # A table comes here from a reader of bags only.
    valid = _BAGS if path.suffix.lower() in TABLES else _VALID
    if not path.exists():
        raise RecordingError(f'{path} does not exist; {valid}')
    if path.is_file():
        if not form_of(path):
            raise RecordingError(f'{path} is not a recording; {valid}')
        return [path], []
    inside = path.iterdir() if path.is_dir() else ()
    found = _in_order(filter(Path.is_file, inside))
    by_form = {form: [file for file in found if form_of(file) == form] for form in _FORMS}
    chosen = next(filter(None, by_form.values()), [])
    if not chosen:
        other = min(path.glob(f'*/{METADATA}'), default=None)
        hint = _VALID if other is None else f'name those inside, such as {other.parent}'
        with suppress(OSError, DocumentError, UnicodeDecodeError, KeyError, TypeError):
            if listed := _metadata(path)[0]:
                raise RecordingError(f'{path} holds no recording: {", ".join(listed)} is missing')
        raise RecordingError(f'{path} holds no recording; {hint}')
    names, losses = None, [f'no readable {METADATA}: the recording was not closed']
    try:
        names, lost = _metadata(path)
    except DocumentError as error:
        losses = [f'{METADATA} {error}']
    except (OSError, UnicodeDecodeError, KeyError, TypeError):
        # Missing, or of an unknown structure.
        pass
    if names is None:
        by_time = not (path / METADATA).exists()
        if len(recordings_among(chosen, by_time=by_time)) > 1:
            several = f'{path} holds several recordings; name them, such as {chosen[0]}'
            raise RecordingError('; '.join([several, *([] if by_time else losses)]))
        return chosen, [*losses, *_missing_parts(chosen)]
    there = {file.name for file in chosen}
    losses = [f'the recorder lost {lost}'] if lost else []
    losses += [f'{name} is missing' for name in names if name not in there]
    if there.isdisjoint(names):
        return chosen, losses
    losses += [
        f'{file.name} is not part of the recording by {METADATA}, left out'
        for file in chosen
        if file.name not in names
    ]
    return [path / name for name in names if name in there], losses


def recordings_among(files: Iterable[Path], *, by_time: bool = True) -> list[list[Path]]:
    """Group data files of bags by recording: parts of a split one continue in name and time."""
    # The names of parts differ only in a number at the end.
    alike: dict[tuple[str, str], list[Path]] = {}
    for file in _in_order(files):
        stem = re.sub(r'_\d+$', '', _uncompressed(file).stem)
        alike.setdefault((stem, form_of(file)), []).append(file)
    groups: list[list[Path]] = []
    for parts in alike.values():
        joined = len(parts) == 1 or not by_time or _continue(parts)
        groups += [parts] if joined else [[part] for part in parts]
    return groups


def _missing_parts(parts: Sequence[Path]) -> list[str]:
    """Return a line for each part of a split recording that its numbers lack."""
    numbered = re.compile(r'(.*_)(\d+)')
    found = [numbered.fullmatch(_uncompressed(part).stem) for part in parts]
    if len(parts) < 2 or not all(found):
        return []
    numbers = {int(match[2]): match[1] for match in found if match}
    stem = numbers[min(numbers)]
    gaps = ((low + 1, high - 1) for low, high in pairwise(sorted(numbers)) if high > low + 1)
    return [
        f'{stem}{low} is missing' if low == high else f'{stem}{low} to {stem}{high} are missing'
        for low, high in gaps
    ]


def _in_order(files: Iterable[Path]) -> list[Path]:
    # Part_10 is after part_9.
    return sorted(files, key=lambda file: [len(file.name), file.name])


def _continue(parts: Sequence[Path]) -> bool:
    """Return whether each file begins at the end of the previous one, if times are readable."""
    return all(
        not before or not after or abs(after[0] - before[1]) < _PAUSE
        for before, after in pairwise(map(_span, parts))
    )


def _span(file: Path) -> tuple[int, int] | None:
    """Return the first and the last receive time [ns] of a file, None without messages."""
    if file.suffix == '.bag':
        return _ros1_span(file)
    if file.suffix == '.mcap' and (span := indexed_span(file)):
        return span
    times: list[int] = []
    tally = Tally({}, lambda _topic: True, [], Budget(file))
    with suppress(RecordingError, OSError, sqlite3.Error, *DAMAGED_MCAP):
        for batch in _BATCHES[form_of(file)](file, tally):
            times += [int(batch.received.min()), int(batch.received.max())]
    return (min(times), max(times)) if times else None


def _metadata(folder: Path) -> tuple[list[str], str]:
    """Return the files listed in the metadata of a bag, and its lost messages."""
    if not (folder / METADATA).is_file():
        # Not a pipe, either, which may never end.
        raise FileNotFoundError(METADATA)
    with (folder / METADATA).open(encoding='utf-8') as stream:
        document = read_document(stream.read(LARGEST + 1))
    information = document['rosbag2_bagfile_information']
    paths = information['relative_file_paths']
    if not isinstance(paths, list):
        raise TypeError('relative_file_paths is not a list')
    own = information.get('custom_data') or {}
    lost = printable(str(own.get(LOST, ''))) if isinstance(own, dict) else ''
    return list(dict.fromkeys(Path(str(name)).name for name in paths)), lost


def _ros1_span(file: Path) -> tuple[int, int] | None:
    # Lazy import, as for the messages.
    from needle_identification.bags.ros1_file import ros1_span

    with suppress(RecordingError, OSError):
        return ros1_span(file)
    return None


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


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class TopicTable(Displayed):
    """Messages of a topic by field; ``table[name]`` is a column."""

    topic: str  #: full name
    #: Fields, shape (n,) each: ``time [s]`` since the first message, by the header if it has a
    #: stamp, and receive time; then the fields, such as ``wrench.force.y``.
    values: Mapping[str, NDArray[Any]]

    def __getitem__(self, name: str) -> NDArray[Any]:
        try:
            return self.values[name]
        except KeyError:
            raise UnknownNameError(f'{name!r}; valid: {", ".join(self.values)}') from None

    def __iter__(self) -> Iterator[str]:
        return iter(self.values)

    def __repr__(self) -> str:
        time = self.values['time [s]']
        return f'<TopicTable {self.topic}: {len(time)} messages in {time[-1] - time[0]:.4g} s>'

    def columns(self) -> dict[str, NDArray[Any]]:
        return dict(self.values)


def read_bag(path: Path | str, topic: str) -> TopicTable:
    """
    Read one topic of a bag as arrays, of any message type that ROS 2 Jazzy or the bag defines.

    Elements of sequences are columns, such as ``data[0]``, and ``position.insertion`` if the
    message names them. Times are integers in ns, such as ``header.stamp [ns]``. A missing number
    is NaN. Sequences with more than 64 elements, such as images, are arrays in one column.

    Parameters
    ----------
    path : Path or str
        As in `Bag`.
    topic : str
        Name, with or without the first slash.

    Returns
    -------
    TopicTable
        Columns, with `to_dataframe` and `plot`.

    Examples
    --------
    >>> table = read_bag('bags/friction_01', '/joint_states')
    >>> table['position.insertion'].shape == table['time [s]'].shape
    True

    """
    name = f'/{topic.removeprefix("/")}'
    messages = read_topic(path, name)
    received = np.array([time for time, _ in messages], dtype=np.int64)
    rows = [dict(_leaves('', message)) for _, message in messages]
    names = dict.fromkeys(key for row in rows for key in row)
    found = {key: _column([row.get(key) for row in rows]) for key in names}
    stamps = found.get('header.stamp [ns]', received)
    if not stamps.any():
        # The driver does not stamp. Simulated time begins at zero.
        stamps = received
    time = (stamps - stamps[:1]) / NANOSECONDS
    return TopicTable(name, {'time [s]': time, 'received [ns]': received, **found})


def _leaves(name: str, value: Any, labels: Sequence[str] = ()) -> Iterator[tuple[str, Any]]:
    """Yield the numbers and texts in a message, with their names; times in ns."""
    if is_dataclass(value):
        parts = {p.name: getattr(value, p.name) for p in fields(value) if p.name != '__msgtype__'}
        if [*parts] == ['sec', 'nanosec']:
            yield f'{name} [ns]'.lstrip(), parts['sec'] * NANOSECONDS + parts['nanosec']
            return
        found = next((part for part in _LABELS if isinstance(parts.get(part), list)), '')
        for part, inner in parts.items():
            whole = f'{name}.{part}' if name else part
            yield from _leaves(whole, inner, parts.get(found, ()))
    elif isinstance(value, (list, np.ndarray)) and len(value) <= _MOST:
        named = labels if len(labels) == len(value) else ()
        for k, one in enumerate(value):
            yield from _leaves(f'{name}.{named[k]}' if named else f'{name}[{k}]', one)
    else:
        yield name, value


def _column(values: list[Any]) -> NDArray[Any]:
    """Return values of one field as an array; NaN for a missing number."""
    known = [one for one in values if one is not None]
    if all(isinstance(one, (bool, int, float, np.number)) for one in known):
        complete = len(known) == len(values)
        return np.array(values if complete else [np.nan if v is None else v for v in values])
    result = np.empty(len(values), dtype=object)
    result[:] = values
    return result
