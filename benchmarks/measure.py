# SPDX-License-Identifier: Apache-2.0
"""Measure the least times of jobs that take turns, and compare results with bars."""

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

#: Text in place of the metrics of a tool that is not installed.
NOT_INSTALLED: Final = "not installed: pip install -e '.[bench]'"

#: Duration of one turn of a short job [s]. The previous job slows down the first runs of a turn.
_TURN: Final = 0.02


@dataclass(frozen=True, slots=True)
class Bar:
    """
    A metric and its limit.

    Attributes
    ----------
    figure : str
        Name of the metric.
    found : float or None
        Measured value; None if not measurable.
    limit : float
        Value to reach.
    unit : str
        Unit of both.
    at_least : bool
        True for a lower limit, False for an upper limit.

    """

    figure: str
    found: float | None
    limit: float
    unit: str = ''
    at_least: bool = False

    @property
    def missed(self) -> bool:
        """Whether the metric was measured and misses the limit."""
        if self.found is None:
            return False
        # NaN misses any limit.
        return not (self.found >= self.limit if self.at_least else self.found <= self.limit)

    @property
    def verdict(self) -> str:
        """``met``, or the factor by which the limit is missed."""
        if self.found is None:
            return NOT_INSTALLED
        if not self.missed:
            return 'met'
        low, high = sorted((self.found, self.limit))
        return f'missed by a factor {high / low:.2f}' if low > 0.0 else 'missed'

    def row(self) -> tuple[str, str, str, str]:
        unit = f' {self.unit}' if self.unit else ''
        wanted = f'{">=" if self.at_least else "<="} {self.limit:g}{unit}'
        found = '' if self.found is None else f'{number(self.found)}{unit}'
        return self.figure, wanted, found, self.verdict


def number(value: float) -> str:
    """Format a number with three digits, with an exponent only below 1e-4 and from 1e9."""
    rounded = float(f'{value:.3g}')
    return f'{rounded:.0f}' if 1e3 <= abs(rounded) < 1e9 else f'{rounded:.3g}'


def seconds(job: Callable[[], object]) -> float:
    """Measure the wall time of one call [s]."""
    begin = time.perf_counter()
    job()
    return time.perf_counter() - begin


def least_times(jobs: Mapping[str, Callable[[], object]], repeats: int) -> dict[str, float]:
    """
    Measure the least wall time [s] of each job over a number of rounds; the jobs take turns.

    Other load on a shared machine only increases a time, and occurs in bursts. The least of many
    times is therefore the best estimate, and jobs that take turns have the same bursts. Short jobs
    are repeated within their turn. Each job is run once before, for warm-up.
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
    """Return ``first, first * ratio, ...`` up to ``last``, inclusive if reached."""
    count = int(np.floor(np.log(last / first) / np.log(ratio) + 1e-9))
    return [first * ratio**k for k in range(count + 1)]


def optional(name: str) -> ModuleType | None:
    """Import a module for comparison; None if not installed."""
    try:
        return import_module(name)
    except ModuleNotFoundError:
        return None


def peak_memory() -> float:
    """Return the peak memory of this process [bytes]."""
    status = Path('/proc/self/status')
    if status.exists():
        for line in status.read_text('ascii').splitlines():
            if line.startswith('VmHWM'):
                return 1024.0 * float(line.split()[1])
    # Other systems. On Linux this would include the process before exec.
    return float(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
