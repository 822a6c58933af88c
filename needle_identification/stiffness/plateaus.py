# SPDX-License-Identifier: Apache-2.0
"""
Find plateaus of force and position, holds of presses and rests, by `StiffnessSettings`.

A plateau is the longest interval of steady force and position. Plateaus near the most frequent
force are rests, the others are holds.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil, hypot, inf, pi, sqrt
from typing import Final, NamedTuple

from needle_dynamics.arrays import BoolArray, FloatArray, IntArray
from needle_identification.errors import IdentificationError
from needle_identification.estimation import ESTIMATORS
from needle_identification.estimation.rounding import resolution
from needle_identification.recordings.recording import IndentationRecording
from needle_ros.settings import CheckedSettings, choice, constant, positive
import numpy as np
from numpy.linalg import norm

_BINS: Final = 10.0  # number of bins in the shortest plateau; steadiness is tested on bin means
_GAP: Final = 4  # largest step between bins within a plateau [bins]
_STEADY_MOTION: Final = 0.05  # largest range of positions over their whole range
_STEADY_TREND: Final = 1.0 / 3.0  # of the force over its tolerance; a ramp has 1
_BAND: Final = 12.0  # width of the band that contains noise [standard deviations]
_RAMP: Final = 3.0  # deviation from the middle half of a ramp [standard deviations]
_FEWEST_SAMPLES: Final = 4  # smallest number of samples of a plateau
ROUNDING: Final = 1e-8  #: relative noise below which values differ by rounding


@dataclass(frozen=True, slots=True, kw_only=True)
class StiffnessSettings(CheckedSettings):
    """
    Settings of `identify_stiffness`; fields describe meaning and unit.

    The mean matrices of Table 2 have an asymmetry of up to 0.086, and the paper calls their
    tissue a spring; ``largest_asymmetry`` is the next round number.
    """

    contact_length: float = positive(
        1.0,
        'm',
        'length of tissue that the end-effector presses; 1 m gives the value of the paper',
    )
    level_tolerance: float = positive(
        0.05, 'N', 'forces this close are one level, and steady within it'
    )
    rest_force: float = positive(0.1, 'N', 'force up to which it counts as rest')
    hold_time: float = positive(0.1, 's', 'shortest steady force that counts as a hold or a rest')
    settle_time: float = constant(0.02, 's', 'left out at the beginning of each hold and rest')
    largest_asymmetry: float = constant(
        0.1, '1', 'antisymmetric part over symmetric up to which it counts as a spring'
    )
    estimator: str = choice('ordinary', ESTIMATORS)


class Plateaus(NamedTuple):
    """Steady intervals; channels are force x, z, displacement x, z, and off-plane displacement."""

    time: FloatArray  # (p,) centers [s]
    mean: FloatArray  # (p, 5)
    variance: FloatArray  # (p, 5) of the means
    trend: FloatArray  # (p, 5) change of a fitted line from the first to the last sample
    rounding: FloatArray  # (5,) variance of a mean by the resolution of its channel
    rest: BoolArray  # (p,) whether it is a rest
    missed: int  # presses without a plateau


def find_plateaus(recording: IndentationRecording, settings: StiffnessSettings) -> Plateaus:
    """Return holds and rests in order; raise `IdentificationError` if nothing is steady."""
    time = recording.time
    channels = np.column_stack([recording.force, recording.position, recording.off_plane])
    if len(time) < _FEWEST_SAMPLES:
        raise IdentificationError(f'too short: {len(time)} samples')
    width = max(settings.hold_time / _BINS, float(np.median(np.diff(time))))
    number, first = np.unique(((time - time[0]) / width).astype(np.int64), return_index=True)
    after = np.append(first[1:], len(time))
    means = np.add.reduceat(channels, first) / (after - first)[:, np.newaxis]
    shortest = max(2, ceil((settings.hold_time + settings.settle_time) / width))
    # Second differences of ramps vanish; noise scatters by its standard deviation times root 6.
    bends = np.abs(np.diff(means[:, :2], n=2, axis=0, prepend=means[:1, :2]))
    noise = float(np.median(bends)) / (0.6745 * sqrt(6.0))
    band = max(settings.level_tolerance, _BAND * noise)
    runs, parts = [], []
    for start, length in _steady_runs(number, means[:, :4], band, shortest):
        begin = int(np.searchsorted(time, time[first[start]] + settings.settle_time))
        end = int(after[start + length - 1])
        if end - begin >= _FEWEST_SAMPLES:
            runs.append((start, length))
            parts.append((begin, end))
    if not parts:
        raise IdentificationError(
            f'no force is steady within {settings.level_tolerance:g} N for '
            f'{settings.hold_time:g} s; found neither a hold nor a rest'
        )
    mean = np.array([channels[begin:end].mean(axis=0) for begin, end in parts])
    rest = _rests(mean[:, :2], settings.rest_force)
    middle = np.array([time[begin:end].mean() for begin, end in parts])
    zero = np.column_stack([np.interp(time[first], middle[rest], c) for c in mean[rest, :2].T])
    size = np.hypot(*(means[:, :2] - zero).T)
    pressed = size > max(settings.rest_force, noise)
    in_hold = np.zeros(len(means), dtype=np.bool_)
    for (start, length), is_rest in zip(runs, rest, strict=True):
        in_hold[start : start + length] = not is_rest
    edges = np.flatnonzero(np.diff(np.pad(pressed.astype(np.int8), 1))).reshape(-1, 2)
    # Noise may cross the limit of a rest repeatedly, but not twice the limit or half its band.
    high = size > max(2.0 * settings.rest_force, 0.5 * _BAND * noise)
    missed = sum(high[up:down].any() and not in_hold[up:down].any() for up, down in edges)
    trend = np.array([_line(channels[begin:end]) for begin, end in parts])
    rounding = _rounding(channels, parts)
    return Plateaus(middle, mean, _variances(channels, parts), trend, rounding, rest, missed)


def _rounding(channels: FloatArray, parts: list[tuple[int, int]]) -> FloatArray:
    """Return the variance (c,) of means of rounded values, which noise reduces."""
    steps = np.array([resolution(values) for values in channels.T])
    uniform = steps**2 / 12.0
    measured = np.mean([channels[begin:end].var(axis=0) for begin, end in parts], axis=0)
    # The first harmonic of the error of rounding in normal noise (B. Widrow, I. Kollar, M.-C. Liu,
    # "Statistical theory of quantization", IEEE Trans. Instrum. Meas. 45(2), 1996).
    noise = np.maximum(measured - uniform, 0.0) / np.where(steps > 0.0, steps, 1.0) ** 2
    return np.asarray(uniform * np.exp(-((2.0 * pi) ** 2) * noise))


def _steady_runs(
    number: IntArray, means: FloatArray, band: float, shortest: int
) -> list[tuple[int, int]]:
    """Return (start, length) of the longest steady runs of bins without overlap."""
    if len(means) < shortest:
        return []
    motion = float(np.ptp(means[:, 2:], axis=0).max()) * _STEADY_MOTION
    scaled = means / [band, band, motion or 1.0, motion or 1.0]
    gap = np.concatenate([[0], np.cumsum(np.diff(number) > _GAP)])
    lengths = _steady_lengths(np.column_stack([scaled, 2.0 * gap]))
    taken = np.zeros(len(means), dtype=np.bool_)
    found = []
    for start in np.argsort(-lengths, kind='stable'):
        length = int(lengths[start])
        if length < shortest:
            break
        if taken[start] or taken[start + length - 1]:
            continue
        taken[start : start + length] = True
        # Ends of ramps may add a trend to a hold.
        begin, end = _trimmed(scaled[start : start + length])
        if norm(_line(scaled[start + begin : start + end, :2])) <= _STEADY_TREND:
            found.append((int(start) + begin, end - begin))
    return sorted(found)


def _line(values: FloatArray) -> FloatArray:
    """Return the change of a fitted line (c,) over the rows of values (n, c)."""
    abscissa = np.linspace(-0.5, 0.5, len(values))
    return np.asarray(abscissa @ values / (abscissa @ abscissa))


def _trimmed(values: FloatArray) -> tuple[int, int]:
    """Leave out up to a quarter at both ends that deviates from the middle half."""
    quarter = len(values) // 4
    middle = values[quarter : len(values) - quarter]
    limit = _RAMP * middle.std(axis=0) + ROUNDING
    alike = (np.abs(values - middle.mean(axis=0)) <= limit).all(axis=1)
    alike[quarter : len(values) - quarter] = True
    return int(alike.argmax()), len(values) - int(alike[::-1].argmax())


def _steady_lengths(values: FloatArray) -> IntArray:
    """Return for each row the number of following rows within a range of 1 in all columns."""
    count = len(values)
    # Smallest and largest values over 1, 2, 4, ... rows.
    lows, highs = [values], [values]
    while 2 ** len(lows) <= count:
        half = 2 ** (len(lows) - 1)
        lows.append(np.minimum(lows[-1][:-half], lows[-1][half:]))
        highs.append(np.maximum(highs[-1][:-half], highs[-1][half:]))
    end = np.arange(count)
    low, high = np.full_like(values, inf), np.full_like(values, -inf)
    for power in reversed(range(len(lows))):
        rows = np.flatnonzero(end + 2**power <= count)
        lower = np.minimum(low[rows], lows[power][end[rows]])
        higher = np.maximum(high[rows], highs[power][end[rows]])
        fits = (higher - lower <= 1.0).all(axis=1)
        rows = rows[fits]
        low[rows], high[rows] = lower[fits], higher[fits]
        end[rows] += 2**power
    return np.asarray(end - np.arange(count))


def _rests(force: FloatArray, rest_force: float) -> BoolArray:
    """Mark the plateaus near the most frequent force, tracked as it drifts."""
    apart = np.hypot(*(force[:, np.newaxis] - force).transpose(2, 0, 1))
    visits = np.count_nonzero(apart <= rest_force, axis=1)
    start = min(range(len(force)), key=lambda i: (-visits[i], hypot(*force[i])))
    rest = np.zeros(len(force), dtype=np.bool_)
    for order in (range(start, len(force)), range(start, -1, -1)):
        zero = force[start]
        for i in order:
            if hypot(*(force[i] - zero)) <= rest_force:
                rest[i], zero = True, force[i]
    return rest


def _variances(channels: FloatArray, parts: list[tuple[int, int]]) -> FloatArray:
    """Return the variance of the mean of each part, with a common autocorrelation."""
    # The sum of autocorrelations ends at a lag of five correlation times (A. Sokal, "Monte Carlo
    # methods in statistical mechanics", 1997).
    rows, shapes = [], []
    for begin, end in parts:
        line = np.linspace(-1.0, 1.0, end - begin)
        shape = np.column_stack([np.full_like(line, 1.0 / sqrt(len(line))), line / norm(line)])
        rows.append(channels[begin:end] - shape @ (shape.T @ channels[begin:end]))
        shapes.append(shape)
    counts = np.array([[len(row)] for row in rows])
    products = _autocorrelations(rows, int(counts.max()) // 4 + 1)
    lags = np.arange(len(products))
    # Subtracting mean and trend removed a fraction of the noise at each lag.
    taken = _autocorrelations(shapes, len(lags)).sum(axis=1)
    free = np.maximum(counts.sum() - (2.0 * np.cumsum(taken) - taken[0]), 1.0)
    sums = 2.0 * np.cumsum(products, axis=0) - products[0]
    power = np.where(products[0] > 0.0, products[0] / counts.sum(), inf)
    time = sums / free[:, np.newaxis] / power
    enough = lags[:, np.newaxis] >= 5.0 * time
    enough[-1] = True
    time = np.maximum(np.take_along_axis(time, enough.argmax(axis=0)[np.newaxis], axis=0), 1.0)
    variance = np.array([row.var(axis=0) for row in rows]) * time / counts
    return np.asarray(np.maximum(variance, (ROUNDING * np.abs(channels).max(axis=0) + 1e-15) ** 2))


def _autocorrelations(rows: Sequence[FloatArray], lags: int) -> FloatArray:
    """Sum products of samples by lag over all rows of shape (n, c); shape (lags, c)."""
    products = np.zeros((lags, rows[0].shape[1]))
    for row in rows:
        spectrum = np.fft.rfft(row, 2 * len(row), axis=0)
        found = np.fft.irfft(np.abs(spectrum) ** 2, axis=0)[: min(lags, len(row))]
        products[: len(found)] += found
    return products
