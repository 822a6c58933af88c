# SPDX-License-Identifier: Apache-2.0
"""
Longest time between two commands after a start, ``python -m benchmarks.gaps``.

Plant and controller start at 1000 Hz, without and with compiled functions on disk, and bare nodes
beside them. The time between arrivals is measured in a third process, for 10 s from the first
command. With ``--priority`` all three processes run under SCHED_FIFO.
"""

import argparse
from collections.abc import Sequence
from itertools import pairwise
import os
from pathlib import Path
import sys
from tempfile import TemporaryDirectory
from time import monotonic
from typing import Final

from benchmarks.measure import Bar
from benchmarks.page import PageSection, report
from benchmarks.pairs import Pair
from geometry_msgs.msg import WrenchStamped
from needle_insertion.graph.ros_graph import Graph
from needle_ros.base_node import COMMAND
from needle_ros.process import set_priority
import numpy as np

LONGEST: Final = 5e-3  #: Longest permitted time between two commands [s].

#: Starts in the order of the table: pair of nodes, and whether compiled functions are on disk.
STARTS: Final = {'cold': ('needle', False), 'warm': ('needle', True), 'bare': ('bare', True)}

_DURATION: Final = 10.0  #: Duration of a measurement [s].
_START: Final = 300.0  #: Timeout of a start [s].


def _schedule(pid: int, priority: int) -> None:
    """Schedule the threads of another process with SCHED_FIFO."""
    for thread in Path(f'/proc/{pid}/task').iterdir():
        os.sched_setscheduler(int(thread.name), os.SCHED_FIFO, os.sched_param(priority))


def measure(start: str, priority: int, logs: Path) -> list[float]:
    """Start a pair of nodes; return the times between its commands [s]."""
    name, compiled = STARTS[start]
    with Graph(logs) as graph:
        if not compiled:
            graph.environment['NUMBA_CACHE_DIR'] = str(logs / 'empty')
        pair = Pair(name, graph, realtime_priority=priority)
        try:
            for what in ('plant', 'controller'):
                pair.start(what)
            for what in ('plant', 'controller'):
                pair.ready(what)
            if priority:
                set_priority(priority)
                if name == 'bare':
                    for pid in pair.pids.values():
                        _schedule(pid, priority)
            with (
                pair.watching({'wrench_command': (WrenchStamped, COMMAND)}) as seen,
                pair.running(),
            ):
                arrivals = seen['wrench_command']
                pair.until(lambda: arrivals, 'the first command', _START)
                pair.aim()
                pair.spin(_DURATION)
                times = [at for at, _ in arrivals]
        finally:
            set_priority(0)
            pair.end()
    return [1e-9 * (after - before) for before, after in pairwise(times)]


def main(words: Sequence[str] | None = None) -> int:
    """Measure, print a table and the verdict; return the exit status."""
    parser = argparse.ArgumentParser('benchmarks.gaps', description=__doc__)
    parser.add_argument('--rounds', type=int, default=3, help='number of starts of each kind')
    parser.add_argument('--priority', type=int, default=0, help='priority under SCHED_FIFO')
    given, begun = parser.parse_args(words), monotonic()
    rows, longest = [], 0.0
    for start in STARTS:
        found = []
        for _ in range(given.rounds):
            with TemporaryDirectory() as folder:
                found.append(measure(start, given.priority, Path(folder)))
        gaps = [1e3 * max(times) for times in found]
        p50, p99 = 1e3 * np.percentile(np.concatenate(found), [50.0, 99.0])
        rows.append((start, f'{p50:.2f}', f'{p99:.2f}', *(f'{gap:.2f}' for gap in gaps)))
        if start != 'bare':
            longest = max(longest, *gaps)
    names = ('start', 'p50 ms', 'p99 ms', *(f'longest {k + 1}, ms' for k in range(given.rounds)))
    bar = Bar('longest time between two commands', longest, 1e3 * LONGEST, 'ms')
    return report([PageSection('Starts', names, rows)], [bar], monotonic() - begun)


if __name__ == '__main__':
    sys.exit(main())
