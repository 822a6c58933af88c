# SPDX-License-Identifier: Apache-2.0
"""
Read steered insertions from bags, and from tables with named columns.

Signs, units and factors of columns are written as in other tables; the suffix ``@1`` takes values
from the previous row: ``guide_x=base.x[mm]@1``. Columns are found by their names and values.

A unit that no name states is that of another column of the same body, as in ``Base x`` and
``Base y``, else it is found by the size of the values: a needle is inserted by 25 mm to 1 m, the
tip moves along the needle as far as the needle, and sideways by less than 100 mm. A depth that
could be in cm or mm has no unit: the user must state it. Depth that decreases into the tissue is
inverted. Columns with times of their own, such as ``Base sec`` and ``Base nanosec`` for
``Base x``, are measured where these times change, and repeat the last measurement in all other
rows.
"""

from collections.abc import Mapping
from itertools import pairwise
from math import pi
from pathlib import Path
import re
from typing import Final

from needle_dynamics.arrays import BoolArray, FloatArray
from needle_identification.bags.bag import Bag
from needle_identification.errors import RecordingError
from needle_identification.recordings import reading, tables
from needle_identification.recordings.merging import merge
from needle_identification.recordings.samples import EachJoint, source_of
from needle_identification.recordings.tables import Table
from needle_identification.sensor.checks import zero_rows
from needle_identification.steering.recording import (
    DEEPEST,
    JITTER,
    recorded_insertion,
    SteeringRecording,
)
from needle_ros import contract, wire
from needle_ros.column_units import states_unit, unit_of, UNITS
from needle_ros.quantities import signed, signed_axis
import numpy as np

_MOTION: Final = reading.Wanted('motion_topic', (wire.JOINT_STATE,), (contract.JOINT_STATES.name,))

#: Joints by role.
JOINTS: Final = {
    'depth': contract.INSERTION,
    'guide_x': contract.GUIDE_X,
    'guide_z': contract.GUIDE_Z,
    'roll': contract.ROLL,
}

_TIPS: Final = {'tip_x': 'x', 'tip_z': 'z'}  # components of the tip by role
_TILTS: Final = (contract.TILT_X, contract.TILT_Z)

_MOVED: Final = 1e-4  # largest change of a constant tilt [rad]

_SHIFTED: Final = re.compile(r'^(.*?)\s*@\s*(\d{1,6})$')

#: Roles of the columns; without a roll column the roll is zero.
STEERING_ROLES: Final = ('depth', 'guide_x', 'guide_z', 'tip_x', 'tip_z', 'roll')

#: Usual column names by role, in lower case without separators; numbers are columns of a matrix.
USUAL: Final = {
    'depth': ('depth', 'insertion', 'insertiondepth', 'guidey', 'basey', 'guide2', 'base2'),
    'guide_x': ('guidex', 'basex', 'xguide', 'xbase', 'guide1', 'base1'),
    'guide_z': ('guidez', 'basez', 'zguide', 'zbase', 'guide3', 'base3'),
    'tip_x': ('tipx', 'xtip', 'tip1'),
    'tip_z': ('tipz', 'ztip', 'tip3'),
    'roll': ('roll', 'rotation', 'theta'),
}

_SMALL: Final = 25.0  # smallest depth in mm; from `DEEPEST` to it the unit is cm or mm
_LATERAL: Final = 0.1  # largest lateral motion [m]
_FAR: Final = 2.0  # largest distance from the origin of a frame [m]
_TURNS: Final = 4.0 * pi  #: largest roll [rad]
_ALONG: Final = 0.5  # least motion of the tip along the needle over the insertion
TIP_ALONG: Final = {'along': ('tipy', 'ytip', 'tip2')}  #: Position along the needle.
_RUN: Final = 10  # least mean number of rows of each of several insertions in one table
_OUTSIDE: Final = 0.1  # depth of a needle that is withdrawn, as a part of the deepest
_INSIDE: Final = 0.25  # depth of an insertion, as a part of the deepest
_FALL: Final = 0.2  # fall of the depth in one row to another insertion, as a part of the deepest
_MOVED_ROLES: Final = ('depth', 'guide_x', 'guide_z')
_COMPONENT: Final = re.compile(r'[\s._-]*[xyz]$', re.IGNORECASE)  # ``x`` of ``Base x``


