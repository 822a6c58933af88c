# SPDX-License-Identifier: Apache-2.0
"""Report pages of identified friction and stiffness: results, data and warnings."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from math import isfinite
from pathlib import Path
from typing import Any, Final

import needle_identification as identification
from needle_identification.estimation.estimate import between, measured, rounded, spread
from needle_identification.result import model_parameters
from needle_insertion.report import identify_figures as figures
from needle_insertion.report import identify_text as text
from needle_insertion.report.content import Picture, short_names
from needle_insertion.report.origin import Origin
from needle_insertion.report.page import write_page
from needle_insertion.report.paper_tables import FORCE_LEVELS, TABLE_1, TABLE_2
import numpy as np

#: Parameters that can be set on a running plant.
_LIVE: Final = ('model.coulomb_friction', 'model.viscous_friction')

_MOST_EACH: Final = 60  #: largest number of recordings with a small plot

_ENTRY_HEADS: Final = tuple(f'{entry} [N/m]' for entry in TABLE_2)
_QUALITY_HEADS: Final = ('residual [mN]', 'R²', 'condition')


def write_identified_page(folder: Path, summary: text.Summary, origin: Origin) -> Path:
    """Write ``friction.html`` or ``stiffness.html`` and its pictures; return the page."""
    estimates = summary.estimates
    label = short_names([estimate.name for estimate in estimates])
    short, full = text.warned(summary, origin)
    number = len(estimates)
    recordings = _counted(number, 'recording')
    if isinstance(summary, identification.FrictionSummary):
        name, content = 'friction.html', _friction_content(summary, label)
    else:
        name, content = 'stiffness.html', _stiffness_content(summary, label)
    drawn = content.pop('figures')
    write_page(
        folder / name,
        name,
        [Picture(key, '', figure) for key, figure in drawn.items()],
        origin=origin,
        warnings=(short, full if len(full) > len(short) else []),
        name=label[content['shown'].name],
        recordings=recordings,
        drawn=f'the first {_MOST_EACH} recordings of {number}'
        if number > _MOST_EACH
        else recordings,
        predictions=text.prediction_lines(summary),
        **content,
    )
    return folder / name


def _friction_content(
    summary: identification.FrictionSummary, label: Mapping[str, str]
) -> dict[str, Any]:
    estimates = summary.estimates
    means = text.friction_statistics(summary)
    main = [one for one in summary.statistics if one.name in TABLE_1]
    shown = estimates[_typical(one[summary.statistics[0].name].value for one in estimates)]
    values = model_parameters(summary.statistics)
    names = [label[one.name] for one in estimates]
    parameters = list(zip(names, map(text.friction_parameters, estimates), strict=True))
    return {
        'figures': {
            'friction_data': figures.friction_data(shown),
            'friction_residuals': figures.friction_residuals(shown),
            'friction_each': figures.friction_each(estimates[:_MOST_EACH], names[:_MOST_EACH]),
            'friction_spread': figures.spread_figure(means, parameters),
        },
        'cards': [_card(one) for one in main or summary.statistics[:2]],
        'mean_rows': [(*text.mean_row(one), _published(one)) for one in means],
        'mean_heads': (*text.MEAN_HEADS, 'Table 1, mean ± STD'),
        'shown': shown,
        'term_rows': _term_rows(shown, estimates),
        'rows': [
            (label[one.name], *text.parameter_cells(one, means), f'{one.samples}', *_quality(one))
            for one in estimates
        ],
        'heads': ('recording', *map(text.label_of, means), 'samples used', *_QUALITY_HEADS),
        'puncture_rows': text.puncture_rows(summary),
        'puncture_heads': text.PUNCTURE_HEADS,
        'values': values,
        'live': [
            f'ros2 param set /plant {name} {values[name]:.6g}' for name in _LIVE if name in values
        ],
    }


def _published(one: identification.Statistic) -> str:
    if one.name not in TABLE_1:
        return ''
    mean, deviation = TABLE_1[one.name]
    return f'{mean:g} ± {deviation:g} {one.unit}'


def _term_rows(
    shown: identification.FrictionEstimate, estimates: Sequence[identification.FrictionEstimate]
) -> list[tuple[str, ...]]:
    """Return the alternative sets of terms with the number of supporting recordings."""
    supported = Counter(
        one.terms for estimate in estimates for one in estimate.comparison if one.supported
    )
    return [
        (
            ', '.join(one.terms),
            f'{supported[one.terms]} of {len(estimates)}',
            f'{one.difference:+,.1f}' if isfinite(one.difference) else '',
            one.words,
        )
        for one in shown.comparison
    ]


def _stiffness_content(
    summary: identification.StiffnessSummary, label: Mapping[str, str]
) -> dict[str, Any]:
    estimates, levels, result = summary.estimates, summary.levels, summary.tissue_stiffness
    force = next(level.force for level in levels if level[result.name] is result)
    # At the level nearest to the force of the result.
    found = [
        min(one.levels, key=lambda level: abs(level.force - force)).tissue_stiffness
        for one in estimates
    ]
    shown = estimates[_typical(one.value for one in found)]
    springs = [level.is_spring for estimate in estimates for level in estimate.levels]
    names = [label[one.name] for one in estimates]
    rows = [(name, {result.name: k}) for name, k in zip(names, found, strict=True)]
    return {
        'figures': {
            'stiffness_levels': figures.stiffness_levels(summary),
            'stiffness_presses': figures.stiffness_presses(shown),
            'stiffness_each': figures.stiffness_each(estimates[:_MOST_EACH], names[:_MOST_EACH]),
            'stiffness_spread': figures.spread_figure([result], rows),
        },
        'cards': [
            _card(result),
            (
                'Symmetric stiffness matrices',
                f'{sum(springs)} of {len(springs)}',
                'tested by the curl of the force; a spring has a symmetric matrix',
            ),
        ],
        'force': force,
        'places': _counted(len(estimates), 'place'),
        'heads': ('force', *_ENTRY_HEADS),
        'mean_rows': [
            (f'{level.force:.2f} N', *(text.with_deviation(level[name]) for name in TABLE_2))
            for level in levels
        ],
        'published_rows': [
            (f'{level:g} N', *(f'{means[k]:g} ({stds[k]:g})' for means, stds in TABLE_2.values()))
            for k, level in enumerate(FORCE_LEVELS)
        ],
        'result_heads': ('force', *text.MEAN_HEADS[1:]),
        'result_rows': [
            (f'{level.force:.2f} N', *text.mean_row(level[result.name])[1:]) for level in levels
        ],
        'shown': shown,
        'spring_rows': [_spring_row(level) for level in shown.levels],
        'place_heads': (
            *('recording', 'force [N]', *_ENTRY_HEADS, 'presses, directions', *_QUALITY_HEADS),
        ),
        'place_rows': [
            (
                *(label[one.name], f'{level.force:.2f}', *map(_cell, level.parameters)),
                *(f'{level.presses} in {level.directions}', *_quality(level)),
            )
            for one in estimates
            for level in one.levels
        ],
        'values': model_parameters([result]),
        # The stiffness of a running plant cannot be set.
        'live': [],
    }


def _spring_row(level: identification.LevelEstimate) -> tuple[str, ...]:
    return (
        f'{level.force:.2f} N',
        *map(_cell, (level.curl, level.spring, *level.principal)),
        measured(np.degrees(level.angle.value), np.degrees(level.angle.error)),
    )


# Functions of both pages.


def _cell(one: identification.ParameterEstimate) -> str:
    return measured(one.value, one.error)


def _quality(
    one: identification.FrictionEstimate | identification.LevelEstimate,
) -> tuple[str, ...]:
    return f'{1e3 * one.residual:.2f}', f'{one.determination:.4f}', f'{one.condition:.1f}'


def _card(one: identification.Statistic) -> tuple[str, str, str]:
    """Return a main result: name, value, and interval with scatter."""
    what = f'{one.name.replace("_", " ").capitalize()} {one.symbol}'
    if not isfinite(one.mean):
        return what, 'not determined', 'by these recordings'
    note = f'95 % interval {between(one.interval)}'
    if one.deviation is not None:
        note += f'; STD {spread(one.deviation)} over {_counted(one.count, "recording")}'
    return what, rounded(one.mean, one.error, one.unit), note


def _counted(number: int, what: str) -> str:
    return f'{number} {what}' if number == 1 else f'{number} {what}s'


def _typical(values: Iterable[float]) -> int:
    """Return the index of the value nearest to the median; 0 if all are nan."""
    found = np.array(list(values))
    if not np.isfinite(found).any():
        return 0
    return int(np.nanargmin(np.abs(found - np.nanmedian(found))))
