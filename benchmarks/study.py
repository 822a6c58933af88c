"""
Studies of populations: insertions per second, memory, and the same tables whoever computes.

The study is that of `examples/studies`. Workers of every kind are started, and have loaded or
compiled what they need, before a rate is measured; then they take turns.
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
from benchmarks.page import Answer, Section, Tick
import dask
from distributed import Client, LocalCluster
from needle_dynamics import FloatArray
from needle_insertion.study import engine
from needle_insertion.study.study import made, read_study, Study
from needle_ros.process_pool import processes
import numpy as np
import psutil
import yaml

#: The study that is computed.
STUDY: Final = Path(__file__).parents[1] / 'examples/studies/steering.yaml'

#: What makes it one of needles whose guide rests: 100 mm by steps of 1 mm.
_OPEN: Final = {'controller': 'open loop', 'depth': 0.1, 'step': 1e-3}

#: Samples that a worker computes before it counts.
_FIRST: Final = 16

#: Insertions in open loop whose time is a bar.
_MILLION: Final = 1_000_000

#: Insertions of a chunk whose cost to the parent is measured: a worker takes a second for them.
_CHUNK: Final = 200

#: Workers of ten machines with 32 cores each.
_WORKERS: Final = 320

#: What docs/howto/study.md tells to set for workers. Otherwise each insertion gives its memory
#: back and takes it anew, and a profiler looks at the worker a hundred times per second.
_SETTINGS: Final = {
    'distributed.nanny.pre-spawn-environ.MALLOC_TOP_PAD_': '16777216',
    'distributed.worker.profile.enabled': False,
}

#: Makes what computes, as `engine.compute` takes it.
_Factory: TypeAlias = Callable[[], AbstractContextManager[Executor]]


class Plan(NamedTuple):
    """
    How much is computed.

    Attributes
    ----------
    closed : int
        Insertions under our controller in the studies whose tables are compared.
    timed : int
        Those in the studies that are timed.
    rounds : int
        How often each is timed.
    open : tuple of int
        Insertions in open loop in each study whose memory is watched.
    kills : int
        How often a study is killed.
    chunks : int
        Chunks whose cost to the parent is measured.

    """

    closed: int
    timed: int
    rounds: int
    open: tuple[int, int, int]
    kills: int
    chunks: int


PLANS: Final = {
    'default': Plan(100_000, 8000, 6, (1000, 10_000, _MILLION), 10, 2000),
    'quick': Plan(800, 400, 2, (100, 1000, 2000), 2, 100),
}


class Watched(NamedTuple):
    """
    A study that was computed by the command.

    Attributes
    ----------
    taken : float
        Time from start to end [s].
    parent, worker : float
        Peak of the memory of the command, and of that of its workers the larger [MB].

    """

    taken: float
    parent: float
    worker: float


def compare(tick: Tick, plan: str = 'default') -> Answer:
    """
    Compute studies with one worker and two, on a pool and on Dask, and kill them.

    Parameters
    ----------
    tick : callable
        Called with the name of each stage.
    plan : str
        How much is computed: a key of `PLANS`.

    Returns
    -------
    sections, bars
        A page.

    """
    chosen = PLANS[plan]
    with TemporaryDirectory() as name:
        return _compare(Path(name), chosen, tick)


def _compare(folder: Path, plan: Plan, tick: Tick) -> Answer:
    study = _study(plan.closed)
    tick('closed loop, in turns')
    least = take_turns(folder / 'timed', _study(plan.timed), plan.rounds)
    tables = {}
    for name, (begin, workers) in WAYS.items():
        tick(f'closed loop, {plan.closed} insertions: {name}')
        with begin(engine.order(study), workers) as factory:
            tables[name] = computed(folder / name, study, factory, workers)
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
    return _answer(plan, least, tables, watched, fed, kills, same)


def _study(samples: int, settings: dict[str, Any] | None = None) -> Study:
    """Return the study with other numbers."""
    document = read_study(STUDY).document
    return made(
        {**document, 'samples': samples, 'settings': {**document['settings'], **(settings or {})}}
    )


def _ready(text: str) -> int:
    """Compute something; return by which process."""
    engine.chunk(text, 0, _FIRST)
    return os.getpid()


@contextmanager
def pool(text: str, workers: int) -> Iterator[_Factory]:
    """
    Start processes, and have each compute something.

    Parameters
    ----------
    text : str
        Of `engine.order`.
    workers : int
        How many.

    Yields
    ------
    callable
        As `engine.compute` takes it.

    """
    with processes(workers) as executor:
        ready: set[int] = set()
        while len(ready) < workers:
            ready |= set(executor.map(_ready, [text] * workers))
        yield lambda: nullcontext(executor)


@contextmanager
def cluster(text: str, workers: int) -> Iterator[_Factory]:
    """
    Start a cluster of Dask on this machine, and have each of its workers compute something.

    Parameters
    ----------
    text, workers
        As in `pool`.

    Yields
    ------
    callable
        As `engine.compute` takes it.

    """
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


#: Who computes, and how many they are.
WAYS: Final = {
    'process pool, 1 worker': (pool, 1),
    'process pool, 2 workers': (pool, 2),
    'Dask, LocalCluster, 2 workers': (cluster, 2),
}


def take_turns(folder: Path, study: Study, rounds: int) -> dict[str, float]:
    """
    Measure how long each of `WAYS` takes for a study.

    Parameters
    ----------
    folder : Path
        Folder of all results.
    study : Study
        The study.
    rounds : int
        How often each takes its turn.

    Returns
    -------
    dict of str to float
        The least time of each, from the first sample to the table [s].

    """
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
    """
    Compute a study.

    Parameters
    ----------
    folder : Path
        Folder of its results.
    study : Study
        The study.
    factory : callable
        Of `pool` or `cluster`.
    workers : int
        Number of workers.

    Returns
    -------
    str
        SHA-256 of the table.

    """
    results = engine.Results(folder, study)
    engine.compute(results, factory, workers, _ignore)
    return _checksum(results.table)


def _ignore(_count: int) -> None:
    """Do nothing with the progress."""


def half_way(folder: Path, study: Study) -> str:
    """
    Compute a study on Dask, and kill one of two workers when half of it is there.

    Parameters
    ----------
    folder, study
        As in `computed`.

    Returns
    -------
    str
        SHA-256 of the table.

    """
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
    """Gives chunks that were computed before, each as if a worker had taken a second."""

    def __init__(self, columns: dict[str, FloatArray]) -> None:
        self._columns = columns

    def submit(self, _function: Any, /, *words: Any, **_options: Any) -> Future[Any]:
        """Return a chunk."""
        _text, first, count = words
        columns = {name: values[:count] for name, values in self._columns.items()}
        future: Future[Any] = Future()
        future.set_result((count / _CHUNK, {**columns, 'sample': np.arange(first, first + count)}))
        return future


def parent_time(folder: Path, study: Study) -> float:
    """
    Measure what a chunk costs the process that writes the results.

    Parameters
    ----------
    folder, study
        As in `computed`.

    Returns
    -------
    float
        Time for a chunk, from the worker's answer to its part of the table [s].

    """
    results = engine.Results(folder, study)
    columns = study.rows(0, _CHUNK)
    instant = _Instant(columns)
    sizes = list[int]()
    taken = seconds(
        partial(engine.compute, results, lambda: nullcontext(instant), 1, sizes.append)
    )
    return taken / len(sizes)


def watch(folder: Path, study: Study, workers: int = 2) -> Watched:
    """
    Compute a study by the command `needle study`, and watch its memory.

    Parameters
    ----------
    folder : Path
        Folder of the results.
    study : Study
        The study.
    workers : int
        Number of workers.

    Returns
    -------
    Watched
        Time and memory.

    """
    begin = time.perf_counter()
    process = subprocess.Popen(_words(folder, study, workers), stdout=subprocess.DEVNULL)
    own, peaks = psutil.Process(process.pid), dict[int, float]()
    while process.poll() is None:
        for one in (own, *_children(own)):
            # A peak only grows; that of a process that is made by a copy of another one does not
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
    """Return the peak of the memory of a process that was in RAM [MB]; 0 if it has ended."""
    try:
        status = Path(f'/proc/{process}/status').read_text('ascii')
    except (FileNotFoundError, ProcessLookupError):
        return 0.0
    lines = [line for line in status.splitlines() if line.startswith('VmHWM:')]
    return 1.024e-3 * float(lines[0].split()[1]) if lines else 0.0


def killed(folder: Path, study: Study, times: int) -> tuple[Kills, bool]:
    """
    Kill a study some times, and let it end.

    Parameters
    ----------
    folder, study
        As in `computed`.
    times : int
        How often.

    Returns
    -------
    kills : Kills
        What became of it.
    same : bool
        Whether its table is that of one that was not killed.

    """
    words = _words(folder, study, 2)
    kills = kill_again_and_again(words, folder, times, np.random.default_rng(1))
    subprocess.run(words, stdout=subprocess.DEVNULL, check=True)
    with pool(engine.order(study), 2) as factory:
        whole = computed(folder.with_name('whole'), study, factory, 2)
    return kills, _checksum(folder / engine.TABLE) == whole


def _checksum(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _answer(
    plan: Plan,
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
        Section(
            'Insertions under our controller',
            ('who computes', 'per second', 'per second and worker'),
            [(name, number(rate), number(rate / WAYS[name][1])) for name, rate in rates.items()],
            f'{plan.timed} insertions of `examples/studies/steering.yaml`, from the first sample '
            f'to the table, the best of {plan.rounds} turns. All workers are there all the time; '
            'those of Dask with the settings that the how-to names. '
            f'The parent takes {1e3 / fed:.2f} ms for a chunk and its part of the table, and a '
            'chunk is a second of a worker.',
        ),
        Section(
            'Open loop: the command, with two workers',
            ('insertions', 'time [s]', 'peak of the parent [MB]', 'peak of a worker [MB]'),
            [
                (f'{size}', f'{run.taken:.1f}', f'{run.parent:.0f}', f'{run.worker:.0f}')
                for size, run in watched.items()
            ],
            f'100 mm by steps of 1 mm, with start and page. An insertion takes '
            f'{1e6 * each:.0f} us of wall time, and start and page {start:.1f} s. A million takes '
            f'{million:.0f} s, by the line through {small} and {large}. '
            'Peaks are those of the kernel (`VmHWM`).',
        ),
        Section(
            'Equal tables',
            ('who computes', 'SHA-256 of the table'),
            [(name, f'`{table[:16]}`') for name, table in tables.items()],
            f'{plan.closed} insertions under our controller. Another study was killed '
            f'{kills.killed} times by `kill -9`, and went on each time: {kills.twice} insertions '
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
