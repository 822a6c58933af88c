"""
The lag of the force behind the motion, by filters of the sensor or by clocks that differ.

A lag of 2 ms changes the force of a needle that accelerates by more than the error of its
friction. The lag is therefore estimated: first coarsely, in steps of half the filter, then by
Gauss-Newton steps; the regression of friction itself takes the last step.
"""

from __future__ import annotations

from dataclasses import replace
from math import hypot
from typing import Final

from needle_dynamics.arrays import FloatArray
from needle_identification.estimation.estimate import ParameterEstimate
from needle_identification.estimation.regression import Regression
from needle_identification.friction.design import (
    Design,
    FEWEST_WINDOWS,
    is_enough,
    moving_threshold,
    select_samples,
    with_lag_column,
)
from needle_identification.friction.filtering import FilteredSignals
from needle_identification.friction.settings import FrictionSettings
from needle_identification.friction.terms import regressors
import numpy as np
from scipy.special import ndtri

#: Largest lag that is searched for [s].
_LARGEST_LAG: Final = 0.25

#: Part of the misfit that a coarse lag must leave at most.
_BETTER: Final = 0.5

#: Largest number of samples for the coarse search.
_MAX_SAMPLES: Final = 1000

_MAX_ITERATIONS: Final = 10

#: Part of the power of the acceleration that may be noise where the lag is estimated.
_LARGEST_NOISE: Final = 0.1

#: The lag is reported if the acceleration (root mean square) exceeds this part of its largest
#: value. A smaller one may be left by filter and spline of jumps of the speed.
_SMALLEST_ACCELERATION: Final = 0.01

#: Error of a lag by the cubic spline between samples, for one sample per period of the cutoff
#: [sampling periods]; of fourth order. Found with the simulated plant, whose speed has corners at
#: the samples.
_SPLINE_ERROR: Final = 10.0

#: The lag if it is not determined.
UNKNOWN_LAG: Final = ParameterEstimate(name='lag', symbol='tau', unit='s')


def find_lag(
    signals: FilteredSignals, settings: FrictionSettings, window: FloatArray
) -> tuple[float, float | None]:
    """
    Search for the lag of the force.

    Parameters
    ----------
    signals : FilteredSignals
        Filtered force and motion.
    settings : FrictionSettings
        The terms; inertia is left out, because it looks like a lag.
    window : ndarray, shape (w,)
        Window that spans the correlation of the noise.

    Returns
    -------
    coarse : float
        Lag to half the length of the filter [s]; 0 if no lag fits much better.
    fine : float or None
        Lag of least misfit [s]; None if the motion does not determine it.

    """
    terms = tuple(term for term in settings.terms if term != 'inertia')
    if not terms:
        return 0.0, None
    simple = replace(settings, terms=terms, estimator='ordinary')
    lag = coarse = _coarse_lag(signals, simple)
    for _ in range(_MAX_ITERATIONS):
        design = select_samples(signals, simple, lag, abs(lag))
        if not is_enough(design, window) or _acceleration_is_noise(signals, design):
            return coarse, None
        design = with_lag_column(signals, design, simple)
        used = design.used
        x = regressors(design.speed[used], design.acceleration[used], terms, simple)
        x = np.column_stack([x, design.lag_column[used]])
        change = float(np.linalg.lstsq(x, signals.force[used], rcond=None)[0][-1])
        lag += change
        if abs(lag) > 2.0 * _LARGEST_LAG:
            return coarse, None
        # The fit itself takes the last step.
        if abs(change) < 0.05 * signals.period:
            break
    return coarse, lag


def _coarse_lag(signals: FilteredSignals, settings: FrictionSettings) -> float:
    """Return the lag, in steps of half the filter, that fits far better than none, else zero."""
    every = max(1, len(signals.time) // _MAX_SAMPLES)
    time, force = signals.time[::every], signals.force[::every]
    threshold = moving_threshold(signals, settings)
    step = signals.half_filter * signals.period
    count = int(_LARGEST_LAG / step)
    lags = step * np.arange(-count, count + 1)
    misfits = []
    for lag in lags:
        then = np.clip(time - lag, time[0], time[-1])
        speed, acceleration = signals.motion(then), signals.motion(then, 1)
        moving = np.abs(speed) > threshold
        if np.count_nonzero(moving) <= FEWEST_WINDOWS:
            return 0.0
        x = regressors(speed[moving], acceleration[moving], settings.terms, settings)
        solution = np.linalg.lstsq(x, force[moving], rcond=None)[0]
        misfits.append(float(np.mean((force[moving] - x @ solution) ** 2)))
    best = int(np.argmin(misfits))
    return float(lags[best]) if misfits[best] < _BETTER * misfits[count] else 0.0


def _acceleration_is_noise(signals: FilteredSignals, design: Design) -> bool:
    power = float(np.mean(design.acceleration[design.used] ** 2))
    return power * _LARGEST_NOISE <= signals.acceleration_noise**2


def accelerates(design: Design) -> bool:
    """
    Tell whether the motion determines a lag.

    Parameters
    ----------
    design : Design
        Samples to use.

    Returns
    -------
    bool
        Whether they accelerate by more than the filter leaves of jumps of the speed.

    """
    used = float(np.sqrt(np.mean(design.acceleration[design.used] ** 2)))
    return used > _SMALLEST_ACCELERATION * float(np.max(np.abs(design.acceleration)))


def lag_estimate(
    lag: float, fit: Regression, settings: FrictionSettings, period: float
) -> ParameterEstimate:
    """
    Return the lag with its error, to which the spline between samples adds.

    Parameters
    ----------
    lag : float
        Lag at which the force was fitted [s].
    fit : Regression
        The fit; its last parameter is what is left of the lag.
    settings : FrictionSettings
        The filter.
    period : float
        Sampling period [s].

    Returns
    -------
    ParameterEstimate
        The lag [s].

    """
    spline = _SPLINE_ERROR * period * (settings.cutoff * period) ** 4
    value, low, high = lag + np.array([fit.values[-1], *fit.interval()[-1]])
    half_width = hypot(0.5 * (high - low), float(ndtri(0.975)) * spline)
    return UNKNOWN_LAG.with_value(float(value), hypot(float(fit.errors[-1]), spline), half_width)