def read_steering_recording(
    path: Path | str,
    *,
    medium: str = '',
    tip_topic: str | None = None,
    motion_topic: str | None = None,
    time: str = 'header',
    columns: Mapping[str, str] | None = None,
) -> SteeringRecording:
    """
    Read an insertion with guide motion or needle rotation.

    Parameters
    ----------
    path : Path or str
        A bag, as in `read_friction_recording`, or a table.
    medium : str
        Name of the tissue.
    tip_topic : str, optional
        Topic of the tip, PointStamped or PoseStamped; default the only topic of these types, or
        the topic with the last name tip_deflection.
    motion_topic : str, optional
        Topic of the joints, a JointState; default the only topic of this type, or the topic with
        the last name joint_states.
    time : str
        Stamps to use, one of `TIMES`.
    columns : mapping of str to str, optional
        By role, of `STEERING_ROLES`: columns of a table, see `tables`; for a bag, the joints of
        depth, guide and roll, and the axes x, y or z of the tip, optionally with a prefix ``-``.

    Returns
    -------
    SteeringRecording
        The insertion; its ``losses`` list discarded and corrected data.

    Raises
    ------
    RecordingError
        If the file is not readable, or lacks a topic, a joint or a column.

    """
    path, columns = Path(path), columns or {}
    if tables.is_table(path):
        for option, given in (('--tip-topic', tip_topic), ('--motion-topic', motion_topic)):
            if given is not None:
                raise RecordingError(f'{path} is a table: --columns takes the place of {option}')
        return _of_table(path, columns, medium)
    bag = Bag(path)
    topics = bag.topics()
    tip = reading.chosen_topic(bag, topics, reading.TIP, tip_topic)
    motion = reading.chosen_topic(bag, topics, _MOTION, motion_topic)
    present = {name for names in reading.first_names(bag, motion) for name in names}
    joints = {role: signed(columns.get(role, name)) for role, name in JOINTS.items()}
    if 'roll' not in columns and contract.ROLL not in present:
        del joints['roll']
    if missing := {name for _, name in joints.values()} - present:
        raise RecordingError(
            f'{path}: {motion.name} has no joint {" nor ".join(sorted(missing))}, it has '
            f'{", ".join(sorted(present)) or "none"}: use --columns guide_x=JOINT,...'
        )
    axes = {role: signed_axis(columns.get(role, axis), role) for role, axis in _TIPS.items()}
    tilts = [name for name in _TILTS if name in present]
    sources = {
        tip: source_of(tip.type_name, [axis for _, axis in axes.values()]),
        motion: EachJoint(*(name for _, name in joints.values()), *tilts),
    }
    gathered, _ = reading.read_samples(bag, sources, time)
    at, tips, moved, _ = merge(bag, gathered[tip].samples(bag), gathered[motion].samples(bag))
    losses = list(bag.losses)
    for name, column in zip(tilts, moved[:, len(joints) :].T, strict=True):
        if (change := float(np.ptp(column))) > _MOVED:
            losses.append(f'{name} moves by {change:.3g} rad, which is ignored')
    both = np.hstack([tips, moved[:, : len(joints)]])
    signs = [sign for sign, _ in (*axes.values(), *joints.values())]
    values = dict(zip([*axes, *joints], (both * signs).T, strict=True))
    advice = f'is {joints["depth"][1]} in m?'
    found = recorded_insertion(path, medium, values, losses, advice)
    if not (again := _second_insertion(found.depth)):
        return found
    # Samples are left out at the start only.
    count = again + len(at) - len(found.depth)
    losses.append(f'a second insertion begins {at[count]:.3g} s after the start, left out')
    values = {role: column[:count] for role, column in values.items()}
    return recorded_insertion(path, medium, values, losses, advice)


