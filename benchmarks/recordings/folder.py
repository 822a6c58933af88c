# SPDX-License-Identifier: Apache-2.0
"""
Read recorded insertions in steps from the tables of a folder.

A table has one row for each time, with these columns: ``Base x``, ``Base y``, ``Base z`` [mm],
position of the guide and, with a negative sign, the depth at the last step; ``Base sec`` and
``Base nanosec``, the time of this step; ``Tip x``, ``Tip z`` [mm], filtered position of the tip. A
step is the first row with a new time of the base; rows between two steps are no further
measurements. The name of a file is the name of its medium, an underscore, and a number.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final, NamedTuple

from needle_identification import RecordingError, SteeringRecording
from needle_identification.recordings.tables import column_values, read_table
from needle_identification.steering.recording import recorded_insertion
from needle_ros.errors import ParameterError
import numpy as np

_COLUMNS: Final = {
    'depth': '-Base y[mm]',
    'guide_x': 'Base x[mm]',
    'guide_z': 'Base z[mm]',
    'tip_x': 'Tip x[mm]',
    'tip_z': 'Tip z[mm]',
}
_TIMES: Final = ('Base sec', 'Base nanosec')

#: Least number of steps of an insertion.
_STEPS: Final = 20

#: Motion of a guide at rest [m].
_REST: Final = 1e-4


class RecordedInsertions(NamedTuple):
    """
    Recorded insertions of a folder.

    Attributes
    ----------
    media : dict
        Insertions by medium.
    left_out : list of str
        Files that are not used, with the reason.

    """

    media: dict[str, list[SteeringRecording]]
    left_out: list[str]


def medium_of(path: Path) -> str:
    """Return the medium of a file by its name."""
    return path.stem.rpartition('_')[0]


def read_insertion(path: Path) -> SteeringRecording:
    """Read the steps of an insertion; guide and tip are relative to the first step."""
    table = read_table(path)
    missing = {*_TIMES, *(spec.lstrip('-')[:-4] for spec in _COLUMNS.values())} - {*table.columns}
    if missing:
        raise RecordingError(f'{path} has no column {", ".join(sorted(missing))}')
    times = np.column_stack([table.columns[name] for name in _TIMES])
    new = (times != 0.0).any(axis=1)
    new[1:] &= (times[1:] != times[:-1]).any(axis=1)
    losses: list[str] = []
    values = {
        role: column_values(table, role, spec, losses)[new] for role, spec in _COLUMNS.items()
    }
    if len(values['depth']) <= _STEPS:
        count = max(0, len(values['depth']) - 1)
        raise RecordingError(f'{path} has {count} steps, at least {_STEPS} are needed')
    for role in ('guide_x', 'guide_z', 'tip_x', 'tip_z'):
        values[role] = values[role] - values[role][0]
    found = recorded_insertion(path, medium_of(path), values, losses)
    if not found.known.all():
        raise RecordingError(f'{path}: {"; ".join(found.losses)}')
    return found


def moves(recording: SteeringRecording) -> bool:
    """Whether the guide moves."""
    return bool(np.ptp(recording.guide, axis=0).max() > _REST)


def read_folder(
    folder: Path, media: Sequence[str] = (), most: int | None = None
) -> RecordedInsertions:
    """
    Read the insertions of a folder and of all folders in it.

    Of each medium, `most` files with a fixed guide and as many with a moving guide are used.
    """
    files = sorted(path for path in folder.rglob('*.csv') if not media or medium_of(path) in media)
    found: dict[str, list[SteeringRecording]] = {name: [] for name in media}
    left_out: list[str] = []
    counts: dict[tuple[str, bool], int] = {}
    for path in files:
        try:
            one = read_insertion(path)
        except RecordingError as error:
            left_out.append(str(error))
            continue
        kind = one.medium, moves(one)
        counts[kind] = counts.get(kind, 0) + 1
        if most is None or counts[kind] <= most:
            found.setdefault(one.medium, []).append(one)
    if not found or not all(found.values()):
        absent = ', '.join(name for name, of in found.items() if not of) or 'any medium'
        why = f': {left_out[0]}' if left_out else ''
        raise ParameterError(f'{folder} has no insertion in {absent}{why}')
    return RecordedInsertions(found, left_out)
