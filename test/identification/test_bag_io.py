# SPDX-License-Identifier: Apache-2.0
"""Bags are read unchanged, compatible with other tools, and robust against damage."""

from pathlib import Path
import re
import resource
import shutil
import sqlite3
from typing import Any

from hypothesis import given, HealthCheck, settings, strategies
import lz4.frame
from mcap.reader import make_reader
from mcap.writer import Writer as McapWriter
from needle_identification import (
    Bag,
    BagWriter,
    read_friction_recording,
    Recording,
    RecordingError,
)
from needle_identification.bags.bag import message_counts, read_topic
from needle_identification.bags.topics import OfferedQos
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
import pytest
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import get_types_from_msg, get_typestore, Stores
from support.samples import (
    EPOCH,
    grid,
    joint_states,
    MOTION,
    simulated,
    STORE,
    TEXT,
    text,
    WRENCH,
    wrench,
    write_bag,
)
import yaml
import zstandard

MILLISECOND = 1_000_000


@pytest.fixture(scope='module')
def recording() -> Recording:
    return simulated()


@pytest.fixture(scope='module')
def bag(tmp_path_factory: pytest.TempPathFactory, recording: Recording) -> Path:
    """Return a bag with all topics of the plant; tests must not change it."""
    path = tmp_path_factory.mktemp('bags') / 'run'
    truth = {'/plant': {'ros__parameters': {'model.coulomb_friction': 0.56}}}
    write_bag(path, recording, yaml.safe_dump(truth))
    return path


def small_bag(
    path: Path,
    wrenches: list[tuple[int, float]] | tuple[()] = (),
    motions: list[tuple[int, float, float]] | tuple[()] = (),
    joint_names: tuple[str, ...] = ('insertion',),
) -> Path:
    """Write (stamp, value) wrenches and (stamp, depth, velocity) motions, in ms of Unix time."""
    with BagWriter(path) as writer:
        writer.add_topic('/ft', WRENCH)
        writer.add_topic('/joints', MOTION)
        for stamp, force in wrenches:
            at = EPOCH + stamp * MILLISECOND
            writer.write('/ft', wrench(at, force), at)
        for stamp, depth, velocity in motions:
            at = EPOCH + stamp * MILLISECOND
            writer.write('/joints', joint_states(at, depth, velocity, joint_names), at)
    return path


# Round trip.


def test_messages_and_receive_times_are_stored_exactly(tmp_path: Path) -> None:
    written = [(EPOCH + 7 * i, wrench(EPOCH + i, i / 3.0)) for i in range(1000)]
    with BagWriter(tmp_path / 'bag') as writer:
        writer.add_topic('/a', WRENCH)
        for stamp, data in written:
            writer.write('/a', data, stamp)
        assert writer.counts == {'/a': 1000}
    with (tmp_path / 'bag' / 'bag_0.mcap').open('rb') as stream:
        read = [(m.log_time, m.data) for _, _, m in make_reader(stream).iter_messages()]
    assert read == written
    decoded = read_topic(tmp_path / 'bag', '/a')
    assert [stamp for stamp, _ in decoded] == [stamp for stamp, _ in written]
    assert [m.wrench.force.y for _, m in decoded] == [i / 3.0 for i in range(1000)]


