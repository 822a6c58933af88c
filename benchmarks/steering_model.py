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
from numpy.typing import ArrayLike
from scipy.linalg import solveh_banded

#: Depth [m] and steps of the measured insertion, and insertions of a batch.
_DEPTH, _STEPS = 0.1, 100
_BATCH: Final = 20_000

#: Turns of each job.
_ROUNDS: Final = 7

#: Matrices of a Hermite element: bending, and tissue; loads by a path at its first and last node.
_BENDING: Final = np.array(
    [[12, 6, -12, 6], [6, 4, -6, 2], [-12, -6, 12, -6], [6, 2, -6, 4]], dtype=np.float64
)
_GROUND: Final = np.array(
    [[156, 22, 54, -13], [22, 4, 13, -3], [54, 13, 156, -22], [-13, -3, -22, 4]], dtype=np.float64
)
_LEFT: Final = np.array([21.0, 3.0, 9.0, -2.0])
_RIGHT: Final = np.array([9.0, 2.0, 21.0, -3.0])
_LOWER: Final = [(i, j) for i in range(4) for j in range(i + 1)]


class HermiteNeedle:
    """
    Beam of cubic Hermite elements along its cut path, with equal constants in each plane.

    The path is straight between the nodes, and its end at the tip is solved together with the
    beam. The matrix and the loads of the cut path are kept; a step adds those of one element.

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
    steps : int
        Largest number of steps.
    entry : array_like, shape (planes,)
        Position of the skin [m].

    """

    def __init__(
        self,
        needle: NeedleParameters,
        free: float,
        skin: float,
        step: float,
        steps: int,
        entry: ArrayLike = (0.0, 0.0),
    ) -> None:
        self._stiffness, self._tissue, self._step = needle.bending_stiffness, needle.tissue, step
        self.path = [np.array(entry, dtype=np.float64)]  #: position of each node [m], (planes,)
        size = 2 * (steps + 2)
        self._band = np.zeros((4, size))
        self._loads = np.zeros((size, len(self.path[0])))
        self._extend(0, free, 0.0)
        self._band[0, 2] += skin
        self._loads[2] += skin * self.path[0]

    def _extend(self, first: int, h: float, k: float) -> FloatArray:
        """Add an element of length h [m] in tissue k [N/m^2]; return the units of its entries."""
        # Deflection and slope of both nodes.
        units = np.array([1.0, h, 1.0, h])
        element = np.outer(units, units) * (
            self._stiffness / h**3 * _BENDING + k * h / 420.0 * _GROUND
        )
        for i, j in _LOWER:
            self._band[i - j, 2 * first + j] += element[i, j]
        return units

    def advance(self, position: ArrayLike, tilt: ArrayLike, load: ArrayLike) -> FloatArray:
        """
        Extend the path by one element, for the guide position [m] and tilt and the tip load [N].

        Returns deflections [m] and slopes from the guide to the tip, (nodes, 2, planes).
        """
        count, h, band = len(self.path), self._step, self._band
        k = self._tissue.stiffness((count - 0.5) * h)
        # Loads of a path that is linear in each element, by its values at both ends.
        shares = k * h / 60.0 * self._extend(count, h, k)
        left, right = shares * _LEFT, shares * _RIGHT
        new = slice(2 * count, 2 * count + 4)
        self._loads[new] += np.outer(left, self.path[-1])
        # The guide holds the first node. The last column is the deflection by the end of the path.
        guide = np.empty((2, len(self.path[0])))
        guide[0], guide[1] = position, tilt
        loads = np.zeros((2 * count + 2, len(self.path[0]) + 1))
        loads[:, :-1] = self._loads[2 : new.stop]
        loads[:2, :-1] -= np.array([[band[2, 0], band[1, 1]], [band[3, 0], band[2, 1]]]) @ guide
        loads[-2, :-1] += np.asarray(load)
        loads[-4:, -1] = right
        found = solveh_banded(band[:, 2 : new.stop], loads, lower=True, check_finite=False)
        end = found[-2, :-1] / (1.0 - found[-2, -1])
        self.path.append(end)
        self._loads[new] += np.outer(right, end)
        nodes = np.vstack([guide, found[:, :-1] + found[:, -1:] * end])
        return np.asarray(nodes.reshape(-1, 2, len(end)))


def compare(tick: Tick) -> Answer:
    """Measure an insertion, a solution and a batch."""
    needle, steering, _ = NEEDLES['bending_35mm']
    steering = replace(steering, bevel_load=(0.1,))
    step = _DEPTH / _STEPS
    depths = np.linspace(0.0, _DEPTH, _STEPS + 1)

    def ours() -> FloatArray:
        return insert_batch(needle, steering, depths[np.newaxis], workers=1)

    def theirs() -> float:
        other = HermiteNeedle(needle, steering.free_length, 0.0, step, _STEPS)
        for _ in range(_STEPS):
            shape = other.advance(0.0, 0.0, (0.0, 0.1))
        return float(shape[-1, 0, 1])

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
    single, batch = short['by hand'] / short['alone'], short['by hand'] / each
    cores = long['one'] / long['two']
    grows = plans['200'] / plans['100']
    off = abs(ours()[0, -1, 2] - theirs())
    rows = [
        ('an insertion, alone', f'{1e6 * short["alone"]:.0f} us'),
        ('an insertion in a batch, one core', f'{1e6 * each:.0f} us'),
        ('an insertion with NumPy and SciPy', f'{1e3 * short["by hand"]:.1f} ms'),
        ('NumPy and SciPy over an insertion alone', f'{single:.0f} times'),
        ('NumPy and SciPy over an insertion in a batch', f'{batch:.0f} times'),
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
        Bar('NumPy and SciPy over an insertion alone', single, 5.0, 'times', at_least=True),
        # The result has four times the entries; eight times is the cube of the steps.
        Bar('a plan of 200 steps over one of 100', grows, 5.0, 'times'),
        Bar('two cores over one', cores, 1.8, 'times', at_least=True),
    ]
    return [section], bars
