"""Distributions of one variable, as defined in a study file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import isfinite
from typing import Any, Final

from needle_dynamics import FloatArray
from needle_ros.errors import ParameterError
import numpy as np
from scipy.special import gammainc, gammaincinv, ndtr, ndtri

#: Kinds, and the parameters of each.
KINDS: Final[Mapping[str, tuple[str, ...]]] = {
    'uniform': ('low', 'high'),
    'normal': ('mean', 'standard deviation'),
    'lognormal': ('median', 'standard deviation of the logarithm'),
    'gamma': ('mean', 'standard deviation'),
}

#: Largest valid magnitude of a parameter.
_LARGEST: Final = 1e100

#: Least and largest mean of a gamma distribution over its standard deviation.
_FLATTEST, _SHARPEST = 1e-3, 1e6

_WITHIN: Final = 'within'
_CHOICE: Final = 'choice'


@dataclass(frozen=True, slots=True)
class Distribution:
    """Distribution of one variable."""

    #: One of `KINDS`, or ``choice``.
    kind: str
    #: Parameters as in `KINDS`, or equally probable values.
    numbers: tuple[float, ...]
    #: Low and high end of a truncated distribution.
    within: tuple[float, float] = (-np.inf, np.inf)

    def quantiles(self, parts: FloatArray) -> FloatArray:
        """Return the values of the quantile function at probabilities in (0, 1), shape (n,)."""
        if self.kind == _CHOICE:
            number = len(self.numbers)
            at = np.minimum((parts * number).astype(int), number - 1)
            return np.asarray(np.array(self.numbers)[at])
        low, high = map(self._below, self.within)
        values = self._at(low + parts * (high - low))
        return np.asarray(np.clip(values, *self.within))

    def ends(self, least: float, most: float) -> tuple[float, float]:
        """Return the values at two probabilities; not finite on overflow."""
        if self.kind == _CHOICE:
            return min(self.numbers), max(self.numbers)
        with np.errstate(over='ignore', invalid='ignore'):
            low, high = self.quantiles(np.array([least, most])).tolist()
        return low, high

    def _at(self, parts: FloatArray) -> FloatArray:
        first, second = self.numbers
        match self.kind:
            case 'uniform':
                return np.asarray(first + parts * (second - first))
            case 'normal':
                return np.asarray(first + second * ndtri(parts))
            case 'lognormal':
                return np.asarray(first * np.exp(second * ndtri(parts)))
        shape = (first / second) ** 2
        return np.asarray(first / shape * gammaincinv(shape, parts))

    def _below(self, value: float) -> float:
        """Return the cumulative probability at a value."""
        first, second = self.numbers
        if not isfinite(value):
            return float(value > 0.0)
        match self.kind:
            case 'uniform':
                return float(np.clip((value - first) / (second - first), 0.0, 1.0))
            case 'normal':
                return float(ndtr((value - first) / second))
            case 'lognormal':
                return float(ndtr(np.log(value / first) / second)) if value > 0.0 else 0.0
        shape = (first / second) ** 2
        return float(gammainc(shape, max(0.0, value) * shape / first))


def distribution(name: str, given: Any) -> Distribution:
    """
    Parse a distribution; `name` is for error messages.

    `given` is a number, a constant, or a mapping such as ``{normal: [0, 0.02]}``, truncated by
    ``within: [low, high]``. Raises `ParameterError` if it is not valid.
    """
    if _is_number(given):
        return Distribution(_CHOICE, (float(given),))
    if not isinstance(given, Mapping):
        raise ParameterError(f'{name} must be a number or one of {_kinds()}, got {given!r}')
    kinds = [kind for kind in given if kind != _WITHIN]
    if len(kinds) != 1 or kinds[0] not in (*KINDS, _CHOICE):
        raise ParameterError(f'{name} must be one of {_kinds()}, got {dict(given)!r}')
    (kind,) = kinds
    numbers = _numbers(f'{name}: {kind}', given[kind])
    found = Distribution(kind, numbers)
    if kind == _CHOICE:
        if not numbers or _WITHIN in given:
            raise ParameterError(f'{name}: {kind} must have values, and no {_WITHIN}')
        return found
    wanted = KINDS[kind]
    if len(numbers) != len(wanted):
        raise ParameterError(f'{name}: {kind} takes [{", ".join(wanted)}], got {list(numbers)}')
    first, second = numbers
    if kind == 'uniform':
        valid = first < second
    else:
        valid = second > 0.0 and (kind == 'normal' or first > 0.0)
    if valid and kind == 'gamma' and not _FLATTEST < first / second < _SHARPEST:
        raise ParameterError(
            f'{name}: gamma must have a mean over standard deviation from {_FLATTEST:g} to '
            f'{_SHARPEST:g}, got {list(numbers)}'
        )
    if not valid:
        rule = 'low < high' if kind == 'uniform' else f'{wanted[1]} > 0'
        rule += '' if kind in ('uniform', 'normal') else f' and {wanted[0]} > 0'
        raise ParameterError(f'{name}: {kind} must have {rule}, got {list(numbers)}')
    if _WITHIN not in given:
        return found
    ends = _numbers(f'{name}: {_WITHIN}', given[_WITHIN])
    if len(ends) != 2 or ends[0] >= ends[1] or found._below(ends[0]) == found._below(ends[1]):
        raise ParameterError(
            f'{name}: {_WITHIN} takes [low, high] with values of the {kind} distribution between '
            f'them, got {list(ends)}'
        )
    return Distribution(kind, numbers, (ends[0], ends[1]))


def _kinds() -> str:
    kinds = [f'{{{kind}: [{", ".join(numbers)}]}}' for kind, numbers in KINDS.items()]
    return ', '.join([*kinds, f'{{{_CHOICE}: [values]}}'])


def _is_number(value: Any) -> bool:
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    return number and abs(value) <= _LARGEST


def _numbers(name: str, given: Any) -> tuple[float, ...]:
    if not isinstance(given, Sequence) or isinstance(given, str):
        raise ParameterError(f'{name} takes a list of numbers, got {given!r}')
    # YAML 1.1 reads 1e-3 as text.
    read = [_read(one) for one in given]
    if not all(map(_is_number, read)):
        raise ParameterError(
            f'{name} takes finite numbers up to {_LARGEST:g}, got {list(given)!r}'
        )
    return tuple(map(float, read))


def _read(value: Any) -> Any:
    if isinstance(value, str):
        try:
            return float(value)
        except ValueError:
            return value
    return value
