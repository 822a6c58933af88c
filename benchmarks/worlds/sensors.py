# SPDX-License-Identifier: Apache-2.0
"""
Tip sensors with errors beyond white noise: distorted, colored, and lost in bursts.

A sensor is called once at each depth with the position of the tip, and returns an averaged tip
measurement, or None.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import pi, sqrt
from typing import Final, TypeAlias

from needle_dynamics import FloatArray
from needle_dynamics.simulated.tip_sensor import SlowNoise
import numpy as np

#: Sensor as `simulate_steering` takes it.
Sensor: TypeAlias = Callable[[FloatArray], FloatArray | None]

#: Standard deviation of an averaged measurement [m]: 20 readings of 0.18 mm of an electromagnetic
#: tracker, and 12 frames of 0.3 mm of an ultrasound probe (docs/steering.md).
TRACKER: Final = 1.8e-4 / sqrt(20.0)
ULTRASOUND: Final = 3e-4 / sqrt(12.0)

#: Time from one measurement to the next [s].
_INTERVAL: Final = 1.7


@dataclass(slots=True, eq=False)
class WhiteNoise:
    """Measurement with independent errors of a standard deviation along each axis [m]."""

    rng: np.random.Generator
    noise: float = TRACKER

    def __call__(self, tip: FloatArray) -> FloatArray | None:
        return tip + self.noise * self.rng.standard_normal(2)


class Distorted:
    """
    Sensor in a distorted field: its error changes smoothly along the insertion.

    ``size`` is the root mean square of the error along both axes together [m]. The error has two
    waves of 0.06 and 0.12 m and random phases; ``step`` is the distance of the measurements [m].
    """

    def __init__(
        self, of: Sensor, rng: np.random.Generator, size: float = 5e-4, step: float = 5e-3
    ) -> None:
        self._of, self._size, self._step, self._count = of, size, step, 0
        self._phases = rng.uniform(0.0, 2.0 * pi, (2, 2))

    def error(self, depth: float) -> FloatArray:
        """Return the error at a depth [m]."""
        waves = np.array([2.0 * pi / 0.06, 2.0 * pi / 0.12])
        # The mean square of four waves is half of the sum of their squares.
        return np.asarray(
            sqrt(0.5) * self._size * np.sin(waves * depth + self._phases).sum(axis=1)
        )

    def __call__(self, tip: FloatArray) -> FloatArray | None:
        found = self._of(tip + self.error(self._step * self._count))
        self._count += 1
        return found


class Colored:
    """
    Sensor whose error is correlated over seconds, in addition to its white noise.

    Means over 12 frames of public ultrasound recordings spread by 0.2 mm at rest and by 0.2 to
    1.7 mm in motion. The error has a standard deviation along each axis [m], and a correlation
    time [s].
    """

    def __init__(
        self, of: Sensor, rng: np.random.Generator, size: float, time: float = 3.0
    ) -> None:
        self._of, self._error = of, SlowNoise(size, time, rng, axes=2)

    def __call__(self, tip: FloatArray) -> FloatArray | None:
        found = self._of(tip + self._error.value)
        self._error.advance(_INTERVAL)
        return found


class Bursts:
    """
    Sensor that is lost in bursts (a Markov chain), as an ultrasound probe that loses the needle.

    ``begin`` and ``end`` are the probabilities that a burst begins, and ends, from one measurement
    to the next.
    """

    def __init__(
        self, of: Sensor, rng: np.random.Generator, begin: float = 0.15, end: float = 0.6
    ) -> None:
        self._of, self._rng, self._begin, self._end = of, rng, begin, end
        self._lost = False

    def __call__(self, tip: FloatArray) -> FloatArray | None:
        found = self._of(tip)
        change = self._rng.uniform()
        self._lost = change >= self._end if self._lost else change < self._begin
        return None if self._lost else found
