# SPDX-License-Identifier: Apache-2.0
"""Figures of identified friction and stiffness."""

from collections.abc import Iterator, Mapping, Sequence
from math import isfinite
import re
from typing import Any, Final

from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from needle_dynamics.arrays import BoolArray, FloatArray
import needle_identification as identification
from needle_insertion.report.identify_text import label_of
from needle_insertion.report.paper_tables import FORCE_LEVELS, TABLE_2
import numpy as np

#: Colors: insertion and results, withdrawal, data, pale data, fits.
_IN, _OUT, _DATA, _LIGHT, _FIT = '#1f5fa8', '#c25a00', '#8b95a1', '#c3cad2', '#111111'

#: Color and name of samples that a fit does not use.
_EXCLUDED, _NAMED = '#7a1f6b', 'excluded from the fit'

#: Width of a figure [in]: its text is readable at the width of a telephone, too.
_WIDTH: Final = 4.8

#: Largest number of drawn points of a line, in large and small plots.
_MOST_POINTS: Final = 8000
_MOST_SMALL: Final = 300

_SYMBOL: Final = re.compile(r'\b(mu|k|f)_(\w{1,3})\b')
_GREEK: Final = {'mu': r'\mu'}


def _sides(fit: identification.Fit) -> Iterator[tuple[BoolArray, str, str, str]]:
    """Yield used samples, label, color and marker of each direction of motion."""
    yield fit.used & (fit.velocity > 0.0), 'insertion', _IN, 'o'
    yield fit.used & (fit.velocity < 0.0), 'withdrawal', _OUT, '^'


def friction_data(estimate: identification.FrictionEstimate) -> Figure:
    """Draw the filtered force over time and against velocity, with the fit."""
    fit = estimate.fit
    figure = Figure(figsize=(_WIDTH, 7.5), layout='constrained')
    above, below = figure.subplots(2, 1)
    time = fit.time - fit.time[0]
    for values, style in (
        (fit.force, {'color': _LIGHT, 'linewidth': 3.0, 'label': 'measured, filtered'}),
        (
            np.where(fit.used, np.nan, fit.force),
            {'color': _EXCLUDED, 'linewidth': 1.2, 'linestyle': ':', 'label': _NAMED},
        ),
        (np.where(fit.used, fit.model, np.nan), {'color': _FIT, 'linewidth': 1.2, 'label': 'fit'}),
    ):
        above.plot(*_thinned(time, values), **style)
    _label(above, 'time [s]', 'force on the needle [N]')
    _legend_above(above)
    _excluded(below, fit, _MOST_POINTS, 3.0)
    for side, words, color, mark in _sides(fit):
        speed, force = _thinned(1e3 * fit.velocity[side], fit.force[side])
        below.plot(speed, force, mark, color=color, markersize=2.5, alpha=0.4, label=words)
        order = np.argsort(fit.velocity[side])
        line = _thinned(1e3 * fit.velocity[side][order], fit.model[side][order])
        label = 'fit' if words == 'withdrawal' else None
        below.plot(*line, color=_FIT, linewidth=1.2, label=label)
    below.axhline(0.0, color=_FIT, linewidth=0.6)
    below.axvline(0.0, color=_FIT, linewidth=0.6)
    _label(below, 'insertion velocity [mm/s]', 'force on the needle [N]')
    _legend_above(below, markerscale=2.0)
    return figure


def _excluded(axes: Axes, fit: identification.Fit, most: int, size: float) -> None:
    out = ~fit.used
    speed, force = _thinned(1e3 * fit.velocity[out], fit.force[out], most=most)
    axes.plot(speed, force, 'x', color=_EXCLUDED, markersize=size, alpha=0.5, label=_NAMED)


def friction_residuals(estimate: identification.FrictionEstimate) -> Figure:
    """Draw the residual over time, against velocity, and as a histogram."""
    fit = estimate.fit
    figure = Figure(figsize=(_WIDTH, 8.0), layout='constrained')
    over, against, often = figure.subplots(3, 1)
    residual = 1e3 * (fit.force - fit.model)
    reach = float(np.abs(residual[fit.used]).max())
    edges = np.linspace(-reach, reach, 41).tolist()
    for side, words, color, mark in _sides(fit):
        time, speed, left = _thinned(
            fit.time[side] - fit.time[0], 1e3 * fit.velocity[side], residual[side]
        )
        style: dict[str, Any] = {'color': color, 'markersize': 2.0, 'alpha': 0.5}
        over.plot(time, left, mark, label=words, **style)
        against.plot(speed, left, mark, **style)
        often.hist(residual[side], edges, color=color, histtype='step', linewidth=1.4)
    for axes in (over, against):
        axes.axhline(0.0, color=_FIT, linewidth=0.8)
    _label(over, 'time [s]', 'residual [mN]')
    _label(against, 'insertion velocity [mm/s]', 'residual [mN]')
    _label(often, 'residual [mN]', 'samples')
    _legend_above(over, markerscale=3.0)
    return figure


