# SPDX-License-Identifier: Apache-2.0
"""Recordings of other laboratories give correct results and warnings, or a one-line error."""

from collections.abc import Callable
from functools import lru_cache
import json
from pathlib import Path
import re
import shutil
import sqlite3
import struct
from typing import Any

from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from needle_dynamics import FloatArray
from needle_identification import BagWriter, RecordingError
from needle_identification.bags.bag import Bag
from needle_insertion.cli import main
import numpy as np
from numpy.typing import NDArray
import pytest
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from support.presses import presses, STIFFNESS
from support.samples import EPOCH, header, STORE, TEXT, text, WRENCH, wrench
from support.strokes import COULOMB, strokes, VISCOUS

JOINTS = 'sensor_msgs/msg/JointState'
POSE = 'geometry_msgs/msg/PoseStamped'
POINT = 'geometry_msgs/msg/PointStamped'
TWIST = 'geometry_msgs/msg/TwistStamped'
ODOMETRY = 'nav_msgs/msg/Odometry'
FORCE, MOTION = '/ft_sensor/raw', '/lab/robot'
SECOND = 1_000_000_000
#: Latency of the first message and its increase per message [ns].
LATENCY, JITTER = 2_000_000, 300_000


@lru_cache(maxsize=1)
def samples() -> tuple[NDArray[np.int64], FloatArray, FloatArray, FloatArray]:
    """Return stamps [ns], depth, velocity and force of strokes, at 125 Hz."""
    made = strokes(seed=7, speeds=(2e-3, 10e-3, 20e-3), push=0.0)
    stamps = EPOCH + np.rint(made.time * 1e9).astype(np.int64)
    return stamps[::2], made.depth[::2], made.velocity[::2], made.force[::2]


def serialized(type_name: str, stamp: int, *parts: Any) -> bytes:
    return bytes(STORE.serialize_cdr(STORE.types[type_name](header(stamp), *parts), type_name))


def triple(kind: str, **given: float) -> Any | Any:
    return STORE.types[f'geometry_msgs/msg/{kind}'](*(given.get(axis, 0.0) for axis in 'xyz'))


def joints(
    stamp: int, position: float | None, velocity: float | None, names: tuple[str, ...] = ('slide',)
) -> bytes:
    """Serialize a JointState of joints with equal values; None leaves an array empty."""
    arrays = [
        np.array([] if value is None else [value] * len(names))
        for value in (position, velocity, None)
    ]
    return serialized(JOINTS, stamp, list(names), *arrays)


def motion(type_name: str, stamp: int, velocity: float, **place: float) -> bytes:
    """Serialize a motion in any type; the velocity is along the axes of the frame."""
    kinds = STORE.types
    where = triple('Point', **place)
    velocity = triple('Vector3', **dict.fromkeys(place, velocity))
    pose = kinds['geometry_msgs/msg/Pose'](
        where, kinds['geometry_msgs/msg/Quaternion'](0, 0, 0, 1)
    )
    twist = kinds['geometry_msgs/msg/Twist'](velocity, triple('Vector3'))
    zero = np.zeros(36)
    parts = {
        POSE: (pose,),
        POINT: (where,),
        TWIST: (twist,),
        ODOMETRY: (
            'tool',
            kinds['geometry_msgs/msg/PoseWithCovariance'](pose, zero),
            kinds['geometry_msgs/msg/TwistWithCovariance'](twist, zero),
        ),
    }
    return serialized(type_name, stamp, *parts[type_name])


def recorded(
    type_name: str = JOINTS,
    make: Callable[..., Any] = joints,
    ahead: float = 0.0,
    sign: float = 1.0,
    topics: tuple[str, ...] = (FORCE, MOTION),
) -> list[tuple[str, str, int, bytes]]:
    """
    Return messages in the order of reception: topic, type, receive time [ns], bytes.

    `ahead` is the offset of the clock of the force [s]; with a sign of -1 the force points out of
    the tissue.
    """
    rng = np.random.default_rng(0)
    rows = []
    for stamp, depth, velocity, force in zip(
        *(column.tolist() for column in samples()), strict=True
    ):
        stamped = stamp + round(ahead * SECOND)
        rows.append((topics[0], WRENCH, stamp, wrench(stamped, sign * force)))
        rows.append((topics[1], type_name, stamp, make(stamp, depth, velocity)))
    late = LATENCY + rng.integers(0, JITTER, len(rows))
    return sorted(
        ((topic, kind, stamp + int(delay), data)
         for (topic, kind, stamp, data), delay in zip(rows, late, strict=True)),
        key=lambda row: row[2],
    )  # fmt: skip


