"""
Steered insertions in tables with named columns.

The roles are ``depth``, ``guide_x``, ``guide_z``, ``tip_x`` and ``tip_z``, and ``roll`` if the
needle was turned. Signs, units and factors are those of all tables; ``@1`` behind a column takes
its value from one row before: ``guide_x=base.x[mm]@1``.
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

#: Roles of the columns; without a roll the needle was not turned.
STEERING_ROLES: Final = ('depth', 'guide_x', 'guide_z', 'tip_x', 'tip_z', 'roll')

#: Usual names of columns by role, in small letters and without signs.
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
    """
    Read an insertion from a table.

    Parameters
    ----------
    path : Path or str
        The file.
    columns : mapping of str to str
        Columns by role, of `STEERING_ROLES`; what is not given is found by the usual names.
    medium : str
        Name of the tissue.

    Returns
    -------
    SteeringRecording
        The insertion; its ``losses`` say what was taken, left out or repaired.

    Raises
    ------
    RecordingError
        If a column is missing or not usable.

    """
    path = Path(path)
    table = read_table(path)
    specs = {**guessed(table, _USUAL), **columns}
    specs = {role: specs[role] for role in STEERING_ROLES if role in specs}
    missing = [role for role in STEERING_ROLES if role not in specs and role != 'roll']
    if missing:
        raise RecordingError(
            f'{path}: which column is {" and ".join(missing)}? It has '
            f'{", ".join(table.columns)}: say --columns {missing[0]}=NAME,...'
        )
    losses = list(table.losses)
    if words := ', '.join(f'{role}={spec}' for role, spec in specs.items() if role not in columns):
        losses.append(f'columns by their names: {words}')
    values = {role: _shifted(table, role, spec, losses) for role, spec in specs.items()}
    moved = np.column_stack([values[role] for role in specs if not role.startswith('tip')])
    usable = np.isfinite(moved).all(axis=1)
    if lost := int(np.count_nonzero(~usable)):
        losses.append(f'{lost} rows with a value that is no number, left out')
    if np.count_nonzero(usable) < 2:
        raise RecordingError('; '.join([f'{path} has fewer than 2 usable rows', *losses]))
    values = {role: column[usable] for role, column in values.items()}
    return recorded_insertion(path, medium, values, losses)


def _shifted(table: Table, role: str, spec: str, losses: list[str]) -> FloatArray:
    """Return the values of a column, perhaps from rows before; the first then counts again."""
    rows = 0
    if spec not in table.columns and (match := _SHIFTED.match(spec)):
        spec, rows = match[1], int(match[2])
    found = column_values(table, role, spec, losses)
    at = np.maximum(np.arange(len(found)) - rows, 0)
    return np.asarray(found[at])
