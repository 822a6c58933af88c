"""
Recordings on disk: writing MCAP bags, reading bags of any origin. No other file knows MCAP.

A bag is a rosbag2 folder, as `ros2 bag` makes and plays it. Reading takes files from the start
and in batches, so that one whose end is missing gives all it has, and a long one needs no more
memory than a short one. The records in a chunk are found by compiled code: in Python that would
take longer than all the rest.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import lru_cache
from heapq import heappop, heappush
from io import BytesIO
from pathlib import Path
import re
import sqlite3
import struct
from types import TracebackType
from typing import Any, Final, NamedTuple
import zlib

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Schema, Statistics
from mcap.writer import CompressionType, Writer
from needle_dynamics.compiled.cache import compiled
from needle_identification.bags.sqlite import sqlite_batches
from needle_identification.bags.storage import (
    Batch,
    BLOCK,
    BROKEN,
    decompressed,
    LARGEST,
    LATEST,
    MOST,
    OfferedQos,
    opened,
    skip,
    taken,
    Tally,
    Topic,
    topic_of,
    uncompressed,
)
from needle_identification.errors import RecordingError
import numpy as np
from numpy.typing import NDArray
from rosbags.serde import SerdeError
from rosbags.typesys import (
    get_types_from_idl,
    get_types_from_msg,
    get_typestore,
    Stores,
    TypesysError,
)
from rosbags.typesys.store import Typestore
import yaml

#: Compression of the chunks in a bag.
COMPRESSIONS: Final = {
    'zstd': CompressionType.ZSTD,
    'lz4': CompressionType.LZ4,
    'none': CompressionType.NONE,
}

_MAGIC: Final = b'\x89MCAP0\r\n'
_METADATA: Final = 'metadata.yaml'

#: Messages that are put in order of time while a bag is played [bytes].
_WINDOW: Final = 2**22

_FORMS: Final = 'valid: a rosbag2 folder, an .mcap or a .db3 file'

#: Kind and length of a record; start, end, size, checksum and the length of a name of a chunk;
#: the end of a file: a footer record and the magic bytes.
_HEAD: Final = struct.Struct('<BQ')
_CHUNK: Final = struct.Struct('<QQQII')
_TAIL: Final = struct.Struct('<BQQQI8s')

#: What readers of the storage formats raise at bytes that make no sense.
_BROKEN: Final = (*BROKEN, McapError, SerdeError, sqlite3.Error)


@lru_cache(maxsize=1)
def _jazzy() -> Typestore:
    return get_typestore(Stores.ROS2_JAZZY)


def message_type(type_name: str) -> Any:
    """
    Return the class of a standard message, for `encode`; no ROS is needed.

    Parameters
    ----------
    type_name : str
        Such as ``sensor_msgs/msg/JointState``.

    Raises
    ------
    RecordingError
        If the type is not one of ROS 2 Jazzy's.

    """
    try:
        return _jazzy().types[type_name]
    except KeyError:
        raise RecordingError(
            f'no definition of {type_name}; those of ROS 2 Jazzy are known'
        ) from None


def encode(message: Any) -> bytes:
    """Serialize a message made from a `message_type`."""
    return bytes(_jazzy().serialize_cdr(message, message.__msgtype__))


class Recorded(NamedTuple):
    """A message of a bag: when it was received [ns], its topic, its bytes."""

    received: int
    topic: Topic
    data: bytes


class BagWriter:
    """
    Writes serialized messages into a new rosbag2 folder, as they are.

    ``metadata.yaml`` is written last: a folder without it was not closed. What `flush` has
    passed on survives the end of the process, whatever ends it.

    Parameters
    ----------
    path : Path
        Folder to make.
    compression : str
        One of `COMPRESSIONS`.

    Raises
    ------
    RecordingError
        If the folder exists or cannot be made.

    """

    def __init__(self, path: Path, compression: str = 'zstd') -> None:
        self.path = path
        self._file = path / f'{path.name}_0.mcap'
        try:
            path.mkdir(parents=True)
            self._stream = self._file.open('xb')
            self._writer: Any = Writer(self._stream, compression=COMPRESSIONS[compression])
            self._writer.start('ros2')
            self.flush()
        except FileExistsError:
            raise RecordingError(f'{path} exists; a recording must go to a new folder') from None
        except OSError as error:
            raise RecordingError(f'cannot record to {path}: {error.strerror}') from error
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._topics: dict[str, dict[str, Any]] = {}
        self._counts: dict[str, int] = {}
        self._start, self._end = 2**63 - 1, 0

    @property
    def counts(self) -> Mapping[str, int]:
        """Messages written so far, by topic."""
        return dict(self._counts)

    @property
    def size(self) -> int:
        """Bytes written so far, without the chunk in progress."""
        return self._stream.tell()

    def add_topic(
        self, topic: str, type_name: str, offered: Sequence[OfferedQos] = (OfferedQos(),)
    ) -> None:
        """
        Announce a topic.

        Parameters
        ----------
        topic : str
            Full name.
        type_name : str
            Message type, such as ``geometry_msgs/msg/WrenchStamped``.
        offered : sequence of OfferedQos
            What its publishers offer.

        Raises
        ------
        RecordingError
            If the definition of the type is not known.

        """
        try:
            definition, _ = _jazzy().generate_msgdef(type_name, ros_version=2)
            type_hash = _jazzy().hash_rihs01(type_name)
        except TypesysError as error:
            raise RecordingError(
                f'no definition of {type_name}; those of ROS 2 Jazzy are known'
            ) from error
        if type_name not in self._schemas:
            self._schemas[type_name] = self._writer.register_schema(
                type_name, 'ros2msg', definition.encode()
            )
        profiles = [qos.as_mapping() for qos in offered]
        self._channels[topic] = self._writer.register_channel(
            topic,
            'cdr',
            self._schemas[type_name],
            {
                'offered_qos_profiles': yaml.safe_dump(profiles),
                'topic_type_hash': type_hash,
            },
        )
        self._counts[topic] = 0
        self._topics[topic] = {
            'name': topic,
            'type': type_name,
            'serialization_format': 'cdr',
            'offered_qos_profiles': profiles,
            'type_description_hash': type_hash,
        }

    def write(self, topic: str, data: bytes, receive_ns: int) -> None:
        """
        Write one serialized message of an announced topic.

        Parameters
        ----------
        topic : str
            Full name.
        data : bytes
            The message as it came over the wire (CDR).
        receive_ns : int
            When it was received, since the epoch [ns].

        """
        self._writer.add_message(self._channels[topic], receive_ns, data, receive_ns)
        self._counts[topic] += 1
        self._start = min(self._start, receive_ns)
        self._end = max(self._end, receive_ns)

    def flush(self) -> None:
        """Pass everything on to the operating system."""
        self._writer.flush()

    def close(self) -> None:
        """Complete the bag: index, then metadata."""
        self._writer.finish()
        self._stream.close()
        draft = self.path / f'{_METADATA}.tmp'
        draft.write_text(yaml.safe_dump(self._metadata(), sort_keys=False), encoding='utf-8')
        draft.replace(self.path / _METADATA)

    def abort(self) -> None:
        """Let go of the file without completing it, for when it can no longer be written."""
        with suppress(OSError):
            self._stream.close()

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is None:
            self.close()
        else:
            self.abort()

    def _metadata(self) -> dict[str, Any]:
        name = self._file.name
        return {
            'rosbag2_bagfile_information': {
                'version': 9,
                'storage_identifier': 'mcap',
                **self._extent(),
                'topics_with_message_count': [
                    {'topic_metadata': metadata, 'message_count': self._counts[topic]}
                    for topic, metadata in self._topics.items()
                ],
                'compression_format': '',
                'compression_mode': '',
                'relative_file_paths': [name],
                'files': [{'path': name, **self._extent()}],
                'custom_data': None,
                'ros_distro': 'jazzy',
            }
        }

    def _extent(self) -> dict[str, Any]:
        return {
            'duration': {'nanoseconds': max(0, self._end - self._start)},
            'starting_time': {'nanoseconds_since_epoch': self._start},
            'message_count': sum(self._counts.values()),
        }


class Bag:
    """
    A recording on disk, of any origin and in any state.

    Parameters
    ----------
    path : Path
        A rosbag2 folder, an ``.mcap`` or a ``.db3`` file, compressed or not.

    Attributes
    ----------
    counts : dict
        Messages by topic that `batches` has come across; those of an unknown channel are not.
    losses : list of str
        What is missing or broken, as far as `batches` has come.

    Raises
    ------
    RecordingError
        If there is no such recording.

    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self._files, self._missing = _files(path)
        except OSError as error:
            raise RecordingError(f'cannot read {path}: {error.strerror or error}') from error
        self.counts: dict[Topic, int] = {}
        self.losses = list(self._missing)

    def topics(self) -> tuple[Topic, ...]:
        """
        List the topics that have messages, in order of name.

        Raises
        ------
        RecordingError
            If there is none.

        """
        found: set[Topic] = set()
        for file in self._files:
            listed = _listed(file)
            if listed is None:
                for _ in self.batches(lambda _topic: False):
                    pass
                found.update(self.counts)
                break
            found.update(listed)
        if not found:
            raise RecordingError('; '.join([f'{self.path} holds no messages', *self.losses]))
        return tuple(sorted(found, key=lambda topic: (topic.name, topic.type_name)))

    def batches(self, wanted: Callable[[Topic], bool]) -> Iterator[Batch]:
        """Go through the bag from its start, yielding the messages of the topics wanted."""
        for _, batch in self._pieces(wanted):
            yield batch

    def messages(self, wanted: Callable[[Topic], bool]) -> Iterator[Recorded]:
        """
        Go through the bag in the order of receive time.

        A message of the topics wanted that lies further behind in the file than `_WINDOW` comes
        when it is met.
        """
        waiting: list[tuple[int, int, Topic, bytes]] = []
        size = order = 0
        piece: tuple[Path, int] | None = None
        for current, batch in self._pieces(wanted):
            # The messages of a piece come topic by topic.
            while current != piece and size > _WINDOW:
                received, _, topic, data = heappop(waiting)
                size -= len(data)
                yield Recorded(received, topic, data)
            piece = current
            for received, data in batch.messages():
                # In the file's order where times are equal, and topics never compared.
                heappush(waiting, (received, order, batch.topic, data))
                size += len(data)
                order += 1
        while waiting:
            received, _, topic, data = heappop(waiting)
            yield Recorded(received, topic, data)

    def _pieces(self, wanted: Callable[[Topic], bool]) -> Iterator[tuple[tuple[Path, int], Batch]]:
        """Yield batches with the piece of the bag that each is from."""
        self.counts.clear()
        self.losses[:] = self._missing
        for file in self._files:
            faults: list[str] = []
            tally = Tally(self.counts, wanted, faults)
            try:
                for batch in _BATCHES[_form(file)](file, tally):
                    yield (file, tally.piece), batch
            except RecordingError as error:
                self.losses.append(str(error))
                continue
            except OSError as error:
                faults.append(f'cannot be read: {error.strerror or error}')
            except _BROKEN as error:
                faults.append(f'is broken: {error}')
            if faults:
                self.losses.append(f'{file.name} {faults[0]}; {tally} read'.replace('\n', ' '))


