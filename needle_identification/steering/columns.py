# SPDX-License-Identifier: Apache-2.0
"""
Find the columns of a steered insertion in a table, by their names and values.

A unit that no name states is found by the size of the values: a needle is inserted by less than
a meter. Depth that decreases into the tissue is inverted. Columns with times of their own, such as
``Base sec`` and ``Base nanosec`` for ``Base x``, are measured where these times change, and repeat
the last measurement in all other rows.
"""

from __future__ import annotations

from collections.abc import Mapping
import re
from typing import Final

from needle_dynamics.arrays import BoolArray, FloatArray
from needle_identification.recordings.tables import guessed, Table, unit_of
import numpy as np

#: Roles of the columns; without a roll column the roll is zero.
STEERING_ROLES: Final = ('depth', 'guide_x', 'guide_z', 'tip_x', 'tip_z', 'roll')

#: Usual column names by role, in lower case without separators.
_USUAL: Final = {
    'depth': ('depth', 'insertion', 'insertiondepth', 'guidey', 'basey', 'robot', 'tipy'),
    'guide_x': ('guidex', 'basex', 'xguide', 'xbase'),
    'guide_z': ('guidez', 'basez', 'zguide', 'zbase'),
    'tip_x': ('tipx', 'xtip'),
    'tip_z': ('tipz', 'ztip'),
    'roll': ('roll', 'rotation', 'theta'),
}

#: Change of a position that is too large for one in m.
_LARGE: Final = 1.0

_MOVED: Final = ('depth', 'guide_x', 'guide_z')

#: Last part of the name of a component, such as ``x`` of ``Base x``.
_COMPONENT: Final = re.compile(r'[\s._-]*[xyz]$', re.IGNORECASE)


def steering_columns(table: Table) -> dict[str, str]:
    """Return the columns by role that are found, with sign and unit, as in ``--columns``."""
    found = guessed(table, _USUAL)
    specs: dict[str, str] = {role: found[role] for role in STEERING_ROLES if role in found}
    if 'depth' not in specs:
        return specs
    depth = _measured(table.columns[specs['depth']])
    deep = np.ptp(depth) > _LARGE
    for role, name in specs.items():
        stated = unit_of(name, role) is not None or role == 'roll'
        if not stated and (deep or np.ptp(_measured(table.columns[name])) > _LARGE):
            specs[role] = f'{name}[mm]'
    from_start = depth - depth[np.argmax(depth != 0.0)]
    if from_start.max() < -from_start.min():
        specs['depth'] = f'-{specs["depth"]}'
    return specs


def new_rows(table: Table, specs: Mapping[str, str]) -> tuple[BoolArray, list[str]]:
    """Return in which rows guide and depth are measured, and the columns of their times."""
    rows = len(next(iter(table.columns.values())))
    words = [re.escape(word) for word in _sources(specs)]
    own = re.compile(rf'(?:{"|".join(words)})[\s._-]*n?(?:ano)?secs?', re.IGNORECASE)
    times = [name for name in table.columns if words and own.fullmatch(name.strip())]
    if not times:
        return np.ones(rows, dtype=np.bool_), []
    read = np.column_stack([table.columns[name] for name in times])
    new = (read != 0.0).any(axis=1) & np.isfinite(read).all(axis=1)
    new[1:] &= (read[1:] != read[:-1]).any(axis=1)
    return new, times


def _measured(column: FloatArray) -> FloatArray:
    """Return the values of a column without those that are missing, at least one."""
    found = column[np.isfinite(column)]
    return found if len(found) else np.zeros(1)


def _sources(specs: Mapping[str, str]) -> set[str]:
    """Return the names of the measured bodies, such as ``Base`` for ``Base x``."""
    moved = [specs[role].lstrip('-').removesuffix('[mm]') for role in _MOVED if role in specs]
    return {part for name in moved if (part := _COMPONENT.sub('', name)) not in ('', name)}
