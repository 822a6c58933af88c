"""Style and helpers that the figures of the report pages share."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import isfinite
import re
from typing import Any, Final

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from needle_dynamics import FloatArray
from needle_identification import ParameterEstimate, Statistic
from needle_insertion.report.wording import label_of

#: Colors: motion into the tissue and results, motion out of it, data, pale data, fits.
IN, OUT, DATA, LIGHT, FIT = '#1f5fa8', '#c25a00', '#8b95a1', '#c3cad2', '#111111'

#: Points of a line; more cannot be seen.
_MOST_POINTS: Final = 8000

_SYMBOL: Final = re.compile(r'\b(mu|k|f)_(\w{1,3})\b')
_GREEK: Final = {'mu': r'\mu'}


def new_figure(width: float, height: float) -> Figure:
    """
    Return an empty figure.

    Parameters
    ----------
    width, height : float
        Size [inch].

    Returns
    -------
    Figure
        The figure.

    """
    return Figure(figsize=(width, height), layout='constrained')


def label_axes(axes: Axes, xlabel: str, ylabel: str) -> None:
    """
    Label a plot, with symbols typeset, and give it a grid.

    Parameters
    ----------
    axes : Axes
        The plot.
    xlabel, ylabel : str
        Labels in plain text.

    """
    axes.set(xlabel=_typeset(xlabel), ylabel=_typeset(ylabel))
    axes.grid(visible=True, alpha=0.25)
    axes.spines[['top', 'right']].set_visible(False)


def _typeset(words: str) -> str:
    words = words.replace('^2', '²').replace('tau', r'$\tau$')
    return _SYMBOL.sub(lambda m: f'${_GREEK.get(m[1], m[1])}_{{{m[2]}}}$', words)


def legend_above(axes: Axes, **options: Any) -> None:
    """
    Put the legend above the plot, where no data are.

    Parameters
    ----------
    axes : Axes
        The plot.
    **options : object
        More options of `Axes.legend`.

    """
    axes.legend(
        loc='lower left', bbox_to_anchor=(0.0, 1.0), ncols=4, frameon=False,
        borderaxespad=0.2, handletextpad=0.5, **options,
    )  # fmt: skip


def thinned(*signals: FloatArray) -> list[FloatArray]:
    """
    Leave out samples that cannot be seen.

    Parameters
    ----------
    *signals : ndarray, shape (n,)
        Signals of one length.

    Returns
    -------
    list of ndarray
        Every k-th sample of each.

    """
    step = max(1, len(signals[0]) // _MOST_POINTS)
    return [signal[::step] for signal in signals]


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
        The figure.

    """
    columns = min(len(means), 4)
    lines = -(-len(means) // columns)
    figure = new_figure(9.0, lines * (1.2 + 0.24 * len(rows)))
    panels = figure.subplots(lines, columns, sharey=True, squeeze=False)
    for axes, mean in zip(panels.flat, means, strict=False):
        for place, (_, found) in enumerate(rows):
            one = found.get(mean.name)
            if one is not None and one.determined:
                axes.plot(one.interval, (place, place), color=DATA, linewidth=1.6)
                axes.plot(one.value, place, 'o', color=IN, markersize=5.0)
        if isfinite(mean.mean):
            axes.axvspan(*mean.interval, color=IN, alpha=0.12, linewidth=0.0)
            axes.axvline(mean.mean, color=IN, linewidth=1.2)
        label_axes(axes, label_of(mean), '')
        axes.tick_params(left=False)
        axes.xaxis.get_major_formatter().set_useOffset(False)
        axes.locator_params(axis='x', nbins=3)
    for axes in panels.flat[len(means) :]:
        axes.set_visible(False)
    panels[0, 0].set_yticks(range(len(rows)), [name for name, _ in rows])
    panels[0, 0].set_ylim(len(rows) - 0.5, -0.5)
    return figure
