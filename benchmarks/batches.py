# SPDX-License-Identifier: Apache-2.0
"""
Batches of insertions: gain over single runs and by a second thread, and memory.

The speed-up depends on other load of the machine. Its upper limit is measured at the same time
with a loop of sums and products without data shared between threads.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial
import tracemalloc
from typing import Final

from benchmarks.lanes_in_c import build, OPTIONS, Run
from benchmarks.measure import Bar, least_times
from benchmarks.page import Answer, PageSection, Tick
from benchmarks.solvers import DEFLECTION, DEPTH, DURATION, FORCE
from benchmarks.step import chains
from needle_dynamics import FloatArray, NeedleModel, NeedleParameters, simulate_batch
from needle_dynamics.compiled import lanes
from needle_dynamics.compiled.intervals import run
from needle_dynamics.simulated.batch import Batch, lane_constants, lane_layers, lane_modes
import numpy as np

#: Number of insertions.
RUNS: Final = 2000

#: Initial step [s]; steps grow with depth.
_STEP: Final = 1.4e-5

#: Sampling interval of the memory measurement [s].
_INTERVAL: Final = DURATION / 300

#: Rounds of the loop over all threads, for about the duration of the insertions.
_ROUNDS: Final = 100_000_000

_REPEATS: Final = 30


class Batches:
    """Open-loop runs with friction from 0.5 to 1.5 times the value of the paper."""

    def __init__(self, runs: int = RUNS) -> None:
        preset = NeedleParameters.preset('paper_si')
        self._start = NeedleModel(preset).state_at(DEPTH, DEFLECTION)
        self._parameters = [
            NeedleParameters.preset('paper_si', coulomb_friction=factor * preset.coulomb_friction)
            for factor in np.linspace(0.5, 1.5, runs)
        ]
        self._arrays = (
            lane_constants(self._parameters),
            lane_modes(preset.reach, preset.modes),
            lane_layers(self._parameters),
        )

    def run(
        self,
        workers: int,
        *,
        duration: float = DURATION,
        interval: float = DURATION,
        keep: bool = False,
    ) -> Batch:
        """Simulate all insertions; keep all samples or only the final states."""
        return simulate_batch(
            self._parameters,
            self._start,
            FORCE,
            duration=duration,
            interval=interval,
            step=_STEP,
            graded=True,
            keep=keep,
            workers=workers,
        )

    def compiled(self, in_c: Run | None) -> FloatArray:
        """Simulate without preparation, in C or by our compiled code; return final states."""
        ends = np.tile(self._start, (len(self._parameters), 1))
        needles, modes, layers = self._arrays
        if in_c is not None:
            in_c(needles, modes.table, FORCE, DURATION, _STEP, ends)
            return ends
        force, torque = np.array([[FORCE]]), np.zeros((1, 1))
        inputs = lanes.BatchTrajectory(force, torque, 1, DURATION, _STEP, True)
        kept, completed = np.empty((len(ends), 1, ends.shape[1])), np.empty(len(ends))
        given = needles, modes, layers, inputs, np.arange(len(ends)), ends, kept, completed
        lanes.run(lanes.LaneBatch(*given))
        return ends

    def one_by_one(self) -> FloatArray:
        """Simulate the insertions one after the other; return final states, (runs, 8)."""
        ends = np.tile(self._start, (len(self._parameters), 1))
        force, torque = np.array([FORCE]), np.zeros(1)
        for p, end in zip(self._parameters, ends, strict=True):
            run(NeedleModel(p).compiled, end, force, torque, DURATION, _STEP, True, 1, end[None])
        return ends

    def peak_memory(self, part: float, *, keep: bool) -> int:
        """Return the peak memory [bytes] of a run over a fraction of `DURATION`, least of 5."""
        job = partial(self.run, 2, duration=part * DURATION, interval=_INTERVAL, keep=keep)
        job()
        return min(_peak(job) for _ in range(5))


def _peak(job: Callable[[], object]) -> int:
    """Return the peak memory of a call [bytes], with garbage that is not yet collected."""
    tracemalloc.start()
    try:
        job()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def _spin(threads: int) -> None:
    """Distribute the rounds of the loop over threads."""
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(partial(chains, 0.7, 0.6), [_ROUNDS // threads] * threads))


def compare(tick: Tick) -> Answer:
    """Measure batches of insertions on one and two threads, and their memory."""
    batches, in_c = Batches(), build()
    tick('batches, one thread and two')
    alike: dict[str, Callable[[], object]] = {}
    if in_c is not None:
        alike = {
            'compiled, ours': partial(batches.compiled, None),
            'compiled, C': partial(batches.compiled, in_c),
        }
    times = least_times(
        {
            **alike,
            'one by one, 1': batches.one_by_one,
            'insertions, 1': partial(batches.run, 1),
            'insertions, 2': partial(batches.run, 2),
            'ceiling, 1': partial(_spin, 1),
            'ceiling, 2': partial(_spin, 2),
            'one step': partial(batches.run, 1, duration=_STEP, interval=_STEP),
        },
        _REPEATS,
    )
    together = times['one by one, 1'] / times['insertions, 1']
    ratio = times['insertions, 1'] / times['insertions, 2']
    ceiling = times['ceiling, 1'] / times['ceiling, 2']
    one, two = batches.run(1).states, batches.run(2).states
    alone = batches.one_by_one()
    ends, others = one[:, 0, [0, 4]], alone[:, [0, 4]]
    apart = float((np.abs(ends - others) / np.maximum(np.abs(others), 1e-9)).max())
    tick('memory of batches')
    runs = ((0.1, False), (1.0, False), (1.0, True))
    short, long, kept = (batches.peak_memory(part, keep=keep) for part, keep in runs)
    rows = [
        (
            name,
            *(f'{times[f"{name}, {threads}"] * 1e3:.4g}' for threads in (1, 2)),
            f'{gain:.2f} x',
            f'{RUNS / times[f"{name}, 2"]:.0f}' if name == 'insertions' else '',
        )
        for name, gain in (('insertions', ratio), ('ceiling', ceiling))
    ]
    section = PageSection(
        'Batches',
        ('what', '1 thread [ms]', '2 threads [ms]', 'speed-up', 'per second'),
        rows,
        f'{RUNS} open-loop runs of {DURATION * 1e3:g} ms. Friction is 0.5 to 1.5 times '
        f'the preset. The steps begin at {_STEP * 1e6:g} us and grow with depth. The final states '
        f'are kept.\n\n'
        f'- Identical bits on 1 and 2 threads: {"yes" if np.array_equal(one, two) else "NO"}.\n'
        f'- An insertion takes {times["insertions, 1"] / RUNS * 1e6:.3g} us on one thread. With '
        f'one step only, it takes {times["one step"] / RUNS * 1e6:.3g} us. Most '
        f'of that is the preparation, in Python on one thread.\n'
        f'- One by one, in the same steps, it takes {times["one by one, 1"] / RUNS * 1e6:.3g} us, '
        f'{together:.3g} times as long: in a batch each instruction takes several needles. '
        f'Depths and velocities at the end differ by at most {apart:.1g} of themselves.\n'
        f'- {_compared_with_c(batches, in_c, times)}',
    )
    memory = PageSection(
        'Memory of batches',
        ('simulated [ms]', 'states kept', 'peak memory [MB]'),
        [
            (f'{part * DURATION * 1e3:g}', 'all' if keep else 'final', f'{peak / 1e6:.3g}')
            for (part, keep), peak in zip(runs, (short, long, kept), strict=True)
        ],
        f'The same runs, sampled every {_INTERVAL * 1e6:g} us. `tracemalloc` sees the arrays of '
        f'NumPy, and not the scratch memory of the compiled code, which has a fixed size.',
    )
    bars = [
        Bar('batches, one by one over together', together, 3.0, 'x', at_least=True),
        Bar('batches, 2 threads over 1', ratio, 1.8, 'x', at_least=True),
        Bar('batches, memory for 10 times the simulated time', long / short, 1.05, 'x'),
    ]
    if alike:
        ratio = times['compiled, ours'] / times['compiled, C']
        bars.append(Bar('batches, over the same step in C', ratio, 1.3, 'x'))
    return [section, memory], bars


def _compared_with_c(batches: Batches, in_c: Run | None, times: Mapping[str, float]) -> str:
    if in_c is None:
        return 'Not compared with C: there is no C compiler.'
    ours, theirs = batches.compiled(None), batches.compiled(in_c)
    scale = np.abs(ours).max(axis=0) + 1e-300
    apart = float((np.abs(ours - theirs) / scale).max())
    each = [1e6 * times[f'compiled, {name}'] / RUNS for name in ('ours', 'C')]
    return (
        f'The step in C, with the same arithmetic (`cc {" ".join(OPTIONS)}`), takes '
        f'{each[1]:.3g} us for an insertion, and ours {each[0]:.3g} us, both without preparation, '
        f'on one thread. The final states differ by at most {apart:.1g} of the largest.'
    )
