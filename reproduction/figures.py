# SPDX-License-Identifier: Apache-2.0
"""Draw figures 4 to 8 of the paper from the runs of `runs`."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from needle_dynamics import FloatArray, NeedleParameters
from needle_insertion.report.content import Picture
import numpy as np
from reproduction import runs
from reproduction.content import Grid, ReportSection

LAW_COLORS: Final[Mapping[str, str]] = {'inverse_dynamics': '#c25a00', 'pid': '#1f5fa8'}

_COLORS: Final = dict(zip(runs.CASES, ('#1f5fa8', '#c25a00', '#2a9d5c', '#7b3fa0'), strict=True))
_DASHES: Final = dict(zip(runs.CASES, ('-', '--', '-.', ':'), strict=True))
_HUB: Final = {False: 'without a hub', True: 'the hub stops the needle'}

#: Drawn state variables: index and axis label.
_STATES: Final = (
    (0, 'd [mm]'),
    (2, r'$q_1$ [$10^{-3}$ m$^{3/2}$]'),
    (3, r'$q_2$ [$10^{-3}$ m$^{3/2}$]'),
)

#: Column heads of `_cells`.
_HEADS: Final = (
    *('peak of the tip [mm]', 'at [s]', 'tip at the end [mm]', 'd at the end [mm]'),
    *('largest depth [mm]', 'end [s]'),
)


def _cells(found: runs.RunOutcome) -> tuple[str, ...]:
    return (
        f'{1e3 * found.peak:.4g}',
        f'{found.peak_time:.4g}',
        _millimeters(found.final),
        _millimeters(found.error),
        f'{1e3 * found.deepest:.4g}',
        f'{found.end:.4g}',
    )


def _millimeters(value: float) -> str:
    """Format a length [m] in mm; values below a nanometer are rounding errors."""
    return f'{1e3 * value:.3g}' if abs(value) >= 1e-9 else '< 1e-6'


def _label(case: tuple[str, ...]) -> str:
    reading = {'paper_si': '0.3 N s/m', 'paper_mm': '0.3 N s/mm'}[case[0]]
    return ', '.join((reading, *case[1:]))


@dataclass(frozen=True, slots=True, kw_only=True)
class PaperFigure:
    """Figure of the paper."""

    picture: Picture
    #: Metrics of each run, by reading and formulation, and for a closed loop 'hub' or 'no hub'.
    outcomes: Mapping[tuple[str, ...], runs.RunOutcome]

    def table(self, title: str = '') -> Grid:
        """Return the metrics as a table with a row per run; default title is the figure."""
        title = title or self.picture.caption.partition(',')[0]
        rows = tuple((_label(case), *_cells(found)) for case, found in self.outcomes.items())
        return Grid(caption=f'{title}: metrics of each run', heads=('run', *_HEADS), rows=rows)


def _draw_open(axes: Axes, case: tuple[str, str], values: FloatArray) -> float:
    """Draw values of an open-loop run [mm]; return the factor of the time axis."""
    is_fast = case[0] == 'paper_si'
    factor, unit = (1e3, 'ms') if is_fast else (1.0, 's')
    _draw_band(axes, factor * runs.open_loop(*case).time, 1e3 * values, _COLORS[case])
    axes.set_xlabel(f'time [{unit}]')
    axes.grid(visible=True, alpha=0.3)
    return factor


def _draw_band(axes: Axes, time: FloatArray, values: FloatArray, color: str) -> None:
    """Draw a line, or its envelope if it oscillates faster than the pixels resolve."""
    bins = 800
    width = len(time) // bins
    if width < 8:
        axes.plot(time, values, color=color, linewidth=0.8)
        return
    count = bins * width
    parts = values[:count].reshape(bins, width)
    middle = time[:count].reshape(bins, width).mean(axis=1)
    axes.fill_between(
        middle, parts.min(axis=1), parts.max(axis=1), color=color, linewidth=0.4, alpha=0.9
    )


def _open_outcomes() -> dict[tuple[str, ...], runs.RunOutcome]:
    return {case: runs.RunOutcome.of(runs.open_loop(*case)) for case in runs.CASES}


def _figure_4() -> PaperFigure:
    figure = Figure(figsize=(10.0, 6.0), layout='constrained')
    grid = figure.subplots(2, 2, sharex='row')
    for axes, case in zip(grid.flat, runs.CASES, strict=True):
        run = runs.open_loop(*case)
        factor = _draw_open(axes, case, run.tip_deflection)
        axes.axvline(factor * runs.hub_time(run), color='0.4', linewidth=0.8, linestyle=':')
        axes.set_title(_label(case))
    for axes in grid[:, 0]:
        axes.set_ylabel('tip deflection [mm]')
    found = _open_outcomes()
    fast, fast_printed, slow, slow_printed = (1e3 * abs(one.peak) for one in found.values())
    soon, late = (runs.hub_time(runs.open_loop(*runs.CASES[k])) for k in (0, 2))
    caption = (
        f'Figure 4, tip deflection under {runs.FORCE:g} N. With mu_v = 0.3 N s/m the needle is at '
        f'its hub after {1e3 * soon:.1f} ms (dotted), with 0.3 N s/mm after {late:.1f} s. The '
        f'deflection is not constant: it rings, at kilohertz at first, with up to {fast:.3g} mm '
        f'and {slow:.3g} mm by the complete and '
        f'{fast_printed:.3g} mm and {slow_printed:.3g} mm by the printed equations. The model has '
        'no damping. Bands are the envelope of fast vibration.'
    )
    return PaperFigure(picture=Picture('figure_4', caption, figure), outcomes=found)


def _figure_5() -> PaperFigure:
    figure = Figure(figsize=(12.0, 7.0), layout='constrained')
    grid = figure.subplots(3, 4, sharex='col')
    for column, case in zip(grid.T, runs.CASES, strict=True):
        for axes, (k, _name) in zip(column, _STATES, strict=True):
            _draw_open(axes, case, runs.open_loop(*case).states[:, k])
        for axes in column[:-1]:
            axes.set_xlabel('')
        column[0].set_title(_label(case), fontsize='medium')
    for axes, (_k, name) in zip(grid[:, 0], _STATES, strict=True):
        axes.set_ylabel(name)
    fast, slow = (
        float(np.abs(np.subtract(*(runs.open_loop(*case).states[:, 0] for case in pair))).max())
        for pair in (runs.CASES[:2], runs.CASES[2:])
    )
    caption = (
        'Figure 5, state variables under 3 N. d decreases to the hub and stays there. By the '
        'complete equations q1 and q2 decrease during the insertion, since the same deflection of '
        'a longer needle requires smaller values; by the printed equations they do not. The two '
        f'differ in d by at most {1e3 * fast:.2g} mm (0.3 N s/m) and {1e3 * slow:.2g} mm '
        '(0.3 N s/mm): the '
        'printed equations have no force of the deflection on d.'
    )
    return PaperFigure(picture=Picture('figure_5', caption, figure), outcomes=_open_outcomes())


def _closed_outcomes(law: str) -> dict[tuple[str, ...], runs.RunOutcome]:
    return {
        (*case, 'hub' if hub_stop else 'no hub'): runs.RunOutcome.of(
            runs.closed_loop(law, *case, hub_stop=hub_stop)
        )
        # PID stops before the hub.
        for hub_stop in ((True,) if law == 'pid' else (False, True))
        for case in runs.CASES
    }


def _draw_closed(axes: Axes, law: str, *, hub_stop: bool, k: int | None = None) -> None:
    """Draw a state variable of all cases, or the tip deflection [mm]."""
    for case in runs.CASES:
        run = runs.closed_loop(law, *case, hub_stop=hub_stop)
        shown = run.time <= runs.SHOWN
        values = run.tip_deflection if k is None else run.states[:, k]
        axes.plot(
            run.time[shown],
            1e3 * values[shown],
            color=_COLORS[case],
            linestyle=_DASHES[case],
            linewidth=2.2 if _DASHES[case] == '-' else 1.4,
            label=_label(case),
        )
    axes.grid(visible=True, alpha=0.3)


def _figure_6() -> PaperFigure:
    figure = Figure(figsize=(11.0, 7.0), layout='constrained')
    grid = figure.subplots(3, 2, sharex=True)
    for column, (hub_stop, words) in zip(grid.T, _HUB.items(), strict=True):
        for axes, (k, _name) in zip(column, _STATES, strict=True):
            _draw_closed(axes, 'inverse_dynamics', hub_stop=hub_stop, k=k)
        column[0].set_title(words)
        column[-1].set_xlabel('time [s]')
    for axes, (_k, name) in zip(grid[:, 0], _STATES, strict=True):
        axes.set_ylabel(name)
    grid[0, 1].legend(fontsize='small')
    found = _closed_outcomes('inverse_dynamics')
    free = found['paper_si', 'complete', 'no hub']
    caption = (
        'Figure 6, state variables under inverse dynamics with the gains of the paper. All four '
        'cases coincide: with an exact model the law cancels friction, stiffness and formulation, '
        'and the error obeys e_ddot + k_v e_dot + k_p e = 0, with a '
        'damping ratio of 0.05 in d and 0.16 in q1 and q2. d overshoots to '
        f'{1e3 * (NeedleParameters().length - free.deepest):.0f} mm, {1e3 * free.deepest:.0f} mm '
        'of a 200 mm needle inserted, which is possible only in a model without a hub. With the '
        'hub the needle stops at the target.'
    )
    return PaperFigure(picture=Picture('figure_6', caption, figure), outcomes=found)


def _figure_7() -> PaperFigure:
    figure = Figure(figsize=(11.0, 4.2), layout='constrained')
    for axes, (hub_stop, words) in zip(figure.subplots(1, 2), _HUB.items(), strict=True):
        _draw_closed(axes, 'inverse_dynamics', hub_stop=hub_stop)
        axes.set(title=words, xlabel='time [s]', xlim=(0.0, 20.0))
    figure.axes[0].set_ylabel('tip deflection [mm]')
    figure.axes[1].legend(fontsize='small')
    found = _closed_outcomes('inverse_dynamics')
    free, held = (found['paper_si', 'complete', word] for word in ('no hub', 'hub'))
    caption = (
        'Figure 7, tip deflection under inverse dynamics. It converges to zero after a peak: q1 '
        'and q2 are slow (3.2 rad/s) and the needle is inserted before they decay, so that the '
        f'tip swings to {1e3 * free.peak:.0f} mm at {free.peak_time:.1f} s without a hub and to '
        f'{1e3 * held.peak:.0f} mm at {held.peak_time:.1f} s with it, from 0.5 mm at the start. '
        'Such a deflection is outside the validity of a linear beam model.'
    )
    return PaperFigure(picture=Picture('figure_7', caption, figure), outcomes=found)


def _figure_8() -> PaperFigure:
    figure = Figure(figsize=(11.0, 4.2), layout='constrained')
    left, right = figure.subplots(1, 2)
    _draw_closed(left, 'pid', hub_stop=True)
    left.set(xlabel='time [s]', ylabel='tip deflection [mm]')
    left.legend(fontsize='small')
    for law, name in runs.LAWS.items():
        run = runs.closed_loop(law, 'paper_mm', 'complete', hub_stop=law == 'pid')
        right.semilogy(run.time, 1e3 * np.abs(run.states[:, 0]), color=LAW_COLORS[law], label=name)
    bound = NeedleParameters().coulomb_friction / runs.PID_KP
    right.axhline(1e3 * bound, color='0.4', linestyle=':', label=r'$\mu_s / k_p$')
    right.set(xlabel='time [s]', ylabel='position error |d| [mm]', ylim=(1e-2, 3e2))
    right.grid(visible=True, alpha=0.3)
    right.legend(fontsize='small')
    found = _closed_outcomes('pid')
    fast, slow = (found[reading, 'complete', 'hub'] for reading in runs.READINGS)
    caption = (
        'Figure 8, PID with the gains of the paper. Left: the tip deflection grows to '
        f'{1e3 * abs(fast.peak):.1f} mm (0.3 N s/m) or {1e3 * abs(slow.peak):.1f} mm '
        f'(0.3 N s/mm) at {slow.peak_time:.0f} s and then converges to zero, as under inverse '
        'dynamics: friction does not act on q1 and q2. Right '
        f'(0.3 N s/mm, complete): d stops at {1e3 * slow.error:.2f} mm = mu_s / k_p, where '
        'friction balances the proportional force without an integral. The error of inverse '
        'dynamics, without a hub, falls as exp(-0.05 t).'
    )
    return PaperFigure(picture=Picture('figure_8', caption, figure), outcomes=found)


#: Functions that draw the figures, by name.
FIGURES: Final[Mapping[str, Callable[[], PaperFigure]]] = {
    'figure-4': _figure_4,
    'figure-5': _figure_5,
    'figure-6': _figure_6,
    'figure-7': _figure_7,
    'figure-8': _figure_8,
}


def _comparison() -> Grid:
    rows = []
    for reading in runs.READINGS:
        for law, name in runs.LAWS.items():
            compared = {
                'forces on d, q1, q2': runs.closed_loop(law, reading, 'complete', hub_stop=True),
                'f_y alone': runs.base_alone(law, reading),
            }
            rows += [
                (f'{name}, {_label((reading,))}, {how}', *_cells(runs.RunOutcome.of(run)))
                for how, run in compared.items()
            ]
    return Grid(
        caption='Metrics of each controller by actuated coordinates (hub on, complete equations)',
        heads=('controller', *_HEADS),
        rows=tuple(rows),
    )


def section() -> ReportSection:
    """Return the section of the results page: figures 4 to 8, and a comparison of the laws."""
    figures = [draw() for draw in FIGURES.values()]
    pid = runs.RunOutcome.of(runs.closed_loop('pid', 'paper_mm', 'complete', hub_stop=True))
    inverse, proportional = (
        1e3 * runs.RunOutcome.of(runs.base_alone(law, 'paper_mm')).final for law in runs.LAWS
    )
    return ReportSection(
        title='Figures 4 to 8',
        paragraphs=(
            (
                'Start of all runs: 2 cm inserted, tip deflected by 0.5 mm in the static shape '
                'for a force at the tip (the paper gives only the tip deflection). Gains: inverse '
                'dynamics k_p = diag(1, 10, 10), k_v = 0.1 k_p; PID k_p = 1000, k_v = 10 k_p on '
                'each of d, q1 and q2, no integral. The target state is zero.'
            ),
            (
                'Final deflection: both controllers reduce it to zero, with generalized forces on '
                'q1 and q2 that no motor of a needle robot applies. With f_y alone the deflection '
                'remains: the needle is at its depth and its tip vibrates, with up to '
                f'{inverse:.2g} mm under inverse dynamics and {proportional:.2g} mm under PID '
                '(0.3 N s/mm), as the model has no damping.'
            ),
            (
                'Final position error: inverse dynamics none, since it compensates Coulomb '
                f'friction exactly; PID {1e3 * pid.error:.2f} mm = mu_s / k_p, since it has no '
                'integral. Either an integral or compensation of mu_s removes this error; the '
                'other parameters of the model do not affect it.'
            ),
        ),
        tables=(
            _comparison(),
            figures[0].table('Figures 4 and 5'),
            figures[2].table('Figures 6 and 7'),
            figures[4].table(),
        ),
        pictures=tuple(one.picture for one in figures),
    )