def _form(file: Path) -> str:
    """Return ``.mcap`` or ``.db3``, '' for what is neither."""
    name = uncompressed(file)
    return name.suffix if name.suffix in _BATCHES else ''


def _files(path: Path) -> tuple[list[Path], list[str]]:
    """List the files of a bag in the order of recording, and what is amiss."""
    if not path.exists():
        raise RecordingError(f'{path} does not exist; {_FORMS}')
    if path.is_file():
        if path.suffix == '.bag':
            raise RecordingError(
                f'{path} is a recording of ROS 1; convert it first: '
                f'rosbags-convert --src {path} --dst {path.with_suffix("")}'
            )
        if not _form(path):
            raise RecordingError(f'{path} is not a recording; {_FORMS}')
        return [path], []
    # part_10 comes after part_9.
    found = sorted(
        (file for file in (path.iterdir() if path.is_dir() else ()) if file.is_file()),
        key=lambda file: [len(file.name), file.name],
    )
    files = {form: [file for file in found if _form(file) == form] for form in _BATCHES}
    chosen = files['.mcap'] or files['.db3']
    if not chosen:
        inside = min(path.glob(f'*/{_METADATA}'), default=None)
        hint = _FORMS if inside is None else f'name those inside, such as {inside.parent}'
        raise RecordingError(f'{path} holds no recording; {hint}')
    names = _names_in_metadata(path)
    if names is None:
        # Parts of one recording differ in a number at the end.
        if len({re.sub(r'_\d+$', '', uncompressed(file).stem) for file in chosen}) > 1:
            raise RecordingError(
                f'{path} holds several recordings; name them, such as {chosen[0]}'
            )
        return chosen, [f'no readable {_METADATA}: the recording was not closed']
    there = {file.name for file in chosen}
    losses = [f'{name} is missing' for name in names if name not in there]
    if there.isdisjoint(names):
        return chosen, losses
    losses += [
        f'{file.name} is not part of the recording by {_METADATA}, left out'
        for file in chosen
        if file.name not in names
    ]
    return [path / name for name in names if name in there], losses


