# SPDX-License-Identifier: Apache-2.0
"""Format identified parameters as text, tables for the terminal, and JSON."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from math import isfinite
import re
from typing import Any, Final, TypeAlias

from needle_identification import (
    Fit,
    FrictionEstimate,
    FrictionSummary,
    ParameterEstimate,
    Statistic,
    StiffnessSummary,
)
from needle_identification.estimation.estimate import between, measured, spread, statistic
from needle_identification.estimation.prediction import Moments
from needle_identification.stiffness.presses import Presses
from needle_insertion.report.content import short_names, table
from needle_insertion.report.origin import Origin
import numpy as np

_NUMBERS: Final = re.compile(r'[-+]?\d[\d.e+-]*')

#: Heads of the rows of `mean_row`.
MEAN_HEADS: Final = ('parameter', 'mean ± SE', '95 % interval', 'STD over bags', 'bags')

#: Heads of the rows of `puncture_rows`.
PUNCTURE_HEADS: Final = ('bag', 'puncture at [s]', 'depth [mm] ± SE', 'drop [N] ± SE')

Summary: TypeAlias = FrictionSummary | StiffnessSummary  #: Result of recordings of one kind.


def label_of(one: ParameterEstimate | Statistic) -> str:
    """Return symbol and unit, such as ``mu_s [N]``."""
    return one.symbol if one.unit == '1' else f'{one.symbol} [{one.unit}]'


def title_of(one: ParameterEstimate | Statistic) -> str:
    """Return name, symbol and unit, such as ``Coulomb friction mu_s [N]``."""
    return f'{one.name.replace("_", " ").capitalize()} {label_of(one)}'


def interval_of(one: ParameterEstimate) -> str:
    """Return the interval of a parameter; '' if the data do not determine it."""
    return between(one.interval) if one.determined else ''


def mean_row(one: Statistic) -> tuple[str, ...]:
    """Return a row of a table of means, with the heads `MEAN_HEADS`."""
    return (
        title_of(one),
        measured(one.mean, one.error),
        between(one.interval) if isfinite(one.mean) else '',
        '' if one.deviation is None else spread(one.deviation),
        f'{one.count}',
    )


def with_deviation(one: Statistic) -> str:
    """Return mean ± standard error, and the standard deviation in brackets if available."""
    scatter = '' if one.deviation is None else f' ({spread(one.deviation)})'
    return f'{measured(one.mean, one.error)}{scatter}'


def friction_parameters(estimate: FrictionEstimate) -> dict[str, ParameterEstimate]:
    """Return all parameters of a recording by name, with breakaway force and lag [ms]."""
    first, *others = estimate.parameters
    found = [first, estimate.breakaway, *others, estimate.lag]
    return {one.name: _in_milliseconds(one) for one in found if one is not None}


def _in_milliseconds(one: ParameterEstimate) -> ParameterEstimate:
    if one.unit != 's':
        return one
    low, high = (1e3 * end for end in one.interval)
    return replace(
        one, unit='ms', value=1e3 * one.value, error=1e3 * one.error, interval=(low, high)
    )


def friction_statistics(summary: FrictionSummary) -> list[Statistic]:
    """Return statistics of `friction_parameters` over the recordings with each parameter."""
    rows = [friction_parameters(estimate) for estimate in summary.estimates]
    names = dict.fromkeys(name for row in rows for name in row)
    return [statistic([row[name] for row in rows if name in row]) for name in names]


def parameter_cells(estimate: FrictionEstimate, means: Sequence[Statistic]) -> list[str]:
    """Return table cells of a recording's parameters; '' for missing parameters."""
    given = friction_parameters(estimate)
    found = [given.get(one.name) for one in means]
    return ['' if one is None else measured(one.value, one.error) for one in found]


def identified_text(summary: Summary) -> str:
    if not isinstance(summary, FrictionSummary):
        return _stiffness_text(summary)
    means = friction_statistics(summary)
    rows = [
        (one.name, *parameter_cells(one, means), f'{one.samples}', f'{one.residual:.4f}')
        for one in summary.estimates
    ]
    heads = ('bag', *(f'{label_of(one)} ± SE' for one in means), 'samples', 'residual [N]')
    tables = [table([mean_row(one) for one in means], MEAN_HEADS), table(rows, heads)]
    if found := puncture_rows(summary):
        tables.append(table(found, PUNCTURE_HEADS))
    tables += prediction_lines(summary)
    return '\n\n'.join(tables)


