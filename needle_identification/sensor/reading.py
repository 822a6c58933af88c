# SPDX-License-Identifier: Apache-2.0
"""Read recordings of a tip sensor and true positions, from bags and tables."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

from needle_dynamics.arrays import FloatArray, IntArray
from needle_identification.bags.bag import Bag
from needle_identification.bags.topics import BagTopic
from needle_identification.errors import RecordingError
from needle_identification.recordings import Roles, tables
from needle_identification.recordings.merging import span_of
from needle_identification.recordings.reading import chosen_topic, read_samples, TIP, Wanted
from needle_identification.recordings.recording import SensorRecording
from needle_identification.recordings.samples import EachJoint, SignalSource, source_of
from needle_ros import wire
from needle_ros.errors import ParameterError
from needle_ros.quantities import AXES, signed, signed_axis
from needle_ros.timing import NANOSECONDS
import numpy as np

_TRUTH: Final = Wanted('truth_topic', (wire.POINT, wire.POSE, wire.JOINT_STATE), ())

#: Roles of the columns of a table; for a bag, axes or joints by role, without the time.
SENSOR_ROLES: Final = ('time', 'tip_x', 'tip_y', 'tip_z')

#: Usual column names by role, in lower case without separators.
_USUAL: Final = {
    'time': tables.TIME_NAMES,
    'tip_x': ('tipx', 'x', 'px', 'pointx', 'positionx'),
    'tip_y': ('tipy', 'y', 'py', 'pointy', 'positiony'),
    'tip_z': ('tipz', 'z', 'pz', 'pointz', 'positionz'),
}

_AVERAGED: Final = 1.5  # messages per sample above which samples are means


def read_sensor_recording(
    path: Path | str,
    truth: Path | str | Sequence[float],
    *,
    axes: Sequence[str] = AXES,
    tip_topic: str | None = None,
    truth_topic: str | None = None,
    time: str = 'header',
    columns: Mapping[str, str] | None = None,
    truth_columns: Mapping[str, str] | None = None,
) -> SensorRecording:
    """Read a bag or a table of a tip sensor, and the true position, which may be constant [m]."""
    # ``columns`` and ``truth_columns`` are by role, of `SENSOR_ROLES`: columns of a table, see
    # `tables`; for a bag, the axes x, y or z, or joints, with a prefix ``-`` for the opposite
    # sign. The true position may be a JointState. Topics are by default the only ones of their
    # types, or end with tip_deflection. Otherwise as `read_friction_recording`.
    axes = tuple(axes)
    if not axes or len({*axes}) < len(axes) or not {*axes} <= {*AXES}:
        raise ParameterError(f'axes must be one or several of x, y, z, got {",".join(axes)!r}')
    path = Path(path)
    # In one bag the topic of the one is not that of the other.
    is_same = isinstance(truth, (str, Path)) and Path(truth) == path
    taken, tip_taken = (truth_topic, tip_topic) if is_same else (None, None)
    stamps, tip, losses = _positions(path, TIP, tip_topic, axes, time, columns or {}, taken)
    if isinstance(truth, (str, Path)):
        true_stamps, true_tip, others = _positions(
            Path(truth), _TRUTH, truth_topic, axes, time, truth_columns or {}, tip_taken
        )
        losses += [f'true position: {loss}' for loss in others]
        if stamps[-1] < true_stamps[0] or true_stamps[-1] < stamps[0]:
            raise RecordingError(
                f'{path} and the true position in {truth} do not overlap in time; they last '
                f'{span_of(stamps)} and {span_of(true_stamps)}'
            )
    else:
        if len(truth) != len(AXES) or not np.isfinite(truth).all():
            raise ParameterError(f'a constant position is x, y, z [m], got {list(truth)}')
        true_stamps = stamps[:1]
        true_tip = np.array([[truth[AXES.index(axis)] for axis in axes]], dtype=np.float64)
    start = stamps[0]
    return SensorRecording(
        name=str(path),
        axes=axes,
        time=(stamps - start) / NANOSECONDS,
        tip=tip,
        true_time=(true_stamps - start) / NANOSECONDS,
        true_tip=true_tip,
        losses=tuple(losses),
    )


def _positions(
    path: Path,
    wanted: Wanted,
    topic: str | None,
    axes: Sequence[str],
    time: str,
    columns: Roles,
    taken: str | None,
) -> tuple[IntArray, FloatArray, list[str]]:
    """Return stamps [ns], (n,), positions on the axes [m], (n, k), and losses."""
    if not tables.is_table(path):
        bag = Bag(path)
        among = [one for one in bag.topics() if topic is not None or one.name != taken]
        return _of_bag(bag, chosen_topic(bag, among, wanted, topic), axes, time, columns)
    if topic is not None:
        option = wanted.option.replace('_', '-')
        raise RecordingError(f'{path} is a table: name columns instead of --{option}')
    table = tables.read_table(path)
    specs, losses = {**tables.guessed(table.columns, _USUAL), **columns}, list(table.losses)
    roles = ['time', *(f'tip_{axis}' for axis in axes)]
    option = '--truth-columns' if wanted is _TRUTH else '--columns'
    if missing := [role for role in roles if role not in specs]:
        raise RecordingError(
            f'{path}: no column found for {" and ".join(missing)}, it has '
            f'{", ".join(table.columns)}: use {option} {missing[0]}=NAME,...'
        )
    if words := ', '.join(f'{role}={specs[role]}' for role in roles if role not in columns):
        losses.append(f'columns by their names: {words}')
    times, *tips = (
        tables.column_values(table, role, specs[role], losses, option) for role in roles
    )
    rows = np.column_stack(tips)
    start, stamps, found = tables.sorted_rows(path, times, rows, losses)
    _check_means(losses, int(np.count_nonzero(np.isfinite(rows).all(axis=1))), len(stamps))
    return round(NANOSECONDS * start) + stamps, found, losses


def _of_bag(
    bag: Bag, topic: BagTopic, axes: Sequence[str], time: str, columns: Roles
) -> tuple[IntArray, FloatArray, list[str]]:
    words = [columns.get(f'tip_{axis}', axis) for axis in axes]
    if topic.type_name == wire.JOINT_STATE:
        parsed = [signed(word) for word in words]
        source: SignalSource = EachJoint(*(joint for _, joint in parsed))
    else:
        parsed = [signed_axis(word, f'tip_{axis}') for axis, word in zip(axes, words, strict=True)]
        source = source_of(topic.type_name, [axis for _, axis in parsed])
    gathered, _ = read_samples(bag, {topic: source}, time)
    samples = gathered[topic].samples(bag)
    losses = list(bag.losses)
    _check_means(losses, bag.counts[topic], len(samples.stamps))
    return samples.stamps, samples.values * [sign for sign, _ in parsed], losses


def _check_means(losses: list[str], count: int, samples: int) -> None:
    if count > _AVERAGED * samples:
        losses.append(f'{count} samples averaged to {samples}: noise and rate are of the means')