def _of_table(path: Path, columns: Mapping[str, str], medium: str) -> SteeringRecording:
    """Read a table; roles missing in ``columns`` are found by names and values."""
    table = tables.read_table(path)
    specs = steering_columns(table, columns)
    specs = {role: specs[role] for role in STEERING_ROLES if role in specs}
    missing = [role for role in STEERING_ROLES if role not in specs and role != 'roll']
    if missing:
        raise RecordingError(
            f'{path}: no column found for {" and ".join(missing)}, it has '
            f'{", ".join(table.columns)}: use --columns {missing[0]}=NAME,...'
        )
    losses = list(table.losses)
    if words := ', '.join(f'{role}={spec}' for role, spec in specs.items() if role not in columns):
        losses.append(f'columns by their names and values: {words}')
    if 'depth' not in columns:
        check_depth(table, specs['depth'])
    new, times = new_rows(table, specs)
    if times:
        losses.append(f'rows in which {" or ".join(times)} changes: {np.count_nonzero(new)}')
    values = {role: _shifted(table, role, spec, losses) for role, spec in specs.items()}
    moved = np.column_stack([values[role] for role in specs if not role.startswith('tip')])
    usable = np.isfinite(moved).all(axis=1)
    if lost := int(np.count_nonzero(~usable)):
        losses.append(f'{lost} rows with a value that is not a number, left out')
    used = usable & new
    if np.count_nonzero(used) < 2:
        raise RecordingError('; '.join([f'{path} has fewer than 2 usable rows', *losses]))
    _check_time(table, used)
    values = {role: column[used] for role, column in values.items()}
    spec = specs['depth']
    name = f'{"-" * spec.startswith("-")}{tables.column_of(table, spec)}'
    advice = f"is {spec} in mm? Use --columns 'depth={name}[mm]'"
    found = recorded_insertion(path, medium, values, losses, advice)
    again = min(
        filter(None, (_second_insertion(found.depth), _begun_again(found.depth))), default=0
    )
    if again:
        # Rows are left out at the start only.
        row = int(np.flatnonzero(used)[again - len(found.depth)]) + 1
        raise RecordingError(
            f'{path}: a second insertion starts at row {row} of {len(used)}, with a depth of '
            f'{1e3 * found.depth[again]:.3g} mm after {1e3 * found.depth[:again].max():.3g} mm: '
            'split the file, one for each insertion'
        )
    return found


def _check_time(table: Table, used: BoolArray) -> None:
    """Raise a RecordingError if a column of time, with any unit, begins again."""
    spec = tables.guessed(table.columns, {'time': tables.TIME_NAMES}).get('time')
    if spec is None:
        return
    time = table.columns.get(spec)
    if time is None:
        time = tables.column_values(table, 'time', spec, [])
    tables.check_restart(table.path, time, used & np.isfinite(time), _RUN)


def _second_insertion(depth: FloatArray) -> int:
    """Return the row at which a needle outside is inserted again, else 0."""
    (inside,) = np.nonzero(depth > _INSIDE * depth.max())
    for begin, end in pairwise(inside.tolist()):
        between = depth[begin:end]
        if between.min() < _OUTSIDE * depth.max():
            # The last row before the insertion.
            return int(end - 1 - np.argmin(between[::-1]))
    return 0


def _begun_again(depth: FloatArray) -> int:
    """Return the row to which a depth falls at once and from which it grows, else 0."""
    least = _FALL * depth.max()
    falls = np.diff(depth, prepend=depth[0]) < -least
    # Two falls, one after the other, are a withdrawal in long steps.
    for row in np.flatnonzero(falls[1:] & ~falls[:-1]) + 1:
        later = depth[row:] - depth[row]
        grown = int(np.argmax(later > least))
        if grown and later[:grown].min() > -JITTER:
            return int(row)
    return 0


def _shifted(table: Table, role: str, spec: str, losses: list[str]) -> FloatArray:
    """Return the values of a column, shifted by rows; the first value is repeated."""
    rows = 0
    if spec not in table.columns and (match := _SHIFTED.match(spec)):
        spec, rows = match[1], int(match[2])
    found = tables.column_values(table, role, spec, losses)
    at = np.maximum(np.arange(len(found)) - rows, 0)
    return np.asarray(found[at])


def steering_columns(table: Table, given: Mapping[str, str] | None = None) -> dict[str, str]:
    """Return the columns by role that are given or found, with sign and unit: ``--columns``."""
    given, found = given or {}, tables.guessed(table.columns, USUAL)
    names = {**found, **{role: tables.column_of(table, spec) for role, spec in given.items()}}
    specs = {role: names[role] for role in STEERING_ROLES if names.get(role) in table.columns}
    if 'depth' not in specs:
        return {**specs, **given}
    units = _units(table, specs, given)
    depth = tables.measured_values(table.columns[specs['depth']])
    for role, unit in units.items():
        if unit and not states_unit(specs[role], role):
            specs[role] = f'{specs[role]}[{unit}]'
    if is_inverted(depth):
        specs['depth'] = f'-{specs["depth"]}'
    return {**specs, **given}


