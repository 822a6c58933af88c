# SPDX-License-Identifier: Apache-2.0
"""Decompression bombs and malicious documents are rejected in one line with little memory."""

from __future__ import annotations

import bz2
from collections.abc import Callable, Iterable
from contextlib import closing
from io import BytesIO
import os
from pathlib import Path
import re
import sqlite3
import struct
import subprocess
import sys
from typing import NamedTuple
import zlib

import lz4.frame
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from needle_identification.bags.writer import BagWriter
from needle_ros.files import DocumentError, read_document
import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.typesys import get_typestore, Stores
from scipy.io import savemat
from support.installed import ROOT
from support.samples import EPOCH, joint_states, TEXT, text
import zstandard

WRENCH = 'geometry_msgs/msg/WrenchStamped'
JOINTS = 'sensor_msgs/msg/JointState'
MEGABYTE = 2**20

#: Memory limit for reading a small file [kB], and limit of its CPU time [s].
MEMORY, PATIENCE = 1_000_000, 240.0

#: Documents of a few lines that expand quadratically or worse.
LAUGHS = 'a0: &a0 [lol, lol, lol, lol, lol, lol, lol, lol, lol, lol]\n' + ''.join(
    f'a{k}: &a{k} [{", ".join([f"*a{k - 1}"] * 10)}]\n' for k in range(1, 12)
)
MERGES = 'a0: &a0 {k: 0}\n' + ''.join(
    f'a{k}: &a{k}\n  <<: [{", ".join([f"*a{k - 1}"] * 10)}]\n' for k in range(1, 12)
)


def mcap(file: Path, messages: Iterable[bytes], compression: CompressionType) -> None:
    """Write messages on both topics of an identification."""
    with file.open('wb') as stream:
        writer = McapWriter(stream, compression=compression)
        writer.start(profile='ros2')
        channels = []
        for name, kind in (('/base_wrench', WRENCH), ('/joint_states', JOINTS)):
            schema = writer.register_schema(name=kind, encoding='ros2msg', data=b'')
            channels.append(writer.register_channel(name, 'cdr', schema))
        for k, data in enumerate(messages):
            for channel in channels:
                writer.add_message(channel, log_time=k, publish_time=k, data=data)
        writer.finish()


