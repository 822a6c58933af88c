# SPDX-License-Identifier: Apache-2.0
"""`needle simulate`: simulate the needle in open loop; write a table, CSV, picture or bag."""

import argparse
from math import sqrt
from pathlib import Path
from time import perf_counter
from typing import Final

from needle_dynamics import DEFAULT_NEEDLE, find_needle, NeedleModel, NeedleParameters, simulate
from needle_dynamics.parameters import PAPER_NEEDLE
from needle_dynamics.simulated.trajectory import DEFAULT_SAMPLES, DEFAULT_TOLERANCE
from needle_insertion.commands import common
from needle_insertion.commands.simulate_steering import add_steering, run_steering
from needle_insertion.progress import ProgressLine
from needle_insertion.report import trajectory as report
from needle_insertion.report.text import table
from needle_ros.errors import ParameterError

_DEFLECTION: Final = 5e-4  #: default tip deflection at the start [m], from section 3.2.8
_DURATION: Final = 1.0  #: default duration if the force does not insert the needle [s]
_MOMENT: Final = 1e-6  #: duration of the warm-up simulation [s]

_DEPTH, _FORCE = 0.02, 3.0  #: Default insertion depth at the start [m] and default force [N].

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
    common.add_needle(parser, None, f'{DEFAULT_NEEDLE}, model modes: {PAPER_NEEDLE}')
    common.add_constants(parser, '--set', 'any other constant of the model')
    for name, unit, words in (
        ('depth', 'm', f'insertion depth at the start (default {1e3 * _DEPTH:g}mm; steering: 0)'),
        ('force', 'N', f'insertion force (default {_FORCE:g}N)'),
        ('duration', 's', 'time to simulate (default: until the hub is at the skin)'),
        ('interval', 's', f'time between samples (default {DEFAULT_SAMPLES} samples, or 1 mm)'),
        ('tolerance', '1', f'change when the step is halved (default {DEFAULT_TOLERANCE:g})'),
    ):
        parser.add_argument(f'--{name}', help=words, **common.with_unit(unit))
    start = parser.add_mutually_exclusive_group()
    start.add_argument(
        '--tip-deflection',
        help='tip deflection at the start, in the shape of least elastic energy (default '
        f'{1e3 * _DEFLECTION:g}mm)',
        **common.with_unit('m'),
    )
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
    parser.add_argument('--json', action='store_true', help='print JSON instead of a table')
    add_steering(parser)


def _time_to_hub(parameters: NeedleParameters, depth: float, force: float) -> float:
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
    needle = options.needle or (PAPER_NEEDLE if options.model == _MODES else DEFAULT_NEEDLE)
    chosen = options.model or ('steering' if find_needle(needle).bends else _MODES)
    for model, names in _ONLY.items():
        given = [name for name in names if getattr(options, name) is not None]
        if given and model != chosen:
            raise ParameterError(
                f'--{given[0].replace("_", "-")} is an option of --model {model}, not of '
                f'{chosen}, the model of {needle}; try --needle '
                f'{PAPER_NEEDLE if model == _MODES else DEFAULT_NEEDLE}'
            )
    return _run_modes(needle, options) if chosen == _MODES else run_steering(needle, options)


def _run_modes(needle: str, options: argparse.Namespace) -> int:
    depth = _DEPTH if options.depth is None else options.depth
    force = _FORCE if options.force is None else options.force
    parameters = NeedleParameters.preset(needle, **common.constants(options.set))
    modal = options.modal or ()
    given = options.tip_deflection
    deflection = given if given is not None else 0.0 if modal else _DEFLECTION
    duration = options.duration
    if duration is None:
        duration = _time_to_hub(parameters, depth, force)
    start = NeedleModel(parameters).state_at(depth, deflection, modal)
    # Loads the machine code, which takes longer than most runs.
    simulate(parameters, start, force, duration=_MOMENT, interval=_MOMENT)
    with ProgressLine('simulation', brief=True):
        begin = perf_counter()
        trajectory = simulate(
            parameters,
            start,
            force,
            duration=duration,
            interval=options.interval,
            tolerance=options.tolerance,
        )
        taken = perf_counter() - begin
    for path in options.output:
        report.write(path, trajectory)
    summary = report.summary(trajectory)
    common.print_each('warning', report.warnings(trajectory))
    # Decayed values have no significant digits left.
    rows = [(name, f'{round(value, 15):.6g}') for name, value in summary.items()]
    text = (
        f'{needle}: inserted {depth:g} m at the start, force {force:g} N, for {duration:g} s\n\n'
        f'{table(rows, ("quantity", "value"))}\n'
        f'{duration:g} s simulated in {taken:.2g} s, {_pace(duration / taken)} real time'
    )
    common.print_result(summary, text, options.output, as_json=options.json)
    return 0


def _pace(ratio: float) -> str:
    """Format the ratio of simulated to real time to two digits."""
    times, word = (ratio, 'faster') if ratio >= 1.0 else (1.0 / ratio, 'slower')
    return f'{float(f"{times:.2g}"):g} times {word} than'
