"""How estimates, statistics and warnings are worded, on the terminal and on pages."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import isfinite
from pathlib import Path
import re
from typing import Any, Final

from needle_identification import ParameterEstimate, Statistic
from needle_identification.estimation.formatting import between, measured, rounded, spread
import numpy as np

#: Heads of the rows of `mean_row`.
MEAN_HEADS: Final = ('parameter', 'mean ± SE', '95 % interval', 'STD over bags', 'bags')

_NUMBERS: Final = re.compile(r'[-+]?\d[\d.e+-]*')


def label_of(one: ParameterEstimate | Statistic) -> str:
    """
    Return symbol and unit.

    Parameters
    ----------
    one : ParameterEstimate or Statistic
        A parameter.

    Returns
    -------
    str
        Such as ``mu_s [N]``.

    """
    return one.symbol if one.unit == '1' else f'{one.symbol} [{one.unit}]'


def estimate_cell(one: ParameterEstimate | None) -> str:
    """
    Return a value with its standard error.

    Parameters
    ----------
    one : ParameterEstimate or None
        A parameter, None where a recording does not have it.

    Returns
    -------
    str
        A table cell, '' for None.

    """
    return '' if one is None else measured(one.value, one.error)


def mean_row(one: Statistic) -> tuple[str, ...]:
    """
    Return a row of a table of means, with the heads `MEAN_HEADS`.

    Parameters
    ----------
    one : Statistic
        A parameter over the recordings.

    Returns
    -------
    tuple of str
        Table cells.

    """
    return (
        f'{one.name.replace("_", " ").capitalize()} {label_of(one)}',
        measured(one.mean, one.error),
        between(one.interval) if isfinite(one.mean) else '',
        '' if one.deviation is None else spread(one.deviation),
        f'{one.count}',
    )


def with_deviation(one: Statistic) -> str:
    """
    Return mean ± standard error, and the standard deviation in brackets if there is one.

    Parameters
    ----------
    one : Statistic
        A parameter over the recordings.

    Returns
    -------
    str
        A table cell.

    """
    scatter = '' if one.deviation is None else f' ({spread(one.deviation)})'
    return f'{measured(one.mean, one.error)}{scatter}'


def card(one: Statistic) -> tuple[str, str, str]:
    """
    Return a main result of a page.

    Parameters
    ----------
    one : Statistic
        A parameter over the recordings.

    Returns
    -------
    (str, str, str)
        What it is, its value, and its interval and scatter.

    """
    what = f'{one.name.replace("_", " ").capitalize()} {one.symbol}'
    if not isfinite(one.mean):
        return what, 'not determined', 'by these recordings'
    note = f'95 % interval {between(one.interval)}'
    if one.deviation is not None:
        note += f'; STD {spread(one.deviation)} over {counted(one.count, "recording")}'
    return what, rounded(one.mean, one.error, one.unit), note


def counted(number: int, what: str) -> str:
    """
    Return a number of things.

    Parameters
    ----------
    number : int
        How many.
    what : str
        Singular of what they are.

    Returns
    -------
    str
        Such as ``2 recordings``.

    """
    return f'{number} {what}' if number == 1 else f'{number} {what}s'


def short_names(names: Sequence[str]) -> dict[str, str]:
    """
    Return names of recordings without their folders, unless two would be the same.

    Parameters
    ----------
    names : sequence of str
        Paths.

    Returns
    -------
    dict
        Short names by path.

    """
    short = [Path(name).name or name for name in names]
    return dict(zip(names, short if len(set(short)) == len(names) else names, strict=True))


def nearest_to_median(values: Sequence[float]) -> int:
    """
    Return which value is typical.

    Parameters
    ----------
    values : sequence of float
        Values, nan where there is none.

    Returns
    -------
    int
        Index of the value nearest to the median; 0 if all are nan.

    """
    if not np.isfinite(values).any():
        return 0
    return int(np.nanargmin(np.abs(np.array(values) - np.nanmedian(values))))


def grouped_warnings(
    estimates: Sequence[Any], label: Mapping[str, str]
) -> tuple[list[str], list[str]]:
    """
    Return the warnings of all recordings, in short and in full.

    Parameters
    ----------
    estimates : sequence
        What was identified from each recording, with its ``name`` and ``warnings``.
    label : Mapping[str, str]
        What to call each recording, by its name.

    Returns
    -------
    (list of str, list of str)
        One of each group of warnings that differ in their numbers only, and all of them if these
        are more.

    """
    groups: dict[str, list[tuple[str, str]]] = {}
    for estimate in estimates:
        for words in estimate.warnings:
            kind = _NUMBERS.sub('', words.partition(' (')[0])
            groups.setdefault(kind, []).append((label[estimate.name], words))
    short = [
        f'{found[0][0]}: {found[0][1]}' + (f'; {len(found) - 1} more like it' if found[1:] else '')
        for found in groups.values()
    ]
    full = [f'{name}: {words}' for found in groups.values() for name, words in found]
    return short, full if len(full) > len(short) else []
