"""`needle verify`: what a plant computes from recorded commands, beside what was recorded."""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
import json
from pathlib import Path
import sys
from typing import Any, Final

from needle_dynamics import ParameterError
from needle_insertion.replay.recorded_run import configurations, RecordedRun
from needle_insertion.replay.rerun import Rerun, Tally
from needle_insertion.report.text import table
from needle_ros.timing import NANOSECONDS
from tqdm import tqdm

#: Part of the largest value of a kind that a difference may be: far above what another processor
#: or library rounds otherwise, far below what any sensor resolves.
TOLERANCE: Final = 1e-6


@dataclass(frozen=True, slots=True, kw_only=True)
class Result:
    """
    What a run was found to be.

    Attributes
    ----------
    bag, plant, mode : str
        Which one.
    samples : int
        Samples of which something was recorded.
    start : int
        Number of the first one since the activation, counted from 1.
    topics : mapping
        Comparison of each topic.
    first : dict or None
        First difference beyond the tolerance.
    reason : str
        Why it may be there.
    notes : tuple of str
        What was found on the way.

    """

    bag: str
    plant: str
    mode: str
    samples: int
    start: int
    topics: Mapping[str, Tally]
    first: dict[str, Any] | None
    reason: str
    notes: tuple[str, ...]

    @property
    def verdict(self) -> str:
        """The worst of the topics."""
        verdicts = {tally.verdict for tally in self.topics.values()}
        for verdict in ('diverges', 'within tolerance'):
            if verdict in verdicts:
                return verdict
        return 'identical'

    def as_mapping(self) -> dict[str, Any]:
        """Return all of it as JSON has it."""
        topics = {
            name: {
                'compared': tally.compared,
                'differing': tally.differing,
                'largest difference': tally.what and tally.what[1],
                'quantity': tally.what and tally.what[0].name,
                'unit': tally.what and tally.what[0].unit,
                'verdict': tally.verdict,
            }
            for name, tally in self.topics.items()
        }
        return {
            'bag': self.bag,
            'plant': self.plant,
            'mode': self.mode,
            'samples': self.samples,
            'first sample': self.start,
            'verdict': self.verdict,
            'topics': topics,
            'first divergence': self.first,
            'reason': self.reason,
            'notes': list(self.notes),
        }


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `needle verify`."""
    parser.add_argument('bags', type=Path, nargs='+', metavar='BAG', help='recording of a plant')
    parser.add_argument(
        '--tolerance',
        type=float,
        default=TOLERANCE,
        metavar='PART',
        help='of the largest value of a kind, that a difference may be; what is rounded to counts '
        f'may be off by one, too (default {TOLERANCE:g})',
    )
    parser.add_argument('--json', action='store_true', help='print JSON instead of a table')


def run(options: argparse.Namespace) -> int:
    """Verify each bag and print what was found; return 1 if one diverges."""
    if not 0.0 <= options.tolerance < 1.0:
        raise ParameterError(f'--tolerance must be in [0, 1), got {options.tolerance}')
    results: list[Result] = []
    for path in tqdm(options.bags, desc='bags', disable=None, delay=2.0):
        results += verify(path, options.tolerance)
    if options.json:
        document = [result.as_mapping() for result in results]
        sys.stdout.write(f'{json.dumps(document, indent=2)}\n')
    else:
        sys.stdout.write('\n'.join([_table(results), *_remarks(results), '']))
    return int(any(result.verdict == 'diverges' for result in results))


def _table(results: Sequence[Result]) -> str:
    rows = []
    for result in results:
        name = Path(result.bag).name
        for topic, tally in result.topics.items():
            worst = '0'
            if tally.what is not None:
                quantity, difference = tally.what
                worst = f'{difference:.3g} {quantity.unit} ({quantity.name})'
            beyond = str(tally.differing)
            rows.append((name, topic, str(tally.compared), worst, beyond, tally.verdict))
            name = ''
    return table(
        rows, ('bag', 'topic', 'compared', 'largest difference', 'beyond tolerance', 'verdict')
    )


def _remarks(results: Sequence[Result]) -> Iterator[str]:
    shared: dict[str, list[str]] = {}
    for result in results:
        name = Path(result.bag).name
        for note in result.notes:
            shared.setdefault(note, []).append(name)
        if result.first is not None:
            at = result.first
            seconds, rest = divmod(at['stamp'], NANOSECONDS)
            yield (
                f'{name}: diverges first at {seconds}.{rest:09d} s (sample {at["sample"]}), '
                f'{at["topic"]} {at["quantity"]}: recorded {at["recorded"]!r}, computed '
                f'{at["computed"]!r} {at["unit"]}; {result.reason}'
            )
    for note, names in shared.items():
        more = f' and {len(names) - 2} more' if len(names) > 2 else ''
        yield f'{", ".join(names[:2])}{more}: {note}'
    counts = Counter(result.verdict for result in results)
    total = ', '.join(f'{number} {verdict}' for verdict, number in sorted(counts.items()))
    yield f'{len(results)} runs: {total}'


def verify(path: Path, tolerance: float = TOLERANCE) -> list[Result]:
    """
    Compute the runs in a bag anew and compare.

    Parameters
    ----------
    path : Path
        The bag: with ``<plant>/configuration``, what commanded it and what it measured.
    tolerance : float
        Part of the largest value of a kind that a difference may be.

    Returns
    -------
    list of Result
        One for each plant in the bag.

    Raises
    ------
    RecordingError
        If the bag is not readable, or lacks the configuration or all that was measured.

    """
    results = []
    for name, configured in configurations(path).items():
        recorded = RecordedRun(path, name, configured)
        again = Rerun(recorded, tolerance)
        results.append(
            Result(
                bag=str(path),
                plant=name,
                mode=recorded.mode,
                samples=len(recorded.entries),
                start=again.start,
                topics=again.tallies,
                first=again.first,
                reason=again.reason,
                notes=tuple(again.notes),
            )
        )
    return results