@pytest.mark.parametrize('compression', ['zstd', 'lz4', 'none'])
def test_rosbags_reads_written_bags_with_definitions_and_hashes(
    tmp_path: Path, compression: str
) -> None:
    offered = [OfferedQos('best_effort', 'volatile', 'keep_last', 5)]
    with BagWriter(tmp_path / 'bag', compression) as writer:
        writer.add_topic('/a', WRENCH, offered)
        writer.add_topic('/nothing', MOTION)
        writer.write('/a', wrench(EPOCH, 1.5), EPOCH)
        writer.write('/a', wrench(EPOCH, 2.5), EPOCH + 10)
    with AnyReader([tmp_path / 'bag']) as reader:
        assert (reader.start_time, reader.duration, reader.message_count) == (EPOCH, 11, 2)
        assert {name: topic.msgcount for name, topic in reader.topics.items()} == {
            '/a': 2,
            '/nothing': 0,
        }
        connection: Any = reader.topics['/a'].connections[0]
        assert connection.digest == STORE.hash_rihs01(WRENCH)
        assert connection.ext.offered_qos_profiles[0].reliability.name == 'BEST_EFFORT'
        messages: list[Any] = [
            reader.deserialize(data, connection.msgtype)
            for connection, _, data in reader.messages()
        ]
    assert [message.wrench.force.y for message in messages] == [1.5, 2.5]


def test_metadata_required_by_rosbag2_and_foxglove_are_stored(bag: Path) -> None:
    with next(bag.glob('*.mcap')).open('rb') as stream:
        reader = make_reader(stream)
        assert reader.get_header().profile == 'ros2'
        summary = reader.get_summary()
    channels = {channel.topic: channel for channel in summary.channels.values()}
    channel = channels['/base_wrench']
    schema = summary.schemas[channel.schema_id]
    assert (channel.message_encoding, schema.encoding, schema.name) == ('cdr', 'ros2msg', WRENCH)
    assert b'MSG: geometry_msgs/Vector3\nfloat64 x' in schema.data
    assert yaml.safe_load(channel.metadata['offered_qos_profiles'])[0]['durability'] == 'volatile'
    assert channel.metadata['topic_type_hash'].startswith('RIHS01_')
    metadata = yaml.safe_load((bag / 'metadata.yaml').read_text())
    information = metadata['rosbag2_bagfile_information']
    assert (information['version'], information['storage_identifier']) == (9, 'mcap')
    assert (
        information['relative_file_paths'] == [information['files'][0]['path']] == ['run_0.mcap']
    )
    # Some parsers do not read YAML aliases.
    assert '&id' not in (bag / 'metadata.yaml').read_text()


def test_a_recording_written_to_a_bag_is_read_back_unchanged(
    bag: Path, recording: Recording
) -> None:
    read = read_friction_recording(bag)
    # 2e-9: stamps, including the first, are rounded to 1 ns.
    assert_allclose(read.time, recording.time, rtol=0.0, atol=2e-9)
    assert_array_equal(read.force, recording.force)
    # Rounding of the interpolation at equal stamps.
    assert_allclose(read.velocity, recording.velocity, rtol=1e-12, atol=1e-12)
    assert_allclose(read.depth, recording.depth, rtol=1e-12)
    assert read.losses == ()
    assert read.truth == {'model.coulomb_friction': 0.56}


def test_messages_are_counted_by_topic(bag: Path, recording: Recording) -> None:
    count = len(recording.time)
    assert message_counts(bag) == {
        '/base_wrench': count,
        '/ground_truth': count,
        '/joint_states': count,
        '/plant/configuration': 1,
        '/wrench_command': count,
    }


# Writing.


def test_metadata_is_written_only_on_close(tmp_path: Path) -> None:
    writer = BagWriter(tmp_path / 'bag')
    writer.add_topic('/a', TEXT)
    writer.write('/a', text('x'), EPOCH)
    writer.flush()
    assert [file.name for file in (tmp_path / 'bag').iterdir()] == ['bag_0.mcap']
    # Another process can read flushed messages.
    assert message_counts(tmp_path / 'bag') == {'/a': 1}
    writer.close()
    assert sorted(file.name for file in (tmp_path / 'bag').iterdir()) == [
        'bag_0.mcap',
        'metadata.yaml',
    ]


