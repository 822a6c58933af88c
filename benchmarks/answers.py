# SPDX-License-Identifier: Apache-2.0
"""
Response times of nodes in separate processes.

``python -m benchmarks.answers --count 300``: time from a trajectory to the status "accepted" or
"rejected" of the controller, read from ``/diagnostics``. With ``--configure``: response times of
``get_state`` from the start of a node without compiled functions until it is active.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from functools import partial
from pathlib import Path
import sys
from tempfile import TemporaryDirectory
from time import monotonic
from typing import Final

from benchmarks.measure import Bar
from benchmarks.page import PageSection, report
from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.srv import GetState
from needle_insertion.graph.ros_graph import Graph, GraphError
from needle_ros import contract
from needle_ros.base_node import COMMAND
from needle_ros.requests import Verdict
from needle_ros.status import ControllerPhase, ControllerStatus, read_reports
from needle_ros.timing import nanoseconds
import numpy as np
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

#: Longest permitted response time [s].
LONGEST: Final = 0.2

#: Insertion depths [m]: current depth, and a depth outside the range.
_DEPTHS: Final = {Verdict.ACCEPTED: 0.02, Verdict.REJECTED: 5.0}

#: Longest pause between two trajectories [s]; pauses are shorter and longer than the status
#: period.
_PAUSE: Final = 0.15

#: Nodes that compile functions, and time between two requests [s].
_COMPILING: Final = 'plant', 'controller', 'steering'
_INTERVAL: Final = 0.02

#: Timeout of their activation [s].
_START: Final = 180.0


class Countdown:
    """Timeout [s] from now."""

    def __init__(self, duration: float) -> None:
        self._end = monotonic() + duration

    def over(self) -> bool:
        return monotonic() > self._end


def measure(count: int, seed: int, rate: float, logs: Path) -> dict[Verdict, list[float]]:
    """Send valid and invalid trajectories in turn; return the response times [s] by verdict."""
    rng = np.random.default_rng(seed)
    times: dict[Verdict, list[float]] = {verdict: [] for verdict in _DEPTHS}
    with Graph(logs) as graph:
        node = graph.node('sender')
        heard: dict[int, tuple[float, Verdict]] = {}
        active: list[bool] = []

        def hear(array: DiagnosticArray) -> None:
            for report in read_reports(array):
                if isinstance(found := report.status, ControllerStatus):
                    active.append(found.phase is ControllerPhase.ACTIVE)
                    for answer in found.requests.answers:
                        heard.setdefault(answer.stamp, (monotonic(), answer.verdict))

        node.create_subscription(DiagnosticArray, contract.DIAGNOSTICS.name, hear, COMMAND)
        topic = contract.JOINT_TRAJECTORY.name
        publisher = node.create_publisher(JointTrajectory, topic, COMMAND)
        graph.start('plant', {'depth': _DEPTHS[Verdict.ACCEPTED], 'rate': rate})
        graph.start('controller', {'rate': rate})
        graph.spin_until(
            lambda: publisher.get_subscription_count() and any(active), 'the controller', 180.0
        )
        for number in range(count):
            verdict = list(_DEPTHS)[number % 2]
            point = JointTrajectoryPoint(positions=[_DEPTHS[verdict]])
            point.time_from_start.sec = 1
            message = JointTrajectory(joint_names=[contract.INSERTION], points=[point])
            message.header.stamp = node.get_clock().now().to_msg()
            stamp, begun = nanoseconds(message.header.stamp), monotonic()
            publisher.publish(message)
            graph.spin_until(partial(heard.__contains__, stamp), 'the answer')
            at, found = heard[stamp]
            if found is verdict:
                times[verdict].append(at - begun)
            pause = Countdown(float(rng.uniform(0.0, _PAUSE)))
            graph.spin_until(pause.over, 'the next one')
    return times


def measure_configuring(name: str, logs: Path) -> list[float]:
    """Start a node with an empty cache; return the response times of ``get_state`` [s]."""
    times: list[float] = []
    with Graph(logs) as graph:
        graph.environment['NUMBA_CACHE_DIR'] = str(logs / 'empty')
        node = graph.node('user')
        graph.start(name)
        graph.wait_for(node, name)
        client = node.create_client(GetState, f'{name}/get_state')
        graph.spin_until(client.service_is_ready, 'the service')
        label, limit = '', Countdown(_START)
        while label != 'active':
            if limit.over():
                raise GraphError(f'{name} is {label} {_START:g} s after its start')
            begun = monotonic()
            response = client.call_async(GetState.Request())
            graph.spin_until(response.done, 'the response')
            times.append(monotonic() - begun)
            label = response.result().current_state.label
            pause = Countdown(_INTERVAL)
            graph.spin_until(pause.over, 'the next request')
    return times


def main(words: Sequence[str] | None = None) -> int:
    """Measure, print a table and the verdict; return the exit status."""
    parser = argparse.ArgumentParser('benchmarks.answers', description=__doc__)
    parser.add_argument('--count', type=int, default=300, help='number of trajectories')
    parser.add_argument('--seed', type=int, default=1, help='seed of the pauses')
    parser.add_argument('--rate', type=float, default=1000.0, help='rate of the nodes [Hz]')
    parser.add_argument(
        '--configure', action='store_true', help='of nodes that compile, in place of trajectories'
    )
    given, begun = parser.parse_args(words), monotonic()
    with TemporaryDirectory() as folder:
        logs = Path(folder)
        if given.configure:
            found = {name: measure_configuring(name, logs / name) for name in _COMPILING}
        else:
            answers = measure(given.count, given.seed, given.rate, logs)
            found = {verdict.value: times for verdict, times in answers.items()}
    rows, slowest = [], 0.0
    for name, times in found.items():
        p50, p99, longest = 1e3 * np.percentile(times, [50.0, 99.0, 100.0])
        rows.append((name, str(len(times)), f'{p50:.2f}', f'{p99:.2f}', f'{longest:.2f}'))
        slowest = max(slowest, float(longest))
    heads = 'answer', 'count', 'p50 ms', 'p99 ms', 'longest ms'
    bar = Bar('longest time to an answer', slowest, 1e3 * LONGEST, 'ms')
    return report([PageSection('Answers', heads, rows)], [bar], monotonic() - begun)


if __name__ == '__main__':
    sys.exit(main())
