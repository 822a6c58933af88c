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
from dataclasses import replace
from pathlib import Path
from typing import Final, NamedTuple

from needle_identification import read_steering_recording, RecordingError, SteeringRecording
from needle_ros.errors import ParameterError
import numpy as np

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
    found = read_steering_recording(path, medium=medium_of(path))
    if len(found.depth) <= _STEPS:
        count = len(found.depth) - 1
        raise RecordingError(f'{path} has {count} steps, at least {_STEPS} are needed')
    if not found.known.all():
        raise RecordingError(f'{path}: {"; ".join(found.losses)}')
    return replace(found, guide=found.guide - found.guide[0], tip=found.tip - found.tip[0])


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
