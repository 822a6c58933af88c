# SPDX-License-Identifier: Apache-2.0
"""
Force and motion of a table.

Usually a row has both. A logger that is faster than the robot repeats each position for several
rows, and a logger of messages has force and position in different rows. In both cases the
positions are samples of their own, interpolated to the times of the force as those of a bag.
"""

from collections.abc import Collection, Mapping, Sequence
from itertools import pairwise, product
from typing import Final

from needle_dynamics.arrays import FloatArray, IntArray
from needle_identification.errors import RecordingError
from needle_identification.recordings.likeness import (
    EXPLAINED,
    likeness,
    most_alike,
    oblique,
    velocity_of,
)
from needle_identification.recordings.merging import merged_recording
from needle_identification.recordings.recording import integrated, Recording
from needle_identification.recordings.samples import Samples
from needle_identification.recordings.tables import (
    column_of,
    column_values,
    guessed,
    measured_values,
    plain_name,
    sorted_rows,
    Table,
)
from needle_ros.quantities import AXES
import numpy as np

_CHOSEN: Final = ('depth', 'force')  # roles that may have several components
_COUNTS: Final = 3.0  # least change in fast motion, as a multiple of the smallest one: one count
_FEWEST: Final = 20  # least number of such changes
_USUAL: Final = 0.9  # least part of them with the usual distance
_VARIATION: Final = 0.25  # usual variation of the distance [usual distances]
_IRREGULAR: Final = 0.01  # largest part of changes in successive rows
_NEXT: Final = 0.75  # least distance of a repetition to the next change [usual distances]


def friction_recording(table: Table, columns: Mapping[str, str]) -> Recording:
    """Return force and motion of a table; roles missing in `columns` are found by usual names."""
    specs = {**guessed(table.columns), **columns}
    if missing := missing_roles(specs):
        raise RecordingError(
            f'{table.path}: which column is {" and ".join(missing)}? It has '
            f'{", ".join(table.columns)}: use --columns {missing[0].split()[0]}=NAME,...'
        )
    return _read(table, friction_columns(table, specs, columns), columns)


def friction_columns(
    table: Table, specs: Mapping[str, str], given: Collection[str] = ()
) -> dict[str, str]:
    """Return columns with those components of position and force that are most like friction."""
    roles = [role for role in _CHOSEN if role in specs and role not in given]
    vectors = [_vector(table, specs[role]) or [specs[role]] for role in roles]
    tried = [{**specs, **dict(zip(roles, names, strict=True))} for names in product(*vectors)]
    if len(tried) == 1:
        return tried[0]
    found = []
    for one in tried:
        read = _read(table, one, one)
        like = likeness(read.time, velocity_of(read.time, read.depth), read.force)
        found.append((like, float(np.ptp(read.depth) * np.ptp(read.force)), ''))
    best = most_alike(found)
    if found[best][0].explained < EXPLAINED:
        several = [
            f'{role} is {", ".join(names)}'
            for role, names in zip(roles, vectors, strict=True)
            if len(names) > 1
        ]
        raise RecordingError(
            f'{table.path}: which {" and which ".join(several)}? No force depends on the '
            f'direction of a motion: use --columns {",".join(f"{role}=NAME" for role in roles)}'
        )
    return tried[best]


def _vector(table: Table, spec: str) -> list[str]:
    """Return the varying columns x, y and z of the vector with a column; none without a vector."""
    short = plain_name(column_of(table, spec))
    names = [
        name
        for name, values in table.columns.items()
        if (plain := plain_name(name))[:-1] == short[:-1]
        and plain[-1:] in AXES
        and np.ptp(measured_values(values)) > 0.0
    ]
    return names if short[-1:] in AXES else []


def _oblique(table: Table, spec: str) -> list[str]:
    name, names = column_of(table, spec), _vector(table, spec)
    if name not in names:
        return []
    columns = np.column_stack([table.columns[one] for one in names])
    columns = columns[np.isfinite(columns).all(axis=1)]
    others = dict(zip(names, columns.T, strict=True))
    return oblique(name, others.pop(name), others) if len(columns) else []


