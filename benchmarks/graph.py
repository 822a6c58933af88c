# SPDX-License-Identifier: Apache-2.0
"""
Cost of the nodes compared with bare rclpy nodes with the same messages and rates.

Four pairs of a plant and a controller take turns, each on its own domain: the nodes of this
package; bare nodes with message objects; bare nodes with serialized messages, as this package has
them; and the nodes of this package with a flexible needle. All use the events executor and exclude
loaded objects from garbage collection. First the plants publish without commands, then the loops
are closed, then the controllers respond to a probe in this process instead of the plant. A ratio
is the median over the rounds of the ratios within a round, so that other load of the machine
affects all alike.

Then the recorder records numbered messages, and the memory of the nodes is measured.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
import gc
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
import time
from typing import Final

from benchmarks.bare import PERIOD, RATE, Sender, STREAMS
from benchmarks.endurance import record, watch_memory
from benchmarks.measure import Bar
from benchmarks.page import Answer, PageSection, Tick
from benchmarks.pairs import Figures, Pair, PAIRS, TARGETS
from geometry_msgs.msg import WrenchStamped
from needle_insertion.graph.ros_graph import Graph, GraphError
from needle_ros.base_node import COMMAND, SENSOR
import numpy as np
from sensor_msgs.msg import JointState

#: Bars: p50 and p99 of the times, and CPU of the plant, relative to bare nodes.
TIMES: Final = {'p50': 1.3, 'p99': 1.5}
PLANT_CPU: Final = 1.5


@dataclass(frozen=True, slots=True, kw_only=True)
class GraphPlan:
    """Rounds, and duration of a turn, of the recording and of the memory measurement [s]."""

    rounds: int = 8
    turn: float = 2.0
    recording: float = 10.0
    memory: float = 20.0


PLANS: Final = {
    'default': GraphPlan(),
    'quick': GraphPlan(rounds=1, turn=0.5, recording=2.0, memory=2.0),
    'full': GraphPlan(recording=60.0, memory=600.0),
}


def compare(tick: Tick, plan: str = 'default') -> Answer:
    """Measure the nodes of this package and bare nodes; `plan` is a key of `PLANS`."""
    durations = PLANS[plan]
    # Exclude loaded objects from garbage collection during the timing.
    gc.collect()
    gc.freeze()
    try:
        with TemporaryDirectory() as name:
            folder = Path(name)
            found = compare_pairs(folder, durations, tick)
            tick('recorder')
            recorded, losses = record(folder / 'recording', durations.recording)
            watched, growth = watch_memory(folder / 'memory', durations.memory, tick)
    finally:
        gc.unfreeze()
    section, bars = side_by_side(found, durations)
    return [section, *recorded, *watched], [*bars, *losses, *growth]


def compare_pairs(folder: Path, plan: GraphPlan, tick: Tick) -> dict[str, list[Figures]]:
    """Start the pairs, let them take turns, and return the metrics of each round by pair."""
    with ExitStack() as stack:
        pairs = {}
        for name in PAIRS:
            tick(f'starting: {name}')
            graph = stack.enter_context(Graph(folder / name))
            pairs[name] = Pair(name, graph)
            stack.callback(pairs[name].end)
            pairs[name].start('plant')
        for pair in pairs.values():
            pair.ready('plant')
        rounds = [_take_turns('publishing', pairs, _publish, plan, tick)]
        for pair in pairs.values():
            pair.start('controller')
        for pair in pairs.values():
            pair.ready('controller')
        rounds.append(_take_turns('loop', pairs, _close_loop, plan, tick))
        for pair in pairs.values():
            pair.kill('plant')
        for pair in pairs.values():
            # Measurements of two publishers are refused.
            pair.wait_for_end('plant')
        rounds.append(_take_turns('round trip', pairs, _answer_probe, plan, tick))
    return {
        name: [
            {key: value for figures in together for key, value in figures.items()}
            for together in zip(*(one[name] for one in rounds), strict=True)
        ]
        for name in PAIRS
    }


def _take_turns(
    stage: str,
    pairs: Mapping[str, Pair],
    job: Callable[[Pair, float], Figures],
    plan: GraphPlan,
    tick: Tick,
) -> dict[str, list[Figures]]:
    """Return the metrics of the rounds by pair; the first pair rotates between rounds."""
    found: dict[str, list[Figures]] = {name: [] for name in pairs}
    for k in range(plan.rounds):
        tick(f'{stage}, round {k + 1} of {plan.rounds}')
        for name in (*PAIRS[k % len(PAIRS) :], *PAIRS[: k % len(PAIRS)]):
            found[name].append(job(pairs[name], plan.turn))
    return found


def _publish(pair: Pair, turn: float) -> Figures:
    """Run the plant without commands; this process subscribes to all its topics."""
    topics = {topic: (kind, SENSOR) for topic, kind in STREAMS.items()}
    with pair.watching(topics) as seen, pair.running():
        found = pair.measure(turn, seen)
    return {'CPU of the plant, no commands [%]': found['CPU of the plant [%]']}


def _close_loop(pair: Pair, turn: float) -> Figures:
    """Run plant and controller in closed loop."""
    topics = {'joint_states': (JointState, SENSOR), 'wrench_command': (WrenchStamped, COMMAND)}
    with pair.watching(topics) as seen, pair.running():
        pair.until(lambda: all(seen.values()), 'the loop')
        pair.aim()
        found = pair.measure(turn, seen)
        samples, commands = seen['joint_states'], seen['wrench_command']
        arrived = dict.fromkeys(stamp for _, stamp in samples)
        return {
            **_quantiles('sample to command', [at - s for at, s in commands if s in arrived]),
            **_quantiles('sample to joint_states', [at - s for at, s in samples]),
            **_quantiles('period', [b[0] - a[0] for a, b in pairwise(samples)], True),
            'samples late by a period [%]': 100.0
            * float(np.mean([at - s > PERIOD for at, s in samples])),
            **found,
        }


def _answer_probe(pair: Pair, turn: float) -> Figures:
    """Publish the messages of a plant, and time the commands in response."""
    left: dict[int, int] = {}
    sender, start, sent, over = Sender(pair.node), time.time_ns(), 0, False

    def tick() -> None:
        nonlocal sent
        # One sample at a time; late samples are discarded. A tick may be in progress at the end.
        if not over and (due := (time.time_ns() - start) // PERIOD) > sent:
            sent = due
            left[start + sent * PERIOD] = sender.send(start + sent * PERIOD, TARGETS[0])

    timer = pair.node.create_timer(1.0 / RATE, tick)
    with pair.watching({'wrench_command': (WrenchStamped, COMMAND)}) as seen:

        def times() -> list[int]:
            return [at - left[s] for at, s in seen['wrench_command'] if s in left]

        pair.until(times, 'the answer')
        pair.aim(TARGETS[0])
        pair.measure(turn, seen)
        # On a busy machine the messages may be commands after a lost measurement.
        pair.until(times, 'an answer')
    over = True
    pair.node.destroy_timer(timer)
    sender.destroy(pair.node)
    return _quantiles('round trip', times(), True)


def _quantiles(what: str, times: Sequence[float], worst: bool = False) -> Figures:
    """Return the median, the 99 % quantile and optionally the maximum of times [ns], in us."""
    if not times:
        raise GraphError(f'no messages to measure the {what}')
    p50, p99, maximum = np.quantile(times, [0.5, 0.99, 1.0]) * 1e-3
    found = {f'{what}, p50 [us]': float(p50), f'{what}, p99 [us]': float(p99)}
    return {**found, f'{what}, worst [us]': float(maximum)} if worst else found


def ratio(ours: Sequence[Figures], theirs: Sequence[Figures], what: str) -> float:
    """
    Return the median of the ratios of a metric within the rounds.

    NaN for a maximum, and if all values of the other pair are zero.
    """
    if 'worst' in what:
        return float('nan')
    figures = [(a[what], b[what]) for a, b in zip(ours, theirs, strict=True)]
    ratios = [a / b for a, b in figures if b]
    return float(np.median(ratios)) if ratios else float('nan')


def side_by_side(
    found: Mapping[str, list[Figures]], plan: GraphPlan
) -> tuple[PageSection, list[Bar]]:
    """Return a table of the metrics of the pairs with ratios, and the bars."""
    ours, bare, in_bytes, steered = (found[name] for name in PAIRS)

    def median(figures: Sequence[Figures], what: str) -> str:
        values = [one[what] for one in figures]
        return f'{max(values) if "worst" in what else np.median(values):.4g}'

    def times(value: float) -> str:
        return '' if np.isnan(value) else f'{value:.2f} x'

    rows = [
        (
            what,
            median(ours, what),
            median(bare, what),
            times(ratio(ours, bare, what)),
            median(in_bytes, what),
            times(ratio(ours, in_bytes, what)),
            median(steered, what),
            times(ratio(steered, bare, what)),
        )
        for what in ours[0]
    ]
    limits = {
        f'{what}, {share} [us]': limit
        for what in ('round trip', 'sample to command')
        for share, limit in TIMES.items()
    }
    limits |= dict.fromkeys(
        ('CPU of the plant, no commands [%]', 'CPU of the plant [%]'), PLANT_CPU
    )
    bars = [
        Bar(f'{what.partition(" [")[0]}, over bare', ratio(ours, bare, what), limit, 'x')
        for what, limit in limits.items()
    ]
    bars.append(
        Bar(
            'CPU of the plant that bends, over bare',
            ratio(steered, bare, 'CPU of the plant [%]'),
            PLANT_CPU,
            'x',
        )
    )
    section = PageSection(
        'Nodes and bare nodes',
        (f'{RATE} Hz', PAIRS[0], PAIRS[1], 'ratio', PAIRS[2], 'ratio', PAIRS[3], 'over bare'),
        rows,
        f'{plan.rounds} rounds of {plan.turn:g} s. Each figure is the median over the rounds, '
        'and each ratio the median of the ratios within the rounds. A worst value is the largest '
        'of all rounds. The rows mean:\n\n'
        '- **CPU:** user and system time of all threads of a process, as a share of one core.\n'
        '- **No commands:** the plant publishes and nothing answers.\n'
        '- **Sample to command:** from the time of a sample of the plant to the arrival of the '
        'command that answers it, in a third process.\n'
        '- **Sample to `joint_states`:** from the time of a sample to its arrival in the third '
        'process.\n'
        '- **Period:** between arrivals of `joint_states` in the third process.\n'
        '- **Late by a period:** arrived more than a period after the time of the sample.\n'
        '- **Round trip:** from `joint_states` to `wrench_command`, seen by a probe in the place '
        'of the plant.',
    )
    return section, bars
