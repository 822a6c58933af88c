# SPDX-License-Identifier: Apache-2.0
"""`needle simulate`: simulate the needle in open loop; write a table, CSV, picture or bag."""

from __future__ import annotations

import argparse
from dataclasses import fields
from functools import partial
from math import inf, sqrt
from pathlib import Path
from time import perf_counter
from typing import Final, TYPE_CHECKING, TypeAlias

import needle_dynamics as dynamics
from needle_dynamics.needles import DIAMETERS
from needle_dynamics.parameters import PAPER_NEEDLE
from needle_dynamics.simulated.trajectory import DEFAULT_SAMPLES, DEFAULT_TOLERANCE
from needle_dynamics.steering.parameters import NEEDLE_CONSTANTS
from needle_insertion.commands import common
from needle_insertion.progress import ProgressLine, Show
from needle_insertion.report import trajectory as report
from needle_insertion.report.content import table
from needle_ros.errors import ParameterError
from needle_ros.settings import checked
from needle_study.scenario import check_names
import numpy as np

if TYPE_CHECKING:
    # Takes half a second to import.
    from needle_insertion.report.insertion import InsertionRecord

_DEFLECTION: Final = 5e-4  #: default tip deflection at the start [m], from section 3.2.8
_DURATION: Final = 1.0  #: default duration if the force does not insert the needle [s]
_MOMENT: Final = 1e-6  #: duration of the warm-up simulation [s]

_DEPTH, _FORCE = 0.02, 3.0  #: Default insertion depth at the start [m] and default force [N].

#: Default target depth [m], speed [m/s] and distance between samples [m].
_TO, _SPEED, _STEP = 0.1, 5e-3, 1e-3

#: Columns of a table of guide motion, in addition to the depth.
_COLUMNS = ('guide_x', 'guide_z', 'tilt_x', 'tilt_z', 'roll')

_Motion: TypeAlias = dict[str, dynamics.FloatArray]  #: positions by the name of a column

_MOST = 1_000_000  #: most samples of a run
_SLOWEST: Final = 1e-6  #: least speed of a steered needle: its tissue relaxes in real time [m/s]

_MODES: Final = 'modes'  #: Options of a single model.
_ONLY: Final = {
    _MODES: ('force', 'duration', 'tolerance', 'tip_deflection', 'modal'),
    'steering': ('to', 'speed', 'motion', 'seed'),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        '--model',
        choices=tuple(_ONLY),
        help='modes: model of the paper; steering: the needle bends about the path that it cuts '
        '(default: modes for a needle of the paper, steering for all others)',
    )
    common.add_needle(parser, None, f'{dynamics.DEFAULT_NEEDLE}, model modes: {PAPER_NEEDLE}')
    common.add_constants(parser, '--set', 'any other constant of the model')
    add = partial(common.add_quantity, parser)
    add('--depth', 'm', f'insertion depth at the start (default {1e3 * _DEPTH:g}mm; steering: 0)')
    add('--force', 'N', f'insertion force (default {_FORCE:g}N)')
    add(
        '--duration',
        's',
        'time to simulate (default: until the hub is at the skin, or up to twice as long)',
    )
    add('--interval', 's', f'time between samples (default {DEFAULT_SAMPLES} samples, or 1 mm)')
    add('--tolerance', '1', f'change when the step is halved (default {DEFAULT_TOLERANCE:g})')
    start = parser.add_mutually_exclusive_group()
    deflection = 'tip deflection at the start, in the shape of least elastic energy (default '
    common.add_quantity(start, '--tip-deflection', 'm', f'{deflection}{1e3 * _DEFLECTION:g}mm)')
    start.add_argument(
        '--modal',
        type=float,
        nargs='+',
        metavar='Q',
        help='modal coordinates q1 to qn at the start [m^3/2], instead of a tip deflection',
    )
    parser.add_argument(
        '-o',
        '--output',
        type=Path,
        action='append',
        default=[],
        help='file.csv, file.png or a folder for a bag; repeatable',
    )
    common.add_flag(parser, '--json', 'print JSON instead of a table')
    group = parser.add_argument_group('model steering only')
    add = partial(common.add_quantity, group)
    add('--to', 'm', f'target depth (default {1e3 * _TO:g}mm)')
    add('--speed', 'm/s', f'insertion velocity (default {1e3 * _SPEED:g}mm/s)')
    group.add_argument(
        '--motion',
        type=Path,
        metavar='FILE',
        help='table (.csv, .mat) with the columns depth and any of '
        f'{", ".join(_COLUMNS)}: positions of guide and roll at each depth',
    )
    group.add_argument('--seed', type=int, help='seed of the noise of the path (default 0)')


