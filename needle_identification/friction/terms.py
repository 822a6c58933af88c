"""Terms of the friction force: regressors by name, settings, and the parameters they give."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import hypot, sqrt
from typing import Final

from needle_dynamics import (
    FloatArray,
)
from needle_identification.estimation.estimate import ParameterEstimate
from needle_identification.estimation.regression import ESTIMATORS, Regression
from needle_ros.errors import (
    ParameterError,
)
from needle_ros.settings import check_constants, constant
import numpy as np
from scipy.special import stdtrit


@dataclass(frozen=True, slots=True)
class Column:
    """A regressor and the parameter before it."""

    name: str
    symbol: str
    unit: str
    of: Callable[[FloatArray, FloatArray, FrictionSettings], FloatArray]


_COLUMNS: Final[Mapping[str, tuple[Column, ...]]] = {
    'coulomb': (Column('coulomb_friction', 'mu_s', 'N', lambda v, _a, _s: np.sign(v)),),
    'viscous': (Column('viscous_friction', 'mu_v', 'N s/m', lambda v, _a, _s: v),),
    'offset': (Column('offset', 'b', 'N', lambda v, _a, _s: np.ones_like(v)),),
    'inertia': (Column('moving_mass', 'm', 'kg', lambda _v, a, _s: a),),
    'direction': (
        Column('withdrawal_coulomb', 'd mu_s', 'N', lambda v, _a, _s: np.minimum(np.sign(v), 0)),
        Column('withdrawal_viscous', 'd mu_v', 'N s/m', lambda v, _a, _s: np.minimum(v, 0.0)),
    ),
    'stribeck': (
        Column(
            'stribeck_friction',
            'mu_b - mu_s',
            'N',
            lambda v, _a, s: np.sign(v) * np.exp(-((v / s.stribeck_speed) ** 2)),
        ),
    ),
}

#: Terms of the friction force by name. `direction`: what Coulomb and viscous friction are more on
#: withdrawal than on insertion; `stribeck`: what break-away friction is more than mu_s.
TERMS: Final = tuple(_COLUMNS)


@dataclass(frozen=True, slots=True, kw_only=True)
class FrictionSettings:
    """
    How friction is identified.

    Attributes
    ----------
    terms : tuple of str
        Terms of the friction force, of `TERMS`; the default is equation (15).
    estimator : str
        One of `ESTIMATORS`; noise is weighted by stroke, and ``total`` takes that of the speed.

    Raises
    ------
    ParameterError
        If a setting is out of range, or a term is unknown or lacks another.

    """

    cutoff: float = constant(
        30.0, 'Hz', 'zero-phase low-pass filter of force and motion', open_low=True
    )
    moving_speed: float = constant(
        1e-5, 'm/s', 'speed above which the needle counts as moving', open_low=True
    )
    largest_acceleration: float = constant(
        0.2, 'm/s^2', 'acceleration up to which samples are used without inertia', open_low=True
    )
    stribeck_speed: float = constant(
        1e-3, 'm/s', 'speed over which break-away friction falls', open_low=True
    )
    terms: tuple[str, ...] = field(
        default=('coulomb', 'viscous'), metadata={'description': f'of {", ".join(TERMS)}'}
    )
    estimator: str = field(
        default='ordinary', metadata={'description': f'one of {", ".join(ESTIMATORS)}'}
    )

    def __post_init__(self) -> None:
        check_constants(self)
        object.__setattr__(self, 'terms', tuple(self.terms))
        if not self.terms or len(set(self.terms)) < len(self.terms):
            raise ParameterError(f'terms must be distinct, at least one, got {list(self.terms)}')
        for term in self.terms:
            if term not in TERMS:
                raise ParameterError(f'terms must be of {", ".join(TERMS)}, got {term!r}')
        if 'direction' in self.terms and not {'coulomb', 'viscous'} <= set(self.terms):
            raise ParameterError('the term direction needs the terms coulomb and viscous')
        if self.estimator not in ESTIMATORS:
            raise ParameterError(
                f'estimator must be one of {", ".join(ESTIMATORS)}, got {self.estimator!r}'
            )
        if self.estimator == 'total' and (
            'direction' in self.terms or 'viscous' not in self.terms
        ):
            raise ParameterError(
                'the estimator total needs the term viscous and takes no direction: the noise '
                'of the speed is that of one column'
            )


def columns_of(terms: Sequence[str]) -> list[Column]:
    """Return the regressors of terms, in their order."""
    return [column for term in terms for column in _COLUMNS[term]]


def regressors(
    speed: FloatArray, acceleration: FloatArray, terms: Sequence[str], settings: FrictionSettings
) -> FloatArray:
    """Return the regressors, shape (n, k), at speeds [m/s] and accelerations [m/s^2], (n,)."""
    return np.column_stack([c.of(speed, acceleration, settings) for c in columns_of(terms)])


def parameter_estimates(
    fit: Regression, settings: FrictionSettings, pace: float, period: float
) -> tuple[ParameterEstimate, ...]:
    """
    Return the coefficients of the terms, then those of the model that follow from them.

    Parameters
    ----------
    fit : Regression
        Whose first columns are those of the terms.
    settings : FrictionSettings
        The terms.
    pace : float
        Mean speed [m/s], at which withdrawal is compared with insertion.
    period : float
        Sample period [s]: stamps of force and motion are trusted to it, no better.

    Returns
    -------
    tuple of ParameterEstimate
        The parameters.

    """
    columns = columns_of(settings.terms)
    at = {column.name: k for k, column in enumerate(columns)}
    intervals = fit.interval()
    found = []
    for k, column in enumerate(columns):
        parameter = ParameterEstimate(name=column.name, symbol=column.symbol, unit=column.unit)
        if fit.determined[k]:
            low, high = intervals[k]
            parameter = replace(
                parameter,
                value=float(fit.values[k]),
                error=float(fit.errors[k]),
                interval=(float(low), float(high)),
                determined=True,
            )
        found.append(parameter)
    if 'moving_mass' in at and 'viscous_friction' in at:
        mass, viscous = found[at['moving_mass']], found[at['viscous_friction']]
        if mass.determined and viscous.determined:
            found[at['moving_mass']] = _widened(mass, viscous.value * period)
    if 'withdrawal_coulomb' in at:
        rows = np.zeros((2, len(fit.values)))
        rows[0, [at['coulomb_friction'], at['viscous_friction']]] = 1.0, pace
        rows[1, [at['withdrawal_coulomb'], at['withdrawal_viscous']]] = 1.0, pace
        found.append(_ratio(fit, rows, 'withdrawal_friction', 'f_out / f_in'))
    if 'stribeck_friction' in at and 'coulomb_friction' in at:
        rows = np.zeros((2, len(fit.values)))
        rows[[0, 1], [at['coulomb_friction'], at['stribeck_friction']]] = 1.0
        found.append(_ratio(fit, rows, 'breakaway_friction', 'mu_b / mu_s'))
    return tuple(found)


def _widened(mass: ParameterEstimate, most: float) -> ParameterEstimate:
    """Add the error of a lag that looks like a mass, evenly anything up to ``most`` [kg]."""
    error = hypot(mass.error, most / sqrt(3.0))
    low, high = mass.interval
    reach = hypot(0.5 * (high - low), 0.95 * most)
    return replace(mass, error=error, interval=(mass.value - reach, mass.value + reach))


def _ratio(fit: Regression, rows: FloatArray, name: str, symbol: str) -> ParameterEstimate:
    """Return 1 + (second row / first row) of the coefficients, error by the delta method."""
    taken = rows.any(axis=0)
    if not fit.determined[taken].all():
        return ParameterEstimate(name=name, symbol=symbol, unit='1')
    base, more = rows[:, taken] @ fit.values[taken]
    gradient = (rows[1, taken] - more / base * rows[0, taken]) / base
    error = sqrt(float(gradient @ fit.covariance[np.ix_(taken, taken)] @ gradient))
    value, reach = (
        1.0 + float(more / base),
        error * float(stdtrit(fit.freedom[taken].min(), 0.975)),
    )
    return ParameterEstimate(
        name=name,
        symbol=symbol,
        unit='1',
        value=value,
        error=error,
        interval=(value - reach, value + reach),
        determined=True,
    )
