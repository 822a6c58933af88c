# SPDX-License-Identifier: Apache-2.0
"""Write the page of a study."""

from collections.abc import Mapping
from math import ceil, floor, isfinite, log10, nan, sqrt
from pathlib import Path
from typing import Final

from matplotlib.figure import Figure as Drawing
from needle_dynamics import FloatArray
from needle_insertion.report.content import Picture
from needle_insertion.report.page import write_page
from needle_study import summary
from needle_study.engine import Results
from needle_study.scenario import Metric
from needle_study.study import FAILURES, Study
import numpy as np
from scipy.stats import binned_statistic_2d
import yaml

_PARTS: Final = (0.5, 0.95, 0.99)  #: quantiles of each metric

#: Most bars of a histogram, and the number of samples from which its tail is cut off.
_BARS, _TAILED = 80, 1000

#: Most cells of a map along each axis; mean and least number of samples of a cell.
_CELLS, _MEAN, _FEWEST = 24, 25, 5

#: Display unit and factor of SI units.
_SHOWN: Final[Mapping[str, tuple[str, float]]] = {
    'm': ('mm', 1e3), 'rad': ('mrad', 1e3), '1': ('', 1.0), '%': ('%', 100.0),
}  # fmt: skip

#: Most samples in quantiles, shares and pictures: bounds the memory of the page.
_MOST: Final = 2**17

_WORST: Final = 10  #: number of worst samples in the list

_FEW: Final = 'too few samples'  #: in place of an interval


def write_study(results: Results, path: Path) -> list[tuple[str, str, str]]:
    """
    Write the page of a study whose table is complete; return its main results as rows.

    These are the cards of the page, and the largest Sobol index of each variable.
    """
    study, table = results.study, results.table
    metrics, drawn = study.scenario.metrics, list(study.population)
    main = next(iter(metrics))
    values = summary.column(table, main, _MOST)
    probabilities, quantiles = dict[str, summary.Estimate](), list[tuple[str, ...]]()
    for name, one in metrics.items():
        if not one.unit:
            probabilities[name] = summary.probability(summary.batches(table, name), study.design)
            continue
        found = values if name == main else summary.column(table, name, _MOST)
        parts = [summary.quantile(found, part, study.design) for part in _PARTS]
        if known := parts[0].samples:
            words = (f'{value} ({ends})' for value, ends in (_rounded(p, one.unit) for p in parts))
            quantiles.append((_head(name, one.unit), *words, str(known), one.meaning))
    columns = {name: summary.column(table, name, _MOST) for name in drawn}
    shares = summary.indices(values, columns, study)
    # By the part of the variance that varies with a variable, in any way.
    order = sorted(shares, key=lambda name: -_influence(shares[name]).value) or drawn
    named = [name for name in order if name in columns]
    meanings = {name: study.scenario.variables[name].meaning for name in drawn}
    meanings[summary.NOISE] = 'noise of path, sensors and losses'
    meanings = {name: meanings.get(name, 'row of this table') for name in order}
    # The two most influential variables are drawn.
    most = {name: columns[name] for name in named[:2]}
    bad, listed = summary.worst(summary.batches(table, main), _WORST), [main, *named[:4]]
    of_bad = {name: summary.picked(table, name, bad) for name in listed}
    units = {name: study.scenario.variables[name].unit for name in drawn}
    units[main] = metrics[main].unit
    cards = [('Samples', f'{study.samples}', f'seed {study.design.seed}, {study.design.name}')]
    chances = dict.fromkeys(one for one in (main, 'hit') if one in probabilities)
    headline = [(one.capitalize(), probabilities[one], '%') for one in chances]
    pictures = []
    # Of yes or no, neither median nor distribution tell more than the probability.
    if units[main]:
        median = summary.quantile(values, 0.5, study.design)
        headline.append((f'Median {main}', median, units[main]))
        pictures.append(_distribution(main, metrics[main], values))
    counts = {
        name: int(np.nansum(summary.column(table, name, _MOST)))
        for name in FAILURES
        if name in metrics
    }
    failed = ', '.join(f'{count} {name}' for name, count in counts.items() if count)
    # Probabilities are of all samples.
    cards += [_card(*one, len(values) if one[2] != '%' else 0, failed) for one in headline]
    if drawn:
        pictures += _map(main, metrics[main], values, most, study)
    write_page(
        path,
        'study.html',
        pictures,
        cards=cards,
        main=main,
        limit=_MOST if study.samples > _MOST else 0,
        probabilities=[
            (name, *_rounded(one, '%'), str(one.samples), metrics[name].meaning)
            for name, one in probabilities.items()
            if np.isfinite(one.value)
        ],
        quantile_heads=('metric', *(f'{part:.0%}' for part in _PARTS), 'samples', 'meaning'),
        quantiles=quantiles,
        totals=summary.NOISE in shares,
        shares=[(name, *_shares(shares[name]), meanings[name]) for name in order if shares],
        worst_heads=('sample', *(_head(name, units[name]) for name in listed)),
        worst=[
            (
                str(number),
                *(f'{_shown(units[name])[1] * of_bad[name][place]:.4g}' for name in listed),
            )
            for place, number in enumerate(bad)
        ],
        variables=[
            (name, f'{one.default:g}', one.unit, one.meaning)
            for name, one in study.scenario.variables.items()
        ],
        study=yaml.safe_dump(dict(study.document), default_flow_style=None, sort_keys=False),
    )
    for name in order if shares else ():
        kind = ' alone' if shares[name].total is None else ', with interactions'
        cards.append(_card(f'Variance by {name}{kind}', _influence(shares[name]), '%'))
    return cards