def write_folder(
    path: Path,
    rows: list[tuple[str, str, int, bytes]],
    plugin: str = 'mcap',
    mode: CompressionMode | None = None,
) -> Path:
    """Write a rosbag2 folder with rosbags; return its data file."""
    writer = Writer(path, version=9, storage_plugin=StoragePlugin[plugin.upper()])
    if mode is not None:
        writer.set_compression(mode, CompressionFormat.ZSTD)
    known = {}
    with writer:
        for topic, kind, received, data in rows:
            if topic not in known:
                known[topic] = writer.add_connection(topic, kind, typestore=STORE)
            writer.write(known[topic], received, data)
    (file,) = (file for file in path.iterdir() if file.name != 'metadata.yaml')
    return file


def write_mcap(path: Path, rows: list[tuple[str, str, int, bytes]], **options: Any) -> Path:
    """Write an MCAP file; types that are not in ROS have no definition."""
    with path.open('wb') as stream:
        writer = McapWriter(stream, **options)
        writer.start('ros2')
        known = {}
        for topic, kind, received, data in rows:
            if topic not in known:
                text = b''
                if kind in STORE.fielddefs:
                    text = STORE.generate_msgdef(kind, ros_version=2)[0].encode()
                schema = writer.register_schema(kind, 'ros2msg' if text else '', text)
                known[topic] = writer.register_channel(topic, 'cdr', schema)
            writer.add_message(known[topic], received, data, received)
        writer.finish()
    return path


@pytest.fixture
def identified(capsys: pytest.CaptureFixture[str]) -> Callable[..., Any]:
    """Return a function that runs the command, checks the result, and returns the warnings."""

    def run(path: Path, *words: str) -> str:
        assert main(['identify', 'friction', str(path), '--json', *words]) == 0
        said = capsys.readouterr()
        found = json.loads(said.out)['statistics']
        for name, truth in (('coulomb_friction', COULOMB), ('viscous_friction', VISCOUS)):
            low, high = found[name]['interval']
            assert low <= truth <= high
            # 2 %: a small multiple of the error of 1 s of motion.
            assert high - low < 0.04 * truth
        return said.err

    return run


@pytest.fixture
def refused(capsys: pytest.CaptureFixture[str]) -> Callable[..., Any]:
    """Return a function that runs the command, expects a one-line error, and returns it."""

    def run(path: Path, *words: str, what: str = 'friction') -> str:
        assert main(['identify', what, str(path), *words]) == 2
        said = capsys.readouterr()
        assert said.out == ''
        assert said.err.startswith('error: ')
        assert said.err.count('\n') == 1
        return said.err

    return run


# Containers.


@pytest.mark.parametrize('plugin', ['mcap', 'sqlite3'])
@pytest.mark.parametrize('mode', [None, CompressionMode.FILE, CompressionMode.MESSAGE])
def test_containers_are_read_complete_without_metadata_and_truncated(
    tmp_path: Path, identified: Callable[..., Any], plugin: str, mode: CompressionMode | None
) -> None:
    file = write_folder(tmp_path / 'bag', recorded(), plugin, mode)
    assert identified(tmp_path / 'bag') == ''
    bare = tmp_path / file.name
    shutil.copy(file, bare)
    assert identified(bare) == ''
    (tmp_path / 'bag' / 'metadata.yaml').unlink()
    assert 'no readable metadata.yaml' in identified(tmp_path / 'bag')
    bare.write_bytes(file.read_bytes()[: int(0.85 * file.stat().st_size)])
    said = identified(bare)
    assert re.search(f'{bare.name} (is cut off|is damaged: .*); [0-9]+ messages read', said)


@pytest.mark.parametrize('plugin', ['mcap', 'sqlite3'])
@pytest.mark.parametrize('share', [0.0, 0.002, 0.03])
def test_a_file_truncated_before_any_message_is_rejected(
    tmp_path: Path, refused: Callable[..., Any], plugin: str, share: float
) -> None:
    file = write_folder(tmp_path / 'bag', recorded(), plugin)
    file.write_bytes(file.read_bytes()[: int(share * file.stat().st_size)])
    assert str(tmp_path / 'bag') in refused(tmp_path / 'bag')


