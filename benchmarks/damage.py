# SPDX-License-Identifier: Apache-2.0
"""
Identification from damaged recordings.

Small recordings in all supported formats are damaged in many ways. Each must result in a one-line
error, in the result of the undamaged recording, or in a different result with a warning.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
import struct
from tempfile import TemporaryDirectory
import time
from typing import Any, Final

from benchmarks.measure import Bar, peak_memory
from benchmarks.page import Answer, PageSection, Tick
from needle_dynamics import FloatArray
from needle_identification import (
    BagWriter,
    FrictionEstimate,
    identify_friction,
    read_friction_recording,
    Recording,
)
from needle_identification.bags.messages import encode, message_type
from needle_ros.errors import NeedleError
import numpy as np
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Rosbag2Writer
from rosbags.typesys import get_typestore, Stores
from scipy.io import savemat

_WRENCH: Final = 'geometry_msgs/msg/WrenchStamped'
_JOINTS: Final = 'sensor_msgs/msg/JointState'
_START: Final = 1_700_000_000 * 10**9

#: Bounds of memory [MB] and of the time of one file [s].
MEMORY, PATIENCE = 1000.0, 20.0


def forms(folder: Path) -> dict[str, Path]:
    """Write a recording to a folder in all formats; return the files by format."""
    time_, depth, speed, force = _strokes()
    rows = list(zip(time_, depth, speed, force, strict=True))
    messages = [_messages(_START + round(1e9 * t), s, v, f) for t, s, v, f in rows]
    found = {}
    for compression in ('zstd', 'none'):
        with BagWriter(folder / compression, compression=compression) as bag:
            bag.add_topic('/base_wrench', _WRENCH)
            bag.add_topic('/joint_states', _JOINTS)
            for stamp, one, other in messages:
                bag.write('/base_wrench', one, stamp)
                bag.write('/joint_states', other, stamp)
        [found[f'mcap, {compression}']] = (folder / compression).glob('*.mcap')
    store = get_typestore(Stores.ROS2_JAZZY)
    with Rosbag2Writer(folder / 'db3', version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        force_at, motion_at = (
            writer.add_connection(name, kind, typestore=store)
            for name, kind in (('/base_wrench', _WRENCH), ('/joint_states', _JOINTS))
        )
        for stamp, one, other in messages:
            writer.write(force_at, stamp, one)
            writer.write(motion_at, stamp, other)
    [found['db3']] = (folder / 'db3').glob('*.db3')
    found['bag of ROS 1'] = _ros1(folder / 'run.bag', messages)
    table = np.column_stack([time_, depth, speed, force])
    names = ('time', 'depth', 'speed', 'force')
    found['csv'] = folder / 'run.csv'
    np.savetxt(
        found['csv'],
        table,
        fmt='%.7g',
        delimiter=',',
        header='time,depth,speed,force',
        comments='',
    )
    found['mat'] = folder / 'run.mat'
    savemat(found['mat'], dict(zip(names, table.T, strict=True)), do_compression=True)
    return found


def _messages(stamp: int, depth: float, speed: float, force: float) -> tuple[int, bytes, bytes]:
    """Return the stamp, and force and motion as messages."""
    vector = message_type('geometry_msgs/msg/Vector3')
    header = message_type('std_msgs/msg/Header')(
        message_type('builtin_interfaces/msg/Time')(*divmod(stamp, 10**9)), 'base'
    )
    wrench = message_type('geometry_msgs/msg/Wrench')(
        vector(0.0, float(force), 0.0), vector(0.0, 0.0, 0.0)
    )
    joints = message_type(_JOINTS)(
        header, ['insertion'], np.array([depth]), np.array([speed]), np.array([])
    )
    return stamp, encode(message_type(_WRENCH)(header, wrench)), encode(joints)


def _strokes() -> tuple[FloatArray, ...]:
    """Return 12 s of time, depth, speed and force."""
    rng = np.random.default_rng(1)
    time_ = np.arange(0.0, 12.0, 0.01)
    turn = 2.0 * np.pi * np.array([0.31, 0.47])[:, np.newaxis]
    speed = 8e-3 * np.sin(turn[0] * time_) + 5e-3 * np.sin(turn[1] * time_)
    depth = 0.1 + 8e-3 / turn[0] * (1.0 - np.cos(turn[0] * time_))
    depth += 5e-3 / turn[1] * (1.0 - np.cos(turn[1] * time_))
    force = 0.56 * np.sign(speed) + 300.0 * speed + 0.02 * rng.standard_normal(len(time_))
    return time_, depth, speed, force


def _ros1(path: Path, messages: list[tuple[int, bytes, bytes]]) -> Path:
    new, old = get_typestore(Stores.ROS2_JAZZY), get_typestore(Stores.ROS1_NOETIC)
    writer = Ros1Writer(path)
    with writer:
        connections = [
            writer.add_connection(name, kind, typestore=old)
            for name, kind in (('/base_wrench', _WRENCH), ('/joint_states', _JOINTS))
        ]
        for stamp, *both in messages:
            for connection, kind, data in zip(connections, (_WRENCH, _JOINTS), both, strict=True):
                message: Any = new.deserialize_cdr(data, kind)
                header = old.types['std_msgs/msg/Header'](
                    0, message.header.stamp, message.header.frame_id
                )
                rest = {
                    name: getattr(message, name)
                    for name in message.__dataclass_fields__
                    if name not in ('header', '__msgtype__')
                }
                made = old.types[kind](header=header, **rest)
                writer.write(connection, stamp, old.serialize_ros1(made, kind))
    return path


def _flip(data: bytearray, rng: np.random.Generator) -> None:
    for _ in range(int(rng.integers(1, 9))):
        data[int(rng.integers(len(data)))] ^= 1 << int(rng.integers(8))


def _cut(data: bytearray, rng: np.random.Generator) -> None:
    del data[int(rng.integers(len(data))) :]


def _lengths(data: bytearray, rng: np.random.Generator) -> None:
    """Overwrite a possible length field."""
    size = int(rng.choice([4, 8]))
    at = int(rng.integers(max(1, len(data) - size)))
    number = int(rng.choice([0, 1, 2**31 - 1, 2**32 - 1, int(rng.integers(2**31))]))
    data[at : at + size] = struct.pack('<Q', number)[:size]


def _swap(data: bytearray, rng: np.random.Generator) -> None:
    size = int(rng.integers(1, max(2, len(data) // 4)))
    first, second = sorted(int(rng.integers(max(1, len(data) - size))) for _ in range(2))
    if second >= first + size:
        data[first : first + size], data[second : second + size] = (
            data[second : second + size],
            data[first : first + size],
        )


def _remove(data: bytearray, rng: np.random.Generator) -> None:
    size = int(rng.integers(1, max(2, len(data) // 4)))
    at = int(rng.integers(max(1, len(data) - size)))
    del data[at : at + size]


#: Kinds of damage by name.
DAMAGES: Final[Mapping[str, Callable[[bytearray, np.random.Generator], None]]] = {
    'flipped bits': _flip,
    'cut': _cut,
    'lengths': _lengths,
    'swapped blocks': _swap,
    'block removed': _remove,
}


def compare(tick: Tick, files: int = 10_000, seed: int = 2014) -> Answer:
    """Identify damaged recordings in this process, and count the outcomes."""
    with TemporaryDirectory() as place:
        whole = forms(Path(place))
        cases = [(form, damage) for form in whole for damage in DAMAGES]
        counts: dict[tuple[str, str], Counter[str]] = {case: Counter() for case in cases}
        truth = {form: _identified(path) for form, path in whole.items()}
        longest, worst = 0.0, ''
        silent = list[str]()
        for number in range(files):
            form, damage = cases[number % len(cases)]
            tick(f'{number + 1} of {files}: {form}, {damage}')
            rng = np.random.default_rng([seed, number])
            data = bytearray(whole[form].read_bytes())
            DAMAGES[damage](data, rng)
            file = Path(place) / f'damaged{whole[form].suffix}'
            file.write_bytes(data)
            begin = time.perf_counter()
            what = _fate(file, truth[form])
            if (took := time.perf_counter() - begin) > longest:
                longest, worst = took, f'{form}, {damage}'
            counts[form, damage][what] += 1
            if what not in ('refused', 'the same', 'shorter', 'warned'):
                silent.append(f'{number}: {form}, {damage}: {what}')
    peak = 1e-6 * peak_memory()
    fates = ('refused', 'the same', 'shorter', 'warned', 'another, silently', 'traceback')
    total = Counter[str]()
    for count in counts.values():
        for what, number in count.items():
            total[what.partition(':')[0]] += number
    rows = [
        (form, damage, *(f'{sum(n for w, n in counts[form, damage].items() if w.startswith(fate))}'
                         for fate in fates))
        for form, damage in cases
    ]  # fmt: skip
    section = PageSection(
        'Damaged recordings',
        ('form', 'damage', *fates),
        rows,
        f'{files} files, seed {seed}, in one process. Refused: an error of one line. The same: '
        'mu_s and mu_v within the interval of the undamaged recording. Shorter: of its beginning, '
        'as for an earlier end: a table cut between two lines is not detectable. '
        f'Warned: another value, with a warning. The slowest took {longest:.2g} s ({worst}). '
        + (f'To mend: {"; ".join(silent[:20])}' if silent else ''),
    )
    bars = [
        Bar('tracebacks', float(total['traceback']), 0.0, ''),
        Bar('other values without a warning', float(total['another, silently']), 0.0, ''),
        Bar('slowest file', longest, PATIENCE, 's'),
        Bar('peak memory', peak, MEMORY, 'MB'),
    ]
    return [section], bars


def _identified(path: Path) -> tuple[Recording, FrictionEstimate]:
    recording = read_friction_recording(path)
    return recording, identify_friction(recording)


def _is_beginning(part: Recording, whole: Recording) -> bool:
    count = len(part.time)
    return bool(
        np.array_equal(part.force, whole.force[:count])
        and np.array_equal(part.depth, whole.depth[:count])
    )


def _fate(file: Path, whole: tuple[Recording, FrictionEstimate]) -> str:
    """Return the outcome of a damaged file."""
    try:
        recording, found = _identified(file)
    except (NeedleError, OSError) as error:
        return 'traceback: more than a line' if '\n' in str(error) else 'refused'
    except Exception as error:  # noqa: BLE001
        return f'traceback: {type(error).__name__}: {error}'
    truth = whole[1]
    same = all(
        found[name].determined
        and truth[name].interval[0] <= found[name].value <= truth[name].interval[1]
        for name in ('coulomb_friction', 'viscous_friction')
    )
    if same:
        return 'the same'
    if _is_beginning(recording, whole[0]):
        return 'shorter'
    told = set(recording.losses) - set(whole[0].losses)
    return 'warned' if told or found.warnings else 'another, silently'
