# SPDX-License-Identifier: Apache-2.0
"""Read recordings from bags: force and motion as arrays on the time base of the force."""

from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Any, Final, NamedTuple

from needle_dynamics.arrays import BoolArray, FloatArray
from needle_identification.bags.bag import Bag, TABLES
from needle_identification.bags.topics import BagTopic
from needle_identification.errors import RecordingError
from needle_identification.recordings import friction_table, samples, tables, TIMES
from needle_identification.recordings.likeness import oblique
from needle_identification.recordings.merging import merge, merged_recording
from needle_identification.recordings.recording import IndentationRecording, Recording
from needle_ros import wire
from needle_ros.column_units import foreign_unit, UNITS
from needle_ros.contract import (
    BASE_WRENCH,
    END_EFFECTOR_POSE,
    INSERTION,
    JOINT_STATES,
    TIP_DEFLECTION,
)
from needle_ros.errors import MessageError, ParameterError
from needle_ros.quantities import AXES, signed, signed_axis
import numpy as np

_FIRST: Final = 50  # number of messages that are read for joint names

#: Message types of the motion of a needle.
MOTIONS: Final = (wire.JOINT_STATE, wire.POSE, wire.POINT, wire.TWIST, wire.ODOMETRY)


class Wanted(NamedTuple):
    """Criteria for a topic: its option, valid types, and usual last names."""

    option: str
    types: tuple[str, ...]
    usual: tuple[str, ...]


_WRENCH: Final = Wanted('wrench_topic', (wire.WRENCH,), (BASE_WRENCH.name,))
TIP: Final = Wanted('tip_topic', (wire.POINT, wire.POSE), (TIP_DEFLECTION.name,))
_POSES: Final = (wire.POSE, wire.POINT, wire.ODOMETRY, wire.JOINT_STATE)
_USUAL: Final = (END_EFFECTOR_POSE.name, JOINT_STATES.name)
#: Spans of positions of an insertion, and under the force of presses, that are rarely in m.
LONGEST_STROKE, _DEEPEST_PRESS = 2.0, 0.25
STRONGEST: Final = 500.0  #: span of forces on a needle that are rarely in N
_FRICTION_MOTION: Final = Wanted('motion_topic', MOTIONS, _USUAL[::-1])
_INDENTATION_MOTION: Final = Wanted('motion_topic', _POSES, _USUAL)


