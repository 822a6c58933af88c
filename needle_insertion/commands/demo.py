"""`needle demo`: insertion, recording and identification, with one report."""

from __future__ import annotations

import argparse
from pathlib import Path

from needle_insertion.experiment.protocol import SHIPPED_BAGS


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """
    Add the options of `needle demo`.

    Parameters
    ----------
    parser : ArgumentParser
        Parser of the command.

    """
    parser.add_argument(
        '-o',
        '--output',
        type=Path,
        default=Path('demo_output'),
        help='folder (default demo_output)',
    )
    parser.add_argument('--bags', type=Path, default=SHIPPED_BAGS, help='shipped recordings')


def run(options: argparse.Namespace) -> int:
    """
    Run the demo.

    Parameters
    ----------
    options : Namespace
        As declared by `add_arguments`.

    Returns
    -------
    int
        0 if every check passed, else 1.

    """
    from needle_insertion.experiment import demo

    return demo.run(options.output, options.bags)
