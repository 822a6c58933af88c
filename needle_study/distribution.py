# SPDX-License-Identifier: Apache-2.0
"""Distributions of one variable, as defined in a study file."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final, NamedTuple

from needle_dynamics import FloatArray
from needle_ros.errors import ParameterError
import numpy as np
from scipy import stats


class Kind(NamedTuple):
    """A kind of distribution, with two parameters."""

    parameters: tuple[str, str]
    valid: Callable[[float, float], bool]
    rule: str
    frozen: Callable[[float, float], Any]


KINDS: Final = {
    'uniform': Kind(
        ('low', 'high'),
        lambda low, high: low < high,
        'low < high',
        lambda low, high: stats.uniform(low, high - low),
    ),
    'normal': Kind(
        ('mean', 'standard deviation'),
        lambda _mean, deviation: deviation > 0.0,
        'standard deviation > 0',
        stats.norm,
    ),
    'lognormal': Kind(
        ('median', 'standard deviation of the logarithm'),
        lambda median, deviation: min(median, deviation) > 0.0,
        'standard deviation of the logarithm > 0 and median > 0',
        lambda median, deviation: stats.lognorm(deviation, scale=median),
    ),
    'gamma': Kind(
        ('mean', 'standard deviation'),
        # The quantile function is exact in this range.
        lambda mean, deviation: min(mean, deviation) > 0.0 and 1e-3 < mean / deviation < 1e6,
        'mean > 0, standard deviation > 0, and their ratio from 0.001 to 1e+06',
        lambda mean, deviation: stats.gamma(
            (mean / deviation) ** 2, scale=mean / (mean / deviation) ** 2
        ),
    ),
}

_LARGEST: Final = 1e100  #: largest valid magnitude of a parameter
_WITHIN: Final = 'within'
_CHOICE: Final = 'choice'


@dataclass(frozen=True, slots=True)
class Distribution:
    """Distribution of one variable."""

    kind: str  #: one of `KINDS`, or ``choice``
    numbers: tuple[float, ...]  #: parameters of the kind, or equally probable values
    within: tuple[float, float] = (-np.inf, np.inf)  #: ends of a truncated distribution

    def quantiles(self, parts: FloatArray) -> FloatArray:
        """Return the values of the quantile function at probabilities in (0, 1), shape (n,)."""
        if self.kind == _CHOICE:
            number = len(self.numbers)
            at = np.minimum((parts * number).astype(int), number - 1)
            return np.asarray(np.array(self.numbers)[at])
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
def _frozen(kind: str, numbers: tuple[float, float]) -> Any:
    """Return the distribution of SciPy, which takes 0.5 ms to construct."""
    return KINDS[kind].frozen(*numbers)


def distribution(name: str, given: Any) -> Distribution:
    """Parse a distribution: a number, or a mapping as ``{normal: [0, 0.02], within: [0, 1]}``."""
    if is_number(given):
        return Distribution(_CHOICE, (float(given),))
    if not isinstance(given, Mapping):
        raise ParameterError(f'{name} must be a number or one of {_kinds()}, got {given!r}')
    kinds = [kind for kind in given if kind != _WITHIN]
    if len(kinds) != 1 or kinds[0] not in (*KINDS, _CHOICE):
        raise ParameterError(f'{name} must be one of {_kinds()}, got {dict(given)!r}')
    (kind,) = kinds
    numbers = _numbers(f'{name}: {kind}', given[kind])
    if kind == _CHOICE:
        if not numbers or _WITHIN in given:
            raise ParameterError(f'{name}: {kind} must have values, and no {_WITHIN}')
        return Distribution(kind, numbers)
    row = KINDS[kind]
    if len(numbers) != len(row.parameters):
        takes = ', '.join(row.parameters)
        raise ParameterError(f'{name}: {kind} takes [{takes}], got {list(numbers)}')
    if not row.valid(*numbers):
        raise ParameterError(f'{name}: {kind} must have {row.rule}, got {list(numbers)}')
    if _WITHIN not in given:
        return Distribution(kind, numbers)
    ends = _numbers(f'{name}: {_WITHIN}', given[_WITHIN])
    # The probabilities differ if a value is between the ends.
    if len(ends) != 2 or not np.diff(_frozen(kind, numbers).cdf(ends)) > 0.0:
        raise ParameterError(
            f'{name}: {_WITHIN} takes [low, high] with values of the {kind} distribution between '
            f'them, got {list(ends)}'
        )
    return Distribution(kind, numbers, ends)


def _kinds() -> str:
    kinds = [f'{{{kind}: [{", ".join(row.parameters)}]}}' for kind, row in KINDS.items()]
    return ', '.join([*kinds, f'{{{_CHOICE}: [values]}}'])


def is_number(value: Any) -> bool:
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    return number and abs(value) <= _LARGEST


def _numbers(name: str, given: Any) -> tuple[float, ...]:
    if not isinstance(given, Sequence) or isinstance(given, str):
        raise ParameterError(f'{name} takes a list of numbers, got {given!r}')
    if not all(map(is_number, given)):
        raise ParameterError(
            f'{name} takes finite numbers up to {_LARGEST:g}, got {list(given)!r}'
        )
    return tuple(map(float, given))
