# SPDX-License-Identifier: Apache-2.0
"""Display of estimated parameters, with their intervals."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Final, TYPE_CHECKING, TypeAlias

from needle_dynamics.display import Displayed, new_figure
from needle_identification.estimation.estimate import ParameterEstimate, Statistic
from needle_identification.estimation.formatting import measured
import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    # Take half a second to import.
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Estimates with what each is for: a recording, a force level or a medium.
EstimateRows: TypeAlias = Iterable[tuple[str, ParameterEstimate | Statistic]]

_MOST: Final = 6  # largest number of parameters in a line of text


class DisplayedEstimate(Displayed):
    """Estimate that displays its parameters; a subclass defines `rows`."""

    __slots__ = ()

    def rows(self) -> EstimateRows:
        """Return the parameters, each with its recording, force level or medium."""
        raise NotImplementedError

    def columns(self) -> dict[str, NDArray[Any]]:
        heads = 'of', 'parameter', 'unit', 'value', 'standard error', 'low', 'high'
        rows = [
            (of, one.name, one.unit, _value(one), one.error, *one.interval)
            for of, one in self.rows()
        ]
        return {head: np.array([row[k] for row in rows]) for k, head in enumerate(heads)}

    def __repr__(self) -> str:
        rows = list(self.rows())
        single = len({of for of, _ in rows}) == 1
        found = [
            f'{one.symbol if single else f"{one.symbol} ({of})"} = '
            f'{measured(_value(one), one.error, one.unit)}'
            for of, one in rows[:_MOST]
        ]
        more = [f'{len(rows) - _MOST} more'] if len(rows) > _MOST else []
        of = f' of {rows[0][0]}' if single else ''
        return f'<{type(self).__name__}{of}: {", ".join(found + more)}>'

    def plot(self, figure: Figure | None = None) -> list[Axes]:
        """Draw each determined parameter with its 95 % interval; return the axes of each."""
        panels: dict[str, list[tuple[str, ParameterEstimate | Statistic]]] = {}
        for of, one in self.rows():
            if np.isfinite(_value(one)):
                panels.setdefault(f'{one.symbol} [{one.unit}]', []).append((of, one))
        places = list(dict.fromkeys(of for rows in panels.values() for of, _ in rows))
        across = min(len(panels), 4) or 1
        down = -(-len(panels) // across) or 1
        figure = figure or new_figure(down * (1.2 + 0.3 * len(places)))
        found = list(figure.subplots(down, across, sharey=True, squeeze=False).flat)
        for axes in found[len(panels) :]:
            axes.remove()
        for axes, (label, rows) in zip(found, panels.items(), strict=False):
            for of, one in rows:
                axes.plot(one.interval, [places.index(of)] * 2, color='0.6')
                axes.plot(_value(one), places.index(of), 'o', color='tab:blue')
            axes.set(xlabel=label, ylim=(len(places) - 0.5, -0.5))
            axes.set_yticks(range(len(places)), places)
            axes.locator_params(axis='x', nbins=3)
            axes.grid(visible=True, alpha=0.3)
        return found[: len(panels)]


def _value(one: ParameterEstimate | Statistic) -> float:
    return one.mean if isinstance(one, Statistic) else one.value
