"""Numbers as text: as many digits as the error of a number leaves it."""

from __future__ import annotations

from math import floor, inf, isfinite, log10
from typing import Final

#: Text for a parameter that the data do not determine.
UNKNOWN: Final = 'not determined by the data'

#: Below this an error does not limit the digits.
_SMALLEST_ERROR: Final = 1e-9


def measured(value: float, error: float, unit: str = '') -> str:
    """
    Write a value with its error.

    Parameters
    ----------
    value, error : float
        Estimate and standard error, or half the width of an interval.
    unit : str
        Unit of both; ``1`` is not written.

    Returns
    -------
    str
        Such as ``0.5604 ± 0.0005 N``; `UNKNOWN` if the value is not finite.

    Examples
    --------
    >>> measured(0.56043, 0.00051, 'N')
    '0.56043 ± 0.00051 N'

    """
    if not isfinite(value):
        return UNKNOWN
    form = _format(error)
    text = f' ± {error:{form if form.endswith("f") else ".2g"}}' if isfinite(error) else ''
    return f'{value:{form}}{text}{_suffix(unit)}'


def rounded(value: float, error: float, unit: str = '') -> str:
    """
    Write a value without its error, rounded to the digits that the error leaves it.

    Parameters
    ----------
    value, error : float
        Estimate and standard error.
    unit : str
        Unit; ``1`` is not written.

    Returns
    -------
    str
        The rounded value; `UNKNOWN` if it is not finite.

    """
    return f'{value:{_format(error)}}{_suffix(unit)}' if isfinite(value) else UNKNOWN


def spread(deviation: float, unit: str = '') -> str:
    """
    Write a standard deviation with three digits.

    Parameters
    ----------
    deviation : float
        Standard deviation.
    unit : str
        Unit; ``1`` is not written.

    Returns
    -------
    str
        The rounded standard deviation; `UNKNOWN` if it is not finite.

    """
    return rounded(deviation, 0.1 * deviation, unit)


def between(interval: tuple[float, float]) -> str:
    """
    Write an interval.

    Parameters
    ----------
    interval : (float, float)
        Lower and upper limit.

    Returns
    -------
    str
        Such as ``0.559 to 0.562``, rounded to a part of the width; `UNKNOWN` if the interval is
        not finite.

    """
    low, high = interval
    if not (isfinite(low) and isfinite(high)):
        return UNKNOWN
    form = _format((high - low) / 4.0)
    return f'{low:{form}} to {high:{form}}'


def _format(error: float) -> str:
    """Return the format specification that keeps two digits of the error."""
    if not _SMALLEST_ERROR < error < inf:
        return '.6g'
    return f'.{max(1 - floor(log10(error)), 0)}f'


def _suffix(unit: str) -> str:
    return '' if unit in ('', '1') else f' {unit}'