def friction_each(
    estimates: Sequence[identification.FrictionEstimate], names: Sequence[str]
) -> Figure:
    """Draw force against velocity of each recording, with the fit."""
    figure, panels = _small_multiples(
        names, 'insertion velocity [mm/s]', 'force on the needle [N]'
    )
    for axes, estimate in zip(panels, estimates, strict=True):
        fit = estimate.fit
        _excluded(axes, fit, _MOST_SMALL, 2.0)
        for side, words, color, mark in _sides(fit):
            order = np.argsort(fit.velocity[side])
            speed, force, model = (
                _thinned(values[side][order], most=_MOST_SMALL)[0]
                for values in (1e3 * fit.velocity, fit.force, fit.model)
            )
            axes.plot(speed, force, mark, color=color, markersize=1.5, alpha=0.5, label=words)
            axes.plot(speed, model, color=_FIT, linewidth=0.9)
    return figure


def stiffness_each(
    estimates: Sequence[identification.StiffnessEstimate], names: Sequence[str]
) -> Figure:
    """Draw the rest positions of the end-effector in each recording, with fitted ellipses."""
    figure, panels = _small_multiples(names, 'displacement x [mm]', 'displacement z [mm]')
    for axes, estimate in zip(panels, estimates, strict=True):
        _ellipses(axes, estimate)
        axes.plot(*1e3 * estimate.presses.displacement.T, 'o', color=_IN, markersize=2.0)
    return figure


def _small_multiples(names: Sequence[str], xlabel: str, ylabel: str) -> tuple[Figure, list[Axes]]:
    """Return a figure with a small plot for each name, in rows, with shared axes."""
    figure, panels = _panels(len(names), 3, 0.6, 1.3, sharex=True)
    for axes, name in zip(panels, names, strict=True):
        axes.set_title(name, fontsize='small')
        _label(axes, '', '')
    figure.supxlabel(xlabel)
    figure.supylabel(ylabel)
    return figure, panels


def _panels(
    count: int, most: int, margin: float, height: float, *, sharex: bool
) -> tuple[Figure, list[Any]]:
    """Return a figure with plots in rows of at most `most`, with heights and a margin [in]."""
    columns = min(count, most)
    lines = -(-count // columns)
    figure = Figure(figsize=(_WIDTH, margin + height * lines), layout='constrained')
    panels = figure.subplots(lines, columns, sharex=sharex, sharey=True, squeeze=False)
    for axes in panels.flat[count:]:
        axes.set_visible(False)
    return figure, list(panels.flat[:count])


def _ellipses(axes: Axes, estimate: identification.StiffnessEstimate) -> None:
    turn = np.linspace(0.0, 2.0 * np.pi, 181)
    circle = np.array([np.cos(turn), np.sin(turn)])
    for level in estimate.levels:
        if np.isfinite(level.matrix).all():
            ellipse = 1e3 * np.linalg.solve(level.matrix, level.force * circle)
            axes.plot(*ellipse, color=_DATA, linewidth=0.8, zorder=1)


def stiffness_levels(summary: identification.StiffnessSummary) -> Figure:
    """Draw each entry of the matrix against the force, with Table 2."""
    # The legend is above the axes: Matplotlib 3.6 has no place outside all axes.
    figure = Figure(figsize=(_WIDTH, 5.5), layout=ConstrainedLayoutEngine(rect=(0, 0, 1, 0.91)))
    for axes, (name, (means, deviations)) in zip(
        figure.subplots(2, 2, sharex=True).flat, TABLE_2.items(), strict=True
    ):
        axes.errorbar(
            FORCE_LEVELS, means, deviations, fmt='D', color=_DATA, capsize=4.0, markersize=5.0,
            label='Table 2, mean and STD', zorder=1,
        )  # fmt: skip
        # Offset horizontally to avoid overlap.
        for estimate in summary.estimates:
            places = [(one.force - 0.012, one[name].value) for one in estimate.levels]
            axes.plot(*np.transpose(places), '.', color=_IN, alpha=0.35, markersize=4.0)
        rows = [(level.force + 0.012, level[name]) for level in summary.levels]
        known = [(force, one.mean, *one.interval) for force, one in rows if isfinite(one.mean)]
        if known:
            force, mean, low, high = np.transpose(known)
            axes.errorbar(
                force, mean, (mean - low, high - mean), fmt='o', color=_IN, capsize=4.0,
                label='identified, mean and 95 % interval', zorder=3,
            )  # fmt: skip
        _label(axes, '', f'{name} [N/m]')
        axes.axhline(0.0, color=_FIT, linewidth=0.6)
    for axes in figure.axes[2:]:
        axes.set_xlabel('force [N]')
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc='upper left', frameon=False)
    return figure


