# SPDX-License-Identifier: Apache-2.0
"""Test the node `slicer` for minutes: targets in, shapes out, and kills of both sides."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
import time
from typing import Any, Final

from benchmarks.endurance import GROWTH, level, resident_memory, warm_memory
from benchmarks.igtl_peer import free_port, Peer, SENT, Told
from benchmarks.measure import Bar, number
from benchmarks.page import Answer, PageSection, Tick
from benchmarks.pairs import cpu_seconds
from geometry_msgs.msg import PointStamped
from needle_insertion.graph.ros_graph import Graph
from needle_ros.base_node import COMMAND
import numpy as np

#: A flexible needle at rest.
_PLANT: Final = {
    'needle': 'bending_35mm',
    'steered': True,
    'mode': 'robot',
    'rate': 200.0,
    'depth': 0.06,
}

#: First target, and increment of x, by which each target is identified [mm].
_TARGET: Final = (0.0, 80.0, 0.0)
_STEP: Final = 1e-3

#: Nominal rate, smallest rate in a window [Hz], and the window [s].
_RATE: Final = 20.0
_LEAST_RATE: Final = 19.5
_WINDOW: Final = 10.0

#: Longest time from a peer to the topic [ms].
_DELAY: Final = 200.0

#: Longest time from a kill to the next shape, including the start of the node [s].
_AGAIN: Final = 15.0

#: Number of received shapes before a kill.
_SOME: Final = 20


#: Duration of the measurement [s].
PLANS: Final = {'default': 600.0, 'quick': 20.0}


def compare(tick: Tick, plan: str = 'default') -> Answer:
    """Run the node for some minutes, kill it, then kill its peer; `plan` is a key of `PLANS`."""
    with TemporaryDirectory() as name:
        return _watch(Path(name), PLANS[plan], tick)


def _watch(folder: Path, duration: float, tick: Tick) -> Answer:
    arrived: list[tuple[float, float]] = []
    memory: list[tuple[float, list[int]]] = []
    port = free_port()
    with Graph(folder / 'logs') as graph:
        watch = graph.node('watch')

        def on_target(message: Any) -> None:
            arrived.append((1e3 * message.point.x, time.monotonic()))

        watch.create_subscription(PointStamped, 'target', on_target, COMMAND)
        graph.start('plant', _PLANT)
        node = graph.start('slicer', {'port': port})
        peer = Peer(folder, port, _TARGET, _STEP)
        try:
            graph.spin_until(lambda: peer.told('NeedleShapeHeader') and arrived, 'the peer')
            begin, spent = time.monotonic(), cpu_seconds(node.process.pid)
            while (now := time.monotonic()) < begin + duration:
                tick(f'watch, {now - begin:.0f} of {duration:.0f} s')
                memory.append((now - begin, [resident_memory(node.process.pid)]))
                end = now + 1.0
                graph.spin_until(lambda end=end: time.monotonic() > end, 'a second')  # type: ignore[misc]
            share = 100.0 * (cpu_seconds(node.process.pid) - spent) / (time.monotonic() - begin)
            shapes = [one for one in peer.told('NeedleShapeHeader') if one.arrived > begin]
            # The last targets may be in transmission. A new peer restarts the numbers.
            sent = [one for one in peer.told(SENT) if begin < one.arrived < now - 1.0]
            delays = _delays(sent, arrived)

            tick('the node is killed')
            killed = time.monotonic()
            node.kill()
            node = graph.start('slicer', {'port': port})
            after_node = _again(graph, peer, killed)

            tick('the peer is killed')
            killed = time.monotonic()
            peer.kill()
            peer = Peer(folder, port, _TARGET, _STEP)
            after_peer = _again(graph, peer, killed)
        finally:
            peer.kill()
        node.interrupt()
    return _answer(duration, shapes, delays, memory, share, (after_node, after_peer))


def _again(graph: Graph, peer: Peer, since: float) -> float:
    """Wait for some shapes; return the time of the first [s]."""

    def come() -> list[Told]:
        return [one for one in peer.told('NeedleShapeHeader') if one.arrived > since]

    def enough() -> bool:
        found = come()
        # Shapes from before the kill may be in the buffers of the system.
        return len(found) > _SOME and found[-1].arrived - found[0].arrived > 1.0

    graph.spin_until(enough, 'shapes after a kill', 60.0)
    times = [one.arrived for one in come()]
    gaps = np.diff([since, *times])
    # The longest gap is caused by the kill.
    return float(times[int(np.argmax(gaps))] - since)


def _delays(sent: list[Told], arrived: list[tuple[float, float]]) -> list[float]:
    """Return the delay of each target, or of the next received target, from peer to topic [s]."""
    places, times = np.array(arrived).T
    # Half a step: messages have 24 bits.
    first = np.searchsorted(places, [one.content[0] - 0.5 * _STEP for one in sent])
    came = np.append(times, np.inf)[first]
    return [float(one) for one in came - [one.arrived for one in sent]]


def _answer(
    duration: float,
    shapes: list[Told],
    delays: list[float],
    memory: list[tuple[float, list[int]]],
    share: float,
    again: tuple[float, float],
) -> Answer:
    numbers = [int(one.content.split(';')[1]) for one in shapes]
    missing = numbers[-1] - numbers[0] + 1 - len(numbers)
    stamps = np.array([one.time for one in shapes])
    gaps = np.diff([one.arrived for one in shapes])
    width = round(_RATE * min(_WINDOW, 0.5 * duration))
    windows = width / (stamps[width:] - stamps[:-width])
    rate = (len(stamps) - 1) / (stamps[-1] - stamps[0])
    warm = warm_memory(memory, duration)
    (early,), (late,) = level(warm, 0.0), level(warm, 1.0)
    rows = [
        ('shapes', f'{len(shapes)}'),
        ('shapes per second by their stamps [Hz]', f'{rate:.3f}'),
        (f'the same, least in {width / _RATE:g} s [Hz]', f'{windows.min():.3f}'),
        ('shapes lost', f'{missing}'),
        (
            'between two shapes, p50, p99, longest [ms]',
            ', '.join(f'{1e3 * one:.0f}' for one in (*np.percentile(gaps, [50, 99]), gaps.max())),
        ),
        ('targets sent', f'{len(delays)}'),
        (
            'until it, or a newer one, is on its topic, p50, p99, longest [ms]',
            ', '.join(
                f'{1e3 * one:.0f}' for one in (*np.percentile(delays, [50, 99]), max(delays))
            ),
        ),
        ('CPU of the node [%]', f'{share:.1f}'),
        ('memory of the node, warm and at the end [MB]', f'{early:.2f}, {late:.2f}'),
        ('first shape after the node was killed, and started again [s]', number(again[0])),
        ('first shape after the peer was killed, and started again [s]', number(again[1])),
    ]
    section = PageSection(
        'Node slicer with a peer',
        ('metric', 'found'),
        rows,
        f'{duration:g} s with a plant and a client of pyigtl that sends 10 targets a second; '
        'then node and peer are killed in turn.',
    )
    bars = [
        Bar('shapes per second, worst window', float(windows.min()), _LEAST_RATE, 'Hz', True),
        Bar('shapes lost', float(missing), 0.0),
        Bar('target to its topic, p99', 1e3 * float(np.percentile(delays, 99)), _DELAY, 'ms'),
        Bar(f'growth of memory in {duration:g} s', float(late - early), GROWTH, 'MB'),
        Bar('first shape after a kill', max(again), _AGAIN, 's'),
    ]
    return [section], bars
