# SPDX-License-Identifier: Apache-2.0
"""Read ROS 1 recordings, with messages converted to ROS 2."""

from bz2 import BZ2Decompressor
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from heapq import merge
from itertools import islice
from pathlib import Path
from typing import Any, Final

from needle_identification.bags.compression import Budget, DAMAGED, decompress
from needle_identification.bags.topics import (
    grouped,
    LARGEST_BATCH,
    make_topic,
    MessageBatch,
    Tally,
)
from needle_identification.errors import RecordingError
from rosbags.convert.converter import generate_message_converter
from rosbags.rosbag1 import Reader, ReaderError
from rosbags.rosbag1.reader import decompressors
from rosbags.serde import SerdeError
from rosbags.typesys import get_typestore, Stores

_ENTRY: Final = 12  # size of an entry of the index [bytes]
_RECORD: Final = 128  # number of bytes in a chunk that count as a record
_MAGIC: Final = b'#ROSBAG V2.0'  # first bytes of a file
_DAMAGED: Final = (ReaderError, SerdeError, EOFError, *DAMAGED)  # for damaged bytes

#: Decompressors of the library, and replacements with a size limit.
_BOUNDED: Final[dict[Any, Callable[[bytes, int], bytes]]] = {
    decompressors['bz2']: lambda data, size: BZ2Decompressor().decompress(data, size),
    decompressors['lz4']: lambda data, size: decompress('lz4', data, size),
}


class _Reader(Reader):
    """Reader that counts the entries of the index: chunks may share them."""

    def __init__(self, file: Path, budget: Budget) -> None:
        self._budget = budget
        super().__init__(file)

    def read_index_data(self, pos: int, indexes: dict[int, list[Any]]) -> None:
        file: Any = self.bio
        begin = file.tell()
        super().read_index_data(pos, indexes)
        self._budget.spend(0, 1 + (file.tell() - begin) // _ENTRY)


def ros1_batches(file: Path, tally: Tally) -> Iterator[MessageBatch]:
    """Read a ``.bag`` file; yield its messages, converted to ROS 2."""
    has_index = False
    try:
        with _Reader(file, tally.budget) as reader:
            has_index = True
            for at, chunk in reader.chunks.items():
                bounded = partial(_unfolded, chunk.decompressor, tally.budget)
                reader.chunks[at] = chunk._replace(decompressor=bounded)
            yield from _batches(reader, tally)
    except _DAMAGED as error:
        remedy = '' if has_index else _remedy(file, error)
        tally.faults.append(f'is damaged: {error}{remedy}')


def ros1_span(file: Path) -> tuple[int, int] | None:
    """Return the first and last receive time [ns] by the index; None without a valid index."""
    with suppress(*_DAMAGED), _Reader(file, Budget(file)) as reader:
        if reader.message_count:
            return reader.start_time, reader.end_time
    return None


def _remedy(file: Path, error: Exception) -> str:
    """Return how to read a file without its index, '' for one that is not of ROS 1."""
    with file.open('rb') as stream:
        is_ros1 = stream.read(len(_MAGIC)) == _MAGIC
    return f' (try rosbag reindex {file.name})' if is_ros1 and 'support' not in str(error) else ''


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
    tally.written = sum(sum(chunk.connection_counts.values()) for chunk in reader.chunk_infos)
    messages = _messages(reader, tally.budget)
    while some := list(islice(messages, LARGEST_BATCH)):
        tally.piece += 1
        for key, group in grouped(some).items():
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


def _messages(reader: Reader, budget: Budget) -> Iterator[tuple[int, int, bytes]]:
    """Yield connection, time and data of all messages; entries may share records."""
    # In the order of `messages`, also if a connection is listed twice.
    entries = merge(*(reader.indexes[one.id] for one in reader.connections))
    for entry, (connection, when, data) in zip(entries, reader.messages(), strict=False):
        size = reader.current_chunk[1].tell() - entry.offset
        budget.spend(size, 1 + size // _RECORD)
        yield connection.id, when, data


def _converted(convert: Callable[[bytes], Any], data: bytes) -> bytes:
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
