# SPDX-License-Identifier: Apache-2.0
"""
Read steered insertions from bags, and from tables with named columns.

Signs, units and factors of columns are written as in other tables; the suffix ``@1`` takes values
from the previous row: ``guide_x=base.x[mm]@1``.
"""

from collections.abc import Mapping
from pathlib import Path
import re
from typing import Final

from needle_dynamics.arrays import FloatArray
from needle_identification.bags.bag import Bag
from needle_identification.errors import RecordingError
from needle_identification.recordings import reading
from needle_identification.recordings.samples import EachJoint, source_of
from needle_identification.recordings.tables import column_values, is_table, read_table, Table
from needle_identification.recordings.timebase import merge
from needle_identification.steering.columns import (
    check_depth,
    new_rows,
    steering_columns,
    STEERING_ROLES,
)
from needle_identification.steering.recording import recorded_insertion, SteeringRecording
from needle_ros import contract, wire
from needle_ros.axes import signed, signed_axis
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
    if is_table(path):
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
    _, tips, moved, _ = merge(bag, gathered[tip].samples(bag), gathered[motion].samples(bag))
    losses = list(bag.losses)
    for name, column in zip(tilts, moved[:, len(joints) :].T, strict=True):
        if (change := float(np.ptp(column))) > _MOVED:
            losses.append(f'{name} moves by {change:.3g} rad, which is ignored')
    both = np.hstack([tips, moved[:, : len(joints)]])
    signs = [sign for sign, _ in (*axes.values(), *joints.values())]
    values = dict(zip([*axes, *joints], (both * signs).T, strict=True))
    return recorded_insertion(path, medium, values, losses)


def _of_table(path: Path, columns: Mapping[str, str], medium: str) -> SteeringRecording:
    """Read a table; roles missing in ``columns`` are found by names and values."""
    table = read_table(path)
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
    if np.count_nonzero(usable & new) < 2:
        raise RecordingError('; '.join([f'{path} has fewer than 2 usable rows', *losses]))
    values = {role: column[usable & new] for role, column in values.items()}
    return recorded_insertion(path, medium, values, losses)


def _shifted(table: Table, role: str, spec: str, losses: list[str]) -> FloatArray:
    """Return the values of a column, shifted by rows; the first value is repeated."""
    rows = 0
    if spec not in table.columns and (match := _SHIFTED.match(spec)):
        spec, rows = match[1], int(match[2])
    found = column_values(table, role, spec, losses)
    at = np.maximum(np.arange(len(found)) - rows, 0)
    return np.asarray(found[at])