def _names_in_metadata(folder: Path) -> list[str] | None:
    """Return the files of a bag by its metadata, None if that cannot be read."""
    try:
        document = yaml.safe_load((folder / _METADATA).read_text(encoding='utf-8'))
        paths = document['rosbag2_bagfile_information']['relative_file_paths']
        if not isinstance(paths, list):
            return None
        return list(dict.fromkeys(Path(str(name)).name for name in paths))
    except (OSError, yaml.YAMLError, KeyError, TypeError, ValueError, RecursionError):
        return None


def _listed(file: Path) -> set[Topic] | None:
    """List the topics of a file that have messages by its own index, None if it has none."""
    if file.suffix != '.mcap':
        return None
    channels = _Channels()
    try:
        with file.open('rb') as stream:
            stream.seek(-_TAIL.size, 2)
            footer, _, start, _, checksum, magic = _TAIL.unpack(stream.read())
            if (footer, magic) != (Opcode.FOOTER, _MAGIC) or not start or not checksum:
                return None
            stream.seek(start)
            # The checksum covers all up to itself.
            summary = stream.read()[: -4 - len(_MAGIC)]
        if zlib.crc32(summary) != checksum:
            return None
        for table in _tables(np.frombuffer(summary, dtype=np.uint8)):
            for kind, _, _, begin, end in table.T.tolist():
                channels.define(kind, summary[begin:end])
        return {channels.topics[id_] for id_, number in channels.counts.items() if number} or None
    except (OSError, *_BROKEN):
        return None


