"""Read ROS 1 recordings, with messages converted to ROS 2."""

from __future__ import annotations

from bz2 import BZ2Decompressor
from collections.abc import Callable, Iterator
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, Final

from needle_identification.bags.batch import grouped, LARGEST_BATCH, MessageBatch, Tally
from needle_identification.bags.compression import Budget, DAMAGED, decompress
from needle_identification.bags.topics import make_topic
from needle_identification.errors import RecordingError
from rosbags.convert.converter import generate_message_converter
from rosbags.rosbag1 import Reader, ReaderError
from rosbags.rosbag1.reader import decompressors
from rosbags.serde import SerdeError
from rosbags.typesys import get_typestore, Stores

#: Exceptions of the library for damaged bytes.
_DAMAGED: Final = (ReaderError, SerdeError, EOFError, *DAMAGED)

#: Decompressors of the library, and replacements with a size limit.
_BOUNDED: Final[dict[Any, Callable[[bytes, int], bytes]]] = {
    decompressors['bz2']: lambda data, size: BZ2Decompressor().decompress(data, size),
    decompressors['lz4']: lambda data, size: decompress('lz4', data, size),
}


def ros1_batches(file: Path, tally: Tally) -> Iterator[MessageBatch]:
    """Read a ``.bag`` file; yield its messages, converted to ROS 2."""
    try:
        with Reader(file) as reader:
            for at, chunk in reader.chunks.items():
                bounded = partial(_unfolded, chunk.decompressor, tally.budget)
                reader.chunks[at] = chunk._replace(decompressor=bounded)
            yield from _batches(reader, tally)
    except _DAMAGED as error:
        tally.faults.append(f'is damaged: {error}')


def _batches(reader: Reader, tally: Tally) -> Iterator[MessageBatch]:
    old, new = get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.ROS2_JAZZY)
    known = {name for name in old.fielddefs if name in new.fielddefs}
    topics = {
        connection.id: make_topic(
            connection.topic, connection.msgtype, 'cdr' if connection.msgtype in known else 'ros1'
        )
        for connection in reader.connections
    }
    converters: dict[str, Callable[[bytes], Any]] = {}
    tally.written = reader.message_count
    messages = reader.messages()
    while some := list(islice(messages, LARGEST_BATCH)):
        tally.piece += 1
        for key, group in grouped((one.id, when, data) for one, when, data in some).items():
            topic = topics[key]
            if not tally.enter(topic, len(group)) or topic.type_name not in known:
                continue
            kind = topic.type_name
            convert = converters.get(kind) or generate_message_converter(
                old, new, kind, kind, {}, src_is2=False, dst_is2=True
            )
            converters[kind] = convert
            parts = [_converted(convert, data) for _, data in group]
            yield MessageBatch.of_times(topic, [when for when, _ in group], parts)


def _converted(convert: Callable[[bytes], Any], data: bytes) -> bytes:
    """Convert a message to ROS 2; return b'' if it is not readable."""
    try:
        return bytes(convert(data))
    except _DAMAGED:
        return b''


def _unfolded(library: Callable[[bytes], bytes], budget: Budget, data: bytes) -> bytes:
    bounded = _BOUNDED.get(library)
    found = data if bounded is None else bounded(data, budget.largest + 1)
    if len(found) > budget.largest:
        raise RecordingError(f'{budget.name} has {budget.too_large("chunk", len(found))}')
    budget.spend(len(found))
    return found