def is_inverted(depth: FloatArray) -> bool:
    """Return whether a depth decreases into the tissue; zeros before its start do not count."""
    from_start = depth - depth[np.argmax(depth != 0.0)]
    return bool(from_start.max() < -from_start.min())


def check_depth(table: Table, spec: str) -> None:
    """Raise a RecordingError if the unit of a depth that was found is not known."""
    name = spec.lstrip('-')
    if name not in table.columns or states_unit(name, 'depth'):
        return
    if (span := float(np.ptp(tables.measured_values(table.columns[name])))) > DEEPEST:
        raise RecordingError(
            f'{table.path}: {name} spans {span:.3g} without a unit, mm or cm: '
            f"use --columns 'depth={spec}[mm]' or 'depth={spec}[cm]'"
        )


def _units(table: Table, specs: Mapping[str, str], given: Mapping[str, str]) -> dict[str, str]:
    """Return the unit of each role, '' if unknown or in SI units."""
    stated = {role: unit_of(given.get(role, name), role) for role, name in specs.items()}
    tips = [table.columns[specs[role]] for role in _TIPS if role in specs]
    seen = ~zero_rows(np.column_stack(tips)) if tips else slice(None)
    moved = {
        role: tables.measured_values(table.columns[name][seen if role in _TIPS else slice(None)])
        for role, name in specs.items()
    }
    bodies = {
        role: re.sub(r'^[xyz]|[xyz123]$', '', tables.plain_name(name))
        for role, name in specs.items()
    }
    span = float(np.ptp(moved['depth']))
    deep = stated['depth'] or ('' if span <= DEEPEST else 'mm' if span >= _SMALL else None)
    found = {'depth': deep or ''}
    for group in (('guide_x', 'guide_z'), ('tip_x', 'tip_z')):
        roles = [role for role in group if role in specs]
        known = {unit for role in roles if (unit := stated[role]) is not None}
        if not known and any(bodies[role] == bodies['depth'] for role in roles):
            known = {found['depth']}
        if not known and 'tip_x' in group and deep is not None:
            known = _along(table, span * UNITS['depth'][deep or 'm'], seen)
        if not known:
            large = any(
                np.ptp(moved[role]) > _LATERAL or np.abs(moved[role]).max() > _FAR
                for role in roles
            )
            known = {'mm' if large else ''}
        for role in roles:
            found[role] = stated[role] or min(known)
    if 'roll' in specs:
        turned = np.abs(moved['roll']).max() > _TURNS
        found['roll'] = stated['roll'] or ('deg' if turned else '')
    return found


def _along(table: Table, depth: float, seen: BoolArray | slice) -> set[str]:
    """Return the unit in which the tip moves along the needle by the depth [m], if any."""
    names = tables.guessed(table.columns, TIP_ALONG)
    if 'along' not in names or not depth:
        return set()
    span = float(np.ptp(tables.measured_values(table.columns[names['along']][seen])))
    for unit in ('m', 'cm', 'mm'):
        if _ALONG < span * UNITS['depth'][unit] / depth < 1.0 / _ALONG:
            return {'' if unit == 'm' else unit}
    return set()


def new_rows(table: Table, specs: Mapping[str, str]) -> tuple[BoolArray, list[str]]:
    """Return in which rows guide and depth are measured, and the columns of their times."""
    rows = len(next(iter(table.columns.values())))
    moved = [tables.column_of(table, specs[role]) for role in _MOVED_ROLES if role in specs]
    # Measured bodies, such as ``Base`` for ``Base x``.
    bodies = {part for name in moved if (part := _COMPONENT.sub('', name)) not in ('', name)}
    words = [re.escape(word) for word in bodies]
    own = re.compile(rf'(?:{"|".join(words)})[\s._-]*n?(?:ano)?secs?', re.IGNORECASE)
    times = [name for name in table.columns if words and own.fullmatch(name.strip())]
    if not times:
        return np.ones(rows, dtype=np.bool_), []
    read = np.column_stack([table.columns[name] for name in times])
    new = (read != 0.0).any(axis=1) & np.isfinite(read).all(axis=1)
    new[1:] &= (read[1:] != read[:-1]).any(axis=1)
    return new, times
