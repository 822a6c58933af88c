"""
What the nodes cost beside bare rclpy nodes that send the same messages at the same rate.

Three camps take turns, each on a domain of its own, with a plant and a controller as processes:
the suite's; bare nodes on the events executor, which the suite uses too; bare nodes on rclpy's
usual executor. In turn they publish without commands, close the loop, and answer a probe in this
process that stands where the plant is. A ratio is the median over the rounds of the ratios within
a round, so that whatever else the machine does weighs on all alike.

Then the recorder takes numbered messages, and the suite's nodes run on while their memory is
watched.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, ExitStack
from dataclasses import dataclass
from functools import partial
import gc
from itertools import pairwise
import os
from pathlib import Path
import subprocess
import sys
from tempfile import TemporaryDirectory
import time
from typing import Any, Final, TypeAlias

from benchmarks.bare import PERIOD, RATE, Sender, STREAMS
from benchmarks.measure import Bar
from benchmarks.page import Answer, Section, Tick, version
from geometry_msgs.msg import PointStamped, WrenchStamped
from needle_identification import Bag
from needle_insertion.experiment.ros_graph import (
    ACTIVATE,
    CONFIGURE,
    DEACTIVATE,
    Graph,
    GraphError,
)
from needle_ros.base_node import COMMAND, LATCHED, SENSOR
from needle_ros.timing import nanoseconds
import numpy as np
from rclpy.qos import QoSProfile
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool

#: Figures of one turn by name.
Figures: TypeAlias = dict[str, float]

#: Executors of the bare camps by name.
_BARE: Final = {'bare': 'events', 'bare, usual executor': 'single'}
CAMPS: Final = ('needle', *_BARE)

#: Bars: round trip p50 and p99 and CPU of the plant over those of bare nodes, growth [MB].
ROUND_TRIP: Final = {'p50': 1.3, 'p99': 1.5}
PLANT_CPU: Final = 1.5
GROWTH: Final = 2.0

#: Time at the start of a turn that does not count, of a recording and of a watch likewise [s].
_SETTLE: Final = 0.5
_FIRST: Final = 1.0
_WARM_UP: Final = 60.0

#: Depths to go to, so that the needle is on its way [m], and how often they change [s].
_TARGETS: Final = (0.06, 0.09)
_TARGET_PERIOD: Final = 2.0

#: Times at which the memory is shown, as shares of the watch.
_SHOWN: Final = (0.1, 0.25, 0.5, 0.75, 1.0)

_PAGE: Final = os.sysconf('SC_PAGE_SIZE')


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """
    How long to measure.

    Attributes
    ----------
    rounds : int
        Turns of each camp in each of the three comparisons.
    turn, recording, memory : float
        Time of a turn, of the recording and of the watch of the memory [s].

    """

    rounds: int = 8
    turn: float = 2.0
    recording: float = 10.0
    memory: float = 20.0


PLANS: Final = {
    'default': Plan(),
    'quick': Plan(rounds=1, turn=0.5, recording=2.0, memory=2.0),
    'full': Plan(recording=60.0, memory=600.0),
}


def cpu_seconds(process: int) -> float:
    """Return the CPU time that a process has had, all threads, user and system [s]."""
    # The clock that clock_getcpuclockid(3) gives: /proc/PID/stat counts in 10 ms only.
    return time.clock_gettime(~process << 3 | 2)


def resident_memory(process: int) -> int:
    """Return the memory of a process that is in RAM [bytes]."""
    return int(Path(f'/proc/{process}/statm').read_text('ascii').split()[1]) * _PAGE


class Camp:
    """
    A plant and a controller as processes, ours or bare, and the node that watches them.

    Parameters
    ----------
    name : str
        One of `CAMPS`.
    graph : Graph
        Where they live.

    """

    def __init__(self, name: str, graph: Graph) -> None:
        self.graph = graph
        self.node = graph.node(f'watch_{CAMPS.index(name)}')
        self.pids: dict[str, int] = {}
        self._bare: list[subprocess.Popen[bytes]] = []
        self._executor = _BARE.get(name)
        self._run = self.node.create_publisher(Bool, 'run', LATCHED)
        self._target = self.node.create_publisher(PointStamped, 'target', COMMAND)
        self._targets = 0

    def start(self, what: str) -> None:
        """Start the plant or the controller."""
        if self._executor is None:
            self.pids[what] = self.graph.start(what, {'autostart': False}).process.pid
        else:
            self.start_bare({'plant': 'plant', 'controller': 'echo'}[what], self._executor)
            self.pids[what] = self._bare[-1].pid

    def start_bare(self, role: str, executor: str = 'events') -> subprocess.Popen[bytes]:
        """Start a bare node."""
        process = subprocess.Popen(
            [sys.executable, '-m', 'benchmarks.bare', role, executor],
            env=self.graph.environment,
            stdout=subprocess.PIPE,
        )
        self._bare.append(process)
        return process

    def ready(self, what: str) -> None:
        """Wait for what was started, and make it ready."""
        if self._executor is None:
            self.graph.change(self.node, what, CONFIGURE)
            if what == 'controller':
                self.graph.change(self.node, what, ACTIVATE)
        topic = {'plant': 'joint_states', 'controller': 'wrench_command'}[what]
        self.until(lambda: self.node.count_publishers(topic), topic)

    def end(self) -> None:
        """End the bare nodes; the graph ends the others."""
        for process in self._bare:
            process.kill()
        for process in self._bare:
            process.wait()
            if process.stdout is not None:
                process.stdout.close()

    def until(self, condition: Callable[[], Any], what: str, timeout: float = 120.0) -> None:
        """Spin until a condition holds; raise `GraphError` if it does not, or a node ends."""

        def holds() -> Any:
            ended = [p.args for p in self._bare if p.poll() is not None]
            if ended:
                raise GraphError(f'a bare node ended early: {ended}')
            return condition()

        self.graph.spin_until(holds, what, timeout)

    def spin(self, duration: float) -> None:
        """Spin for a time [s]."""
        end = time.monotonic() + duration
        self.until(lambda: time.monotonic() >= end, 'the end', duration + 30.0)

    @contextmanager
    def running(self) -> Iterator[None]:
        """Let the plant sample."""
        if self._executor is None:
            self.graph.change(self.node, 'plant', ACTIVATE)
        else:
            self._run.publish(Bool(data=True))
        yield
        if self._executor is None:
            self.graph.change(self.node, 'plant', DEACTIVATE)
        else:
            self._run.publish(Bool(data=False))

    def say(self, run: bool) -> None:
        """Tell a bare node to run or to stop."""
        self._run.publish(Bool(data=run))

    def aim(self, depth: float | None = None) -> None:
        """Have the controller go to a depth, or to the next of several [m]."""
        target = PointStamped()
        target.point.y = _TARGETS[self._targets % 2] if depth is None else depth
        self._targets += 1
        self._target.publish(target)

    @contextmanager
    def watching(
        self, topics: Mapping[str, tuple[type, QoSProfile]]
    ) -> Iterator[dict[str, list[tuple[int, int]]]]:
        """Note when each message of some topics comes, and its stamp [ns]."""
        seen: dict[str, list[tuple[int, int]]] = {topic: [] for topic in topics}

        def note(rows: list[tuple[int, int]], message: Any) -> None:
            rows.append((time.time_ns(), nanoseconds(message.header.stamp)))

        subscriptions = [
            self.node.create_subscription(kind, topic, partial(note, seen[topic]), qos)
            for topic, (kind, qos) in topics.items()
        ]
        yield seen
        for subscription in subscriptions:
            self.node.destroy_subscription(subscription)

    def measure(self, turn: float, seen: Mapping[str, list[tuple[int, int]]]) -> Figures:
        """
        Watch for a turn after what is seen has settled.

        Returns
        -------
        dict
            CPU share of each process [%]; ``seen`` holds what came meanwhile.

        """
        self.until(lambda: all(seen.values()), f'{", ".join(seen)}')
        self.spin(_SETTLE)
        for rows in seen.values():
            rows.clear()
        spent = {what: cpu_seconds(pid) for what, pid in self.pids.items()}
        begin = time.monotonic()
        self.spin(turn)
        wall = time.monotonic() - begin
        return {
            f'CPU of the {what} [%]': 100.0 * (cpu_seconds(pid) - spent[what]) / wall
            for what, pid in self.pids.items()
        }


def quantiles(what: str, times: Sequence[float], worst: bool = False) -> Figures:
    """Return p50 and p99, and the greatest, of times [ns] in us."""
    if not times:
        raise GraphError(f'nothing to tell the {what} from')
    p50, p99, greatest = np.quantile(times, [0.5, 0.99, 1.0]) * 1e-3
    found = {f'{what}, p50 [us]': float(p50), f'{what}, p99 [us]': float(p99)}
    return {**found, f'{what}, worst [us]': float(greatest)} if worst else found


def publishing(camp: Camp, turn: float) -> Figures:
    """Let the plant publish; no commands come, and everything is read."""
    topics = {topic: (kind, SENSOR) for topic, kind in STREAMS.items()}
    with camp.watching(topics) as seen, camp.running():
        found = camp.measure(turn, seen)
    return {'CPU of the plant, no commands [%]': found['CPU of the plant [%]']}


def loop(camp: Camp, turn: float) -> Figures:
    """Let plant and controller close the loop."""
    topics = {
        'joint_states': (JointState, SENSOR),
        'wrench_command': (WrenchStamped, COMMAND),
    }
    with camp.watching(topics) as seen, camp.running():
        camp.until(lambda: all(seen.values()), 'the loop')
        camp.aim()
        found = camp.measure(turn, seen)
        samples, commands = seen['joint_states'], seen['wrench_command']
        arrived = dict.fromkeys(stamp for _, stamp in samples)
        return {
            **quantiles('sample to command', [at - s for at, s in commands if s in arrived]),
            **quantiles('sample to joint_states', [at - s for at, s in samples]),
            **quantiles('period', [b[0] - a[0] for a, b in pairwise(samples)], True),
            'samples late by a period [%]': 100.0
            * float(np.mean([at - s > PERIOD for at, s in samples])),
            **found,
        }


def answer(camp: Camp, turn: float) -> Figures:
    """Stand where the plant is and send its messages; time the commands that come back."""
    left: dict[int, int] = {}
    sender, start, sent, over = Sender(camp.node), time.time_ns(), 0, False

    def tick() -> None:
        nonlocal sent
        # No more than one at a time: what is late is left out. A tick may be under way at the end.
        if not over and (due := (time.time_ns() - start) // PERIOD) > sent:
            sent = due
            left[start + sent * PERIOD] = sender.send(start + sent * PERIOD, _TARGETS[0])

    timer = camp.node.create_timer(1.0 / RATE, tick)
    with camp.watching({'wrench_command': (WrenchStamped, COMMAND)}) as seen:
        camp.until(lambda: any(s in left for _, s in seen['wrench_command']), 'the answer')
        camp.aim(_TARGETS[0])
        camp.measure(turn, seen)
        times = [at - left[s] for at, s in seen['wrench_command'] if s in left]
    over = True
    camp.node.destroy_timer(timer)
    sender.destroy(camp.node)
    return quantiles('round trip', times, True)


def compared(
    camps: Mapping[str, Camp],
    job: Callable[[Camp, float], Figures],
    plan: Plan,
    tick: Tick,
) -> dict[str, list[Figures]]:
    """Let the camps take turns; return the figures of the rounds by camp."""
    found: dict[str, list[Figures]] = {name: [] for name in camps}
    for k in range(plan.rounds):
        tick(f'{job.__name__}, round {k + 1} of {plan.rounds}')
        # Nobody is always the first.
        for name in (*CAMPS[k % len(CAMPS) :], *CAMPS[: k % len(CAMPS)]):
            found[name].append(job(camps[name], plan.turn))
    return found


def middle(figures: Sequence[Figures], what: str) -> float:
    """Return the median of a figure over the rounds; of what is worst the greatest."""
    values = [one[what] for one in figures]
    return max(values) if 'worst' in what else float(np.median(values))


def ratio(ours: Sequence[Figures], theirs: Sequence[Figures], what: str) -> float:
    """Return the median of the ratios within the rounds; not a number if it says nothing."""
    if 'worst' in what:
        return float('nan')
    pairs = [(a[what], b[what]) for a, b in zip(ours, theirs, strict=True)]
    ratios = [a / b for a, b in pairs if b]
    return float(np.median(ratios)) if ratios else float('nan')


def record(folder: Path, duration: float) -> Answer:
    """
    Record numbered messages and count those that are missing in the bag.

    Parameters
    ----------
    folder : Path
        Where to record to.
    duration : float
        Time [s]; the first second does not count.

    Returns
    -------
    sections : list of Section
        Messages sent and lost.
    bars : list of Bar
        Losses.

    """
    topics = [*STREAMS, 'wrench_command']
    with Graph(folder / 'logs') as graph, ExitStack() as stack:
        camp = Camp(CAMPS[1], graph)
        stack.callback(camp.end)
        settings = {'path': str(folder / 'bag'), 'topics': topics}
        recorder = graph.start('recorder', settings)
        graph.wait_for(camp.node, 'recorder')
        source = camp.start_bare('source')
        camp.until(lambda: camp.node.count_publishers('wrench_command'), 'the source')
        camp.say(True)
        camp.until(lambda: camp.node.count_subscribers('wrench_command'), 'the recorder')
        camp.spin(_FIRST)
        pids = {'recorder': recorder.process.pid, 'source': source.pid}
        spent, begin = {n: cpu_seconds(p) for n, p in pids.items()}, time.monotonic()
        camp.spin(duration)
        wall = time.monotonic() - begin
        shares = {n: 100.0 * (cpu_seconds(p) - spent[n]) / wall for n, p in pids.items()}
        camp.say(False)
        # Nothing more is sent after this line.
        said = source.stdout.readline().split() if source.stdout else []
        camp.spin(_FIRST)
        recorder.interrupt()
    sent, taken = int(said[0]), float(said[1])
    numbers = sample_numbers(folder / 'bag')
    lost = losses(numbers, sent)
    rows = [
        ('messages sent', f'{len(topics) * sent}'),
        ('per second', f'{len(topics) * sent / taken:.0f}'),
        ('lost', ', '.join(f'{n} of {t}' for t, n in lost.items() if n) or 'none'),
        ('doubled', f'{sum(len(n) - len(np.unique(n)) for n in numbers.values())}'),
        *((f'CPU of the {name} [%]', f'{share:.1f}') for name, share in shares.items()),
    ]
    section = Section(
        'Recorder', ('figure', 'found'), rows, f'{len(topics)} topics, {duration:g} s.'
    )
    total = float(sum(lost.values()))
    return [section], [Bar(f'messages lost by the recorder in {duration:g} s', total, 0.0)]


def losses(numbers: Mapping[str, Any], sent: int) -> dict[str, int]:
    """
    Count the samples that are missing after the first second.

    Parameters
    ----------
    numbers : Mapping[str, ndarray]
        Numbers of the samples that are there by topic; the first has the number 1.
    sent : int
        Number of the last sample.

    Returns
    -------
    dict[str, int]
        Missing samples by topic.

    """
    first = round(_FIRST * RATE)
    return {
        topic: sent - first - len(np.unique(found[(found > first) & (found <= sent)]))
        for topic, found in numbers.items()
    }


def sample_numbers(path: Path) -> dict[str, Any]:
    """Return the numbers in the stamps of a bag's messages by topic."""
    numbers: dict[str, list[Any]] = {topic: [] for topic in (*STREAMS, 'wrench_command')}
    bag = Bag(path)
    for batch in bag.batches(lambda topic: topic.name.lstrip('/') in numbers):
        # After the four bytes that say how the rest is encoded comes the stamp.
        stamps = batch.data[batch.begin[:, np.newaxis] + np.arange(4, 12)].view('<i4')
        found = (stamps[:, 0].astype(np.int64) * 1_000_000_000 + stamps[:, 1]) // PERIOD
        numbers[batch.topic.name.lstrip('/')].append(found)
    if bag.losses:
        raise GraphError(f'the bag is not whole: {"; ".join(bag.losses)}')
    return {topic: np.concatenate(found or [np.empty(0, int)]) for topic, found in numbers.items()}


