"""
Read steered insertions from tables with named columns.

The roles are ``depth``, ``guide_x``, ``guide_z``, ``tip_x`` and ``tip_z``, and ``roll`` for a
rotated needle. Signs, units and factors are written as in other tables; the suffix ``@1`` takes
values from the previous row: ``guide_x=base.x[mm]@1``.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
import re
from typing import Final

from needle_dynamics.arrays import FloatArray
from needle_identification.errors import RecordingError
from needle_identification.recordings.tables import column_values, guessed, read_table, Table
from needle_identification.steering.recording import recorded_insertion, SteeringRecording
import numpy as np

#: Roles of the columns; without a roll column the roll is zero.
STEERING_ROLES: Final = ('depth', 'guide_x', 'guide_z', 'tip_x', 'tip_z', 'roll')

#: Usual column names by role, in lower case without separators.
_USUAL: Final = {
    'depth': ('depth', 'insertion', 'insertiondepth', 'tipy', 'robot'),
    'guide_x': ('guidex', 'basex', 'xguide', 'xbase'),
    'guide_z': ('guidez', 'basez', 'zguide', 'zbase'),
    'tip_x': ('tipx', 'xtip'),
    'tip_z': ('tipz', 'ztip'),
    'roll': ('roll', 'rotation', 'theta'),
}

_SHIFTED: Final = re.compile(r'^(.*?)\s*@\s*(\d{1,6})$')


def read_steering_table(
    path: Path | str, columns: Mapping[str, str], medium: str = ''
) -> SteeringRecording:
    """Read an insertion from a table; roles missing in ``columns`` are found by usual names."""
    path = Path(path)
    table = read_table(path)
    specs = {**guessed(table, _USUAL), **columns}
    specs = {role: specs[role] for role in STEERING_ROLES if role in specs}
    missing = [role for role in STEERING_ROLES if role not in specs and role != 'roll']
    if missing:
        raise RecordingError(
            f'{path}: no column found for {" and ".join(missing)}, it has '
            f'{", ".join(table.columns)}: use --columns {missing[0]}=NAME,...'
        )
    losses = list(table.losses)
    if words := ', '.join(f'{role}={spec}' for role, spec in specs.items() if role not in columns):
        losses.append(f'columns by their names: {words}')
    values = {role: _shifted(table, role, spec, losses) for role, spec in specs.items()}
    moved = np.column_stack([values[role] for role in specs if not role.startswith('tip')])
    usable = np.isfinite(moved).all(axis=1)
    if lost := int(np.count_nonzero(~usable)):
        losses.append(f'{lost} rows with a value that is not a number, left out')
    if np.count_nonzero(usable) < 2:
        raise RecordingError('; '.join([f'{path} has fewer than 2 usable rows', *losses]))
    values = {role: column[usable] for role, column in values.items()}
    return recorded_insertion(path, medium, values, losses)


def _shifted(table: Table, role: str, spec: str, losses: list[str]) -> FloatArray:
    """Return the values of a column, shifted by rows; the first value is repeated."""
    rows = 0
    if spec not in table.columns and (match := _SHIFTED.match(spec)):
        spec, rows = match[1], int(match[2])
    found = column_values(table, role, spec, losses)
    at = np.maximum(np.arange(len(found)) - rows, 0)
    return np.asarray(found[at])
