"""
Recordings from bags: the topics of force and motion as arrays on the time base of the force.

Samples are sorted by stamp. Samples denser than 800 Hz are averaged over bins of 1/400 s, stamps
and values alike, which causes no delay; see `series`. The motion is interpolated to the stamps
of the force; see `timebase`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Final, NamedTuple

from needle_identification.bags.bag import Bag
from needle_identification.bags.topics import Topic
from needle_identification.errors import RecordingError
from needle_identification.recordings import TIMES
from needle_identification.recordings.recording import IndentationRecording, Recording
from needle_identification.recordings.samples import (
    AXES,
    Gathering,
    position_and_speed,
    Source,
    source_of,
)
from needle_identification.recordings.tables import is_table, read_friction_table, TABLES
from needle_identification.recordings.timebase import merge
from needle_ros import wire
from needle_ros.contract import BASE_WRENCH, END_EFFECTOR_POSE, JOINT_STATES
from needle_ros.errors import MessageError

#: Messages that show the names of joints.
_FIRST: Final = 50


class Wanted(NamedTuple):
    """
    A topic that is looked for in a bag.

    Attributes
    ----------
    option : str
        The option that names it.
    types : tuple of str
        Types it may have.
    usual : tuple of str
        Its usual last names.

    """

    option: str
    types: tuple[str, ...]
    usual: tuple[str, ...]


_WRENCH: Final = Wanted('wrench_topic', (wire.WRENCH,), (BASE_WRENCH.name,))
_FRICTION_MOTION: Final = Wanted(
    'motion_topic',
    (wire.JOINT_STATE, wire.POSE, wire.POINT, wire.TWIST, wire.ODOMETRY),
    (JOINT_STATES.name, END_EFFECTOR_POSE.name),
)
_INDENTATION_MOTION: Final = Wanted(
    'motion_topic',
    (wire.POSE, wire.POINT, wire.ODOMETRY, wire.JOINT_STATE),
    (END_EFFECTOR_POSE.name, JOINT_STATES.name),
)


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
        A rosbag2 folder, an ``.mcap`` or a ``.db3`` file, whose end may be missing; a ``.bag``
        file of ROS 1; or a table, see `tables`.
    wrench_topic : str, optional
        Topic of type WrenchStamped; default the only one, or else that with the last name
        base_wrench.
    motion_topic : str, optional
        Topic of type JointState, PoseStamped, PointStamped, TwistStamped or Odometry; default the
        only one, or else that with the last name joint_states or end_effector_pose.
    force_axis : str
        Component of the force that points into the tissue: x, y, z, or one of them after ``-``.
    motion_axis : str, optional
        Component of the motion that points into the tissue, likewise; default y. Of a JointState
        the joint; default insertion, or the only one there is.
    time : str
        Stamps to use, one of `TIMES`.
    columns : mapping of str to str, optional
        Columns of a table by role, see `tables`; topics, axes and stamps do not apply to it.

    Returns
    -------
    Recording
        Force and motion; its ``losses`` say what was left out or repaired. Speeds alone are
        integrated.

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
    if is_table(path):
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
        return read_friction_table(Path(path), columns or {})
    if columns:
        raise RecordingError(f'{path} is a bag: --columns is for tables ({", ".join(TABLES)})')
    sign, axis = signed_axis(force_axis, 'force axis')
    bag = Bag(path)
    topics = bag.topics()
    wrench = chosen_topic(bag, topics, _WRENCH, wrench_topic)
    motion = chosen_topic(bag, topics, _FRICTION_MOTION, motion_topic)
    source, direction = _motion_source(bag, motion, motion_axis)
    force_source = source_of(wrench.type_name, [axis])
    gathered, configuration = read_samples(bag, {wrench: force_source, motion: source}, time)
    force = gathered[wrench].samples(bag)
    moved = gathered[motion].samples(bag)
    if motion.type_name in (wire.TWIST, wire.JOINT_STATE, wire.ODOMETRY):
        moved = position_and_speed(moved, bag)
    else:
        bag.losses.append(f'{motion.name} has no velocity')
    moved = moved._replace(values=direction * moved.values)
    times, forces, motions, clock_offset = merge(bag, force, moved)
    return Recording(
        name=str(path),
        time=times,
        depth=motions[:, 0],
        speed=motions[:, 1] if motions.shape[1] > 1 else None,
        force=sign * forces[:, 0],
        losses=tuple(bag.losses),
        configuration=configuration,
        clock_offset=clock_offset,
    )


def read_indentation_recording(
    path: Path | str,
    *,
    wrench_topic: str | None = None,
    motion_topic: str | None = None,
    axes: tuple[str, str] = ('x', 'z'),
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
        default the only one, or else that with the last name end_effector_pose or joint_states.
    axes : (str, str)
        The plane: x, y or z, or one of them after ``-``, which turns both force and position.

    Returns
    -------
    IndentationRecording
        Force and position; its ``losses`` say what was left out or repaired.

    Raises
    ------
    RecordingError
        If the bag is not readable or lacks a topic.

    """
    signs, plane = zip(*(signed_axis(axis, 'axis of the plane') for axis in axes), strict=True)
    if len(set(plane)) != 2:
        raise RecordingError(f'axes must be two different ones of x, y, z, got {axes!r}')
    across = next(axis for axis in AXES if axis not in plane)
    bag = Bag(path)
    topics = bag.topics()
    wrench = chosen_topic(bag, topics, _WRENCH, wrench_topic)
    motion = chosen_topic(bag, topics, _INDENTATION_MOTION, motion_topic)
    sources = {
        wrench: source_of(wrench.type_name, plane),
        motion: source_of(motion.type_name, (*plane, across)),
    }
    gathered, configuration = read_samples(bag, sources, time)
    times, forces, positions, clock_offset = merge(
        bag, gathered[wrench].samples(bag), gathered[motion].samples(bag)
    )
    return IndentationRecording(
        name=str(path),
        time=times,
        position=positions[:, :2] * signs,
        off_plane=positions[:, 2],
        force=forces * signs,
        losses=tuple(bag.losses),
        configuration=configuration,
        clock_offset=clock_offset,
    )


