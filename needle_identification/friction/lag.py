# SPDX-License-Identifier: Apache-2.0
"""
Estimate the lag of the force behind the motion by sensor filters or clock offsets.

A lag of 2 ms changes the force of an accelerating needle by more than the error of its friction.
The lag is estimated coarsely in steps of half the filter, then by Gauss-Newton steps; the last
step is part of the friction regression.
"""

from math import hypot, sqrt
from typing import Final

from needle_dynamics.arrays import FloatArray
from needle_identification.estimation.estimate import ParameterEstimate, with_half_width
from needle_identification.estimation.regression import Regression
from needle_identification.friction.design import Design, FEWEST_SAMPLES, select_samples
from needle_identification.friction.filtering import FilteredSignals
from needle_identification.friction.terms import NeedleMotion, regressors
from needle_identification.recordings.recording import Recording
from needle_ros.quantities import NORMAL
import numpy as np

_LARGEST_LAG: Final = 0.25  # largest lag of the coarse search [s]
_BETTER: Final = 0.5  # largest fraction of the misfit that remains with an accepted coarse lag
_MAX_SAMPLES: Final = 1000  # largest number of samples for the coarse search

_MAX_ITERATIONS: Final = 10
_NEAR: Final = 0.05  # step before the last [sampling periods]; the samples depend on the lag
_CONVERGED: Final = 1e-3  # step that needs no other, likewise
_LARGEST_NOISE: Final = 0.1  # largest share of noise in the power of the acceleration

#: Smallest ratio of root mean square and largest acceleration at which the lag is reported.
#: Filter and spline produce smaller accelerations from velocity steps.
_SMALLEST_ACCELERATION: Final = 0.01

#: Error of a lag by the spline at one sample per period of the cutoff [sampling periods].
_SPLINE_ERROR: Final = 10.0

_CERTAIN: Final = 5.0  # smallest delay of a velocity [standard errors]
_DELAY_PARTS: Final = 0.1  # length of the differences that show it [s]
SAME_SCALE: Final = 0.01  #: largest error of the scale of a velocity that is not named

_UNKNOWN: Final = ParameterEstimate(name='lag', symbol='tau', unit='s')


def find_lag(signals: FilteredSignals) -> tuple[float, Design | None]:
    """Return the coarse lag [s] (0: none), and a design near the best lag (None: unknown)."""
    terms = signals.settings.terms
    if 'inertia' in terms:
        # It resembles a lag.
        return 0.0, None
    lag = coarse = _coarse_lag(signals)
    design, is_near = None, False
    for _ in range(_MAX_ITERATIONS):
        design = select_samples(signals, lag, abs(lag))
        if not design.is_enough:
            return coarse, None
        power = float(np.mean(design.acceleration[design.used] ** 2))
        if power * _LARGEST_NOISE <= signals.acceleration_noise**2:
            return coarse, None
        design = design.with_lag_column()
        x, y = design.regressors(terms), signals.force
        x, y = x.take(design.rows, axis=0), y.take(design.rows)
        change = float(np.linalg.lstsq(x, y, rcond=None)[0][-1])
        # The regression includes the last step.
        if is_near or abs(change) < _CONVERGED * signals.period:
            break
        lag, is_near = lag + change, abs(change) < _NEAR * signals.period
        if abs(lag) > 2.0 * _LARGEST_LAG:
            return coarse, None
    return coarse, design


