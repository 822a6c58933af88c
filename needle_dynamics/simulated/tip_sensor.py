"""The sensor of the tip: a tracker or an imager, exposed, noisy and late."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from math import ceil

from needle_ros.errors import ParameterError
from needle_ros.settings import check_constants, constant
import numpy as np


@dataclass(frozen=True, slots=True, kw_only=True)
class TipParameters:
    """What sees the tip: a tracker or imager, exposed all the time from one sample to the next."""

    rate: float = constant(0.0, 'Hz', 'samples per second; 0: one with every sample of the plant')
    noise: float = constant(1e-4, 'm', 'standard deviation of a sample')
    delay: float = constant(0.0, 's', 'time from a sample to its message', high=1.0)

    def __post_init__(self) -> None:
        check_constants(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class TipReading:
    """
    A sample of the tip as it leaves its sensor.

    Attributes
    ----------
    age : int
        Samples of the plant since the end of its exposure.
    depth : float
        Inserted length then [m].
    deflection : float
        Mean deflection of the tip over the exposure, with noise [m].

    """

    age: int
    depth: float
    deflection: float


class TipSensor:
    """
    Turns mean deflections of the tip into what its sensor reports, and when.

    Parameters
    ----------
    parameters : TipParameters
        Constants.
    rate : float
        Samples per second of the plant [Hz].
    seed : int
        Seed of the noise.

    Raises
    ------
    ParameterError
        If the sensor is faster than the plant.

    """

    def __init__(self, parameters: TipParameters, rate: float, seed: int) -> None:
        self._noise = parameters.noise
        #: Samples of the plant in one of the sensor; it ends with the nearest one of the plant.
        self._every = rate / parameters.rate if parameters.rate else 1.0
        if self._every < 1.0 - 1e-9:
            raise ParameterError(
                f'tip.rate must be at most the rate of the plant {rate:g} Hz, got '
                f'{parameters.rate:g} Hz'
            )
        # A message leaves with the first sample of the plant that is late enough.
        self._late = ceil(parameters.delay * rate * (1.0 - 1e-9))
        self._random = np.random.default_rng([seed, 1])
        self._sum = 0.0
        #: Samples of the plant, and of the sensor.
        self._count = self._taken = 0
        self._waiting: deque[tuple[int, float, float]] = deque()

    def measure(self, depth: float, deflection: float) -> TipReading | None:
        """
        Take in a sample of the plant.

        Parameters
        ----------
        depth : float
            Inserted length now [m].
        deflection : float
            Mean deflection of the tip since the sample before [m].

        Returns
        -------
        TipReading or None
            What leaves the sensor now.

        """
        self._count += 1
        self._sum += deflection
        if self._count >= round(self._taken * self._every + self._every):
            value = self._sum / (self._count - round(self._taken * self._every))
            self._taken += 1
            if self._noise:
                value += self._noise * float(self._random.standard_normal())
            self._waiting.append((self._count, depth, value))
            self._sum = 0.0
        if not self._waiting or self._count - self._waiting[0][0] < self._late:
            return None
        taken, at, value = self._waiting.popleft()
        return TipReading(age=self._count - taken, depth=at, deflection=value)
