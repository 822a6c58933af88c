# SPDX-License-Identifier: Apache-2.0
"""Tip sensor: a tracker or imager with exposure time, noise, delay and its own frame."""

from collections import deque
from dataclasses import dataclass
from math import ceil, cos, pi, sin
from typing import NamedTuple

from needle_dynamics.simulated.tip_errors import TipErrorParameters, TipErrors
from needle_ros.errors import ParameterError
from needle_ros.settings import check_constants, constant
import numpy as np


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