def read_friction_recording(
    path: Path | str,
    *,
    wrench_topic: str | None = None,
    motion_topic: str | None = None,
    force_axis: str = 'y',
    motion_axis: str | None = None,
    time: str = 'header',
    columns: Mapping[str, str] | None = None,
) -> Recording:
    """
    Read force and motion of the needle base from a bag, on the time base of the force.

    Parameters
    ----------
    path : Path or str
        A rosbag2 folder, an ``.mcap`` or a ``.db3`` file, possibly truncated; a ``.bag``
        file of ROS 1; or a table, see `tables`.
    wrench_topic : str, optional
        Topic of type WrenchStamped; default the only such topic, else the topic with the last
        name base_wrench.
    motion_topic : str, optional
        Topic of type JointState, PoseStamped, PointStamped, TwistStamped or Odometry; default the
        only such topic, else the topic with the last name joint_states or end_effector_pose.
    force_axis : str
        Component of the force into the tissue: x, y or z, with ``-`` for the opposite sign, and
        with a unit in brackets if it is not N: ``-z[mN]``, or a factor: ``-z*0.01``.
    motion_axis : str, optional
        Component of the motion into the tissue, likewise; default y. For a JointState the joint;
        default insertion, or the only joint. With ``[mm]``, the velocity is in mm/s; with a
        factor, ``spindle*0.0016``, in the same unit per s: here rad and rad/s.
    time : str
        Stamps to use, one of `TIMES`.
    columns : mapping of str to str, optional
        Columns of a table by role, see `tables`; a table has no topics, axes and stamps.

    Returns
    -------
    Recording
        Force and motion; ``losses`` lists discarded and repaired data. A velocity without
        position is integrated.

    Raises
    ------
    RecordingError
        If the bag is not readable or lacks a topic.

    Examples
    --------
    >>> from needle_identification import read_friction_recording
    >>> recording = read_friction_recording('bags/friction_01')
    >>> recording
    <Recording bags/friction_01: 1110 samples in 11.09 s>
    >>> recording.losses
    ()

    """
    if tables.is_table(path):
        others = {
            '--wrench-topic': wrench_topic,
            '--motion-topic': motion_topic,
            '--motion-axis': motion_axis,
            '--force-axis': force_axis if force_axis != 'y' else None,
            '--time': time if time != 'header' else None,
        }
        for option, given in others.items():
            if given is not None:
                raise RecordingError(f'{path} is a table: --columns takes the place of {option}')
        return friction_table.friction_recording(tables.read_table(Path(path)), columns or {})
    if columns:
        raise RecordingError(f'{path} is a bag: --columns is for tables ({", ".join(TABLES)})')
    given, size = scaled_axis(force_axis, 'force')
    sign, axis = signed_axis(given, 'force axis')
    bag = Bag(path)
    topics = bag.topics()
    wrench = chosen_topic(bag, topics, _WRENCH, wrench_topic)
    motion = chosen_topic(bag, topics, _FRICTION_MOTION, motion_topic)
    along_axis, length = scaled_axis(motion_axis, 'depth')
    source, direction, name = _motion_source(bag, motion, along_axis)
    force_source = samples.source_of(wrench.type_name, [axis])
    gathered, configuration = read_samples(bag, {wrench: force_source, motion: source}, time)
    force = gathered[wrench].samples(bag)
    moved = gathered[motion].samples(bag)
    if isinstance(source, samples.ObliqueVector):
        along, *across = moved.values.T
        lines = oblique(source.axes[0], along, dict(zip(source.axes[1:], across, strict=True)))
        bag.losses += [f'{motion.name}: {line}' for line in lines]
        moved = moved._replace(values=moved.values[:, :1])
    if motion.type_name in (wire.TWIST, wire.JOINT_STATE, wire.ODOMETRY):
        moved = samples.position_and_velocity(moved, bag)
    else:
        bag.losses.append(f'{motion.name} has no velocity')
    moved = moved._replace(values=direction * length * moved.values)
    if length == 1.0:
        bag.losses += _too_long(motion, moved.values[:, 0], LONGEST_STROKE, '--motion-axis', name)
    if size == 1.0:
        bag.losses += _too_strong(wrench, force.values[:, 0], force_axis)
    return merged_recording(
        bag, force._replace(values=sign * size * force.values), moved, configuration
    )


