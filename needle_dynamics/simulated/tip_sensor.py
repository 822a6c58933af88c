# SPDX-License-Identifier: Apache-2.0
r"""
Tip sensor: a tracker or imager with exposure time, noise, delay and its own frame.

Its errors beyond white noise are slow noise, losses in bursts, and field distortion. Slow noise
is an Ornstein-Uhlenbeck process, and the state of a burst is a Markov process with two states.
Both decay over an interval h by a factor that is exact for any h [Gillespie1996]_:

.. math:: x(t + h) = e^{-h / \tau} x(t) + \sigma \sqrt{1 - e^{-2 h / \tau}} \, n, \qquad
   P(t + h) = p + e^{-h / (T (1 - p))} (P(t) - p)

with the fraction p of lost samples and the mean duration T of a burst. The distortion is a sum of
plane waves with random directions, lengths and phases [Shinozuka1972]_: a field that is nearly
Gaussian, with correlation :math:`e^{-r^2 / (2 L^2)}` over a distance r.

References
----------
.. [Gillespie1996] D. T. Gillespie, "Exact numerical simulation of the Ornstein-Uhlenbeck process
   and its integral", Physical Review E 54(2), 1996, doi:10.1103/PhysRevE.54.2084.
.. [Shinozuka1972] M. Shinozuka, C.-M. Jan, "Digital simulation of random processes and its
   applications", Journal of Sound and Vibration 25(1), 1972.

"""

from collections import deque
from dataclasses import dataclass
from math import ceil, cos, exp, expm1, pi, sin, sqrt
from typing import Final, NamedTuple

from needle_dynamics.arrays import FloatArray
from needle_ros.errors import ParameterError
from needle_ros.settings import check_constants, CheckedSettings, constant, positive
import numpy as np
from numpy.typing import ArrayLike

#: Plane waves per axis of a distortion: the excess kurtosis of the field is -1.5 over this number.
_WAVES: Final = 64


@dataclass(frozen=True, slots=True, kw_only=True)
class TipErrorParameters(CheckedSettings):
    """Constants of the errors of a tip sensor beyond white noise."""

    slow_noise: float = constant(
        0.0, 'm', 'standard deviation of the slow noise on each axis, in addition to noise'
    )
    slow_time: float = positive(3.0, 's', 'correlation time of the slow noise')
    dropout: float = constant(0.0, '1', 'probability that a sample is lost', high=1.0)
    dropout_time: float = constant(
        0.0, 's', 'mean duration of a burst of lost samples; 0: losses are independent'
    )
    distortion: float = constant(
        0.0, 'm', 'root mean square of the field distortion on each axis, which is fixed by seed'
    )
    distortion_length: float = positive(0.05, 'm', 'correlation length of the distortion')


class SlowNoise:
    """Ornstein-Uhlenbeck process on several axes, stationary from its start, as ``value`` [m]."""

    def __init__(self, size: float, time: float, random: np.random.Generator, axes: int) -> None:
        self._size, self._time, self._random = size, time, random
        self.value: FloatArray = size * random.standard_normal(axes)

    def advance(self, interval: float) -> None:
        """Advance by an interval [s]."""
        step = interval / self._time
        size = sqrt(-expm1(-2.0 * step)) * self._size
        self.value = exp(-step) * self.value + size * self._random.standard_normal(
            self.value.shape
        )


class BurstLosses:
    """Losses of a fraction of samples, in bursts of a mean duration [s], stationary at first."""

    def __init__(self, fraction: float, time: float, random: np.random.Generator) -> None:
        self._fraction, self._random = fraction, random
        self._decay = time * (1.0 - fraction)  # of the deviation from the fraction [s]
        self._probability = fraction

    def lost(self, interval: float) -> bool:
        """Return whether the sample is lost, an interval [s] after the previous sample."""
        kept = exp(-interval / self._decay) if self._decay else 0.0
        expected = self._fraction + kept * (self._probability - self._fraction)
        lost = bool(self._random.random() < expected)
        self._probability = float(lost)
        return lost


class Distortion:
    """Smooth random vector field with an RMS per axis [m] and a correlation length [m]."""

    def __init__(self, size: float, length: float, random: np.random.Generator) -> None:
        self._waves = random.standard_normal((3, _WAVES, 3)) / length
        self._phases = random.uniform(0.0, 2.0 * pi, (3, _WAVES))
        self._size = sqrt(2.0 / _WAVES) * size

    def error(self, point: ArrayLike) -> FloatArray:
        """Return the error x, y, z [m] at a point x, y, z [m]."""
        waves = np.cos(self._waves @ np.asarray(point) + self._phases)
        return np.asarray(self._size * waves.sum(axis=1))


class TipErrors:
    """Errors of a tip sensor in time and space, independent of its white noise."""

    def __init__(
        self,
        parameters: TipErrorParameters,
        random: np.random.Generator,
        losses: np.random.Generator,
    ) -> None:
        p = parameters
        # ``losses`` gives one number for each sample, lost or not.
        # First, so that the field depends on its own constants and the seed only.
        self._field = Distortion(p.distortion, p.distortion_length, random)
        self._slow = SlowNoise(p.slow_noise, p.slow_time, random, 3)
        self.lost = BurstLosses(p.dropout, p.dropout_time, losses).lost
        self._distorted, self._is_slow = p.distortion > 0.0, p.slow_noise > 0.0

    def shifted(self, x: float, y: float, z: float, interval: float) -> tuple[float, float, float]:
        """Return a position [m] with slow noise and distortion, an interval [s] after the last."""
        if not (self._distorted or self._is_slow):
            return x, y, z
        self._slow.advance(interval)
        shifted = np.array([x, y, z]) + self._slow.value
        if self._distorted:
            shifted += self._field.error((x, y, z))
        x, y, z = shifted.tolist()
        return x, y, z


