"""Bags come back as they were written, open in other tools, and break without a traceback."""

from pathlib import Path
import resource
import shutil

from hypothesis import given, HealthCheck, settings, strategies
from identification.samples import (
    EPOCH,
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
from mcap.reader import make_reader
from needle_identification import (
    BagWriter,
    identify_friction,
    message_counts,
    OfferedQos,
    read_friction_recording,
    read_topic,
    RecordingError,
)
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
import pytest
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import get_types_from_msg, get_typestore, Stores
import yaml

MILLISECOND = 1_000_000


@pytest.fixture(scope='module')
def recording():
    return simulated()


@pytest.fixture(scope='module')
def bag(tmp_path_factory, recording):
    """Return a bag with all that our plant publishes; tests must not change it."""
    path = tmp_path_factory.mktemp('bags') / 'run'
    truth = {'/plant': {'ros__parameters': {'model.coulomb_friction': 0.56}}}
    write_bag(path, recording, yaml.safe_dump(truth))
    return path


def small_bag(path, wrenches=(), motions=(), joint_names=('insertion',)):
    """Write (stamp, value) wrenches and (stamp, depth, speed) motions, in ms after the epoch."""
    with BagWriter(path) as writer:
        writer.add_topic('/ft', WRENCH)
        writer.add_topic('/joints', MOTION)
        for stamp, force in wrenches:
            at = EPOCH + stamp * MILLISECOND
            writer.write('/ft', wrench(at, force), at)
        for stamp, depth, speed in motions:
            at = EPOCH + stamp * MILLISECOND
            writer.write('/joints', joint_states(at, depth, speed, joint_names), at)
    return path


def grid(count=11, step=10):
    return [(i * step, float(i)) for i in range(count)], [
        (i * step, 0.1 + 0.001 * i, 0.1) for i in range(count)
    ]


# Round trip.


def test_gives_back_every_byte_and_nanosecond(tmp_path):
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
def test_opens_in_rosbags_with_its_own_definitions_and_hashes(tmp_path, compression):
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
        connection = reader.topics['/a'].connections[0]
        assert connection.digest == STORE.hash_rihs01(WRENCH)
        assert connection.ext.offered_qos_profiles[0].reliability.name == 'BEST_EFFORT'
        forces = [
            reader.deserialize(data, connection.msgtype).wrench.force.y
            for connection, _, data in reader.messages()
        ]
    assert forces == [1.5, 2.5]


def test_stores_what_rosbag2_and_foxglove_look_for(bag):
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
    # An alias would be an odd thing to hand to other parsers.
    assert '&id' not in (bag / 'metadata.yaml').read_text()


def test_arrays_of_a_recording_survive_the_bag(bag, recording):
    read = read_friction_recording(bag)
    # 2e-9: a stamp is a whole nanosecond, and so is the first one.
    assert_allclose(read.time, recording.time, rtol=0.0, atol=2e-9)
    assert_array_equal(read.force, recording.force)
    # Interpolation to its own stamps leaves rounding.
    assert_allclose(read.speed, recording.speed, rtol=1e-12, atol=1e-12)
    assert_allclose(read.depth, recording.depth, rtol=1e-12)
    assert read.losses == ()
    assert read.truth == {'model.coulomb_friction': 0.56}
    one, other = identify_friction(read), identify_friction(recording)
    # The speeds were rounded to 1e-12 in the middle of 1e-3.
    assert_allclose(one.coulomb_friction, other.coulomb_friction, rtol=1e-6)


def test_counts_messages_by_topic(bag, recording):
    count = len(recording.time)
    assert message_counts(bag) == {
        '/base_wrench': count,
        '/ground_truth': count,
        '/joint_states': count,
        '/plant/configuration': 1,
        '/wrench_command': count,
    }


# Writing.


def test_metadata_appears_only_with_close(tmp_path):
    writer = BagWriter(tmp_path / 'bag')
    writer.add_topic('/a', TEXT)
    writer.write('/a', text('x'), EPOCH)
    writer.flush()
    assert [file.name for file in (tmp_path / 'bag').iterdir()] == ['bag_0.mcap']
    # What was flushed is there for any other process.
    assert message_counts(tmp_path / 'bag') == {'/a': 1}
    writer.close()
    assert sorted(file.name for file in (tmp_path / 'bag').iterdir()) == [
        'bag_0.mcap',
        'metadata.yaml',
    ]


def test_an_error_leaves_the_folder_unfinished_and_readable(tmp_path):
    def fail():
        with BagWriter(tmp_path / 'bag') as writer:
            writer.add_topic('/a', TEXT)
            writer.write('/a', text('x'), EPOCH)
            writer.flush()
            writer.write('/b', text('x'), EPOCH)

    with pytest.raises(KeyError):
        fail()
    assert not (tmp_path / 'bag' / 'metadata.yaml').exists()
    assert message_counts(tmp_path / 'bag') == {'/a': 1}


def test_refuses_a_folder_that_exists(tmp_path):
    with pytest.raises(RecordingError, match='exists; a recording must go to a new folder'):
        BagWriter(tmp_path)


def test_refuses_a_place_that_cannot_be_written(tmp_path):
    (tmp_path / 'file').touch()
    with pytest.raises(RecordingError, match=r'cannot record to .*/file/bag: Not a directory'):
        BagWriter(tmp_path / 'file' / 'bag')


def test_refuses_a_type_it_cannot_describe(tmp_path):
    with (
        BagWriter(tmp_path / 'bag') as writer,
        pytest.raises(RecordingError, match='no definition of lab_msgs/msg/Thing'),
    ):
        writer.add_topic('/a', 'lab_msgs/msg/Thing')


def test_a_full_disk_is_an_error_of_the_system_and_loses_nothing_flushed(tmp_path):
    noise = np.random.default_rng(0)
    writer = BagWriter(tmp_path / 'bag')
    writer.add_topic('/a', TEXT)
    flushed = 0

    def fill():
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


# Broken and foreign bags.


@pytest.fixture(scope='module')
def cut(tmp_path_factory):
    """Return a file in several chunks, its messages, and a place for cut-off copies."""
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
def test_a_bag_cut_off_at_any_byte_gives_its_first_messages(cut, data):
    whole, part = cut
    part.write_bytes(whole[: data.draw(strategies.integers(0, len(whole)))])
    try:
        messages = read_topic(part, '/a')
    except RecordingError:
        return
    assert [m.data for _, m in messages] == [f'message {i}' for i in range(len(messages))]


@settings(max_examples=300, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(data=strategies.data())
def test_a_bag_with_a_wrong_byte_is_read_or_refused(cut, data):
    whole, part = cut
    at = data.draw(strategies.integers(0, len(whole) - 1))
    wrong = bytearray(whole)
    wrong[at] ^= data.draw(strategies.integers(1, 255))
    part.write_bytes(wrong)
    try:
        messages = read_topic(part, '/a')
    except RecordingError:
        return
    # The checksum of each chunk vouches for what is in it; a whole chunk may be lost.
    left = iter(f'message {i}' for i in range(60))
    assert all(message.data in left for _, message in messages)


def test_a_chunk_lost_in_the_middle_is_noticed(tmp_path):
    with BagWriter(tmp_path / 'bag') as writer:
        writer.add_topic('/ft', WRENCH)
        writer.add_topic('/joints', MOTION)
        for i in range(30):
            writer.write('/ft', wrench(EPOCH + i, 0.0), EPOCH + i)
            writer.write('/joints', joint_states(EPOCH + i, 0.1, 0.0), EPOCH + i)
            if i % 10 == 9:
                writer.flush()
    file = tmp_path / 'bag' / 'bag_0.mcap'
    with file.open('rb') as stream:
        second = make_reader(stream).get_summary().chunk_indexes[1].chunk_start_offset
    data = bytearray(file.read_bytes())
    data[second] = 0x80
    file.write_bytes(data)
    losses = read_friction_recording(file).losses
    assert losses[0] == 'bag_0.mcap is broken after 40 messages: 60 were written'


@settings(max_examples=100, deadline=None)
@given(strategies.binary(max_size=200))
def test_any_bytes_are_refused_in_one_line(cut, data):
    _, part = cut
    part.write_bytes(data)
    with pytest.raises(RecordingError, match=r'is not an MCAP file|holds no messages') as caught:
        message_counts(part)
    assert '\n' not in str(caught.value)


def test_says_what_a_cut_off_recording_lost(tmp_path, bag):
    part = tmp_path / 'run_0.mcap'
    whole = next(bag.glob('*.mcap')).read_bytes()
    part.write_bytes(whole[: len(whole) // 2])
    [loss] = read_friction_recording(part).losses
    assert loss.startswith('run_0.mcap is cut off after ')


def test_reads_a_folder_without_metadata_and_says_so(tmp_path, bag):
    shutil.copy(next(bag.glob('*.mcap')), tmp_path)
    [loss] = read_friction_recording(tmp_path).losses
    assert loss == 'no readable metadata.yaml: the recording was not closed'


def test_reads_the_parts_of_a_split_bag_in_order_and_misses_one_by_name(tmp_path):
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
def test_reads_bags_of_another_writer(tmp_path, plugin, mode):
    writer = Writer(tmp_path / 'bag', version=9, storage_plugin=plugin)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        force = writer.add_connection('/ft', WRENCH, typestore=STORE)
        motion = writer.add_connection('/joints', MOTION, typestore=STORE)
        for i in range(10):
            writer.write(force, EPOCH + i, wrench(EPOCH + i * MILLISECOND, float(i)))
            writer.write(motion, EPOCH + i, joint_states(EPOCH + i * MILLISECOND, 0.1, 0.0))
    read = read_friction_recording(tmp_path / 'bag')
    assert_array_equal(read.force, np.arange(10.0))
    assert read.losses == ()
    assert message_counts(tmp_path / 'bag') == {'/ft': 10, '/joints': 10}


def test_decodes_a_type_of_the_lab_by_the_definition_in_the_bag(tmp_path):
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
    """Make what is not a recording."""
    path = tmp_path / case
    if case == 'missing':
        return path
    if case in ('notes.txt', 'magic.mcap', 'empty.mcap', 'broken.db3'):
        path.write_bytes(b'' if case == 'empty.mcap' else b'what is this?')
        return path
    path.mkdir()
    if case == 'silent':
        path.rmdir()
        return small_bag(path)
    return path


@pytest.mark.parametrize(
    ('case', 'complaint'),
    [
        ('missing', 'missing does not exist; valid: a rosbag2 folder, an .mcap or a .db3 file'),
        ('notes.txt', 'notes.txt is not a recording; valid:'),
        ('magic.mcap', "magic.mcap is not an MCAP file: begins with b'what is '"),
        ('empty.mcap', "empty.mcap is not an MCAP file: begins with b''"),
        ('broken.db3', 'broken.db3 holds no messages; broken.db3 is broken after 0 messages'),
        ('folder', 'folder holds no recording; valid:'),
        ('silent', 'silent holds no messages'),
    ],
)
def test_says_what_is_not_a_recording(tmp_path, case, complaint):
    with pytest.raises(RecordingError, match=complaint) as caught:
        message_counts(damaged(tmp_path, case))
    assert '\n' not in str(caught.value)


# Finding force and motion.


def test_prefers_the_usual_names_and_lists_candidates_otherwise(tmp_path, bag):
    with pytest.raises(RecordingError, match=r'has no topic /nope .*; it has /base_wrench'):
        read_friction_recording(bag, wrench_topic='/nope')
    with pytest.raises(RecordingError, match=r'has no topic /nope; it has /base_wrench \(geo'):
        read_topic(bag, '/nope')
    assert read_friction_recording(bag, wrench_topic='/wrench_command').force.max() == 0.0
    with BagWriter(tmp_path / 'two') as writer:
        for topic in ('/left/ft', '/right/ft'):
            writer.add_topic(topic, WRENCH)
            writer.write(topic, wrench(EPOCH, 0.0), EPOCH)
    with pytest.raises(RecordingError, match=r'several topics.*name one of /left/ft, /right/ft'):
        read_friction_recording(tmp_path / 'two')
    with pytest.raises(
        RecordingError, match='no topic of type sensor_msgs/msg/JointState; it has'
    ):
        read_friction_recording(tmp_path / 'two', wrench_topic='/left/ft')


@pytest.mark.parametrize(('axis', 'sign'), [('y', 1.0), ('-y', -1.0), ('x', 0.0)])
def test_takes_the_axis_asked_for(tmp_path, axis, sign):
    path = small_bag(tmp_path / 'bag', *grid())
    assert_array_equal(
        read_friction_recording(path, force_axis=axis).force, sign * np.arange(11.0)
    )


@pytest.mark.parametrize('axis', ['', '-', 'w', '--x', 'xy'])
def test_refuses_an_axis_that_is_none(tmp_path, axis):
    with pytest.raises(RecordingError, match='force axis must be'):
        read_friction_recording(tmp_path, force_axis=axis)


def test_takes_the_joint_asked_for_and_lists_what_there_is(tmp_path):
    path = small_bag(tmp_path / 'bag', *grid(), joint_names=('slide', 'roll'))
    with pytest.raises(RecordingError, match="no joint 'insertion'; it has roll, slide"):
        read_friction_recording(path)
    assert len(read_friction_recording(path, joint='slide').time) == 11


def test_motion_is_interpolated_to_the_stamps_of_the_force(tmp_path):
    wrenches = [(i * 10 + 5, float(i)) for i in range(10)]
    path = small_bag(tmp_path / 'bag', wrenches, grid()[1])
    read = read_friction_recording(path)
    assert_allclose(read.depth, 0.1005 + 0.001 * np.arange(10), rtol=1e-12)


def test_speed_is_differentiated_where_there_is_none(tmp_path):
    wrenches, motions = grid()
    path = small_bag(tmp_path / 'bag', wrenches, [(t, d, None) for t, d, _ in motions])
    read = read_friction_recording(path)
    # 1e-9: differences of 1e-3 m in positions of 0.1 m.
    assert_allclose(read.speed, 0.1, rtol=1e-9)
    assert read.losses == ('/joints has no velocity: position differentiated',)


def test_samples_that_say_nothing_are_left_out_and_counted(tmp_path):
    wrenches, motions = grid()
    wrenches[3] = (30, float('nan'))
    wrenches[5], wrenches[6] = wrenches[6], wrenches[5]
    wrenches.append(wrenches[-1])
    motions[8] = (80, float('inf'), 0.1)
    read = read_friction_recording(small_bag(tmp_path / 'bag', wrenches, motions))
    assert_allclose(read.time, [t / 100.0 for t in range(11) if t != 3], atol=1e-12)
    assert read.losses == (
        '1 of /ft out of order, sorted by stamp',
        '1 of /ft not finite, left out',
        '1 of /ft with the stamp of another, left out',
        '1 of /joints not finite, left out',
    )


def test_force_without_motion_is_left_out_and_counted(tmp_path):
    wrenches, motions = grid(count=101)
    path = small_bag(tmp_path / 'bag', wrenches, motions[10:40] + motions[70:])
    read = read_friction_recording(path)
    # Ten before the motion; thirty in the gap, and the one at its end.
    assert read.losses == ('41 of /ft not covered by /joints',)
    later = small_bag(tmp_path / 'later', wrenches, [(t + 5000, d, v) for t, d, v in motions])
    with pytest.raises(RecordingError, match='/ft and /joints do not overlap in time'):
        read_friction_recording(later)


def test_without_header_stamps_the_time_of_reception_counts(tmp_path):
    with BagWriter(tmp_path / 'bag') as writer:
        writer.add_topic('/ft', WRENCH)
        writer.add_topic('/joints', MOTION)
        for i in range(5):
            writer.write('/ft', wrench(0, float(i)), EPOCH + i * MILLISECOND)
            writer.write('/joints', joint_states(0, 0.1, 0.0), EPOCH + i * MILLISECOND)
    assert_allclose(read_friction_recording(tmp_path / 'bag').time, np.arange(5) * 1e-3)


def test_one_sample_is_not_a_recording(tmp_path):
    path = small_bag(tmp_path / 'bag', [(0, 1.0)], grid()[1])
    with pytest.raises(
        RecordingError, match='/ft must have >= 2 samples at different times, has 1'
    ):
        read_friction_recording(path)


def test_a_message_that_is_not_of_its_type_is_named(tmp_path):
    with BagWriter(tmp_path / 'bag') as writer:
        writer.add_topic('/a', WRENCH)
        writer.write('/a', wrench(EPOCH, 1.0), EPOCH)
        writer.write('/a', b'\x00\x01\x00\x00zzz', EPOCH)
    with pytest.raises(RecordingError, match='message 1 of /a is not a geometry_msgs/msg/Wrench'):
        read_topic(tmp_path / 'bag', '/a')
