"""The page of a study."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from matplotlib.figure import Figure as Drawing
from needle_dynamics import FloatArray
from needle_insertion.report.content import Grid, Picture, Section
from needle_insertion.report.page import write_page
from needle_insertion.study.engine import Results
from needle_insertion.study.protocol import Figure
from needle_insertion.study.summary import column, Estimate, probability, quantile, share, worst
import numpy as np

#: Quantiles of each figure.
_PARTS: Final = (0.5, 0.95, 0.99)

#: Cells of a map along each axis, and samples that one needs at least.
_CELLS, _FEWEST = 24, 5

#: Worst samples that are listed.
_WORST: Final = 10


def write(results: Results, path: Path) -> None:
    """
    Write the page.

    Parameters
    ----------
    results : Results
        A study whose table is complete.
    path : Path
        Page to write.

    """
    study, table = results.study, results.table
    figures, drawn = study.protocol.figures, list(study.population)
    main = next(iter(figures))
    values = column(table, main)
    chances = {
        name: probability(column(table, name)) for name, one in figures.items() if not one.unit
    }
    shares = {
        name: {other: share(column(table, name), column(table, other)) for other in drawn}
        for name, one in figures.items()
        if one.unit
    }
    order = sorted(drawn, key=lambda name: -shares[main][name])
    bad = worst(values, _WORST)
    sections = [
        Section(
            title='How often',
            paragraphs=('Intervals are of 95 %, of Wilson.',),
            tables=(
                Grid(
                    caption='Probabilities',
                    heads=('figure', 'probability', '95 % interval', 'what it is'),
                    rows=tuple(
                        (name, f'{one.value:.2%}', f'{one.low:.2%} to {one.high:.2%}',
                         figures[name].meaning)
                        for name, one in chances.items()
                        if np.isfinite(one.value)
                    ),
                ),
            ),
            pictures=(),
        ),
        Section(
            title='How far',
            paragraphs=('With intervals of 95 %, whatever the distribution.',),
            tables=(
                Grid(
                    caption='Quantiles',
                    heads=('figure', *(f'{part:.0%}' for part in _PARTS), 'what it is'),
                    rows=tuple(
                        (f'{name} [{one.unit}]',
                         *(_words(quantile(column(table, name), part)) for part in _PARTS),
                         one.meaning)
                        for name, one in figures.items()
                        if one.unit and np.isfinite(column(table, name)).any()
                    ),
                ),
            ),
            pictures=(_distribution(main, figures[main], values),),
        ),
    ]  # fmt: skip
    if drawn:
        sections.append(
            Section(
                title='What matters',
                paragraphs=(
                    f'Part of the variance of {main} that each quantity explains alone.',
                    'What is missing to 100 % is noise, and quantities that act together.',
                ),
                tables=(
                    Grid(
                        caption='Shares of the variance',
                        heads=('quantity', main, 'what it is'),
                        rows=tuple(
                            (name, f'{shares[main][name]:.1%}',
                             study.protocol.quantities[name].meaning)
                            for name in order
                        ),
                    ),
                ),
                pictures=tuple(
                    _map(main, figures[main], values, order[:2], results) for _ in order[1:2]
                ),
            )
        )  # fmt: skip
    sections.append(
        Section(
            title='The worst',
            paragraphs=('`needle study STUDY --replay NUMBER` computes one again, into a bag.',),
            tables=(
                Grid(
                    caption=f'Samples with the largest {main}',
                    heads=('sample', f'{main} [{figures[main].unit}]', *order[:4]),
                    rows=tuple(
                        (str(number), f'{values[number]:.4g}',
                         *(f'{column(table, name)[number]:.4g}' for name in order[:4]))
                        for number in bad
                    ),
                ),
            ),
            pictures=(),
        )
    )  # fmt: skip
    pictures = [one for section in sections for one in section.pictures]
    hit = chances.get('hit')
    cards = [('Samples', f'{study.samples}', f'seed {study.seed}, {study.design}')]
    if hit is not None:
        cards.append(('Hit', f'{hit.value:.1%}', f'95 %: {hit.low:.1%} to {hit.high:.1%}'))
    cards.append((f'Median {main}', _words(quantile(values, 0.5)), figures[main].unit))
    write_page(
        path,
        'study.html',
        pictures,
        title='Study',
        introduction='Simulated insertions of a population of needles that nobody knows exactly.',
        cards=cards,
        sections=sections,
        study=study.text,
    )


def _words(one: Estimate) -> str:
    return f'{one.value:.4g} ({one.low:.4g} to {one.high:.4g})'


def _distribution(name: str, figure: Figure, values: FloatArray) -> Picture:
    drawing = Drawing(figsize=(8.0, 3.2), layout='constrained')
    axes = drawing.subplots()
    seen = np.sort(values[np.isfinite(values)])
    if len(seen):
        # What is beyond the last thousandth would leave nothing to see of the rest.
        end = float(np.quantile(seen, 0.999))
        axes.hist(seen[seen <= end], bins=80, color='tab:blue')
        for part in _PARTS:
            axes.axvline(float(np.quantile(seen, part)), color='k', lw=0.8, ls='--')
    axes.set(xlabel=f'{name} [{figure.unit}]', ylabel='samples')
    return Picture('distribution', f'Distribution of {name}; dashed: {_dashed()}.', drawing)


def _dashed() -> str:
    return ', '.join(f'{part:.0%}' for part in _PARTS)


def _map(
    name: str, figure: Figure, values: FloatArray, axes_of: list[str], results: Results
) -> Picture:
    """Draw the median of a figure over the two quantities that matter most."""
    first, second = axes_of
    x, y = (column(results.table, one) for one in axes_of)
    seen = np.isfinite(values)
    x, y, z = x[seen], y[seen], values[seen]
    drawing = Drawing(figsize=(8.0, 4.5), layout='constrained')
    axes = drawing.subplots()
    edges = [
        np.linspace(float(np.quantile(one, 0.005)), float(np.quantile(one, 0.995)), _CELLS + 1)
        for one in (x, y)
    ]
    shown = np.full((_CELLS, _CELLS), np.nan)
    places = [np.digitize(one, edge) - 1 for one, edge in zip((x, y), edges, strict=True)]
    cell = places[0] * _CELLS + places[1]
    inside = (places[0] >= 0) & (places[0] < _CELLS) & (places[1] >= 0) & (places[1] < _CELLS)
    order = np.argsort(cell[inside], kind='stable')
    cells, begins = np.unique(cell[inside][order], return_index=True)
    for at, group in zip(cells, np.split(z[inside][order], begins[1:]), strict=True):
        if len(group) >= _FEWEST:
            shown[at // _CELLS, at % _CELLS] = np.median(group)
    mesh = axes.pcolormesh(*edges, shown.T, cmap='viridis')
    drawing.colorbar(mesh, label=f'median {name} [{figure.unit}]')
    quantities = results.study.protocol.quantities
    axes.set(
        xlabel=f'{first} [{quantities[first].unit}]',
        ylabel=f'{second} [{quantities[second].unit}]',
    )
    return Picture(
        'map', f'Median {name} over the two quantities that matter most. White: too few.', drawing
    )
