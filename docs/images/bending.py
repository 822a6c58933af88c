# SPDX-License-Identifier: Apache-2.0
"""
Draw bending.png: shapes of a needle during an insertion, in both planes, to scale.

The bevel pushes the tip along z, until the needle is rolled half way. The guide moves along x at
a small depth, so that the tip moves in the opposite direction.
"""

from __future__ import annotations

from dataclasses import replace
from math import pi
from pathlib import Path

from matplotlib.figure import Figure
from needle_dynamics import FloatArray, NEEDLES, SteeredNeedle
from needle_insertion.report.insertion import draw_needle
import numpy as np

#: Depth, position of the guide along x [m] and roll [rad] of each needle that is drawn.
WAY = (
    (0.01, 0.0, 0.0), (0.03, 8e-3, 0.0), (0.07, 8e-3, 0.0), (0.09, 8e-3, pi), (0.14, 8e-3, pi),
)  # fmt: skip


def insert() -> tuple[SteeredNeedle, list[FloatArray]]:
    """Return the needle at the end of the insertion, and its shapes at each depth."""
    preset = NEEDLES['bending_35mm']
    one = SteeredNeedle(preset.needle, replace(preset.steering, bevel_load=(1.5,)))
    shapes = []
    for depth, guide, roll in WAY:
        one.move(depth=depth, guide=(guide, 0.0), roll=roll)
        shapes.append(np.insert(one.shape.deflections, 1, one.shape.depths, axis=1))
    return one, shapes


def draw() -> Figure:
    """Return the picture."""
    one, shapes = insert()
    return draw_needle(shapes, np.insert(one.path.deflections, 1, one.path.depths, axis=1))


if __name__ == '__main__':
    draw().savefig(Path(__file__).with_suffix('.png'), dpi=120)