class _Channels:
    """Topics of an MCAP file by channel, and what its statistics say of them."""

    def __init__(self) -> None:
        self.topics: dict[int, Topic] = {}
        self.counts: dict[int, int] = {}
        self._schemas = {0: Schema(id=0, data=b'', encoding='', name='no type')}

    def define(self, kind: int, record: bytes) -> None:
        """Take in a record if it is a schema, a channel or the statistics."""
        stream = ReadDataStream(BytesIO(record))
        if kind == Opcode.SCHEMA:
            schema = Schema.read(stream)
            self._schemas[schema.id] = schema
        elif kind == Opcode.CHANNEL:
            channel = Channel.read(stream)
            schema = self._schemas[channel.schema_id]
            self.topics[channel.id] = topic_of(
                channel.topic,
                schema.name,
                channel.message_encoding,
                schema.encoding,
                schema.data.decode(errors='replace'),
                channel.metadata.get('offered_qos_profiles', ''),
            )
        elif kind == Opcode.STATISTICS:
            self.counts = Statistics.read(stream).channel_message_counts


@compiled
def _walk(data: NDArray[np.uint8], position: int, table: NDArray[np.int64]) -> tuple[int, int]:
    """
    Enter the whole records from a position on, as far as the table reaches.

    Rows: kind, channel, receive time [ns], begin and end of what the record holds; of a message,
    begin and end of its data. Returns the number of records and where the next one begins.
    """
    number, start = 0, np.int64(position)
    while number < table.shape[1] and len(data) - start >= 9:
        length = np.int64(0)
        for k in range(8):
            length |= np.int64(data[start + 1 + k]) << (8 * k)
        begin = start + 9
        if length < 0 or length > len(data) - begin:
            break
        kind = data[start]
        start = begin + length
        table[0, number] = kind
        table[3, number] = begin
        table[4, number] = start
        if kind == 5 and length < 22:
            table[0, number] = 0
        elif kind == 5:
            received = np.int64(0)
            for k in range(8):
                received |= np.int64(data[begin + 6 + k]) << (8 * k)
            table[1, number] = np.int64(data[begin]) | np.int64(data[begin + 1]) << 8
            table[2, number] = received if 0 <= received < LATEST else LATEST
            table[3, number] = begin + 22
        number += 1
    return number, int(start)


