"""Identified stiffness as tables, for the terminal and for the page."""

from __future__ import annotations

from needle_identification import (
    LevelSummary,
    ParameterEstimate,
    StiffnessEstimate,
    StiffnessSummary,
)
from needle_identification.estimation.formatting import between, measured
from needle_insertion.report.text import table
from needle_insertion.report.wording import label_of, with_deviation


def stiffness_text(summary: StiffnessSummary) -> str:
    """
    Return the result for the terminal, as Table 2.

    Parameters
    ----------
    summary : StiffnessSummary
        All recordings.

    Returns
    -------
    str
        A row for each entry and a column for each force, the intervals, and k_a.

    """
    names = [one.name for one in summary.levels[0].statistics]
    rows = [
        (
            label_of(summary.levels[0][name]),
            *(with_deviation(level[name]) for level in summary.levels),
        )
        for name in names
    ]
    heads = ['mean ± SE (STD)', *(f'{level.force:.2f} N' for level in summary.levels)]
    by_force = [
        (
            f'{level.force:.2f} N',
            *(between(level[name].interval) for name in names),
            f'{level[names[0]].count}',
        )
        for level in summary.levels
    ]
    symbols = [summary.levels[0][name].symbol for name in names]
    matrices = table(rows, heads)
    intervals = table(by_force, ('95 % interval', *symbols, 'bags'))
    result = summary.tissue_stiffness
    return (
        f'{matrices}\n\n{intervals}\n\n'
        f'{result.symbol} = {measured(result.mean, result.error, result.unit)}, '
        f'95 % interval {between(result.interval)}'
    )


def result_level(summary: StiffnessSummary) -> LevelSummary:
    """
    Return the force level whose stiffness is the result.

    Parameters
    ----------
    summary : StiffnessSummary
        All recordings.

    Returns
    -------
    LevelSummary
        The level that gives k_a.

    """
    return next(
        level for level in summary.levels if level['tissue_stiffness'] is summary.tissue_stiffness
    )


def tissue_stiffness_at(estimate: StiffnessEstimate, force: float) -> ParameterEstimate:
    """
    Return k_a of one recording at the level nearest to a force.

    Parameters
    ----------
    estimate : StiffnessEstimate
        What the recording gave.
    force : float
        Force [N].

    Returns
    -------
    ParameterEstimate
        k_a [N/m^2].

    """
    level = min(estimate.levels, key=lambda one: abs(one.force - force))
    return level.tissue_stiffness