def test_a_bag_after_an_error_is_incomplete_but_readable(tmp_path: Path) -> None:
    def fail() -> None:
        with BagWriter(tmp_path / 'bag') as writer:
            writer.add_topic('/a', TEXT)
            writer.write('/a', text('x'), EPOCH)
            writer.flush()
            writer.write('/b', text('x'), EPOCH)

    with pytest.raises(KeyError):
        fail()
    assert not (tmp_path / 'bag' / 'metadata.yaml').exists()
    assert message_counts(tmp_path / 'bag') == {'/a': 1}


def test_an_existing_folder_is_rejected(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match='exists; a recording must go to a new folder'):
        BagWriter(tmp_path)


def test_a_folder_without_write_permission_is_rejected(tmp_path: Path) -> None:
    (tmp_path / 'file').touch()
    with pytest.raises(RecordingError, match=r'cannot record to .*/file/bag: Not a directory'):
        BagWriter(tmp_path / 'file' / 'bag')


def test_an_unknown_message_type_is_rejected(tmp_path: Path) -> None:
    with (
        BagWriter(tmp_path / 'bag') as writer,
        pytest.raises(RecordingError, match='no definition of lab_msgs/msg/Thing'),
    ):
        writer.add_topic('/a', 'lab_msgs/msg/Thing')


def test_flushed_messages_survive_a_full_disk(tmp_path: Path) -> None:
    noise = np.random.default_rng(0)
    writer = BagWriter(tmp_path / 'bag')
    writer.add_topic('/a', TEXT)
    flushed = 0

    def fill() -> None:
        nonlocal flushed
        for _ in range(1000):
            writer.write('/a', text(noise.bytes(500).hex()), EPOCH)
            writer.flush()
            flushed += 1

    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, limits[1]))
    try:
        with pytest.raises(OSError, match='File too large'):
            fill()
        writer.abort()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert flushed > 100
    assert message_counts(tmp_path / 'bag') == {'/a': flushed}


# Damaged bags, and bags of other writers.


@pytest.fixture(scope='module')
def cut(tmp_path_factory: pytest.TempPathFactory) -> tuple[bytes, Path]:
    """Return a file with several chunks, and a path for truncated copies."""
    folder = tmp_path_factory.mktemp('cut')
    with BagWriter(folder / 'bag') as writer:
        writer.add_topic('/a', TEXT)
        for i in range(60):
            writer.write('/a', text(f'message {i}'), EPOCH + i)
            if i % 7 == 0:
                writer.flush()
    return (folder / 'bag' / 'bag_0.mcap').read_bytes(), folder / 'part.mcap'


@settings(max_examples=300, deadline=None)
@given(data=strategies.data())
def test_a_bag_truncated_at_any_byte_is_read_up_to_the_cut(
    cut: tuple[bytes, Path], data: Any
) -> None:
    whole, part = cut
    part.write_bytes(whole[: data.draw(strategies.integers(0, len(whole)))])
    try:
        messages = read_topic(part, '/a')
    except RecordingError:
        return
    assert [m.data for _, m in messages] == [f'message {i}' for i in range(len(messages))]


@settings(max_examples=300, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(data=strategies.data())
def test_a_bag_with_a_wrong_byte_is_read_or_rejected(cut: tuple[bytes, Path], data: Any) -> None:
    whole, part = cut
    at = data.draw(strategies.integers(0, len(whole) - 1))
    wrong = bytearray(whole)
    wrong[at] ^= data.draw(strategies.integers(1, 255))
    part.write_bytes(wrong)
    try:
        messages = read_topic(part, '/a')
    except RecordingError:
        return
    # Each chunk has a checksum; a complete chunk may be lost.
    left = iter(f'message {i}' for i in range(60))
    assert all(message.data in left for _, message in messages)


@pytest.fixture(scope='module')
def unchecked(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, bytes], Path]:
    """Return a small friction recording in files without checksums."""
    folder = tmp_path_factory.mktemp('unchecked')
    loose = folder / 'loose.mcap'
    with (
        loose.open('wb') as stream,
        Writer(folder / 'bag', version=9, storage_plugin=StoragePlugin.SQLITE3) as writer,
    ):
        mcap = McapWriter(stream, use_chunking=False, enable_crcs=False)
        mcap.start('ros2')
        for topic, kind, make in (
            ('/ft', WRENCH, lambda at, i: wrench(at, i / 3.0)),
            ('/joints', MOTION, lambda at, i: joint_states(at, 0.1 + 0.01 * i, 0.1)),
        ):
            schema = mcap.register_schema(kind, 'ros2msg', b'')
            channel = mcap.register_channel(topic, 'cdr', schema)
            connection = writer.add_connection(topic, kind, typestore=STORE)
            for i in range(20):
                at = EPOCH + 10 * i * MILLISECOND
                mcap.add_message(channel, at, make(at, i), at)
                writer.write(connection, at, make(at, i))
        mcap.finish()
    database = next((folder / 'bag').glob('*.db3'))
    return {'.mcap': loose.read_bytes(), '.db3': database.read_bytes()}, folder / 'part'


