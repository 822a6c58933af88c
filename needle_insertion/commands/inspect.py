"""`needle inspect`: list the contents of recordings, and the command that identifies from them."""

from __future__ import annotations

import argparse
import json
from math import isfinite
from pathlib import Path
import sys

from needle_identification import inspect_recording, Inspection
from needle_insertion.commands.common import Subcommand
from needle_insertion.report.identify_text import plain
from needle_insertion.report.text import table
from needle_ros.errors import NeedleError, shown


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        'recordings',
        type=Path,
        nargs='+',
        metavar='RECORDING',
        help='rosbag2 folder, .mcap, .db3 or ROS 1 .bag file, or a table (.csv, .mat)',
    )
    parser.add_argument('--json', action='store_true', help='print JSON instead of tables')


def _run(options: argparse.Namespace) -> int:
    """Print the contents of each recording; return 2 if a recording cannot be read."""
    found: list[Inspection] = []
    bad = 0
    for path in options.recordings:
        one = _inspected(path)
        found += one
        bad += not one
    if options.json:
        document = [plain(one) for one in found]
        sys.stdout.write(f'{json.dumps(document, indent=2, allow_nan=False)}\n')
    else:
        sys.stdout.write('\n\n'.join(map(_text, found)) + ('\n' if found else ''))
    return 2 if bad else 0


def _inspected(path: Path) -> list[Inspection]:
    """Inspect a recording, or print the error and return an empty list."""
    try:
        return [inspect_recording(path)]
    except (NeedleError, OSError) as error:
        sys.stderr.write(shown(f'error: {error}') + '\n')
        return []


def _text(found: Inspection) -> str:
    rows = []
    for content in found.contents:
        first = (
            content.name,
            content.type_name.rpartition('/')[2],
            f'{content.count}',
            f'{content.rate:.4g}' if isfinite(content.rate) else '',
            f'{content.gaps}' if content.gaps else '',
        )
        ranges = [
            f'{one.name}: {one.low + 0.0:.4g} to {one.high + 0.0:.4g}' for one in content.columns
        ]
        for k, span in enumerate(ranges or ['']):
            rows.append((*(first if k == 0 else ('',) * len(first)), span))
    heads = ('topic', 'type', 'messages', 'per second', 'gaps', 'range')
    lines = [found.path, table([tuple(map(shown, row)) for row in rows], heads)]
    lines += [f'warning: {shown(words)}' for words in found.losses]
    lines += [shown(words) for words in found.words]
    if found.command:
        lines += [f'try: {shown(found.command)}']
    return '\n'.join(lines)


COMMAND = Subcommand(_add_arguments, _run)
