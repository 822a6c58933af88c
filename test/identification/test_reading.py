# SPDX-License-Identifier: Apache-2.0
"""Recordings of any laboratory give force and motion, or a one-line error."""

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
import re
import struct
from typing import Any

from hypothesis import given, settings, strategies
from mcap.reader import make_reader
from mcap.writer import Writer as McapWriter
from needle_identification import (
    BagWriter,
    inspect_recording,
    read_friction_recording,
    read_indentation_recording,
    RecordingError,
)
from needle_identification.bags.messages import message_type
from needle_identification.recordings import samples
from needle_identification.recordings.merging import clock_offset
from needle_identification.recordings.samples import restart_of, Samples
from needle_ros.errors import ParameterError
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
import pytest
from support.samples import (
    EPOCH,
    grid,
    header,
    joint_states,
    MOTION,
    STORE,
    TEXT,
    text,
    WRENCH,
    wrench,
)

MILLISECOND = 1_000_000
POSE = 'geometry_msgs/msg/PoseStamped'
POINT = 'geometry_msgs/msg/PointStamped'
TWIST = 'geometry_msgs/msg/TwistStamped'
ODOMETRY = 'nav_msgs/msg/Odometry'


def pose(position: tuple[float, ...], turn: float = 0.0) -> Any:
    """Build a pose rotated about z [rad]."""
    orientation = (0.0, 0.0, np.sin(turn / 2.0), np.cos(turn / 2.0))
    return message_type('geometry_msgs/msg/Pose')(
        message_type('geometry_msgs/msg/Point')(*position),
        message_type('geometry_msgs/msg/Quaternion')(*orientation),
    )


def twist(velocity: tuple[float, ...]) -> Any:
    vector = message_type('geometry_msgs/msg/Vector3')
    return message_type('geometry_msgs/msg/Twist')(vector(*velocity), vector(0.0, 0.0, 0.0))


def odometry(
    stamp: int, position: tuple[float, ...], velocity: tuple[float, ...], turn: float = 0.0
) -> bytes:
    """Serialize an Odometry with a body rotated about z; the velocity is in the body frame."""
    zero = np.zeros(36)
    return serialized(
        ODOMETRY,
        stamp,
        'needle_base',
        message_type('geometry_msgs/msg/PoseWithCovariance')(pose(position, turn), zero),
        message_type('geometry_msgs/msg/TwistWithCovariance')(twist(velocity), zero),
    )


def serialized(type_name: str, stamp: int, *parts: Any) -> bytes:
    return bytes(STORE.serialize_cdr(message_type(type_name)(header(stamp), *parts), type_name))


def moving(type_name: str, stamp: int, depth: float, velocity: float) -> bytes:
    """Serialize a motion along y in each type of message."""
    if type_name == MOTION:
        return joint_states(stamp, depth, velocity)
    if type_name == ODOMETRY:
        return odometry(stamp, (0.0, depth, 0.0), (0.0, velocity, 0.0))
    if type_name == TWIST:
        return serialized(TWIST, stamp, twist((0.0, velocity, 0.0)))
    if type_name == POSE:
        return serialized(POSE, stamp, pose((0.0, depth, 0.0)))
    return serialized(POINT, stamp, message_type('geometry_msgs/msg/Point')(0.0, depth, 0.0))


def write(path: Path, topics: dict[str, tuple[str, list[tuple[Any, Any]]]]) -> Path:
    """Write topics, each a type and (stamp [ms after the epoch], bytes)."""
    with BagWriter(path) as writer:
        for topic, (type_name, messages) in topics.items():
            writer.add_topic(topic, type_name)
            for stamp, data in messages:
                writer.write(topic, data, EPOCH + stamp * MILLISECOND)
    return path


def at(stamp: int) -> int:
    return EPOCH + stamp * MILLISECOND


def small_bag(
    path: Path,
    wrenches: Sequence[tuple[int, float]] = (),
    motions: Sequence[tuple[int, float, float]] = (),
    joint_names: tuple[str, ...] = ('insertion',),
) -> Path:
    """Write (stamp, value) wrenches and (stamp, depth, velocity) motions, in ms of Unix time."""
    return write(
        path,
        {
            '/ft': (WRENCH, [(t, wrench(at(t), force)) for t, force in wrenches]),
            '/joints': (
                MOTION,
                [(t, joint_states(at(t), d, v, joint_names)) for t, d, v in motions],
            ),
        },
    )


