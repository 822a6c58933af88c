# SPDX-License-Identifier: Apache-2.0
"""
Draw convergence.png: convergence of n modes to a clamped beam on an elastic foundation.

Left the first three natural frequencies at three quarters of the needle's length, right the tip
deflection under a lateral force at the tip, at several insertion depths, both relative to the
exact beam. A line ends where the condition of G rejects another mode.
"""

from __future__ import annotations

from pathlib import Path

from matplotlib.figure import Figure
from needle_dynamics import FloatArray, mode_shapes, NeedleModel, NeedleParameters
from needle_dynamics.parameters import LARGEST_CONDITION, MOST_MODES
import numpy as np
from scipy.linalg import eigh

#: Insertion depths over the needle's length.
DEPTHS = (1.0, 0.9, 0.75, 0.5)

P = NeedleParameters()


def draw() -> Figure:
    """Return the picture."""
    figure = Figure(figsize=(10.0, 4.2), layout='constrained')
    left, right = figure.subplots(1, 2, sharex=True)
    depth = 0.75 * P.length
    exact = exact_frequencies(depth)
    models = models_at(depth)
    counts = [model.modes.count for model in models]
    found = np.full((len(models), 3), np.nan)
    for row, model in zip(found, models, strict=True):
        mass = P.linear_density * model.modes.integrals(depth).gram
        squares = eigh(model.stiffness_matrix(depth), mass, eigvals_only=True)
        row[: squares.size] = np.sqrt(squares[:3])
    for i, mark in enumerate('os^'):
        label = f'mode {i + 1} ({exact[i] / (2.0 * np.pi):.0f} Hz)'
        left.semilogy(counts, found[:, i] / exact[i] - 1.0, f'{mark}-', label=label)
    left.set(
        title=f'natural frequencies at s = {depth * 100:g} cm',
        ylabel='excess over the exact beam, relative',
    )
    for part, mark in zip(DEPTHS, 'os^v', strict=True):
        depth = part * P.length
        models = models_at(depth)
        errors = []
        for model in models:
            value = model.modes.integrals(depth).value
            deflection = value @ np.linalg.solve(model.stiffness_matrix(depth), value)
            errors.append(1.0 - deflection / exact_compliance(depth))
        counts = [model.modes.count for model in models]
        right.semilogy(counts, errors, f'{mark}-', label=f's = {depth * 100:g} cm')
    right.set(
        title='tip deflection under a force at the tip',
        ylabel='shortfall against the exact beam, relative',
    )
    for axes in (left, right):
        axes.set(xlabel='number of modes n', xticks=range(1, MOST_MODES + 1))
        axes.grid(visible=True, alpha=0.3)
        axes.legend()
    return figure


def models_at(depth: float) -> list[NeedleModel]:
    """Return the models of all numbers of modes that are valid at a depth [m]."""
    least = min(depth, 0.95 * P.length)
    return [
        NeedleModel(NeedleParameters(modes=n, minimum_depth=least))
        for n in range(1, MOST_MODES + 1)
        if np.linalg.cond(mode_shapes(P.length, n).integrals(least).gram) <= LARGEST_CONDITION
    ]


def exact_frequencies(depth: float) -> FloatArray:
    """Return the first three angular frequencies of the beam of this length [rad/s]."""
    bending = P.bending_stiffness * (mode_shapes(P.length, 3).arguments / depth) ** 4
    return np.asarray(np.sqrt((bending + P.tissue_stiffness) / P.linear_density))


def exact_compliance(depth: float) -> float:
    """Return the tip deflection [m] of E I w'''' + k w = 0 under a force of 1 N at the tip."""
    decay = (P.tissue_stiffness / (4.0 * P.bending_stiffness)) ** 0.25
    x = decay * depth
    shape = np.sinh(x) * np.cosh(x) - np.sin(x) * np.cos(x)
    spread = np.cosh(x) ** 2 + np.cos(x) ** 2
    return float(2.0 * decay / P.tissue_stiffness * shape / spread)


if __name__ == '__main__':
    draw().savefig(Path(__file__).with_suffix('.png'), dpi=120)
