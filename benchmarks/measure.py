"""Measuring side by side: least times of interleaved jobs, and where they were taken."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import datetime, timezone
from importlib import import_module, metadata
import os
from pathlib import Path
import platform
import time
from types import ModuleType
from typing import Final

import numpy as np

#: What a line says of a tool that is not there.
NOT_INSTALLED: Final = 'not installed: pip install needle-insertion[bench]'

#: A turn of a short job lasts this long [s]: the job before spoils the first runs of a turn.
_TURN: Final = 0.02


@dataclass(frozen=True, slots=True)
class Bar:
    """
    One wanted figure and what was found.

    Attributes
    ----------
    what, wanted : str
        The figure, and its bar in words.
    found : float or None
        What was measured; None if it could not be.
    bar : float
        Bar.
    at_least : bool
        True if the figure shall be at least ``bar``, False if at most.

    """

    what: str
    wanted: str
    found: float | None
    bar: float
    at_least: bool = True

    @property
    def verdict(self) -> str:
        """Say whether the bar is met, or by what factor it is missed."""
        if self.found is None:
            return NOT_INSTALLED
        found, bar = (self.found, self.bar) if self.at_least else (self.bar, self.found)
        if found >= bar:
            return 'met'
        # Nothing at all is no factor away from something.
        return f'missed by a factor {bar / found:.2f}' if found > 0.0 else 'missed'

    def row(self) -> tuple[str, str, str, str]:
        """Return the cells of a table."""
        found = '' if self.found is None else f'{self.found:.3g}'
        return self.what, self.wanted, found, self.verdict


def seconds(job: Callable[[], object]) -> float:
    """Return the wall time of a job [s]."""
    begin = time.perf_counter()
    job()
    return time.perf_counter() - begin


def least_times(jobs: Mapping[str, Callable[[], object]], repeats: int) -> dict[str, float]:
    """
    Return the least wall time of each job, run in turn.

    Noise of a shared machine only adds to a time, and comes in spells: the least of many is
    the best guess, and jobs that take turns share the spells. Short jobs are repeated within
    their turn.

    Parameters
    ----------
    jobs : Mapping[str, callable]
        Jobs by name. Each is run once more beforehand, to warm up.
    repeats : int
        Rounds.

    Returns
    -------
    dict[str, float]
        Least time [s] by name.

    """
    for job in jobs.values():
        job()
    best = dict.fromkeys(jobs, float('inf'))
    for _ in range(repeats):
        for name, job in jobs.items():
            spent = 0.0
            while spent < _TURN:
                taken = seconds(job)
                best[name] = min(best[name], taken)
                spent += taken
    return best


def geometric(first: float, last: float, ratio: float) -> list[float]:
    """Return first, first * ratio, ... up to last or down to it; the ends included."""
    count = int(np.floor(np.log(last / first) / np.log(ratio) + 1e-9))
    return [first * ratio**k for k in range(count + 1)]


def optional(name: str) -> ModuleType | None:
    """Import a tool to compare with; None if it is not installed."""
    try:
        return import_module(name)
    except ModuleNotFoundError:
        return None


def version(name: str) -> str:
    """Return a distribution with its version, or say that it is not installed."""
    try:
        return f'{name} {metadata.version(name)}'
    except metadata.PackageNotFoundError:
        return f'{name} not installed'


def environment() -> str:
    """Return the time, the machine and the versions, one line each."""
    cpu = platform.processor() or platform.machine()
    information = Path('/proc/cpuinfo')
    if information.exists():
        for line in information.read_text('utf-8').splitlines():
            if line.startswith('model name'):
                cpu = line.partition(':')[2].strip()
                break
    versions = [version(name) for name in ('numpy', 'scipy', 'numba', 'mujoco', 'pyelastica')]
    return '\n'.join(
        [
            f'date: {datetime.now(timezone.utc):%Y-%m-%d %H:%M} UTC',
            f'machine: {cpu}, {os.cpu_count()} cores, {platform.system()} {platform.machine()}',
            f'versions: Python {platform.python_version()}, {", ".join(versions)}',
        ]
    )
