# SPDX-License-Identifier: Apache-2.0
"""`needle analyze`: controllability and observability of the linearized needle model."""

import argparse
from dataclasses import asdict
from functools import partial
from pathlib import Path

from needle_dynamics import FORMULATIONS, NeedleModel, NeedleParameters
from needle_dynamics.linearization import SLIDING
from needle_dynamics.parameters import PAPER_NEEDLE
from needle_insertion.commands import common
from needle_insertion.report import controllability as report
from needle_insertion.report.content import table
from needle_ros.errors import ParameterError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    common.add_needle(parser, PAPER_NEEDLE)
    common.add_constants(parser, '--set', 'any other constant of the model')
    parser.add_argument('--formulation', choices=FORMULATIONS, default='complete')
    parser.add_argument('--modes', type=int, default=2, metavar='N', help='shape modes')
    points = parser.add_argument_group('operating points', 'every combination of the values given')
    add = partial(common.add_quantity, points)
    add('--depth', 'm', 'insertion depths (default 100mm)', [0.1], nargs='+')
    add('--tip-deflection', 'm', 'tip deflections (default 0 0.5mm)', [0.0, 5e-4], nargs='+')
    speeds = 'insertion velocities, negative for retraction (default 5mm/s)'
    add('--speed', 'm/s', speeds, [5e-3], nargs='+')
    add('--force', 'N', 'insertion force (default 0)', 0.0)
    points.add_argument(
        '--sliding',
        choices=tuple(SLIDING),
        help='branch of dry friction at speed 0, where it has no derivative',
    )
    common.add_flag(parser, '--json', 'print JSON instead of a table')
    mapped = 'also map depth and deflection, up to the largest deflection given'
    common.add_flag(parser, '--map', mapped)
    parser.add_argument('-o', '--output', type=Path, metavar='DIR', help='folder for the map')


def run(options: argparse.Namespace) -> int:
    if options.map and (options.output is None or len(options.speed) > 1):
        raise ParameterError('--map needs a folder, -o DIR, and a single --speed')
    if options.output is not None and not options.map:
        raise ParameterError('-o DIR is the folder of the map: it needs --map')
    common.check_folder(options.output)
    changes = common.constants(options.set)
    for name in ('formulation', 'modes'):
        if name in changes:
            raise ParameterError(f'{name} is given by --{name}, not by --set')
    parameters = NeedleParameters.preset(
        options.needle, **{'formulation': options.formulation, 'modes': options.modes, **changes}
    )
    points = report.analyze_points(
        NeedleModel(parameters),
        options.depth,
        options.tip_deflection,
        options.speed,
        options.force,
        options.sliding,
    )
    files = list[Path]()
    if options.map:
        common.make_folder(options.output)
        largest = max(map(abs, options.tip_deflection)) or report.LARGEST_DEFLECTION
        (speed,) = options.speed
        found = report.map_needle(parameters, speed, largest, options.force, options.sliding)
        files = report.write_map(options.output, found)
    document = {
        'needle': options.needle,
        'parameters': asdict(parameters),
        'unit': 'SI',
        'points': [point.document for point in points],
        'files': [str(path) for path in files],
    }
    text = table([point.row for point in points], report.POINT_HEADS)
    common.print_result(document, text, files, as_json=options.json)
    return 0
