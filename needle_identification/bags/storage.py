"""What the forms of storage have in common: topics, batches of messages, compression."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
import re
import struct
from typing import Any, Final, NamedTuple

import lz4.frame
import numpy as np
from numpy.typing import NDArray
import yaml
import zstandard

#: Endings of compressed files.
COMPRESSED: Final = ('.zstd', '.zst', '.lz4')

#: Bytes that are read at a time.
BLOCK: Final = 2**20

#: A larger record or chunk is none, but a broken length [bytes].
LARGEST: Final = 2**30

#: Larger messages are not decompressed [bytes].
_LARGEST_MESSAGE: Final = 2**26

#: Messages of one batch, at most.
MOST: Final = 2**14

#: Receive times are kept so that their differences fit in 64 bits [ns].
LATEST: Final = 2**62

#: How compressed data begin; a message begins with 0.
_MARKS: Final = {b'\x28\xb5\x2f\xfd': 'zstd', b'\x04\x22\x4d\x18': 'lz4'}

#: What is raised at bytes that make no sense.
BROKEN: Final = (
    RuntimeError,
    zstandard.ZstdError,
    struct.error,
    AssertionError,
    KeyError,
    MemoryError,
    OverflowError,
    TypeError,
    ValueError,
)


#: Numbers that older recordings have for the words of rosbag2.
_WORDS: Final = {
    'reliability': {1: 'reliable', 2: 'best_effort'},
    'durability': {1: 'transient_local', 2: 'volatile'},
    'history': {1: 'keep_last', 2: 'keep_all'},
}


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


def offered_qos(text: str) -> tuple[OfferedQos, ...]:
    """Read the profiles stored with a topic; none if there are none or they are not readable."""
    try:
        profiles = yaml.safe_load(text) or []
        return tuple(
            OfferedQos(
                **{name: words.get(stored[name], stored[name]) for name, words in _WORDS.items()},
                depth=int(stored['depth']),
            )
            for stored in profiles
        )
    except (yaml.YAMLError, KeyError, TypeError, ValueError, RecursionError):
        return ()


@dataclass(frozen=True, slots=True)
class Topic:
    """
    A topic in a bag.

    Attributes
    ----------
    name, type_name : str
        Full name, and type such as ``sensor_msgs/msg/JointState``; after the type its encoding
        in brackets where that is not the one of ROS 2, so that it is no type we know.
    encoding, definition : str
        Language of the definition of the type, ros2msg or ros2idl, and the definition.
    profiles : str
        What its publishers offered, for `offered_qos`.

    """

    name: str
    type_name: str
    encoding: str = field(default='', compare=False)
    definition: str = field(default='', compare=False, repr=False)
    profiles: str = field(default='', compare=False, repr=False)

    def __str__(self) -> str:
        return f'{self.name} ({self.type_name})'


class Batch(NamedTuple):
    """Messages of one topic, in order: receive times [ns], and where each begins and ends."""

    topic: Topic
    received: NDArray[np.int64]
    data: NDArray[np.uint8]
    begin: NDArray[np.int64]
    end: NDArray[np.int64]

    def messages(self) -> Iterator[tuple[int, bytes]]:
        """Yield receive time [ns] and bytes."""
        for received, begin, end in zip(self.received, self.begin, self.end, strict=True):
            yield int(received), self.data[begin:end].tobytes()

    def plain(self) -> Batch:
        """Decompress the messages if they are compressed one by one; what is broken is empty."""
        compression = _MARKS.get(next(self.messages())[1][:4])
        if compression is None:
            return self
        parts = [b''] * len(self.received)
        for k, (_, data) in enumerate(self.messages()):
            with suppress(*BROKEN):
                parts[k] = decompressed(compression, data, _LARGEST_MESSAGE)
        return joined(self.topic, self.received, parts)


@dataclass(slots=True)
class Tally:
    """Keeps count of what is read of a file; pieces of it follow each other in time."""

    counts: dict[Topic, int]
    wanted: Callable[[Topic], bool]
    faults: list[str]
    count: int = 0
    written: int | None = None
    piece: int = 0

    def __str__(self) -> str:
        of = '' if self.written is None else f' of {self.written}'
        return f'{self.count}{of} messages'

    def enter(self, topic: Topic, number: int) -> bool:
        """Count messages and tell whether they are wanted."""
        self.counts[topic] = self.counts.get(topic, 0) + number
        self.count += number
        return self.wanted(topic)


def topic_of(
    name: str, type_name: str, form: str, encoding: str, definition: str, profiles: str
) -> Topic:
    """Return a topic whose messages are in a form, such as cdr, under the name its type has."""
    # Some writers leave the middle out, as ROS 1 did.
    full = re.sub(r'^(\w+)/(\w+)$', r'\1/msg/\2', type_name)
    full = full if form == 'cdr' else f'{full} [{form}]'
    # Messages about a topic are one line, whatever a broken file calls it.
    name, full = (re.sub(r'[\x00-\x1f\x7f]', '?', word) for word in (name, full))
    return Topic(name, full, encoding, definition, profiles)


def joined(topic: Topic, received: NDArray[np.int64], parts: Sequence[bytes]) -> Batch:
    """Return messages that are apart as a batch."""
    end = np.cumsum([len(part) for part in parts])
    begin = end - [len(part) for part in parts]
    return Batch(topic, received, np.frombuffer(b''.join(parts), dtype=np.uint8), begin, end)


def uncompressed(file: Path) -> Path:
    """Return the name of a file without the ending of its compression."""
    return file.with_suffix('') if file.suffix in COMPRESSED else file


def opened(file: Path) -> Any:
    """Open a file that may be compressed."""
    if file.suffix == '.lz4':
        archive = lz4.frame.LZ4FrameFile(file)
        # Where the end is missing, read would lose what there is.
        archive.read = archive.read1
        return archive
    stream = file.open('rb')
    return _zstd_stream(stream) if file.suffix in COMPRESSED else stream


def taken(stream: Any, length: int) -> bytes:
    """Read so many bytes, fewer only at the end."""
    parts = []
    with suppress(EOFError):
        while length > 0 and (part := stream.read(min(length, LARGEST))):
            parts.append(part)
            length -= len(part)
    return parts[0] if len(parts) == 1 else b''.join(parts)


def skip(stream: Any, length: int) -> None:
    """Read past so many bytes, without holding them."""
    while length > 0 and (part := taken(stream, min(length, BLOCK))):
        length -= len(part)


def decompressed(compression: str, data: bytes, size: int) -> bytes:
    """Decompress up to so many bytes, and fewer if the rest is missing."""
    if compression == 'zstd':
        with _zstd_stream(data) as stream:
            return taken(stream, size)
    if compression == 'lz4':
        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size))
    if compression:
        raise ValueError(f'compression {compression!r} is not zstd or lz4')
    return data


def _zstd_stream(source: Any) -> Any:
    return zstandard.ZstdDecompressor().stream_reader(source, read_across_frames=True)