@pytest.mark.parametrize('form', ['.mcap', '.db3'])
@settings(max_examples=200, deadline=None)
@given(data=strategies.data())
def test_a_recording_with_wrong_bytes_is_read_or_rejected(
    unchecked: tuple[dict[str, bytes], Path], form: str, data: Any
) -> None:
    wholes, part = unchecked
    wrong = bytearray(wholes[form])
    # Pages of a database are mostly empty.
    full = np.flatnonzero(np.frombuffer(wholes[form], dtype=np.uint8))
    for _ in range(data.draw(strategies.integers(1, 4))):
        at = full[data.draw(strategies.integers(0, len(full) - 1))]
        wrong[at] = data.draw(strategies.integers(0, 255))
    if data.draw(strategies.booleans()):
        del wrong[data.draw(strategies.integers(0, len(wrong))) :]
    path = part.with_suffix(form)
    path.write_bytes(wrong)
    lines: list[str] = []
    try:
        read = read_friction_recording(path)
        lines += read.losses
        assert len(read.time) <= 20
    except RecordingError as error:
        lines.append(str(error))
    assert not any('\n' in line for line in lines)


def test_a_missing_chunk_is_reported(tmp_path: Path) -> None:
    with BagWriter(tmp_path / 'bag') as writer:
        writer.add_topic('/ft', WRENCH)
        writer.add_topic('/joints', MOTION)
        for i in range(30):
            at = EPOCH + 10 * i * MILLISECOND
            writer.write('/ft', wrench(at, 0.0), at)
            writer.write('/joints', joint_states(at, 0.1, 0.0), at)
            if i % 10 == 9:
                writer.flush()
    file = tmp_path / 'bag' / 'bag_0.mcap'
    with file.open('rb') as stream:
        second = make_reader(stream).get_summary().chunk_indexes[1].chunk_start_offset
    data = bytearray(file.read_bytes())
    data[second] = 0x80
    file.write_bytes(data)
    loss, *gaps = read_friction_recording(file).losses
    assert loss == 'bag_0.mcap has lost messages; 40 of 60 messages read'
    assert gaps[:2] == [
        f'pauses of {topic} in 1 place, 0.11 s in all' for topic in ('/ft', '/joints')
    ]


@settings(max_examples=100, deadline=None)
@given(strategies.binary(max_size=200))
def test_arbitrary_bytes_are_rejected_in_one_line(cut: tuple[bytes, Path], data: bytes) -> None:
    _, part = cut
    part.write_bytes(data)
    with pytest.raises(RecordingError, match=r'is not an MCAP file|holds no messages') as caught:
        message_counts(part)
    assert '\n' not in str(caught.value)


