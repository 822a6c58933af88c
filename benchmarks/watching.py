"""
What `needle watch` with an open page costs the plant.

A plant and a controller at 1 kHz run all the time. In each round their CPU time is measured twice:
alone, and with `needle watch` and a browser that shows its page. A ratio is the median over the
rounds of the ratios within a round. Run it from a clone: ``python -m benchmarks.watching``.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
import shutil
import subprocess
import sys
from tempfile import TemporaryDirectory
import time
from typing import Final

from benchmarks.measure import Bar
from benchmarks.pairs import cpu_seconds
from needle_insertion.experiment.ros_graph import Graph
from needle_ros.base_node import SENSOR
from needle_ros.errors import JobError
import numpy as np
from rclpy.node import Node
from sensor_msgs.msg import JointState

#: CPU of the plant with a page over that without.
LARGEST: Final = 1.1

#: Rounds, time that is measured in each half of one, and time before it [s].
ROUNDS, TURN, SETTLE = 5, 6.0, 4.0

#: A needle that bends, half way in.
_NEEDLE: Final[dict[str, object]] = {'model.preset': 'bending_35mm'}
_PLANT: Final = {**_NEEDLE, 'steered': True, 'depth': 0.06}

_BROWSERS: Final = ('chromium', 'chromium-browser', 'google-chrome')


@contextmanager
def page(graph: Graph, folder: str) -> Iterator[tuple[int, int]]:
    """
    Show the page within a ``with`` statement.

    Parameters
    ----------
    graph : Graph
        What it shows.
    folder : str
        Folder for the browser.

    Yields
    ------
    int, int
        Process ids of `needle watch` and of the browser.

    Raises
    ------
    JobError
        If there is no browser, or no page.

    """
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
        shown: subprocess.Popen[str] = subprocess.Popen(
            [browser, *options, f'--user-data-dir={folder}', line.removeprefix('page: ').strip()],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            text=True,
        )
        running.append(shown)
        yield watch.pid, shown.pid
    finally:
        for process in reversed(running):
            process.terminate()
            process.wait(30.0)


def measure() -> dict[str, list[float]]:
    """Return CPU of the nodes alone and with a page, and of `needle watch`, by round [%]."""
    found: dict[str, list[float]] = {}
    with TemporaryDirectory(ignore_cleanup_errors=True) as name, Graph(Path(name)) as graph:
        node: Node = graph.node('bench')
        state = graph.latest(node, JointState, 'joint_states', SENSOR)
        pids = {
            'plant': graph.start('plant', _PLANT).process.pid,
            'controller': graph.start('controller', _NEEDLE).process.pid,
        }
        graph.spin_until(lambda: state.message and node.count_subscribers('target'), 'nodes', 180)
        # It would cost the plant as well.
        graph.executor.remove_node(node)
        for topic in [*node.subscriptions]:
            node.destroy_subscription(topic)

        def take(what: str, more: dict[str, int]) -> None:
            time.sleep(SETTLE)
            watched = {**pids, **more}
            begin, spent = time.monotonic(), {k: cpu_seconds(pid) for k, pid in watched.items()}
            time.sleep(TURN)
            wall = time.monotonic() - begin
            for key, pid in watched.items():
                share = 100.0 * (cpu_seconds(pid) - spent[key]) / wall
                found.setdefault(f'{key}, {what}', []).append(share)

        for k in range(ROUNDS):
            take('alone', {})
            with page(graph, f'{name}/browser_{k}') as (watch, _):
                take('with a page', {'needle watch': watch})
            sys.stderr.write(f'round {k + 1} of {ROUNDS}\n')
    return found


def main() -> int:
    """Measure, and print what was found; return 1 if the bar is missed."""
    found = measure()
    for what, shares in found.items():
        sys.stdout.write(f'CPU of {what}: {np.median(shares):.1f} % {np.round(shares, 1)}\n')
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
