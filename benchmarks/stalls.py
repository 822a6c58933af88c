# SPDX-License-Identifier: Apache-2.0
"""
Velocity of the needle after stalls: suspended nodes and lost messages during an insertion.

`insert` connects plant and supervisor in simulated time; `measure` suspends real nodes (SIGSTOP).
``python -m benchmarks.stalls`` prints a table of both.
"""

from __future__ import annotations

import argparse
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import product
from pathlib import Path
import signal
import subprocess
import sys
from tempfile import TemporaryDirectory
from time import monotonic
from typing import Any, Final, NamedTuple

from benchmarks.loop import Loop, MEASURED, Sent
from geometry_msgs.msg import PointStamped
from needle_controller import (
    Controller,
    ControllerSettings,
    ForceCommand,
    ObserverSettings,
    SafetyLimits,
)
from needle_controller.gains import LAWS
from needle_controller.reference.quintic import PEAK_SPEED
from needle_controller.steering.motion import smooth
from needle_dynamics import NeedleParameters
from needle_dynamics.simulated.run import Event, PARAMETERS
from needle_insertion.graph.ros_graph import Graph
from needle_insertion.report.content import table
from needle_ros.base_node import COMMAND, SENSOR
from needle_ros.contract import NEWEST
from needle_ros.timing import NANOSECONDS, nanoseconds
from needle_ros.trajectories import JointPath
import numpy as np
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

#: What stalls: a suspended node, or a topic whose messages are lost.
VICTIMS: Final = ('plant', 'controller', 'measurements', 'commands')

#: Limit of the velocity of the reference [m/s], and time over which velocities are averaged [s].
LIMIT: Final = 0.01
WINDOW: Final = 0.01

#: Start and target of the insertion [m], and duration of the path between them at the limit [s].
START, TARGET = 0.02, 0.05
_DURATION: Final = PEAK_SPEED * (TARGET - START) / (0.999 * LIMIT)

#: Longest time that a suspended plant computes later [s].
_BACKLOG: Final = 0.05


class Stall(NamedTuple):
    """
    A stall.

    Attributes
    ----------
    victim : str
        One of `VICTIMS`.
    after : float
        Time since the end of the previous stall, or since the start [s].
    lasts : float
        Duration [s].

    """

    victim: str
    after: float
    lasts: float


