# SPDX-License-Identifier: Apache-2.0
"""
Identify the errors of a tip sensor from its recording and a true position.

The delay is found first by least squares on a grid, then with bias and noise
(`needle_identification.sensor.noise`). An outlier is a sample that deviates from the median of
eleven samples by more than six robust standard deviations; outliers are left out of the fit.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import permutations
from math import exp, inf, isfinite, log, log10, sqrt
from typing import Final

from needle_dynamics.arrays import BoolArray, FloatArray
from needle_identification.errors import IdentificationError
from needle_identification.estimation.estimate import (
    DisplayedEstimate,
    estimated,
    EstimateRows,
    named,
    ParameterEstimate,
)
from needle_identification.recordings.recording import SensorRecording
from needle_identification.recordings.samples import are_gaps
from needle_identification.sensor.checks import axis_warnings, EXACT, measured_rows
from needle_identification.sensor.noise import (
    binomial_interval,
    fit_losses,
    log_interval,
    NoiseFit,
    NoiseLikelihood,
    RATIOS,
)
from needle_ros.quantities import DEVIATION_OVER_MEDIAN, NORMAL
import numpy as np
from scipy.ndimage import median_filter
from scipy.special import stdtrit

_LEAST: Final = 50  # smallest number of samples
_WINDOW: Final = 11  # samples of a running median
_FAR: Final = 6.0  # deviation of an outlier [robust standard deviations]
_DELAYS: Final = (-0.2, 1.0)  # range of the delay [s]
_GRID: Final = 0.01  # step of the search for the delay [s], short relative to motions
_ALIGNED: Final = 5000  # largest number of samples of this search
_VAGUE: Final = 0.05  # largest error of a determined delay [s]
_CLEAR: Final = 3.0  # smallest motion that determines it [standard deviations of the errors]
_ROUNDS: Final = 20  # largest number of linearizations of the delay
_SETTLED: Final = 1e-7  # change of the delay in the last round [s]

#: Factors of wrong units, and the largest difference of decimal logarithms.
_UNITS: Final = {1e3: '[mm]', 1e2: '[cm]', 1e-3: '[m], with the true position in mm'}
_SIMILAR: Final = 0.3
_EXCHANGED: Final = 5.0  # ratio of residuals above which axes are exchanged
_BIASED: Final = 2e-3  # smallest residual of exchanged axes [m]
_LONG: Final = 20.0  #: Duration of a recording over a correlation time that it determines well.


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class SensorEstimate(DisplayedEstimate):
    """Errors of a tip sensor; ``estimate[name]`` is a parameter."""

    name: str  #: name of the recording
    axes: tuple[str, ...]  #: axes of the biases
    parameters: tuple[ParameterEstimate, ...]  #: noise, biases, delay, losses
    rate: float  #: samples per second, from the median interval [Hz]
    samples: int  #: number of samples
    duration: float  #: time from the first to the last sample [s]
    warnings: tuple[str, ...] = ()  #: warnings about the validity of the values

    def __getitem__(self, name: str) -> ParameterEstimate:
        return named(self.parameters, name)

    def rows(self) -> EstimateRows:
        return ((self.name, one) for one in self.parameters)


def identify_sensor(recording: SensorRecording) -> SensorEstimate:
    """
    Identify noise, correlation time, bias, delay, losses and outliers of a tip sensor.

    Parameters
    ----------
    recording : SensorRecording
        Measured and true positions.

    Returns
    -------
    SensorEstimate
        Parameters with 95 % intervals; slow noise is not determined if it is not significant.

    Raises
    ------
    IdentificationError
        If there are too few samples, or if units or axes do not match.

    """
    kept, lost = measured_rows(recording.tip)
    one = replace(recording, time=recording.time[kept], tip=recording.tip[kept])
    if not one.moves:
        mean = one.true_tip.mean(axis=0, keepdims=True)
        one = replace(one, true_time=one.true_time[:1], true_tip=mean)
    _check_count(one, len(one.time))
    usable = _covered(one)
    _check_count(one, int(np.count_nonzero(usable)))
    delay, time = _aligned(one, usable), one.time[usable]
    errors = one.tip[usable] - _true(one, time - delay)
    for axis, column in zip(one.axes, errors.T, strict=True):
        if np.ptp(column) < EXACT:
            raise IdentificationError(
                f'{one.name}: the error along {axis} does not vary, {column[0]:.3g} m in all '
                'samples: leave this axis out with --axes'
            )
    far = _outliers(errors)
    kept = ~far
    _check_count(one, int(np.count_nonzero(kept)))
    time, tip = time[kept], one.tip[usable][kept]
    fit, delay = _fit(one, time, tip, delay)
    dropout, dropout_time = fit_losses(one.time)
    duration, count = float(time[-1] - time[0]), int(np.count_nonzero(far))
    fraction, error = count / len(far), sqrt(count) / len(far)
    between = binomial_interval(count, len(far))
    outliers = estimated('outliers', 'p_o', '1', fraction, error, between)
    noise = (*_noise(fit), *_biases(one, fit), _delay(one, fit, delay))
    doubts = _warnings(fit, duration, isfinite(dropout.value))
    left = tip - _true(one, time - delay)
    return SensorEstimate(
        name=one.name,
        axes=one.axes,
        parameters=(*noise, outliers, dropout, dropout_time),
        rate=1.0 / float(np.median(np.diff(one.time))),
        samples=len(one.time),
        duration=duration,
        warnings=(*lost, *doubts, *axis_warnings(one.axes, time, tip, left, fit)),
    )


def _check_count(one: SensorRecording, count: int) -> None:
    if count < _LEAST:
        raise IdentificationError(
            f'{one.name}: needs at least {_LEAST} samples of the tip with a true position, got '
            f'{count}'
        )


def _true(one: SensorRecording, time: FloatArray) -> FloatArray:
    columns = [np.interp(time, one.true_time, column) for column in one.true_tip.T]
    return np.column_stack(columns)


def _covered(one: SensorRecording) -> BoolArray:
    if not one.moves:
        return np.ones(len(one.time), dtype=np.bool_)
    times, gaps = one.true_time, are_gaps(np.rint(1e9 * np.diff(one.true_time)).astype(np.int64))
    last, first = one.time - _DELAYS[0], one.time - _DELAYS[1]
    inside = (times[0] <= first) & (last <= times[-1])
    starts, ends = times[:-1][gaps], times[1:][gaps]
    # Gaps that end after the first time and start before the last time.
    return np.asarray(inside & (np.searchsorted(ends, first) == np.searchsorted(starts, last)))


def _aligned(one: SensorRecording, usable: BoolArray) -> float:
    """Return the delay of least errors [s]; reject other units, exchanged or reversed axes."""
    every = -(-int(np.count_nonzero(usable)) // _ALIGNED)
    time, tip, k = one.time[usable][::every], one.tip[usable][::every], len(one.axes)
    delays = np.arange(*_DELAYS, _GRID) if one.moves else np.zeros(1)
    # An offset between the frames of two sensors is a bias, and may be large.
    center = tip.mean(axis=0) if one.moves else np.zeros(k)
    tip = tip - center
    #: Mean square errors by delay, axis, true axis, and sign [m^2].
    squares = np.empty((len(delays), k, k, 2))
    for row, delay in zip(squares, delays.tolist(), strict=True):
        true = _true(one, time - delay)
        true -= true.mean(axis=0) if one.moves else 0.0
        for column, sign in enumerate((1.0, -1.0)):
            apart = tip[:, :, np.newaxis] - sign * true[:, np.newaxis, :]
            row[:, :, column] = np.mean(apart**2, axis=0)
    _check_units(one, tip, true)
    own = np.trace(squares[..., 0], axis1=1, axis2=2)
    smallest, axes = inf, range(k)
    for order in permutations(axes):
        each = squares[:, axes, order]  # by delay, axis and sign
        total = each.min(axis=2).sum(axis=1)
        at = int(np.argmin(total))
        if total[at] < smallest:
            smallest, signs = float(total[at]), each[at].argmin(axis=1)
            names = ', '.join(
                f'{"-" * int(sign)}{one.axes[j]}' for sign, j in zip(signs, order, strict=True)
            )
    found, best = sqrt(float(own.min()) / k), sqrt(smallest / k)
    if found > max(_EXCHANGED * best, _BIASED):
        raise IdentificationError(
            f'{one.name}: measured {", ".join(one.axes)} match the true {names}, to '
            f'{1e3 * best:.3g} mm instead of {1e3 * found:.3g} mm: name the axes in --columns or '
            '--truth-columns'
        )
    return float(delays[int(np.argmin(own))])


def _check_units(one: SensorRecording, tip: FloatArray, true: FloatArray) -> None:
    measured, size = (sqrt(float(np.mean(part**2))) for part in (tip, true))
    for factor, unit in _UNITS.items():
        if min(measured, size) > 0.0 and abs(log10(measured / size / factor)) < _SIMILAR:
            raise IdentificationError(
                f'{one.name}: measured positions are {measured / size:.3g} times the true '
                f'positions: perhaps their unit is {unit}; name it in --columns or '
                '--truth-columns'
            )


def _outliers(errors: FloatArray) -> BoolArray:
    """Return which samples, (n,), deviate from the running median on any axis."""
    apart = np.abs(errors - median_filter(errors, size=(_WINDOW, 1), mode='reflect'))
    # The middle sample may be the median itself.
    scale = np.array([np.median(column[column > 0.0]) if column.any() else inf
                      for column in apart.T])  # fmt: skip
    return np.asarray((apart > _FAR * DEVIATION_OVER_MEDIAN * scale).any(axis=1))


def _fit(
    one: SensorRecording, time: FloatArray, tip: FloatArray, delay: float
) -> tuple[NoiseFit, float]:
    """Fit noise and bias, and the delay if the true position moves."""
    if not one.moves:
        return NoiseLikelihood(time, tip - _true(one, time), None).best(), 0.0
    step = 0.5 * float(np.median(np.diff(one.true_time)))

    def linearized(delay: float) -> NoiseLikelihood:
        at = time - delay
        slopes = (_true(one, at - step) - _true(one, at + step)) / (2.0 * step)
        return NoiseLikelihood(time, tip - _true(one, at), slopes)

    fit = linearized(delay).best()
    for _ in range(_ROUNDS):
        change = float(np.clip(fit.constants[-1], -0.05, 0.05))
        delay += change
        fit = linearized(delay).fit(fit.log_ratio, fit.log_time)
        if abs(change) < _SETTLED:
            break
    return linearized(delay).best(), delay


def _noise(fit: NoiseFit) -> Iterator[ParameterEstimate]:
    """Return the deviations of white and slow noise, and the correlation time."""
    spread, is_slow = fit.spread, fit.log_ratio > -inf
    values = [('noise', 's', 'm', fit.log_noise, spread[0, 0])]
    if is_slow:
        variance = spread[0, 0] + 0.25 * spread[1, 1] + spread[0, 1]
        values += [
            ('slow_noise', 's_s', 'm', fit.log_noise + 0.5 * fit.log_ratio, variance),
            ('slow_time', 'tau', 's', fit.log_time, spread[2, 2]),
        ]
    for name, symbol, unit, logarithm, variance in values:
        value, known = exp(logarithm), isfinite(variance) and variance < 1.0
        interval = log_interval(logarithm, variance) if known else (-inf, inf)
        yield estimated(name, symbol, unit, value, value * sqrt(variance), interval)
    if not is_slow:
        yield ParameterEstimate(name='slow_noise', symbol='s_s', unit='m')
        yield ParameterEstimate(name='slow_time', symbol='tau', unit='s')


def _biases(one: SensorRecording, fit: NoiseFit) -> Iterator[ParameterEstimate]:
    """Return the bias of each axis; slow noise has few independent samples."""
    k = len(one.axes)
    quantile = float(stdtrit(k * max(fit.information - 1.0, 1.0 / k), 0.975))
    for axis, value, variance in zip(
        one.axes, fit.constants.tolist(), np.diag(fit.covariance).tolist(), strict=False
    ):
        error = sqrt(variance)
        interval = value - quantile * error, value + quantile * error
        yield estimated(f'bias_{axis}', f'b_{axis}', 'm', value, error, interval)


def _delay(one: SensorRecording, fit: NoiseFit, delay: float) -> ParameterEstimate:
    if one.moves:
        error = sqrt(float(fit.covariance[-1, -1]))
        low, high = delay - NORMAL * error, delay + NORMAL * error
        noise = exp(fit.log_noise) * sqrt(1.0 + exp(fit.log_ratio))
        clear = sqrt(float(one.true_tip.var(axis=0).mean())) > _CLEAR * noise
        if clear and error < _VAGUE and _DELAYS[0] < low < high < _DELAYS[1]:
            return estimated('delay', 'D', 's', delay, error, (low, high))
    return ParameterEstimate(name='delay', symbol='D', unit='s')


def _warnings(fit: NoiseFit, duration: float, regular: bool) -> Iterator[str]:
    if fit.log_ratio > -inf:
        time = exp(fit.log_time)
        if duration < _LONG * time:
            yield (
                f'the correlation time of {time:.3g} s needs a recording of {_LONG * time:.3g} s '
                f'or more, got {duration:.3g} s: it may be a drift'
            )
        if fit.log_ratio > log(0.5 * RATIOS[1]):
            yield 'no white noise: a filter in the sensor, or a too slow rate, may be the reason'
    if not regular:
        yield 'the samples have no regular period: lost samples cannot be counted'
