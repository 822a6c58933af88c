# SPDX-License-Identifier: Apache-2.0
"""Read messages of MCAP files chunk by chunk, also of truncated or damaged files."""

from array import array
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from io import BytesIO
from itertools import repeat
from pathlib import Path
import struct
from typing import Any, Final
import zlib

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Schema, Statistics
from needle_identification.bags import compression
from needle_identification.bags.mcap_search import (
    CHUNK,
    find_record,
    HEAD,
    is_record,
    PRIVATE,
    Rereadable,
)
from needle_identification.bags.topics import (
    BagTopic,
    LARGEST_BATCH,
    LATEST,
    make_topic,
    MessageBatch,
    Tally,
)
from needle_identification.errors import RecordingError
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

_MAGIC: Final = b'\x89MCAP0\r\n'

_TAIL: Final = struct.Struct('<BQQQI8s')  # the end of a file: a footer record and the magic bytes

#: Header of a message record.
_MESSAGE: Final = np.dtype(
    [('channel', '<u2'), ('sequence', '<u4'), ('received', '<u8'), ('published', '<u8')]
)
_MESSAGE_HEAD: Final = _MESSAGE.itemsize

#: Opcodes of a chunk.
_IS_MESSAGES: Final = np.isin(np.arange(256), (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE))

_SUMMARY: Final = 2**24  #: largest index that is read, of 80,000 chunks or more [bytes]
DAMAGED_MCAP: Final = (*compression.DAMAGED, McapError)  #: exceptions for damaged bytes


class _Channels:
    """Topics of a file by channel, and the message counts of the statistics record."""

    def __init__(self) -> None:
        self.topics: dict[int, BagTopic] = {}
        self.counts: dict[int, int] = {}
        self._schemas = {0: Schema(id=0, data=b'', encoding='', name='no type')}
        self._recovered = False

    def define(self, opcode: int, record: bytes) -> None:
        stream = ReadDataStream(BytesIO(record))
        if opcode == Opcode.SCHEMA:
            schema = Schema.read(stream)
            self._schemas[schema.id] = schema
        elif opcode == Opcode.CHANNEL:
            channel = Channel.read(stream)
            schema = self._schemas[channel.schema_id]
            definition = schema.data.decode(errors='replace')
            profiles = channel.metadata.get('offered_qos_profiles', '')
            own = channel.topic, schema.name, channel.message_encoding
            self.topics[channel.id] = make_topic(*own, schema.encoding, definition, profiles)
        elif opcode == Opcode.STATISTICS:
            self.counts = Statistics.read(stream).channel_message_counts

    def recover(self, file: Path) -> None:
        """Define the topics after the loss of the first chunk, which may have contained them."""
        if not self._recovered:
            self._recovered = True
            with suppress(*DAMAGED_MCAP):
                self.define_by_index(file)

    def define_by_index(self, file: Path) -> None:
        """Define all topics of the index at the end of a file, if it has a valid one."""
        summary = _summary(file)
        for begin, end in _records(summary):
            for first, after in zip(begin.tolist(), end.tolist(), strict=True):
                self.define(summary[first - HEAD.size], summary[first:after])


def indexed_topics(file: Path) -> set[BagTopic] | None:
    """Return the topics with messages by the index of a file; None without a valid index."""
    channels = _Channels()
    try:
        channels.define_by_index(file)
        # New publishers of a topic add a channel: the last channel has the QoS of all of them.
        latest = {topic: topic for topic in channels.topics.values()}
        found = {channels.topics[id_] for id_, number in channels.counts.items() if number}
        return {latest[topic] for topic in found} or None
    except DAMAGED_MCAP:
        return None


def indexed_span(file: Path) -> tuple[int, int] | None:
    """Return the first and last receive time [ns] by the index; None without a valid index."""
    summary = _summary(file)
    with suppress(*DAMAGED_MCAP):
        for begin, end in _records(summary):
            for first, after in zip(begin.tolist(), end.tolist(), strict=True):
                if summary[first - HEAD.size] == Opcode.STATISTICS:
                    stream = ReadDataStream(BytesIO(summary[first - HEAD.size : after]))
                    found = Statistics.read(stream)
                    if found.message_count:
                        return found.message_start_time, found.message_end_time
    return None


def _summary(file: Path) -> bytes:
    """Return the index at the end of a file, b'' without a valid one."""
    try:
        with file.open('rb') as stream:
            stream.seek(-_TAIL.size, 2)
            footer, _, start, _, checksum, magic = _TAIL.unpack(stream.read())
            if (footer, magic) != (Opcode.FOOTER, _MAGIC) or not start or not checksum:
                return b''
            stream.seek(start)
            # The checksum covers all bytes before it.
            summary = stream.read(_SUMMARY)[: -4 - len(_MAGIC)]
    except (OSError, *DAMAGED_MCAP):
        return b''
    return summary if zlib.crc32(summary) == checksum else b''


