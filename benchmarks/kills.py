# SPDX-License-Identifier: Apache-2.0
"""
Studies that are killed repeatedly: lost samples, repeated samples and remaining processes.

Either the command or its workers are killed.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
import subprocess
import sys
import time
from typing import Final, NamedTuple

from needle_study.engine import TABLE
import numpy as np
import psutil

#: Timeout of a result [s], after which a study is killed.
_PATIENCE: Final = 120.0

#: Longest delay of a kill after a result [s].
_LATEST: Final = 0.3

#: Timeout of the processes of a killed study [s].
_ORPHANED: Final = 5.0


#: Largest age of a replacement worker when it is killed [s], during the start of Python.
_SPAWNED: Final = 0.2

#: Kills without a result in between: one more ends the study (`needle_ros.process_pool`).
_MOST: Final = 9

#: Probability that a replacement worker is killed, and the largest number in sequence.
_YOUNG, _ROW = 0.6, 3


class Losses(NamedTuple):
    """
    Outcome of a study whose workers were killed.

    Attributes
    ----------
    killed : int
        Number of killed workers.
    young : int
        Number of killed workers younger than 0.2 s.
    errors : int
        Number of restarts after an error of the command.
    hangs : int
        Number of runs ended because nothing was written for 120 s and ten times the longest time
        between kills.

    """

    killed: int
    young: int
    errors: int
    hangs: int


def kill_workers(
    words: Sequence[str], folder: Path, times: int, between: float, rng: np.random.Generator
) -> Losses:
    """
    Compute a study, and kill its workers at random times, at most `between` seconds apart.

    Most workers that replace killed workers are killed while they are spawned. After nine kills
    the next result is awaited.
    """
    killed = young = errors = hangs = 0
    skew = _clock_skew()
    while not (folder / TABLE).exists() and hangs + errors <= times:
        process = subprocess.Popen(words, stdout=subprocess.DEVNULL)
        progress = _Progress(folder / 'parts', _PATIENCE + (_MOST + 1) * between)
        row, before = 0, killed
        moment = time.monotonic() + rng.uniform(0.0, between)
        while process.poll() is None:
            # Random time, without a condition.
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
                young += age - skew < _SPAWNED
                row = row + 1 if row < _ROW and rng.random() < _YOUNG else 0
                moment = time.monotonic() + rng.uniform(0.0, _SPAWNED if row else between)
        errors += process.wait() > 0
    return Losses(killed, young, errors, hangs)


class _Progress:
    """Monitors the results written by a study."""

    def __init__(self, parts: Path, patience: float) -> None:
        self._parts, self._patience = parts, patience
        self._seen, self._last = 0, time.monotonic()

    def made(self) -> bool:
        """Whether a result was written since the last call."""
        before, self._seen = self._seen, len(written(self._parts))
        if self._seen != before:
            self._last = time.monotonic()
        return self._seen != before

    def stalled(self) -> bool:
        """Whether no result was written for too long."""
        return time.monotonic() - self._last > self._patience


def kill_worker(parent: int, rng: np.random.Generator, *, youngest: bool) -> float | None:
    """Kill the youngest or a random worker; return its age [s], None without a worker."""
    with suppress(psutil.NoSuchProcess):
        if found := workers(parent):
            one = found[-1 if youngest else rng.integers(len(found))]
            age = time.time() - float(one.create_time())
            one.kill()
            return age
    return None


def _clock_skew() -> float:
    """Return the age of a new process [s]: not 0 if the clock was set after the system start."""
    process = psutil.Popen([sys.executable, '-c', ''])
    age = time.time() - float(process.create_time())
    process.wait()
    return age


def workers(parent: int) -> list[psutil.Process]:
    """Return the running children of a process, the oldest first."""
    found = [
        one
        for one in psutil.Process(parent).children()
        if one.status() != psutil.STATUS_ZOMBIE
        and 'resource_tracker' not in ' '.join(one.cmdline())
    ]
    return sorted(found, key=psutil.Process.create_time)


class Kills(NamedTuple):
    """
    Outcome of a study that was killed repeatedly.

    Attributes
    ----------
    killed : int
        Number of kills before its end.
    twice : int
        Number of samples computed again after they were written.
    left : int
        Number of processes that outlived the study; they are terminated here.

    """

    killed: int
    twice: int
    left: int


def kill_again_and_again(
    words: Sequence[str], folder: Path, times: int, rng: np.random.Generator
) -> Kills:
    """
    Start a study repeatedly, and kill it each time after it has written more results.

    Further kills are omitted if the study ends first.
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
        # Random time, without a condition.
        time.sleep(rng.uniform(0.0, _LATEST))
        if process.poll() is not None:
            break
        workers = psutil.Process(process.pid).children(recursive=True)
        process.kill()
        process.wait()
        killed += 1
        left += _left(workers)
        if (folder / TABLE).exists():
            # The study is complete, and its parts are removed.
            break
        now = written(parts)
        twice += again(before, now)
        before = now
    return Kills(killed, twice, left)


def _left(workers: Sequence[psutil.Process]) -> int:
    """Terminate processes that do not end; return their number."""
    _, alive = psutil.wait_procs(workers, timeout=_ORPHANED)
    # An orphan may remain a zombie.
    alive = [one for one in alive if one.status() != psutil.STATUS_ZOMBIE]
    for one in alive:
        one.kill()
    return len(alive)


def written(parts: Path) -> dict[tuple[int, int], int]:
    """Return the first and last + 1 sample of each part in a folder, and its write time [ns]."""
    found = {}
    # Parts are removed at the end of the study.
    with suppress(FileNotFoundError):
        for path in parts.glob('*-*.arrow'):
            first, end, _ = path.stem.split('-')
            found[int(first), int(end)] = path.stat().st_mtime_ns
    return found


def again(before: dict[tuple[int, int], int], now: dict[tuple[int, int], int]) -> int:
    """Return the number of samples computed again after they were written (see `written`)."""
    kept = [one for one in before if now.get(one) == before[one]]
    changed = sum(end - first for first, end in before) - sum(end - first for first, end in kept)
    return changed + sum(
        max(0, min(end, last) - max(first, begin))
        for first, end in kept
        for begin, last in now
        if (first, end) != (begin, last)
    )