def forces(count: int = 11, step: int = 10) -> tuple[str, list[tuple[int, bytes]]]:
    return WRENCH, [(i * step, wrench(at(i * step), float(i))) for i in range(count)]


# Selection of force and motion.


@pytest.mark.parametrize(('axis', 'sign'), [('y', 1.0), ('-y', -1.0), ('x', 0.0)])
def test_the_force_axis_can_be_chosen(tmp_path: Path, axis: str, sign: float) -> None:
    path = small_bag(tmp_path / 'bag', *grid())
    assert_array_equal(
        read_friction_recording(path, force_axis=axis).force, sign * np.arange(11.0)
    )


@pytest.mark.parametrize('axis', ['', '-', 'w', '--x', 'xy'])
def test_an_invalid_axis_is_rejected(tmp_path: Path, axis: str) -> None:
    with pytest.raises(ParameterError, match='force axis must be'):
        read_friction_recording(tmp_path, force_axis=axis)


def test_the_joint_can_be_chosen(tmp_path: Path) -> None:
    path = small_bag(tmp_path / 'bag', *grid(), joint_names=('slide', 'roll'))
    with pytest.raises(RecordingError, match=r"no joint 'insertion'; .* one of roll, slide"):
        read_friction_recording(path)
    one, other = (read_friction_recording(path, motion_axis=axis) for axis in ('slide', '-slide'))
    assert_array_equal(one.depth, -other.depth)
    assert_array_equal(one.velocity, -other.velocity)
    alone = small_bag(tmp_path / 'alone', *grid(), joint_names=('slide',))
    assert_array_equal(read_friction_recording(alone).depth, one.depth)


def test_motion_is_interpolated_to_the_stamps_of_the_force(tmp_path: Path) -> None:
    wrenches = [(i * 10 + 5, float(i)) for i in range(10)]
    path = small_bag(tmp_path / 'bag', wrenches, grid()[1])
    read = read_friction_recording(path)
    assert_allclose(read.depth, 0.1005 + 0.001 * np.arange(10), rtol=1e-12)


def test_a_missing_velocity_is_reported(tmp_path: Path) -> None:
    wrenches, motions = grid()
    for name, value in (('empty', None), ('nan', float('nan'))):
        path = small_bag(tmp_path / name, wrenches, [(t, d, value) for t, d, _ in motions])
        read = read_friction_recording(path)
        assert read.velocity is None
        assert read.losses == ('/joints has no velocity',)
    path = small_bag(tmp_path / 'zero', wrenches, [(t, d, 0.0) for t, d, _ in motions])
    read = read_friction_recording(path)
    assert read.velocity is None
    assert read.losses == ('/joints moves with the velocity 0, which is left out',)


def test_samples_without_velocity_are_discarded_if_most_have_a_velocity(tmp_path: Path) -> None:
    wrenches, motions = grid()
    motions[4] = (40, 0.104, None)
    read = read_friction_recording(small_bag(tmp_path / 'bag', wrenches, motions))
    assert_array_equal(read.velocity, 0.1)
    assert read.losses == ('1 of /joints without velocity, left out',)


def test_unusable_samples_are_discarded_and_counted(tmp_path: Path) -> None:
    wrenches, motions = grid()
    wrenches[3] = (30, float('nan'))
    wrenches[5], wrenches[6] = wrenches[6], wrenches[5]
    wrenches.append(wrenches[-1])
    motions[8] = (80, float('inf'), 0.1)
    read = read_friction_recording(small_bag(tmp_path / 'bag', wrenches, motions))
    assert_allclose(read.time, [t / 100.0 for t in range(11) if t != 3], atol=1e-12)
    assert read.losses == (
        '1 of /ft not finite, left out',
        '1 of /ft out of order, sorted by stamp',
        '1 of /ft with the stamp of another, left out',
        '1 of /joints not finite, left out',
    )