def signed(text: str) -> tuple[float, str]:
    """
    Split a name from its sign.

    Parameters
    ----------
    text : str
        A name, perhaps after ``-``.

    Returns
    -------
    sign : float
        1 or -1.
    name : str
        The name.

    """
    return (-1.0, text[1:]) if text.startswith('-') else (1.0, text)


def signed_axis(text: str, what: str) -> tuple[float, str]:
    """
    Split an axis into its sign and its name.

    Parameters
    ----------
    text : str
        x, y or z, or one of them after ``-``.
    what : str
        What the axis is, for the message.

    Returns
    -------
    sign : float
        1 or -1.
    axis : str
        x, y or z.

    Raises
    ------
    RecordingError
        If it is another.

    """
    sign, axis = signed(text)
    if axis not in AXES:
        raise RecordingError(f'{what} must be x, y, z, -x, -y or -z, got {text!r}')
    return sign, axis


def _motion_source(bag: Bag, topic: Topic, axis: str | None) -> tuple[Source, float]:
    """Return what to take for a motion along an axis or of a joint, and its sign."""
    if topic.type_name == wire.JOINT_STATE:
        sign, joint = signed(axis or '')
        return source_of(topic.type_name, 'y', joint or _only_joint(bag, topic)), sign
    sign, name = signed_axis('y' if axis is None else axis, 'motion axis')
    return source_of(topic.type_name, [name]), sign


def _only_joint(bag: Bag, topic: Topic) -> str | None:
    """Return the joint that nearly all of the first messages name alone; None if none is."""
    names = Counter(first_names(bag, topic))
    if not names:
        return None
    usual, count = names.most_common(1)[0]
    return usual[0] if len(usual) == 1 and count > 0.8 * names.total() else None


def first_names(bag: Bag, topic: Topic) -> list[tuple[str, ...]]:
    """
    Return the joints that the first messages of a topic name.

    Parameters
    ----------
    bag : Bag
        The bag.
    topic : Topic
        A topic of JointState messages.

    Returns
    -------
    list of tuple of str
        Names of each message that can be read.

    """
    reader = wire.Reader(wire.JOINT_STATE)
    found: list[tuple[str, ...]] = []
    # The first batch is enough, and all that is read.
    for batch in islice(bag.batches(lambda other: other == topic), 1):
        for _, data in islice(batch.messages(), _FIRST):
            with suppress(MessageError):
                found.append(reader.read(data).names)
    return found


def chosen_topic(bag: Bag, topics: Sequence[Topic], wanted: Wanted, name: str | None) -> Topic:
    """
    Return the topic of a name, or the one of the right type.

    Parameters
    ----------
    bag : Bag
        The bag.
    topics : sequence of Topic
        Its topics.
    wanted : Wanted
        What is looked for.
    name : str or None
        Its name, if that is known.

    Returns
    -------
    Topic
        The topic.

    Raises
    ------
    RecordingError
        If there is none, or more than one.

    """
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
    bag: Bag, sources: Mapping[Topic, Source], time: str
) -> tuple[Mapping[Topic, Gathering], str]:
    """
    Go through a bag.

    Parameters
    ----------
    bag : Bag
        The bag.
    sources : mapping of Topic to Source
        What to take from each topic.
    time : str
        Stamps to use, one of `TIMES`.

    Returns
    -------
    gathered : mapping of Topic to Gathering
        Samples of each topic.
    configuration : str
        Configuration of the plant, '' if there is none.

    Raises
    ------
    RecordingError
        If the bag is not readable.

    """
    if time not in TIMES:
        raise RecordingError(f'time must be one of {", ".join(TIMES)}, got {time!r}')
    gathered = {
        topic: Gathering(topic, source, by_header=time == 'header')
        for topic, source in sources.items()
    }
    configuration = ''
    for batch in bag.batches(lambda topic: topic in gathered or _is_configuration(topic)):
        if batch.topic in gathered:
            gathered[batch.topic].add(batch)
        else:
            with suppress(MessageError):
                *_, (_, data) = batch.messages()
                configuration = wire.read_string(data)
    return gathered, configuration


def _is_configuration(topic: Topic) -> bool:
    return topic.type_name == 'std_msgs/msg/String' and topic.name.endswith('plant/configuration')