def _read(table: Table, specs: Mapping[str, str], columns: Collection[str]) -> Recording:
    path = table.path
    losses = list(table.losses)
    values = {role: column_values(table, role, spec, losses) for role, spec in specs.items()}
    if words := ', '.join(f'{role}={spec}' for role, spec in specs.items() if role not in columns):
        found = [specs[role] for role in _CHOSEN if role in specs and role not in columns]
        chosen = any(len(_vector(table, spec)) > 1 for spec in found)
        losses.append(f'columns by their names{" and values" if chosen else ""}: {words}')
    losses += _oblique(table, specs['depth']) if 'depth' in specs else []
    moving = [role for role in ('depth', 'speed') if role in values]
    time, force = values['time'], values['force'][:, np.newaxis]
    motion = np.column_stack([values[role] for role in moving])
    moved, loss = _own_rows(force[:, 0], motion)
    if loss:
        losses.append(loss)
        own = np.isfinite(force[:, 0])
        start, stamps, force = sorted_rows(path, time[own], force[own], losses)
        begin, others, motion = sorted_rows(path, time[moved], motion[moved], losses)
        none = np.zeros(1, dtype=np.int64)
        return merged_recording(
            table._replace(losses=losses),
            Samples('force', stamps, force, none),
            Samples(
                'motion',
                others + round(1e9 * (begin - start)),
                _placed(others, motion, moving, losses),
                none,
            ),
        )
    _, stamps, rows = sorted_rows(path, time, np.column_stack([force, motion]), losses)
    motion = _placed(stamps, rows[:, 1:], moving, losses)
    return Recording(
        name=str(path),
        time=1e-9 * (stamps - stamps[0]),
        depth=motion[:, 0],
        velocity=motion[:, 1] if motion.shape[1] > 1 else None,
        force=rows[:, 0],
        losses=tuple(losses),
    )


def _placed(
    stamps: IntArray, motion: FloatArray, roles: Sequence[str], losses: list[str]
) -> FloatArray:
    """Return a motion with its depth: without one the integral of the speed."""
    if 'depth' in roles:
        return motion
    losses.append('no depth: it is the integral of the speed from 0')
    speed = motion[:, 0]
    return np.column_stack([integrated(1e-9 * (stamps - stamps[0]), speed), speed])


def missing_roles(specs: Collection[str]) -> list[str]:
    """Return what friction needs in addition to the roles in ``specs``."""
    either = [] if {'depth', 'speed'} & {*specs} else ['depth or speed']
    return [role for role in ('time', 'force') if role not in specs] + either


def _own_rows(force: FloatArray, motion: FloatArray) -> tuple[IntArray, str]:
    """Return the rows in which a motion is measured, and a loss if the force has other rows."""
    forces, motions = np.isfinite(force), np.isfinite(motion).all(axis=1)
    many, both = np.count_nonzero(forces), np.count_nonzero(forces & motions)
    if 2 * both < many and np.count_nonzero(motions) > 1:
        what = f'force in {many} rows, motion in {np.count_nonzero(motions)}, both in {both}'
        return np.flatnonzero(motions), f'{what}: interpolated to the times of the force'
    rows = np.flatnonzero(forces & motions)
    kept, every = held_rows(motion[rows], force[rows])
    if every:
        words = f'the motion is measured in every {every} rows, and repeated in the others'
        return rows[kept], f'{words}: interpolated to the times of the force'
    return rows, ''


def held_rows(motion: FloatArray, force: FloatArray) -> tuple[IntArray, int]:
    """
    Return the rows in which a motion is measured, and their usual distance; 0 if in all rows.

    A motion, shape (n, k), of positions and perhaps speeds is repeated if it changes at regular
    distances of two or more rows while the force changes in between. At rest it does not change,
    and counts of an encoder in slow motion change by one count. Therefore only changes by
    several counts are regarded.
    """
    none = np.empty(0, dtype=np.int64), 0
    changed = np.flatnonzero(np.diff(motion, axis=0).any(axis=1)) + 1
    steps = np.abs(motion[changed, 0] - motion[changed - 1, 0])
    fast = steps > _COUNTS * steps[steps > 0.0].min(initial=np.inf)
    distances, successive = np.diff(changed), fast[1:] & fast[:-1]
    if np.count_nonzero(successive) < _FEWEST or np.mean(distances < 2) > _IRREGULAR:
        return none
    every = round(float(np.median(distances[successive])))
    # Clocks of a robot and a logger differ by up to a row, times of a robot vary.
    usual = np.abs(distances[successive] - every) <= max(1.0, _VARIATION * every)
    between = np.zeros(len(motion), dtype=np.bool_)
    for begin, end in zip(changed[:-1][successive], changed[1:][successive], strict=True):
        between[begin + 1 : end] = True
    if every < 2 or np.mean(usual) < _USUAL or not np.diff(force)[between[1:]].any():
        return none
    starts = [changed[0] % every, *changed, len(motion) + _NEXT * every]
    kept = [
        np.arange(begin, max(begin + 1, end - _NEXT * every), every)
        for begin, end in pairwise(starts)
    ]
    return np.concatenate(kept).astype(np.int64), every