def test_the_loss_of_a_truncated_recording_is_reported(tmp_path: Path, bag: Path) -> None:
    part = tmp_path / 'run_0.mcap'
    whole = next(bag.glob('*.mcap')).read_bytes()
    part.write_bytes(whole[: len(whole) // 2])
    [loss] = read_friction_recording(part).losses
    # Messages before the cut within a chunk are also read; the index takes some bytes.
    count = int(re.fullmatch(r'run_0.mcap is cut off; (\d+) messages read', loss)[1])
    assert 0.4 < count / sum(message_counts(bag).values()) < 0.9


def test_missing_metadata_is_reported(tmp_path: Path, bag: Path) -> None:
    shutil.copy(next(bag.glob('*.mcap')), tmp_path)
    [loss] = read_friction_recording(tmp_path).losses
    assert loss == 'no readable metadata.yaml: the recording was not closed'


def test_split_bags_are_read_in_order_and_missing_parts_are_reported(tmp_path: Path) -> None:
    names = [f'bag_{i}.mcap' for i in range(12)]
    for i, name in enumerate(names):
        with BagWriter(tmp_path / 'one') as writer:
            writer.add_topic('/a', TEXT)
            writer.write('/a', text(str(i)), EPOCH + i)
        shutil.copy(tmp_path / 'one' / 'one_0.mcap', tmp_path / name)
        shutil.rmtree(tmp_path / 'one')
    metadata = {'rosbag2_bagfile_information': {'relative_file_paths': names}}
    (tmp_path / 'metadata.yaml').write_text(yaml.safe_dump(metadata))
    assert [m.data for _, m in read_topic(tmp_path, '/a')] == [str(i) for i in range(12)]
    small_bag(tmp_path / 'other', *grid())
    shutil.copy(tmp_path / 'other' / 'other_0.mcap', tmp_path / 'bag_3.mcap')
    (tmp_path / 'bag_11.mcap').unlink()
    assert 'bag_11.mcap is missing' in read_friction_recording(tmp_path).losses


@pytest.mark.parametrize(
    ('plugin', 'mode'),
    [
        (StoragePlugin.SQLITE3, CompressionMode.NONE),
        (StoragePlugin.SQLITE3, CompressionMode.FILE),
        (StoragePlugin.SQLITE3, CompressionMode.MESSAGE),
        (StoragePlugin.MCAP, CompressionMode.NONE),
        (StoragePlugin.MCAP, CompressionMode.MESSAGE),
    ],
)
def test_bags_written_by_rosbags_are_read(
    tmp_path: Path, plugin: StoragePlugin, mode: CompressionMode
) -> None:
    writer = Writer(tmp_path / 'bag', version=9, storage_plugin=plugin)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        force = writer.add_connection('/ft', WRENCH, typestore=STORE)
        motion = writer.add_connection('/joints', MOTION, typestore=STORE)
        for i in range(10):
            at = EPOCH + 10 * i * MILLISECOND
            writer.write(force, at, wrench(at, float(i)))
            writer.write(motion, at, joint_states(at, 0.1, 0.0))
    read = read_friction_recording(tmp_path / 'bag')
    assert_array_equal(read.force, np.arange(10.0))
    assert read.losses == ()
    assert message_counts(tmp_path / 'bag') == {'/ft': 10, '/joints': 10}


@pytest.mark.parametrize('form', ['.mcap', '.db3'])
@pytest.mark.parametrize('compression', ['', '.zstd', '.zst', '.lz4'])
def test_single_compressed_and_truncated_files_are_read(
    tmp_path: Path, form: str, compression: str
) -> None:
    plugin = {'.mcap': StoragePlugin.MCAP, '.db3': StoragePlugin.SQLITE3}[form]
    noise = np.random.default_rng(0).normal(size=3000)
    with Writer(tmp_path / 'bag', version=9, storage_plugin=plugin) as writer:
        force = writer.add_connection('/ft', WRENCH, typestore=STORE)
        for i, value in enumerate(noise):
            writer.write(force, EPOCH + i, wrench(EPOCH + i, value))
    [file] = (tmp_path / 'bag').glob(f'*{form}')
    data = file.read_bytes()
    pack = {'': bytes, '.lz4': lz4.frame.compress}.get(compression, zstandard.compress)
    alone = tmp_path / f'alone{form}{compression}'
    alone.write_bytes(pack(data))
    assert message_counts(alone) == {'/ft': 3000}
    alone.write_bytes(pack(data)[: len(pack(data)) // 2])
    read = [m.wrench.force.y for _, m in read_topic(alone, '/ft')]
    # A compressed file is truncated between blocks, a database between pages.
    assert 300 < len(read) < 3000
    assert read == list(noise[: len(read)])


def test_messages_compressed_with_lz4_are_read(tmp_path: Path) -> None:
    with BagWriter(tmp_path / 'bag') as writer:
        writer.add_topic('/a', TEXT)
        for i in range(3):
            writer.write('/a', lz4.frame.compress(text(str(i))), EPOCH + i)
    assert [m.data for _, m in read_topic(tmp_path / 'bag', '/a')] == ['0', '1', '2']


def test_the_journal_of_a_database_is_read(tmp_path: Path) -> None:
    with Writer(tmp_path / 'bag', version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        force = writer.add_connection('/a', TEXT, typestore=STORE)
        writer.write(force, EPOCH, text('in the file'))
    file = next((tmp_path / 'bag').glob('*.db3'))
    recorder = sqlite3.connect(file)
    recorder.execute('PRAGMA journal_mode=WAL')
    recorder.execute('INSERT INTO messages VALUES (9, 1, ?, ?)', (EPOCH + 1, text('after it')))
    recorder.commit()
    try:
        assert [m.data for _, m in read_topic(file, '/a')] == ['in the file', 'after it']
    finally:
        recorder.close()


def test_messages_outside_of_chunks_are_read(tmp_path: Path) -> None:
    path = tmp_path / 'loose.mcap'
    with path.open('wb') as stream:
        writer = McapWriter(stream, use_chunking=False)
        writer.start('ros2')
        schema = writer.register_schema('std_msgs/String', 'ros2msg', b'string data')
        channel = writer.register_channel('/a', 'cdr', schema)
        for i in range(1000):
            writer.add_message(channel, EPOCH + i, text(str(i)), EPOCH + i)
        writer.finish()
    # Some writers leave out the middle of the type name, as in ROS 1.
    assert [m.data for _, m in read_topic(path, '/a')] == [str(i) for i in range(1000)]
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    assert 400 < len(read_topic(path, '/a')) < 600


@pytest.mark.parametrize('damaged', [0, 1])
def test_a_damaged_chunk_loses_only_its_own_messages(tmp_path: Path, damaged: int) -> None:
    """The first chunk also has the definitions of the topics, which the index repeats."""
    with BagWriter(tmp_path / 'bag', 'none') as writer:
        writer.add_topic('/a', TEXT)
        for i in range(30):
            writer.write('/a', text(f'message {i}'), EPOCH + i)
            if i % 10 == 9:
                writer.flush()
    file = tmp_path / 'bag' / 'bag_0.mcap'
    data = file.read_bytes()
    wrong = 10 * damaged + 5
    file.write_bytes(
        data.replace(f'message {wrong}'.encode(), b'message XX'[: len(f'message {wrong}')])
    )
    bag = Bag(file)
    numbers = [int(m.data.split()[1]) for _, m in read_topic(file, '/a')]
    assert numbers == [i for i in range(30) if i // 10 != damaged]
    assert sum(len(batch.received) for batch in bag.batches(lambda _topic: True)) == 20
    assert bag.losses == [
        'bag_0.mcap is damaged: the checksum of a chunk is wrong; 20 of 30 messages read'
    ]


def test_files_not_listed_in_the_metadata_are_ignored(tmp_path: Path, bag: Path) -> None:
    shutil.copytree(bag, tmp_path / 'run')
    shutil.copy(tmp_path / 'run' / 'run_0.mcap', tmp_path / 'run' / 'copy.mcap')
    read = read_friction_recording(tmp_path / 'run')
    assert read.losses == ('copy.mcap is not part of the recording by metadata.yaml, left out',)


def test_a_channel_with_an_unsupported_encoding_is_not_used(tmp_path: Path) -> None:
    path = tmp_path / 'ros1.mcap'
    with path.open('wb') as stream:
        writer = McapWriter(stream)
        writer.start('ros1')
        schema = writer.register_schema('geometry_msgs/WrenchStamped', 'ros1msg', b'')
        channel = writer.register_channel('/ft', 'ros1', schema)
        writer.add_message(channel, EPOCH, b'1234', EPOCH)
        writer.finish()
    with pytest.raises(RecordingError, match=r'/ft \(geometry_msgs/msg/WrenchStamped \[ros1\]\)'):
        read_friction_recording(path)


def test_custom_message_types_are_read_by_their_definition_in_the_bag(tmp_path: Path) -> None:
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg('std_msgs/Header header\nint32 x', 'lab_msgs/msg/Thing'))
    with Writer(tmp_path / 'bag', version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection('/thing', 'lab_msgs/msg/Thing', typestore=store)
        stamp = store.types['builtin_interfaces/msg/Time'](1, 2)
        thing = store.types['lab_msgs/msg/Thing'](store.types['std_msgs/msg/Header'](stamp, ''), 7)
        writer.write(connection, EPOCH, store.serialize_cdr(thing, 'lab_msgs/msg/Thing'))
    [(received, message)] = read_topic(tmp_path / 'bag', '/thing')
    assert (received, message.x, message.header.stamp.nanosec) == (EPOCH, 7, 2)


def damaged(tmp_path: Path, case: str) -> Path:
    """Create a path that is not a recording."""
    path = tmp_path / case
    if case == 'missing' or case.startswith('long'):
        return path
    if case in ('notes.txt', 'magic.mcap', 'empty.mcap', 'broken.db3'):
        path.write_bytes(b'' if case == 'empty.mcap' else b'what is this?')
        return path
    path.mkdir()
    if case == 'silent':
        path.rmdir()
        return small_bag(path)
    if case == 'nested':
        (path / 'a.mcap').mkdir()
    return path


@pytest.mark.parametrize(
    ('case', 'complaint'),
    [
        ('missing', 'missing does not exist; valid: a rosbag2 folder, an .mcap or a .db3 file'),
        ('notes.txt', 'notes.txt is not a recording; valid:'),
        ('magic.mcap', "magic.mcap is not an MCAP file: begins with b'what is '"),
        ('empty.mcap', 'empty.mcap is not an MCAP file: begins with nothing'),
        (
            'broken.db3',
            'broken.db3 holds no messages; broken.db3 is damaged: file is not a database',
        ),
        ('folder', 'folder holds no recording; valid:'),
        ('nested', 'nested holds no recording; valid:'),
        ('long' * 100, 'cannot read .*: File name too long'),
        ('silent', 'silent holds no messages'),
    ],
)
def test_invalid_recordings_are_rejected(tmp_path: Path, case: str, complaint: str) -> None:
    with pytest.raises(RecordingError, match=complaint) as caught:
        message_counts(damaged(tmp_path, case))
    assert '\n' not in str(caught.value)


def test_an_invalid_message_is_reported_by_its_number(tmp_path: Path) -> None:
    with BagWriter(tmp_path / 'bag') as writer:
        writer.add_topic('/a', WRENCH)
        writer.write('/a', wrench(EPOCH, 1.0), EPOCH)
        writer.write('/a', b'\x00\x01\x00\x00zzz', EPOCH)
    with pytest.raises(RecordingError, match='message 1 of /a is not a geometry_msgs/msg/Wrench'):
        read_topic(tmp_path / 'bag', '/a')
