# SPDX-License-Identifier: Apache-2.0
"""
Observers of needles in a closed loop, with a tip sensor and without a wrench.

The steps are those of `Observer` and `LoadEstimator` with one tip measurement in each period. Each
observer has two slots of a `Filter`, since no measurement is late.
"""

from __future__ import annotations

from math import nan
from typing import NamedTuple, TYPE_CHECKING

from needle_controller.compiled.filter import begin, Filter, observe
from needle_dynamics.arrays import Matrix
from needle_dynamics.compiled.cache import compiled

if TYPE_CHECKING:
    from needle_dynamics.compiled.boxed import Boxed

#: Entries of the memory of an observer: depth [m] and velocity [m/s] of the last sample, load of
#: the bent needle [N], number of samples since the start, and 1 if NIS is too large. The NIS of
#: the samples in the history follow.
_DEPTH, _VELOCITY, _LOAD, _SAMPLES, _DOUBT, HEAD = range(6)


class LoopObserver(NamedTuple):
    """Observers of needles, besides their `Filter`."""

    memory: Matrix  #: a row for each needle; no rows without observers
    exposure: float  #: time before a sample over which the tip measurement is the mean [s]
    largest: float  #: largest plausible load [N]
    interval: int  #: samples between two checks of NIS
    known: int  #: samples after the start without a check
    far: float  #: mean of NIS from which an observer is inconsistent


@compiled
def observed_load(
    boxed: Boxed[Filter],
    o: LoopObserver,
    lane: int,
    time: float,
    period: float,
    depth: float,
    velocity: float,
    tip: float,
) -> float:
    """
    Return the load of the sample before [N], and process a measured state and tip deflection.

    Without observers the load is zero. Depths outside the range of the nominal needle are limited
    to it.
    """
    if o.memory.shape[0] == 0:
        return 0.0
    needle, row = boxed.value.needle, o.memory[lane]
    before = float(row[_LOAD])
    depth = min(max(depth, needle.minimum_depth), needle.maximum_depth)
    done = int(row[_SAMPLES])
    new = 2 * lane + done % 2
    nis = load = 0.0
    if done == 0:
        begin(boxed, new, time, period, depth)
    else:
        exposures = boxed.value.exposures
        exposures[0, 0], exposures[0, 1], exposures[0, 2] = time - o.exposure, time, tip
        load = observe(
            boxed, 1, 4 * lane + 1 - new, new, time, period, row[_DEPTH], depth, row[_VELOCITY],
            velocity, nan, nan,
        )  # fmt: skip
        nis = boxed.value.samples[new]['nis']
    history = row.shape[0] - HEAD
    row[HEAD + done % history] = nis
    done += 1
    row[_DEPTH], row[_VELOCITY], row[_SAMPLES] = depth, velocity, done
    if done % o.interval == 0:
        total = 0.0
        for k in range(history):
            total += row[HEAD + k]
        row[_DOUBT] = 1.0 if done > o.known and total > o.far * history else 0.0
    if not abs(load) <= o.largest:
        # The next sample starts the observer again.
        row[_SAMPLES] = row[_DOUBT] = load = 0.0
    row[_LOAD] = 0.0 if row[_DOUBT] == 1.0 else load
    return before
