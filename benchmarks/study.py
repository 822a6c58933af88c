# SPDX-License-Identifier: Apache-2.0
"""
Studies of populations: insertions per second, memory, and identical tables for all workers.

The studies are examples of `examples/studies`. Workers of each kind are started, and have loaded
or compiled their code, before a rate is measured; then they take turns.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future
from contextlib import AbstractContextManager, contextmanager, ExitStack, nullcontext
from functools import partial
import hashlib
from itertools import count
import os
from pathlib import Path
import signal
import subprocess
import sys
from tempfile import TemporaryDirectory
import time
from typing import Any, Final, NamedTuple, TypeAlias

from benchmarks.kills import kill_again_and_again, Kills
from benchmarks.measure import Bar, least_times, number, seconds
from benchmarks.page import Answer, PageSection, Tick
import dask
from distributed import Client, LocalCluster
from needle_dynamics import FloatArray
from needle_ros.process_pool import processes
from needle_study import engine
from needle_study.study import build_study, read_study, Study
import numpy as np
import psutil
import yaml

#: Studies of the benchmark: steering, and insertion along the axis.
STUDIES: Final = Path(__file__).parents[1] / 'examples/studies'
STUDY: Final = STUDIES / 'steering.yaml'
AXIS: Final = STUDIES / 'insertion.yaml'

#: Changes for needles with a fixed guide: 100 mm in steps of 1 mm.
_OPEN: Final = {'law': 'open_loop', 'depth': 0.1, 'step_length': 1e-3}

#: Warm-up samples of a worker.
_FIRST: Final = 16

#: Number of open-loop insertions for the bar on time.
_MILLION: Final = 1_000_000

#: Insertions per chunk for the cost to the parent: a worker takes a second for them.
_CHUNK: Final = 200

#: Workers of ten machines with 32 cores each.
_WORKERS: Final = 320

#: Settings for workers in docs/howto/study.md. Otherwise each insertion releases and reallocates
#: its memory, and a profiler samples the worker a hundred times per second.
_SETTINGS: Final = {
    'distributed.nanny.pre-spawn-environ.MALLOC_TOP_PAD_': '16777216',
    'distributed.worker.profile.enabled': False,
}

#: Factory of executors for `engine.compute`.
_Factory: TypeAlias = Callable[[], AbstractContextManager[Executor]]


class StudyPlan(NamedTuple):
    """
    Size of the benchmark.

    Attributes
    ----------
    closed : int
        Insertions under our controller in the studies with compared tables.
    timed : int
        Insertions in the timed studies.
    rounds : int
        Number of timings of each study.
    open : tuple of int
        Open-loop insertions in each study with a memory measurement.
    kills : int
        Number of kills of a study.
    chunks : int
        Number of chunks for the cost to the parent.

    """

    closed: int
    timed: int
    rounds: int
    open: tuple[int, int, int]
    kills: int
    chunks: int


PLANS: Final = {
    'default': StudyPlan(10_000, 2000, 5, (1000, 10_000, _MILLION), 10, 2000),
    'quick': StudyPlan(800, 400, 2, (100, 1000, 2000), 2, 100),
}


class Watched(NamedTuple):
    """
    A study that was computed by the command.

    Attributes
    ----------
    taken : float
        Duration [s].
    parent, worker : float
        Peak memory of the command, and the largest peak memory of its workers [MB].

    """

    taken: float
    parent: float
    worker: float


def compare(tick: Tick, plan: str = 'default') -> Answer:
    """
    Compute studies with one and two workers, on a pool and on Dask, and kill them.

    `plan` is a key of `PLANS`.
    """
    chosen = PLANS[plan]
    with TemporaryDirectory() as name:
        return _compare(Path(name), chosen, tick)


def _compare(folder: Path, plan: StudyPlan, tick: Tick) -> Answer:
    study = _study(plan.closed)
    tick('closed loop, in turns')
    least = take_turns(folder / 'timed', _study(plan.timed), plan.rounds)
    tick('closed loop along the axis, in turns')
    axis = _study(plan.timed, file=AXIS)
    along = take_turns(folder / 'timed along', axis, plan.rounds)
    tables, axial = {}, {}
    for name, (begin, workers) in WAYS.items():
        tick(f'closed loop, {plan.closed} insertions: {name}')
        with begin(engine.order(study), workers) as factory:
            tables[name] = computed(folder / name, study, factory, workers)
        with begin(engine.order(axis), workers) as factory:
            axial[name] = computed(folder / f'{name} along', axis, factory, workers)
    tick('Dask, a worker is killed')
    tables['a worker of Dask is killed half way'] = half_way(folder / 'half', study)
    watched = {}
    for size in plan.open:
        tick(f'open loop, {size} insertions')
        watched[size] = watch(folder / f'open_{size}', _study(size, _OPEN))
    tick('the parent alone')
    fed = 1.0 / parent_time(folder / 'parent', _study(plan.chunks * _CHUNK))
    tick('the study is killed')
    small = _study(max(plan.closed // 4, 1))
    kills, same = killed(folder / 'killed', small, plan.kills)
    sections, bars = _answer(plan, least, tables, watched, fed, kills, same)
    section, own = _axial(plan, along, axial)
    return [sections[0], section, *sections[1:]], [*bars, *own]


def _study(samples: int, settings: dict[str, Any] | None = None, file: Path = STUDY) -> Study:
    """Return a study with different numbers."""
    document = read_study(file).document
    return build_study(
        {**document, 'samples': samples, 'settings': {**document['settings'], **(settings or {})}}
    )


def _ready(text: str) -> int:
    """Compute a warm-up; return the process id."""
    engine.chunk(text, 0, _FIRST)
    return os.getpid()


@contextmanager
def pool(text: str, workers: int) -> Iterator[_Factory]:
    """Start a number of processes, each warmed up; yield their factory for `engine.compute`."""
    with processes(workers) as executor:
        ready: set[int] = set()
        while len(ready) < workers:
            ready |= set(executor.map(_ready, [text] * workers))
        yield lambda: nullcontext(executor)


@contextmanager
def cluster(text: str, workers: int) -> Iterator[_Factory]:
    """Start a local Dask cluster, each worker warmed up; yield its factory."""
    with _dask(workers) as client:
        client.run(_ready, text)
        yield partial(engine.dask, client)


@contextmanager
def _dask(workers: int) -> Iterator[Any]:
    with (
        dask.config.set(_SETTINGS),
        LocalCluster(
            n_workers=workers, threads_per_worker=1, host='127.0.0.1', dashboard_address=None
        ) as made_of,
        Client(made_of) as client,
    ):
        yield client


#: Executors, and number of workers.
WAYS: Final = {
    'process pool, 1 worker': (pool, 1),
    'process pool, 2 workers': (pool, 2),
    'Dask, LocalCluster, 2 workers': (cluster, 2),
}


def take_turns(folder: Path, study: Study, rounds: int) -> dict[str, float]:
    """Return the least time of each of `WAYS` for a study, from first sample to table [s]."""
    numbers = count()

    def once(factory: _Factory, workers: int) -> None:
        computed(folder / str(next(numbers)), study, factory, workers)

    with ExitStack() as stack:
        jobs = {
            name: partial(once, stack.enter_context(begin(engine.order(study), workers)), workers)
            for name, (begin, workers) in WAYS.items()
        }
        return least_times(jobs, rounds)


def computed(folder: Path, study: Study, factory: _Factory, workers: int) -> str:
    """Compute a study with the workers of a factory; return the SHA-256 of the table."""
    results = engine.Results(folder, study)
    engine.compute(results, factory, workers, _ignore)
    return _checksum(results.table)


def _ignore(_count: int) -> None:
    """Ignore the progress."""


def half_way(folder: Path, study: Study) -> str:
    """Compute a study on Dask, with one of two workers killed half way; return the SHA-256."""
    results = engine.Results(folder, study)
    with _dask(2) as client:
        victim, done = min(client.run(os.getpid).values()), 0

        def written(count: int) -> None:
            nonlocal done
            before, done = done, done + count
            if before < study.samples / 2 <= done:
                os.kill(victim, signal.SIGKILL)

        engine.compute(results, partial(engine.dask, client), 2, written)
    return _checksum(results.table)


class _Instant(Executor):
    """Returns precomputed chunks, each as if a worker had taken a second."""

    def __init__(self, columns: dict[str, FloatArray]) -> None:
        self._columns = columns

    def submit(self, _function: Any, /, *words: Any, **_options: Any) -> Future[Any]:
        _text, first, count = words
        columns = {name: values[:count] for name, values in self._columns.items()}
        future: Future[Any] = Future()
        future.set_result((count / _CHUNK, {**columns, 'sample': np.arange(first, first + count)}))
        return future


def parent_time(folder: Path, study: Study) -> float:
    """Return the time per chunk of the writing process, from result to table part [s]."""
    results = engine.Results(folder, study)
    columns = study.rows(0, _CHUNK)
    instant = _Instant(columns)
    sizes = list[int]()
    taken = seconds(
        partial(engine.compute, results, lambda: nullcontext(instant), 1, sizes.append)
    )
    return taken / len(sizes)


def watch(folder: Path, study: Study, workers: int = 2) -> Watched:
    """Compute a study by the command `needle study`, and measure its time and memory."""
    begin = time.perf_counter()
    process = subprocess.Popen(_words(folder, study, workers), stdout=subprocess.DEVNULL)
    own, peaks = psutil.Process(process.pid), dict[int, float]()
    while process.poll() is None:
        for one in (own, *_children(own)):
            # A peak only increases; the peak of a forked process does not
            # count.
            peaks[one.pid] = _peak(one.pid) or peaks.get(one.pid, 0.0)
        time.sleep(0.02)
    taken = time.perf_counter() - begin
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, process.args)
    parent = peaks.pop(process.pid)
    return Watched(taken, parent, max(peaks.values()))


def _words(folder: Path, study: Study, workers: int) -> list[str]:
    """Return the command that computes a study."""
    file = folder.with_suffix('.yaml')
    file.write_text(yaml.safe_dump(dict(study.document)), encoding='utf-8')
    command = [sys.executable, '-m', 'needle_insertion.cli', 'study', str(file)]
    return [*command, '--workers', str(workers), '-o', str(folder)]


def _children(process: psutil.Process) -> list[psutil.Process]:
    try:
        return list(process.children(recursive=True))
    except psutil.NoSuchProcess:
        return []


def _peak(process: int) -> float:
    """Return the peak resident memory of a process [MB]; 0 if it has ended."""
    try:
        status = Path(f'/proc/{process}/status').read_text('ascii')
    except (FileNotFoundError, ProcessLookupError):
        return 0.0
    lines = [line for line in status.splitlines() if line.startswith('VmHWM:')]
    return 1.024e-3 * float(lines[0].split()[1]) if lines else 0.0


def killed(folder: Path, study: Study, times: int) -> tuple[Kills, bool]:
    """Kill a study repeatedly, complete it; return the outcome and whether the table is equal."""
    words = _words(folder, study, 2)
    kills = kill_again_and_again(words, folder, times, np.random.default_rng(1))
    subprocess.run(words, stdout=subprocess.DEVNULL, check=True)
    with pool(engine.order(study), 2) as factory:
        whole = computed(folder.with_name('whole'), study, factory, 2)
    return kills, _checksum(folder / engine.TABLE) == whole


def _checksum(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _axial(
    plan: StudyPlan, least: dict[str, float], tables: dict[str, str]
) -> tuple[PageSection, list[Bar]]:
    """Return the table and bars of insertions along the axis."""
    rates = {name: plan.timed / taken for name, taken in least.items()}
    one, two, _ = rates.values()
    section = PageSection(
        'Insertions along the axis under a control law',
        ('who computes', 'per second', 'per second and worker', 'SHA-256 of the table'),
        [
            (name, number(rate), number(rate / WAYS[name][1]), f'`{tables[name][:16]}`')
            for name, rate in rates.items()
        ],
        f'{plan.timed} insertions of `examples/studies/insertion.yaml`, from the first sample to '
        f'the table, the best of {plan.rounds} turns. The time of a million follows from the '
        'rate of two workers.',
    )
    bars = [
        Bar('along the axis, per second and core', one, 500.0, at_least=True),
        Bar('a million along the axis, two workers', _MILLION / two, 1200.0, 's'),
        Bar('tables along the axis that differ', float(len({*tables.values()}) - 1), 0.0),
    ]
    return section, bars


def _answer(
    plan: StudyPlan,
    least: dict[str, float],
    tables: dict[str, str],
    watched: dict[int, Watched],
    fed: float,
    kills: Kills,
    same: bool,
) -> Answer:
    rates = {name: plan.timed / taken for name, taken in least.items()}
    one, two, spread = rates.values()
    small, large = plan.open[1:3]
    each = (watched[large].taken - watched[small].taken) / (large - small)
    start = watched[small].taken - small * each
    million = start + _MILLION * each
    sections = [
        PageSection(
            'Insertions under our controller',
            ('who computes', 'per second', 'per second and worker'),
            [(name, number(rate), number(rate / WAYS[name][1])) for name, rate in rates.items()],
            f'{plan.timed} insertions of `examples/studies/steering.yaml`, from the first sample '
            f'to the table, the best of {plan.rounds} turns. All workers run all the time, '
            'on Dask with the settings of the how-to. '
            f'The parent takes {1e3 / fed:.2f} ms for a chunk and its part of the table, and a '
            'chunk is a second of a worker.',
        ),
        PageSection(
            'Open loop: the command, with two workers',
            ('insertions', 'time [s]', 'peak of the parent [MB]', 'peak of a worker [MB]'),
            [
                (f'{size}', f'{run.taken:.1f}', f'{run.parent:.0f}', f'{run.worker:.0f}')
                for size, run in watched.items()
            ],
            f'100 mm by steps of 1 mm, with start and page. An insertion takes '
            f'{1e6 * each:.0f} us of wall time, and start and page {start:.1f} s. A million takes '
            f'{million:.0f} s, by the line through {small} and {large}. '
            'Peaks are from the kernel (`VmHWM`).',
        ),
        PageSection(
            'Equal tables',
            ('who computes', 'SHA-256 of the table'),
            [(name, f'`{table[:16]}`') for name, table in tables.items()],
            f'{plan.closed} insertions under our controller. Another study was killed '
            f'{kills.killed} times by `kill -9`, and resumed each time: {kills.twice} insertions '
            f'were computed though they had been written, its table is '
            f'{"that" if same else "NOT that"} of one that was not killed, and {kills.left} '
            'processes were left behind.',
        ),
    ]
    bars = [
        Bar('closed loop, per second and core', one, 200.0, at_least=True),
        Bar('a million in open loop, two workers', million, 600.0, 's'),
        Bar('two workers over one', two / one, 1.8, 'x', at_least=True),
        Bar('workers that one parent can feed', fed, float(_WORKERS), at_least=True),
        Bar('time that Dask adds', 100.0 * (two / spread - 1.0), 10.0, '%'),
    ]
    span = f'{large} over {small} insertions'
    for name in ('parent', 'worker'):
        peaks = [getattr(watched[size], name) for size in (large, small)]
        bars.append(Bar(f'peak of {name}, {span}', peaks[0] / peaks[1], 1.2, 'x'))
    bars += [
        Bar('tables that differ', float(len(set(tables.values())) - 1 + (not same)), 0.0),
        Bar('insertions computed twice', float(kills.twice), 0.0),
        Bar('processes left behind', float(kills.left), 0.0),
    ]
    return sections, bars
