# SPDX-License-Identifier: Apache-2.0
"""
Find the columns of a steered insertion in a table, by their names and values.

A unit that no name states is that of another column of the same body, as in ``Base x`` and
``Base y``, else it is found by the size of the values: a needle is inserted by 25 mm to 1 m, the
tip moves along the needle as far as the needle, and sideways by less than 100 mm. A depth that
could be in cm or mm has no unit: the user must state it. Depth that decreases into the tissue is
inverted. Columns with times of their own, such as ``Base sec`` and ``Base nanosec`` for
``Base x``, are measured where these times change, and repeat the last measurement in all other
rows.
"""

from collections.abc import Mapping
from math import pi
import re
from typing import Final

from needle_dynamics.arrays import BoolArray, FloatArray
from needle_identification.errors import RecordingError
from needle_identification.recordings.tables import guessed, plain_name, Table, unit_of, UNITS
import numpy as np

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

_LARGE: Final = 1.0  # largest depth in m
_SMALL: Final = 25.0  # smallest depth in mm; between them the unit is cm or mm
_LATERAL: Final = 0.1  # largest lateral motion [m]
_FAR: Final = 2.0  # largest distance from the origin of a frame [m]
_TURNS: Final = 4.0 * pi  #: largest roll [rad]
_ALONG: Final = 0.5  # least motion of the tip along the needle over the insertion
_TIP_ALONG: Final = {'along': ('tipy', 'ytip', 'tip2')}  # position along the needle
_MOVED: Final = ('depth', 'guide_x', 'guide_z')
_COMPONENT: Final = re.compile(r'[\s._-]*[xyz]$', re.IGNORECASE)  # ``x`` of ``Base x``


def steering_columns(table: Table, given: Mapping[str, str] | None = None) -> dict[str, str]:
    """Return the columns by role that are given or found, with sign and unit: ``--columns``."""
    given, found = given or {}, guessed(table.columns, USUAL)
    names = {**found, **{role: _column_of(table, spec) for role, spec in given.items()}}
    specs = {role: names[role] for role in STEERING_ROLES if names.get(role) in table.columns}
    if 'depth' not in specs:
        return {**specs, **given}
    units = _units(table, specs, given)
    depth = _measured(table.columns[specs['depth']])
    for role, unit in units.items():
        if unit_of(specs[role], role) is None and unit:
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
    if name not in table.columns or unit_of(name, 'depth') is not None:
        return
    if (span := float(np.ptp(_measured(table.columns[name])))) > _LARGE:
        raise RecordingError(
            f'{table.path}: {name} spans {span:.3g} without a unit, mm or cm: '
            f"use --columns 'depth={spec}[mm]' or 'depth={spec}[cm]'"
        )


def _units(table: Table, specs: Mapping[str, str], given: Mapping[str, str]) -> dict[str, str]:
    """Return the unit of each role, '' if unknown or in SI units."""
    stated = {role: unit_of(given.get(role, name), role) for role, name in specs.items()}
    moved = {role: _measured(table.columns[name]) for role, name in specs.items()}
    bodies = {
        role: re.sub(r'^[xyz]|[xyz123]$', '', plain_name(name)) for role, name in specs.items()
    }
    span = float(np.ptp(moved['depth']))
    deep = stated['depth'] or ('' if span <= _LARGE else 'mm' if span >= _SMALL else None)
    found = {'depth': deep or ''}
    for group in (('guide_x', 'guide_z'), ('tip_x', 'tip_z')):
        roles = [role for role in group if role in specs]
        known = {unit for role in roles if (unit := stated[role]) is not None}
        if not known and any(bodies[role] == bodies['depth'] for role in roles):
            known = {found['depth']}
        if not known and 'tip_x' in group and deep is not None:
            known = _along(table, span * UNITS['depth'][deep or 'm'])
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


def _along(table: Table, depth: float) -> set[str]:
    """Return the unit in which the tip moves along the needle by the depth [m], if any."""
    names = guessed(table.columns, _TIP_ALONG)
    if 'along' not in names or not depth:
        return set()
    span = float(np.ptp(_measured(table.columns[names['along']])))
    for unit in ('m', 'cm', 'mm'):
        if _ALONG < span * UNITS['depth'][unit] / depth < 1.0 / _ALONG:
            return {'' if unit == 'm' else unit}
    return set()


def new_rows(table: Table, specs: Mapping[str, str]) -> tuple[BoolArray, list[str]]:
    """Return in which rows guide and depth are measured, and the columns of their times."""
    rows = len(next(iter(table.columns.values())))
    moved = [_column_of(table, specs[role]) for role in _MOVED if role in specs]
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


def _measured(column: FloatArray) -> FloatArray:
    """Return the values of a column without those that are missing, at least one."""
    found = column[np.isfinite(column)]
    return found if len(found) else np.zeros(1)


def _column_of(table: Table, spec: str) -> str:
    """Return the name of a column without sign, factor, unit and shift."""
    if spec in table.columns:
        return spec
    return re.split(r'\s*[*\[@]', spec.lstrip('-'), maxsplit=1)[0].strip()