class StalledLoop(Loop):
    """
    A plant and its controller in simulated time, each of which may be suspended.

    Attributes
    ----------
    track : list of tuple
        Stamp [ns] and true insertion depth [m] of each sample.
    references : list of tuple
        Position and velocity of the reference in each command [m, m/s].
    ages : list of int
        Age of the sample of each command [ns].
    busy : int
        Number of periods that the controller needs for a sample; 1 if it takes all that wait.

    """

    def __init__(
        self, law: str = LAWS[0], rate: float = 1000.0, kind: str = 'trapezoid', **options: Any
    ) -> None:
        super().__init__(law, rate, **options)
        settings = ControllerSettings(rate=rate)
        controller = Controller(
            NeedleParameters.preset('phantom'), law, settings=settings, reference=kind
        )
        self.supervisor.configure(controller, SafetyLimits(), ObserverSettings())
        self.supervisor.activate(self.now, self.publishers)
        self.track: list[tuple[int, float]] = []
        self.references: list[tuple[float, ...]] = []
        self.ages: list[int] = []
        self._ends_at = dict.fromkeys(VICTIMS, 0)
        self._received = {name: deque[bytes](maxlen=NEWEST.depth) for name in MEASURED}
        self._sampled = self.now
        self.busy, self._turn = 1, 0

    def stall(self, victim: str, lasts: float) -> None:
        """Suspend a node, or lose the messages of a topic, for a time from now on [s]."""
        self._ends_at[victim] = self.now + round(lasts * NANOSECONDS)

    def follow(self, end: float, duration: float) -> None:
        """Send a path of minimum jerk to an insertion depth [m], as the node `steering` does."""
        move = smooth(('insertion',), np.array([self.depth]), np.array([end]), duration)
        path = JointPath(
            move.joints, move.times.tolist(), move.positions.tolist(), move.velocities.tolist()
        )
        self.supervisor.trajectory(0, '', path, self.now)

    def change(self, **friction: float) -> None:
        """Change the ``coulomb`` friction [N] or ``viscous`` friction [N s/m] of the needle."""
        values = {f'model.{kind}_friction': value for kind, value in friction.items()}
        self.run.perform(Event(PARAMETERS, values))

    def _stalls(self, victim: str) -> bool:
        return self.now < self._ends_at[victim]

    def step(self, *_: Any) -> None:
        """Continue by a period."""
        self.now += self._period
        if not self._stalls('plant'):
            # Older samples are skipped: the needle has not moved then.
            oldest = self.now - round(_BACKLOG * NANOSECONDS)
            self._sampled = max(self._sampled + self._period, oldest)
            for stamp in range(self._sampled, self.now + 1, self._period):
                self._sample(stamp)
            self.run.commands.count_commanders(1)
        if not self._stalls('controller'):
            self._turn += 1
            if self._turn % self.busy == 0:
                for _once in range(NEWEST.depth if self.busy == 1 else 1):
                    self._take_next()
            self._answer(self.supervisor.watch(self.now, self.publishers), None)
        self.depth = self.run.plant.depth

    def _take_next(self) -> None:
        """Process the next message of each topic."""
        for name, waiting in self._received.items():
            if waiting:
                reading = self._ends[name][1](waiting.popleft())
                self._answer(self._take[name](reading, self.now), None)

    def _sample(self, stamp: int) -> None:
        self._sampled = stamp
        told = {name: values for name, _, values in self.run.take(stamp)}
        self.track.append((stamp, self.run.plant.depth))
        if not self._stalls('measurements'):
            for name, waiting in self._received.items():
                if name in told:
                    waiting.append(self._written(name, Sent(stamp, told[name])))

    def _answer(self, answer: ForceCommand | None, _fault: object) -> None:
        if answer is None:
            return
        self.ages.append(self.now - answer.stamp)
        if answer.reference:
            self.references.append(answer.reference)
        if not self._stalls('commands'):
            self.run.commands.offer(answer.stamp, 'needle_base', answer.force, 0.0, self.now)


def fastest(track: Sequence[tuple[int, float]]) -> tuple[float, float]:
    """Return the highest mean velocities into the tissue and out of it over `WINDOW` [m/s]."""
    stamps, depths = np.array([one[0] for one in track]), np.array([one[1] for one in track])
    later = np.searchsorted(stamps, stamps + round(0.99 * WINDOW * NANOSECONDS))
    first = np.flatnonzero(later < len(stamps))
    later = later[first]
    elapsed = (stamps[later] - stamps[first]) / NANOSECONDS
    # Without windows in which samples are missing: the plant skips samples while the needle rests,
    # and an overloaded probe loses messages.
    whole = elapsed < 1.6 * WINDOW
    velocities = (depths[later] - depths[first])[whole] / elapsed[whole]
    return float(velocities.max()), -float(velocities.min())


class StalledInsertion(NamedTuple):
    """
    Outcome of an insertion with stalls.

    Attributes
    ----------
    inward, outward : float
        Highest mean velocity of the needle over `WINDOW`, into the tissue and out of it [m/s].
    reference : float
        Highest speed of the reference [m/s].
    depth : float
        Final insertion depth [m].
    stop : str
        Reason of a stop, or ''.

    """

    inward: float
    outward: float
    reference: float
    depth: float
    stop: str