def _card(
    name: str, one: summary.Estimate, unit: str, total: int = 0, failed: str = ''
) -> tuple[str, str, str]:
    """Return a main result, with the number of its samples and the failed ones if fewer."""
    if not one.samples:
        return name, 'no sample has a value', failed
    value, ends = _rounded(one, unit)
    sign = '' if unit == '%' else _shown(unit)[0]
    note = _note(ends, sign)
    if one.samples < total:
        note += f'; of {one.samples} of {total} samples' + (failed and f': {failed}')
    return name, f'{value} {sign}'.rstrip(), note


def _shown(unit: str) -> tuple[str, float]:
    return _SHOWN.get(unit, (unit, 1.0))


def _head(name: str, unit: str) -> str:
    shown, _ = _shown(unit)
    return f'{name} [{shown}]' if shown else name


def _rounded(one: summary.Estimate, unit: str) -> tuple[str, str]:
    """Format a value and its interval, with digits according to the width of the interval."""
    value, low, high = (_shown(unit)[1] * number for number in one[:3])
    wide = sum(end for end in (value - low, high - value) if isfinite(end))
    form = f'.{min(9, max(1, 1 - floor(log10(wide))))}f' if wide > 0.0 else '.4g'
    sign = unit if unit == '%' else ''
    ends = [f'{end:{form}}{sign}' for end in (low, high) if isfinite(end)]
    bound = '' if len(ends) == 2 else '≥ ' if isfinite(low) else '≤ '
    return f'{value:{form}}{sign}', bound + ' to '.join(ends) if ends else _FEW


def _note(ends: str, unit: str = '') -> str:
    return ends if ends == _FEW else f'95 %: {ends} {unit}'.rstrip()


def _influence(one: summary.Indices) -> summary.Estimate:
    return one.total or one.first


def _shares(one: summary.Indices) -> list[str]:
    both = [_rounded(found, '%') for found in (one.first, one.total) if found is not None]
    return [f'{value} ({ends})' for value, ends in both]


def _distribution(name: str, figure: Metric, values: FloatArray) -> Picture:
    drawing = Drawing(figsize=(8.0, 3.2), layout='constrained')
    axes = drawing.subplots()
    finite = np.sort(_shown(figure.unit)[1] * values[np.isfinite(values)])
    words = f'Distribution of {name}; dashed: {", ".join(f"{part:.0%}" for part in _PARTS)}.'
    if len(finite):
        end = float(finite[-1])
        if len(finite) >= _TAILED:
            # Outliers would compress the rest of the histogram.
            end = float(np.quantile(finite, 0.999))
            words += ' The largest thousandth is not shown.'
        bars = min(_BARS, ceil(2.0 * len(finite) ** (1.0 / 3.0)))
        axes.hist(finite[finite <= end], bins=bars, color='tab:blue')
        for part in _PARTS:
            axes.axvline(float(np.quantile(finite, part)), color='k', lw=0.8, ls='--')
    axes.set(xlabel=_head(name, figure.unit), ylabel='samples')
    return Picture('distribution', words, drawing)


def _map(
    name: str, figure: Metric, values: FloatArray, over: dict[str, FloatArray], study: Study
) -> list[Picture]:
    """Draw the median, or for yes or no the fraction, over two variables, if both vary."""
    if len(over) < 2:
        return []
    inside = np.isfinite(values)
    count = max(1, min(_CELLS, floor(sqrt(inside.sum() / _MEAN))))
    ends = [np.quantile(of, [0.005, 0.995]).tolist() for of in over.values()]
    if any(low == high for low, high in ends) or not inside.any():
        return []
    points, of_points = np.array(list(over.values()))[:, inside], values[inside]
    kind, middle = ('median', 'median') if figure.unit else ('fraction of', 'mean')
    (medians, *edges, _), (numbers, *_) = (
        binned_statistic_2d(*points, of_points, statistic, count, ends)
        for statistic in (middle, 'count')
    )
    shown = _shown(figure.unit)[1] * np.where(numbers >= _FEWEST, medians, nan)
    units = [study.scenario.variables[one].unit for one in over]
    heads = [_head(one, unit) for one, unit in zip(over, units, strict=True)]
    drawing = Drawing(figsize=(8.0, 4.5), layout='constrained')
    axes = drawing.subplots()
    x, y = (_shown(unit)[1] * at for unit, at in zip(units, edges, strict=True))
    mesh = axes.pcolormesh(x, y, shown.T, cmap='viridis')
    drawing.colorbar(mesh, label=_head(f'{kind} {name}', figure.unit))
    axes.set(xlabel=heads[0], ylabel=heads[1])
    words = f'{kind.capitalize()} {name} over the two most influential variables. '
    words += 'White: too few samples.'
    return [Picture('map', words, drawing)]