def zeros(size: int) -> bytes:
    """Compress zeros in blocks, to limit the memory."""
    stream = BytesIO()
    with zstandard.ZstdCompressor(level=19).stream_writer(stream, closefd=False) as packer:
        for _ in range(size // MEGABYTE):
            packer.write(bytes(MEGABYTE))
    return stream.getvalue()


def zstd_messages(folder: Path) -> Path:
    """Write 64 messages of 60 MB in a few kB, and the same in a compressed chunk."""
    file = folder / 'messages.mcap'
    mcap(file, [zeros(60 * MEGABYTE)] * 64, CompressionType.ZSTD)
    return file


def lz4_messages(folder: Path) -> Path:
    """Write 60 MB in 250 kB."""
    file = folder / 'messages.mcap'
    mcap(file, [lz4.frame.compress(bytes(60 * MEGABYTE))] * 64, CompressionType.ZSTD)
    return file


def zstd_file(folder: Path) -> Path:
    """Append 1 GB of zeros to the first bytes."""
    file = folder / 'whole.mcap.zst'
    head = b'\x89MCAP0\r\n' + struct.pack('<BQ', 0x0F, 2**62)
    file.write_bytes(zstandard.ZstdCompressor().compress(head) + zeros(1024 * MEGABYTE))
    return file


def chunks(folder: Path) -> Path:
    """Write chunks of 1 GB each in 32 kB."""
    file, name = folder / 'chunks.mcap', b'zstd'
    for size, claims in ((100, 100), (1024, 1024)):
        packed = zeros(size * MEGABYTE)
        body = struct.pack('<QQQII', 0, 0, claims * MEGABYTE, 0, len(name)) + name
        body += struct.pack('<Q', len(packed)) + packed
        record = struct.pack('<BQ', 0x06, len(body)) + body
        with file.open('ab') as stream:
            stream.write((b'\x89MCAP0\r\n' if size == 100 else b'') + record * 23)
    return file


def bag_with(metadata: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        mcap(folder / 'a_0.mcap', [b''], CompressionType.NONE)
        mcap(folder / 'b_0.mcap', [b''], CompressionType.NONE)
        (folder / 'metadata.yaml').write_text(metadata, encoding='utf-8')
        return folder

    return make


def database(*statements: str) -> Callable[[Path], Path]:
    """Return the SQL statements of a database of two topics with the given messages."""

    def make(folder: Path) -> Path:
        file = folder / 'bag.db3'
        with closing(sqlite3.connect(file)) as made, made:
            made.execute('CREATE TABLE topics (id INTEGER, name, type, serialization_format)')
            for k, (name, kind) in enumerate((('/base_wrench', WRENCH), ('/joints', JOINTS))):
                made.execute('INSERT INTO topics VALUES (?, ?, ?, ?)', (k, name, kind, 'cdr'))
            for statement in statements:
                made.execute(statement)
        return file

    return make


ENDLESS = (
    'CREATE VIEW messages AS WITH RECURSIVE n(k) AS (SELECT 1 UNION ALL SELECT k + 1 FROM n) '
    "SELECT k % 2 AS topic_id, k AS timestamp, x'00' AS data FROM n"
)
COMPUTED = (
    'CREATE TABLE messages (topic_id, timestamp, data AS (zeroblob(900000000)))',
    'INSERT INTO messages VALUES (0, 1), (0, 2), (1, 1), (1, 2)',
)


def zstd_database(folder: Path) -> Path:
    """Append 1 GB of zeros to a database."""
    plain = database('CREATE TABLE messages (topic_id, timestamp, data)')(folder)
    packed = zstandard.ZstdCompressor().compress(plain.read_bytes()) + zeros(1024 * MEGABYTE)
    plain.unlink()
    file = folder / 'bag.db3.zst'
    file.write_bytes(packed)
    return file


def ros1_chunk(folder: Path) -> Path:
    """Replace a chunk of a ROS 1 recording by 1 GB of zeros."""
    store = get_typestore(Stores.ROS1_NOETIC)
    file = folder / 'run.bag'
    writer = Ros1Writer(file)
    writer.set_compression(Ros1Writer.CompressionFormat.BZ2)
    with writer:
        for name, kind in (('/base_wrench', WRENCH), ('/joint_states', JOINTS)):
            connection = writer.add_connection(name, kind, typestore=store)
            writer.write(connection, 1, bytes(100))
    content = file.read_bytes()
    begin = content.index(b'BZh')
    packer = bz2.BZ2Compressor()
    packed = b''.join(packer.compress(bytes(MEGABYTE)) for _ in range(1024)) + packer.flush()
    size = struct.unpack('<I', content[begin - 4 : begin])[0]
    # The index after the chunk is located by its position.
    spread = packed + content[begin + size :]
    place = struct.unpack('<Q', field(content, b'index_pos='))[0] + len(packed) - size
    head = content[: begin - 4].replace(
        b'index_pos=' + field(content, b'index_pos='), b'index_pos=' + struct.pack('<Q', place)
    )
    file.write_bytes(head + struct.pack('<I', len(packed)) + spread)
    return file


def field(content: bytes, name: bytes) -> bytes:
    at = content.index(name) + len(name)
    return content[at : at + 8]


def matlab(folder: Path) -> Path:
    """Write a variable of 1 GB with a declared size of one number."""
    file = folder / 'run.mat'
    savemat(file, {'time': 1.0}, do_compression=False)
    content = file.read_bytes()
    inner = bytearray(content[128:])
    packer = zlib.compressobj(9)
    # The last element is the number of 8 bytes: declare 1 GB.
    inner[-12:-8] = struct.pack('<I', 1024 * MEGABYTE)
    inner[4:8] = struct.pack('<I', 1024 * MEGABYTE + len(inner) - 16)
    packed = packer.compress(bytes(inner))
    packed += b''.join(packer.compress(bytes(MEGABYTE)) for _ in range(1024)) + packer.flush()
    file.write_bytes(content[:128] + struct.pack('<II', 15, len(packed)) + packed)
    return file


def one_line(folder: Path) -> Path:
    """Write a table with a single long line."""
    file = folder / 'run.csv'
    file.write_text('1,' * 15_000_000, encoding='utf-8')
    return file


# Many small records.

MAGIC = b'\x89MCAP0\r\n'


def record(opcode: int, body: bytes = b'') -> bytes:
    return struct.pack('<BQ', opcode, len(body)) + body


def text_field(text: str) -> bytes:
    return struct.pack('<I', len(text)) + text.encode()


def channel(number: int, topic: str, kind: str = 'lab_msgs/msg/Any') -> bytes:
    """Return a schema and a channel of a topic."""
    schema = struct.pack('<H', number) + text_field(kind) + text_field('ros2msg') + bytes(4)
    fields = struct.pack('<HH', number, number) + text_field(topic) + text_field('cdr') + bytes(4)
    return record(3, schema) + record(4, fields)


def message(number: int, data: bytes = b'') -> bytes:
    return record(5, struct.pack('<HIQQ', number, 0, 0, 0) + data)


def chunk(content: bytes) -> bytes:
    body = struct.pack('<QQQI', 0, 0, len(content), 0) + text_field('')
    return record(6, body + struct.pack('<Q', len(content)) + content)


def repeated(*parts: bytes, head: bytes = b'') -> Callable[[Path], Path]:
    """Return a compressed file of 64 MB of the same parts."""

    def make(folder: Path) -> Path:
        file = folder / 'many.mcap.zst'
        block = b''.join(parts) * max(1, MEGABYTE // len(b''.join(parts)))
        with file.open('wb') as stream, zstandard.open(stream, 'wb') as packed:
            packed.write(MAGIC + channel(1, '/base_wrench', WRENCH) + channel(2, '/other') + head)
            for _ in range(64 * MEGABYTE // len(block)):
                packed.write(block)
        return file

    return make


def rows(table: str) -> Callable[[Path], Path]:
    """Return a compressed database with 600,000 rows in a table."""

    def make(folder: Path) -> Path:
        numbers = 'WITH RECURSIVE n(k) AS (SELECT 1 UNION ALL SELECT k + 1 FROM n LIMIT 600000)'
        values = "0, 0, x''" if table == 'messages' else "0, 'a', 'b', 'cdr'"
        plain = database(
            'CREATE TABLE messages (topic_id, timestamp, data)',
            f'INSERT INTO {table} {numbers} SELECT {values} FROM n',  # noqa: S608
        )(folder)
        file = folder / 'rows.db3.zst'
        file.write_bytes(zstandard.compress(plain.read_bytes()))
        plain.unlink()
        return file

    return make


def tables(folder: Path) -> Path:
    """Write a database with many tables."""
    return database(
        'CREATE TABLE messages (topic_id, timestamp, data)',
        *(f'CREATE TABLE t{k} (a)' for k in range(2000)),
    )(folder)


def index(folder: Path) -> Path:
    """Write an index of 12 MB: records without content, and counts of channels."""
    file = folder / 'index.mcap'
    head = MAGIC + channel(1, '/base_wrench') + channel(2, '/other') + record(15, bytes(4))
    counts = np.zeros(600_000, dtype=[('channel', '<u2'), ('count', '<u8')])
    counts['count'] = counts['channel'] = np.arange(len(counts)) % 2**16
    statistics = record(11, bytes(42) + struct.pack('<I', counts.nbytes) + counts.tobytes())
    summary = record(14) * 600_000 + statistics
    summary += struct.pack('<BQQQ', 2, 20, len(head), 0)
    file.write_bytes(head + summary + struct.pack('<I', zlib.crc32(summary)) + MAGIC)
    return file


def ros1(before: bytes, size: int, count: int, repeats: int = 1) -> Callable[[Path], Path]:
    """
    Return a ROS 1 recording whose index names one message many times.

    `before` is before the message in its chunk, `size` the size of the message, `count` the number
    of entries of the index, and `repeats` how often the chunk is listed.
    """

    def field(name: str, value: bytes) -> bytes:
        return struct.pack('<I', len(name) + 1 + len(value)) + f'{name}='.encode() + value

    def of(opcode: int, data: bytes, **fields: bytes) -> bytes:
        head = field('op', bytes([opcode]))
        head += b''.join(field(name, value) for name, value in fields.items())
        return struct.pack('<I', len(head)) + head + struct.pack('<I', len(data)) + data

    def make(folder: Path) -> Path:
        zero, one = struct.pack('<I', 0), struct.pack('<I', 1)
        content = before + of(2, bytes(size), conn=zero, time=bytes(8))
        packed = of(5, bz2.compress(content), compression=b'bz2', size=zero)
        entries = bytes(12) * count
        packed += of(4, entries, ver=one, conn=zero, count=struct.pack('<I', count))
        kind = field('type', b'geometry_msgs/WrenchStamped') + field('md5sum', b'*')
        kind += field('message_definition', b'')
        # The head of a file is padded to 4096 bytes.
        begin = b'#ROSBAG V2.0\n'
        place = len(begin) + 4096
        listed = of(
            6,
            zero + struct.pack('<I', count),
            ver=one,
            chunk_pos=struct.pack('<Q', place),
            start_time=bytes(8),
            end_time=bytes(8),
            count=one,
        )
        head = {
            'index_pos': struct.pack('<Q', place + len(packed)),
            'conn_count': one,
            'chunk_count': struct.pack('<I', repeats),
        }
        padding = bytes(4096 - len(of(3, b'', **head)))
        file = folder / 'run.bag'
        file.write_bytes(
            begin
            + of(3, padding, **head)
            + packed
            + of(7, kind, conn=zero, topic=b'/base_wrench')
            + listed * repeats
        )
        return file

    return make


#: A connection record of a ROS 1 chunk without content.
CONNECTION = struct.pack('<II', 8, 4) + b'op=\7' + bytes(4)

EMPTY = zstandard.compress(b'')
MANY = [
    pytest.param(repeated(record(0x8F)), id='empty records'),
    pytest.param(repeated(message(1), message(2)), id='empty messages'),
    pytest.param(repeated(*[message(k) for k in range(9, 30000)]), id='unknown channels'),
    pytest.param(
        repeated(
            *[message(k) for k in range(9, 30000)],
            head=b''.join(channel(k, f'/t{k}') for k in range(9, 30000)),
        ),
        id='channels',
    ),
    pytest.param(repeated(channel(1, '/base_wrench', WRENCH)), id='definitions'),
    pytest.param(repeated(*[channel(9, f'/t{k}') for k in range(9999)]), id='redefinitions'),
    pytest.param(repeated(chunk(b'')), id='empty chunks'),
    pytest.param(repeated(chunk(message(1))), id='small chunks'),
    pytest.param(repeated(record(6)), id='damaged chunks'),
    pytest.param(repeated(message(1, EMPTY), message(2, EMPTY)), id='compressed messages'),
    pytest.param(rows('messages'), id='rows'),
    pytest.param(rows('topics'), id='rows of topics'),
    pytest.param(ros1(b'', 2**20, 100_000), id='ROS 1: one message'),
    pytest.param(ros1(CONNECTION * 2**18, 64, 10_000), id='ROS 1: connections'),
    pytest.param(ros1(b'', 64, 10_000, 10_000), id='ROS 1: index'),
]

#: Limit of CPU time for reading many small records twice, on a slow machine [s].
DURATION = 120.0


@pytest.mark.requirement('S-188')
@pytest.mark.parametrize('make', MANY)
def test_many_small_records_are_rejected_in_one_line(
    make: Callable[[Path], Path], tmp_path: Path
) -> None:
    """The message names the limit."""
    line, cost = refused(make(tmp_path))
    assert re.search(r'unfolds to more than (\d{6,} records|256 MB) from', line)
    assert cost.duration < DURATION
    assert cost.memory < MEMORY


@pytest.mark.requirement('S-188')
def test_recording_at_rest_is_within_the_limit_of_records(tmp_path: Path) -> None:
    """Equal messages on ten topics at 1 kHz, compressed by zstd."""
    file, messages = tmp_path / 'rest.mcap', 10 * 5000
    with file.open('wb') as stream:
        writer = McapWriter(stream, compression=CompressionType.NONE)
        writer.start(profile='ros2')
        schema = writer.register_schema(name=JOINTS, encoding='ros2msg', data=b'')
        channels = [writer.register_channel(f'/joints_{k}', 'cdr', schema) for k in range(10)]
        for k in range(messages):
            stamp = EPOCH + k // 10 * 1_000_000
            data = joint_states(stamp, 0.0, 0.0)
            writer.add_message(channels[k % 10], log_time=stamp, publish_time=stamp, data=data)
        writer.finish()
    packed = zstandard.compress(file.read_bytes())
    # The limit is a record per byte; chunks and their topics count too.
    assert len(packed) > 1.5 * messages


@pytest.mark.requirement('S-168')
@pytest.mark.parametrize('make', [index, tables])
def test_large_tables_of_contents_are_skipped(
    make: Callable[[Path], Path], tmp_path: Path
) -> None:
    line, cost = refused(make(tmp_path))
    assert 'holds no messages' in line
    assert cost.duration < DURATION
    assert cost.memory < MEMORY


@pytest.mark.requirement('S-168', 'S-169', 'S-170', 'S-171', 'S-172', 'S-173', 'S-174', 'S-177')
@pytest.mark.parametrize(
    ('make', 'reason'),
    [
        pytest.param(ros1_chunk, 'NEEDLE_BAG_FACTOR=10 raises', id='chunk of ROS 1'),
        pytest.param(matlab, 'NEEDLE_BAG_FACTOR=10 raises', id='matlab'),
        pytest.param(one_line, 'is not a table', id='one line'),
        pytest.param(zstd_messages, 'NEEDLE_BAG_FACTOR=10 raises', id='zstd messages'),
        pytest.param(lz4_messages, 'NEEDLE_BAG_FACTOR=10 raises', id='lz4 messages'),
        pytest.param(zstd_file, 'NEEDLE_BAG_FACTOR=10 raises', id='zstd file'),
        pytest.param(chunks, 'NEEDLE_BAG_FACTOR=10 raises', id='chunks'),
        pytest.param(bag_with(LAUGHS), 'aliases are not read', id='aliases'),
        pytest.param(bag_with(MERGES), 'aliases are not read', id='merge keys'),
        pytest.param(bag_with('[' * 5000), 'nested deeper than 32', id='depth'),
        pytest.param(bag_with('a' * 2**21), 'has more than 1048576 characters', id='length'),
        pytest.param(database(ENDLESS), 'messages is not a plain table', id='view'),
        pytest.param(database(*COMPUTED), 'messages is not a plain table', id='computed'),
        pytest.param(zstd_database, 'NEEDLE_BAG_FACTOR=10 raises', id='zstd database'),
    ],
)
def test_decompression_bomb_is_rejected_in_one_line(
    make: Callable[[Path], Path], reason: str, tmp_path: Path
) -> None:
    """The message names the limit; the memory is not above an ordinary recording."""
    bomb = make(tmp_path)
    files = [bomb] if bomb.is_file() else [*bomb.iterdir()]
    # Chunks of 100 MB are within the limit of a record, but exceed the total limit.
    assert sum(file.stat().st_size for file in files) < 32 * MEGABYTE
    line, cost = refused(bomb)
    assert reason in line
    assert cost.memory < MEMORY


@pytest.mark.requirement('S-168')
@pytest.mark.parametrize('bomb', [LAUGHS, MERGES])
def test_recorded_parameters_with_a_yaml_bomb_are_ignored(bomb: str, tmp_path: Path) -> None:
    """They are not read, like other invalid text."""
    with BagWriter(tmp_path / 'bag') as bag:
        bag.add_topic('/plant/configuration', TEXT)
        bag.write('/plant/configuration', text(bomb), EPOCH)
    command = [sys.executable, '-m', 'needle_insertion', 'verify', str(tmp_path / 'bag')]
    line, cost = measured(command)
    assert 'cannot be read as parameters' in line
    assert cost.memory < MEMORY


class Cost(NamedTuple):
    """CPU time [s] and peak memory [kB] of a process."""

    duration: float
    memory: int


def refused(bomb: Path) -> tuple[str, Cost]:
    """Identify friction from a recording; return the line of its error, and the cost."""
    command = [sys.executable, '-m', 'needle_insertion', 'identify', 'friction', str(bomb)]
    return measured(command)


def measured(command: list[str]) -> tuple[str, Cost]:
    """Run a command that fails with one line; return the line and the cost."""
    # From a small process, since a child starts with the size of its parent.
    script = (
        'import resource, subprocess, sys\n'
        f'resource.setrlimit(resource.RLIMIT_CPU, ({PATIENCE:.0f}, {PATIENCE:.0f}))\n'
        'run = subprocess.run(sys.argv[1:], stdout=subprocess.DEVNULL)\n'
        'used = resource.getrusage(resource.RUSAGE_CHILDREN)\n'
        'print(run.returncode, used.ru_utime + used.ru_stime, used.ru_maxrss)\n'
    )
    run = subprocess.run(
        [command[0], '-c', script, *command], capture_output=True, text=True, check=True, cwd=ROOT
    )
    code, duration, memory = run.stdout.split()
    lines = run.stderr.splitlines()
    assert (code, len(lines)) == ('2', 1), run.stderr
    return lines[0], Cost(float(duration), int(memory))


@pytest.mark.requirement('S-176')
def test_limits_can_be_raised(tmp_path: Path) -> None:
    """A common factor scales all limits; an invalid factor is rejected."""
    file = tmp_path / 'bag.mcap'
    mcap(file, [zeros(50 * MEGABYTE)] * 4, CompressionType.ZSTD)
    command = [sys.executable, '-m', 'needle_insertion', 'info', str(file)]
    said = {}
    for factor in ('1', '4', 'many', '-1'):
        run = subprocess.run(
            [*command[:3], 'identify', 'friction', str(file)],
            env={**os.environ, 'NEEDLE_BAG_FACTOR': factor},
            capture_output=True,
            text=True,
            timeout=PATIENCE,
            check=False,
            cwd=ROOT,
        )
        assert run.returncode == 2
        said[factor] = run.stderr
    assert 'unfolds to more than 256 MB' in said['1']
    assert 'unfolds' not in said['4']
    for factor in ('many', '-1'):
        assert f'NEEDLE_BAG_FACTOR must be a positive number, got {factor!r}' in said[factor]


@pytest.mark.requirement('S-167', 'S-172')
@pytest.mark.parametrize(
    'text',
    [
        'a: &x 1\nb: *x',
        '{' * 40,
        '"' + 'a' * 2**20 + '"',
        'a: [',
        '\0',
        '!!python/object/apply:os.getcwd []',
        # In base 60: 40 s in the parser.
        'a: ' + '1:' * (2**19 - 10) + '1',
        'a: ' + '9' * (2**20 - 10),
        '{' + ', '.join(map(str, [*range(100_000), 99_999])) + '}',
    ],
    ids=str.__len__,
)
def test_documents_that_expand_are_rejected(text: str) -> None:
    """Aliases, nesting depth, length, invalid YAML, code, long numbers and repeated keys."""
    with pytest.raises(DocumentError):
        read_document(text)
