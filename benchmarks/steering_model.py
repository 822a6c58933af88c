# SPDX-License-Identifier: Apache-2.0
"""Cost of the steered needle, compared with the same model in NumPy and SciPy."""

from __future__ import annotations

from dataclasses import replace
import os
from typing import Final

from benchmarks.measure import Bar, least_times
from benchmarks.page import Answer, PageSection, Tick
from needle_controller import SteeringModel
from needle_dynamics import FloatArray, insert_batch, NeedleParameters, NEEDLES, SteeredNeedle
import numpy as np
from scipy.linalg import solveh_banded

#: Depth [m] and steps of the measured insertion, and insertions of a batch.
_DEPTH, _STEPS = 0.1, 100
_BATCH: Final = 20_000

#: Turns of each job.
_ROUNDS: Final = 7


class HermiteNeedle:
    """
    Beam of cubic Hermite elements along its cut path, in one plane.

    The path is straight between the nodes, and its end at the tip is solved together with the
    beam.

    Parameters
    ----------
    needle : NeedleParameters
        Needle and tissue.
    free : float
        Free length [m].
    skin : float
        Stiffness of the skin [N/m].
    step : float
        Length of the elements [m].
    entry : float
        Position of the skin [m].

    """

    def __init__(
        self, needle: NeedleParameters, free: float, skin: float, step: float, entry: float = 0.0
    ) -> None:
        self._needle, self._skin, self._step = needle, skin, step
        self._lengths = np.array([free])
        self._tissue = np.array([0.0])
        self._depth = 0.0
        self.path = np.array([entry])

    def advance(self, position: float, tilt: float, load: float) -> FloatArray:
        """
        Extend the path by one element, for the guide position [m] and tilt and the tip load [N].

        Returns deflections [m] and slopes from the guide to the tip, (nodes, 2).
        """
        middle = self._depth + 0.5 * self._step
        self._lengths = np.append(self._lengths, self._step)
        self._tissue = np.append(self._tissue, self._needle.tissue.stiffness(middle))
        self._depth += self._step
        h, k = self._lengths, self._tissue
        count = len(h)
        size = 2 * (count + 1)
        # Stiffness and foundation of each element, with entries (w, w') of both nodes.
        one = np.ones(count)
        units = np.array([one, h, one, h]).T
        bending = np.array([[12, 6, -12, 6], [6, 4, -6, 2], [-12, -6, 12, -6], [6, 2, -6, 4]])
        ground = np.array(
            [[156, 22, 54, -13], [22, 4, 13, -3], [54, 13, 156, -22], [-13, -3, -22, 4]]
        )
        pairs = units[:, :, np.newaxis] * units[:, np.newaxis, :]
        matrices = pairs * (
            (self._needle.bending_stiffness / h**3)[:, np.newaxis, np.newaxis] * bending
            + (k * h / 420.0)[:, np.newaxis, np.newaxis] * ground
        )
        band = np.zeros((4, size))
        for i in range(4):
            for j in range(i + 1):
                np.add.at(band[i - j], 2 * np.arange(count) + j, matrices[:, i, j])
        band[0, 2] += self._skin
        # Loads of a path that is linear in each element, by its values at both ends.
        shares = (k * h / 60.0)[:, np.newaxis] * units
        left = shares * np.array([21, 3, 9, -2])
        right = shares * np.array([9, 2, 21, -3])
        path = np.append(self.path, 0.0)
        values = np.concatenate([[0.0], path])
        loads = np.zeros((size, 2))
        for i in range(4):
            at = 2 * np.arange(count) + i
            np.add.at(loads[:, 0], at, left[:, i] * values[:-1] + right[:, i] * values[1:])
        loads[-4:, 1] = right[-1]
        loads[2, 0] += self._skin * self.path[0]
        loads[-2, 0] += load
        # The guide holds the first node.
        for place, value in ((0, position), (1, tilt)):
            for j in range(1, 4):
                if place + j < size:
                    loads[place + j, 0] -= band[j, place] * value
            band[:, place] = 0.0
            band[0, place] = 1.0
        band[1, 0] = 0.0
        loads[0, 0], loads[1, 0] = position, tilt
        found = solveh_banded(band, loads, lower=True)
        end = found[-2, 0] / (1.0 - found[-2, 1])
        self.path = np.append(self.path, end)
        return np.asarray((found[:, 0] + end * found[:, 1]).reshape(-1, 2))


