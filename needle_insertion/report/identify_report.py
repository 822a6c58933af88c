"""The page about what was identified: the figures, the data behind them, and what to doubt."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from math import isfinite
from pathlib import Path
import re
from typing import Any, Final

from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from needle_dynamics import FloatArray
from needle_identification import (
    FrictionEstimate,
    FrictionSummary,
    LevelEstimate,
    LevelSummary,
    ParameterEstimate,
    Statistic,
    statistic,
    StiffnessEstimate,
    StiffnessSummary,
)
from needle_identification.estimation.formatting import between, measured, rounded, spread
from needle_identification.result import model_parameters
from needle_insertion.paper.tables import FORCE_LEVELS, TABLE_1, TABLE_2
from needle_insertion.report.page import (
    bullets,
    code,
    grid,
    heading,
    headline,
    notice,
    paragraph,
    Picture,
    write_document,
)
import numpy as np

_IN, _OUT, _DATA, _LIGHT, _FIT = '#1f5fa8', '#c25a00', '#8b95a1', '#c3cad2', '#111111'

#: Symbols as they are written in plain text.
_MATH: Final = re.compile(r'\b(mu|k|f)_(\w{1,3})\b')
_NUMBERS: Final = re.compile(r'[-+]?\d[\d.e+-]*')
_GREEK: Final = {'mu': r'\mu'}

#: Points of a line in a picture; more cannot be seen.
_MOST_POINTS: Final = 8000

_SIDES = ((1.0, 'into the tissue', _IN, 'o'), (-1.0, 'out of it', _OUT, '^'))


@dataclass(frozen=True, slots=True, kw_only=True)
class Source:
    """
    What a recording was read from.

    Attributes
    ----------
    name : str
        The recording.
    losses : tuple of str
        What was lost, left out or repaired in reading, in words.
    clock_offset : float
        Stamps of the force minus those of the motion [s], corrected.
    samples : int
        Samples of force and motion.
    files : tuple of (str, str)
        Paths and SHA-256 of its files.

    """

    name: str
    losses: tuple[str, ...]
    clock_offset: float
    samples: int
    files: tuple[tuple[str, str], ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Origin:
    """
    What a result was identified from, and how.

    Attributes
    ----------
    sources : sequence of Source
        The recordings.
    failures : sequence of (str, str)
        Recordings that could not be used, and why.
    settings : object
        The dataclass with the settings.
    reading : Mapping[str, Any]
        Options of reading; None stands for what is found by type.
    result : Path or None
        The parameter file, if one was written.

    """

    sources: Sequence[Source]
    failures: Sequence[tuple[str, str]]
    settings: Any
    reading: Mapping[str, Any]
    result: Path | None


def friction_report(
    folder: Path,
    summary: FrictionSummary,
    origin: Origin,
) -> Path:
    """
    Write ``friction.html`` and its pictures.

    Parameters
    ----------
    folder : Path
        Where to write.
    summary : FrictionSummary
        What was identified.
    origin : Origin
        What it was identified from, and how.

    Returns
    -------
    Path
        The page.

    """
    estimates = summary.estimates
    label = _labels([estimate.name for estimate in estimates])
    means = friction_statistics(summary)
    main = [one for one in summary.statistics if one.name in TABLE_1]
    first = [one[summary.statistics[0].name].value for one in estimates]
    shown = estimates[_nearest_to_median(first)]
    name = label[shown.name]
    blocks: list[str | Picture] = [
        headline([_card(one) for one in main or summary.statistics[:2]]),
        _failures(origin.failures),
        _warnings(estimates, label),
        heading('Parameters'),
        grid(
            [(*mean_row(one), _beside(TABLE_1.get(one.name), one.unit)) for one in means],
            (*MEAN_HEADS, 'Table 1, mean ± STD'),
            'Friction over all recordings',
        ),
        paragraph(
            'SE is the standard error of the mean; it respects that neighboring samples of a '
            'filtered signal are alike. The interval holds the true mean in 95 of 100 such '
            'experiments. Table 1 is of the needle and the phantom of the paper, to compare '
            'with: its mu_v is printed as 0.3 without a unit, read here as 0.3 N s/mm.'
        ),
        heading('Data and fit'),
        Picture(
            'friction_data',
            f'{name}: force over time and against speed after the low-pass filter, and '
            f'the fit of {_words(shown.terms)} to the samples in steady motion.',
            _friction_data(shown),
            f'Two plots of {name}. The force over time follows the strokes of the needle '
            'with the fitted force on top of it; against speed it jumps at zero by twice mu_s '
            'and rises with slope mu_v.',
        ),
        heading('What the fit leaves'),
        Picture(
            'friction_residuals',
            f'{name}: measured minus fitted force, over time, against speed, and how '
            'often each size occurs, apart for both directions.',
            _friction_residuals(shown),
            f'Three plots of the residual force of {name}, which has a root mean square '
            f'of {1e3 * shown.residual:.2g} mN. A good fit leaves noise around zero without a '
            'trend.',
        ),
        bullets(test.words for test in shown.tests),
        heading('Which terms the data support'),
        *_compared(shown, estimates, name),
        heading('Recording by recording'),
        Picture(
            'friction_spread',
            'Each recording with its 95 % interval; the line and the band are the mean and '
            'its interval.',
            spread_figure(means, [(label[one.name], every_parameter(one)) for one in estimates]),
            f'Dot plots of each parameter over {len(estimates)} recordings with intervals.',
        ),
        grid(
            [
                (label[one.name], *_quality(one, [mean.name for mean in means]))
                for one in estimates
            ],
            (
                'recording',
                *(label_of(mean) for mean in means),
                'samples used',
                'residual [mN]',
                'R²',
                'condition',
            ),
            'Each recording, ± its standard error',
        ),
        *_origin(origin),
        *_usage(origin.result, model_parameters(summary.statistics)),
    ]
    path = folder / 'friction.html'
    write_document(
        path,
        'Friction between needle and tissue',
        f'Identified from {_count(len(estimates), "recording")} of force and motion of the '
        'needle base by regression on equation (15).',
        blocks,
    )
    return path


def stiffness_report(
    folder: Path,
    summary: StiffnessSummary,
    origin: Origin,
) -> Path:
    """
    Write ``stiffness.html`` and its pictures.

    Parameters
    ----------
    folder : Path
        Where to write.
    summary : StiffnessSummary
        What was identified.
    origin : Origin
        What it was identified from, and how.

    Returns
    -------
    Path
        The page.

    """
    estimates = summary.estimates
    label = _labels([estimate.name for estimate in estimates])
    shown = _typical_place(summary)
    name = label[shown.name]
    springs = [level.is_spring for estimate in estimates for level in estimate.levels]
    blocks: list[str | Picture] = [
        headline(
            [
                _card(summary.tissue_stiffness),
                (
                    'Is it a spring?',
                    f'{sum(springs)} of {len(springs)} matrices are',
                    'by the curl of the force, within its uncertainty',
                ),
            ]
        ),
        _failures(origin.failures),
        _warnings(estimates, label),
        heading('Stiffness by force'),
        grid(
            [(f'{level.force:.2f} N', *_stiffness_cells(level)) for level in summary.levels],
            ('force', *(f'{entry} [N/m]' for entry in TABLE_2)),
            f'Mean ± SE (STD) over {_count(len(estimates), "place")}',
        ),
        grid(
            [
                (
                    f'{force:g} N',
                    *(f'{row[0][i]:g} ({row[1][i]:g})' for row in TABLE_2.values()),
                )
                for i, force in enumerate(FORCE_LEVELS)
            ],
            ('force', *(f'{entry} [N/m]' for entry in TABLE_2)),
            'Table 2 of the paper, mean (STD) over 20 places',
        ),
        grid(
            [
                (f'{level.force:.2f} N', *mean_row(level['tissue_stiffness'])[1:])
                for level in summary.levels
            ],
            ('force', *MEAN_HEADS[1:]),
            'k_a [N/m^2], which is k_zz over the contact length',
        ),
        Picture(
            'stiffness_levels',
            'Entries of the matrix by force, with 95 % intervals of the mean; small dots are '
            'places. Gray is Table 2, mean and STD.',
            _stiffness_levels(summary),
            'Four plots of the entries of the stiffness matrix against force, beside Table 2.',
        ),
        heading('Presses'),
        Picture(
            'stiffness_presses',
            f'{name}: left, force against displacement along each direction; right, where '
            'the end-effector came to rest, the ellipse on which each level of force ends '
            'according to the fitted matrix, and the principal axes at the largest.',
            _stiffness_presses(shown),
            f'Two plots of {name}. Force grows with displacement in each direction; the '
            'rest positions of a level of force lie on an ellipse.',
        ),
        heading('Is it a spring?'),
        paragraph(
            'A spring has a symmetric matrix. The antisymmetric part makes the force field curl: '
            'pressing around a closed path would then gain or lose energy.'
        ),
        grid(
            [
                (
                    f'{level.force:.2f} N',
                    measured(level.curl.value, level.curl.error),
                    measured(level.spring.value, level.spring.error),
                    *(measured(one.value, one.error) for one in level.principal),
                    measured(np.degrees(level.angle.value), np.degrees(level.angle.error)),
                )
                for level in shown.levels
            ],
            (
                'force',
                'curl [N/m]',
                'antisymmetric / symmetric',
                'stiffest [N/m]',
                'softest [N/m]',
                'angle from x toward z [°]',
            ),
            f'{name}, ± standard error',
        ),
        bullets(f'{level.force:.2f} N: {level.words}' for level in shown.levels),
        heading('Place by place'),
        Picture(
            'stiffness_spread',
            f'k_a of each place at {_asked(summary).force:.2f} N with its 95 % interval; the '
            'line and the band are the mean and its interval.',
            spread_figure(
                [summary.tissue_stiffness],
                [(label[one.name], _at_level(one, _asked(summary).force)) for one in estimates],
            ),
            f'Dot plot of k_a over {_count(len(estimates), "place")} with intervals.',
        ),
        grid(
            [
                (
                    label[estimate.name],
                    f'{level.force:.2f}',
                    *(measured(one.value, one.error) for one in level.parameters),
                    f'{level.presses} in {level.directions}',
                    f'{1e3 * level.residual:.2f}',
                    f'{level.determination:.4f}',
                    f'{level.condition:.1f}',
                )
                for estimate in estimates
                for level in estimate.levels
            ],
            (
                'recording',
                'force [N]',
                *(f'{entry} [N/m]' for entry in TABLE_2),
                'presses, directions',
                'residual [mN]',
                'R²',
                'condition',
            ),
            'Each place and force, ± standard error',
        ),
        *_origin(origin),
        *_usage(origin.result, model_parameters([summary.tissue_stiffness])),
    ]
    path = folder / 'stiffness.html'
    write_document(
        path,
        'Stiffness of the tissue',
        f'Identified from {_count(len(estimates), "recording")} of presses in the plane of '
        'deflection, as in Table 2 of the paper.',
        blocks,
    )
    return path


# What is said of parameters.


def every_parameter(estimate: FrictionEstimate) -> dict[str, ParameterEstimate]:
    """Return what a recording gave by name, for people: also break-away force and lag [ms]."""
    first, *others = estimate.parameters
    found = [first, estimate.breakaway, *others, estimate.lag]
    return {one.name: _in_ms(one) for one in found if one is not None}


def _in_ms(one: ParameterEstimate) -> ParameterEstimate:
    if one.unit != 's':
        return one
    low, high = one.interval
    return replace(
        one,
        unit='ms',
        value=1e3 * one.value,
        error=1e3 * one.error,
        interval=(1e3 * low, 1e3 * high),
    )


def friction_statistics(summary: FrictionSummary) -> list[Statistic]:
    """Return statistics of `every_parameter`, over the recordings that have it."""
    rows = [every_parameter(estimate) for estimate in summary.estimates]
    names = dict.fromkeys(name for row in rows for name in row)
    return [statistic([row[name] for row in rows if name in row]) for name in names]


def label_of(one: ParameterEstimate | Statistic) -> str:
    """Return symbol and unit."""
    return one.symbol if one.unit == '1' else f'{one.symbol} [{one.unit}]'


def _card(one: Statistic) -> tuple[str, str, str]:
    what = f'{one.name.replace("_", " ").capitalize()} {one.symbol}'
    if not isfinite(one.mean):
        return what, 'not determined', 'by these recordings'
    note = f'95 % interval {between(one.interval)}'
    if one.deviation is not None:
        note += f'; STD {spread(one.deviation)} over {_count(one.count, "recording")}'
    return what, rounded(one.mean, one.error, one.unit), note


#: Heads of the rows that `mean_row` returns.
MEAN_HEADS: Final = ('parameter', 'mean ± SE', '95 % interval', 'STD over bags', 'bags')


def mean_row(one: Statistic) -> tuple[str, ...]:
    """Return a row of a table of means: name, mean, interval, deviation, count."""
    return (
        f'{one.name.replace("_", " ").capitalize()} {label_of(one)}',
        measured(one.mean, one.error),
        between(one.interval) if isfinite(one.mean) else '',
        '' if one.deviation is None else spread(one.deviation),
        f'{one.count}',
    )


def _beside(published: tuple[float, float] | None, unit: str) -> str:
    return '' if published is None else f'{published[0]:g} ± {published[1]:g} {unit}'


def _quality(estimate: FrictionEstimate, names: Sequence[str]) -> tuple[str, ...]:
    found = every_parameter(estimate)
    return (
        *(
            measured(found[name].value, found[name].error) if name in found else ''
            for name in names
        ),
        f'{estimate.samples}',
        f'{1e3 * estimate.residual:.2f}',
        f'{estimate.determination:.4f}',
        f'{estimate.condition:.1f}',
    )


def _compared(
    shown: FrictionEstimate, estimates: Sequence[FrictionEstimate], name: str
) -> list[str]:
    if not shown.comparison:
        return [paragraph('No other set of terms can be told from this one.')]
    supported = Counter(
        one.terms for estimate in estimates for one in estimate.comparison if one.supported
    )
    rows = [
        (
            _words(one.terms),
            f'{supported[one.terms]} of {len(estimates)}',
            f'{one.difference:+,.1f}' if isfinite(one.difference) else '',
            one.words,
        )
        for one in shown.comparison
    ]
    heads = ('terms', 'supported by', f'{shown.comparison[0].criterion} difference', 'in words')
    return [
        grid(rows, heads, f'Other sets of terms; difference and words are of {name}'),
        paragraph(f'Chosen: {_words(shown.terms)}. A negative difference speaks for the other.'),
    ]


def _labels(names: Sequence[str]) -> dict[str, str]:
    """Return short names of recordings: without the folder, unless two would be alike."""
    short = [Path(name).name or name for name in names]
    return dict(zip(names, short if len(set(short)) == len(names) else names, strict=True))


def _count(number: int, what: str) -> str:
    return f'{number} {what}' if number == 1 else f'{number} {what}s'


def _words(terms: Iterable[str]) -> str:
    return ', '.join(terms)


def _nearest_to_median(values: Sequence[float]) -> int:
    """Return which value is typical; the first if none is a number."""
    if not np.isfinite(values).any():
        return 0
    return int(np.nanargmin(np.abs(np.array(values) - np.nanmedian(values))))


def _warnings(estimates: Sequence[Any], label: Mapping[str, str]) -> str:
    """Return warnings; those that differ in numbers only are told by their first."""
    about: dict[str, list[tuple[str, str]]] = {}
    for estimate in estimates:
        for words in estimate.warnings:
            kind = _NUMBERS.sub('', words.partition(' (')[0])
            about.setdefault(kind, []).append((label[estimate.name], words))
    items = [
        f'{found[0][0]}: {found[0][1]}' + (f'; {len(found) - 1} more like it' if found[1:] else '')
        for found in about.values()
    ]
    every = [f'{name}: {words}' for found in about.values() for name, words in found]
    return notice('Before you use these numbers', items, every if len(every) > len(items) else ())


def _stiffness_cells(level: LevelSummary) -> list[str]:
    return [with_deviation(level[name]) for name in TABLE_2]


def with_deviation(one: Statistic) -> str:
    """Return mean ± standard error, and the standard deviation in brackets if there is one."""
    scatter = '' if one.deviation is None else f' ({spread(one.deviation)})'
    return f'{measured(one.mean, one.error)}{scatter}'


def _asked(summary: StiffnessSummary) -> LevelSummary:
    """Return the level whose stiffness is the result."""
    return next(
        level for level in summary.levels if level['tissue_stiffness'] is summary.tissue_stiffness
    )


def _at_level(estimate: StiffnessEstimate, force: float) -> dict[str, ParameterEstimate]:
    level = min(estimate.levels, key=lambda one: abs(one.force - force))
    return {level.tissue_stiffness.name: level.tissue_stiffness}


def _typical_place(summary: StiffnessSummary) -> StiffnessEstimate:
    force = _asked(summary).force
    found = [_at_level(one, force)['tissue_stiffness'].value for one in summary.estimates]
    return summary.estimates[_nearest_to_median(found)]


# Where it comes from and where it goes.


def _failures(failures: Sequence[tuple[str, str]]) -> str:
    items = [reason if name in reason else f'{name}: {reason}' for name, reason in failures]
    return notice(f'{_count(len(failures), "recording")} could not be used', items)


def _origin(origin: Origin) -> list[str]:
    losses = [f'{one.name}: {words}' for one in origin.sources for words in one.losses]
    losses += [
        f'{one.name}: the clock of the force was {1e3 * one.clock_offset:+.2f} ms off that of '
        'the motion; corrected'
        for one in origin.sources
        if one.clock_offset
    ]
    settings = [
        (
            item.name.replace('_', ' '),
            _setting(getattr(origin.settings, item.name), item.metadata.get('unit', '')),
            item.metadata.get('description', ''),
        )
        for item in fields(origin.settings)
    ]
    settings += [
        (name.replace('_', ' '), _setting(value, ''), '') for name, value in origin.reading.items()
    ]
    files = [
        (path, f'{one.samples}', digest) for one in origin.sources for path, digest in one.files
    ]
    return [
        heading('What was lost in reading'),
        bullets(losses) if losses else paragraph('Nothing.'),
        heading('Settings'),
        grid(settings, ('setting', 'value', 'meaning'), 'How it was read and identified'),
        heading('Files'),
        grid(files, ('file', 'samples in the recording', 'SHA-256'), 'What was read'),
    ]


def _setting(value: Any, unit: str) -> str:
    if value is None:
        return 'found by type'
    if isinstance(value, (list, tuple)):
        return ', '.join(map(str, value))
    return f'{value:g} {unit}'.removesuffix(' 1') if isinstance(value, float) else str(value)


def _usage(result: Path | None, values: Mapping[str, float | str]) -> list[str]:
    if not values:
        return []
    blocks = [heading('Use of the result')]
    if result is None:
        blocks.append(paragraph('With -o result.yaml the command writes a ROS parameter file.'))
    else:
        blocks += [
            paragraph(f'{result} is a ROS parameter file for the nodes plant and controller:'),
            code(
                f'ros2 run needle_insertion plant --ros-args --params-file {result}\n'
                f'ros2 run needle_insertion controller --ros-args --params-file {result}'
            ),
            paragraph('Without ROS on the machine the nodes are needle-plant, needle-controller.'),
        ]
    live = [name for name in values if name in _LIVE]
    if live:
        blocks += [
            paragraph('Into a plant that runs:'),
            code('\n'.join(f'ros2 param set /plant {name} {values[name]:.6g}' for name in live)),
        ]
    return blocks


_LIVE = ('model.coulomb_friction', 'model.viscous_friction')


# Pictures.


def _figure(width: float, height: float) -> Figure:
    return Figure(figsize=(width, height), layout='constrained')


def _plain(axes: Axes, xlabel: str, ylabel: str) -> None:
    axes.set(xlabel=_math(xlabel), ylabel=_math(ylabel))
    axes.grid(visible=True, alpha=0.25)
    axes.spines[['top', 'right']].set_visible(False)


def _legend(axes: Axes, **options: Any) -> None:
    """Explain above the plot, where no data are."""
    axes.legend(
        loc='lower left', bbox_to_anchor=(0.0, 1.0), ncols=4, frameon=False,
        borderaxespad=0.2, handletextpad=0.5, **options,
    )  # fmt: skip


def _math(words: str) -> str:
    """Write symbols as in print."""
    words = words.replace('^2', '²').replace('tau', r'$\tau$')
    return _MATH.sub(lambda m: f'${_GREEK.get(m[1], m[1])}_{{{m[2]}}}$', words)


def _thinned(*signals: FloatArray) -> list[FloatArray]:
    step = max(1, len(signals[0]) // _MOST_POINTS)
    return [signal[::step] for signal in signals]


def _friction_data(estimate: FrictionEstimate) -> Figure:
    fit = estimate.fit
    figure = _figure(9.0, 7.5)
    above, below = figure.subplots(2, 1)
    time, force = _thinned(fit.time - fit.time[0], fit.force)
    above.plot(time, force, color=_LIGHT, linewidth=3.0, label='measured, filtered')
    model = np.where(fit.used, fit.model, np.nan)
    above.plot(*_thinned(fit.time - fit.time[0], model), color=_FIT, linewidth=1.2, label='fit')
    _plain(above, 'time [s]', 'force on the needle [N]')
    _legend(above)
    for sign, words, color, mark in _SIDES:
        side = fit.used & (np.sign(fit.speed) == sign)
        speed, force = _thinned(1e3 * fit.speed[side], fit.force[side])
        below.plot(speed, force, mark, color=color, markersize=2.5, alpha=0.4, label=words)
        order = np.argsort(fit.speed[side])
        line = _thinned(1e3 * fit.speed[side][order], fit.model[side][order])
        below.plot(*line, color=_FIT, linewidth=1.2, label='fit' if sign < 0.0 else None)
    below.axhline(0.0, color=_FIT, linewidth=0.6)
    below.axvline(0.0, color=_FIT, linewidth=0.6)
    _plain(below, 'insertion speed [mm/s]', 'force on the needle [N]')
    _legend(below, markerscale=2.0)
    return figure


def _friction_residuals(estimate: FrictionEstimate) -> Figure:
    fit = estimate.fit
    figure = _figure(9.0, 6.5)
    over, against, often = figure.subplot_mosaic([['time', 'time'], ['speed', 'size']]).values()
    residual = 1e3 * (fit.force - fit.model)
    reach = float(np.abs(residual[fit.used]).max())
    edges = np.linspace(-reach, reach, 41).tolist()
    for sign, words, color, mark in _SIDES:
        side = fit.used & (np.sign(fit.speed) == sign)
        time, speed, left = _thinned(
            fit.time[side] - fit.time[0], 1e3 * fit.speed[side], residual[side]
        )
        style: dict[str, Any] = {'color': color, 'markersize': 2.0, 'alpha': 0.5}
        over.plot(time, left, mark, label=words, **style)
        against.plot(speed, left, mark, **style)
        often.hist(
            residual[side], edges, color=color, histtype='step',
            linewidth=1.4,
        )  # fmt: skip
    for axes in (over, against):
        axes.axhline(0.0, color=_FIT, linewidth=0.8)
    _plain(over, 'time [s]', 'residual [mN]')
    _plain(against, 'insertion speed [mm/s]', 'residual [mN]')
    _plain(often, 'residual [mN]', 'samples')
    _legend(over, markerscale=3.0)
    return figure


def _stiffness_levels(summary: StiffnessSummary) -> Figure:
    figure = _figure(9.0, 6.5)
    for axes, (name, (means, deviations)) in zip(
        figure.subplots(2, 2, sharex=True).flat, TABLE_2.items(), strict=True
    ):
        axes.errorbar(
            FORCE_LEVELS, means, deviations, fmt='D', color=_DATA, capsize=4.0, markersize=5.0,
            label='Table 2, mean and STD', zorder=1,
        )  # fmt: skip
        # Beside one another, not on top.
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
        _plain(axes, '', f'{name} [N/m]')
        axes.axhline(0.0, color=_FIT, linewidth=0.6)
    for axes in figure.axes[2:]:
        axes.set_xlabel('force [N]')
    figure.legend(
        *figure.axes[0].get_legend_handles_labels(), loc='outside upper left', ncols=2,
        frameon=False,
    )  # fmt: skip
    return figure


def _stiffness_presses(estimate: StiffnessEstimate) -> Figure:
    presses = estimate.presses
    figure = _figure(9.0, 4.8)
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
            right.plot(*ellipse, color=_DATA, linewidth=0.8, zorder=1)
    _principal_axes(right, estimate.levels[-1])
    _plain(left, 'displacement along the force [mm]', 'force [N]')
    left.set(xlim=(0.0, None), ylim=(0.0, None))
    left.legend(title='direction, from x toward z', ncols=2, frameon=False, loc='lower right')
    _plain(right, 'displacement x [mm]', 'displacement z [mm]')
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
            *np.transpose([-reach, reach]), style, color=_FIT, linewidth=1.2,
            label=f'{name}: {one.value:.0f} N/m',
        )  # fmt: skip
    _legend(axes)


def spread_figure(
    means: Sequence[Statistic], rows: Sequence[tuple[str, Mapping[str, ParameterEstimate]]]
) -> Figure:
    """
    Draw each parameter of each recording with its interval, and the mean with its own.

    Parameters
    ----------
    means : sequence of Statistic
        Parameters to draw, a plot each.
    rows : sequence of (str, Mapping[str, ParameterEstimate])
        Recordings, and what each gave by the name of the parameter.

    Returns
    -------
    Figure
        The picture.

    """
    columns = min(len(means), 4)
    lines = -(-len(means) // columns)
    figure = _figure(9.0, lines * (1.2 + 0.24 * len(rows)))
    panels = figure.subplots(lines, columns, sharey=True, squeeze=False)
    for axes, mean in zip(panels.flat, means, strict=False):
        for place, (_, found) in enumerate(rows):
            one = found.get(mean.name)
            if one is not None and one.determined:
                ends = one.interval[0], one.interval[1]
                axes.plot(ends, (place, place), color=_DATA, linewidth=1.6)
                axes.plot(one.value, place, 'o', color=_IN, markersize=5.0)
        if isfinite(mean.mean):
            axes.axvspan(*mean.interval, color=_IN, alpha=0.12, linewidth=0.0)
            axes.axvline(mean.mean, color=_IN, linewidth=1.2)
        _plain(axes, label_of(mean), '')
        axes.tick_params(left=False)
        axes.xaxis.get_major_formatter().set_useOffset(False)
        axes.locator_params(axis='x', nbins=3)
    for axes in panels.flat[len(means) :]:
        axes.set_visible(False)
    panels[0, 0].set_yticks(range(len(rows)), [name for name, _ in rows])
    panels[0, 0].set_ylim(len(rows) - 0.5, -0.5)
    return figure