def stiffness_presses(estimate: identification.StiffnessEstimate) -> Figure:
    """Draw force against displacement, and the displacements in the plane, with the fit."""
    presses = estimate.presses
    figure = Figure(figsize=(_WIDTH, 8.5), layout='constrained')
    above, below = figure.subplots(2, 1)
    force = np.hypot(*presses.force.T)
    along = np.einsum('ij,ij->i', presses.displacement, presses.force) / force
    colors = colormaps['twilight_shifted'](np.linspace(0.1, 0.9, presses.direction.max() + 1))
    for index, color in enumerate(colors):
        of = presses.direction == index
        direction = presses.force[of].mean(axis=0)
        order = np.argsort(force[of])
        above.plot(
            1e3 * np.append(0.0, along[of][order]), np.append(0.0, force[of][order]), 'o-',
            color=color, markersize=4.0, linewidth=1.0,
            label=f'{round(np.degrees(np.arctan2(direction[1], direction[0]))) % 360}°',
        )  # fmt: skip
        below.plot(*1e3 * presses.displacement[of].T, 'o', color=color, markersize=4.0)
    _ellipses(below, estimate)
    _principal_axes(below, estimate.levels[-1])
    _label(above, 'displacement along the force [mm]', 'force [N]')
    above.set(xlim=(0.0, None), ylim=(0.0, None))
    above.legend(title='direction, from x toward z', ncols=2, frameon=False, loc='lower right')
    _label(below, 'displacement x [mm]', 'displacement z [mm]')
    below.set_aspect('equal', 'datalim')
    return figure


def _principal_axes(axes: Axes, level: identification.LevelEstimate) -> None:
    """Draw the principal axes at the largest force, scaled to its displacement."""
    if not level.angle.determined:
        return
    for one, name, turned, style in zip(
        level.principal, ('stiffest', 'softest'), (0.0, np.pi / 2.0), ('-', '--'), strict=True
    ):
        direction = level.angle.value + turned
        reach = 1e3 * level.force / one.value * np.array([np.cos(direction), np.sin(direction)])
        axes.plot(
            *np.transpose([-reach, reach]), style, color=_FIT, linewidth=1.2,
            label=f'{name}: {one.value:.0f} N/m',
        )  # fmt: skip
    _legend_above(axes)


def spread_figure(
    means: Sequence[identification.Statistic],
    rows: Sequence[tuple[str, Mapping[str, identification.ParameterEstimate]]],
) -> Figure:
    """Draw each parameter of each recording with its interval, and the mean with its interval."""
    figure, panels = _panels(len(means), 2, 0.0, 1.2 + 0.24 * len(rows), sharex=False)
    for axes, mean in zip(panels, means, strict=True):
        for place, (_, found) in enumerate(rows):
            one = found.get(mean.name)
            if one is not None and one.determined:
                axes.plot(one.interval, (place, place), color=_DATA, linewidth=1.6)
                axes.plot(one.value, place, 'o', color=_IN, markersize=5.0)
        if isfinite(mean.mean):
            axes.axvspan(*mean.interval, color=_IN, alpha=0.12, linewidth=0.0)
            axes.axvline(mean.mean, color=_IN, linewidth=1.2)
        _label(axes, label_of(mean), '')
        axes.tick_params(left=False)
        axes.xaxis.get_major_formatter().set_useOffset(False)
        axes.locator_params(axis='x', nbins=3)
    panels[0].set_yticks(range(len(rows)), [name for name, _ in rows])
    panels[0].set_ylim(len(rows) - 0.5, -0.5)
    return figure


def _label(axes: Axes, xlabel: str, ylabel: str) -> None:
    axes.set(xlabel=_typeset(xlabel), ylabel=_typeset(ylabel))
    axes.grid(visible=True, alpha=0.25)
    axes.spines[['top', 'right']].set_visible(False)


def _typeset(words: str) -> str:
    words = words.replace('^2', '²').replace('tau', r'$\tau$')
    return _SYMBOL.sub(lambda m: f'${_GREEK.get(m[1], m[1])}_{{{m[2]}}}$', words)


def _legend_above(axes: Axes, **options: Any) -> None:
    axes.legend(
        loc='lower left', bbox_to_anchor=(0.0, 1.0), ncols=2, frameon=False,
        borderaxespad=0.2, handletextpad=0.5, **options,
    )  # fmt: skip


def _thinned(*signals: FloatArray, most: int = _MOST_POINTS) -> list[FloatArray]:
    step = max(1, len(signals[0]) // most)
    return [signal[::step] for signal in signals]