def insert(
    law: str, request: str, stalls: Sequence[Stall], *, rate: float = 1000.0, **options: Any
) -> StalledInsertion:
    """Insert to a ``target`` or along a ``path``, with stalls, until 4 s after their end."""
    loop = StalledLoop(law, rate, **options)
    for _ in range(20):
        loop.step()
    if request == 'target':
        loop.target(TARGET)
    else:
        loop.follow(TARGET, _DURATION)
    for stall in (*stalls, Stall('', _DURATION, 0.0)):
        for _ in range(max(1, round(stall.after * rate))):
            loop.step()
        if stall.victim:
            loop.stall(stall.victim, stall.lasts)
            for _ in range(round(stall.lasts * rate)):
                loop.step()
    speeds = [abs(one[1]) for one in loop.references]
    reason = loop.supervisor.authority.reason
    return StalledInsertion(*fastest(loop.track), max(speeds), loop.depth, reason)


def draw(rng: np.random.Generator, victim: str, shortest: float, longest: float) -> list[Stall]:
    """Draw stalls within some 3 s of motion, with durations in a range [s], evenly in log."""
    stalls: list[Stall] = []
    while sum(one.after for one in stalls) < 3.0:
        lasts = float(np.exp(rng.uniform(np.log(shortest), np.log(longest))))
        pause = min(1.0, 4.0 * lasts)
        who = str(rng.choice(VICTIMS)) if victim == 'any' else victim
        stalls.append(Stall(who, float(rng.uniform(0.005, max(0.01, pause))), lasts))
    return stalls


# Real nodes.

#: Keeps a processor busy.
_BUSY: Final = 'while True: pass'

#: Parameters of all nodes for a needle that is steered.
_STEERED: Final = {'needle': 'bending_35mm'}


class RealNodes:
    """Plant and controller as processes in real time, also ``steered``, and a probe."""

    def __init__(
        self, graph: Graph, *, steered: bool = False, rate: float = 1000.0, law: str = LAWS[0]
    ) -> None:
        self._graph, self.track = graph, list[tuple[int, float]]()
        both: dict[str, object] = {'rate': rate}
        if steered:
            both |= {**_STEERED, 'steered': True}
        depth = 0.001 if steered else START
        self.nodes = {
            'plant': graph.start('plant', {**both, 'depth': depth}),
            'controller': graph.start('controller', {**both, 'law': law}),
        }
        if steered:
            self.nodes['steering'] = graph.start('steering', _STEERED)
        probe = graph.node('probe')
        probe.create_subscription(JointState, 'joint_states', self._on_sample, SENSOR)
        self._targets = probe.create_publisher(PointStamped, 'target', COMMAND)
        self._paths = probe.create_publisher(JointTrajectory, 'joint_trajectory', COMMAND)
        for name in self.nodes:
            graph.wait_active(probe, name)
        self.until(lambda: self.track, 'a sample')

    def _on_sample(self, message: JointState) -> None:
        self.track.append((nanoseconds(message.header.stamp), message.position[0]))

    def until(self, condition: Any, what: str) -> None:
        """Spin until a condition holds."""
        self._graph.spin_until(condition, what, timeout=120.0)

    def passes(self, time: float) -> None:
        """Spin for a time [s]."""
        end = monotonic() + time
        self.until(lambda: monotonic() > end, 'time')

    @property
    def depth(self) -> float:
        """Last measured insertion depth [m]."""
        return self.track[-1][1]

    def begin(self, request: str, depth: float = TARGET) -> None:
        """Send a ``target``, to ``steering`` or not, or a ``path``, until the needle moves."""
        target, start = PointStamped(), self.depth
        target.point.y = depth
        if 'steering' in self.nodes:
            target.point.x, target.point.z = 1.5e-3, -1e-3
        move = smooth(('insertion',), np.array([start]), np.array([depth]), _DURATION)
        path = JointTrajectory(joint_names=['insertion'])
        for time, at, rate in zip(move.times, move.positions, move.velocities, strict=True):
            point = JointTrajectoryPoint(positions=at.tolist(), velocities=rate.tolist())
            point.time_from_start.sec = int(time)
            point.time_from_start.nanosec = int(time % 1.0 * NANOSECONDS)
            path.points.append(point)
        sent = 0.0

        def moves() -> bool:
            nonlocal sent
            # A request may be lost before discovery; a repeated path starts again.
            if monotonic() - sent > 5.0:
                sent = monotonic()
                if request == 'path':
                    self._paths.publish(path)
                else:
                    self._targets.publish(target)
            return abs(self.depth - start) > 5e-4

        self.until(moves, 'motion')

    def stall(self, name: str, lasts: float) -> None:
        """Suspend a node for a time [s]."""
        process = self.nodes[name].process
        process.send_signal(signal.SIGSTOP)
        try:
            self.passes(lasts)
        finally:
            process.send_signal(signal.SIGCONT)