def test_force_without_motion_is_discarded_and_counted(tmp_path: Path) -> None:
    wrenches, motions = grid(count=101)
    path = small_bag(tmp_path / 'bag', wrenches, motions[10:40] + motions[70:])
    read = read_friction_recording(path)
    # Ten before the motion, thirty in the gap, and its end.
    assert read.losses == (
        'pauses of /joints in 1 place, 0.31 s in all',
        '41 of /ft not covered by /joints',
    )
    later = small_bag(tmp_path / 'later', wrenches, [(t + 5000, d, v) for t, d, v in motions])
    with pytest.raises(RecordingError, match='/ft and /joints do not overlap in time'):
        read_friction_recording(later)


def test_without_header_stamps_the_receive_time_is_used(tmp_path: Path) -> None:
    with BagWriter(tmp_path / 'bag') as writer:
        writer.add_topic('/ft', WRENCH)
        writer.add_topic('/joints', MOTION)
        for i in range(5):
            writer.write('/ft', wrench(0, float(i)), at(10 * i))
            writer.write('/joints', joint_states(0, 0.1, 0.0), at(10 * i))
    read = read_friction_recording(tmp_path / 'bag')
    assert_allclose(read.time, np.arange(5) * 1e-2)
    assert read.losses == (
        '5 of /ft without a stamp, the receive time is used',
        '5 of /joints without a stamp, the receive time is used',
    )


def test_stamp_of_a_simulation_that_begins_at_zero_is_a_stamp(tmp_path: Path) -> None:
    """Its receive time is 0, too."""
    with BagWriter(tmp_path / 'bag') as writer:
        writer.add_topic('/ft', WRENCH)
        writer.add_topic('/joints', MOTION)
        for stamp in range(0, 10**8, 10**7):
            writer.write('/ft', wrench(stamp, 1.0), stamp)
            writer.write('/joints', joint_states(stamp, 0.1, 0.0), stamp)
    assert read_friction_recording(tmp_path / 'bag').losses == ()


def test_one_sample_is_not_a_recording(tmp_path: Path) -> None:
    path = small_bag(tmp_path / 'bag', [(0, 1.0)], grid()[1])
    with pytest.raises(
        RecordingError, match='/ft must have >= 2 samples at different times, has 1'
    ):
        read_friction_recording(path)


# Other types and laboratories.


@pytest.mark.parametrize('type_name', [MOTION, POSE, POINT, TWIST, ODOMETRY])
def test_motion_is_independent_of_the_message_type(tmp_path: Path, type_name: str) -> None:
    motions = [(t, moving(type_name, at(t), d, v)) for t, d, v in grid()[1]]
    path = write(tmp_path / 'bag', {'/ft': forces(), '/robot': (type_name, motions)})
    axis = '-insertion' if type_name == MOTION else '-y'
    for sign, chosen in ((1.0, None), (-1.0, axis)):
        read = read_friction_recording(path, motion_axis=chosen)
        begin = 0.0 if type_name == TWIST else 0.1
        # 1e-12: rounding of sums and differences near 0.1.
        assert_allclose(read.depth, sign * (begin + 0.001 * np.arange(11)), atol=1e-12)
        if type_name in (POSE, POINT):
            assert read.velocity is None
        else:
            assert_allclose(read.velocity, sign * 0.1, rtol=1e-12)
    said = {
        POSE: ('/robot has no velocity',),
        POINT: ('/robot has no velocity',),
        TWIST: ('/robot has no position: depth is the integral of speed from 0',),
    }
    assert read.losses == said.get(type_name, ())


def test_the_velocity_of_an_odometry_is_rotated_from_the_body_frame(tmp_path: Path) -> None:
    # The body is rotated by 90 degrees about z: its x is y of the frame.
    motions = [
        (t, odometry(at(t), (0.0, d, 0.0), (v, 0.0, 0.0), np.pi / 2.0)) for t, d, v in grid()[1]
    ]
    path = write(tmp_path / 'bag', {'/ft': forces(), '/odom': (ODOMETRY, motions)})
    # 1e-12: rounding of the quaternion.
    assert_allclose(read_friction_recording(path).velocity, 0.1, rtol=1e-12)