def _time_to_hub(parameters: dynamics.NeedleParameters, depth: float, force: float) -> float:
    """Return the time of insertion up to the hub under a constant force, to two digits [s]."""
    drive, distance = force - parameters.coulomb_friction, parameters.length - depth
    if drive <= 0.0 or distance <= 0.0:
        return _DURATION
    # Upper bound: acceleration and steady motion, one after the other.
    longest = distance * parameters.viscous_friction / drive + sqrt(
        2.0 * distance * parameters.moving_mass / drive
    )
    return float(f'{1.05 * longest:.2g}')


def run(options: argparse.Namespace) -> int:
    for path in options.output:
        if path.suffix not in ('', '.csv', '.png'):
            raise ParameterError(f'{path}: output must be .csv, .png or a folder for a bag')
        if not path.suffix and path.exists():
            raise ParameterError(f'{path}: a bag must not exist')
        common.check_file(path)
    needle = options.needle or (
        PAPER_NEEDLE if options.model == _MODES else dynamics.DEFAULT_NEEDLE
    )
    chosen = options.model or ('steering' if dynamics.find_needle(needle).bends else _MODES)
    for model, names in _ONLY.items():
        given = [name for name in names if getattr(options, name) is not None]
        if given and model != chosen:
            raise ParameterError(
                f'--{given[0].replace("_", "-")} is an option of --model {model}, not of '
                f'{chosen}, the model of {needle}; try --model {model}'
            )
    return _run_modes(needle, options) if chosen == _MODES else _run_steering(needle, options)


def _run_modes(needle: str, options: argparse.Namespace) -> int:
    depth = _DEPTH if options.depth is None else options.depth
    force = _FORCE if options.force is None else options.force
    parameters = dynamics.NeedleParameters.preset(needle, **common.constants(options.set))
    modal = options.modal or ()
    given = options.tip_deflection
    deflection = given if given is not None else 0.0 if modal else _DEFLECTION
    hub = _time_to_hub(parameters, depth, force)
    duration = hub if options.duration is None else options.duration
    start = dynamics.NeedleModel(parameters).state_at(depth, deflection, modal)
    # Loads the machine code, which takes longer than most runs.
    dynamics.simulate(parameters, start, force, duration=_MOMENT, interval=_MOMENT)
    accuracy = {'interval': options.interval, 'tolerance': options.tolerance}
    with ProgressLine('simulation', brief=True):
        begin = perf_counter()
        trajectory = dynamics.simulate(parameters, start, force, duration=duration, **accuracy)
        taken = perf_counter() - begin
    for path in options.output:
        report.write(path, trajectory)
    summary = report.summary(trajectory)
    common.print_each('warning', report.warnings(trajectory))
    word, ratio = (
        ('faster', duration / taken) if duration >= taken else ('slower', taken / duration)
    )
    times = float(f'{ratio:.2g}')
    # Decayed values have no significant digits left.
    rows = [(name, f'{round(value, 15):.6g}') for name, value in summary.items()]
    text = (
        f'{needle}: inserted {depth:g} m at the start, force {force:g} N, for {duration:g} s\n\n'
        f'{table(rows, ("quantity", "value"))}\n'
        f'{duration:g} s simulated in {taken:.2g} s, {times:g} times {word} than real time'
    )
    common.print_result(summary, text, options.output, as_json=options.json)
    return 0


