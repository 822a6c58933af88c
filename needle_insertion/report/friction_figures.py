"""Figures of identified friction."""

from __future__ import annotations

from typing import Any, Final

from matplotlib.figure import Figure
from needle_identification import FrictionEstimate
from needle_insertion.report.figures import (
    FIT,
    IN,
    label_axes,
    legend_above,
    LIGHT,
    new_figure,
    OUT,
    thinned,
)
import numpy as np

#: Directions of motion: sign, words, color and marker.
_SIDES: Final = ((1.0, 'into the tissue', IN, 'o'), (-1.0, 'out of it', OUT, '^'))


def data_figure(estimate: FrictionEstimate) -> Figure:
    """
    Draw the filtered force over time and against speed, with the fit.

    Parameters
    ----------
    estimate : FrictionEstimate
        What a recording gave.

    Returns
    -------
    Figure
        Two plots.

    """
    fit = estimate.fit
    figure = new_figure(9.0, 7.5)
    above, below = figure.subplots(2, 1)
    time, force = thinned(fit.time - fit.time[0], fit.force)
    above.plot(time, force, color=LIGHT, linewidth=3.0, label='measured, filtered')
    model = np.where(fit.used, fit.model, np.nan)
    above.plot(*thinned(fit.time - fit.time[0], model), color=FIT, linewidth=1.2, label='fit')
    label_axes(above, 'time [s]', 'force on the needle [N]')
    legend_above(above)
    for sign, words, color, mark in _SIDES:
        side = fit.used & (np.sign(fit.speed) == sign)
        speed, force = thinned(1e3 * fit.speed[side], fit.force[side])
        below.plot(speed, force, mark, color=color, markersize=2.5, alpha=0.4, label=words)
        order = np.argsort(fit.speed[side])
        line = thinned(1e3 * fit.speed[side][order], fit.model[side][order])
        below.plot(*line, color=FIT, linewidth=1.2, label='fit' if sign < 0.0 else None)
    below.axhline(0.0, color=FIT, linewidth=0.6)
    below.axvline(0.0, color=FIT, linewidth=0.6)
    label_axes(below, 'insertion speed [mm/s]', 'force on the needle [N]')
    legend_above(below, markerscale=2.0)
    return figure


def residual_figure(estimate: FrictionEstimate) -> Figure:
    """
    Draw what the fit leaves, over time, against speed, and as a histogram.

    Parameters
    ----------
    estimate : FrictionEstimate
        What a recording gave.

    Returns
    -------
    Figure
        Three plots.

    """
    fit = estimate.fit
    figure = new_figure(9.0, 6.5)
    over, against, often = figure.subplot_mosaic([['time', 'time'], ['speed', 'size']]).values()
    residual = 1e3 * (fit.force - fit.model)
    reach = float(np.abs(residual[fit.used]).max())
    edges = np.linspace(-reach, reach, 41).tolist()
    for sign, words, color, mark in _SIDES:
        side = fit.used & (np.sign(fit.speed) == sign)
        time, speed, left = thinned(
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
        axes.axhline(0.0, color=FIT, linewidth=0.8)
    label_axes(over, 'time [s]', 'residual [mN]')
    label_axes(against, 'insertion speed [mm/s]', 'residual [mN]')
    label_axes(often, 'residual [mN]', 'samples')
    legend_above(over, markerscale=3.0)
    return figure
