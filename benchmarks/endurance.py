# SPDX-License-Identifier: Apache-2.0
"""Message losses of the recorder at a high rate, and memory growth of the nodes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
import os
from pathlib import Path
import time
from typing import Any, Final

from benchmarks.bare import PERIOD, RATE, STREAMS
from benchmarks.measure import Bar
from benchmarks.page import Answer, PageSection, Tick
from benchmarks.pairs import cpu_seconds, Pair, PAIRS
from needle_identification import Bag
from needle_insertion.graph.ros_graph import Graph
import numpy as np

#: Bar on the growth of the memory of a node [MB].
GROWTH: Final = 2.0

#: Warm-up time of a recording, and of the memory measurement [s].
_FIRST: Final = 1.0
_WARM_UP: Final = 60.0

#: Time between changes of the target [s].
_TARGET_PERIOD: Final = 2.0

#: Times at which the memory is reported, as fractions of the measurement.
_SHOWN: Final = (0.1, 0.25, 0.5, 0.75, 1.0)

_TOPICS: Final = (*STREAMS, 'wrench_command')


def record(folder: Path, duration: float) -> Answer:
    """Record numbered messages for a duration [s], and count the messages missing in the bag."""
    with Graph(folder / 'logs') as graph, ExitStack() as stack:
        watch = Pair(PAIRS[1], graph)
        stack.callback(watch.end)
        settings = {'path': str(folder / 'bag'), 'topics': list(_TOPICS)}
        recorder = graph.start('recorder', settings)
        graph.wait_for(watch.node, 'recorder')
        source = watch.start_bare('source')
        watch.until(lambda: watch.node.count_publishers('wrench_command'), 'the source')
        watch.run_bare(True)
        watch.until(lambda: watch.node.count_subscribers('wrench_command'), 'the recorder')
        watch.spin(_FIRST)
        pids = {'recorder': recorder.process.pid, 'source': source.pid}
        spent, begin = {n: cpu_seconds(p) for n, p in pids.items()}, time.monotonic()
        watch.spin(duration)
        wall = time.monotonic() - begin
        shares = {n: 100.0 * (cpu_seconds(p) - spent[n]) / wall for n, p in pids.items()}
        watch.run_bare(False)
        # The source prints this line after its last message.
        printed = source.stdout.readline().split() if source.stdout else []
        watch.spin(_FIRST)
        recorder.interrupt()
    sent, taken = int(printed[0]), float(printed[1])
    numbers = sample_numbers(folder / 'bag')
    lost = losses(numbers, sent)
    rows = [
        ('messages sent', f'{len(_TOPICS) * sent}'),
        ('per second', f'{len(_TOPICS) * sent / taken:.0f}'),
        ('lost', ', '.join(f'{n} of {t}' for t, n in lost.items() if n) or 'none'),
        ('duplicates', f'{sum(len(n) - len(np.unique(n)) for n in numbers.values())}'),
        *((f'CPU of the {name} [%]', f'{share:.1f}') for name, share in shares.items()),
    ]
    section = PageSection(
        'Recorder', ('metric', 'found'), rows, f'{len(_TOPICS)} topics, {duration:g} s.'
    )
    total = float(sum(lost.values()))
    return [section], [Bar(f'messages lost by the recorder in {duration:g} s', total, 0.0)]


def losses(numbers: Mapping[str, Any], sent: int) -> dict[str, int]:
    """Count the missing samples after the first second, by topic; numbers start at 1."""
    first = round(_FIRST * RATE)
    return {
        topic: sent - first - len(np.unique(found[(found > first) & (found <= sent)]))
        for topic, found in numbers.items()
    }


def sample_numbers(path: Path) -> dict[str, Any]:
    """Read the sample numbers from the time stamps in a bag, by topic."""
    numbers: dict[str, list[Any]] = {topic: [] for topic in _TOPICS}
    bag = Bag(path)
    for batch in bag.batches(lambda topic: topic.name.lstrip('/') in numbers):
        # The time stamp follows the four bytes of the encoding.
        stamps = batch.data[batch.begin[:, np.newaxis] + np.arange(4, 12)].view('<i4')
        found = (stamps[:, 0].astype(np.int64) * 1_000_000_000 + stamps[:, 1]) // PERIOD
        numbers[batch.topic.name.lstrip('/')].append(found)
    # Losses are counted by the numbers of the samples.
    return {topic: np.concatenate(found or [np.empty(0, int)]) for topic, found in numbers.items()}


def resident_memory(process: int) -> int:
    """Return the resident memory of a process [bytes]."""
    pages = int(Path(f'/proc/{process}/statm').read_text('ascii').split()[1])
    return pages * os.sysconf('SC_PAGE_SIZE')


def watch_memory(folder: Path, duration: float, tick: Tick) -> Answer:
    """Run plant, controller and recorder for a duration [s], and measure their memory."""
    names = ('plant', 'controller', 'recorder')
    rows: list[tuple[float, list[int]]] = []
    with Graph(folder / 'logs') as graph:
        watch = Pair(PAIRS[0], graph)
        started = [
            graph.start(name, {'path': str(folder / 'bag')} if name == 'recorder' else {})
            for name in names
        ]
        for name in names:
            graph.wait_for(watch.node, name)
        begin = time.monotonic()
        aimed = -_TARGET_PERIOD
        while (now := time.monotonic() - begin) < duration:
            if now - aimed >= _TARGET_PERIOD:
                aimed = now
                tick(f'memory, {now:.0f} of {duration:.0f} s')
                watch.aim()
            rows.append((now, [resident_memory(one.process.pid) for one in started]))
            watch.spin(0.1)
    return memory_growth(names, rows, duration, GROWTH)


def _warm_up(duration: float) -> float:
    return min(_WARM_UP, 0.1 * duration)


def warm_memory(rows: Sequence[tuple[float, Sequence[int]]], duration: float) -> Any:
    """
    Return the memory of each node after the warm-up [MB], shape (n, nodes).

    Rows have a time [s] and the resident memory of each node [bytes]; the first tenth of the
    duration [s], at most a minute, is warm-up.
    """
    warm = _warm_up(duration)
    return np.array([values for at, values in rows if at >= warm or at == rows[-1][0]]) / 1e6


def level(memory: Any, share: float) -> Any:
    """Return the median over a tenth that ends at a fraction of the time after the warm-up."""
    tenth = max(1, len(memory) // 10)
    end = tenth + round(share * (len(memory) - tenth))
    return np.median(memory[end - tenth : end], axis=0)


def memory_growth(
    names: Sequence[str],
    rows: Sequence[tuple[float, Sequence[int]]],
    duration: float,
    limit: float,
) -> Answer:
    """
    Evaluate rows of a time [s] and the resident memory of each node [bytes].

    `limit` is in MB.
    """
    memory = warm_memory(rows, duration)
    growth = level(memory, 1.0) - level(memory, 0.0)
    columns = [level(memory, 0.0), *(level(memory, share) for share in _SHOWN), growth]
    section = PageSection(
        'Memory',
        ('[MB]', 'warm', *(f'{100 * share:.0f} %' for share in _SHOWN), 'growth'),
        [(name, *(f'{c[k]:.2f}' for c in columns)) for k, name in enumerate(names)],
        f'Resident memory over {duration:g} s, of which {_warm_up(duration):g} s are warm-up.',
    )
    worst = int(np.argmax(growth))
    figure = f'growth of memory in {duration:g} s, largest: {names[worst]}'
    return [section], [Bar(figure, float(growth[worst]), limit, 'MB')]
