# SPDX-License-Identifier: Apache-2.0
"""
Identify the errors of a tip sensor from its recording and a true position.

Clocks and delay are found first by least squares on a grid
(`needle_identification.sensor.alignment`), then with bias and noise
(`needle_identification.sensor.fitting`). An outlier is a sample that deviates from the median of
eleven samples by more than six robust standard deviations; outliers are left out of the fit.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from math import exp, inf, isfinite, log, sqrt
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
from needle_identification.sensor.alignment import aligned, clock_offset, covered, DELAYS
from needle_identification.sensor.checks import axis_warnings, EXACT, measured_rows
from needle_identification.sensor.fitting import fit_sensor, fit_warnings, SensorFit
from needle_identification.sensor.noise import (
    binomial_interval,
    fit_losses,
    log_interval,
    NoiseFit,
    RATIOS,
)
from needle_identification.sensor.truth import TruePath, unresolved_motion
from needle_ros.quantities import DEVIATION_OVER_MEDIAN, NORMAL
import numpy as np
from scipy.ndimage import median_filter
from scipy.special import stdtrit

_LEAST: Final = 50  # smallest number of samples
_WINDOW: Final = 11  # samples of a running median
_FAR: Final = 6.0  # deviation of an outlier [robust standard deviations]
_VAGUE: Final = 0.05  # largest error of a determined delay [s]
_CLEAR: Final = 3.0  # smallest motion that determines it [standard deviations of the errors]
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
    slow = list(unresolved_motion(one))
    if not one.moves:
        mean = one.true_tip.mean(axis=0, keepdims=True)
        one = replace(one, true_time=one.true_time[:1], true_tip=mean)
    _check_count(one, len(one.time))
    path = TruePath(one)
    usable = covered(one, path)
    if np.count_nonzero(usable) >= _LEAST:
        # Reversed axes would also fit with other clocks.
        aligned(one, path, usable)
    if offset := clock_offset(one, path):
        one = replace(one, true_time=one.true_time + offset)
        path = TruePath(one)
    usable = covered(one, path)
    _check_count(one, int(np.count_nonzero(usable)))
    delay, time = aligned(one, path, usable), one.time[usable]
    errors = one.tip[usable] - path.at(time - delay)
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
    try:
        whole = fit_sensor(path, time, tip, delay)
    except IdentificationError as cause:
        raise IdentificationError(f'{one.name}: {cause}') from None
    fit = whole.noise
    dropout, dropout_time = fit_losses(one.time)
    duration, count = float(time[-1] - time[0]), int(np.count_nonzero(far))
    fraction, error = count / len(far), sqrt(count) / len(far)
    between = binomial_interval(count, len(far))
    outliers = estimated('outliers', 'p_o', '1', fraction, error, between)
    noise = (*_noise(fit), *_biases(one, fit), _delay(one, whole, offset))
    doubts = (
        *fit_warnings(whole, path, one.axes, offset, duration),
        *_warnings(fit, duration, isfinite(dropout.value)),
        *axis_warnings(one.axes, time, tip, whole.left, fit),
    )
    return SensorEstimate(
        name=one.name,
        axes=one.axes,
        parameters=(*noise, outliers, dropout, dropout_time),
        rate=1.0 / float(np.median(np.diff(one.time))),
        samples=len(one.time),
        duration=duration,
        warnings=(*lost, *slow, *doubts),
    )


def _check_count(one: SensorRecording, count: int) -> None:
    if count < _LEAST:
        raise IdentificationError(
            f'{one.name}: needs at least {_LEAST} samples of the tip with a true position, got '
            f'{count}'
        )


def _outliers(errors: FloatArray) -> BoolArray:
    """Return which samples, (n,), deviate from the running median on any axis."""
    apart = np.abs(errors - median_filter(errors, size=(_WINDOW, 1), mode='reflect'))
    # The middle sample may be the median itself.
    scale = np.array([np.median(column[column > 0.0]) if column.any() else inf
                      for column in apart.T])  # fmt: skip
    return np.asarray((apart > _FAR * DEVIATION_OVER_MEDIAN * scale).any(axis=1))


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


def _delay(one: SensorRecording, whole: SensorFit, offset: float) -> ParameterEstimate:
    fit, delay, place = whole.noise, whole.delay, len(one.axes)
    # Different clocks do not reveal a delay.
    if one.moves and not offset and not whole.drift:
        error = sqrt(float(fit.covariance[place, place]))
        low, high = delay - NORMAL * error, delay + NORMAL * error
        noise = exp(fit.log_noise) * sqrt(1.0 + exp(fit.log_ratio))
        clear = sqrt(float(one.true_tip.var(axis=0).mean())) > _CLEAR * noise
        if clear and error < _VAGUE and DELAYS[0] < low < high < DELAYS[1]:
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