@contextmanager
def busy(count: int) -> Iterator[None]:
    """Keep processors busy with a number of processes."""
    processes = [subprocess.Popen([sys.executable, '-c', _BUSY]) for _ in range(count)]
    try:
        yield
    finally:
        for one in processes:
            one.kill()
            one.wait()


def measure(
    request: str,
    stalls: Sequence[Stall],
    *,
    load: int = 0,
    rate: float = 1000.0,
    law: str = LAWS[0],
) -> tuple[float, float, float]:
    """Return the highest mean velocities in and out [m/s], and the final depth [m]."""
    with TemporaryDirectory() as logs, Graph(Path(logs)) as graph:
        nodes = RealNodes(graph, steered=request == 'steering', rate=rate, law=law)
        nodes.begin(request)
        with busy(load):
            for stall in stalls:
                nodes.passes(stall.after)
                nodes.stall(stall.victim, stall.lasts)
            nodes.passes(2.0)
        return *fastest(nodes.track), nodes.depth


def main(words: Sequence[str] | None = None) -> int:
    """Print the highest velocities; return the exit status."""
    parser = argparse.ArgumentParser('benchmarks.stalls', description=__doc__)
    parser.add_argument('--count', type=int, default=3, help='insertions per row')
    parser.add_argument('--seed', type=int, default=1, help='seed of the random choices')
    parser.add_argument('--nodes', action='store_true', help='real nodes')
    parser.add_argument('--load', type=int, default=0, help='busy processes beside the nodes')
    given = parser.parse_args(words)
    rows = []
    requests = ('target', 'path', 'steering') if given.nodes else ('target', 'path')
    for law, request in product(LAWS, requests):
        victims = ['any', *VICTIMS]
        if given.nodes:
            victims = [*VICTIMS[:2], *(['steering'] if request == 'steering' else [])]
        for victim in victims:
            for shortest, longest in ((0.005, 0.1), (0.05, 5.0)):
                rng = np.random.default_rng(given.seed)
                found: list[Any] = []
                for _ in range(given.count):
                    stalls = draw(rng, victim, shortest, longest)
                    if given.nodes:
                        found.append(measure(request, stalls, load=given.load, law=law))
                    else:
                        found.append(insert(law, request, stalls))
                numbers = [1e3 * max(one[k] for one in found) for k in (0, 1)]
                depths = [1e3 * one[2 if given.nodes else 3] for one in found]
                row = (
                    law, request, victim, f'{shortest:g} to {longest:g}',
                    *(f'{one:.1f}' for one in numbers), f'{min(depths):.1f}',
                    '' if given.nodes else ' '.join({one.stop for one in found}),
                )  # fmt: skip
                rows.append(row)
                sys.stdout.write('\t'.join(row) + '\n')
                sys.stdout.flush()
    heads = ('law', 'request', 'victim', 'durations [s]', 'in [mm/s]', 'out [mm/s]',
             'least depth [mm]', 'stop')  # fmt: skip
    sys.stdout.write(f'{table(rows, heads)}\n')
    return 0


if __name__ == '__main__':
    sys.exit(main())
