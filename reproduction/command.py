# SPDX-License-Identifier: Apache-2.0
"""`needle reproduce`: compute the paper's results again and compare them with the paper."""

import argparse
import json
from pathlib import Path
import sys
from typing import Any, Final

from needle_insertion.commands.common import check_folder, make_folder
from needle_insertion.progress import ProgressLine
from needle_insertion.report.content import table

#: Results to choose from.
RESULTS: Final = (
    *(f'figure-{number}' for number in range(4, 9)),
    *(f'table-{number}' for number in range(1, 4)),
    *('controllability', 'claims', 'mismatch', 'all'),
)

_OUTPUT: Final = Path('reproduce_output')  #: Default folder of the page of all results.


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        'what', choices=RESULTS, metavar='WHAT', help=f'one of {", ".join(RESULTS)}'
    )
    parser.add_argument(
        '-o',
        '--output',
        type=Path,
        metavar='DIR',
        help=f'folder for a page of HTML with its pictures (all: default {_OUTPUT})',
    )
    parser.add_argument(
        '--record',
        type=Path,
        metavar='DIR',
        help='tables and claims: record new bags in this folder, or continue there',
    )
    parser.add_argument('--json', action='store_true', help='print JSON instead of a table')


def run(options: argparse.Namespace) -> int:
    # Takes two seconds to import; invalid options are reported without it.
    with ProgressLine('reproduce', brief=True):
        from reproduction.results import campaigns, results, VERDICT_HEADS, write_results

    folder = options.output or (_OUTPUT if options.what == 'all' else None)
    check_folder(folder)
    check_folder(options.record)
    recorded = None
    if options.record is not None:
        wanted = campaigns(options.what)
        # Needs ROS; the shipped recordings are read without it.
        from reproduction.record import record

        recorded = {name: record(one, options.record) for name, one in wanted.items()}
    if folder is not None:
        make_folder(folder)
    found = results(options.what, recorded)
    passed = all(one.holds for one in found.values())
    if options.json:
        document: dict[str, Any] = {'result': options.what}
        if options.what == 'all':
            document['results'] = {name: one.document for name, one in found.items()}
            document['holds'] = passed
        else:
            document |= found[options.what].document
        # Values that are not finite, such as the STD of a single recording, become null.
        finite = json.loads(json.dumps(document), parse_constant=lambda _name: None)
        sys.stdout.write(f'{json.dumps(finite, indent=2)}\n')
    elif options.what == 'all':
        verdicts = [row for one in found.values() for row in one.verdicts]
        sys.stdout.write(f'{table(verdicts, VERDICT_HEADS)}\n')
    else:
        sys.stdout.write(f'{found[options.what].text}\n')
    if folder is not None:
        with ProgressLine('page', brief=True):
            page = write_results(folder, found)
        if not options.json:
            sys.stdout.write(f'\nwrote {page}\n')
    return 0 if passed else 1
