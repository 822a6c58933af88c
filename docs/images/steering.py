# SPDX-License-Identifier: Apache-2.0
"""
Draw steering.png: needles that bend in tissue, to scale, and the authority of the guide.

Above three needles at 100 mm, each with the path that it cut: with a fixed bevel, with a bevel
rolled half way through the insertion, and without a bevel but with an early guide motion. Below
the static shift of the tip per shift of the guide, by depth and bending length; it is zero on the
line.
"""

from __future__ import annotations

from dataclasses import replace
from math import pi
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from needle_dynamics import FloatArray, NeedleParameters, SteeredNeedle, SteeringParameters
from needle_dynamics.steering.parameters import tissue_of
import numpy as np

PAPER = NeedleParameters.preset('phantom')
EI = PAPER.bending_stiffness

#: Bending length and free length [m], and curvature of the bevel [1/m].
LENGTH, FREE, CURVATURE = 0.035, 0.04, 2.0

#: Final depth of the needles [m].
DEPTH = 0.1


def draw() -> Figure:
    """Return the picture."""
    figure = Figure(figsize=(9.0, 7.2), layout='constrained')
    above, below = figure.subplots(2, 1, height_ratios=(1.0, 1.6))
    for one, color, label in needles():
        show(above, one, color, label)
    above.add_patch(Rectangle((0.0, -12.0), 115.0, 34.0, color='#f3d9d0', zorder=0, lw=0))
    above.axvline(0.0, color='#b07060', lw=2.0)
    above.set(
        title='needles that bend about the paths they cut (to scale)',
        xlabel='depth y [mm]',
        ylabel='z [mm]',
        xlim=(-1e3 * FREE - 35.0, 115.0),
        ylim=(-12.0, 22.0),
        aspect='equal',
    )
    above.legend(loc='upper left', fontsize=8)
    depths, lengths, found = authority()
    mesh = below.pcolormesh(
        1e3 * depths, 1e3 * lengths, found, cmap='RdBu', vmin=-1.0, vmax=1.0, shading='gouraud'
    )
    lines = below.contour(
        1e3 * depths, 1e3 * lengths, found, levels=[-0.2, 0.0, 0.2, 0.5, 0.8], colors='black',
        linewidths=[0.7, 2.0, 0.7, 0.7, 0.7],
    )  # fmt: skip
    below.clabel(lines, fontsize=8)
    below.set(
        title='shift of the tip per shift of the guide',
        xlabel='depth s [mm]',
        ylabel='bending length lambda [mm]',
    )
    figure.colorbar(mesh, ax=below)
    return figure


def needles() -> list[tuple[SteeredNeedle, str, str]]:
    """Return needles at their depth, with color and label."""
    tissue = replace(PAPER, tissue_stiffness=tissue_of(EI, LENGTH))
    bevel = SteeringParameters(free_length=FREE, bevel_load=(CURVATURE * EI / LENGTH,))
    bent, turned = SteeredNeedle(tissue, bevel), SteeredNeedle(tissue, bevel)
    bent.move(depth=DEPTH)
    turned.move(depth=0.4 * DEPTH)
    turned.move(roll=pi)
    turned.move(depth=DEPTH)
    moved = SteeredNeedle(tissue, SteeringParameters(free_length=FREE))
    moved.move(depth=0.01)
    moved.move(guide=(0.0, 5e-3))
    moved.move(depth=DEPTH)
    return [
        (bent, 'tab:blue', 'bevel to one side'),
        (turned, 'tab:green', 'bevel turned at 40 mm'),
        (moved, 'tab:orange', 'guide moved by 5 mm at 10 mm'),
    ]


def show(axes: Axes, one: SteeredNeedle, color: str, label: str) -> None:
    """Draw a needle, the path that it cut, and its guide."""
    shape, path = one.shape, one.path
    axes.plot(1e3 * shape.depths, 1e3 * shape.deflections[:, 1], color=color, lw=2.0, label=label)
    axes.plot(1e3 * path.depths, 1e3 * path.deflections[:, 1], color=color, lw=0.8, ls='--')
    middle = 1e3 * shape.deflections[0, 1]
    size = (5.0, 2.0)
    corner = (-1e3 * FREE - size[0], middle - 0.5 * size[1])
    axes.add_patch(Rectangle(corner, *size, color=color, alpha=0.5, lw=0))


def authority() -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return depths, bending lengths, and the shift of the tip per shift of the guide."""
    depths, lengths = np.linspace(2e-3, 0.12, 60), np.geomspace(0.02, 0.12, 50)
    found = []
    for length in lengths:
        tissue = replace(PAPER, tissue_stiffness=tissue_of(EI, float(length)))
        one = SteeredNeedle(tissue, SteeringParameters(free_length=0.02))
        row = []
        for depth in depths:
            one.move(depth=float(depth))
            row.append(one.authority[0, 0])
        found.append(row)
    return depths, lengths, np.array(found)


if __name__ == '__main__':
    draw().savefig(Path(__file__).with_suffix('.png'), dpi=120)