def test_joints_may_change_order_and_publisher(tmp_path: Path) -> None:
    messages = []
    for i in range(11):
        names = ('insertion', 'rotation') if i % 2 else ('rotation', 'insertion')
        values = (0.1 + 0.001 * i, -5.0) if i % 2 else (-5.0, 0.1 + 0.001 * i)
        messages.append((10 * i, joints(at(10 * i), names, values, values)))
        messages.append((10 * i + 5, joints(at(10 * i + 5), ('grip',), (9.0,), ())))
    path = write(tmp_path / 'bag', {'/ft': forces(), '/joints': (MOTION, messages)})
    read = read_friction_recording(path, motion_axis='insertion')
    assert_array_equal(read.depth, 0.1 + 0.001 * np.arange(11))
    assert read.losses == ()
    # Default joint.
    assert_array_equal(read_friction_recording(path).depth, read.depth)


@pytest.mark.parametrize('first', [True, False])
def test_a_corrupted_joint_name_discards_one_message(tmp_path: Path, first: bool) -> None:
    """For the first and for later messages; the loss is counted."""
    names = ['slide'] * 100
    names[0 if first else 70] = 'sl\x1bde'
    messages = [
        (10 * i, joints(at(10 * i), (name,), (0.1 + 0.001 * i,), (0.1,)))
        for i, name in enumerate(names)
    ]
    path = write(tmp_path / 'bag', {'/ft': forces(100), '/joints': (MOTION, messages)})
    read = read_friction_recording(path)
    assert len(read.time) >= 98
    assert '1 of /joints name other joints, left out' in read.losses


def joints(
    stamp: int, names: tuple[str, ...], position: tuple[float, ...], velocity: tuple[float, ...]
) -> bytes:
    return serialized(
        MOTION,
        stamp,
        list(names),
        np.array(position, dtype=float),
        np.array(velocity, dtype=float),
        np.array([]),
    )


def test_arrays_shorter_than_the_names_are_missing_samples(tmp_path: Path) -> None:
    messages = [
        (10 * i, joints(at(10 * i), ('a', 'insertion'), (0.0, 0.1)[: 1 + (i != 4)], (0.0, 0.1)))
        for i in range(11)
    ]
    path = write(tmp_path / 'bag', {'/ft': forces(), '/joints': (MOTION, messages)})
    assert read_friction_recording(path).losses == ('1 of /joints not finite, left out',)


def test_invalid_messages_are_discarded_and_counted(tmp_path: Path) -> None:
    kind, wrenches = forces()
    wrenches[3] = (30, wrenches[3][1][:-5])
    wrenches[5] = (50, b'')
    wrenches[6] = (60, b'\x00\x03' + wrenches[6][1][2:])
    path = write(
        tmp_path / 'bag',
        {'/ft': (kind, wrenches), '/joints': (MOTION, [
            (t, joint_states(at(t), d, v)) for t, d, v in grid()[1]
        ])},
    )  # fmt: skip
    read = read_friction_recording(path)
    assert_array_equal(read.force, [0, 1, 2, 4, 7, 8, 9, 10])
    assert read.losses == ('3 of /ft not readable, left out: the first one ends after 71 bytes',)


def test_topics_of_other_types_are_ignored(tmp_path: Path) -> None:
    path = small_bag(tmp_path / 'bag', *grid())
    file = path / 'bag_0.mcap'
    with file.open('rb') as stream:
        known = [*make_reader(stream).iter_messages()]
    with (tmp_path / 'more.mcap').open('wb') as stream:
        writer = McapWriter(stream)
        writer.start('ros2')
        event = writer.register_schema('lab_srvs/srv/Tare_Event', 'ros2idl', b'what is this?')
        strange = writer.register_channel('/tare/_service_event', 'cdr', event)
        bare = writer.register_channel('/bare', 'json', 0)
        ids = {}
        for schema, channel, message in known:
            if channel.topic not in ids:
                kind = writer.register_schema(schema.name, 'ros2msg', schema.data)
                ids[channel.topic] = writer.register_channel(channel.topic, 'cdr', kind)
            writer.add_message(strange, message.log_time, b'\x00\x01\xff', message.log_time)
            writer.add_message(bare, message.log_time, b'{}', message.log_time)
            writer.add_message(
                ids[channel.topic], message.log_time, message.data, message.log_time
            )
        writer.finish()
    read = read_friction_recording(tmp_path / 'more.mcap')
    assert_array_equal(read.force, np.arange(11.0))
    assert read.losses == ()