def read_indentation_recording(
    path: Path | str,
    *,
    wrench_topic: str | None = None,
    motion_topic: str | None = None,
    axes: tuple[str, str] = ('x', 'z'),
    force_axes: tuple[str, str] | None = None,
    time: str = 'header',
) -> IndentationRecording:
    """
    Read force and position of an end-effector from a bag, on the time base of the force.

    Parameters
    ----------
    path, wrench_topic, time
        As in `read_friction_recording`.
    motion_topic : str, optional
        Topic of type PoseStamped, PointStamped or Odometry, or JointState with joints x, y and z;
        default the only such topic, else the topic with the last name end_effector_pose or
        joint_states.
    axes : (str, str)
        Axes of the plane: x, y or z; ``-`` reverses the sign of both force and position. With a
        unit in brackets, ``x[mm]``, it is the unit of the position.
    force_axes : (str, str), optional
        Axes of the force along these axes, with ``-`` if only the force is reversed, and with a
        unit in brackets if it is not N; default the same axes.

    Returns
    -------
    IndentationRecording
        Force and position; ``losses`` lists discarded and repaired data.

    """
    signs, plane, sizes = _plane('axes', axes, 'depth')
    if force_axes is None:
        force_signs, pressed = signs, plane
    else:
        scales, pressed, units = _plane('force_axes', force_axes, 'force')
        force_signs = scales * units
    across = next(axis for axis in AXES if axis not in plane)
    bag = Bag(path)
    topics = bag.topics()
    wrench = chosen_topic(bag, topics, _WRENCH, wrench_topic)
    motion = chosen_topic(bag, topics, _INDENTATION_MOTION, motion_topic)
    sources = {
        wrench: samples.source_of(wrench.type_name, pressed),
        motion: samples.source_of(motion.type_name, (*plane, across)),
    }
    gathered, configuration = read_samples(bag, sources, time)
    times, forces, positions, clock_offset = merge(
        bag, gathered[wrench].samples(bag), gathered[motion].samples(bag)
    )
    length = float(sizes.max())
    if length == 1.0:
        for axis, position in zip(plane, positions[_are_pressed(forces)].T, strict=False):
            bag.losses += _too_long(motion, position, _DEEPEST_PRESS, '--axes', axis)
    return IndentationRecording(
        name=str(path),
        time=times,
        position=positions[:, :2] * signs * sizes,
        off_plane=positions[:, 2] * length,
        force=forces * force_signs,
        losses=tuple(bag.losses),
        configuration=configuration,
        clock_offset=clock_offset,
    )


def scaled_axis(axis: Any, role: str) -> tuple[Any, float]:
    """Split an axis, such as ``slide[mm]`` or ``spindle*0.002``, into name and factor (to SI)."""
    found = tables.SPEC.match(axis or '')
    name, factor, unit = found.groups() if found else (axis, None, None)
    known = unit is None or unit in UNITS[role]
    if (factor is None and unit is None) or not (known or foreign_unit(axis)):
        # With the blanks of its name, and with an index, such as joint[0].
        return axis, 1.0
    if not known:
        raise ParameterError(
            f'the unit of the axis {axis!r} must be one of {", ".join(UNITS[role])}, got '
            f'{unit!r}; or state a factor: NAME*FACTOR'
        )
    size = UNITS[role][unit] if unit else 1.0
    if factor is not None:
        with suppress(ValueError):
            size *= float(factor)
            if size and np.isfinite(size):
                return name, size
        raise ParameterError(
            f'the factor of the axis {axis!r} must be a finite number, not zero, got {factor!r}'
        )
    return name, size


def _plane(
    name: str, axes: tuple[str, str], role: str
) -> tuple[FloatArray, tuple[str, ...], FloatArray]:
    """Return the signs, names and sizes of the units of two different axes."""
    given, sizes = zip(*(scaled_axis(axis, role) for axis in axes), strict=True)
    signs, plane = zip(*(signed_axis(axis, f'each of {name}') for axis in given), strict=True)
    if len(set(plane)) != 2:
        raise ParameterError(f'{name} must be two different axes of x, y, z, got {axes!r}')
    return np.array(signs), plane, np.array(sizes)


def _are_pressed(forces: FloatArray) -> BoolArray:
    """Return where a force (n, 2) is far from its median: not on the way to the presses."""
    size = np.linalg.norm(forces - np.median(forces, axis=0), axis=1)
    return np.asarray(size > 0.5 * size.max())


def _too_long(
    topic: BagTopic, positions: FloatArray, longest: float, option: str, axis: str
) -> list[str]:
    """Warn of positions whose span is rarely one in m."""
    if (span := _span(positions)) <= longest:
        return []
    return [f'{topic.name} moves over {span:.3g} m along {axis}: perhaps {option} {axis}[mm]']


def _too_strong(topic: BagTopic, forces: FloatArray, axis: str) -> list[str]:
    """Warn of forces on a needle whose span is rarely one in N."""
    if (span := _span(forces)) <= STRONGEST:
        return []
    return [f'{topic.name} varies by {span:.4g} N along {axis}: perhaps --force-axis {axis}[mN]']


def _span(values: FloatArray) -> float:
    known = values[np.isfinite(values)]
    return float(np.ptp(known)) if len(known) else 0.0


