"""What identification says of a parameter: from one recording, and over several."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf, nan, sqrt

from needle_identification.errors import IdentificationError
import numpy as np
from scipy.special import stdtrit


@dataclass(frozen=True, slots=True, kw_only=True)
class ParameterEstimate:
    """
    One parameter from one recording.

    Attributes
    ----------
    name : str
        Name, that of the field of `NeedleParameters` where there is one.
    symbol, unit : str
        How people write it, and its unit.
    value, error : float
        Estimate and its standard error; nan and inf if the data do not determine it.
    interval : (float, float)
        95 % confidence interval.
    determined : bool
        False if the data cannot tell it from the others.

    """

    name: str
    symbol: str
    unit: str
    value: float = nan
    error: float = inf
    interval: tuple[float, float] = (-inf, inf)
    determined: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Statistic:
    """
    One parameter over several recordings.

    Attributes
    ----------
    name, symbol, unit : str
        As in `ParameterEstimate`.
    mean : float
        Mean over the recordings that determine it; nan if none does.
    deviation : float or None
        Standard deviation over the recordings, as in Table 1; None for fewer than two.
    error : float
        Standard error of the mean.
    interval : (float, float)
        95 % confidence interval of the mean.
    count : int
        Recordings that determine it.

    """

    name: str
    symbol: str
    unit: str
    mean: float = nan
    deviation: float | None = None
    error: float = inf
    interval: tuple[float, float] = (-inf, inf)
    count: int = 0


def statistic(parameters: Sequence[ParameterEstimate]) -> Statistic:
    """
    Put one parameter from several recordings together, as in Tables 1 and 2.

    The standard error of the mean is the scatter over the recordings divided by the root of
    their number, which holds whatever makes them differ; but it is never taken as smaller than
    the errors within the recordings alone allow, which few recordings could undercut by chance.
    The interval is wider than two standard errors where few recordings differ by more than
    their own errors: a scatter known from few is itself uncertain (Student's t).

    Parameters
    ----------
    parameters : sequence of ParameterEstimate
        The parameter, one per recording; those that do not determine it are left out.

    Returns
    -------
    Statistic
        Mean, standard deviation and standard error.

    Raises
    ------
    IdentificationError
        If there are no estimates.

    """
    if not parameters:
        raise IdentificationError('no recordings to identify from')
    first = parameters[0]
    known = [parameter for parameter in parameters if parameter.determined]
    count = len(known)
    if not count:
        return Statistic(name=first.name, symbol=first.symbol, unit=first.unit)
    values = np.array([parameter.value for parameter in known])
    deviation = float(values.std(ddof=1)) if count > 1 else None
    within = float(np.mean([parameter.error**2 for parameter in known]))
    scatter = (deviation or 0.0) ** 2
    error = sqrt(max(within, scatter) / count)
    reach = error * (float(stdtrit(count - 1, 0.975)) if scatter > within else 2.0)
    mean = float(values.mean())
    return Statistic(
        name=first.name,
        symbol=first.symbol,
        unit=first.unit,
        mean=mean,
        deviation=deviation,
        error=error,
        interval=(mean - reach, mean + reach),
        count=count,
    )
