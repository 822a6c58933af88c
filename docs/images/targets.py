# SPDX-License-Identifier: Apache-2.0
"""
Draw targets.png: distribution of the final distance from the target, by controller.

Fraction of the needles that end within a distance, for the first case of `needle bench steering`
and for needles with a bevel that is rolled.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from benchmarks.steering import CASES, CONTROLLERS, insert, SteeringOutcome, turn, TURNING
from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np

#: Needles of each case; the benchmark has a thousand.
NEEDLES = 40


def draw() -> Figure:
    """Return the picture."""
    sensor, spread = CASES[0]
    figure = Figure(figsize=(9.0, 3.8), layout='constrained')
    left, right = figure.subplots(1, 2, sharey=True)
    show(left, [insert(sensor, spread, seed) for seed in range(NEEDLES)], CONTROLLERS)
    show(right, [turn(seed) for seed in range(NEEDLES)], TURNING)
    left.set(title='moved guide', ylabel='part of the needles')
    right.set(title='bevel of 0.8 N')
    return figure


def show(axes: Axes, found: Sequence[SteeringOutcome], names: Sequence[str]) -> None:
    """Draw the fraction of the needles within each distance."""
    counted = [one for one in found if one.reachable and not one.refused]
    for name in names:
        miss = np.sort([1e3 * one.ends[name].miss for one in counted])
        axes.step(miss, (1.0 + np.arange(len(miss))) / len(miss), where='post', label=name)
    axes.set(xscale='log', xlim=(2e-3, 30.0), ylim=(0.0, 1.0))
    axes.set_xlabel('distance of the tip from its target [mm]')
    axes.grid(visible=True, alpha=0.3)
    axes.legend()


if __name__ == '__main__':
    draw().savefig(Path(__file__).with_suffix('.png'), dpi=120)