@pytest.mark.parametrize(
    'options',
    [
        {'compression': CompressionType.LZ4},
        {'compression': CompressionType.NONE, 'chunk_size': 4096},
        {'use_chunking': False},
    ],
)
def test_single_mcap_files_of_other_writers_are_read(
    tmp_path: Path, identified: Callable[..., Any], options: dict[str, Any]
) -> None:
    assert identified(write_mcap(tmp_path / 'run.mcap', recorded(), **options)) == ''


def test_a_missing_part_of_a_split_recording_is_reported(
    tmp_path: Path, identified: Callable[..., Any]
) -> None:
    rows, folder = recorded(), tmp_path / 'split'
    folder.mkdir()
    for k in range(12):
        write_mcap(
            folder / f'split_{k}.mcap', rows[k * len(rows) // 12 : (k + 1) * len(rows) // 12]
        )
    names = ''.join(f'  - split_{k}.mcap\n' for k in range(12))
    information = f'rosbag2_bagfile_information:\n  relative_file_paths:\n{names}'
    (folder / 'metadata.yaml').write_text(information)
    assert identified(folder) == ''
    (folder / 'split_4.mcap').unlink()
    said = identified(folder)
    assert 'split_4.mcap is missing' in said
    assert f'pauses of {FORCE} in 1 place' in said


# Messages.


def without_velocity(stamp: int, depth: float, _velocity: float) -> bytes:
    return joints(stamp, depth, None)


def at_velocity_zero(stamp: int, depth: float, _velocity: float) -> bytes:
    return joints(stamp, depth, 0.0)


def at_velocity_nan(stamp: int, depth: float, _velocity: float) -> bytes:
    return joints(stamp, depth, np.nan)


def without_position(stamp: int, _depth: float, velocity: float) -> bytes:
    return joints(stamp, None, velocity)


def at_position_zero(stamp: int, _depth: float, velocity: float) -> bytes:
    return joints(stamp, 0.0, velocity)


@pytest.mark.parametrize(
    ('make', 'said'),
    [
        (without_velocity, 'has no velocity'),
        (at_velocity_zero, 'moves with the velocity 0'),
        (at_velocity_nan, 'has no velocity'),
        (without_position, 'has no position'),
        (at_position_zero, 'has no position'),
    ],
)
def test_joint_states_with_missing_fields_are_used(
    tmp_path: Path, identified: Callable[..., Any], make: Callable[..., Any], said: str
) -> None:
    assert f'{MOTION} {said}' in identified(write_mcap(tmp_path / 'run.mcap', recorded(make=make)))


@pytest.mark.parametrize(
    ('names', 'said'),
    [
        (('slide',), 'neither position nor velocity of slide'),
        ((), 'has joints without names'),
        (
            ('roll', 'slide'),
            "no joint 'insertion'; motion_axis (--motion-axis) must name one of roll, slide",
        ),
    ],
)
def test_joint_states_without_position_and_velocity_are_rejected(
    tmp_path: Path, refused: Callable[..., Any], names: tuple[str, ...], said: str
) -> None:
    rows = recorded(make=lambda stamp, *_: joints(stamp, None, None, names))
    assert said in refused(write_mcap(tmp_path / 'run.mcap', rows))


def test_a_reversed_joint_is_selected_by_name_and_sign(
    tmp_path: Path, identified: Callable[..., Any]
) -> None:
    rows = recorded(make=lambda t, d, v: joints(t, -d, -v, ('rail', 'slide')), sign=-1.0)
    path = write_mcap(tmp_path / 'run.mcap', rows)
    assert identified(path, '--motion-axis', '-slide', '--force-axis', '-y') == ''


@pytest.mark.parametrize(
    ('type_name', 'said'),
    [
        (POSE, 'has no velocity'),
        (POINT, 'has no velocity'),
        (TWIST, 'has no position'),
        (ODOMETRY, ''),
    ],
)
@pytest.mark.parametrize(('axis', 'sign'), [('y', 1.0), ('-z', -1.0)])
def test_all_motion_types_are_read_along_any_axis(
    tmp_path: Path,
    identified: Callable[..., Any],
    type_name: str,
    said: str,
    axis: str,
    sign: float,
) -> None:
    def make(stamp: int, depth: float, velocity: float) -> bytes:
        return motion(type_name, stamp, sign * velocity, **{axis[-1]: sign * depth})

    path = write_mcap(tmp_path / 'run.mcap', recorded(type_name, make))
    assert said in identified(path, '--motion-axis', axis)


def test_several_topics_of_one_type_are_listed(
    tmp_path: Path, identified: Callable[..., Any], refused: Callable[..., Any]
) -> None:
    rows = [*recorded(topics=('/l/ft', '/l/arm')), *recorded(topics=('/r/ft', '/r/arm'))]
    path = write_mcap(tmp_path / 'run.mcap', sorted(rows, key=lambda row: row[2]))
    assert 'wrench_topic (--wrench-topic) must name one of /l/ft, /r/ft' in refused(path)
    one = ('--wrench-topic', '/l/ft')
    assert 'motion_topic (--motion-topic) must name one of /l/arm, /r/arm' in refused(path, *one)
    assert identified(path, *one, '--motion-topic', '/l/arm') == ''


def test_other_topics_are_ignored(tmp_path: Path, identified: Callable[..., Any]) -> None:
    rows = recorded()
    for k, (_, _, received, _) in enumerate(rows[::20]):
        rows += [
            ('/tare/_service_event', 'std_srvs/srv/Trigger_Event', received, b'\0\1\0\0\5'),
            ('/odd', 'lab_msgs/msg/Odd', received, b'?' * (k % 7)),
            ('/note', TEXT, received, text('note')),
        ]
    path = write_mcap(tmp_path / 'run.mcap', sorted(rows, key=lambda row: row[2]))
    assert identified(path) == ''
    file = write_folder(tmp_path / 'bag', recorded(), 'sqlite3')
    with sqlite3.connect(file) as database:
        database.execute(
            "INSERT INTO topics SELECT 9, '/tare/_service_event', 'std_srvs/srv/Trigger_Event', "
            "'cdr', offered_qos_profiles, type_description_hash FROM topics LIMIT 1"
        )
        database.execute("INSERT INTO messages SELECT NULL, 9, timestamp, 'x' FROM messages")
    assert identified(tmp_path / 'bag') == ''


# Times and faults.


@pytest.mark.parametrize('ahead', [5.0, -5.0, 3 * 3600.0])
def test_different_clocks_are_corrected(
    tmp_path: Path, identified: Callable[..., Any], ahead: float
) -> None:
    path = write_mcap(tmp_path / 'run.mcap', recorded(ahead=ahead))
    assert f'is stamped {ahead:.3f} s after {MOTION}: clocks differ, corrected' in identified(path)


def test_a_latency_of_a_tenth_of_a_second_is_reported(
    tmp_path: Path, identified: Callable[..., Any], capsys: pytest.CaptureFixture[str]
) -> None:
    path = write_mcap(tmp_path / 'run.mcap', recorded(ahead=0.1))
    assert 'may be latency' not in identified(path, '--time', 'receive')
    assert main(['identify', 'friction', str(path)]) == 0
    assert (
        'may be latency, not corrected; time receive would correct it' in capsys.readouterr().err
    )


def damaged(kind: str) -> tuple[list[tuple[str, str, int, bytes]], str]:
    """Return the messages of a recording with a fault, and the expected warning."""
    rows = recorded()
    rng = np.random.default_rng(1)
    if kind == 'gap':
        gone = EPOCH + 2 * SECOND, EPOCH + 5 * SECOND // 2
        return [
            row for row in rows if not gone[0] < row[2] < gone[1]
        ], f'pauses of {FORCE} in 1 place'
    if kind == 'lost':
        return [row for row in rows if rng.random() > 0.1], ''
    if kind == 'twice':
        return [row for row in rows for _ in range(2)], 'with the stamp of another, left out'
    if kind == 'order':
        order = np.argsort(np.arange(len(rows)) + rng.uniform(0.0, 20.0, len(rows)))
        return [rows[k] for k in order], f'of {FORCE} out of order, sorted by stamp'
    if kind == 'short':
        cut = [(*row[:3], row[3][: -7 if k % 50 == 3 else None]) for k, row in enumerate(rows)]
        return cut, 'not readable, left out'
    put = struct.pack('<d', float(kind))
    broken = [
        (*row[:3], row[3][:-40] + put + row[3][-32:]) if row[0] == FORCE and k % 40 < 2 else row
        for k, row in enumerate(rows)
    ]
    return broken, f'of {FORCE} not finite, left out'


@pytest.mark.parametrize('kind', ['gap', 'lost', 'twice', 'order', 'short', 'nan', 'inf', '1e300'])
def test_faults_are_reported_and_do_not_change_the_result(
    tmp_path: Path, identified: Callable[..., Any], kind: str
) -> None:
    rows, said = damaged(kind)
    assert said in identified(write_mcap(tmp_path / 'run.mcap', rows))


# Unusable recordings.


@pytest.mark.parametrize(
    ('kept', 'said'),
    [
        ([FORCE], 'has no topic of type JointState'),
        ([MOTION], 'has no topic of type WrenchStamped; it has /lab/robot'),
        ([], 'holds no messages'),
    ],
)
def test_missing_topics_are_reported(
    tmp_path: Path, refused: Callable[..., Any], kept: list[str], said: str
) -> None:
    rows = [row for row in recorded() if row[0] in kept]
    assert said in refused(write_mcap(tmp_path / 'run.mcap', rows))


def test_the_error_for_other_files_gives_instructions(
    tmp_path: Path, refused: Callable[..., Any]
) -> None:
    old = tmp_path / 'old.bag'
    old.write_bytes(b'#ROSBAG V2.0\n')
    assert '(try rosbag reindex old.bag)' in refused(old)
    old.write_bytes(b'what is this?')
    said = refused(old)
    assert 'old.bag is damaged' in said
    assert 'reindex' not in said
    folder = tmp_path / 'runs'
    file = write_folder(folder / 'one', recorded()[:10])
    with pytest.raises(RecordingError, match=f'name those inside, such as {folder / "one"}'):
        Bag(folder)
    for name in ('monday.mcap', 'tuesday.mcap'):
        shutil.copy(file, folder / name)
    with pytest.raises(RecordingError, match=f'several .* such as {folder / "monday.mcap"}$'):
        Bag(folder)


# Stiffness.


@pytest.mark.parametrize('type_name', [POSE, POINT, ODOMETRY, JOINTS])
def test_stiffness_is_identified_from_all_motion_types(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], type_name: str
) -> None:
    rows = []
    for time, (x, z), (f_x, f_z) in zip(*presses(1), strict=True):
        stamp = EPOCH + round(time * 1e9)
        pair = STORE.types['geometry_msgs/msg/Wrench'](
            triple('Vector3', x=f_x, z=f_z), triple('Vector3')
        )
        if type_name == JOINTS:
            data = serialized(JOINTS, stamp, ['x', 'z'], np.array([x, z]), *[np.array([])] * 2)
        else:
            data = motion(type_name, stamp, 0.0, x=x, z=z)
        rows += [(FORCE, WRENCH, stamp, serialized(WRENCH, stamp, pair)),
                 (MOTION, type_name, stamp, data)]  # fmt: skip
    file = write_folder(tmp_path / 'bag', rows, 'sqlite3')
    assert main(['identify', 'stiffness', str(file), '--json']) == 0
    for level, truth in zip(
        json.loads(capsys.readouterr().out)['levels'], STIFFNESS.values(), strict=True
    ):
        told = [level['statistics'][name]['mean'] for name in ('k_xx', 'k_xz', 'k_zx', 'k_zz')]
        # Noise of 1 um and 2 mN over 30 samples and 8 presses: at most some N/m.
        assert told == pytest.approx(truth.ravel(), abs=5.0)


