# SPDX-License-Identifier: Apache-2.0
"""Format numbers with the digits that are significant for their error."""

from math import floor, inf, isfinite, log10
from typing import Final

UNKNOWN: Final = 'not determined by the data'  #: text for a parameter
_SMALLEST_ERROR: Final = 1e-9  # smallest error that limits the digits


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
