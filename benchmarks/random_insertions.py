# SPDX-License-Identifier: Apache-2.0
"""Steered insertions with random faults through real nodes, and a table of their ends."""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
import sys
from tempfile import TemporaryDirectory
from time import monotonic
from typing import Any, Final

from benchmarks.measure import Bar
from benchmarks.page import PageSection, report
import numpy as np
from rclpy.impl.logging_severity import LoggingSeverity
from rclpy.logging import set_logger_level
from tqdm import trange

#: Largest distance of the tip from the target at the end [m].
LARGEST_MISS: Final = 1e-3

#: Timeout of an event, in wall time [s].
HANGS: Final = 120.0

#: Parameters of the nodes.
PLANT: Final[dict[str, object]] = {
    'needle': 'bending_35mm',
    'steered': True,
    'rate': 200.0,
    'depth': 0.001,
    'model.tissue_stiffness': 5e4,
    'steering.bevel_load': [0.1],
    'tip.noise': 1e-4,
    'guide.speed_limit': 0.1,
}
STEERING: Final[dict[str, object]] = {
    'needle': 'bending_35mm',
    'step_length': 0.01,
    'guide_speed': 0.05,
    'acceleration': 0.4,
    'measurement_time': 0.15,
    'settle_time': 0.02,
}

#: Insertion number k: its row of the table, its end, and a line to print, or ''.
Insertion = Callable[[int, np.random.Generator, Path], tuple[str, str, str]]


def at_target(plant: Any, target: Sequence[float]) -> tuple[str, str]:
    """Return ``target`` or ``missed``, and a line with the distance of the tip of a plant node."""
    off = float(np.linalg.norm(np.array(plant._run.plant.insertion.needle.tip) - target))
    end = 'target' if off < LARGEST_MISS else 'missed'
    return end, f'{1e3 * off:.2f} mm from the target'


@contextmanager
def _quiet_nodes() -> Iterator[None]:
    """Only outcomes are printed; a log level applies to all nodes with a name in the process."""
    names = ('plant', 'controller', 'steering')
    try:
        for name in names:
            set_logger_level(name, LoggingSeverity.FATAL)
        yield
    finally:
        for name in names:
            set_logger_level(name, LoggingSeverity.UNSET)


def repeat(
    insert: Insertion, good: Sequence[str], bad: Sequence[str], head: str, count: int, seed: int
) -> int:
    """Repeat an insertion, print a table of good and bad ends, and return the exit status."""
    rng, begun = np.random.default_rng(seed), monotonic()
    rows: dict[str, Counter[str]] = {}
    with _quiet_nodes(), TemporaryDirectory() as folder:
        for number in trange(count, unit=' insertions', disable=None):
            row, end, line = insert(number, rng, Path(folder) / str(number))
            rows.setdefault(row, Counter())[end] += 1
            if line:
                sys.stdout.write(f'{number}: {line}\n')
                sys.stdout.flush()
    ends = *good, *bad
    cells = [(row, *(str(found[end]) for end in ends)) for row, found in sorted(rows.items())]
    failed = sum(found[end] for found in rows.values() for end in bad)
    section = PageSection(f'{count} insertions', (head, *ends), cells)
    bar = Bar('insertions that failed', float(failed), 0.0)
    return report([section], [bar], monotonic() - begun)


def arguments(name: str, about: str, count: int, words: Sequence[str] | None) -> tuple[int, int]:
    """Return the number of insertions and the seed of a command."""
    parser = argparse.ArgumentParser(name, description=about)
    parser.add_argument('--count', type=int, default=count, help='number of insertions')
    parser.add_argument('--seed', type=int, default=1, help='seed of the random choices')
    given = parser.parse_args(words)
    return given.count, given.seed