def _tables(data: NDArray[np.uint8]) -> Iterator[NDArray[np.int64]]:
    """Yield tables of the records in a piece of an MCAP file, as `_walk` makes them."""
    table = np.empty((5, MOST), dtype=np.int64)
    number, position = MOST, 0
    while number == MOST:
        number, position = _walk(data, position, table)
        yield table[:, :number]


def _mcap_batches(file: Path, tally: Tally) -> Iterator[Batch]:
    channels = _Channels()
    loose = bytearray()
    complete = False
    with opened(file) as stream:
        magic = taken(stream, len(_MAGIC))
        if magic != _MAGIC:
            begin = repr(magic) if magic else 'nothing'
            raise RecordingError(f'{file.name} is not an MCAP file: begins with {begin}')
        while len(head := taken(stream, _HEAD.size)) == _HEAD.size:
            kind, length = _HEAD.unpack(head)
            if kind in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE, Opcode.CHUNK):
                if length > LARGEST:
                    tally.faults.append(f'is broken: a record of {length} bytes')
                    break
                body = taken(stream, length)
                if kind != Opcode.CHUNK:
                    loose += head + body
                if kind == Opcode.CHUNK or len(loose) > BLOCK:
                    yield from _records(bytes(loose), channels, tally)
                    loose.clear()
                if kind == Opcode.CHUNK:
                    yield from _records(_content(body, length, tally), channels, tally)
            elif kind == Opcode.STATISTICS:
                tally.written = int.from_bytes(taken(stream, length)[:8], 'little')
            else:
                skip(stream, length)
                complete |= kind == Opcode.DATA_END
            if kind == Opcode.FOOTER:
                break
    yield from _records(bytes(loose), channels, tally)
    if not complete:
        tally.faults.insert(0, 'is cut off')
    if tally.written not in (None, tally.count):
        tally.faults.append('has lost messages')


def _content(chunk: bytes, length: int, tally: Tally) -> bytes:
    """Return what is in a chunk; of one that is cut off, what there is; none if it is broken."""
    try:
        _, _, size, checksum, name_length = _CHUNK.unpack_from(chunk)
        begin = _CHUNK.size + name_length + 8
        if size > LARGEST:
            raise ValueError(f'a chunk of {size} bytes')
        data = decompressed(chunk[_CHUNK.size : begin - 8].decode(), chunk[begin:], size)
        if len(chunk) == length:
            if len(data) != size:
                raise ValueError(f'a chunk of {len(data)} instead of {size} bytes')
            if checksum not in (0, zlib.crc32(data)):
                raise ValueError('the checksum of a chunk is wrong')
    except _BROKEN as error:
        tally.faults.append(f'is broken: {error}')
        return b''
    return data


