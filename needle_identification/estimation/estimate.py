# SPDX-License-Identifier: Apache-2.0
"""Parameter estimates from one recording, and their mean over several recordings."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import inf, isfinite, nan, sqrt
from typing import TypeVar

from needle_identification.errors import IdentificationError
from needle_identification.estimation.formatting import measured
import numpy as np
from scipy.special import stdtrit


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


_Named = TypeVar('_Named', ParameterEstimate, Statistic)


def named(items: Sequence[_Named], name: str) -> _Named:
    """Return the item with a name; a KeyError lists the valid names."""
    for item in items:
        if item.name == name:
            return item
    raise KeyError(f'{name!r}; valid: {", ".join(item.name for item in items)}')


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
    between = (deviation or 0.0) ** 2
    error = sqrt(max(within, between) / count)
    half_width = error * (float(stdtrit(count - 1, 0.975)) if between > within else 2.0)
    mean = float(values.mean())
    ends = mean - half_width, mean + half_width
    return replace(
        unknown, mean=mean, deviation=deviation, error=error, interval=ends, count=count
    )
