# SPDX-License-Identifier: Apache-2.0
"""
Select samples and regressors for the friction regression.

The terms with a sign are not linear. Samples whose filter window reaches a start, a stop or a
reversal are therefore left out. An additional regressor accounts for the remaining lag of the
force.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import ceil
from typing import Final

from needle_dynamics.arrays import BoolArray, FloatArray, IntArray
from needle_identification.errors import IdentificationError
from needle_identification.estimation.memory import divided, Parts, stretches
from needle_identification.estimation.regression import independent_span, regress, Regression
from needle_identification.estimation.screening import Screening, Trial
from needle_identification.friction.filtering import FilteredSignals, HALF_LENGTH
from needle_identification.friction.settings import OF_VELOCITY
from needle_identification.friction.terms import columns_of, NeedleMotion, regressors
import numpy as np
from scipy.fft import next_fast_len
from scipy.ndimage import maximum_filter1d, uniform_filter1d

FEWEST_SAMPLES: Final = 10.0  #: smallest number of independent samples in motion
_SETTLING: Final = 3.0  # settling time of the sensor filters after a change [lags of the force]
_SAME_DEPTH: Final = 5e-5  # tolerance of the largest depth [m]: counts, noise, backlash
_EFFECT: Final = 0.05  # smallest fraction of the full size of a term that counts as an effect
_DECAY: Final = 5.0  # settling time of a low-pass filter of the force [time constants]
_STEADY: Final = 10  # correlation lengths of the noise, over which slow motion is averaged
_SURE: Final = 5.0  # smallest mean speed of slow motion [standard errors]
_MUCH: Final = 0.1  # smallest time of hidden motion that is reported [times of used samples]
_LONGEST_SETTLING: Final = 0.1  # largest settling time [s]; a longer lag is a clock offset


@dataclass(frozen=True, kw_only=True, eq=False)
class Design:
    """Motion delayed by the lag of the force, and the samples of the regression, (n,) each."""

    signals: FilteredSignals
    lag: float  # of the force [s]
    velocity: FloatArray  # [m/s], delayed
    acceleration: FloatArray  # [m/s^2], delayed
    depth: FloatArray  # insertion depth [m], delayed
    fresh: BoolArray  # at the largest insertion depth so far
    regime: FloatArray  # sign of the velocity; 0 at rest
    change: BoolArray  # where the regime changes or samples are lost
    used: BoolArray  # samples to use
    stroke: IntArray  # index of the stroke or rest
    lag_column: FloatArray  # (n, 1) derivative of the force by the lag [N/s], or (n, 0)

    @property
    def estimates_lag(self) -> bool:
        return self.lag_column.size > 0

    @property
    def terms(self) -> int:
        """Number of coefficients of the chosen terms."""
        return len(columns_of(self.signals.settings.terms, self.signals.settings))

    @property
    def is_enough(self) -> bool:
        needed = FEWEST_SAMPLES * independent_span(self.signals.correlation)
        return bool(np.count_nonzero(self.used) >= needed)

    @property
    def parts(self) -> Parts:
        """Parts of the used samples with the correlation length of the noise."""
        return divided(self.used, self.signals.correlation)

    @cached_property
    def rows(self) -> IntArray:
        """Indices of the used samples."""
        return np.flatnonzero(self.used)

    @cached_property
    def screening(self) -> Screening:
        """Return the least squares fit of the chosen terms, for additional terms on trial."""
        terms, rows = self.signals.settings.terms, self.rows
        x, noise = self.regressors(terms).take(rows, axis=0), self.column_noise(terms)
        if noise is not None:
            noise = np.pad(noise, ((0, 0), (0, self.lag_column.shape[1])))
        return Screening(x, self.signals.force[rows], self.parts, noise)

    def regressors(self, terms: Sequence[str]) -> FloatArray:
        """Return the regressors of terms and of an estimated lag, shape (n, k)."""
        if terms == self.signals.settings.terms:
            return self._chosen
        return np.column_stack([self.columns(terms), self.lag_column])

    @cached_property
    def _chosen(self) -> FloatArray:
        return np.column_stack([self.columns(self.signals.settings.terms), self.lag_column])

    def columns(self, terms: Sequence[str], later: float = 0.0) -> FloatArray:
        """Return the regressors of terms at an additional lag ``later`` [s], shape (n, k)."""
        signals = self.signals
        velocity, depth = self.velocity, self.depth
        if later:
            velocity, depth = velocity - later * self.acceleration, depth - later * velocity
        time = signals.time - signals.time[0]
        sign = signals.sign if signals.settings.reversals else np.sign(velocity)
        motion = NeedleMotion(velocity, self.acceleration, time, depth, self.fresh, sign)
        return regressors(motion, terms, signals.settings)

    def column_noise(self, terms: Sequence[str]) -> FloatArray | None:
        """Return the change of the used rows by a standard deviation of velocity noise, if any."""
        noise = self.signals.velocity_noise
        if noise == 0.0 or OF_VELOCITY.isdisjoint(terms):
            return None
        less, more = (replace(self, velocity=self.velocity + e) for e in (-noise, noise))
        change = more.columns(terms) - less.columns(terms)
        return np.asarray(0.5 * change.take(self.rows, axis=0))

    def reaches(self, term: str) -> bool:
        """Test whether enough samples lie where a term has an effect."""
        if term == 'cutting':
            # Without motion into old tissue, it is an offset.
            inward = self.used & (self.velocity > 0.0)
            few = min(
                np.count_nonzero(inward & self.fresh), np.count_nonzero(inward & ~self.fresh)
            )
            return bool(few >= self.signals.correlation)
        if term != 'stribeck':
            return True
        # At higher speeds, only velocity noise would support it.
        column = self.columns([term])
        affected = np.count_nonzero(np.abs(column[self.used]) >= _EFFECT)
        return bool(affected >= self.signals.correlation)

    def far_from_changes(self, distance: float) -> Design:
        """Leave out samples within ``distance`` [s] plus the filter of a change of regime."""
        size = 2 * (self.signals.margin + ceil(distance / self.signals.period)) + 1
        near = maximum_filter1d(self.change.astype(np.uint8), size) > 0
        return replace(self, used=self.used & ~near)

    def excess_after_changes(self, time: float, residual: FloatArray) -> float:
        """Return the excess friction in a time [s] from each first used sample, over its error."""
        first = stretches(self.used)[:, :1] + np.arange(max(1, round(time / self.signals.period)))
        column = np.zeros_like(self.regime)
        column[first[self.used.take(first, mode='clip')]] = 1.0
        column *= self.regime
        x = np.where(self.used[:, np.newaxis], self._chosen, 0.0)
        column -= x @ (np.linalg.pinv(x.T @ x, hermitian=True) @ (x.T @ column))
        # The error is the root mean square over all shifts in time.
        size = next_fast_len(len(column), real=True)
        shifted = np.fft.rfft(column, size).conj() * np.fft.rfft(residual, size)
        return float(column @ residual / np.sqrt(np.mean(np.fft.irfft(shifted, size) ** 2)))

    def doubt_at_reversals(self) -> float:
        """Return the p-value of a delayed sign of friction, and of breakaway, at reversals."""
        sign = self.signals.sign
        columns = np.column_stack([np.gradient(sign), sign * (1.0 - sign**2)])
        return self.screening.tried(columns[self.used]).p_value

    def lag_spread(self) -> Trial:
        """Return the variance [s^2] of the lag that the fit lacks."""
        signals, time, used = self.signals, self.signals.time, self.used
        slope = np.linalg.norm(self.lag_column[used]) / np.linalg.norm(self.acceleration[used])
        bend = signals.motion(np.clip(time - self.lag, time[0], time[-1]), 2)[used, np.newaxis]
        shared = None
        if signals.velocity_noise:
            # The noise e of the velocity and its second derivative: E[e e''] = -E[e'^2].
            per_noise = -(signals.acceleration_noise**2) / signals.velocity_noise
            shared = np.full_like(bend, 0.5 * slope * per_noise)
        return self.screening.tried(0.5 * slope * bend, shared)

    def with_lag_column(self) -> Design:
        """Add the derivative of the fitted force by the lag as a regressor."""
        settings, step = self.signals.settings, 0.5 * self.signals.period
        early, now, late = (self.columns(settings.terms, shift) for shift in (-step, 0.0, step))
        x, y = now.take(self.rows, axis=0), self.signals.force.take(self.rows)
        solution = np.linalg.lstsq(x, y, rcond=None)[0]
        column = np.where(self.used, (late - early) @ solution / (2.0 * step), 0.0)
        return replace(self, lag_column=column[:, np.newaxis])

    def solve(self, terms: Sequence[str], estimator: str) -> Regression:
        """Fit terms to the force; the last coefficient is the remaining lag [s], if any."""
        signals = self.signals
        noise_of = {
            'viscous_friction': signals.velocity_noise,
            'moving_mass': signals.acceleration_noise,
        }
        noise = [noise_of.get(column.name, 0.0) for column in columns_of(terms, signals.settings)]
        if self.estimates_lag:
            slope = np.linalg.norm(self.lag_column[self.used])
            slope /= np.linalg.norm(self.acceleration[self.used])
            noise.append(float(slope) * signals.acceleration_noise)
        return regress(
            self.regressors(terms),
            signals.force,
            estimator=estimator,
            correlation=signals.correlation,
            groups=self.stroke,
            regressor_noise=np.array(noise),
            noise_moments=self._noise_moments(terms),
            used=self.used,
            colored=True,
        )

    def _noise_moments(self, terms: Sequence[str]) -> FloatArray | None:
        """Return the squares and products (k, k) of the noise of the velocity, if any."""
        noise = self.column_noise(terms)
        if noise is None:
            return None
        return np.pad(noise.T @ noise, (0, self.lag_column.shape[1]))

    def hidden_words(self) -> str:
        """Return words about slow motion that the noise of the velocity hides, or ''."""
        signals, size = self.signals, self.signals.correlation
        count = len(self.velocity) // size
        if signals.moving_speed <= signals.settings.moving_speed or count <= _STEADY:
            return ''
        parts = self.velocity[: count * size].reshape(count, size).mean(axis=1)
        mean, square = uniform_filter1d(parts, _STEADY), uniform_filter1d(parts**2, _STEADY)
        error = np.sqrt(np.maximum(square - mean**2, 0.0) / (_STEADY - 1))
        # The mean of noise is below a standard deviation of the noise.
        least = max(signals.settings.moving_speed, signals.velocity_noise)
        speed = np.abs(mean)
        hidden = (speed > least) & (speed < signals.moving_speed) & (speed > _SURE * error)
        lasts = np.count_nonzero(hidden) * size * signals.period
        if lasts < _MUCH * len(self.rows) * signals.period:
            return ''
        return (
            f'{lasts:.2g} s of motion are left out: {signals.noise_words}: choose a lower cutoff'
        )

    def _fast_words(self) -> str:
        """Words about an acceleration that leaves out a motion: by noise, counts or stick-slip."""
        limit, moving = self.signals.settings.largest_acceleration, self.regime != 0.0
        fast = np.abs(self.acceleration[moving]) > limit
        if 'inertia' in self.signals.settings.terms or not (self.signals.is_clear and fast.any()):
            return ''
        return (
            f'; {np.count_nonzero(moving) * self.signals.period:.3g} s of motion are not steady, '
            f'with accelerations up to {np.abs(self.acceleration[moving]).max():.2g} m/s^2 '
            f'(largest_acceleration {limit:g}): against noise and counts choose a lower cutoff'
        )

    def check(self) -> None:
        signals = self.signals
        if not self.is_enough:
            needed = FEWEST_SAMPLES * independent_span(signals.correlation) * signals.period
            raise IdentificationError(
                f'steady motion above {signals.settings.moving_speed:g} m/s must last '
                f'{needed:.3g} s in all, lasts '
                f'{np.count_nonzero(self.used) * signals.period:.3g} s: move longer, or choose '
                f'another axis, topic or column{signals.noise_remedy or self._fast_words()}'
            )
        force = signals.force[self.used]
        if np.ptp(force) == 0.0:
            raise IdentificationError(
                f'the force must vary, got {force[0]:g} N throughout: '
                'choose another axis, topic or column'
            )


def select_samples(signals: FilteredSignals, lag: float, settling_lag: float) -> Design:
    """Select samples in steady regimes, after the sensor filters with a lag [s] have settled."""
    settings, time = signals.settings, signals.time
    then = np.clip(time - lag, time[0], time[-1])
    velocity, acceleration = signals.undelayed
    if lag:
        velocity, acceleration = signals.motion(then), signals.motion(then, 1)
    depth = np.interp(then, time, signals.depth)
    regime = np.where(np.abs(velocity) > signals.moving_speed, np.sign(velocity), 0.0)
    change = np.ones(len(velocity), dtype=np.bool_)
    change[1:-1] = signals.lost[1:-1] | (regime[1:-1] != regime[:-2])
    fresh = depth >= np.maximum.accumulate(depth) - _SAME_DEPTH
    if 'cutting' in settings.terms:
        change[1:-1] |= (fresh[1:-1] != fresh[:-2]) & (velocity[1:-1] > 0.0)
    # Sensor and filter settle at the same time; the outer third of the window has little weight.
    settling = max(min(_SETTLING * settling_lag, _LONGEST_SETTLING), _DECAY * signals.low_pass)
    settling -= HALF_LENGTH / settings.cutoff / 1.5
    more = max(0, ceil(settling / signals.period))
    margin = signals.margin + more
    moves, border = regime != 0.0, change
    if settings.reversals:
        turning, begins = _reversals(regime, signals.half_filter)
        moves, border = moves | turning, change & (signals.lost | ~begins)
    used = moves & (time - lag >= time[0])
    used &= time - lag <= time[-1]
    used &= maximum_filter1d(border.astype(np.uint8), 2 * margin + 1) == 0
    if 'inertia' not in settings.terms:
        large = np.abs(acceleration) > settings.largest_acceleration
        size = 2 * (signals.half_filter + more) + 1
        used &= maximum_filter1d(large.astype(np.uint8), size) == 0
    return Design(
        signals=signals,
        lag=lag,
        velocity=velocity,
        acceleration=acceleration,
        depth=depth,
        fresh=fresh,
        regime=regime,
        change=change,
        used=used,
        stroke=np.cumsum(change),
        lag_column=np.empty((len(velocity), 0)),
    )


def _reversals(regime: FloatArray, longest: int) -> tuple[BoolArray, BoolArray]:
    """Mark rests of up to ``longest`` samples within reversals, and the changes of reversals."""
    starts = np.flatnonzero(np.diff(regime, prepend=np.nan) != 0.0)
    ends = np.append(starts[1:], len(regime))
    sign = regime[starts]
    turning, begins = np.zeros((2, len(regime)), dtype=np.bool_)
    begins[starts[1:][sign[1:] * sign[:-1] < 0.0]] = True
    # Between opposite signs is a rest.
    for k in np.flatnonzero(sign[2:] * sign[:-2] < 0.0) + 1:
        if ends[k] - starts[k] <= longest:
            turning[starts[k] : ends[k]] = True
            begins[[starts[k], ends[k]]] = True
    return turning, begins