def _coarse_lag(signals: FilteredSignals) -> float:
    """Return the best lag in steps of half the filter [s]; 0 if zero lag fits nearly as well."""
    every = max(1, len(signals.time) // _MAX_SAMPLES)
    count = int(_LARGEST_LAG / (signals.half_filter * signals.period))
    lags = signals.half_filter * np.arange(-count, count + 1)
    misfits = [_misfit(signals, lag, every) for lag in lags.tolist()]
    best = int(np.argmin(misfits))
    if not misfits[best] < _BETTER * misfits[count]:
        return 0.0
    # The subsampled search may miss contradicting samples at the edges of strokes.
    lag = int(lags[best])
    is_better = _misfit(signals, lag, 1) < _BETTER * _misfit(signals, 0, 1)
    return lag * signals.period if is_better else 0.0


def _misfit(signals: FilteredSignals, lag: int, every: int) -> float:
    """Return the mean squared misfit at a lag [samples] of every n-th sample; nan: few move."""
    settings, time, force = signals.settings, signals.time[::every], signals.force[::every]
    then = np.clip(np.arange(-lag, len(signals.time) - lag, every), 0, len(signals.time) - 1)
    delayed = (one.take(then) for one in (*signals.undelayed, signals.depth))
    velocity, acceleration, depth = delayed
    moving = np.abs(velocity) > signals.moving_speed
    if np.count_nonzero(moving) <= FEWEST_SAMPLES:
        return np.nan
    sign, fresh = np.sign(velocity), np.zeros_like(moving)
    motion = NeedleMotion(velocity, acceleration, time - time[0], depth, fresh, sign)
    x = regressors(motion, settings.terms, settings)[moving]
    solution = np.linalg.lstsq(x, force[moving], rcond=None)[0]
    return float(np.mean((force[moving] - x @ solution) ** 2))


def velocity_delay(recording: Recording) -> float:
    """Return the delay of the recorded velocity behind the positions [s]; 0 if not significant."""
    change, travel, depth = _changes(recording)
    # A filter, T v' + v = s', integrates to s - travel = T v; the second column is a scale error.
    delay, error = _first((change, travel), depth - travel)
    period = float(np.median(np.diff(recording.time)))
    return delay if delay > max(period, _CERTAIN * error) else 0.0


def velocity_scale(recording: Recording) -> tuple[float, float] | None:
    """
    Return the ratio of velocity and positions, and its error; None if it may be one.

    It is negative if one of them has the wrong sign.
    """
    change, travel, depth = _changes(recording)
    # Noise of the velocity raises the second ratio, noise of the positions reduces the first.
    (low, error), (inverse, _) = _first((depth, change), travel), _first((travel, change), depth)
    if not low * inverse > 0.0:
        return None
    ratio, error = 0.5 * (low + 1.0 / inverse), hypot(error, 0.5 * (1.0 / inverse - low))
    return (ratio, error) if abs(ratio - 1.0) > max(SAME_SCALE, _CERTAIN * error) else None


def _changes(recording: Recording) -> FloatArray:
    """Return the changes of velocity, its integral and depth over parts, (3, m)."""
    time, velocity = recording.time, recording.velocity
    if velocity is None:
        return np.zeros((3, 0))
    ends = np.searchsorted(time, np.arange(time[0], time[-1], _DELAY_PARTS))
    travel = np.concatenate(
        [[0.0], np.cumsum(0.5 * np.diff(time) * (velocity[1:] + velocity[:-1]))]
    )
    return np.asarray(np.diff(np.stack([velocity, travel, recording.depth])[:, ends]))


def _first(columns: tuple[FloatArray, FloatArray], response: FloatArray) -> tuple[float, float]:
    """Return the first coefficient of a fit of two columns and its error; zeros if unknown."""
    x = np.column_stack(columns)
    gram, free = x.T @ x, len(x) - x.shape[1]
    if free < 1 or np.linalg.matrix_rank(gram) < len(gram):
        return 0.0, 0.0
    values = np.linalg.solve(gram, x.T @ response)
    left = response - x @ values
    error = sqrt(float(left @ left) / free * float(np.linalg.inv(gram)[0, 0]))
    return float(values[0]), error


def lag_estimate(design: Design, fit: Regression) -> ParameterEstimate:
    """Return the lag [s] and its error; undetermined if the needle accelerates only by steps."""
    used = float(np.sqrt(np.mean(design.acceleration[design.used] ** 2)))
    accelerates = used > _SMALLEST_ACCELERATION * float(np.max(np.abs(design.acceleration)))
    if not design.estimates_lag or not accelerates:
        return _UNKNOWN
    period = design.signals.period
    spline = _SPLINE_ERROR * period * (design.signals.settings.cutoff * period) ** 4
    value, low, high = design.lag + np.array([fit.values[-1], *fit.interval()[-1]])
    half_width = hypot(0.5 * (high - low), NORMAL * spline)
    error = hypot(float(fit.errors[-1]), spline)
    return with_half_width(_UNKNOWN, float(value), error, half_width)