def compare(tick: Tick) -> Answer:
    """Measure an insertion, a solution and a batch."""
    needle, steering, _ = NEEDLES['bending_35mm']
    steering = replace(steering, bevel_load=(0.1,))
    step = _DEPTH / _STEPS
    depths = np.linspace(0.0, _DEPTH, _STEPS + 1)

    def ours() -> FloatArray:
        return insert_batch(needle, steering, depths[np.newaxis], workers=1)

    def theirs() -> float:
        # Both planes, as in our model.
        for _ in range(2):
            other = HermiteNeedle(needle, steering.free_length, 0.0, step)
            for _ in range(_STEPS):
                shape = other.advance(0.0, 0.0, 0.1)
        return float(shape[-1, 0])

    many = np.broadcast_to(depths, (_BATCH, len(depths)))
    solved = SteeredNeedle(needle, replace(steering, element=_DEPTH / 40))
    solved.move(depth=_DEPTH)
    tick('insertions and solutions')
    short = least_times(
        {'alone': ours, 'by hand': theirs, 'solution': lambda: solved.guide_load}, _ROUNDS
    )
    tick('plans')
    grids = [np.linspace(0.0, _DEPTH, steps + 1) for steps in (100, 200)]
    plans = least_times(
        {
            '100': lambda: SteeringModel(needle, steering, grids[0]),
            '200': lambda: SteeringModel(needle, steering, grids[1]),
        },
        _ROUNDS,
    )
    tick('batches')
    long = least_times(
        {
            'one': lambda: insert_batch(needle, steering, many, workers=1),
            'two': lambda: insert_batch(needle, steering, many, workers=2),
        },
        _ROUNDS,
    )
    each = long['one'] / _BATCH
    faster, cores = short['by hand'] / each, long['one'] / long['two']
    grows = plans['200'] / plans['100']
    off = abs(ours()[0, -1, 2] - theirs())
    rows = [
        ('an insertion, alone', f'{1e6 * short["alone"]:.0f} us'),
        ('an insertion in a batch, one core', f'{1e6 * each:.0f} us'),
        ('the same with NumPy and SciPy', f'{1e3 * short["by hand"]:.1f} ms'),
        ('solution at 40 elements', f'{1e6 * short["solution"]:.1f} us'),
        ('a plan of 200 steps', f'{1e3 * plans["200"]:.0f} ms'),
        ('a plan of 200 steps over one of 100', f'{grows:.1f} times'),
        ('two cores over one', f'{cores:.2f} times'),
        ('difference of the tips', f'{1e6 * off:.2f} um'),
    ]
    section = PageSection(
        'A needle that cuts its path',
        ('', 'found'),
        rows,
        f'{1e3 * _DEPTH:g} mm in {_STEPS} steps, both planes; {_BATCH} insertions in a batch; '
        f'{os.cpu_count()} cores.',
    )
    bars = [
        Bar('an insertion in a batch, one core', 1e3 * each, 0.5, 'ms'),
        Bar('solution at 40 elements', 1e6 * short['solution'], 10.0, 'us'),
        Bar('NumPy and SciPy over it', faster, 300.0, 'times', at_least=True),
        # The result has four times the entries; eight times is the cube of the steps.
        Bar('a plan of 200 steps over one of 100', grows, 5.0, 'times'),
        Bar('two cores over one', cores, 1.8, 'times', at_least=True),
    ]
    return [section], bars
