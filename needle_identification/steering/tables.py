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
from needle_identification.steering.recording import credible, SteeringRecording
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

#: A first depth beyond this is that of another origin than the skin [m].
_AT_THE_SKIN: Final = 0.03

#: A robot at rest on the skin may be so far above it [m].
_JITTER: Final = 1e-3


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
    depth = values['depth']
    if not 0.0 <= depth[0] <= _AT_THE_SKIN or depth.min() < 0.0:
        losses.append(f'depths from the first, {1e3 * depth[0]:.4g} mm, which is at the skin')
        depth = depth - depth[0]
    if depth.min() < -_JITTER:
        raise RecordingError(
            f'{path}: depth goes from the first row to {1e3 * depth.min():.4g} mm, out of the '
            f'skin: if it counts out of the tissue, say --columns depth=-NAME'
        )
    guide = np.column_stack([values['guide_x'], values['guide_z']])
    tip = np.column_stack([values['tip_x'], values['tip_z']])
    known = tip[np.isfinite(tip).all(axis=1)]
    if not len(known):
        raise RecordingError(f'{path}: no row has a position of the tip')
    good, wrong = credible(depth, guide - guide[0], tip - known[0])
    tip[~good] = np.nan
    return SteeringRecording(
        name=str(path),
        medium=medium,
        depth=np.maximum(depth, 0.0),
        guide=guide,
        roll=values.get('roll', np.zeros(len(depth))),
        tip=tip,
        losses=(*losses, *wrong),
    )


def _shifted(table: Table, role: str, spec: str, losses: list[str]) -> FloatArray:
    """Return the values of a column, perhaps from rows before; the first then counts again."""
    rows = 0
    if spec not in table.columns and (match := _SHIFTED.match(spec)):
        spec, rows = match[1], int(match[2])
    found = column_values(table, role, spec, losses)
    at = np.maximum(np.arange(len(found)) - rows, 0)
    return np.asarray(found[at])