@dataclass(frozen=True, slots=True, kw_only=True)
class TipParameters(TipErrorParameters):
    """Constants of a tracker or imager of the tip, exposed during the whole sample interval."""

    rate: float = constant(0.0, 'Hz', 'samples per second; 0: rate of the plant')
    noise: float = constant(1e-4, 'm', 'standard deviation of a sample')
    delay: float = constant(0.0, 's', 'time from a sample to its message', high=1.0)
    offset: tuple[float, ...] = constant(
        (0.0, 0.0, 0.0), 'm', 'measurement of a tip at the entry point: x, y, z', low=-1.0,
        high=1.0,
    )  # fmt: skip
    turn: float = constant(
        0.0, 'rad', 'rotation of the measured x and z about y', low=-pi, high=pi
    )
    slice: float = constant(
        0.0,
        'm',
        'half the thickness of the y-z slice of an imager, which reports x = 0. 0: tracker',
    )

    def __post_init__(self) -> None:
        check_constants(self)
        if len(self.offset) != 3:
            raise ParameterError(f'offset must be three numbers, x y z, got {list(self.offset)}')


class TipReading(NamedTuple):
    """Published sample of the tip sensor."""

    age: int  #: plant samples since the end of the exposure
    depth: float  #: insertion depth at that time [m]
    deflection: float  #: mean tip deflection along z over the exposure, with noise [m]
    across: float = 0.0  #: mean tip deflection along x

    @property
    def point(self) -> list[float]:
        """Tip position x, y, z [m]."""
        return [self.across, self.depth, self.deflection]


class TipSensor:
    """Convert mean tip deflections to delayed, noisy measurements."""

    def __init__(
        self, parameters: TipParameters, rate: float, seed: int, *, spatial: bool = False
    ) -> None:
        # A ``spatial`` sensor measures three coordinates with noise and averages the depth,
        # another only the deflection in the plane of the source's needle.
        self._parameters, self._spatial = parameters, spatial
        #: Plant samples per sensor sample; a sensor sample ends at the nearest plant sample.
        self._every = rate / parameters.rate if parameters.rate else 1.0
        if self._every < 1.0 - 1e-9:
            raise ParameterError(
                f'tip.rate must be at most the rate of the plant {rate:g} Hz, got '
                f'{parameters.rate:g} Hz'
            )
        # A message is published with the first plant sample after the delay.
        self._late = ceil(parameters.delay * rate * (1.0 - 1e-9))
        self._shifted = any(parameters.offset)
        self._random = np.random.default_rng([seed, 1])
        self._errors = TipErrors(
            parameters, np.random.default_rng([seed, 4]), np.random.default_rng([seed, 3])
        )
        self._period = 1.0 / rate  # of the plant [s]
        #: Sums over the exposure of x, depth and z.
        self._sums = [0.0, 0.0, 0.0]
        #: Number of samples of the plant and of the sensor.
        self._count = self._taken = 0
        self._waiting: deque[tuple[int, float, float, float]] = deque()

    def measure(self, depth: float, deflection: float, across: float = 0.0) -> TipReading | None:
        """Process depth and mean deflections along z and x [m]; return the reading due now."""
        self._count += 1
        if self._every == 1.0:
            self._take(across, depth, deflection, self._period)
        else:
            self._expose(across, depth, deflection)
        waiting = self._waiting
        if not waiting or self._count - waiting[0][0] < self._late:
            return None
        taken, x, y, z = waiting.popleft()
        return TipReading(self._count - taken, y, z, x)

    def _expose(self, x: float, y: float, z: float) -> None:
        """Add a plant sample to the exposure, and take a sample at the end of the exposure."""
        sums = self._sums
        sums[0] += x
        sums[1] += y
        sums[2] += z
        number = self._count - round(self._taken * self._every)
        if self._count >= round(self._taken * self._every + self._every):
            self._taken += 1
            self._sums = [0.0, 0.0, 0.0]
            mean_depth = sums[1] / number if self._spatial else y
            self._take(sums[0] / number, mean_depth, sums[2] / number, number * self._period)

    def _take(self, x: float, y: float, z: float, interval: float) -> None:
        """Take a sample in the sensor frame an interval after the previous, unless it is lost."""
        p = self._parameters
        if p.turn:
            c, s = cos(p.turn), sin(p.turn)
            x, z = c * x - s * z, s * x + c * z
        if self._shifted:
            x, y, z = x + p.offset[0], y + p.offset[1], z + p.offset[2]
        # A tip outside the slice is not measured; this test is free of errors.
        visible = not p.slice or abs(x) <= p.slice
        if self._spatial:
            x, y, z = self._errors.shifted(x, y, z, interval)
        else:
            z = self._errors.shifted(x, y, z, interval)[2]
        if p.noise:
            draw = self._random.standard_normal
            z += p.noise * draw()
            if self._spatial:
                x += p.noise * draw()
                y += p.noise * draw()
        if not self._errors.lost(interval) and visible:
            self._waiting.append((self._count, 0.0 if p.slice else x, y, z))