def mcap_batches(file: Path, tally: Tally) -> Iterator[MessageBatch]:
    """Read an MCAP file, compressed or not; yield the messages of the selected topics."""
    with compression.open_file(file, tally.budget) as stream:
        magic = compression.read_up_to(stream, len(_MAGIC))
        if magic != _MAGIC:
            begin = repr(magic) if magic else 'nothing'
            raise RecordingError(f'{file.name} is not an MCAP file: begins with {begin}')
        yield from _McapReader(file, stream, tally).batches()
    if tally.written not in (None, tally.count):
        tally.faults.append('has lost messages')


class _McapReader:
    """Reads records one by one; after damaged bytes it continues at the next records."""

    def __init__(self, file: Path, stream: Any, tally: Tally) -> None:
        self._file, self._stream, self._tally = file, Rereadable(stream), tally
        self._channels = _Channels()
        #: Records outside of chunks.
        self._loose = bytearray()
        #: The last record outside of chunks, which the head of the next record confirms, and the
        #: bytes from its start on.
        self._held, self._suspect = b'', bytearray()
        self._is_complete = False

    def batches(self) -> Iterator[MessageBatch]:
        tally = self._tally
        while len(head := compression.read_up_to(self._stream, HEAD.size)) == HEAD.size:
            opcode, length = HEAD.unpack(head)
            if is_record(opcode, length) or len(self._suspect) > compression.BLOCK:
                self._loose += self._held
                self._held, self._suspect = b'', bytearray()
            elif opcode < PRIVATE:
                yield from self._search(head)
                continue
            if length > tally.budget.largest and opcode != Opcode.ATTACHMENT:
                tally.faults.append(f'is damaged: {tally.budget.too_large("record", length)}')
                yield from self._search(head)
                continue
            if opcode == Opcode.CHUNK or len(self._loose) > compression.BLOCK:
                yield from self._flush()
            if opcode == Opcode.ATTACHMENT:
                _skip(self._stream, length)
                continue
            body = compression.read_up_to(self._stream, length)
            yield from self._take(opcode, length, head + body)
            if opcode == Opcode.FOOTER:
                break
        self._loose += self._held
        yield from self._flush()
        if not self._is_complete:
            # After damage the end may have been lost with it.
            self._tally.faults.insert(0, 'is cut off')

    def _take(self, opcode: int, length: int, record: bytes) -> Iterator[MessageBatch]:
        body = record[HEAD.size :]
        if opcode == Opcode.CHUNK and _is_consistent(body, length):
            recover = partial(self._channels.recover, self._file)
            content = _chunk_content(body, length, self._tally, recover)
            yield from _batches(content, self._channels, self._tally)
        elif len(body) < length or opcode == Opcode.CHUNK:
            yield from self._search(record)
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE):
            self._held = record
            self._suspect += record
        else:
            self._tally.budget.spend(0, compression.COSTLY)
            if opcode == Opcode.STATISTICS:
                self._tally.written = int.from_bytes(body[:8], 'little')
            if opcode >= PRIVATE:
                self._suspect += record
            self._is_complete |= opcode == Opcode.DATA_END

    def _search(self, data: bytes) -> Iterator[MessageBatch]:
        """Skip to the next records after damage, without the record before the damage."""
        yield from self._flush()
        self._channels.recover(self._file)
        suspect = bytes(self._suspect) + data
        self._stream.put_back(suspect[1:])
        skipped = self._stream.find(self._channels.topics, self._tally.budget)
        if skipped is not None:
            self._tally.faults.append(_damage(skipped + 1))
            self._held = b''
        self._suspect.clear()

    def _flush(self) -> Iterator[MessageBatch]:
        content = bytes(self._loose)
        self._loose.clear()
        yield from _batches(content, self._channels, self._tally)


def _damage(size: int) -> str:
    return f'is damaged: {size} bytes are not readable'


def _is_consistent(chunk: bytes, length: int) -> bool:
    """Return whether the sizes in the head of a chunk add up to its length."""
    with suppress(struct.error):
        *_, name_length = CHUNK.unpack_from(chunk)
        size_at = CHUNK.size + name_length
        (size,) = struct.unpack_from('<Q', chunk, size_at)
        return bool(size_at + 8 + size == length)
    return True


