"""Side-by-side timing: the least times of jobs that take turns, and bars on the results."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
import resource
import time
from types import ModuleType
from typing import Final

import numpy as np

#: Shown in place of the figures of a tool that is not installed.
NOT_INSTALLED: Final = "not installed: pip install -e '.[bench]'"

#: Duration of one turn of a short job [s]. The previous job slows down the first runs of a turn.
_TURN: Final = 0.02


@dataclass(frozen=True, slots=True)
class Bar:
    """
    A figure and the value that it must reach.

    Attributes
    ----------
    figure : str
        What is measured.
    found : float or None
        Measured value; None if it could not be measured.
    limit : float
        Value that must be reached.
    unit : str
        Unit of both.
    at_least : bool
        True if the figure must be at least ``limit``, False if it must be at most ``limit``.

    """

    figure: str
    found: float | None
    limit: float
    unit: str = ''
    at_least: bool = False

    @property
    def missed(self) -> bool:
        """Whether the figure was measured and does not reach the limit."""
        if self.found is None:
            return False
        # NaN reaches no limit.
        return not (self.found >= self.limit if self.at_least else self.found <= self.limit)

    @property
    def verdict(self) -> str:
        """``met``, or by what factor the limit is missed."""
        if self.found is None:
            return NOT_INSTALLED
        if not self.missed:
            return 'met'
        low, high = sorted((self.found, self.limit))
        return f'missed by a factor {high / low:.2f}' if low > 0.0 else 'missed'

    def row(self) -> tuple[str, str, str, str]:
        """
        Return the cells of a table row.

        Returns
        -------
        tuple of str
            Figure, limit, measured value and verdict.

        """
        unit = f' {self.unit}' if self.unit else ''
        wanted = f'{">=" if self.at_least else "<="} {self.limit:g}{unit}'
        found = '' if self.found is None else f'{number(self.found)}{unit}'
        return self.figure, wanted, found, self.verdict


def number(value: float) -> str:
    """
    Return a number with three significant digits.

    Parameters
    ----------
    value : float
        Number.

    Returns
    -------
    str
        With an exponent only below 1e-4 and from 1e9.

    """
    rounded = float(f'{value:.3g}')
    return f'{rounded:.0f}' if 1e3 <= abs(rounded) < 1e9 else f'{rounded:.3g}'


def seconds(job: Callable[[], object]) -> float:
    """
    Measure the wall time of one call.

    Parameters
    ----------
    job : callable
        Called without arguments.

    Returns
    -------
    float
        Wall time [s].

    """
    begin = time.perf_counter()
    job()
    return time.perf_counter() - begin


def least_times(jobs: Mapping[str, Callable[[], object]], repeats: int) -> dict[str, float]:
    """
    Measure the least wall time of each job; the jobs take turns.

    Other work on a shared machine only ever adds to a time, and comes in bursts. The least of
    many times is therefore the best estimate, and jobs that take turns see the same bursts. Short
    jobs are repeated within their turn.

    Parameters
    ----------
    jobs : Mapping[str, callable]
        Jobs by name. Each is run once more beforehand, to warm up.
    repeats : int
        Number of rounds.

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
    """
    Return a geometric sequence.

    Parameters
    ----------
    first, last : float
        First value, and the value that the sequence does not pass.
    ratio : float
        Ratio of neighbors: above 1 if ``last`` is above ``first``, else below 1.

    Returns
    -------
    list of float
        ``first``, ``first * ratio``, ...; includes ``last`` if the sequence meets it.

    """
    count = int(np.floor(np.log(last / first) / np.log(ratio) + 1e-9))
    return [first * ratio**k for k in range(count + 1)]


def optional(name: str) -> ModuleType | None:
    """
    Import a module of a tool to compare with.

    Parameters
    ----------
    name : str
        Module.

    Returns
    -------
    module or None
        None if it is not installed.

    """
    try:
        return import_module(name)
    except ModuleNotFoundError:
        return None


def peak_memory() -> float:
    """
    Return the peak memory of this process.

    Returns
    -------
    float
        Memory [bytes].

    """
    status = Path('/proc/self/status')
    if status.exists():
        for line in status.read_text('ascii').splitlines():
            if line.startswith('VmHWM'):
                return 1024.0 * float(line.split()[1])
    # Other systems. On Linux this would include the process before exec.
    return float(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
