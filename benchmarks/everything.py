# SPDX-License-Identifier: Apache-2.0
"""
All nodes at once for ten minutes: memory, lost samples, and latency at the start and at the end.

Plant, controller, steering, recorder and slicer run with a peer of 3D Slicer and two pages of
`needle watch`, while a needle is steered to targets and withdrawn. Run it from a clone: ``python
-m benchmarks.everything``, with a rate of the plant [Hz] and a duration [s] if not the default.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import cycle
from pathlib import Path
import sys
from tempfile import TemporaryDirectory
import time
from typing import Any, Final, TypeVar

from benchmarks.endurance import memory_growth, resident_memory
from benchmarks.igtl_peer import free_port, Peer
from benchmarks.measure import Bar
from benchmarks.page import Answer, PageSection
from benchmarks.watching import connections, page
from needle_identification import Bag
from needle_insertion.graph.ros_graph import Graph, GraphError
from needle_insertion.live.operator import Operator, RequestOutcome
from needle_ros.contract import JOINT_STATES, WRENCH_COMMAND
from needle_ros.status import NodeStatus, PlantStatus, SteeringPhase, SteeringStatus
import numpy as np

#: Needle of all nodes.
_NEEDLE: Final[dict[str, object]] = {'needle': 'bending_35mm'}

#: Targets of the tip [m].
_TARGETS: Final = ((1.5e-3, 0.07, -1e-3), (-1e-3, 0.06, 1e-3), (0.0, 0.065, 0.0))

#: Depth to which the needle is withdrawn after each insertion, and its upper limit [m].
_RETRACTED: Final = 0.005
_AWAY: Final = _RETRACTED + 5e-4

_Status = TypeVar('_Status', bound=NodeStatus)

#: Bar on the growth of memory [MB], and factor by which the latency may grow.
_GROWTH, _SLOWER = 3.0, 1.1

#: Part of the recording whose latency is compared: after a warm-up as long, and at the end.
_PART: Final = 0.1


def measure(folder: Path, rate: float, duration: float) -> Answer:
    """Run all nodes for a duration [s]; return memory, losses and latency."""
    both, port = {**_NEEDLE, 'rate': rate}, free_port()
    given: Mapping[str, dict[str, object]] = {
        'recorder': {'path': str(folder / 'bag')},
        'controller': {
            **both,
            'retract_depth': _RETRACTED,
            'steered': True,
            'deflection_feedback': 'none',
        },
        'steering': _NEEDLE,
        'slicer': {'port': port},
        'plant': {**both, 'steered': True, 'depth': _RETRACTED},
    }
    memory: list[tuple[float, list[int]]] = []
    with Graph(folder / 'logs') as graph:
        node = graph.node('bench')
        operator = Operator(node)
        pids = {name: graph.start(name, own).process.pid for name, own in given.items()}
        for name in given:
            graph.wait_active(node, name)
        with page(graph, str(folder / 'browser'), 2) as (watch, watched):
            peer = Peer(folder, port)
            try:
                pids['watch'] = watch
                insertions = Insertions(graph, operator)
                insertions.until(lambda: {*given} <= {*operator.states}, 'a status of each node')
                insertions.until(lambda: connections(watched) >= 2, 'the pages')
                insertions.until(lambda: peer.told('NeedleShapeHeader'), 'the peer')
                begin = time.monotonic()

                def sample() -> None:
                    now = time.monotonic() - begin
                    if not memory or now - memory[-1][0] > 0.1:
                        memory.append((now, [resident_memory(pid) for pid in pids.values()]))

                insertions.run(duration, sample)
                skipped = insertions.status('plant', PlantStatus).skipped
            finally:
                peer.kill()
    (section,), bars = memory_growth(list(pids), memory, duration, _GROWTH)
    stamps, latency = answers(folder / 'bag')
    missing = round(float(stamps[-1] - stamps[0]) * 1e-9 * rate) + 1 - len(stamps) - skipped
    part = max(1, round(_PART * len(latency)))
    ends = latency[part : 2 * part], latency[-part:]
    rows = [
        ('insertions', str(insertions.completed)),
        ('samples', str(len(stamps))),
        ('samples skipped by the plant', str(skipped)),
        ('other samples missing in the bag', str(missing)),
        ('samples without a command in the bag', str(len(stamps) - len(latency))),
        *(
            (
                f'{name} of the latency, start and end [ms]',
                ', '.join(f'{1e3 * v:.2f}' for v in two),
            )
            for name, two in (
                ('median', [float(np.median(one)) for one in ends]),
                ('99 %', [float(np.quantile(one, 0.99)) for one in ends]),
            )
        ),
    ]
    medians = [float(np.median(one)) for one in ends]
    bars += [
        Bar('samples missing in the bag', float(missing), 0.0),
        Bar('latency at the end, relative to the start', medians[1] / medians[0], _SLOWER),
    ]
    notes = (
        f'{duration:g} s at {rate:g} Hz; latency: from a sample to its command in the recorder.'
    )
    return [section, PageSection('All nodes', ('metric', 'found'), rows, notes)], bars


class Insertions:
    """Steer the needle to one target after another, and withdraw it after each."""

    def __init__(self, graph: Graph, operator: Operator) -> None:
        self._graph, self._operator = graph, operator
        self.completed = 0

    def until(self, condition: Callable[[], Any], what: str) -> None:
        """Spin until a condition holds."""
        self._graph.spin_until(condition, what, 180.0, period=0.05)

    def run(self, duration: float, sample: Callable[[], None]) -> None:
        """Insert for a duration [s]; call `sample` all the time."""
        end = time.monotonic() + duration
        for target in cycle(_TARGETS):
            for what, is_done in (
                (
                    target,
                    lambda: self.status('steering', SteeringStatus).phase is SteeringPhase.DONE,
                ),
                (
                    'retract',
                    lambda: (self.status('plant', PlantStatus).insertion_depth or 0.0) < _AWAY,
                ),
            ):
                self._request(what)

                def passes(is_done: Callable[[], bool] = is_done) -> bool:
                    sample()
                    steering = self.status('steering', SteeringStatus)
                    if steering.phase is SteeringPhase.STOPPED:
                        raise GraphError(f'the insertion was stopped: {steering.fault}')
                    return time.monotonic() > end or is_done()

                self.until(passes, f'the end of {what}')
                if time.monotonic() > end:
                    return
            self.completed += 1

    def _request(self, what: str | tuple[float, float, float]) -> None:
        if isinstance(what, str):
            answer = self._operator.ask(what)
            self.until(answer.done, f'the answer to {what}')
            outcome: RequestOutcome = answer.result()  # type: ignore[no-untyped-call]
            if not outcome.success:
                raise GraphError(f'{what}: {outcome.message}')
            return
        # A retraction ends some time after the needle is at rest.
        accepted = False
        while not accepted:
            pending = self._operator.target(*what)
            self.until(lambda pending=pending: pending.done, f'the answer to {what}')  # type: ignore[misc]
            accepted, line = pending.outcome
            sys.stderr.write(f'{line}\n')

    def status(self, name: str, kind: type[_Status]) -> _Status:
        """Return the latest status of a node."""
        found = self._operator.states[name].report.status
        if not isinstance(found, kind):
            raise GraphError(f'{name} reports {found}')
        return found


def answers(path: Path) -> tuple[Any, Any]:
    """Return the stamps of all samples [ns], and the time until their commands [s]."""
    found: dict[str, list[Any]] = {JOINT_STATES.name: [], WRENCH_COMMAND.name: []}
    bag = Bag(path)
    for batch in bag.batches(lambda topic: topic.name.lstrip('/') in found):
        # The time stamp follows the four bytes of the encoding.
        words = batch.data[batch.begin[:, np.newaxis] + np.arange(4, 12)].view('<i4')
        stamps = words[:, 0].astype(np.int64) * 1_000_000_000 + words[:, 1]
        found[batch.topic.name.lstrip('/')].append(np.stack([stamps, batch.received]))
    samples, commands = (np.concatenate(parts, axis=1) for parts in found.values())
    _, at, to = np.intersect1d(samples[0], commands[0], return_indices=True)
    return samples[0], (commands[1, to] - samples[1, at]) * 1e-9


def main() -> int:
    """Measure, and print the results; return 1 if a bar is missed."""
    rate, duration = map(float, sys.argv[1:] or ('1000', '600'))
    with TemporaryDirectory(ignore_cleanup_errors=True) as name:
        sections, bars = measure(Path(name), rate, duration)
    for section in sections:
        sys.stdout.write(f'{section}\n\n')
    for bar in bars:
        sys.stdout.write(f'{bar.verdict}: {bar.figure} {bar.found:.3f}, at most {bar.limit:g}\n')
    return int(any(bar.missed for bar in bars))


if __name__ == '__main__':
    sys.exit(main())
