# SPDX-License-Identifier: Apache-2.0
"""`needle experiment`: the paper's experiments on the simulated robot, recorded to bags."""

import argparse
from pathlib import Path

from needle_insertion.commands.common import add_needle, check_folder
from needle_ros.errors import ParameterError
from reproduction.protocol import FASTEST, PROTOCOLS, SPEED


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        'which',
        choices=tuple(PROTOCOLS),
        metavar='WHAT',
        help=f'quantity to identify from the recordings: {" or ".join(PROTOCOLS)}',
    )
    parser.add_argument('output', type=Path, metavar='DIR', help='folder for the bags')
    for name, kind, default, unit, words in (
        ('repeats', int, 20, 'N', 'number of bags to record'),
        (
            'seed',
            int,
            2014,
            'N',
            'seed of the true values; the sensor noise of run k, from 0, has the seed plus k',
        ),
        ('rate', float, 250.0, 'Hz', 'samples per second'),
        ('speed', float, SPEED, 'X', 'times real time'),
    ):
        parser.add_argument(
            f'--{name}',
            type=kind,
            default=default,
            metavar=unit,
            help=f'{words} (default {default:g})',
        )
    add_needle(parser, None, "friction drawn around the paper's Table 1")
    parser.add_argument(
        '--fixed',
        action='store_true',
        help="use the means of the paper's tables instead of values drawn around them",
    )


def run(options: argparse.Namespace) -> int:
    # Takes a second to import; invalid options of the parser are reported without it.
    from reproduction.campaign import Campaign

    campaign = Campaign(
        protocol=PROTOCOLS[options.which],
        repeats=options.repeats,
        seed=options.seed,
        rate=options.rate,
        fixed=options.fixed,
        needle=options.needle,
    )
    if not 0.0 < options.speed <= FASTEST:
        raise ParameterError(f'--speed must be in (0, {FASTEST:g}], got {options.speed}')
    check_folder(options.output)
    # Needs ROS; invalid options are reported without it.
    from reproduction.record import record

    record(campaign, options.output, options.speed)
    return 0