def _read_motion(path: Path, to: float) -> tuple[_Motion, list[str]]:
    """Read `_COLUMNS` by depth from a table; return them with warnings for a depth `to` [m]."""
    # Imported here, as the report below: the modal model does not need these 0.5 s.
    from needle_identification import RecordingError
    from needle_identification.recordings.tables import column_values, guessed, read_table

    read = read_table(path)
    names = {name: (name.replace('_', ''),) for name in ('depth', *_COLUMNS)}
    found = guessed(read.columns, names)
    if 'depth' not in found or len(found) < 2:
        raise RecordingError(
            f'{path} must have the columns depth and any of {", ".join(_COLUMNS)}; it has '
            f'{", ".join(read.columns)}'
        )
    losses = list(read.losses)
    if unused := [name for name in read.columns if name not in found.values()]:
        losses.append(f'columns not used: {", ".join(unused)}; valid: {", ".join(names)}')
    motion = {
        name: column_values(read, name, column, losses, option='')
        for name, column in found.items()
    }
    if not all(np.isfinite(values).all() for values in motion.values()):
        raise RecordingError(f'{path} has values that are not numbers')
    if len(motion['depth']) < 1 or not (np.diff(motion['depth']) > 0.0).all():
        raise RecordingError(f'{path}: depth must increase from row to row')
    first, last = motion['depth'][[0, -1]]
    # Beyond rounding of units.
    if last > to * (1.0 + 1e-9):
        losses.append(
            f'its depths, {1e3 * first:g} to {1e3 * last:g} mm, continue beyond --to, '
            f'{1e3 * to:g} mm'
        )
    return motion, [f'{path}: {one}' for one in losses]


def _run_steering(needle_name: str, options: argparse.Namespace) -> int:
    from needle_insertion.report import insertion as report

    for path in options.output:
        if path.suffix not in ('.csv', '.png'):
            raise ParameterError(f'{path}: output of --model steering must be .csv or .png')
    changes = common.constants(options.set)
    own = (item.name for item in fields(dynamics.SteeringParameters))
    check_names('', changes, (*NEEDLE_CONSTANTS, *DIAMETERS, *own))
    needle, steering, _ = dynamics.find_needle(needle_name).changed(changes)
    to = _TO if options.to is None else options.to
    speed = _SPEED if options.speed is None else options.speed
    checked('--speed', speed, 'm/s', low=_SLOWEST)
    interval = _STEP / speed if options.interval is None else options.interval
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
    motion, warnings = _read_motion(options.motion, to) if options.motion is not None else ({}, [])
    common.print_each('warning', warnings)
    insertion = dynamics.Insertion(needle, steering, depth=start, seed=options.seed or 0)
    recorder = report.InsertionRecord(insertion)
    with ProgressLine('simulation', brief=True) as show:
        _insert(recorder, motion, show, to, speed, interval)
    for path in options.output:
        report.write(path, recorder)
    common.print_each('warning', report.warnings(recorder))
    summary = report.summary(recorder)
    rows = [(key, f'{value + 0.0:.6g}') for key, value in summary.items()]
    text = (
        f'{needle_name}: inserted from {start:g} m to {to:g} m at {speed:g} m/s\n\n'
        f'{table(rows, ("quantity", "value"))}'
    )
    common.print_result(summary, text, options.output, as_json=options.json)
    return 0


def _insert(
    recorder: InsertionRecord,
    motion: _Motion,
    show: Show,
    to: float,
    speed: float,
    interval: float,
) -> None:
    """Insert a needle to a depth [m] at a speed [m/s], with samples at intervals [s]."""
    one = recorder.one
    begin = one.depth
    while one.depth < to:
        show('inserting', (one.depth - begin) / (to - begin))
        # The first interval accelerates to the speed, the last ends at the target depth.
        ahead = min(one.depth + 0.5 * (one.velocity + speed) * interval, to)
        at = dict.fromkeys(_COLUMNS, 0.0)
        at |= {key: float(np.interp(ahead, motion['depth'], motion[key])) for key in motion}
        guide, tilt = (at['guide_x'], at['guide_z']), (at['tilt_x'], at['tilt_z'])
        duration = interval
        if ahead == to:
            duration = max(2.0 * (to - one.depth) / (one.velocity + speed), 1e-9)
        recorder.take(one.carry(duration, speed, guide=guide, tilt=tilt, roll=at['roll']))
        if ahead == to:
            break