def _records(content: bytes, channels: _Channels, tally: Tally) -> Iterator[Batch]:
    """Yield the messages among the records of a chunk."""
    data = np.frombuffer(content, dtype=np.uint8)
    for table in _tables(data):
        kinds, ids, received, begin, end = table
        for k in np.flatnonzero((kinds == Opcode.SCHEMA) | (kinds == Opcode.CHANNEL)):
            # What cannot be read leaves messages of an unknown topic.
            with suppress(*_BROKEN):
                channels.define(kinds[k], content[begin[k] : end[k]])
        messages = kinds == Opcode.MESSAGE
        tally.piece += 1
        for id_ in np.flatnonzero(np.bincount(ids[messages])):
            rows = np.flatnonzero(messages & (ids == id_))
            topic = channels.topics.get(int(id_))
            if topic is None:
                tally.faults.append(f'is broken: {len(rows)} messages of an unknown topic')
            elif tally.enter(topic, len(rows)):
                yield Batch(topic, received[rows], data, begin[rows], end[rows]).plain()


#: Readers of the forms of storage.
_BATCHES: Final = {'.mcap': _mcap_batches, '.db3': sqlite_batches}


@lru_cache(maxsize=64)
def _typestore(type_name: str, encoding: str, definition: str) -> Typestore:
    """Return a store that knows a type: Jazzy's, else one with the definition from the bag."""
    known = _jazzy().fielddefs
    if type_name in known:
        return _jazzy()
    store = get_typestore(Stores.ROS2_JAZZY)
    try:
        if encoding == 'ros2msg':
            types = get_types_from_msg(definition, type_name)
        else:
            types = {}
            for part in re.split(r'^=+\nIDL: .*\n', definition, flags=re.MULTILINE):
                types.update(get_types_from_idl(part) if part.strip() else {})
        store.register({name: fields for name, fields in types.items() if name not in known})
    except TypesysError as error:
        raise RecordingError(f'the definition of {type_name} is not readable: {error}') from error
    if type_name not in store.fielddefs:
        raise RecordingError(f'the bag does not hold the definition of {type_name}')
    return store


def message_counts(path: Path) -> dict[str, int]:
    """
    Count the messages of a bag by topic.

    Raises
    ------
    RecordingError
        If it is not readable or empty.

    """
    bag = Bag(path)
    for _ in bag.batches(lambda _topic: False):
        pass
    if not bag.counts:
        raise RecordingError('; '.join([f'{path} holds no messages', *bag.losses]))
    counts: dict[str, int] = {}
    for topic, count in sorted(bag.counts.items(), key=lambda item: item[0].name):
        counts[topic.name] = counts.get(topic.name, 0) + count
    return counts


def check_distinct(paths: Sequence[Path]) -> None:
    """
    Refuse to count a recording twice: it would make the errors look smaller than they are.

    Raises
    ------
    RecordingError
        Naming the recording.

    """
    seen: set[Path] = set()
    for path in paths:
        if path.resolve() in seen:
            raise RecordingError(f'{path} is given twice; each recording counts once')
        seen.add(path.resolve())


def read_topic(path: Path, topic: str) -> list[tuple[int, Any]]:
    """
    Read one topic of a bag.

    Parameters
    ----------
    path : Path
        A rosbag2 folder, an ``.mcap`` or a ``.db3`` file; the end may be missing.
    topic : str
        Full name.

    Returns
    -------
    list of (int, message)
        Receive time [ns] and decoded message.

    Raises
    ------
    RecordingError
        If the bag is not readable or has no such topic.

    """
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


def deserialize(topic: Topic, data: bytes) -> Any:
    """
    Decode one message of a topic.

    Raises
    ------
    RecordingError
        If it is not of its type, or if that is not known.

    """
    store = _typestore(topic.type_name, topic.encoding, topic.definition)
    try:
        return store.deserialize_cdr(data, topic.type_name)
    except _BROKEN as error:
        raise RecordingError(f'is not a {topic.type_name}: {error}') from error
