"""The sensor of the tip: a tracker or an imager, exposed, noisy, late, in a frame of its own."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from math import ceil, cos, pi, sin
from typing import NamedTuple

from needle_ros.errors import ParameterError
from needle_ros.settings import check_constants, constant
import numpy as np


@dataclass(frozen=True, slots=True, kw_only=True)
class TipParameters:
    """What sees the tip: a tracker or imager, exposed all the time from one sample to the next."""

    rate: float = constant(0.0, 'Hz', 'samples per second; 0: one with every sample of the plant')
    noise: float = constant(1e-4, 'm', 'standard deviation of a sample')
    delay: float = constant(0.0, 's', 'time from a sample to its message', high=1.0)
    dropout: float = constant(0.0, '1', 'probability that a sample is lost', high=1.0)
    offset: tuple[float, ...] = constant(
        (0.0, 0.0, 0.0), 'm', 'what it says of a tip at the entry point: x, y, z', low=-1.0,
        high=1.0,
    )  # fmt: skip
    turn: float = constant(
        0.0, 'rad', 'angle about y by which its x and z are turned', low=-pi, high=pi
    )
    slice: float = constant(
        0.0, 'm', 'half the thickness of the slice y-z in which an imager sees the tip; it says '
        'x = 0. 0: a tracker',
    )  # fmt: skip

    def __post_init__(self) -> None:
        check_constants(self)
        if len(self.offset) != 3:
            raise ParameterError(f'offset must be three numbers, x y z, got {list(self.offset)}')


class TipReading(NamedTuple):
    """
    A sample of the tip as it leaves its sensor.

    Attributes
    ----------
    age : int
        Samples of the plant since the end of its exposure.
    depth : float
        Inserted length then [m].
    deflection : float
        Mean deflection of the tip along z over the exposure, with noise [m].
    across : float
        The same along x.

    """

    age: int
    depth: float
    deflection: float
    across: float = 0.0

    @property
    def point(self) -> list[float]:
        """Where the tip is, x, y, z [m]."""
        return [self.across, self.depth, self.deflection]


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
    spatial : bool
        Whether it measures all three coordinates, with noise, and averages the depth too. The
        needle of the source bends in one plane: there it is the deflection that is measured.

    Raises
    ------
    ParameterError
        If the sensor is faster than the plant.

    """

    def __init__(
        self, parameters: TipParameters, rate: float, seed: int, *, spatial: bool = False
    ) -> None:
        self._parameters, self._spatial = parameters, spatial
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
        self._losses = np.random.default_rng([seed, 3])
        #: Sums over the exposure of x, depth and z.
        self._sums = [0.0, 0.0, 0.0]
        #: Samples of the plant, and of the sensor.
        self._count = self._taken = 0
        self._waiting: deque[tuple[int, float, float, float]] = deque()

    def measure(self, depth: float, deflection: float, across: float = 0.0) -> TipReading | None:
        """
        Take in a sample of the plant.

        Parameters
        ----------
        depth : float
            Inserted length now [m].
        deflection, across : float
            Mean deflection of the tip since the sample before, along z and along x [m].

        Returns
        -------
        TipReading or None
            What leaves the sensor now.

        """
        self._count += 1
        sums = self._sums
        sums[0] += across
        sums[1] += depth
        sums[2] += deflection
        if self._count >= round(self._taken * self._every + self._every):
            number = self._count - round(self._taken * self._every)
            self._taken += 1
            x, y, z = (value / number for value in sums)
            self._sums = [0.0, 0.0, 0.0]
            self._see(x, y if self._spatial else depth, z)
        if not self._waiting or self._count - self._waiting[0][0] < self._late:
            return None
        taken, x, y, z = self._waiting.popleft()
        return TipReading(age=self._count - taken, depth=y, deflection=z, across=x)

    def _see(self, x: float, y: float, z: float) -> None:
        """Take a sample, in the frame of the sensor, unless it is lost."""
        p = self._parameters
        if p.turn:
            c, s = cos(p.turn), sin(p.turn)
            x, z = c * x - s * z, s * x + c * z
        if any(p.offset):
            x, y, z = x + p.offset[0], y + p.offset[1], z + p.offset[2]
        # What is not in the slice is not seen; that the tip is out of it is seen without noise.
        seen = not p.slice or abs(x) <= p.slice
        if p.noise:
            z += p.noise * float(self._random.standard_normal())
            if self._spatial:
                x += p.noise * float(self._random.standard_normal())
                y += p.noise * float(self._random.standard_normal())
        if p.dropout and self._losses.random() < p.dropout:
            return
        if seen:
            self._waiting.append((self._count, 0.0 if p.slice else x, y, z))