def test_usual_topic_names_are_preferred(tmp_path: Path) -> None:
    motions = (MOTION, [(t, joint_states(at(t), d, v)) for t, d, v in grid()[1]])
    usual = write(
        tmp_path / 'usual',
        {
            '/lab/base_wrench': forces(),
            '/command': forces(count=5),
            '/lab/joint_states': motions,
            '/reference': motions,
        },
    )
    assert len(read_friction_recording(usual).time) == 11
    assert len(read_friction_recording(usual, wrench_topic='/command').time) == 5
    with pytest.raises(RecordingError, match=r'no topic /nope of type WrenchStamped; it has /com'):
        read_friction_recording(usual, wrench_topic='/nope')
    two = write(tmp_path / 'two', {'/left/ft': forces(), '/right/ft': forces()})
    with pytest.raises(RecordingError, match=r'several topics.*name one of /left/ft, /right/ft'):
        read_friction_recording(two)
    with pytest.raises(RecordingError, match=r'no topic of type JointState, .*; it has /l'):
        read_friction_recording(two, wrench_topic='/left/ft')


def test_the_last_configuration_of_the_plant_is_read(tmp_path: Path) -> None:
    wrenches, motions = grid()
    with BagWriter(tmp_path / 'bag') as writer:
        for topic, kind in (('/ft', WRENCH), ('/joints', MOTION), ('/plant/configuration', TEXT)):
            writer.add_topic(topic, kind)
        for data in (text('old'), text('new')):
            writer.write('/plant/configuration', data, EPOCH)
        for (t, force), (_, depth, velocity) in zip(wrenches, motions, strict=True):
            writer.write('/ft', wrench(at(t), force), at(t))
            writer.write('/joints', joint_states(at(t), depth, velocity), at(t))
    assert read_friction_recording(tmp_path / 'bag').configuration == 'new'


# Clocks.


def two_clocks(
    path: Path, ahead: float, latency: tuple[float, ...] = (0.002, 0.002), count: int = 500
) -> Path:
    """Write force and motion every 4 ms, with an offset of the clock of the force [s]."""
    rng = np.random.default_rng(0)
    with BagWriter(path) as writer:
        writer.add_topic('/ft', WRENCH)
        writer.add_topic('/joints', MOTION)
        for i in range(count):
            true = at(4 * i)
            late = [round(1e9 * (least + rng.exponential(0.005))) for least in latency]
            stamp = true + round(1e9 * ahead)
            writer.write('/ft', wrench(stamp, float(i)), true + late[0])
            writer.write('/joints', joint_states(true, 1e-3 * i, 0.25), true + late[1])
    return path


@pytest.mark.parametrize('ahead', [-3600.0, 0.5, 1e6])
def test_different_clocks_are_aligned(tmp_path: Path, ahead: float) -> None:
    read = read_friction_recording(two_clocks(tmp_path / 'bag', ahead))
    # 2e-3: the 5 % quantiles of 500 latencies vary by 5e-5 s, and a clock of 1e6 s is exact
    # to the nanosecond; the rest is margin for other random numbers.
    assert_allclose(read.clock_offset, ahead, rtol=0.0, atol=2e-3)
    assert_allclose(read.depth, 1e-3 * read.force, atol=2e-3 * 0.25)
    assert f'/ft is stamped {read.clock_offset:.3f} s after /joints: clocks' in read.losses[0]
    by_reception = read_friction_recording(tmp_path / 'bag', time='receive')
    assert by_reception.clock_offset == 0.0
    assert not any('clocks' in loss for loss in by_reception.losses)


@pytest.mark.parametrize(('latency', 'said'), [((0.002, 0.002), 0), ((0.002, 0.2), 1)])
def test_latency_is_not_corrected_as_a_clock(
    tmp_path: Path, latency: tuple[float, ...], said: int
) -> None:
    read = read_friction_recording(two_clocks(tmp_path / 'bag', 0.0, latency))
    assert read.clock_offset == 0.0
    assert_array_equal(read.depth, 1e-3 * read.force)
    assert len([loss for loss in read.losses if 'may be latency' in loss]) == said


