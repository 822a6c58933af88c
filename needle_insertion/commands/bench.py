"""`needle bench`: the benchmarks, which are run from a clone and not installed."""

from __future__ import annotations

import argparse
from importlib import import_module
from pathlib import Path
import sys

from needle_ros.errors import ParameterError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """
    Add the options of `needle bench`.

    Parameters
    ----------
    parser : ArgumentParser
        Parser of the command.

    """
    subjects = parser.add_subparsers(required=True, dest='subject', metavar='SUBJECT')
    for subject, words in (
        ('dynamics', 'the integrator'),
        ('identification', 'from a bag to a result'),
        ('control', 'a control step'),
    ):
        subjects.add_parser(subject, help=f'speed: {words}')
    graph = subjects.add_parser('graph', help='speed: our nodes and bare rclpy nodes')
    length = graph.add_mutually_exclusive_group()
    length.add_argument('--full', action='store_true', help='record 60 s, watch memory for 10 min')
    length.add_argument(
        '--quick', action='store_true', help='a short trial; its numbers mean nothing'
    )
    intervals = subjects.add_parser('calibration', help='how often intervals hold the truth')
    intervals.add_argument(
        '--recordings',
        type=int,
        default=1000,
        metavar='N',
        help='simulated recordings of each kind (default 1000)',
    )
    intervals.add_argument(
        '--seed', type=int, default=2014, help='of the true values and the noise (default 2014)'
    )
    intervals.add_argument('--json', action='store_true', help='print JSON instead of tables')


def run(options: argparse.Namespace) -> int:
    """
    Run a benchmark.

    Parameters
    ----------
    options : Namespace
        As declared by `add_arguments`.

    Returns
    -------
    int
        Exit status.

    Raises
    ------
    ParameterError
        If this is not a clone.

    """
    root = Path(__file__).parents[2]
    if not (root / 'benchmarks').is_dir():
        raise ParameterError('needle bench needs a clone of the repository: benchmarks/ is there')
    # A clone is not on the path.
    sys.path.insert(0, str(root))
    has_own_run = options.subject in ('graph', 'calibration')
    module = import_module(f'benchmarks.{options.subject}' if has_own_run else 'benchmarks.run')
    return int(module.run(options))
