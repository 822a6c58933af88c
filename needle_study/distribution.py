# SPDX-License-Identifier: Apache-2.0
"""Distributions of one variable, as defined in a study file."""

from collections.abc import Callable, Mapping, Sequence
import csv
from dataclasses import dataclass
from functools import lru_cache
from itertools import chain, repeat
from math import isfinite, nan
from pathlib import Path
from reprlib import repr as short
from typing import Any, Final, NamedTuple

from needle_dynamics import FloatArray
from needle_ros.column_units import factor_of
from needle_ros.errors import ParameterError
from needle_ros.quantities import quantity
from needle_ros.settings import find_class, is_number
import numpy as np
from scipy import stats


class Kind(NamedTuple):
    """A kind of distribution."""

    parameters: tuple[str, ...]
    valid: Callable[..., bool]
    rule: str
    frozen: Callable[..., Any]


# The quantile function of gamma is exact in its valid range.
KINDS: Final = {
    'uniform': Kind(
        ('low', 'high'), lambda low, high: low < high, 'low < high',
        lambda low, high: stats.uniform(low, high - low),
    ),
    'normal': Kind(
        ('mean', 'standard deviation'), lambda _mean, deviation: deviation > 0.0,
        'standard deviation > 0', stats.norm,
    ),
    'lognormal': Kind(
        ('median', 'standard deviation of the logarithm'),
        lambda median, deviation: min(median, deviation) > 0.0,
        'standard deviation of the logarithm > 0 and median > 0',
        lambda median, deviation: stats.lognorm(deviation, scale=median),
    ),
    'gamma': Kind(
        ('mean', 'standard deviation'),
        lambda mean, deviation: min(mean, deviation) > 0.0 and 1e-3 < mean / deviation < 1e6,
        'mean > 0, standard deviation > 0, and their ratio from 0.001 to 1e+06',
        lambda mean, sd: stats.gamma((mean / sd) ** 2, scale=mean / (mean / sd) ** 2),
    ),
    'triangular': Kind(
        ('low', 'mode', 'high'), lambda low, mode, high: low <= mode <= high and low < high,
        'low <= mode <= high and low < high',
        lambda low, mode, high: stats.triang((mode - low) / (high - low), low, high - low),
    ),
    'beta': Kind(
        ('a', 'b', 'low', 'high'),
        lambda a, b, low, high: min(a, b) >= 0.1 and max(a, b) <= 1e4 and low < high,
        'a and b from 0.1 to 10000, and low < high',
        lambda a, b, low, high: stats.beta(a, b, low, high - low),
    ),
}  # fmt: skip

#: Parameters without the unit of the variable.
_UNITLESS: Final = ('standard deviation of the logarithm', 'a', 'b')

_LARGEST: Final = 1e100  #: largest valid magnitude of a parameter
_WITHIN: Final = 'within'
_CHOICE: Final = 'choice'
_WEIGHTS: Final = 'weights'
_ROWS, _OF = 'rows', 'of'
TABLE: Final = 'table'  #: of a study file; the study has the rows of its column


@dataclass(frozen=True, slots=True)
class Distribution:
    """Distribution of one variable."""

    kind: str  #: one of `KINDS`, ``choice``, or the address of a class with ``ppf`` and ``cdf``
    numbers: tuple[float, ...]  #: parameters of the kind, or values to choose from
    within: tuple[float, float] = (-np.inf, np.inf)  #: ends of a truncated distribution
    weights: tuple[float, ...] = ()  #: relative probabilities of the values; empty: equal ones
    rows: str = ''  #: name of a table; all variables of a table have values of the same row

    def quantiles(self, parts: FloatArray) -> FloatArray:
        """Return the values of the quantile function at probabilities in (0, 1), shape (n,)."""
        if self.kind == _CHOICE:
            ends = np.cumsum(self.weights or np.ones(len(self.numbers)))
            at = np.searchsorted(ends, parts * ends[-1], side='right')
            return np.asarray(np.array(self.numbers)[np.minimum(at, len(ends) - 1)])
        frozen = _frozen(self.kind, self.numbers)
        low, high = frozen.cdf(self.within)
        return np.asarray(np.clip(frozen.ppf(low + parts * (high - low)), *self.within))

    def ends(self, least: float, most: float) -> tuple[float, float]:
        """Return the values at two probabilities; not finite on overflow."""
        if self.kind == _CHOICE:
            return min(self.numbers), max(self.numbers)
        with np.errstate(over='ignore', invalid='ignore'):
            low, high = self.quantiles(np.array([least, most])).tolist()
        return low, high


