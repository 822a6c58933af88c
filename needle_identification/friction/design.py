"""
The regression of friction: which samples it uses, and with which regressors.

The terms with a sign are not linear. Samples whose filter reaches a start, a stop or a reversal
are therefore left out. One more regressor takes up what is left of the lag of the force.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import ceil
from typing import Final

from needle_dynamics.arrays import BoolArray, FloatArray, IntArray
from needle_identification.errors import IdentificationError
from needle_identification.estimation.regression import regress, Regression, window_span
from needle_identification.friction.filtering import FilteredSignals, HALF_LENGTH
from needle_identification.friction.settings import FrictionSettings
from needle_identification.friction.terms import columns_of, regressors
import numpy as np
from scipy.ndimage import maximum_filter1d

#: Correlation windows of motion that a meaningful standard error needs.
FEWEST_WINDOWS: Final = 10.0

#: The needle moves if its speed is at least this many standard deviations of the noise.
_CLEARLY: Final = 5.0

#: Time after a change at which the filters of the sensor have settled too [lags of the force].
_SETTLING: Final = 3.0

#: A longer settling time than this is the lag of a clock [s].
_LONGEST_SETTLING: Final = 0.1


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Design:
    """
    Motion as the force shows it, and the samples that are used.

    Attributes
    ----------
    speed, acceleration : ndarray, shape (n,)
        Speed [m/s] and acceleration [m/s^2], delayed by the lag of the force.
    regime : ndarray, shape (n,)
        Sign of the speed; 0 at rest.
    used : ndarray of bool, shape (n,)
        Samples to use.
    stroke : ndarray of int, shape (n,)
        Number of the stroke or rest of each sample.
    lag_column : ndarray, shape (n, 1) or (n, 0)
        Change of the force with a further lag [N/s]; no column if the lag is not estimated.

    """

    speed: FloatArray
    acceleration: FloatArray
    regime: FloatArray
    used: BoolArray
    stroke: IntArray
    lag_column: FloatArray

    @property
    def estimates_lag(self) -> bool:
        """Whether the regression has a column for the lag."""
        return self.lag_column.size > 0


def moving_threshold(signals: FilteredSignals, settings: FrictionSettings) -> float:
    """
    Return the speed above which the needle counts as moving.

    Parameters
    ----------
    signals : FilteredSignals
        The noise of the speed.
    settings : FrictionSettings
        The smallest threshold.

    Returns
    -------
    float
        Speed [m/s].

    """
    return max(settings.moving_speed, _CLEARLY * signals.speed_noise)


def select_samples(
    signals: FilteredSignals, settings: FrictionSettings, lag: float, settling_lag: float
) -> Design:
    """
    Select samples in steady regimes, farther from changes than the filters reach.

    Parameters
    ----------
    signals : FilteredSignals
        Filtered force and motion.
    settings : FrictionSettings
        Which motion counts.
    lag : float
        Lag of the force [s].
    settling_lag : float
        Lag of the filters of the sensor [s], for which more samples are left out.

    Returns
    -------
    Design
        Without a column for the lag.

    """
    speed, acceleration = signals.delayed_motion(lag)
    moving = np.abs(speed) > moving_threshold(signals, settings)
    regime = np.where(moving, np.sign(speed), 0.0)
    change = np.ones(len(speed), dtype=np.bool_)
    change[1:-1] = signals.lost[1:-1] | (regime[1:-1] != regime[:-2])
    # The sensor settles while the filter does, whose outer third weighs little.
    settling = (
        min(_SETTLING * settling_lag, _LONGEST_SETTLING) - HALF_LENGTH / settings.cutoff / 1.5
    )
    more = max(0, ceil(settling / signals.period))
    margin = signals.margin + more
    used = (regime != 0.0) & (signals.time - lag >= signals.time[0])
    used &= signals.time - lag <= signals.time[-1]
    used &= maximum_filter1d(change.astype(np.uint8), 2 * margin + 1) == 0
    if 'inertia' not in settings.terms:
        large = np.abs(acceleration) > settings.largest_acceleration
        size = 2 * (signals.half_filter + more) + 1
        used &= maximum_filter1d(large.astype(np.uint8), size) == 0
    return Design(
        speed=speed,
        acceleration=acceleration,
        regime=regime,
        used=used,
        stroke=np.cumsum(change),
        lag_column=np.empty((len(speed), 0)),
    )


def with_lag_column(
    signals: FilteredSignals, design: Design, settings: FrictionSettings
) -> Design:
    """
    Add the change of the fitted force with a further lag.

    Parameters
    ----------
    signals : FilteredSignals
        Filtered force and motion.
    design : Design
        Samples to use.
    settings : FrictionSettings
        The terms.

    Returns
    -------
    Design
        With a column for the lag.

    """
    step = 0.5 * signals.period
    early, now, late = (
        regressors(
            design.speed - shift * design.acceleration,
            design.acceleration,
            settings.terms,
            settings,
        )
        for shift in (-step, 0.0, step)
    )
    used = design.used
    solution = np.linalg.lstsq(now[used], signals.force[used], rcond=None)[0]
    column = np.where(used, (late - early) @ solution / (2.0 * step), 0.0)
    return replace(design, lag_column=column[:, np.newaxis])


def solve(
    signals: FilteredSignals,
    design: Design,
    settings: FrictionSettings,
    terms: Sequence[str],
    window: FloatArray,
) -> Regression:
    """
    Fit terms to the force.

    Parameters
    ----------
    signals : FilteredSignals
        Filtered force and motion.
    design : Design
        Samples to use.
    settings : FrictionSettings
        Estimator and constants of the terms.
    terms : sequence of str
        Terms to fit.
    window : ndarray, shape (w,)
        Window that spans the correlation of the noise.

    Returns
    -------
    Regression
        Coefficients of the columns of the terms, then that of the lag if the design has it [s].

    Raises
    ------
    IdentificationError
        If there are too few samples, or the noise of the speed exceeds its variation.

    """
    noise = [
        {'viscous_friction': signals.speed_noise, 'moving_mass': signals.acceleration_noise}.get(
            column.name, 0.0
        )
        for column in columns_of(terms)
    ]
    if design.estimates_lag:
        slope = np.linalg.norm(design.lag_column[design.used])
        slope /= np.linalg.norm(design.acceleration[design.used])
        noise.append(float(slope) * signals.acceleration_noise)
    columns = regressors(design.speed, design.acceleration, terms, settings)
    return regress(
        np.column_stack([columns, design.lag_column]),
        signals.force,
        estimator=settings.estimator,
        window=window,
        groups=design.stroke,
        noisy=np.array(noise) > 0.0,
        regressor_noise=np.array(noise),
        used=design.used,
    )


def is_enough(design: Design, window: FloatArray) -> bool:
    """
    Tell whether a design has enough samples for standard errors.

    Parameters
    ----------
    design : Design
        Samples to use.
    window : ndarray, shape (w,)
        Window that spans the correlation of the noise.

    Returns
    -------
    bool
        Whether the samples span `FEWEST_WINDOWS` windows.

    """
    return bool(np.count_nonzero(design.used) >= FEWEST_WINDOWS * window_span(window))


def check_motion(
    signals: FilteredSignals, design: Design, settings: FrictionSettings, window: FloatArray
) -> None:
    """
    Reject a recording with too little motion or without force.

    Parameters
    ----------
    signals : FilteredSignals
        Filtered force and motion.
    design : Design
        Samples to use.
    settings : FrictionSettings
        Which motion counts.
    window : ndarray, shape (w,)
        Window that spans the correlation of the noise.

    Raises
    ------
    IdentificationError
        If the motion is too short, or the force is constant.

    """
    if not is_enough(design, window):
        samples = int(np.count_nonzero(design.used))
        raise IdentificationError(
            f'steady motion above {settings.moving_speed:g} m/s must last '
            f'{FEWEST_WINDOWS * window_span(window) * signals.period:.3g} s in all, lasts '
            f'{samples * signals.period:.3g} s: move longer, or choose another axis or topic'
        )
    force = signals.force[design.used]
    if np.ptp(force) == 0.0:
        raise IdentificationError(
            f'the force must vary, got {force[0]:g} N throughout: choose another axis or topic'
        )
