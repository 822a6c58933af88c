"""
Recordings on disk: writing MCAP bags, reading bags of any origin. No other file knows MCAP.

A bag is a rosbag2 folder, as `ros2 bag` makes and plays it. Reading takes MCAP record by record
from the start, so that a file whose end is missing gives all it has.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
import re
import struct
from types import TracebackType
from typing import Any, Final, NamedTuple

import apsw
from mcap.exceptions import EndOfFile, McapError
from mcap.records import Channel, DataEnd, Message, Schema, Statistics
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer
from needle_dynamics import FloatArray
from needle_identification.errors import RecordingError
from needle_identification.recording import Recording
import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import MessageDefinitionFormat
from rosbags.rosbag2 import Reader, ReaderError
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
from zstandard import ZstdError

#: Compression of the chunks in a bag.
COMPRESSIONS: Final = {
    'zstd': CompressionType.ZSTD,
    'lz4': CompressionType.LZ4,
    'none': CompressionType.NONE,
}

_WRENCH: Final = 'geometry_msgs/msg/WrenchStamped'
_MOTION: Final = 'sensor_msgs/msg/JointState'
_TEXT: Final = 'std_msgs/msg/String'
_MAGIC: Final = b'\x89MCAP0\r\n'
_METADATA: Final = 'metadata.yaml'
_FORMS: Final = 'valid: a rosbag2 folder, an .mcap or a .db3 file'

#: Motion is not interpolated over a longer step between samples [sample periods].
_GAP: Final = 10.0

#: What the readers of the storage formats raise at bytes that make no sense.
_BROKEN: Final = (
    McapError,
    ReaderError,
    ZstdError,
    apsw.Error,
    struct.error,
    AssertionError,
    KeyError,
    MemoryError,
    OverflowError,
    RuntimeError,
    TypeError,
    ValueError,
)


class OfferedQos(NamedTuple):
    """Quality of service that a publisher offers, in the words of rosbag2."""

    reliability: str = 'reliable'
    durability: str = 'volatile'
    history: str = 'keep_last'
    depth: int = 10

    def as_mapping(self) -> dict[str, Any]:
        """Return the profile as rosbag2 stores it; what is not known is without limit."""
        forever = {'sec': 9223372036, 'nsec': 854775807}
        return {
            'history': self.history,
            'depth': self.depth,
            'reliability': self.reliability,
            'durability': self.durability,
            'deadline': dict(forever),
            'lifespan': dict(forever),
            'liveliness': 'automatic',
            'liveliness_lease_duration': dict(forever),
            'avoid_ros_namespace_conventions': False,
        }


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


@dataclass(slots=True)
class _Topic:
    """What a bag holds of one topic; ``messages`` are receive times [ns] and bytes."""

    type_name: str
    encoding: str
    definition: str
    count: int = 0
    messages: list[tuple[int, bytes]] = field(default_factory=list)


@dataclass(slots=True)
class _Contents:
    """What a bag holds; messages only of the topics that were wanted."""

    path: Path
    topics: dict[str, _Topic] = field(default_factory=dict)
    losses: list[str] = field(default_factory=list)

    def listing(self) -> str:
        return ', '.join(f'{name} ({t.type_name})' for name, t in sorted(self.topics.items()))

    def decoded(self, name: str) -> Iterator[tuple[int, Any]]:
        """Yield receive time [ns] and message of a topic that was wanted."""
        topic = self.topics[name]
        store = _typestore(topic.type_name, topic.encoding, topic.definition)
        number = 0
        try:
            for stamp, data in topic.messages:
                yield stamp, store.deserialize_cdr(data, topic.type_name)
                number += 1
        except (SerdeError, *_BROKEN) as error:
            raise RecordingError(
                f'{self.path}: message {number} of {name} is not a {topic.type_name}: {error}'
            ) from error


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


def _scan(path: Path, wanted: Callable[[str, str], bool]) -> _Contents:
    """Read a bag once, keeping the messages of those topics (name, type) that are wanted."""
    contents = _Contents(path)
    try:
        for file in _files(contents):
            _scan_file(file, contents, wanted)
    except OSError as error:
        raise RecordingError(f'cannot read {path}: {error.strerror or error}') from error
    if not contents.topics:
        raise RecordingError('; '.join([f'{path} holds no messages', *contents.losses]))
    return contents


def _scan_file(file: Path, contents: _Contents, wanted: Callable[[str, str], bool]) -> None:
    records = _mcap_records(file) if file.suffix == '.mcap' else _other_records(file)
    count = 0
    try:
        for name, channel, stamp, data in records:
            topic = contents.topics.setdefault(name, channel)
            topic.count += 1
            if wanted(name, topic.type_name):
                topic.messages.append((stamp, data))
            count += 1
    except (EndOfFile, struct.error):
        contents.losses.append(f'{file.name} is cut off after {count} messages')
    except _BROKEN as error:
        contents.losses.append(f'{file.name} is broken after {count} messages: {error}')


def _files(contents: _Contents) -> list[Path]:
    """List the files of a bag in the order of recording, noting what is amiss."""
    path = contents.path
    if not path.exists():
        raise RecordingError(f'{path} does not exist; {_FORMS}')
    if path.is_file():
        if path.suffix not in ('.mcap', '.db3'):
            raise RecordingError(f'{path} is not a recording; {_FORMS}')
        return [path]
    found = [*path.glob('*.mcap')] or [*path.glob('*.db3')]
    metadata = _metadata(path)
    if metadata is None:
        contents.losses.append(f'no readable {_METADATA}: the recording was not closed')
    elif metadata.get('compression_mode') in ('FILE', 'MESSAGE', 'file', 'message'):
        return [path]
    else:
        paths = metadata.get('relative_file_paths')
        listed = {Path(str(name)).name for name in paths} if isinstance(paths, list) else set()
        for name in sorted(listed - {file.name for file in found}):
            contents.losses.append(f'{name} is missing')
    if not found:
        raise RecordingError(f'{path} holds no recording; {_FORMS}')
    # part_10 comes after part_9.
    return sorted(found, key=lambda file: [len(file.name), file.name])


def _metadata(folder: Path) -> dict[str, Any] | None:
    try:
        document = yaml.safe_load((folder / _METADATA).read_text(encoding='utf-8'))
        return dict(document['rosbag2_bagfile_information'])
    except (FileNotFoundError, yaml.YAMLError, KeyError, TypeError, ValueError):
        return None


def _mcap_records(file: Path) -> Iterator[tuple[str, _Topic, int, bytes]]:
    """Yield topic, channel, receive time [ns] and bytes of the messages of an MCAP file."""
    schemas: dict[int, Schema] = {}
    channels: dict[int, tuple[str, _Topic]] = {}
    with file.open('rb') as stream:
        begin = stream.read(len(_MAGIC))
        if begin != _MAGIC:
            raise RecordingError(f'{file} is not an MCAP file: begins with {begin!r}')
        reader = StreamReader(
            stream, skip_magic=True, validate_crcs=True, record_size_limit=file.stat().st_size
        )
        count, complete = 0, False
        try:
            for record in reader.records:
                if isinstance(record, Message):
                    yield *channels[record.channel_id], record.log_time, record.data
                    count += 1
                elif isinstance(record, Channel):
                    schema = schemas[record.schema_id]
                    definition = schema.data.decode(errors='replace')
                    channels[record.id] = (
                        record.topic,
                        _Topic(schema.name, schema.encoding, definition),
                    )
                elif isinstance(record, Schema):
                    schemas[record.id] = record
                elif isinstance(record, DataEnd):
                    complete = True
                elif isinstance(record, Statistics) and record.message_count != count:
                    raise McapError(f'{record.message_count} were written')
        except EndOfFile:
            # What follows the data only repeats it.
            if not complete:
                raise


def _other_records(path: Path) -> Iterator[tuple[str, _Topic, int, bytes]]:
    """Yield the same of an sqlite3 file, or of a folder with compressed files or messages."""
    encodings = {MessageDefinitionFormat.MSG: 'ros2msg', MessageDefinitionFormat.IDL: 'ros2idl'}
    with Reader(path) as reader:
        channels = {
            connection.id: _Topic(
                connection.msgtype,
                encodings.get(connection.msgdef.format, ''),
                connection.msgdef.data,
            )
            for connection in reader.connections
        }
        for connection, stamp, data in reader.messages():
            yield connection.topic, channels[connection.id], stamp, data


def message_counts(path: Path) -> dict[str, int]:
    """
    Count the messages of a bag by topic.

    Raises
    ------
    RecordingError
        If it is not readable or empty.

    """
    contents = _scan(path, lambda _name, _kind: False)
    return {name: topic.count for name, topic in sorted(contents.topics.items())}


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
    contents = _scan(path, lambda name, _kind: name == topic)
    if topic not in contents.topics:
        raise RecordingError(f'{path} has no topic {topic}; it has {contents.listing()}')
    return list(contents.decoded(topic))


def read_friction_recording(
    path: Path,
    *,
    wrench_topic: str | None = None,
    motion_topic: str | None = None,
    force_axis: str = 'y',
    joint: str = 'insertion',
) -> Recording:
    """
    Read force and motion of the needle base from a bag, on the time base of the force.

    Parameters
    ----------
    path : Path
        A rosbag2 folder, an ``.mcap`` or a ``.db3`` file; the end may be missing.
    wrench_topic, motion_topic : str, optional
        Topics of type WrenchStamped and JointState; if not given, the only one of its type, or
        else the one whose last name is base_wrench or joint_states.
    force_axis : str
        Component of the force that points into the tissue: x, y, z, or one of them after ``-``.
    joint : str
        Joint whose position is the inserted length [m].

    Returns
    -------
    Recording
        By header stamps; `Recording.losses` says what was left out or repaired.

    Raises
    ------
    RecordingError
        If the bag is not readable or lacks what is needed.

    """
    sign, axis = (-1.0, force_axis[1:]) if force_axis.startswith('-') else (1.0, force_axis)
    if axis not in ('x', 'y', 'z'):
        raise RecordingError(f'force axis must be x, y, z, -x, -y or -z, got {force_axis!r}')
    contents = _scan(
        path,
        lambda name, kind: kind in (_WRENCH, _MOTION) or _is_configuration(name, kind),
    )
    wrench_topic = _chosen(contents, _WRENCH, wrench_topic, 'base_wrench')
    motion_topic = _chosen(contents, _MOTION, motion_topic, 'joint_states')
    wrenches = contents.decoded(wrench_topic)
    stamps, force = _samples(
        contents, wrench_topic, wrenches, lambda m: [getattr(m.wrench.force, axis)]
    )
    motion_stamps, motion = _motion(contents, motion_topic, joint)
    covered = _covered(stamps, motion_stamps)
    if not covered.any():
        raise RecordingError(
            f'{path}: {wrench_topic} and {motion_topic} do not overlap in time; they last from '
            f'{stamps[0]} to {stamps[-1]} ns and from {motion_stamps[0]} to {motion_stamps[-1]} ns'
        )
    if not covered.all():
        contents.losses.append(
            f'{np.count_nonzero(~covered)} of {wrench_topic} not covered by {motion_topic}'
        )
    start = stamps[covered][0]
    time = (stamps[covered] - start) * 1e-9
    motion_time = (motion_stamps - start) * 1e-9
    return Recording(
        name=str(path),
        time=time,
        depth=np.interp(time, motion_time, motion[:, 0]),
        speed=np.interp(time, motion_time, motion[:, 1]),
        force=sign * force[covered, 0],
        losses=tuple(contents.losses),
        configuration=_configuration(contents),
    )


def _is_configuration(name: str, type_name: str) -> bool:
    return type_name == _TEXT and name.endswith('plant/configuration')


def _configuration(contents: _Contents) -> str:
    texts = [
        message.data
        for name, topic in contents.topics.items()
        if _is_configuration(name, topic.type_name)
        for _, message in contents.decoded(name)
    ]
    return str(texts[-1]) if texts else ''


def _chosen(contents: _Contents, type_name: str, topic: str | None, usual: str) -> str:
    """Return the topic asked for, or the one that must be meant."""
    names = sorted(name for name, t in contents.topics.items() if t.type_name == type_name)
    if topic is not None:
        if topic not in names:
            raise RecordingError(
                f'{contents.path} has no topic {topic} of type {type_name}; it has '
                f'{contents.listing()}'
            )
        return topic
    if not names:
        raise RecordingError(
            f'{contents.path} has no topic of type {type_name}; it has {contents.listing()}'
        )
    meant = names if len(names) == 1 else [n for n in names if n.rsplit('/', 1)[-1] == usual]
    if len(meant) != 1:
        raise RecordingError(
            f'{contents.path} has several topics of type {type_name}; name one of '
            f'{", ".join(meant or names)}'
        )
    return meant[0]


def _samples(
    contents: _Contents,
    topic: str,
    messages: Iterable[tuple[int, Any]],
    read: Callable[[Any], list[float]],
) -> tuple[NDArray[np.int64], FloatArray]:
    """
    Return stamps [ns], strictly increasing, and finite values of a topic.

    ``read`` takes the values from a message, none at all if it is of no interest. A message
    without a header stamp counts at the time it was received.
    """
    stamps: list[int] = []
    rows: list[list[float]] = []
    for received, message in messages:
        row = read(message)
        if row:
            stamp = message.header.stamp
            stamps.append(int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec) or received)
            rows.append(row)
    time, values = np.array(stamps, dtype=np.int64), np.array(rows, dtype=np.float64)
    if len(time) == 0:
        return time, values
    order = np.argsort(time, kind='stable')
    late = np.count_nonzero(time < np.maximum.accumulate(time))
    time, values = time[order], values[order]
    finite = np.isfinite(values).all(axis=1)
    repeated = np.zeros(len(time), dtype=np.bool_)
    repeated[1:] = time[1:] == time[:-1]
    for count, what in (
        (late, 'out of order, sorted by stamp'),
        (np.count_nonzero(~finite), 'not finite, left out'),
        (np.count_nonzero(repeated), 'with the stamp of another, left out'),
    ):
        if count:
            contents.losses.append(f'{count} of {topic} {what}')
    kept = finite & ~repeated
    if np.count_nonzero(kept) < 2:
        raise RecordingError(
            f'{contents.path}: {topic} must have >= 2 samples at different times, has '
            f'{np.count_nonzero(kept)}'
        )
    return time[kept], values[kept]


def _motion(contents: _Contents, topic: str, joint: str) -> tuple[NDArray[np.int64], FloatArray]:
    """Return stamps [ns], shape (n,), with depth [m] and speed [m/s], shape (n, 2)."""
    messages = list(contents.decoded(topic))
    with_speed = any(len(message.velocity) for _, message in messages)

    def read(message: Any) -> list[float]:
        if joint not in message.name:
            return []
        i = message.name.index(joint)
        columns = (message.position, message.velocity) if with_speed else (message.position,)
        return [column[i] if i < len(column) else np.nan for column in columns]

    stamps, motion = _samples(contents, topic, messages, read)
    if len(stamps) == 0:
        names = {name for _, message in messages for name in message.name}
        raise RecordingError(
            f'{contents.path}: {topic} has no joint {joint!r}; it has '
            f'{", ".join(sorted(names)) or "none"}'
        )
    if not with_speed:
        contents.losses.append(f'{topic} has no velocity: position differentiated')
        speed = np.gradient(motion[:, 0], (stamps - stamps[0]) * 1e-9)
        motion = np.column_stack([motion, speed])
    return stamps, motion


def _covered(stamps: NDArray[np.int64], motion: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Mark the stamps at which motion can be interpolated."""
    steps = np.diff(motion)
    after = np.clip(np.searchsorted(motion, stamps), 1, len(steps))
    inside = (motion[0] <= stamps) & (stamps <= motion[-1])
    return np.asarray(inside & (steps[after - 1] <= _GAP * np.median(steps)))
