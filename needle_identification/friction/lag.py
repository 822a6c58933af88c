"""
The lag of the force behind the motion, by filters of the sensor or by clocks that differ.

A lag of 2 ms changes the force of a needle that accelerates by more than the error of its
friction. The lag is therefore estimated: first coarsely, in steps of half the filter, then by
Gauss-Newton steps; the regression of friction itself takes the last step.
"""

from __future__ import annotations

from math import hypot
from typing import Final

from needle_identification.estimation.estimate import ParameterEstimate
from needle_identification.estimation.regression import Regression
from needle_identification.friction.design import Design, FEWEST_SAMPLES, select_samples
from needle_identification.friction.filtering import FilteredSignals
from needle_identification.friction.terms import Motion, regressors
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

_UNKNOWN: Final = ParameterEstimate(name='lag', symbol='tau', unit='s')


def find_lag(signals: FilteredSignals) -> tuple[float, float | None]:
    """
    Search for the lag of the force.

    Parameters
    ----------
    signals : FilteredSignals
        Filtered force and motion; without the term inertia, which looks like a lag.

    Returns
    -------
    coarse : float
        Lag to half the length of the filter [s]; 0 if no lag fits much better.
    fine : float or None
        Lag of least misfit [s]; None if the motion does not determine it.

    """
    terms = signals.settings.terms
    lag = coarse = _coarse_lag(signals)
    for _ in range(_MAX_ITERATIONS):
        design = select_samples(signals, lag, abs(lag))
        if not design.is_enough or _acceleration_is_noise(design):
            return coarse, None
        design = design.with_lag_column()
        x, used = design.regressors(terms)[design.used], design.used
        change = float(np.linalg.lstsq(x, signals.force[used], rcond=None)[0][-1])
        lag += change
        if abs(lag) > 2.0 * _LARGEST_LAG:
            return coarse, None
        # The fit itself takes the last step.
        if abs(change) < 0.05 * signals.period:
            break
    return coarse, lag


def _coarse_lag(signals: FilteredSignals) -> float:
    """Return the lag, in steps of half the filter, that fits far better than none, else zero."""
    every = max(1, len(signals.time) // _MAX_SAMPLES)
    step = signals.half_filter * signals.period
    count = int(_LARGEST_LAG / step)
    lags = step * np.arange(-count, count + 1)
    misfits = [_misfit(signals, lag, every) for lag in lags.tolist()]
    best = int(np.argmin(misfits))
    if not misfits[best] < _BETTER * misfits[count]:
        return 0.0
    # Few samples may have missed what speaks against it: the edges of the strokes.
    lag = float(lags[best])
    return lag if _misfit(signals, lag, 1) < _BETTER * _misfit(signals, 0.0, 1) else 0.0


def _misfit(signals: FilteredSignals, lag: float, every: int) -> float:
    """Return the mean squared misfit of some of the samples at a lag; nan if too few move."""
    settings, time, force = signals.settings, signals.time[::every], signals.force[::every]
    then = np.clip(time - lag, time[0], time[-1])
    speed, acceleration = signals.motion(then), signals.motion(then, 1)
    moving = np.abs(speed) > signals.moving_speed
    if np.count_nonzero(moving) <= FEWEST_SAMPLES:
        return np.nan
    motion = Motion(
        speed[moving],
        acceleration[moving],
        time[moving] - time[0],
        np.interp(then[moving], signals.time, signals.depth),
        np.zeros(np.count_nonzero(moving), dtype=np.bool_),
    )
    x = regressors(motion, settings.terms, settings)
    solution = np.linalg.lstsq(x, force[moving], rcond=None)[0]
    return float(np.mean((force[moving] - x @ solution) ** 2))


def _acceleration_is_noise(design: Design) -> bool:
    power = float(np.mean(design.acceleration[design.used] ** 2))
    return power * _LARGEST_NOISE <= design.signals.acceleration_noise**2


def lag_estimate(lag: float | None, design: Design, fit: Regression) -> ParameterEstimate:
    """
    Return the lag with its error, to which the spline between samples adds.

    Parameters
    ----------
    lag : float or None
        Lag at which the force was fitted [s].
    design : Design
        The regression.
    fit : Regression
        Its solution; the last parameter is what is left of the lag.

    Returns
    -------
    ParameterEstimate
        The lag [s]; not determined if it was not estimated, or the samples accelerate by no more
        than the filter leaves of jumps of the speed.

    """
    used = float(np.sqrt(np.mean(design.acceleration[design.used] ** 2)))
    accelerates = used > _SMALLEST_ACCELERATION * float(np.max(np.abs(design.acceleration)))
    if lag is None or not design.estimates_lag or not accelerates:
        return _UNKNOWN
    period = design.signals.period
    spline = _SPLINE_ERROR * period * (design.signals.settings.cutoff * period) ** 4
    value, low, high = lag + np.array([fit.values[-1], *fit.interval()[-1]])
    half_width = hypot(0.5 * (high - low), float(ndtri(0.975)) * spline)
    return _UNKNOWN.with_value(float(value), hypot(float(fit.errors[-1]), spline), half_width)