@lru_cache(maxsize=256)
def _frozen(kind: str, numbers: tuple[float, ...]) -> Any:
    """Return the distribution of SciPy, which takes 0.5 ms to construct, or of the user."""
    if kind in KINDS:
        return KINDS[kind].frozen(*numbers)
    of_class = find_class('a distribution', kind, dict.fromkeys((*KINDS, _CHOICE), ''))
    try:
        found = of_class(*numbers)
        found.cdf(found.ppf(0.5))
    # Any code of the user.
    except Exception as error:
        raise ParameterError(
            f'{kind} with {list(numbers)} must have ppf and cdf: {error}'
        ) from error
    return found


def distribution(name: str, given: Any, unit: str = '1') -> Distribution:
    """
    Parse a distribution: a number, or a mapping as ``{normal: [0, 0.02], within: [0, 1]}``.

    Numbers are in the SI unit, or text with another unit of its kind, such as ``4mm``.
    """
    if is_number(given) or isinstance(given, str):
        return Distribution(_CHOICE, _numbers(name, [given], unit))
    if not isinstance(given, Mapping):
        raise ParameterError(f'{name} must be a number or one of {_kinds()}, got {given!r}')
    kinds = [str(kind) for kind in given if kind not in (_WITHIN, _WEIGHTS, _OF)]
    if len(kinds) != 1 or not (kinds[0] in (*KINDS, _CHOICE, _ROWS) or ':' in kinds[0]):
        raise ParameterError(f'{name} must be one of {_kinds()}, got {dict(given)!r}')
    (kind,) = kinds
    row = KINDS.get(kind)
    # Parameters of a class have no known units.
    units = ['1' if ':' in kind else unit]
    if row is not None:
        units = ['1' if one in _UNITLESS else unit for one in row.parameters]
    numbers = _numbers(f'{name}: {kind}', given[kind], *units)
    if kind in (_CHOICE, _ROWS):
        return _choice(name, kind, numbers, given)
    if _WEIGHTS in given or _OF in given:
        raise ParameterError(f'{name}: only a {_CHOICE} has {_WEIGHTS}, and only {_ROWS} {_OF}')
    if row is not None:
        if len(numbers) != len(row.parameters):
            takes = ', '.join(row.parameters)
            raise ParameterError(f'{name}: {kind} takes [{takes}], got {list(numbers)}')
        if not row.valid(*numbers):
            raise ParameterError(f'{name}: {kind} must have {row.rule}, got {list(numbers)}')
    if _WITHIN not in given:
        return Distribution(kind, numbers)
    ends = _numbers(f'{name}: {_WITHIN}', given[_WITHIN], unit)
    # The probabilities differ if a value is between the ends.
    if len(ends) != 2 or not np.diff(_frozen(kind, numbers).cdf(ends)) > 0.0:
        raise ParameterError(
            f'{name}: {_WITHIN} takes [low, high] with values of the {kind} distribution between '
            f'them, got {list(ends)}'
        )
    return Distribution(kind, numbers, ends)


