"""`needle simulate`: the needle in open loop without ROS, to a table, CSV, picture or bag."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
import sys
from typing import Final

from needle_dynamics import NeedleModel, NeedleParameters, PRESETS, simulate
from needle_dynamics.simulated.integrator import DEFAULT_TOLERANCE
from needle_insertion.commands.common import add_needle, check_file, Command, constants
from needle_insertion.report import trajectory as report
from needle_insertion.report.text import table
from needle_ros.errors import ParameterError

#: Deflection of the tip at the start by default [m], that of section 3.2.8.
_DEFLECTION: Final = 5e-4


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `needle simulate`."""
    add_needle(parser, PRESETS, 'paper_si')
    for name, default, unit, words in (
        ('depth', 0.02, 'm', 'inserted length at the start'),
        ('force', 3.0, 'N', 'insertion force'),
        ('duration', 0.05, 's', 'time to simulate'),
        ('interval', 1e-4, 's', 'time between samples'),
        ('tolerance', DEFAULT_TOLERANCE, 'X', 'relative error of each interval'),
    ):
        parser.add_argument(
            f'--{name}',
            type=float,
            default=default,
            metavar=unit,
            help=f'{words} (default {default:g})',
        )
    start = parser.add_mutually_exclusive_group()
    start.add_argument(
        '--tip-deflection',
        type=float,
        metavar='m',
        help=f'at the start, with the least elastic energy (default {_DEFLECTION:g})',
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


def _run(options: argparse.Namespace) -> int:
    """Simulate, write the outputs, and print a summary."""
    for path in options.output:
        if path.suffix not in ('', '.csv', '.png'):
            raise ParameterError(f'{path}: output must be .csv, .png or a folder for a bag')
        if not path.suffix and path.exists():
            raise ParameterError(f'{path}: a bag must not exist')
        check_file(path)
    parameters = NeedleParameters.preset(options.preset, **constants(options.set))
    modal = options.modal or ()
    given = options.tip_deflection
    deflection = given if given is not None else 0.0 if modal else _DEFLECTION
    trajectory = simulate(
        parameters,
        NeedleModel(parameters).state_at(options.depth, deflection, modal),
        options.force,
        duration=options.duration,
        interval=options.interval,
        tolerance=options.tolerance,
    )
    for path in options.output:
        report.write(path, trajectory)
    summary = report.summary(trajectory)
    for words in report.warnings(trajectory):
        sys.stderr.write(f'warning: {words}\n')
    if options.json:
        sys.stdout.write(f'{json.dumps(summary, indent=2)}\n')
    else:
        rows = [(name, f'{value:.6g}') for name, value in summary.items()]
        sys.stdout.write(
            f'{options.preset}: inserted {options.depth:g} m at the start, force '
            f'{options.force:g} N, for {options.duration:g} s\n\n'
            f'{table(rows, ("quantity", "value"))}\n'
        )
        for path in options.output:
            sys.stdout.write(f'wrote {path}\n')
    return 0


COMMAND = Command(_add_arguments, _run)
