"""Figures of identified stiffness."""

from __future__ import annotations

from math import isfinite

from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from needle_identification import LevelEstimate, StiffnessEstimate, StiffnessSummary
from needle_insertion.paper.tables import FORCE_LEVELS, TABLE_2
from needle_insertion.report.figures import DATA, FIT, IN, label_axes, legend_above, new_figure
import numpy as np


def level_figure(summary: StiffnessSummary) -> Figure:
    """
    Draw each entry of the matrix against the force, beside Table 2.

    Parameters
    ----------
    summary : StiffnessSummary
        All recordings.

    Returns
    -------
    Figure
        Four plots.

    """
    figure = new_figure(9.0, 6.5)
    for axes, (name, (means, deviations)) in zip(
        figure.subplots(2, 2, sharex=True).flat, TABLE_2.items(), strict=True
    ):
        axes.errorbar(
            FORCE_LEVELS, means, deviations, fmt='D', color=DATA, capsize=4.0, markersize=5.0,
            label='Table 2, mean and STD', zorder=1,
        )  # fmt: skip
        # Beside one another, not on top.
        for estimate in summary.estimates:
            places = [(one.force - 0.012, one[name].value) for one in estimate.levels]
            axes.plot(*np.transpose(places), '.', color=IN, alpha=0.35, markersize=4.0)
        rows = [(level.force + 0.012, level[name]) for level in summary.levels]
        known = [(force, one.mean, *one.interval) for force, one in rows if isfinite(one.mean)]
        if known:
            force, mean, low, high = np.transpose(known)
            axes.errorbar(
                force, mean, (mean - low, high - mean), fmt='o', color=IN, capsize=4.0,
                label='identified, mean and 95 % interval', zorder=3,
            )  # fmt: skip
        label_axes(axes, '', f'{name} [N/m]')
        axes.axhline(0.0, color=FIT, linewidth=0.6)
    for axes in figure.axes[2:]:
        axes.set_xlabel('force [N]')
    figure.legend(
        *figure.axes[0].get_legend_handles_labels(), loc='outside upper left', ncols=2,
        frameon=False,
    )  # fmt: skip
    return figure


def press_figure(estimate: StiffnessEstimate) -> Figure:
    """
    Draw the presses of one recording with the fitted matrices.

    Parameters
    ----------
    estimate : StiffnessEstimate
        What the recording gave.

    Returns
    -------
    Figure
        Force against displacement, and the displacements in the plane.

    """
    presses = estimate.presses
    figure = new_figure(9.0, 4.8)
    left, right = figure.subplots(1, 2)
    force = np.hypot(*presses.force.T)
    along = np.einsum('ij,ij->i', presses.displacement, presses.force) / force
    colors = colormaps['twilight_shifted'](np.linspace(0.1, 0.9, presses.direction.max() + 1))
    for index, color in enumerate(colors):
        of = presses.direction == index
        way = presses.force[of].mean(axis=0)
        order = np.argsort(force[of])
        left.plot(
            1e3 * np.append(0.0, along[of][order]), np.append(0.0, force[of][order]), 'o-',
            color=color, markersize=4.0, linewidth=1.0,
            label=f'{round(np.degrees(np.arctan2(way[1], way[0]))) % 360}°',
        )  # fmt: skip
        right.plot(*1e3 * presses.displacement[of].T, 'o', color=color, markersize=4.0)
    turn = np.linspace(0.0, 2.0 * np.pi, 181)
    circle = np.array([np.cos(turn), np.sin(turn)])
    for level in estimate.levels:
        if np.isfinite(level.matrix).all():
            ellipse = 1e3 * np.linalg.solve(level.matrix, level.force * circle)
            right.plot(*ellipse, color=DATA, linewidth=0.8, zorder=1)
    _principal_axes(right, estimate.levels[-1])
    label_axes(left, 'displacement along the force [mm]', 'force [N]')
    left.set(xlim=(0.0, None), ylim=(0.0, None))
    left.legend(title='direction, from x toward z', ncols=2, frameon=False, loc='lower right')
    label_axes(right, 'displacement x [mm]', 'displacement z [mm]')
    right.set_aspect('equal', 'datalim')
    return figure


def _principal_axes(axes: Axes, level: LevelEstimate) -> None:
    """Draw the principal axes of the largest force, each as long as that force moves it."""
    if not level.angle.determined:
        return
    for one, name, turned, style in zip(
        level.principal, ('stiffest', 'softest'), (0.0, np.pi / 2.0), ('-', '--'), strict=True
    ):
        way = level.angle.value + turned
        reach = 1e3 * level.force / one.value * np.array([np.cos(way), np.sin(way)])
        axes.plot(
            *np.transpose([-reach, reach]), style, color=FIT, linewidth=1.2,
            label=f'{name}: {one.value:.0f} N/m',
        )  # fmt: skip
    legend_above(axes)
