"""
A study that is killed again and again: what was lost, computed twice, or left behind.

The command is killed, or its workers are.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
import subprocess
import time
from typing import Final, NamedTuple

from needle_insertion.study.engine import TABLE
import numpy as np
import psutil

#: Longest time until a study writes something [s], after which it is killed anyway.
_PATIENCE: Final = 120.0

#: A study is killed up to this time after it has written something [s].
_LATEST: Final = 0.3

#: Time in which the processes of a study that was killed must end [s].
_ORPHANED: Final = 5.0


#: Age up to which a worker that replaces a killed one is killed [s]: Python starts in that time.
_SPAWNED: Final = 0.2

#: Kills without a result in between: one more would end the study (`needle_ros.process_pool`).
_MOST: Final = 9

#: Probability that the worker that replaces a killed one is killed so, and how many in a row.
_YOUNG, _ROW = 0.6, 3


class Losses(NamedTuple):
    """
    What became of a study whose workers were killed.

    Attributes
    ----------
    killed : int
        Workers that were killed.
    young : int
        Those of them that had been started less than 0.2 s before.
    errors : int
        How often the command ended with an error, and was started again.
    hangs : int
        How often it wrote nothing for 120 s and ten times the longest time between kills, and was
        ended.

    """

    killed: int
    young: int
    errors: int
    hangs: int


def kill_workers(
    words: Sequence[str], folder: Path, times: int, between: float, rng: np.random.Generator
) -> Losses:
    """
    Compute a study, and kill its workers at random times.

    Most workers that replace killed ones are killed while they are spawned. After nine kills the
    next result is awaited.

    Parameters
    ----------
    words : sequence of str
        Command that begins the study, or continues it.
    folder : Path
        Folder of its results.
    times : int
        Largest number of kills.
    between : float
        Longest time between kills [s], except those of workers that are spawned.
    rng : Generator
        Random numbers.

    Returns
    -------
    Losses
        What became of it.

    """
    killed = young = errors = hangs = 0
    while not (folder / TABLE).exists() and hangs + errors <= times:
        process = subprocess.Popen(words, stdout=subprocess.DEVNULL)
        progress = _Progress(folder / 'parts', _PATIENCE + (_MOST + 1) * between)
        row, before = 0, killed
        moment = time.monotonic() + rng.uniform(0.0, between)
        while process.poll() is None:
            # The moment is random: no condition is waited for.
            time.sleep(0.01)
            if progress.made():
                before = killed
            if progress.stalled():
                hangs += 1
                process.kill()
                break
            if min(times, before + _MOST) <= killed or time.monotonic() < moment:
                continue
            age = kill_worker(process.pid, rng, youngest=row > 0)
            if age is not None:
                killed += 1
                young += age < _SPAWNED
                row = row + 1 if row < _ROW and rng.random() < _YOUNG else 0
                moment = time.monotonic() + rng.uniform(0.0, _SPAWNED if row else between)
        errors += process.wait() > 0
    return Losses(killed, young, errors, hangs)


class _Progress:
    """The results that a study writes."""

    def __init__(self, parts: Path, patience: float) -> None:
        self._parts, self._patience = parts, patience
        self._seen, self._last = 0, time.monotonic()

    def made(self) -> bool:
        """Whether something was written since the last call."""
        before, self._seen = self._seen, len(written(self._parts))
        if self._seen != before:
            self._last = time.monotonic()
        return self._seen != before

    def stalled(self) -> bool:
        """Whether nothing was written for too long."""
        return time.monotonic() - self._last > self._patience


def kill_worker(parent: int, rng: np.random.Generator, *, youngest: bool) -> float | None:
    """
    Kill a worker of a process.

    Parameters
    ----------
    parent : int
        The process.
    rng : Generator
        Random numbers.
    youngest : bool
        Kill the youngest worker, instead of a random one.

    Returns
    -------
    float or None
        Age of the worker [s]; None if there is no worker, or one has just ended.

    """
    with suppress(psutil.NoSuchProcess):
        if found := workers(parent):
            one = found[-1 if youngest else rng.integers(len(found))]
            age = time.time() - float(one.create_time())
            one.kill()
            return age
    return None


def workers(parent: int) -> list[psutil.Process]:
    """
    Return the workers of a process.

    Parameters
    ----------
    parent : int
        The process.

    Returns
    -------
    list of Process
        Its children that have not ended, the oldest first.

    """
    found = [
        one
        for one in psutil.Process(parent).children()
        if one.status() != psutil.STATUS_ZOMBIE
        and 'resource_tracker' not in ' '.join(one.cmdline())
    ]
    return sorted(found, key=psutil.Process.create_time)


class Kills(NamedTuple):
    """
    What became of a study.

    Attributes
    ----------
    killed : int
        How often it was killed before it had ended.
    twice : int
        Samples that were computed again though they had been written.
    left : int
        Processes that were there still when the study was not. They are ended here.

    """

    killed: int
    twice: int
    left: int


def kill_again_and_again(
    words: Sequence[str], folder: Path, times: int, rng: np.random.Generator
) -> Kills:
    """
    Start a study some times, and kill it each time when it has written something more.

    Parameters
    ----------
    words : sequence of str
        Command that begins the study, or goes on with it.
    folder : Path
        Folder of its results.
    times : int
        How often.
    rng : Generator
        Gives the moments.

    Returns
    -------
    Kills
        What became of it; where it ended before it was killed the rest is not tried.

    """
    parts = folder / 'parts'
    killed = twice = left = 0
    before = written(parts)
    for _ in range(times):
        process = subprocess.Popen(words, stdout=subprocess.DEVNULL)
        patience = time.monotonic() + _PATIENCE
        while process.poll() is None and time.monotonic() < patience:
            if len(written(parts)) > len(before):
                break
            time.sleep(0.01)
        # The moment is random: no condition is waited for.
        time.sleep(rng.uniform(0.0, _LATEST))
        if process.poll() is not None:
            break
        workers = psutil.Process(process.pid).children(recursive=True)
        process.kill()
        process.wait()
        killed += 1
        left += _left(workers)
        if (folder / TABLE).exists():
            # All was written, and the parts are removed.
            break
        now = written(parts)
        twice += again(before, now)
        before = now
    return Kills(killed, twice, left)


def _left(workers: Sequence[psutil.Process]) -> int:
    """Return how many do not end by themselves; they are ended."""
    _, alive = psutil.wait_procs(workers, timeout=_ORPHANED)
    # Nobody may take note of a child of a process that was killed.
    alive = [one for one in alive if one.status() != psutil.STATUS_ZOMBIE]
    for one in alive:
        one.kill()
    return len(alive)


def written(parts: Path) -> dict[tuple[int, int], int]:
    """
    Return what a study has written.

    Parameters
    ----------
    parts : Path
        Folder of its parts.

    Returns
    -------
    dict of (int, int) to int
        First and last + 1 of the samples of each part, and when it was written [ns].

    """
    found = {}
    # They go when all is written.
    with suppress(FileNotFoundError):
        for path in parts.glob('*-*.parquet'):
            first, _, end = path.stem.partition('-')
            found[int(first), int(end)] = path.stat().st_mtime_ns
    return found


def again(before: dict[tuple[int, int], int], now: dict[tuple[int, int], int]) -> int:
    """
    Return how many samples were computed again though they had been written.

    Parameters
    ----------
    before, now : dict
        As `written` returns them.

    Returns
    -------
    int
        Samples of parts that are not there as they were, or that are in another part, too.

    """
    kept = [one for one in before if now.get(one) == before[one]]
    changed = sum(end - first for first, end in before) - sum(end - first for first, end in kept)
    return changed + sum(
        max(0, min(end, last) - max(first, begin))
        for first, end in kept
        for begin, last in now
        if (first, end) != (begin, last)
    )