def prediction_lines(summary: Summary) -> list[str]:
    """Return a sentence with the error of predicted recordings, for each level of force."""
    if isinstance(summary, FrictionSummary):
        found = [('', summary.prediction)]
    else:
        found = [(f'{level.force:.2f} N: ', level.prediction) for level in summary.levels]
    return [
        f'{where}force of a recording predicted from the others: error {one.rms:.3g} N rms, '
        f'95 % interval {between(one.interval)}; residual {one.residual:.3g} N'
        for where, one in found
        if one is not None
    ]


def puncture_rows(summary: FrictionSummary) -> list[tuple[str, ...]]:
    """Return the punctures of all recordings as rows with the heads `PUNCTURE_HEADS`."""
    return [
        (
            estimate.name,
            f'{one.time:.3f}',
            measured(1e3 * one.depth.value, 1e3 * one.depth.error),
            measured(one.drop.value, one.drop.error),
        )
        for estimate in summary.estimates
        for one in estimate.punctures
    ]


def _stiffness_text(summary: StiffnessSummary) -> str:
    levels, result = summary.levels, summary.tissue_stiffness
    entries = levels[0].statistics
    forces = [f'{level.force:.2f} N' for level in levels]
    rows = [
        (label_of(one), *(with_deviation(level[one.name]) for level in levels)) for one in entries
    ]
    spans = [[between(one.interval) for one in level.statistics] for level in levels]
    counts = [f'{level.statistics[0].count}' for level in levels]
    by_force = [(force, *ends, n) for force, ends, n in zip(forces, spans, counts, strict=True)]
    matrices = table(rows, ('mean ± SE (STD)', *forces))
    intervals = table(by_force, ('95 % interval', *(one.symbol for one in entries), 'bags'))
    predictions = '\n'.join(prediction_lines(summary))
    stiffness = (
        f'{result.symbol} = {measured(result.mean, result.error, result.unit)}, '
        f'95 % interval {between(result.interval)}'
    )
    return '\n\n'.join(
        filter(None, [matrices, intervals, predictions, _spring_lines(summary), stiffness])
    )


def _spring_lines(summary: StiffnessSummary) -> str:
    """Return whether the places are springs, one sentence of each group."""
    places = short_names([one.name for one in summary.estimates])
    at = [
        (f'{places[one.name]}, {level.force:.2f} N', level.words)
        for one in summary.estimates
        for level in one.levels
    ]
    return '\n'.join(_grouped(at, {})[0])


def warned(summary: Summary, origin: Origin) -> tuple[list[str], list[str]]:
    """Return one warning of each group that differs in numbers only, and all warnings."""
    names = short_names([one.name for one in summary.estimates])
    found = [('', words) for words in summary.warnings]
    found += origin.lost
    found += [(one.name, words) for one in summary.estimates for words in one.warnings]
    return _grouped(found, names)


def _grouped(
    found: Iterable[tuple[str, str]], names: Mapping[str, str]
) -> tuple[list[str], list[str]]:
    """Return one sentence of each group that differs in numbers only, and all sentences."""
    groups: dict[str, list[str]] = {}
    for name, words in found:
        kind = _NUMBERS.sub('', words.partition(' (')[0])
        line = f'{names.get(name, name)}: {words}' if name else words
        groups.setdefault(kind, []).append(line)
    short = [
        same[0] + (f'; {len(same) - 1} more like it' if same[1:] else '')
        for same in groups.values()
    ]
    return short, [line for same in groups.values() for line in same]


def identified_document(summary: object, origin: Origin) -> dict[str, Any]:
    return {
        **plain(summary),
        'settings': plain(origin.settings),
        'reading': plain(origin.reading),
        'recordings': plain(origin.sources),
        'failures': [{'name': name, 'reason': reason} for name, reason in origin.failures],
    }


def plain(value: Any) -> Any:
    """Convert values to JSON: None for numbers that are not finite, without arrays of samples."""
    if is_dataclass(value):
        named = {item.name: getattr(value, item.name) for item in fields(value)}
        # Arrays as long as the recording are only for figures.
        return {
            name: plain(one)
            for name, one in named.items()
            if not isinstance(one, (Fit, Moments, Presses))
        }
    if isinstance(value, dict):
        return {str(key): plain(one) for key, one in value.items()}
    if isinstance(value, (list, tuple)):
        # Parameters and statistics become mappings by name.
        if value and all(isinstance(one, (ParameterEstimate, Statistic)) for one in value):
            return {one.name: plain(one) for one in value}
        return [plain(one) for one in value]
    if isinstance(value, np.generic):
        return plain(value.item())
    return None if isinstance(value, float) and not isfinite(value) else value
