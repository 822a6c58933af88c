# SPDX-License-Identifier: Apache-2.0
"""
Time and memory from a bag to a result, compared with other bag readers.

Friction is identified from a bag. Other Python libraries read the same bag into message objects
and extract the same numbers. Bags of ten and thirty times the length show the growth of memory.
Each measurement has its own process, and therefore its own peak memory.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial
import json
from pathlib import Path
import struct
import subprocess
import sys
from tempfile import TemporaryDirectory
import time
from typing import Any, Final

from benchmarks.measure import Bar, NOT_INSTALLED, number, optional, peak_memory
from benchmarks.page import Answer, PageSection, Tick
from needle_identification import (
    BagWriter,
    FrictionEstimate,
    identify_friction,
    read_friction_recording,
)
from needle_identification.bags.messages import encode, message_type
from needle_identification.recordings.samples import MOST_SAMPLES
import numpy as np
from rosbags.highlevel import AnyReader
from rosbags.typesys import get_typestore, Stores

#: Messages per topic in the shortest bag, and relative lengths of the other bags.
MESSAGES: Final = 2**17
LONGER: Final = (1, 10, 30)

#: Messages per second of each topic [Hz], and time of one stroke [s].
_RATE: Final = 250.0
_STROKE: Final = 4.0

#: Repeats with the shortest bag; the least time is used.
_REPEATS: Final = 3

#: Timeout of one reading [s].
_PATIENCE: Final = 600.0

_WRENCH: Final = 'geometry_msgs/msg/WrenchStamped'
_MOTION: Final = 'sensor_msgs/msg/JointState'
_TOPICS: Final = {'/base_wrench': _WRENCH, '/joint_states': _MOTION}

#: Placeholder number in a message.
_MARK: Final = struct.unpack('<d', b'needle!!')[0]

_START: Final = 1_700_000_000


def write_bag(path: Path, messages: int) -> None:
    """Write a bag with force and motion of strokes in both directions at five speeds."""
    header = message_type('std_msgs/msg/Header')(
        message_type('builtin_interfaces/msg/Time')(_START, 0), 'needle_base'
    )
    vector = message_type('geometry_msgs/msg/Vector3')
    wrench = message_type('geometry_msgs/msg/Wrench')(
        vector(0.0, _MARK, 0.0), vector(0.0, 0.0, 0.0)
    )
    joints = message_type(_MOTION)(
        header, ['insertion', 'rotation'], np.array([_MARK, 0.0]), np.array([_MARK, 0.0]),
        np.array([0.0, 0.0]),
    )  # fmt: skip
    rng = np.random.default_rng(1)
    with BagWriter(path) as bag:
        for topic, type_name in _TOPICS.items():
            bag.add_topic(topic, type_name)
        for first in range(0, messages, 2**16):
            count = np.arange(first, min(first + 2**16, messages))
            depth, speed, force = _strokes(count / _RATE)
            force += 0.01 * rng.standard_normal(len(force))
            stamps = np.rint(count / _RATE * 1e9).astype(np.int64)
            wrenches = _patched(encode(message_type(_WRENCH)(header, wrench)), stamps, [force])
            motions = _patched(encode(joints), stamps, [depth, speed])
            for stamp, one, other in zip(stamps.tolist(), wrenches, motions, strict=True):
                received = _START * 10**9 + stamp + 100_000
                bag.write('/base_wrench', one, received)
                bag.write('/joint_states', other, received)


def _strokes(time: np.ndarray[Any, Any]) -> tuple[np.ndarray[Any, Any], ...]:
    """Return depth [m], speed [m/s] and force [N] of strokes with sinusoidal speed."""
    number, phase = np.divmod(time, _STROKE)
    most = 0.004 * (1.0 + number % 5) * np.where(number // 5 % 2, -1.0, 1.0)
    turn = 2.0 * np.pi / _STROKE
    speed = most * np.sin(turn * phase)
    depth = 0.1 + most / turn * (1.0 - np.cos(turn * phase))
    return depth, speed, 0.56 * np.sign(speed) + 300.0 * speed


def _patched(
    message: bytes, stamps: np.ndarray[Any, Any], values: list[np.ndarray[Any, Any]]
) -> Iterator[bytes]:
    """Yield copies of a message with new stamps, and with values in place of the mark."""
    size = len(message)
    copies = np.tile(np.frombuffer(message, dtype=np.uint8), (len(stamps), 1))
    # The time stamp follows the four bytes of the encoding.
    time = np.column_stack([_START + stamps // 10**9, stamps % 10**9]).astype('<i4')
    copies[:, 4:12] = time.view(np.uint8)
    at = -1
    for column in values:
        at = message.index(struct.pack('<d', _MARK), at + 1)
        copies[:, at : at + 8] = column.astype('<f8')[:, np.newaxis].view(np.uint8)
    data = copies.tobytes()
    return (data[k : k + size] for k in range(0, len(data), size))


def ours(path: Path) -> FrictionEstimate:
    """Read a bag and identify friction."""
    return identify_friction(read_friction_recording(path))


def any_reader(path: Path) -> None:
    """Read the same numbers with rosbags."""
    rows: dict[str, list[tuple[float, ...]]] = {topic: [] for topic in _TOPICS}
    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
        wanted = [connection for connection in reader.connections if connection.topic in rows]
        for connection, _, data in reader.messages(connections=wanted):
            message = reader.deserialize(data, connection.msgtype)
            rows[connection.topic].append(_numbers(message))
    _arrays(rows)


def mcap_ros2(path: Path) -> None:
    """Read the same numbers with mcap-ros2-support."""
    reader = optional('mcap_ros2.reader')
    rows: dict[str, list[tuple[float, ...]]] = {topic: [] for topic in _TOPICS}
    [file] = path.glob('*.mcap')
    for found in reader.read_ros2_messages(str(file), topics=list(rows)):  # type: ignore[union-attr]
        rows[found.channel.topic].append(_numbers(found.ros_msg))
    _arrays(rows)


def _numbers(message: Any) -> tuple[float, ...]:
    stamp = message.header.stamp
    time = stamp.sec * 10**9 + stamp.nanosec
    if hasattr(message, 'wrench'):
        return time, message.wrench.force.y
    return time, message.position[0], message.velocity[0]


def _arrays(rows: Mapping[str, list[tuple[float, ...]]]) -> list[np.ndarray[Any, Any]]:
    return [np.array(values) for values in rows.values()]


#: Names of the complete task, and of its first part.
OURS: Final = 'needle_identification'
OUR_READING: Final = 'needle_identification, reading'

#: Functions that read a bag, by name.
READERS: Final[Mapping[str, Callable[[Path], object]]] = {
    OURS: ours,
    OUR_READING: read_friction_recording,
    'rosbags AnyReader': any_reader,
    'mcap-ros2-support': mcap_ros2,
}


def measure(reader: str, warm: Path, path: Path) -> dict[str, float]:
    """
    Read a bag in this process, after a short bag for warm-up.

    Returns the time ``seconds`` [s], the peak ``memory`` [bytes], and the memory ``before``
    reading [bytes].
    """
    read = READERS[reader]
    read(warm)
    before = peak_memory()
    begin = time.perf_counter()
    read(path)
    spent = time.perf_counter() - begin
    return {'seconds': spent, 'memory': peak_memory(), 'before': before}


def measured(reader: str, warm: Path, path: Path) -> dict[str, float]:
    """Call `measure` in another process."""
    done = subprocess.run(
        [sys.executable, '-m', __name__, reader, str(warm), str(path)],
        capture_output=True,
        text=True,
        check=True,
        timeout=_PATIENCE,
    )
    return dict(json.loads(done.stdout))


def compare(tick: Tick, messages: int = MESSAGES) -> Answer:
    """Measure reading and identification, compared with reading only."""
    with TemporaryDirectory() as folder:
        warm = Path(folder) / 'warm'
        write_bag(warm, min(messages, 5000))
        bags = {}
        for times in LONGER:
            tick(f'writing a bag {times} times as long')
            bags[times] = Path(folder) / f'times_{times}'
            write_bag(bags[times], times * messages)
        sizes = {
            times: sum(f.stat().st_size for f in bag.iterdir()) for times, bag in bags.items()
        }
        run = partial(measured, warm=warm)
        found = dict[str, dict[str, float]]()
        # The readers take turns.
        for k in range(_REPEATS):
            for name in READERS:
                tick(f'round {k + 1} of {_REPEATS}, {name}')
                if name != 'mcap-ros2-support' or optional('mcap_ros2.reader'):
                    one = run(name, path=bags[1])
                    found[name] = min(one, found.get(name, one), key=lambda each: each['seconds'])
        lengths = {}
        for times, bag in bags.items():
            tick(f'memory, {times} times as long')
            lengths[times] = run(OURS, path=bag)
    return _told(messages, found, lengths, sizes)


def _told(
    messages: int,
    found: Mapping[str, Mapping[str, float]],
    lengths: Mapping[int, Mapping[str, float]],
    sizes: Mapping[int, int],
) -> Answer:
    best = found[OURS]['seconds']
    speeds = []
    for name in READERS:
        what = 'bag to result' if name == OURS else 'reading alone'
        if name not in found:
            speeds.append((name, what, NOT_INSTALLED, '', ''))
            continue
        seconds, memory = found[name]['seconds'], found[name]['memory']
        speeds.append(
            (
                name,
                what,
                number(2 * messages / seconds),
                f'{number(seconds / best)} x',
                f'{memory / 1e6:.0f} MB',
            )
        )
    memories = [
        (
            f'{times} x',
            number(2 * times * messages),
            f'{sizes[times] / 1e6:.0f} MB',
            f'{one["seconds"]:.2f} s',
            number(2 * times * messages / one['seconds']),
            f'{one["memory"] / 1e6:.0f} MB',
            f'{(one["memory"] - one["before"]) / 1e6:.0f} MB',
        )
        for times, one in lengths.items()
    ]
    sections = [
        PageSection(
            'From a bag to a result',
            ('what', 'task', 'messages per second', 'time', 'peak memory'),
            speeds,
            f'A bag (MCAP, zstd) with {messages} messages each of WrenchStamped and JointState at '
            f'{_RATE:g} Hz. The readers take turns, each in a new process, and the least time of '
            f'{_REPEATS} counts.',
        ),
        PageSection(
            'Longer bags',
            ('length', 'messages', 'size', 'time', 'per second', 'peak memory', 'for the bag'),
            memories,
            'From a bag to a result with `needle_identification`, once, in one process each. '
            '"For the bag" is the peak less the peak before the bag is read. At most '
            f'{MOST_SAMPLES} samples of a topic are kept. A longer topic is averaged to fewer '
            'samples.',
        ),
    ]
    others = [one['seconds'] for name, one in found.items() if name not in (OURS, OUR_READING)]
    longer, longest = LONGER[-2:]
    growth = lengths[longest]['memory'] / lengths[longer]['memory']
    bars = [
        Bar(
            'bag to result against the faster reader', min(others) / best, 1.0, 'x', at_least=True
        ),
        Bar(f'peak memory, {longest} times the length over {longer} times', growth, 1.2, 'x'),
    ]
    return sections, bars


if __name__ == '__main__':
    name, warm, path = sys.argv[1:]
    sys.stdout.write(json.dumps(measure(name, Path(warm), Path(path))))