def _motion_source(
    bag: Bag, topic: BagTopic, axis: str | None
) -> tuple[samples.SignalSource, float, str]:
    """Return the source of a motion along an axis or of a joint, its sign, and its name."""
    if topic.type_name == wire.JOINT_STATE:
        sign, joint = signed(axis or '')
        name = joint or _only_joint(bag, topic) or INSERTION
        return samples.source_of(topic.type_name, 'y', name), sign, axis or name
    sign, name = signed_axis('y' if axis is None else axis, 'motion axis')
    if topic.type_name == wire.ODOMETRY:
        return samples.source_of(topic.type_name, [name]), sign, axis or name
    return samples.ObliqueVector(name), sign, axis or name


def _only_joint(bag: Bag, topic: BagTopic) -> str | None:
    """Return the joint named alone by more than 80 % of the first messages, else None."""
    names = Counter(first_names(bag, topic))
    if not names:
        return None
    usual, count = names.most_common(1)[0]
    return usual[0] if len(usual) == 1 and count > 0.8 * names.total() else None


def first_names(bag: Bag, topic: BagTopic) -> list[tuple[str, ...]]:
    """Return the joint names of each readable message among the first of a JointState topic."""
    reader = wire.MessageReader(wire.JOINT_STATE)
    found: list[tuple[str, ...]] = []
    # Only the first batch is read.
    for batch in islice(bag.batches(lambda other: other == topic), 1):
        for _, data in islice(batch.messages(), _FIRST):
            with suppress(MessageError):
                found.append(reader.read(data).names)
    return found


def chosen_topic(
    bag: Bag, topics: Sequence[BagTopic], wanted: Wanted, name: str | None
) -> BagTopic:
    """Return the topic with a name, or the only suitable topic by type and usual name."""
    fitting = [topic for topic in topics if topic.type_name in wanted.types]
    short = ', '.join(type_name.rsplit('/', 1)[-1] for type_name in wanted.types)
    if name is not None:
        meant = [topic for topic in fitting if topic.name == name]
        lacking = f'topic {name} of type {short}'
    else:
        named = ([t for t in fitting if t.name.rsplit('/', 1)[-1] == n] for n in wanted.usual)
        meant = fitting if len(fitting) == 1 else next(filter(None, named), [])
        lacking = f'topic of type {short}'
    if len(meant) == 1:
        return meant[0]
    if name is None and fitting:
        raise RecordingError(
            f'{bag.path} has several topics of type {short}; {wanted.option} '
            f'(--{wanted.option.replace("_", "-")}) must name one of '
            f'{", ".join(topic.name for topic in meant or fitting)}'
        )
    listing = ', '.join(map(str, topics))
    raise RecordingError(
        '; '.join([f'{bag.path} has no {lacking}; it has {listing}', *bag.losses])
    )


def read_samples(
    bag: Bag, sources: Mapping[BagTopic, samples.SignalSource], time: str
) -> tuple[Mapping[BagTopic, samples.Gathering], str]:
    """Gather topics from a bag by stamps of `time`; also return the configuration of the plant."""
    if time not in TIMES:
        raise RecordingError(f'time must be one of {", ".join(TIMES)}, got {time!r}')
    gathered = {
        topic: samples.Gathering(topic, source, by_header=time == 'header')
        for topic, source in sources.items()
    }
    configuration = ''
    for batch in bag.batches(lambda topic: topic in gathered or is_configuration(topic, 'plant')):
        if batch.topic in gathered:
            gathered[batch.topic].add(batch)
        else:
            with suppress(MessageError):
                *_, (_, data) = batch.messages()
                configuration = wire.read_string(data)
    return gathered, configuration


def is_configuration(topic: BagTopic, node: str) -> bool:
    """Return whether a topic has the parameters of a node."""
    kind = topic.type_name == 'std_msgs/msg/String'
    return kind and topic.name.endswith(f'{node}/configuration')
