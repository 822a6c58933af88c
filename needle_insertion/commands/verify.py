# SPDX-License-Identifier: Apache-2.0
"""`needle verify`: compute recorded runs again and compare them with the recordings."""

import argparse
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
import sys

from needle_insertion.commands.common import add_flag, print_result
from needle_insertion.replay.rerun import Rerun, TOLERANCE, verify
from needle_insertion.report.content import short_names, table
from needle_ros.errors import NeedleError, ParameterError, shown
from needle_ros.timing import NANOSECONDS
from tqdm import tqdm


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('bags', type=Path, nargs='+', metavar='BAG', help='recording of a plant')
    parser.add_argument(
        '--tolerance',
        type=float,
        default=TOLERANCE,
        metavar='FRACTION',
        help='largest difference as a fraction of the largest value of its topic and unit; a '
        f'value that is rounded to counts may also differ by one count (default {TOLERANCE:g})',
    )
    add_flag(parser, '--json', 'print JSON instead of a table')


def run(options: argparse.Namespace) -> int:
    """Verify each bag and print the results; return 1 if a run differs, 2 if a bag is unusable."""
    if not 0.0 <= options.tolerance < 1.0:
        raise ParameterError(f'--tolerance must be in [0, 1), got {options.tolerance}')
    results: list[Rerun] = []
    bad = False
    for path in tqdm(options.bags, desc='bags', disable=None, delay=2.0):
        try:
            results += verify(path, options.tolerance)
        except (NeedleError, OSError) as error:  # noqa: PERF203
            tqdm.write(f'error: {error}', file=sys.stderr)
            bad = True
    if results or options.json:
        names = short_names([*{str(result.recorded.path) for result in results}])
        text = '\n'.join([_table(results, names), *map(shown, _remarks(results, names))])
        print_result([one.document for one in results], text, as_json=options.json)
    return 2 if bad else int(any(result.verdict == 'differs' for result in results))


def _table(results: Sequence[Rerun], names: Mapping[str, str]) -> str:
    rows = []
    for result in results:
        name = shown(names[str(result.recorded.path)])
        for topic, found in result.topics.items():
            worst = f'{found.largest_difference:.3g} {found.unit} ({found.quantity})'
            counts = str(found.compared), worst if found.quantity else '0', str(found.differing)
            rows.append((name, shown(topic), *counts, found.verdict))
            name = ''
    return table(
        rows, ('bag', 'topic', 'compared', 'largest difference', 'beyond tolerance', 'verdict')
    )


def _remarks(results: Sequence[Rerun], names: Mapping[str, str]) -> Iterator[str]:
    shared: dict[str, dict[Path, str]] = {}
    for result in results:
        name = names[str(result.recorded.path)]
        for note in result.notes:
            shared.setdefault(note, {})[result.recorded.path] = name
        if result.first is not None:
            at = result.first
            seconds, rest = divmod(at['stamp'], NANOSECONDS)
            yield (
                f'{name}: differs first at {seconds}.{rest:09d} s (sample {at["sample"]}), '
                f'{at["topic"]} {at["quantity"]}: recorded {at["recorded"]!r}, computed '
                f'{at["computed"]!r} {at["unit"]}; {result.reason}'
            )
    for note, bags in shared.items():
        more = f' and {len(bags) - 2} more' if len(bags) > 2 else ''
        yield f'{", ".join(list(bags.values())[:2])}{more}: {note}'
    counts = Counter(result.verdict for result in results)
    total = ', '.join(f'{number} {verdict}' for verdict, number in sorted(counts.items()))
    yield f'{len(results)} runs: {total}'