def test_control_characters_in_names_are_escaped(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Control characters in names of folders, topics and joints are not printed."""
    evil = '\x1b[31m\x9b2J\u202eevil\u2066\x07\r\n'
    bag, wrenches, motion = tmp_path / f'bag{evil}', f'/w{evil}', f'/j{evil}'
    names = (f'slide{evil}', f'other{evil}')
    stamps, depth, velocity, force = samples()
    with BagWriter(bag) as writer:
        writer.add_topic(wrenches, WRENCH)
        writer.add_topic(motion, JOINTS)
        for at, d, v, f in zip(stamps.tolist(), depth, velocity, force, strict=True):
            writer.write(wrenches, wrench(at, f), at)
            writer.write(motion, joints(at, d, v, names), at)
    # With two joints, their names are listed.
    assert main(['identify', 'friction', str(bag)]) == 2
    result = tmp_path / 'result.yaml'
    arguments = ['--motion-axis', names[0], '--output', str(result)]
    assert main(['identify', 'friction', str(bag), *arguments]) == 0
    assert main(['verify', str(bag)]) == 2
    captured = capsys.readouterr()
    for text_ in (captured.out, captured.err, result.read_text(encoding='utf-8')):
        assert 'evil' in text_
        for line in text_.splitlines():
            assert line.isprintable(), ascii(line)