def _choice(
    name: str, kind: str, numbers: tuple[float, ...], given: Mapping[str, Any]
) -> Distribution:
    """Parse values to choose from, or the rows of a table."""
    weights = _numbers(f'{name}: {_WEIGHTS}', given.get(_WEIGHTS, ()))
    if not numbers or _WITHIN in given:
        raise ParameterError(f'{name}: {kind} must have values, and no {_WITHIN}')
    if len(weights) not in (0, len(numbers)) or min(weights, default=1.0) <= 0.0:
        raise ParameterError(
            f'{name}: {_WEIGHTS} must have a positive number for each value, got {weights}'
        )
    if (kind == _ROWS) != (_OF in given) or (kind == _ROWS and weights):
        raise ParameterError(f'{name}: {_ROWS} must have {_OF}, a name, and no {_WEIGHTS}')
    return Distribution(_CHOICE, numbers, weights=weights, rows=str(given.get(_OF, '')))


def _kinds() -> str:
    kinds = [f'{{{kind}: [{", ".join(row.parameters)}]}}' for kind, row in KINDS.items()]
    others = f'{{{_CHOICE}: [values], {_WEIGHTS}: [numbers]}}', f'{{{TABLE}: [file, column]}}'
    return ', '.join([*kinds, *others, '{module:Class: [numbers]}'])


def from_table(name: str, given: Any, folder: Path, unit: str) -> Any:
    """Return a distribution of a file with the rows of its table, in SI units, if it names one."""
    if not (isinstance(given, Mapping) and TABLE in given):
        return given
    where = given[TABLE]
    if len(given) > 1 or not (
        isinstance(where, list) and len(where) == 2 and all(isinstance(one, str) for one in where)
    ):
        raise ParameterError(f'{name}: {TABLE} takes [file, column], got {dict(given)!r}')
    file, column = where
    try:
        with (folder / file).open(encoding='utf-8-sig', newline='') as stream:
            rows = [row for row in csv.reader(stream) if row]
    except (OSError, ValueError, csv.Error) as error:
        raise ParameterError(f'{name}: {file} cannot be read: {error}') from error
    found = _column(f'{name}: {file}', rows, column)
    try:
        factor = factor_of(column, unit)
    except ParameterError as error:
        raise ParameterError(f'{name}: {file}: {error}') from error
    return {_ROWS: [factor * value for value in found], _OF: file}


def _column(where: str, rows: Sequence[Sequence[str]], column: str) -> list[float]:
    """Return the numbers of a column of a table; its header is row 1."""
    header = rows[0] if rows else []
    if len(rows) < 2:
        raise ParameterError(f'{where} must have a header and rows below it')
    if column not in header:
        raise ParameterError(f'{where} has no column {column!r}, it has {", ".join(header)}')
    if header.count(column) > 1:
        raise ParameterError(f'{where} has {header.count(column)} columns {column!r}')
    at, found = header.index(column), []
    for number, row in enumerate(rows[1:], 2):
        if len(row) != len(header):
            raise ParameterError(
                f'{where}: row {number} must have {len(header)} cells as the header, also for the '
                f'column {column!r}, got {len(row)}; numbers have a decimal point'
            )
        try:
            value = float(row[at])
        except ValueError:
            value = nan
        if not isfinite(value):
            raise ParameterError(
                f'{where}: row {number}, column {column!r} must be a finite number, got '
                f'{short(row[at])}'
            )
        found.append(value)
    return found


def _numbers(name: str, given: Any, *units: str) -> tuple[float, ...]:
    """Return numbers in SI units, by default without a unit; the last unit is for all others."""
    if not isinstance(given, Sequence) or isinstance(given, str):
        raise ParameterError(f'{name} takes a list of numbers, got {given!r}')
    each = zip(given, chain(units, repeat((units or ('1',))[-1])), strict=False)
    try:
        numbers = [quantity(one, unit) if isinstance(one, str) else one for one, unit in each]
    except ParameterError as error:
        raise ParameterError(f'{name}: {error}') from error
    if not all(is_number(one) and abs(one) <= _LARGEST for one in numbers):
        raise ParameterError(
            f'{name} takes finite numbers up to {_LARGEST:g}, got {list(given)!r}'
        )
    return tuple(map(float, numbers))
