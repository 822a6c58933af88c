# SPDX-License-Identifier: Apache-2.0
"""
CPU cost of `needle watch` with an open page to the plant.

A plant and a controller at 1 kHz run all the time. In each round their CPU time is measured twice:
alone, and with `needle watch` and a browser that shows its page. A process on a shared core may
skip samples, so the CPU time is divided by the number of samples of the plant. A ratio is the
median over the rounds of the ratios within a round. Run it from a clone: ``python -m
benchmarks.watching``.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
import shutil
import subprocess
import sys
from tempfile import TemporaryDirectory
import time
from typing import Final

from benchmarks.measure import Bar
from benchmarks.pairs import cpu_seconds
from diagnostic_msgs.msg import DiagnosticArray
from needle_insertion.graph.ros_graph import Graph
from needle_ros.errors import JobError
from needle_ros.status import PlantStatus, read_reports
import numpy as np
from rclpy.node import Node

#: CPU of the plant with a page, relative to without.
LARGEST: Final = 1.1

#: Rounds, measuring time of each half of a round, and settling time before it [s].
ROUNDS, TURN, SETTLE = 5, 6.0, 4.0

#: A flexible needle, inserted half way.
_NEEDLE: Final[dict[str, object]] = {'needle': 'bending_35mm'}
_PLANT: Final = {**_NEEDLE, 'steered': True, 'depth': 0.06}

_BROWSERS: Final = ('chromium', 'chromium-browser', 'google-chrome')


@contextmanager
def page(graph: Graph, folder: str, count: int = 1) -> Iterator[tuple[int, int]]:
    """Show pages within a ``with`` statement; yield process id of `needle watch` and port."""
    browser = next(filter(None, map(shutil.which, _BROWSERS)), None)
    if browser is None:
        raise JobError(f'none of {", ".join(_BROWSERS)} is installed')
    watch = subprocess.Popen(
        [sys.executable, '-m', 'needle_insertion.cli', 'watch', '--port', '0'],
        env=graph.environment,
        stdout=subprocess.PIPE,
        text=True,
    )
    running: list[subprocess.Popen[str]] = [watch]
    try:
        line = watch.stdout.readline() if watch.stdout else ''
        if not line.startswith('page: '):
            raise JobError('needle watch did not start')
        options = ('--headless=new', '--no-sandbox', '--disable-gpu', '--disable-dev-shm-usage',
                   '--no-first-run', '--disable-background-networking',
                   '--remote-debugging-port=0', '--window-size=1400,1000')  # fmt: skip
        # One browser per page: a browser slows down the pages that it hides.
        for k in range(count):
            profile = f'--user-data-dir={folder}_{k}'
            shown: subprocess.Popen[str] = subprocess.Popen(
                [browser, *options, profile, line.removeprefix('page: ').strip()],
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                text=True,
            )
            running.append(shown)
        yield watch.pid, int(line.strip().rstrip('/').rpartition(':')[2])
    finally:
        for process in reversed(running):
            process.terminate()
            process.wait(30.0)


def connections(port: int) -> int:
    """Return the number of established connections to a port of this machine."""
    rows = (line.split() for line in Path('/proc/net/tcp').read_text('ascii').splitlines()[1:])
    return sum(row[1].endswith(f':{port:04X}') and row[3] == '01' for row in rows)


def measure() -> dict[str, list[float]]:
    """Return CPU of the nodes alone and with a page, and of `needle watch`, by round [%]."""
    found: dict[str, list[float]] = {}
    with TemporaryDirectory(ignore_cleanup_errors=True) as name, Graph(Path(name)) as graph:
        node: Node = graph.node('bench')
        factors: list[float] = []

        def hear(array: DiagnosticArray) -> None:
            found = [one.status for one in read_reports(array)]
            factors.extend(one.real_time_factor for one in found if isinstance(one, PlantStatus))

        node.create_subscription(DiagnosticArray, '/diagnostics', hear, 10)
        pids = {
            'plant': graph.start('plant', _PLANT).process.pid,
            'controller': graph.start('controller', _NEEDLE).process.pid,
        }
        graph.spin_until(lambda: factors and node.count_subscribers('target'), 'nodes', 180.0)

        def spin(span: float) -> None:
            end = time.monotonic() + span
            graph.spin_until(lambda: time.monotonic() > end, 'time', 2.0 * span + 60.0)

        def take(what: str, more: dict[str, int]) -> None:
            spin(SETTLE)
            factors.clear()
            watched = {**pids, **more}
            begin, spent = time.monotonic(), {k: cpu_seconds(pid) for k, pid in watched.items()}
            spin(TURN)
            wall = time.monotonic() - begin
            taken = wall * float(np.mean(factors))
            for key, pid in watched.items():
                share = 100.0 * (cpu_seconds(pid) - spent[key]) / taken
                found.setdefault(f'{key}, {what}', []).append(share)
            found.setdefault(f'real time, {what}', []).append(100.0 * taken / wall)

        for k in range(ROUNDS):
            take('alone', {})
            with page(graph, f'{name}/browser_{k}') as (watch, port):
                graph.spin_until(partial(connections, port), 'the page')
                take('with a page', {'needle watch': watch})
            sys.stderr.write(f'round {k + 1} of {ROUNDS}\n')
    return found


def main() -> int:
    """Measure, and print the results; return 1 if the bar is missed."""
    found = measure()
    for what, shares in found.items():
        sys.stdout.write(f'{what}: {np.median(shares):.1f} % {np.round(shares, 1)}\n')
    ratios = {
        node: np.divide(found[f'{node}, with a page'], found[f'{node}, alone'])
        for node in ('plant', 'controller')
    }
    for node, values in ratios.items():
        sys.stdout.write(f'{node}: {np.median(values):.3f} times {np.round(values, 3)}\n')
    bar = Bar('CPU of the plant with a page', float(np.median(ratios['plant'])), LARGEST)
    sys.stdout.write(f'{bar.verdict}: {bar.figure} {bar.found:.3f}, at most {bar.limit:g}\n')
    return int(bar.missed)


if __name__ == '__main__':
    sys.exit(main())
