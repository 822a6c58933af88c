# SPDX-License-Identifier: Apache-2.0
"""`needle demo`: insertion, recording and identification, with one report."""

import argparse
from pathlib import Path

from needle_insertion.commands.common import check_folder
from needle_insertion.progress import ProgressLine
from reproduction.protocol import SHIPPED_BAGS


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        '-o',
        '--output',
        type=Path,
        default=Path('demo_output'),
        help='folder (default demo_output)',
    )
    parser.add_argument('--bags', type=Path, default=SHIPPED_BAGS, help='shipped recordings')
    parser.add_argument(
        '--realtime',
        action='store_true',
        help='real time instead of lock-step: a busy machine changes the insertions',
    )


def run(options: argparse.Namespace) -> int:
    check_folder(options.output)
    with ProgressLine('demo', brief=True):
        from needle_insertion.commands.compile import compile_nodes
        from reproduction import demo

    compile_nodes()
    return demo.run(options.output, options.bags, lockstep=not options.realtime)
