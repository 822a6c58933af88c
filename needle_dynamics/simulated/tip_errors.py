# SPDX-License-Identifier: Apache-2.0
r"""
Errors of a tip sensor beyond white noise: slow noise, losses in bursts, and field distortion.

Slow noise is an Ornstein-Uhlenbeck process, and the state of a burst is a Markov process with two
states. Both decay over an interval h by a factor that is exact for any h [Gillespie1996]_:

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

from dataclasses import dataclass
from math import exp, expm1, pi, sqrt
from typing import Final

from needle_dynamics.arrays import FloatArray
from needle_ros.settings import CheckedSettings, constant, positive
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
