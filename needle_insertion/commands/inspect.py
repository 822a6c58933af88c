# SPDX-License-Identifier: Apache-2.0
"""`needle inspect`: list the contents of recordings, and the command that identifies from them."""

import argparse
from math import isfinite

from needle_identification import inspect_recording, Inspection
from needle_insertion.commands.common import add_flag, add_recordings, print_each, print_result
from needle_insertion.progress import ProgressLine
from needle_insertion.report.content import table
from needle_insertion.report.identify_text import plain
from needle_ros.errors import NeedleError, shown


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_recordings(parser)
    add_flag(parser, '--json', 'print JSON instead of tables')


def run(options: argparse.Namespace) -> int:
    found, bad = list[Inspection](), 0
    for path in options.recordings:
        try:
            with ProgressLine(f'reading {path.name}', brief=True):
                found.append(inspect_recording(path))
        except (NeedleError, OSError) as error:  # noqa: PERF203
            print_each('error', [error])
            bad += 1
    if found or options.json:
        # One command is for all recordings of a kind.
        kinds = {one.command.split()[2] for one in found if one.command}
        several = len(found) > 1 and len(kinds) == 1
        text = '\n\n'.join(_text(one, several=several) for one in found)
        if several:
            text += '\n\ntry, for all of them: needle identify RECORDINGS'
        print_result([plain(one) for one in found], text, as_json=options.json)
    return 2 if bad else 0


def _text(found: Inspection, *, several: bool) -> str:
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
    lines = [shown(found.path), table([tuple(map(shown, row)) for row in rows], heads)]
    lines += [f'warning: {shown(words)}' for words in found.losses]
    lines += [shown(words) for words in found.words]
    if found.command and not several:
        lines += [f'try: {shown(found.command)}']
    return '\n'.join(lines)
