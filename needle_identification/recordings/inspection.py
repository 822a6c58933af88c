# SPDX-License-Identifier: Apache-2.0
"""Inspect a recording: list its content, find force and motion, suggest a command."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import chain, islice
from math import nan
from pathlib import Path
import shlex
from typing import Any, Final, NamedTuple

from needle_dynamics.arrays import FloatArray
from needle_identification.bags.bag import Bag
from needle_identification.bags.topics import BagTopic
from needle_identification.errors import RecordingError, WrongSignError
from needle_identification.recordings import friction_table, reading, tables
from needle_identification.recordings.likeness import (
    EXPLAINED,
    Likeness,
    likeness,
    most_alike,
    oblique,
    tilted,
    velocity_of,
)
from needle_identification.recordings.merging import clock_offset
from needle_identification.recordings.reading import is_configuration
from needle_identification.recordings.samples import (
    are_gaps,
    EachJoint,
    Gathering,
    Samples,
    source_of,
)
from needle_identification.recordings.tables import column_values, measured_values
from needle_identification.steering.reading import (
    check_depth,
    is_inverted,
    JOINTS,
    read_steering_recording,
    steering_columns,
    STEERING_ROLES,
    TIP_ALONG,
    USUAL,
)
from needle_identification.stiffness.identify import identify_stiffness
from needle_ros import wire
from needle_ros.contract import GROUND_TRUTH, INSERTION, TOPICS
from needle_ros.errors import MessageError, NeedleError
from needle_ros.parameter_file import parameters_in
from needle_ros.quantities import AXES
import numpy as np

_FORCE: Final = (wire.WRENCH,)  # message types of forces
_VELOCITIES: Final = (wire.TWIST,)  # message types of velocities
_UNSIGNED: Final = 'the motion does not reverse: the sign of the force cannot be found'

#: Topics of the suite that are computed, not measured: commands, references and the truth.
_COMPUTED: Final = {one.name for one in TOPICS if one.publisher != 'plant'} | {GROUND_TRUTH.name}

#: Least motion of a steered insertion, by role [m, rad].
_STEERED: Final = {'guide_x': 2e-4, 'guide_z': 2e-4, 'roll': 0.1}

_MAX_JOINTS: Final = 64  # largest number of joints of a topic that are inspected


class ColumnSummary(NamedTuple):
    """One component of a topic or one column of a table, with the range of its values."""

    name: str
    low: float
    high: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Content:
    """One topic of a bag, or a whole table."""

    name: str  #: of the topic, or of the file
    type_name: str  #: of the messages, or ``table``
    count: int  #: number of messages or rows
    rate: float = nan  #: messages per second, without pauses; nan if not inspected
    gaps: int = 0  #: number of pauses of more than ten steps
    columns: tuple[ColumnSummary, ...] = ()  #: components; none if the type is not supported


@dataclass(frozen=True, slots=True, kw_only=True)
class Inspection:
    """Content of a recording, and a command to identify from it."""

    path: str  #: of the recording
    contents: tuple[Content, ...]  #: topics, or the table
    losses: tuple[str, ...]  #: missing or damaged parts
    words: tuple[str, ...]  #: probable force and motion, with the reason
    command: str  #: for identification; '' if no force and motion were found
    lacking: str = ''  #: parts of the command to be completed by the user


def inspect_recording(path: Path | str) -> Inspection:
    """
    Inspect the content of a recording.

    Parameters
    ----------
    path : Path or str
        As for `read_friction_recording`.

    Returns
    -------
    Inspection
        Content and suggested command.

    Examples
    --------
    >>> from needle_identification import inspect_recording
    >>> inspect_recording('bags/friction_01').command
    'needle identify friction bags/friction_01'

    """
    return _table(Path(path)) if tables.is_table(path) else _bag(Path(path))


def _guide_moves(table: tables.Table, steered: Mapping[str, str]) -> bool:
    with suppress(RecordingError):
        return any(
            np.ptp(measured_values(column_values(table, role, steered[role], []))) > least
            for role, least in _STEERED.items()
            if role in steered
        )
    return False


def _table(path: Path) -> Inspection:
    table = tables.read_table(path)
    roles = _with_units(table, tables.guessed(table.columns))
    columns = tuple(_column(name, values) for name, values in table.columns.items())
    count = len(next(iter(table.columns.values())))
    content = Content(name=path.name, type_name='table', count=count, columns=columns)
    words = [f'{role} by name or unit: {spec}' for role, spec in roles.items()]
    words += [f'factor: {name} = {value:g}' for name, value in table.scalars.items()]
    lacking = friction_table.missing_roles(roles)
    kind, unknown, columns_of = 'friction', '', roles
    steered = _steering_columns(table, lacking)
    steerable = {*STEERING_ROLES} - {*steered} <= {'roll'}
    if steerable and (lacking or _guide_moves(table, steered)):
        words = [f'{role} by name and values: {spec}' for role, spec in steered.items()]
        kind, columns_of = 'steering', steered
        unknown = _refusal(table, steered)
    elif lacking:
        unknown = f'no column looks like {" or ".join(lacking)}: name them with --columns'
        columns_of = {role: roles.get(role, 'NAME') for role in tables.ROLES if role != 'speed'}
    else:
        try:
            columns_of, said = _friction_roles(table, roles)
            words = said + words[len(roles) :]
        except RecordingError as error:
            unknown = _reason(table, error)
    words += [unknown] * bool(unknown)
    named = ','.join(f'{role}={spec}' for role, spec in columns_of.items())
    return Inspection(
        path=str(path), contents=(content,), losses=tuple(table.losses), words=tuple(words),
        command=shlex.join(['needle', 'identify', kind, str(path), '--columns', named]),
        lacking=unknown,
    )  # fmt: skip


def _steering_columns(table: tables.Table, lacking: Sequence[str]) -> dict[str, str]:
    """Return the columns of a steered insertion; without friction, the depth may have any name."""
    steered = steering_columns(table)
    if not lacking or {*STEERING_ROLES} - {*steered} - {'roll'} != {'depth'}:
        return steered
    known = {*steered.values(), tables.guessed(table.columns).get('time')}
    known |= {*tables.guessed(table.columns, TIP_ALONG).values()}
    others = [name for name in table.columns if name not in known]
    if len(others) != 1:
        return {'depth': 'NAME', **steered}
    depth = others[0]
    sign = '-' if is_inverted(tables.measured_values(table.columns[depth])) else ''
    return {**steering_columns(table, {'depth': depth}), 'depth': f'{sign}{depth}'}


def _friction_roles(
    table: tables.Table, guess: Mapping[str, str]
) -> tuple[dict[str, str], list[str]]:
    """Return the columns with the sign of the motion, and words on them."""
    roles = _with_units(table, friction_table.friction_columns(table, guess))
    words = [f'{role} by name or unit: {spec}' for role, spec in roles.items()]
    read = friction_table.friction_recording(table, roles)
    sense = likeness(read.time, velocity_of(read.time, read.depth), read.force).sense
    if sense < 0.0:
        words.append('motion reversed: the force of friction has the sign of the velocity')
        roles = {
            role: f'-{spec}' if role in ('depth', 'speed') else spec
            for role, spec in roles.items()
        }
    words += [_UNSIGNED] * (not sense)
    return roles, words


def _with_units(table: tables.Table, specs: Mapping[str, str]) -> dict[str, str]:
    return {
        role: tables.with_unit(role, spec, table.columns.get(spec, np.empty(0)))
        for role, spec in specs.items()
    }


def _refusal(table: tables.Table, columns: Mapping[str, str]) -> str:
    """Return why columns of a steered insertion are not usable, such as by their unit, or ''."""
    if columns['depth'] == 'NAME':
        return 'no column looks like depth: name it with --columns'
    try:
        check_depth(table, columns['depth'])
        for role, spec in columns.items():
            column_values(table, role, spec, [])
    except RecordingError as error:
        return _reason(table, error)
    return ''


def _reason(table: tables.Table, error: RecordingError) -> str:
    return str(error).removeprefix(f'{table.path}').lstrip(': ')


def _column(name: str, values: FloatArray) -> ColumnSummary:
    finite = values[np.isfinite(values)]
    low, high = (finite.min(), finite.max()) if len(finite) else (nan, nan)
    return ColumnSummary(name, float(low), float(high))


# Bags.


class _Signal(NamedTuple):
    """A component of a topic over time, in SI units."""

    topic: BagTopic
    axis: str
    samples: Samples  # values (n,)

    @property
    def values(self) -> FloatArray:
        return self.samples.values

    @property
    def vector(self) -> str:
        """Name of the vector that has the component: joints are no vector."""
        is_joint = self.topic.type_name == wire.JOINT_STATE
        return f'{self.topic.name} {self.axis if is_joint else ""}'

    @property
    def varies(self) -> bool:
        return bool(np.isfinite(self.values).all() and np.ptp(self.values) > 0.0)


def _bag(path: Path) -> Inspection:
    bag = Bag(path)
    gathered = {
        topic: _gatherings(bag, topic)
        for topic in bag.topics()
        if topic.type_name in (*reading.MOTIONS, *_FORCE)
    }
    robot: dict[str, Any] = {}
    for batch in bag.batches(lambda one: one in gathered or is_configuration(one, 'controller')):
        if batch.topic not in gathered:
            with suppress(MessageError):
                *_, (_, data) = batch.messages()
                robot = parameters_in(wire.read_string(data))
            continue
        for gathering in gathered[batch.topic].values():
            gathering.add(batch)
    contents, signals = [], []
    losses = list(bag.losses)
    for topic, count in sorted(bag.counts.items(), key=lambda item: item[0].name):
        content = Content(name=topic.name, type_name=topic.type_name, count=count)
        if read := _signals(bag, topic, gathered.get(topic, {}), losses):
            steps = np.diff(max((one.samples.stamps for one in read), key=len))
            gaps = are_gaps(steps)
            content = replace(
                content,
                rate=float(1e9 * (count - 1) / steps[~gaps].sum()),
                gaps=int(np.count_nonzero(gaps)),
                columns=tuple(_column(one.axis, one.values) for one in read),
            )
            signals += read
        contents.append(content)
    varying = [one for one in signals if one.varies]
    words, command = _steered(path, varying)
    if not command:
        components = {topic: len(list(chain(*parts))) for topic, parts in gathered.items()}
        words, command = _suggestion(path, varying, components, robot)
    if not command:
        with suppress(NeedleError):
            words, command = _pressed(path)
    return Inspection(
        path=str(path), contents=tuple(contents), losses=tuple(dict.fromkeys(losses)),
        words=tuple(words), command=command,
    )  # fmt: skip


def _gatherings(bag: Bag, topic: BagTopic) -> dict[tuple[str, ...], Gathering]:
    """Return what gathers all axes of a topic, or each of its joints, by their names."""
    if topic.type_name != wire.JOINT_STATE:
        return {AXES: Gathering(topic, source_of(topic.type_name, AXES), by_header=True)}
    names = dict.fromkeys(chain.from_iterable(reading.first_names(bag, topic)))
    # One by one: other publishers have other joints, and a joint may have no numbers.
    return {
        (name,): Gathering(topic, EachJoint(name, required=1), by_header=True)
        for name in islice(names, _MAX_JOINTS)
    }


def _signals(
    bag: Bag, topic: BagTopic, gathered: Mapping[tuple[str, ...], Gathering], losses: list[str]
) -> list[_Signal]:
    """Return all components of a topic that are readable; add what was lost."""
    found = []
    for axes, gathering in gathered.items():
        bag.losses.clear()
        try:
            samples = gathering.samples(bag)
        except RecordingError as error:
            # Commands of velocities or efforts have no positions: they are no motion.
            if topic.type_name != wire.JOINT_STATE or not gathering.has_no_values:
                losses.append(str(error))
            continue
        losses += bag.losses
        found += [
            _Signal(topic, axis, samples._replace(values=values))
            for axis, values in zip(axes, samples.values.T, strict=True)
        ]
    return found


def _steered(path: Path, signals: Sequence[_Signal]) -> tuple[list[str], str]:
    """Return words and command for an insertion with a moved guide or a rotated needle."""
    joints = {one.axis: one for one in signals if one.topic.type_name == wire.JOINT_STATE}
    found = {role: name for role, name in tables.guessed(joints, USUAL).items() if role in JOINTS}
    moved = [
        role for role, least in _STEERED.items()
        if role in found and np.ptp(joints[found[role]].values) > least
    ]  # fmt: skip
    if 'depth' not in found or not moved:
        return [], ''
    # The signals are those that move: a joint at rest has its usual name.
    columns = {role: name for role, name in found.items() if name != JOINTS[role]}
    if is_inverted(joints[found['depth']].values):
        columns['depth'] = f'-{found["depth"]}'
    try:
        recording = read_steering_recording(path, columns=columns)
    except NeedleError:
        return [], ''
    what = (
        f'{" and ".join(found[role] for role in moved)} moved during the insertion to '
        f'{1e3 * recording.depth.max(initial=0.0):.0f} mm: the bending can be identified'
    )
    named = ['--columns', ','.join(f'{r}={n}' for r, n in columns.items())] if columns else []
    return [what], shlex.join(['needle', 'identify', 'steering', str(path), *named])


def _pressed(path: Path) -> tuple[list[str], str]:
    """Return words and command for presses; raise `NeedleError` without presses."""
    recording = reading.read_indentation_recording(path)
    try:
        identify_stiffness(recording)
    except WrongSignError as error:
        return [str(error).removeprefix(f'{recording.name}: ')], ''
    what = 'presses at several places and forces: stiffness can be identified'
    return [what], shlex.join(['needle', 'identify', 'stiffness', str(path)])


def _suggestion(
    path: Path,
    signals: Sequence[_Signal],
    components: Mapping[BagTopic, int],
    robot: Mapping[str, Any],
) -> tuple[list[str], str]:
    """
    Find the pair of force and motion that is most similar to friction.

    `components` is the number of axes or joints of each topic, also of those at rest, and `robot`
    are the recorded parameters of the controller.
    """
    measured = [one for one in signals if one.topic.name.rpartition('/')[2] not in _COMPUTED]
    forces, motions = (
        [one for one in measured if one.topic.type_name in types]
        or [one for one in signals if one.topic.type_name in types]
        for types in (_FORCE, reading.MOTIONS)
    )
    pairs = [(force, motion) for force in forces for motion in motions]
    found = [
        (
            _friction(force, motion),
            float(np.ptp(force.values) * np.ptp(motion.values)),
            (force.vector, motion.vector),
        )
        for force, motion in pairs
    ]
    best = most_alike(found) if found else 0
    if not found or found[best][0].explained < EXPLAINED:
        lacking = [what for what, known in (('force', forces), ('motion', motions)) if not known]
        why = 'no force depends on the direction of a motion'
        if lacking:
            why = f'no varying {" or ".join(lacking)}'
        return [f'no friction found: {why}'], ''
    (explained, sense), (force, motion) = found[best][0], pairs[best]
    what = (
        f'{force.topic.name} {force.axis} is probably the force, {motion.topic.name} '
        f'{motion.axis} the motion: its direction and speed explain '
        f'{100.0 * explained:.0f} % of the force'
    )
    words = [what]
    if loss := clock_offset(force.samples, motion.samples)[1]:
        words.append(loss)
    words += oblique(motion.axis, motion.values, _across(motion, motions))
    words += tilted(force.axis, force.values, _across(force, forces))
    options = []
    for option, one, types in (
        ('--wrench-topic', force, _FORCE),
        ('--motion-topic', motion, reading.MOTIONS),
    ):
        if len([topic for topic in components if topic.type_name in types]) > 1:
            options += [option, one.topic.name]
    direction, scale = 1.0, 1.0
    if motion.axis == robot.get('hardware.joint') and motion.topic.type_name == wire.JOINT_STATE:
        direction, scale = robot['hardware.sign'], robot['hardware.scale']
    axis, more = _force_axis(force, sense * direction)
    words += more
    if axis != 'y':
        options += ['--force-axis', axis]
    usual = INSERTION if motion.topic.type_name == wire.JOINT_STATE else 'y'
    span = float(np.ptp(motion.values))
    if (direction, scale) != (1.0, 1.0):
        words.append(f'{motion.axis}: sign and scale of the robot, from the recorded parameters')
        options += ['--motion-axis', f'{"-" * (direction < 0.0)}{motion.axis}*{scale:.9g}']
    elif motion.topic.type_name not in _VELOCITIES and span > reading.LONGEST_STROKE:
        words.append(f'it moves over {span:.3g} m if it is in m: mm assumed')
        options += ['--motion-axis', f'{motion.axis}[mm]']
    elif motion.axis != usual and components[motion.topic] > 1:
        options += ['--motion-axis', motion.axis]
    command = shlex.join(['needle', 'identify', 'friction', str(path), *options])
    return words, command


def _force_axis(force: _Signal, sense: float) -> tuple[str, list[str]]:
    """Return the axis of the force with the sign of its sense and its unit, and their reasons."""
    axis, words = force.axis, [_UNSIGNED] * (not sense)
    if sense < 0.0:
        words.append('the force is opposite to the motion: sign reversed')
        axis = f'-{axis}'
    strength = float(np.ptp(force.values))
    if strength > reading.STRONGEST:
        words.append(f'it varies by {strength:.4g} N if it is in N: mN assumed')
        axis = f'{axis}[mN]'
    return axis, words


def _across(chosen: _Signal, signals: Sequence[_Signal]) -> dict[str, FloatArray]:
    """Return the other components of the vector of a component."""
    return {
        one.axis: one.values
        for one in signals
        if one.vector == chosen.vector and one.axis != chosen.axis
    }


def _friction(force: _Signal, motion: _Signal) -> Likeness:
    offset, _ = clock_offset(force.samples, motion.samples)
    stamps, moved = force.samples.stamps - offset, motion.samples.stamps
    both = (max(stamps[0], moved[0]) <= moved) & (moved <= min(stamps[-1], moved[-1]))
    if np.count_nonzero(both) < 2:
        return Likeness()
    time = 1e-9 * (moved[both] - moved[0])
    values = motion.values[both]
    is_velocity = motion.topic.type_name in _VELOCITIES
    velocity = values if is_velocity else velocity_of(time, values)
    return likeness(time, velocity, np.interp(time, 1e-9 * (stamps - moved[0]), force.values))
