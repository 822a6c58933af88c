"""Identified friction as tables, for the terminal and for the page."""

from __future__ import annotations

from dataclasses import replace

from needle_identification import (
    FrictionEstimate,
    FrictionSummary,
    ParameterEstimate,
    Statistic,
    statistic,
)
from needle_insertion.report.text import table
from needle_insertion.report.wording import estimate_cell, label_of, MEAN_HEADS, mean_row


def friction_parameters(estimate: FrictionEstimate) -> dict[str, ParameterEstimate]:
    """
    Return all parameters of a recording, also the break-away force and the lag.

    Parameters
    ----------
    estimate : FrictionEstimate
        What the recording gave.

    Returns
    -------
    dict
        Parameters by name, times in milliseconds.

    """
    first, *others = estimate.parameters
    found = [first, estimate.breakaway, *others, estimate.lag]
    return {one.name: _in_milliseconds(one) for one in found if one is not None}


def _in_milliseconds(one: ParameterEstimate) -> ParameterEstimate:
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
    """
    Return statistics of `friction_parameters`, each over the recordings that have it.

    Parameters
    ----------
    summary : FrictionSummary
        All recordings.

    Returns
    -------
    list of Statistic
        One for each parameter.

    """
    rows = [friction_parameters(estimate) for estimate in summary.estimates]
    names = dict.fromkeys(name for row in rows for name in row)
    return [statistic([row[name] for row in rows if name in row]) for name in names]


def friction_text(summary: FrictionSummary) -> str:
    """
    Return the result for the terminal.

    Parameters
    ----------
    summary : FrictionSummary
        All recordings.

    Returns
    -------
    str
        A table of the means, and one of the recordings.

    """
    means = friction_statistics(summary)
    rows = [
        (
            estimate.name,
            *parameter_cells(estimate, means),
            f'{estimate.samples}',
            f'{estimate.residual:.4f}',
        )
        for estimate in summary.estimates
    ]
    heads = ('bag', *(f'{label_of(one)} ± SE' for one in means), 'samples', 'residual [N]')
    return f'{table([mean_row(one) for one in means], MEAN_HEADS)}\n\n{table(rows, heads)}'


def parameter_cells(estimate: FrictionEstimate, means: list[Statistic]) -> list[str]:
    """
    Return the parameters of one recording.

    Parameters
    ----------
    estimate : FrictionEstimate
        What the recording gave.
    means : list of Statistic
        Parameters to show, in order.

    Returns
    -------
    list of str
        Table cells.

    """
    given = friction_parameters(estimate)
    return [estimate_cell(given.get(one.name)) for one in means]