def _skip(stream: Any, length: int) -> None:
    while length > 0 and (part := compression.read_up_to(stream, min(length, compression.BLOCK))):
        length -= len(part)


def _chunk_content(chunk: bytes, length: int, tally: Tally, recover: Callable[[], None]) -> bytes:
    """Return the records of a chunk: all available if truncated, none if damaged (`recover`)."""
    try:
        _, _, size, checksum, name_length = CHUNK.unpack_from(chunk)
        begin = CHUNK.size + name_length + 8
        if size > tally.budget.largest:
            raise ValueError(tally.budget.too_large('chunk', size))
        data = compression.decompress(chunk[CHUNK.size : begin - 8].decode(), chunk[begin:], size)
        tally.budget.spend(len(data))
        if len(chunk) == length:
            if len(data) != size:
                raise ValueError(f'a chunk of {len(data)} instead of {size} bytes')
            if checksum not in (0, zlib.crc32(data)):
                raise ValueError('the checksum of a chunk is wrong')
    except DAMAGED_MCAP as error:
        tally.faults.append(f'is damaged: {error}')
        recover()
        return b''
    return data


def _records(
    content: bytes, position: int = 0
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Yield the begin (after the head) and end of complete records, in groups."""
    length_of, head = struct.Struct('<Q').unpack_from, HEAD.size
    size = len(content)
    is_more = True
    while is_more:
        ends, is_more = array('q', [position]), False
        add = ends.append
        # The position after a damaged length is outside the content, or of 64 bits.
        with suppress(struct.error, OverflowError):
            for _ in repeat(None, LARGEST_BATCH):
                (length,) = length_of(content, position + 1)
                position += head + length
                add(position)
            is_more = True
        table = np.array(ends)
        table = table[: np.searchsorted(table, size, 'right')]
        yield table[:-1] + head, table[1:]


def _undamaged(
    content: bytes, channels: _Channels, tally: Tally
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Yield records as `_records`, without damaged bytes and the record before each damage."""
    data, position, size = np.frombuffer(content, dtype=np.uint8), 0, len(content)
    while position < size:
        wrong, after = False, position
        for begin, end in _records(content, position):
            # The head of a record, also of an incomplete one, confirms the record before.
            heads = np.append(begin - HEAD.size, end[-1:] if len(end) else after)
            after = int(heads[-1])
            known = _IS_MESSAGES[data[heads[heads < size]]]
            known[: len(begin)] &= (end - begin >= _MESSAGE_HEAD) | (
                data[begin - HEAD.size] != Opcode.MESSAGE
            )
            count = len(begin)
            if wrong := not known.all():
                count = max(int(known.argmin()) - 1, 0)
                after = int(heads[count])
            yield begin[:count], end[:count]
            if wrong:
                break
        if after >= size:
            return
        position, is_found = find_record(
            content, after + 1, channels.topics, tally.budget, is_end=True
        )
        if wrong or is_found:
            tally.faults.append(_damage((position if is_found else size) - after))
        if not is_found:
            return


def _batches(content: bytes, channels: _Channels, tally: Tally) -> Iterator[MessageBatch]:
    data = np.frombuffer(content, dtype=np.uint8)
    # A chunk without records counts, too.
    tally.budget.spend(0, compression.COSTLY)
    for begin, end in _undamaged(content, channels, tally):
        opcodes = data[begin - HEAD.size]
        definitions = np.flatnonzero((opcodes == Opcode.SCHEMA) | (opcodes == Opcode.CHANNEL))
        tally.budget.spend(0, len(begin) + compression.COSTLY * len(definitions))
        for k in definitions:
            # Messages of an unreadable channel are counted as of an unknown topic.
            with suppress(*DAMAGED_MCAP):
                channels.define(opcodes[k], content[begin[k] : end[k]])
        tally.piece += 1
        is_message = opcodes == Opcode.MESSAGE
        if not is_message.any():
            continue
        first, after = begin[is_message], end[is_message]
        heads = sliding_window_view(data, _MESSAGE_HEAD)[first].view(_MESSAGE)[:, 0]
        ids = heads['channel']
        received = np.minimum(heads['received'], np.uint64(LATEST)).astype(np.int64)
        for id_ in np.flatnonzero(np.bincount(ids)):
            topic = channels.topics.get(int(id_))
            rows = np.flatnonzero(ids == id_)
            if tally.enter(topic, len(rows)) and topic is not None:
                starts = first[rows] + _MESSAGE_HEAD
                yield MessageBatch(topic, received[rows], data, starts, after[rows]).decompressed(
                    tally.budget
                )