def watch_memory(folder: Path, duration: float, tick: Tick) -> Answer:
    """
    Run plant, controller and recorder, and watch their memory.

    Parameters
    ----------
    folder : Path
        Where to record to.
    duration : float
        Time [s]; what is used in the first tenth of it, at most a minute, is warm-up.
    tick : callable
        Told how far it is.

    Returns
    -------
    sections : list of Section
        Memory of each node over time.
    bars : list of Bar
        The greatest growth after the warm-up.

    """
    names = ('plant', 'controller', 'recorder')
    rows: list[tuple[float, list[int]]] = []
    with Graph(folder / 'logs') as graph:
        camp = Camp(CAMPS[0], graph)
        pids = [
            graph.start(name, {'path': str(folder / 'bag')} if name == 'recorder' else {})
            for name in names
        ]
        for name in names:
            graph.wait_for(camp.node, name)
        begin = time.monotonic()
        aimed = -_TARGET_PERIOD
        while (now := time.monotonic() - begin) < duration:
            if now - aimed >= _TARGET_PERIOD:
                aimed = now
                tick(f'memory, {now:.0f} of {duration:.0f} s')
                camp.aim()
            rows.append((now, [resident_memory(one.process.pid) for one in pids]))
            camp.spin(0.1)
    warm = min(_WARM_UP, 0.1 * duration)
    memory = np.array([values for at, values in rows if at >= warm or at == rows[-1][0]]) / 1e6
    tenth = max(1, len(memory) // 10)

    def around(share: float) -> Any:
        """Return the median over a tenth that ends at a share of the time after the warm-up."""
        end = tenth + round(share * (len(memory) - tenth))
        return np.median(memory[end - tenth : end], axis=0)

    shown = [around(share) for share in _SHOWN]
    growth = around(1.0) - around(0.0)
    columns = [around(0.0), *shown, growth]
    section = Section(
        'Memory',
        ('[MB]', 'warm', *(f'{100 * share:.0f} %' for share in _SHOWN), 'growth'),
        [(name, *(f'{c[k]:.2f}' for c in columns)) for k, name in enumerate(names)],
        f'Resident memory over {duration:g} s, of which {warm:g} s are warm-up.',
    )
    worst = int(np.argmax(growth))
    figure = f'growth of memory in {duration:g} s, largest: {names[worst]}'
    return [section], [Bar(figure, float(growth[worst]), GROWTH, 'MB')]


def compare(tick: Tick, plan: str = 'default') -> Answer:
    """
    Measure the nodes of the suite beside bare ones.

    Parameters
    ----------
    tick : callable
        Called with the name of each stage.
    plan : str
        Duration of the measurements: a key of `PLANS`.

    Returns
    -------
    sections : list of Section
        Times and CPU of the nodes, messages in the bag, memory.
    bars : list of Bar
        Round trip, CPU of the plant, losses of the recorder, growth of memory.

    """
    durations = PLANS[plan]
    # What was loaded so far is not looked through again while messages are timed.
    gc.collect()
    gc.freeze()
    try:
        with TemporaryDirectory() as name:
            folder = Path(name)
            found = compare_camps(folder, durations, tick)
            tick('recorder')
            recorded, losses = record(folder / 'recording', durations.recording)
            watched, growth = watch_memory(folder / 'memory', durations.memory, tick)
    finally:
        gc.unfreeze()
    sections, bars = tabled(found, durations)
    return [*sections, *recorded, *watched], [*bars, *losses, *growth]


def compare_camps(folder: Path, plan: Plan, tick: Tick) -> dict[str, list[Figures]]:
    """Start the camps and let them take turns; return the figures of the rounds by camp."""
    with ExitStack() as stack:
        camps = {}
        for name in CAMPS:
            tick(f'starting: {name}')
            graph = stack.enter_context(Graph(folder / name))
            camps[name] = Camp(name, graph)
            stack.callback(camps[name].end)
            camps[name].start('plant')
        for camp in camps.values():
            camp.ready('plant')
        rounds = [compared(camps, publishing, plan, tick)]
        for camp in camps.values():
            camp.start('controller')
        for camp in camps.values():
            camp.ready('controller')
        rounds += [compared(camps, job, plan, tick) for job in (loop, answer)]
    return {
        name: [
            {key: value for figures in together for key, value in figures.items()}
            for together in zip(*(one[name] for one in rounds), strict=True)
        ]
        for name in CAMPS
    }


def tabled(found: Mapping[str, list[Figures]], plan: Plan) -> Answer:
    """Return the figures of the camps side by side, and the bars."""
    ours, bare, usual = (found[name] for name in CAMPS)

    def times(value: float) -> str:
        return '' if np.isnan(value) else f'{value:.2f} x'

    rows = [
        (
            what,
            f'{middle(ours, what):.4g}',
            f'{middle(bare, what):.4g}',
            times(ratio(ours, bare, what)),
            f'{middle(usual, what):.4g}',
            times(ratio(ours, usual, what)),
        )
        for what in ours[0]
    ]
    bars = [
        Bar(f'{what}, {share}, over bare', ratio(ours, bare, f'{what}, {share} [us]'), most, 'x')
        for what in ('round trip', 'sample to command')
        for share, most in ROUND_TRIP.items()
    ]
    bars += [
        Bar(f'{what}, over bare', ratio(ours, bare, f'{what} [%]'), PLANT_CPU, 'x')
        for what in ('CPU of the plant, no commands', 'CPU of the plant')
    ]
    section = Section(
        'Nodes beside bare nodes',
        (f'{RATE} Hz', CAMPS[0], CAMPS[1], 'ratio', CAMPS[2], 'ratio'),
        rows,
        f'{version("ros-jazzy-rclpy")}; {plan.rounds} rounds of {plan.turn:g} s; medians over the '
        'rounds, also of the ratios; the largest of the worst values.\n\n'
        '- round trip: from `joint_states` to `wrench_command`, seen by a probe in the place of '
        'the plant\n'
        '- sample to command: from the time of a sample of the plant to the arrival of the '
        'command that answers it, in a third process\n'
        '- period: between arrivals of `joint_states` in the third process',
    )
    return [section], bars
