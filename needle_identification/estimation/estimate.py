# SPDX-License-Identifier: Apache-2.0
"""Parameter estimates from one recording, their mean over several, their text and display."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from math import floor, inf, isfinite, log10, nan, sqrt
from typing import Any, Final, TYPE_CHECKING, TypeAlias, TypeVar

from needle_dynamics.display import Displayed, new_figure
from needle_identification.errors import IdentificationError, UnknownNameError, WrongSignError
import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

if TYPE_CHECKING:
    # Take half a second to import.
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

UNKNOWN: Final = 'not determined by the data'  #: text for a parameter
_SMALLEST_ERROR: Final = 1e-9  # smallest error that limits the digits
_MOST: Final = 6  # largest number of parameters in a line of text


def measured(value: float, error: float, unit: str = '') -> str:
    """Format a value with its error, such as ``0.56043 ± 0.00051 N``; else `UNKNOWN`."""
    if not isfinite(value):
        return UNKNOWN
    form = _format(error)
    text = f' ± {error:{form if form.endswith("f") else ".2g"}}' if isfinite(error) else ''
    return f'{value:{form}}{text}{suffix(unit)}'


def rounded(value: float, error: float, unit: str = '') -> str:
    """Format a value without its error, rounded to significant digits; or `UNKNOWN`."""
    return f'{value:{_format(error)}}{suffix(unit)}' if isfinite(value) else UNKNOWN


def spread(deviation: float) -> str:
    """Format a standard deviation with three digits; `UNKNOWN` if not finite."""
    return rounded(deviation, 0.1 * deviation)


def between(interval: tuple[float, float]) -> str:
    """Format an interval, such as ``0.559 to 0.562``; `UNKNOWN` if not finite."""
    low, high = interval
    if not (isfinite(low) and isfinite(high)):
        return UNKNOWN
    form = _format((high - low) / 4.0)
    return f'{low:{form}} to {high:{form}}'


def _format(error: float) -> str:
    if not _SMALLEST_ERROR < error < inf:
        return '.6g'
    return f'.{max(1 - floor(log10(error)), 0)}f'


def suffix(unit: str) -> str:
    """Return a unit for the end of a number; none of a pure number."""
    return '' if unit in ('', '1') else f' {unit}'


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class ParameterEstimate:
    """Estimate of one parameter from one recording."""

    name: str  #: name; for a model parameter, its field in `NeedleParameters`
    symbol: str  #: symbol in text, such as ``mu_s``
    unit: str  #: unit; ``1`` for a pure number
    value: float = nan  #: estimate; nan if not determined
    error: float = inf  #: standard error; inf if not determined
    interval: tuple[float, float] = (-inf, inf)  #: 95 % confidence interval
    determined: bool = False  #: whether the data determine the parameter

    def __repr__(self) -> str:
        return f'<{self.name}: {measured(self.value, self.error, self.unit)}>'


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Statistic:
    """One parameter over several recordings; name, symbol and unit as in `ParameterEstimate`."""

    name: str
    symbol: str
    unit: str
    mean: float = nan  #: mean over the recordings that determine the parameter, nan if none
    #: Standard deviation over the recordings, as in Tables 1 and 2; None for fewer than two.
    deviation: float | None = None
    error: float = inf  #: standard error of the mean
    interval: tuple[float, float] = (-inf, inf)  #: 95 % confidence interval of the mean
    count: int = 0  #: number of recordings that determine the parameter

    def __repr__(self) -> str:
        return f'<{self.name}: {measured(self.mean, self.error, self.unit)}, n = {self.count}>'


def estimated(
    name: str, symbol: str, unit: str, value: float, error: float, interval: tuple[float, float]
) -> ParameterEstimate:
    """Return an estimate, determined if its value and its interval are finite."""
    known = isfinite(value) and all(map(isfinite, interval))
    return ParameterEstimate(
        name=name, symbol=symbol, unit=unit, value=value, error=error, interval=interval,
        determined=known,
    )  # fmt: skip


def with_half_width(
    unknown: ParameterEstimate, value: float, error: float, half_width: float
) -> ParameterEstimate:
    """Return a determined copy, with an interval symmetric about the value."""
    interval = (value - half_width, value + half_width)
    return replace(unknown, value=value, error=error, interval=interval, determined=True)


def check_sign(what: str, parameter: ParameterEstimate) -> None:
    """Raise `WrongSignError` if a parameter is clearly negative."""
    if parameter.determined and parameter.value + 2.0 * parameter.error < 0.0:
        raise WrongSignError(
            f'{what} must not be negative, got {parameter.symbol} = {parameter.value:.3g} '
            f'{parameter.unit}; the force or the motion may have the wrong sign'
        )


_Named = TypeVar('_Named', ParameterEstimate, Statistic)


def named(items: Sequence[_Named], name: str) -> _Named:
    """Return the item with a name; an `UnknownNameError` lists the valid names."""
    for item in items:
        if item.name == name:
            return item
    raise UnknownNameError(f'{name!r}; valid: {", ".join(item.name for item in items)}')


def statistic(parameters: Sequence[ParameterEstimate]) -> Statistic:
    """Return the mean of one parameter over the recordings that determine it."""
    # As in Tables 1 and 2, the error is the standard deviation over the root of the number; at
    # least that of the errors within the recordings, because a few may agree by chance. If the
    # recordings differ by more than their errors, the interval is from Student's t.
    if not parameters:
        raise IdentificationError('no recordings to identify from')
    first = parameters[0]
    known = [parameter for parameter in parameters if parameter.determined]
    count = len(known)
    unknown = Statistic(name=first.name, symbol=first.symbol, unit=first.unit)
    if not count:
        return unknown
    values = np.array([parameter.value for parameter in known])
    deviation = float(values.std(ddof=1)) if count > 1 else None
    within = float(np.mean([parameter.error**2 for parameter in known]))
    beyond = (deviation or 0.0) ** 2
    error = sqrt(max(within, beyond) / count)
    half_width = error * (float(stdtrit(count - 1, 0.975)) if beyond > within else 2.0)
    mean = float(values.mean())
    ends = mean - half_width, mean + half_width
    return replace(
        unknown, mean=mean, deviation=deviation, error=error, interval=ends, count=count
    )


#: Estimates with their recording, force level or medium.
EstimateRows: TypeAlias = Iterable[tuple[str, ParameterEstimate | Statistic]]


class DisplayedEstimate(Displayed, ABC):
    """Estimate that displays its parameters; a subclass defines `rows`."""

    __slots__ = ()

    @abstractmethod
    def rows(self) -> EstimateRows:
        """Return the parameters, each with its recording, force level or medium."""

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
