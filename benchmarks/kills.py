"""A study that is killed again and again: what was lost, computed twice, or left behind."""

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