def test_invalid_receive_times_do_not_change_stamps(tmp_path: Path) -> None:
    wrenches, motions = grid()
    with BagWriter(tmp_path / 'bag') as writer:
        writer.add_topic('/ft', WRENCH)
        writer.add_topic('/joints', MOTION)
        for (t, force), (_, depth, velocity) in zip(wrenches[5:], motions[:-1], strict=False):
            writer.write('/ft', wrench(at(100 * t), force), 0)
            writer.write('/joints', joint_states(at(100 * t - 3000), depth, velocity), 0)
    assert read_friction_recording(tmp_path / 'bag').clock_offset == 0.0


def test_an_invalid_choice_of_stamps_is_rejected(tmp_path: Path) -> None:
    path = small_bag(tmp_path / 'bag', *grid())
    with pytest.raises(RecordingError, match="time must be one of header, receive, got 'now'"):
        read_friction_recording(path, time='now')


SECONDS = strategies.integers(-(2**31), 2**31 - 1)


@settings(max_examples=100, deadline=None)
@given(
    stamps=strategies.lists(
        strategies.tuples(SECONDS, strategies.integers(0, 2**32 - 1)), min_size=3, max_size=8
    ),
    received=strategies.lists(strategies.integers(0, 2**64 - 1), min_size=8, max_size=8),
    value=strategies.floats(),
)
def test_arbitrary_stamps_and_values_are_read_or_rejected(
    tmp_path_factory: pytest.TempPathFactory,
    stamps: list[tuple[int, int]],
    received: list[int],
    value: float,
) -> None:
    path = tmp_path_factory.mktemp('stamps') / 'bag'
    with BagWriter(path) as writer:
        writer.add_topic('/ft', WRENCH)
        writer.add_topic('/joints', MOTION)
        for (seconds, rest), now in zip(stamps, received, strict=False):
            stamp = struct.pack('<iI', seconds, rest)
            data = wrench(0, value)
            writer.write('/ft', data[:4] + stamp + data[12:], now)
            data = joint_states(0, value, value)
            writer.write('/joints', data[:4] + stamp + data[12:], now)
    for time in ('header', 'receive'):
        with suppress(RecordingError):
            assert len(read_friction_recording(path, time=time).time) <= len(stamps)


# Dense recordings.


def test_dense_samples_are_averaged_without_delay(tmp_path: Path) -> None:
    rate, frequency = 4000, 5.0
    with BagWriter(tmp_path / 'bag') as writer:
        writer.add_topic('/ft', WRENCH)
        writer.add_topic('/joints', MOTION)
        for i in range(2 * rate):
            stamp = EPOCH + i * 10**9 // rate
            wave = np.sin(2.0 * np.pi * frequency * i / rate)
            writer.write('/ft', wrench(stamp, wave), stamp)
            if i % 16 == 0:
                writer.write('/joints', joint_states(stamp, wave, 1.0), stamp)
    read = read_friction_recording(tmp_path / 'bag')
    assert abs(len(read.time) - 800) <= 2
    begin = read.force[0] / (2.0 * np.pi * frequency)
    # The mean over a bin of width h has an error of (2 pi f h)^2 / 24 = 3e-4.
    wave = np.sin(2.0 * np.pi * frequency * (read.time + begin))
    assert_allclose(read.force, wave, rtol=0.0, atol=4e-4)


def two_runs(path: Path, second: int) -> Path:
    """Write two runs of 400 messages each, stamped from 0 and from a time [ms]."""
    stamps = [*range(0, 4000, 10), *range(second, second + 4000, 10)]
    messages = [
        (i * 10, wrench(at(stamp), float(i)), joint_states(at(stamp), 1e-3 * i, 0.1))
        for i, stamp in enumerate(stamps)
    ]
    return write(
        path,
        {
            '/ft': (WRENCH, [(t, data) for t, data, _ in messages]),
            '/joints': (MOTION, [(t, data) for t, _, data in messages]),
        },
    )


