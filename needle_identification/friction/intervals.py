# SPDX-License-Identifier: Apache-2.0
"""
Compute friction parameters with standard errors and confidence intervals.

The interval of a coefficient is its standard error from `score_covariance` times the quantile of
Student's t. Ratios have intervals by the delta method.
"""

from math import hypot, sqrt

from needle_dynamics.arrays import FloatArray
from needle_identification.estimation.estimate import estimated, ParameterEstimate, with_half_width
from needle_identification.estimation.regression import Regression
from needle_identification.friction.settings import FrictionSettings
from needle_identification.friction.terms import columns_of
import numpy as np
from scipy.special import stdtrit


def parameter_estimates(
    fit: Regression, settings: FrictionSettings, mean_speed: float, period: float
) -> tuple[ParameterEstimate, ...]:
    """Return the coefficients of the terms, then derived ratios, at the mean speed [m/s]."""
    columns = columns_of(settings.terms, settings)
    at = {column.name: k for k, column in enumerate(columns)}
    intervals = fit.interval()
    found = []
    for k, column in enumerate(columns):
        value, error = float(fit.values[k]), float(fit.errors[k])
        ends = (float(intervals[k, 0]), float(intervals[k, 1]))
        found.append(estimated(column.name, column.symbol, column.unit, value, error, ends))
    if 'moving_mass' in at and 'viscous_friction' in at:
        mass, viscous = found[at['moving_mass']], found[at['viscous_friction']]
        if mass.determined and viscous.determined:
            # Stamps differ by up to a period, which resembles a mass within +- largest [kg].
            largest = viscous.value * period
            error = hypot(mass.error, largest / sqrt(3.0))
            low, high = mass.interval
            half_width = hypot(0.5 * (high - low), 0.95 * largest)
            found[at['moving_mass']] = with_half_width(mass, mass.value, error, half_width)
    rows = np.zeros((2, len(fit.values)))
    if 'withdrawal_coulomb' in at:
        rows[0, [at['coulomb_friction'], at['viscous_friction']]] = 1.0, mean_speed
        rows[1, [at['withdrawal_coulomb'], at['withdrawal_viscous']]] = 1.0, mean_speed
        found.append(_ratio(fit, rows, 'withdrawal_friction', 'f_out / f_in'))
    if 'stribeck_friction' in at and 'coulomb_friction' in at:
        rows[:] = 0.0
        rows[[0, 1], [at['coulomb_friction'], at['stribeck_friction']]] = 1.0
        found.append(_ratio(fit, rows, 'breakaway_friction', 'mu_b / mu_s'))
    return tuple(found)


def _ratio(fit: Regression, rows: FloatArray, name: str, symbol: str) -> ParameterEstimate:
    """Return 1 + (second row / first row) of the coefficients, with errors by the delta method."""
    parameter = ParameterEstimate(name=name, symbol=symbol, unit='1')
    taken = rows.any(axis=0)
    if not fit.determined[taken].all():
        return parameter
    base, more = rows[:, taken] @ fit.values[taken]
    gradient = (rows[1, taken] - more / base * rows[0, taken]) / base
    error = sqrt(float(gradient @ fit.covariance[np.ix_(taken, taken)] @ gradient))
    half_width = error * float(stdtrit(fit.degrees_of_freedom[taken].min(), 0.975))
    return with_half_width(parameter, 1.0 + float(more / base), error, half_width)
