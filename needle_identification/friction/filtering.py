# SPDX-License-Identifier: Apache-2.0
"""
Resample force and motion of a recording and apply a zero-phase low-pass filter.

Force and velocity pass the same low-pass filter of finite length (Hann window), which preserves
linear relations between them. The filter mixes samples from before and after a change, so samples
near a start, a stop or a reversal are left out later; see `design`.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, sqrt
from typing import Final, TYPE_CHECKING

from needle_dynamics.arrays import BoolArray, FloatArray
from needle_identification.errors import IdentificationError
from needle_identification.estimation.rounding import rounding_of_motion
from needle_identification.friction.settings import FrictionSettings
from needle_identification.recordings.recording import Recording
import numpy as np
from scipy.fft import next_fast_len
from scipy.ndimage import maximum_filter1d

if TYPE_CHECKING:
    # Takes a fifth of a second to import; only filtering a recording needs it.
    from scipy.interpolate import BSpline

HALF_LENGTH: Final = 0.36  #: half of a Hann window [periods of its cutoff at half power]
CORRELATION_LENGTH: Final = 3.0  #: of filtered noise [periods of the cutoff]
GAP: Final = 3.5  #: longest step between samples that is not a gap [sampling periods]
_CLEARLY: Final = 5.0  # speed above which the needle moves [standard deviations of the noise]
_SIGNAL: Final = 1.5  # least root mean square of the speed in motion [standard deviations]
_HIDES: Final = 10.0  # largest one that is hidden by noise, likewise
_KEPT: Final = 8.0  # samples per period of the cutoff that are kept after the filter
_LONGER: Final = 3  # hold time at a limit of the sensor over the longest at other values
_MOST_CUT_OFF: Final = 0.5  # largest fraction of samples that may count as saturated
_FEWEST: Final = 6  # samples of a spline of order 5
_LARGEST_GRID: Final = 10.0  # resampled points per sample; more are mostly gaps


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FilteredSignals:
    """Filtered force and motion; arrays have shape (n,)."""

    settings: FrictionSettings
    time: FloatArray  # evenly spaced [s]
    force: FloatArray  # [N]
    depth: FloatArray  # insertion depth [m]
    period: float  # after resampling [s]
    motion: BSpline  # velocity [m/s] as a function of time [s]
    undelayed: tuple[FloatArray, FloatArray]  # velocity [m/s] and acceleration [m/s^2] at `time`
    sign: FloatArray  # of the velocity; with `reversals` filtered as the force
    lost: BoolArray  # in a gap of the recording, or saturated
    half_filter: int  # half the length of the filter [samples]
    margin: int  # reach of a change of the velocity in the force [samples]
    velocity_noise: float  # standard deviation after the filter [m/s]
    acceleration_noise: float  # likewise [m/s^2]
    from_positions: bool  # velocity differentiated from the depth
    cut_off: float  # fraction of samples with a saturated force
    low_pass: float  # time constant of a filter of the force, also applied to the motion [s]

    @property
    def correlation(self) -> int:
        """Correlation length of the filtered noise [samples]."""
        return ceil(CORRELATION_LENGTH / self.settings.cutoff / self.period)

    @property
    def moving_speed(self) -> float:
        return max(self.settings.moving_speed, _CLEARLY * self.velocity_noise)

    @property
    def noise_words(self) -> str:
        return (
            f'noise of {self.velocity_noise:.2g} m/s in the speed hides motion below '
            f'{self.moving_speed:.2g} m/s'
        )

    @property
    def noise_remedy(self) -> str:
        """Words about noise that hides much of the motion, which is more than noise; or none."""
        if not _SIGNAL * self.velocity_noise < self._speed < _HIDES * self.velocity_noise:
            return ''
        return f'; {self.noise_words}: choose a lower cutoff'

    @property
    def is_clear(self) -> bool:
        """Whether noise hides little of the motion."""
        return self._speed >= _HIDES * self.velocity_noise

    @property
    def _speed(self) -> float:
        return float(np.sqrt(np.mean(self.undelayed[0] ** 2)))


def filter_signals(
    recording: Recording, settings: FrictionSettings, low_pass: float = 0.0
) -> FilteredSignals:
    """Filter force and motion, the motion also by a low-pass filter of the force [s]."""
    time = recording.time
    if len(time) < 3:
        raise IdentificationError(f'too short: {len(time)} samples')
    steps = np.diff(time)
    period = float(np.median(steps))
    duration = float(time[-1] - time[0])
    if duration > _LARGEST_GRID * len(time) * period:
        raise IdentificationError(
            f'stamps too uneven: {len(time)} samples in {duration:g} s, most within {period:g} s'
        )
    grid = time[0] + period * np.arange(int(duration / period + 1e-6) + 1)
    lost = steps[np.clip(np.searchsorted(time, grid), 1, len(steps)) - 1] > GAP * period
    cut = cut_off(recording.force)
    lost |= np.interp(grid, time, cut.astype(np.float64)) > 0.0
    # A filter longer than the recording may exceed the memory.
    half = ceil(min(HALF_LENGTH / settings.cutoff / period, len(grid)))
    if len(grid) <= 4 * half:
        raise IdentificationError(
            f'must last > {4.0 * HALF_LENGTH / settings.cutoff:.3g} s for a filter of '
            f'{settings.cutoff:g} Hz, lasts {duration:.3g} s: the cutoff must be above '
            f'{4.0 * HALF_LENGTH / duration:.3g} Hz'
        )
    if len(grid) < _FEWEST:
        raise IdentificationError(f'too short: {len(grid)} periods of {period:.3g} s')
    taps = filter_taps(settings.cutoff, period)
    of_motion = np.convolve(taps, low_pass_taps(low_pass, period)) if low_pass else taps
    step = max(1, int(1.0 / (_KEPT * settings.cutoff * period)))
    from_positions = recording.velocity is None
    measured = recording.depth if recording.velocity is None else recording.velocity
    raw = np.asarray(np.interp(grid, time, measured), dtype=np.float64)
    motion = _filtered_velocity(grid, raw, of_motion, step, from_positions)
    impulse = np.zeros(4 * len(of_motion) + 8 * step + 13)
    impulse[len(impulse) // 2] = 1.0
    around = np.arange(len(impulse), dtype=np.float64) * period
    response = _filtered_velocity(around, impulse, of_motion, 1, from_positions)
    velocity, acceleration = motion(grid), motion(grid, 1)
    noise, sign = _white_noise(raw, velocity, acceleration), np.sign(velocity)
    # Strokes at a whole number of counts per sample show no noise.
    rounding = rounding_of_motion(measured) if from_positions else 0.0
    return FilteredSignals(
        settings=settings,
        time=grid[::step],
        period=step * period,
        motion=motion,
        undelayed=(velocity[::step], acceleration[::step]),
        sign=(_smooth(sign, taps) if settings.reversals else sign)[::step],
        force=_smooth(np.interp(grid, time, recording.force), taps)[::step],
        depth=np.asarray(np.interp(grid[::step], time, recording.depth)),
        lost=np.asarray(maximum_filter1d(lost.astype(np.uint8), step)[::step] > 0),
        half_filter=ceil(half / step),
        margin=max(1, ceil(2 * (half - 1) / step)),
        velocity_noise=max(noise, rounding) * float(np.linalg.norm(response(around))),
        acceleration_noise=noise * float(np.linalg.norm(response(around, 1))),
        from_positions=from_positions,
        cut_off=float(cut.mean()),
        low_pass=low_pass,
    )


def cut_off(force: FloatArray) -> BoolArray:
    """Mark samples, (n,), at the largest or smallest force, if it lasts longer than others."""
    limits = force.max(), force.min()
    found = np.zeros(force.shape, dtype=np.bool_)
    if limits[0] == limits[1]:
        return found
    starts = np.flatnonzero(np.diff(force, prepend=np.nan) != 0.0)
    lengths = np.diff(starts, append=len(force))
    values = force[starts]
    inner = lengths[(values != limits[0]) & (values != limits[1])]
    longest = _LONGER * int(inner.max(initial=1))
    for limit in limits:
        if int(lengths[values == limit].max()) > longest:
            found |= force == limit
    # A nearly constant force is also constant at its extreme values.
    return found if found.mean() < _MOST_CUT_OFF else np.zeros_like(found)


def filter_taps(cutoff: float, period: float) -> FloatArray:
    """Return a Hann window, shape (2 h + 1,), that halves the power at ``cutoff`` [Hz]."""
    half = ceil(HALF_LENGTH / cutoff / period)
    taps = 0.5 + 0.5 * np.cos(np.linspace(-np.pi, np.pi, 2 * half + 1))
    return np.asarray(taps / taps.sum(), dtype=np.float64)


def low_pass_taps(time_constant: float, period: float) -> FloatArray:
    """Return a low-pass filter less its mean delay, exact for linear pieces, (2 h + 1,)."""
    half = ceil(8.0 * time_constant / period)
    since = np.maximum(period * np.arange(-half - 1, half + 2) + time_constant, 0.0)
    taps = np.diff(since + time_constant * np.expm1(-since / time_constant), 2)
    return np.asarray(taps / taps.sum(), dtype=np.float64)


def _smooth(signal: FloatArray, taps: FloatArray) -> FloatArray:
    padded = np.pad(signal, len(taps) // 2, mode='edge')
    size = next_fast_len(len(padded), real=True)
    found = np.fft.irfft(np.fft.rfft(padded, size) * np.fft.rfft(taps, size), size)
    # The first values contain the end of the signal.
    return np.asarray(found[len(taps) - 1 : len(padded)])


def _filtered_velocity(
    time: FloatArray, raw: FloatArray, taps: FloatArray, step: int, from_depth: bool
) -> BSpline:
    from scipy.interpolate import make_interp_spline

    start = raw[0] if from_depth else 0.0
    smooth, kept = _smooth(raw - start, taps), time[::step]
    if from_depth:
        return make_interp_spline(kept, make_interp_spline(time, smooth, k=5)(kept, 1), k=3)
    return make_interp_spline(kept, smooth[::step], k=3)


def _white_noise(raw: FloatArray, velocity: FloatArray, acceleration: FloatArray) -> float:
    """Return a robust estimate of the white noise standard deviation from fourth differences."""
    size = np.abs(acceleration)
    # Large noise dominates the acceleration most of the time.
    unsteady = size > max(0.1 * float(size.max()), 3.0 * float(np.median(size)))
    steady = maximum_filter1d(unsteady.astype(np.uint8), 9) == 0
    steady &= np.abs(velocity) > 0.1 * np.max(np.abs(velocity))
    differences = np.abs(np.diff(raw, 4))[steady[2:-2]]
    # 80th percentile: encoder counts at constant velocity may show no noise in half the strokes.
    # The fourth difference of white noise has 70 times its variance.
    usual = float(np.quantile(differences, 0.8)) if len(differences) else 0.0
    return usual / (1.2816 * sqrt(70.0))