@pytest.mark.parametrize('second', [0, 3, 300])
def test_stamps_that_restart_are_named(
    tmp_path: Path, second: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The runs are not mixed, nor is one left out; the receive times have both in order."""
    path = two_runs(tmp_path / 'bag', second)
    said = '/ft time restarts at message 401 of 800: use --time receive, or split'
    with pytest.raises(RecordingError, match=said):
        read_friction_recording(path)
    with monkeypatch.context() as patch:
        # Of a long recording fewer stamps are kept.
        patch.setattr(samples, 'MOST_SAMPLES', 500)
        with pytest.raises(RecordingError, match=said):
            read_friction_recording(path)
    assert any('time restarts' in loss for loss in inspect_recording(path).losses)
    assert_array_equal(read_friction_recording(path, time='receive').force, np.arange(800.0))


@pytest.mark.parametrize('back', [205, 1505])
def test_a_clock_that_was_set_back_is_named(tmp_path: Path, back: int) -> None:
    """In the middle of a recording, by a number of ms; the receive times are in order."""
    path = two_runs(tmp_path / 'bag', 4000 - back)
    losses = '; '.join(read_friction_recording(path).losses)
    for topic in ('/ft', '/joints'):
        assert f'the clock of {topic} was set back by {1e-3 * (back - 10):.3g} s' in losses
    assert 'time receive would correct it' in losses
    received = read_friction_recording(path, time='receive')
    assert not any('set back' in loss for loss in received.losses)
    assert_array_equal(received.force, np.arange(800.0))


@given(
    begin=strategies.integers(0, 300),
    late=strategies.integers(11, 100),
    after=strategies.integers(1, 100),
)
def test_messages_that_come_late_are_no_restart(begin: int, late: int, after: int) -> None:
    """Also near the start: no other messages have their times."""
    order = np.arange(1000)
    parts = np.split(order, np.cumsum([begin, late, after]))
    assert restart_of(np.concatenate([parts[0], parts[2], parts[1], parts[3]])) == 0
    assert restart_of(np.concatenate([order, order + begin * 0.1])) == len(order)


@pytest.mark.parametrize('factor', [1.0, 1e3])
def test_presses_in_mm_are_suspected(tmp_path: Path, factor: float) -> None:
    """Also of stiff tissue, by the positions under force and not on the way there."""
    way = [(i, (-0.5 + 0.05 * i, 0.0, 0.0), 0.0) for i in range(10)]
    presses = [
        (10 + 10 * i + k, (2e-4 * size * (k > 4), 0.0, 1e-4 * size * (k > 4)), size * (k > 4))
        for i, size in enumerate([1.0, -1.0, 1.5])
        for k in range(10)
    ]
    vector = message_type('geometry_msgs/msg/Vector3')
    forces, poses = [], []
    for i, place, size in (*way, *presses):
        stamp = at(10 * i)
        one = message_type('geometry_msgs/msg/Wrench')(vector(size, 0.0, size), vector(0, 0, 0))
        forces.append((10 * i, serialized(WRENCH, stamp, one)))
        scaled = tuple(factor * x for x in place)
        poses.append((10 * i, serialized(POSE, stamp, pose(scaled))))
    path = write(tmp_path / 'bag', {'/ft': (WRENCH, forces), '/ee': (POSE, poses)})
    losses = ' '.join(read_indentation_recording(path).losses)
    assert ('perhaps --axes x[mm]' in losses) == (factor > 1.0)


# Indentation.


def pressed(path: Path, type_name: str) -> Path:
    """Write an indentation along x, z and slightly y; force 100 and 200 N/m."""
    messages = []
    for i in range(11):
        place = (1e-3 * i, 1e-5 * i, 2e-3 * i)
        if type_name == MOTION:
            data = joints(at(10 * i), ('x', 'y', 'z'), place, ())
        elif type_name == ODOMETRY:
            data = odometry(at(10 * i), place, (0.0, 0.0, 0.0))
        elif type_name == POSE:
            data = serialized(POSE, at(10 * i), pose(place))
        else:
            data = serialized(POINT, at(10 * i), message_type('geometry_msgs/msg/Point')(*place))
        messages.append((10 * i, data))
    vector = message_type('geometry_msgs/msg/Vector3')
    zero = vector(0.0, 0.0, 0.0)
    wrenches = [
        (10 * i, serialized(WRENCH, at(10 * i), message_type('geometry_msgs/msg/Wrench')(
            vector(0.1 * i, 0.0, 0.4 * i), zero
        )))
        for i in range(11)
    ]  # fmt: skip
    return write(path, {'/base_wrench': (WRENCH, wrenches), '/robot': (type_name, messages)})


@pytest.mark.parametrize('type_name', [POSE, POINT, ODOMETRY, MOTION])
def test_an_indentation_is_read_from_all_message_types(tmp_path: Path, type_name: str) -> None:
    path = pressed(tmp_path / 'bag', type_name)
    read = read_indentation_recording(path)
    i = np.arange(11)
    assert_allclose(read.position, np.column_stack([1e-3 * i, 2e-3 * i]), rtol=1e-12)
    assert_allclose(read.off_plane, 1e-5 * i, rtol=1e-12)
    assert_allclose(read.force, np.column_stack([0.1 * i, 0.4 * i]), rtol=1e-12)
    assert read.losses == ()
    turned = read_indentation_recording(path, axes=('-z', 'x'))
    assert_array_equal(turned.position, read.position[:, ::-1] * [-1.0, 1.0])
    assert_array_equal(turned.force, read.force[:, ::-1] * [-1.0, 1.0])
    reversed_force = read_indentation_recording(path, force_axes=('-x', 'z[mN]'))
    assert_array_equal(reversed_force.position, read.position)
    assert_allclose(reversed_force.force, read.force * [-1.0, 1e-3], rtol=1e-12)
    other = read_indentation_recording(path, axes=('x', 'z[mm]'), force_axes=('x', 'y'))
    assert_allclose(other.position, read.position * [1.0, 1e-3], rtol=1e-12)
    assert_array_equal(other.force[:, 1], 0.0)


def test_the_joint_out_of_the_plane_may_be_missing(tmp_path: Path) -> None:
    messages = [
        (10 * i, joints(at(10 * i), ('z', 'x'), (0.01 * i, -0.01 * i), ())) for i in range(11)
    ]
    path = write(tmp_path / 'bag', {'/ft': forces(), '/joint_states': (MOTION, messages)})
    read = read_indentation_recording(path)
    assert_array_equal(read.off_plane, 0.0)
    assert_allclose(read.position[:, 1], 0.01 * np.arange(11), rtol=1e-12)
    assert read.losses == (
        '/joint_states has no joint out of the plane: off-plane motion unknown',
    )
    with pytest.raises(RecordingError, match='must have the joints y and z, has x, z'):
        read_indentation_recording(path, axes=('y', 'z'))


@given(
    strategies.sampled_from(
        [(-1e-3, 0.0), (-2e-4, 0.0), (0.0, 0.0), (2e-5, 0.0), (2e-4, 0.0), (1e-3, 0.0), (0.0, 0.5)]
    ),
    strategies.integers(0, 99),
)
def test_a_drift_of_clocks_is_reported(rates: tuple[float, float], seed: int) -> None:
    """Beside latencies of 0.1 ms; a drift of both stamps, as of simulated time, is none."""
    (rate, common), rng = rates, np.random.default_rng(seed)
    time = np.arange(0.0, 50.0, 0.01)
    force, motion = (
        Samples(
            name,
            (1e9 * time).astype(np.int64),
            np.zeros((len(time), 1)),
            (1e9 * (rng.exponential(1e-4, len(time)) - own * time)).astype(np.int64),
        )
        for name, own in (('/force', rate + common), ('/motion', common))
    )
    offset, loss = clock_offset(force, motion)
    assert offset == 0
    if abs(rate) * 50.0 < 2e-3:
        assert loss == ''
    else:
        # From the first to the last fifth, within a fifth; 0.1 ms is the error of the latencies.
        gained = float(re.findall(r'gains (\S+) ms', loss)[0])
        assert gained == pytest.approx(4e4 * rate, abs=0.1 + 1e4 * abs(rate))
        assert loss.endswith('time receive would correct it')


@pytest.mark.parametrize('axes', [('x', 'x'), ('x', '-x'), ('x', 'w')])
def test_an_invalid_plane_is_rejected(tmp_path: Path, axes: tuple[str, str]) -> None:
    with pytest.raises(ParameterError, match=r'axes must be two different|each of axes must'):
        read_indentation_recording(tmp_path, axes=axes)
