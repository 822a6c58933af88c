# SPDX-License-Identifier: Apache-2.0
"""`needle simulate --model steering`: simulate a needle that bends about the path that it cuts."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import fields
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING

from needle_dynamics import (
    find_needle,
    FloatArray,
    Insertion,
    NeedleParameters,
    SteeringParameters,
)
from needle_dynamics.steering.parameters import NEEDLE_CONSTANTS
from needle_insertion.commands.common import constants, print_result, with_unit
from needle_insertion.progress import ProgressLine, Show
from needle_insertion.report.text import table
from needle_ros.errors import ParameterError
from needle_ros.settings import unknown_name
import numpy as np

if TYPE_CHECKING:
    # Takes half a second to import.
    from needle_insertion.report.insertion import InsertionRecord

#: Default target depth [m], speed [m/s] and distance between samples [m].
TO, SPEED, WAY = 0.1, 5e-3, 1e-3

#: Columns of a table of guide motion, in addition to the depth.
COLUMNS = ('guide_x', 'guide_z', 'tilt_x', 'tilt_z', 'roll')

_MOST = 1_000_000  #: most samples of a run


def add_steering(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group('model steering only')
    group.add_argument('--to', help=f'target depth (default {1e3 * TO:g}mm)', **with_unit('m'))
    group.add_argument(
        '--speed', help=f'insertion velocity (default {1e3 * SPEED:g}mm/s)', **with_unit('m/s')
    )
    group.add_argument(
        '--motion',
        type=Path,
        metavar='FILE',
        help='table (.csv, .mat) with the columns depth and any of '
        f'{", ".join(COLUMNS)}: positions of guide and roll at each depth',
    )
    group.add_argument('--seed', type=int, help='seed of the noise of the path (default 0)')


def made(name: str, words: list[str]) -> tuple[NeedleParameters, SteeringParameters]:
    """Return the constants of a needle, changed by ``name=value`` words."""
    given = constants(words)
    valid = [*NEEDLE_CONSTANTS, *(item.name for item in fields(SteeringParameters))]
    for key in given:
        if key not in valid:
            raise ParameterError(unknown_name(key, valid))
    needle, steering, _ = find_needle(name).changed(given)
    return needle, steering


def read_motion(path: Path) -> dict[str, FloatArray]:
    """Read guide, tilt and roll by depth from a table: ``depth`` and at least one of `COLUMNS`."""
    # Imported here, as the report below: the modal model does not need these 0.5 s.
    from needle_identification import RecordingError
    from needle_identification.recordings.tables import column_values, guessed, read_table

    read = read_table(path)
    names = {name: (name.replace('_', ''),) for name in ('depth', *COLUMNS)}
    found = guessed(read, names)
    if 'depth' not in found or len(found) < 2:
        raise RecordingError(
            f'{path} must have the columns depth and any of {", ".join(COLUMNS)}; it has '
            f'{", ".join(read.columns)}'
        )
    motion = {name: column_values(read, name, column, []) for name, column in found.items()}
    if not all(np.isfinite(values).all() for values in motion.values()):
        raise RecordingError(f'{path} has values that are not numbers')
    if len(motion['depth']) < 1 or not (np.diff(motion['depth']) > 0.0).all():
        raise RecordingError(f'{path}: depth must increase from row to row')
    return motion


def run_steering(name: str, options: argparse.Namespace) -> int:
    from needle_insertion.report import insertion as report

    for path in options.output:
        if path.suffix not in ('.csv', '.png'):
            raise ParameterError(f'{path}: output of --model steering must be .csv or .png')
    needle, steering = made(name, options.set)
    to = TO if options.to is None else options.to
    speed = SPEED if options.speed is None else options.speed
    if not 0.0 < speed < inf:
        raise ParameterError(f'--speed must be positive and finite, got {speed!r} m/s')
    interval = WAY / speed if options.interval is None else options.interval
    start = 0.0 if options.depth is None else options.depth
    if start > needle.length:
        raise ParameterError(
            f'--depth must be <= length = {needle.length:g} m, got {start:g} m: lengths without a '
            'unit are in m, such as 0.05 or 50mm'
        )
    if not 0.0 < interval < inf or not start < to < inf or (to - start) / speed > _MOST * interval:
        raise ParameterError(
            f'--to must be beyond --depth, {start:g} m, with at most {_MOST} samples of '
            f'--interval, got {to!r} m and {interval!r} s'
        )
    motion = read_motion(options.motion) if options.motion is not None else {}
    one = Insertion(needle, steering, depth=start, seed=options.seed or 0)
    recorder = report.InsertionRecord(one)
    with ProgressLine('simulation', brief=True) as show:
        _insert(one, recorder, motion, show, to=to, speed=speed, interval=interval)
    for path in options.output:
        report.write(path, recorder)
    summary = report.summary(recorder)
    rows = [(key, f'{value + 0.0:.6g}') for key, value in summary.items()]
    text = (
        f'{name}: inserted from {start:g} m to {to:g} m at {speed:g} m/s\n\n'
        f'{table(rows, ("quantity", "value"))}'
    )
    print_result(summary, text, options.output, as_json=options.json)
    return 0


def _insert(
    one: Insertion,
    recorder: InsertionRecord,
    motion: Mapping[str, FloatArray],
    show: Show,
    *,
    to: float,
    speed: float,
    interval: float,
) -> None:
    begin = one.depth
    while one.depth < to:
        show('inserting', (one.depth - begin) / (to - begin))
        # The first interval accelerates to the speed, the last ends at the target depth.
        ahead = min(one.depth + 0.5 * (one.velocity + speed) * interval, to)
        at = {key: float(np.interp(ahead, motion['depth'], motion[key])) for key in motion}
        duration = interval
        if ahead == to:
            duration = max(2.0 * (to - one.depth) / (one.velocity + speed), 1e-9)
        force = one.carry(
            duration,
            speed,
            guide=(at.get('guide_x', 0.0), at.get('guide_z', 0.0)),
            tilt=(at.get('tilt_x', 0.0), at.get('tilt_z', 0.0)),
            roll=at.get('roll', 0.0),
        )
        recorder.take(force)
        if ahead == to:
            break
