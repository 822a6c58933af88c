# SPDX-License-Identifier: Apache-2.0
"""Force-torque sensor at the base (JR3 in the source): noise, drift, filters, resolution, tare."""

from collections import deque
from dataclasses import dataclass, field, fields
from math import pi, sqrt, tan
from typing import Final

from needle_dynamics.arrays import FloatArray
from needle_dynamics.compiled.force_sensor import sense, straight
from needle_ros.errors import JobError, ParameterError, ShapeError
from needle_ros.settings import check_constants, check_whole, constant, positive
import numpy as np

MOST_FILTERS: Final = 6  #: number of filters of the sensor, in cascade
HIGHEST_RATE: Final = 8000.0  #: highest sample rate of the sensor [Hz]
TARE_TIME: Final = 0.1  #: averaging time of the tare [s]


def low_pass(cutoff: float, rate: float) -> FloatArray:
    """Return a Butterworth low-pass b0 b1 b2 a0 a1 a2; scipy.signal takes 0.6 s to import."""
    warped = tan(pi * cutoff / rate)
    square, damping = warped * warped, sqrt(2.0) * warped
    numerator = square * np.array([1.0, 2.0, 1.0])
    denominator = np.array([1.0 + damping + square, 2.0 * (square - 1.0), 1.0 - damping + square])
    section: FloatArray = np.append(numerator, denominator) / denominator[0]
    return section


@dataclass(frozen=True, slots=True, kw_only=True)
class ForceSensorParameters:
    """Constants of the sensor, one number or three for x y z; zero disables an imperfection."""

    rate: float = positive(
        HIGHEST_RATE, 'Hz', 'samples per second within the sensor', high=HIGHEST_RATE
    )
    filter: int = field(
        default=2,
        metadata={
            'description': 'low-pass filter: 0 none, 1 with a cutoff of rate / 16 (500 Hz), '
            f'the cutoff of each further filter is a quarter, up to {MOST_FILTERS}'
        },
    )
    force_noise: float | tuple[float, ...] = constant(
        (0.05, 0.05, 0.05), 'N', 'standard deviation of the white noise of each sample'
    )
    torque_noise: float | tuple[float, ...] = constant(
        (1.5e-3, 1.5e-3, 1.5e-3), 'N m', 'standard deviation of the white noise of each sample'
    )
    force_bias: float | tuple[float, ...] = constant(
        (0.0, 0.0, 0.0), 'N', 'offset at the start', low=-1e3
    )
    torque_bias: float | tuple[float, ...] = constant(
        (0.0, 0.0, 0.0), 'N m', 'offset at the start', low=-1e2
    )
    force_drift: float | tuple[float, ...] = constant(
        (0.0, 0.0, 0.0), 'N/s^0.5', 'standard deviation of the random walk of the offset in 1 s'
    )
    torque_drift: float | tuple[float, ...] = constant(
        (0.0, 0.0, 0.0), 'N m/s^0.5', 'standard deviation of the random walk of the offset in 1 s'
    )
    force_resolution: float | tuple[float, ...] = constant(
        (0.0025, 0.0025, 0.0025), 'N', 'force per count'
    )
    torque_resolution: float | tuple[float, ...] = constant(
        (1e-4, 1e-4, 1e-4), 'N m', 'torque per count'
    )
    force_range: float | tuple[float, ...] = constant(
        (100.0, 100.0, 100.0), 'N', 'force at which the sensor saturates', open_low=True
    )
    torque_range: float | tuple[float, ...] = constant(
        (5.0, 5.0, 5.0), 'N m', 'torque at which the sensor saturates', open_low=True
    )

    def __post_init__(self) -> None:
        check_constants(self)
        for item in fields(self):
            value = getattr(self, item.name)
            if isinstance(value, tuple) and len(value) != 3:
                raise ParameterError(
                    f'{item.name} must be one number or three, x y z, got {list(value)}'
                )
        check_whole('filter', self.filter, 0, MOST_FILTERS)

    @property
    def cutoffs(self) -> tuple[float, ...]:
        """Cutoff frequencies of the active filters, in cascade order [Hz]."""
        return tuple(self.rate / (16.0 * 4.0**k) for k in range(self.filter))

    def per_axis(self, name: str) -> FloatArray:
        """Return a constant, such as ``noise``, for the forces and torques x y z; shape (6,)."""
        pair = (getattr(self, f'{kind}_{name}') for kind in ('force', 'torque'))
        return np.concatenate([np.broadcast_to(value, 3) for value in pair], dtype=np.float64)


class ForceSensor:
    """Force-torque sensor at the needle base: converts true wrenches to readings."""

    # Offset and noise, of a seed, are added to each internal sample, which then saturates and
    # passes a cascade of second-order Butterworth filters. A reading is the last sample, minus
    # the tare value, rounded to counts.

    _DRAWN = 16384  #: size of a block of random numbers

    def __init__(self, parameters: ForceSensorParameters, rate: float, seed: int) -> None:
        p = parameters
        samples = round(p.rate / rate)
        if samples < 1 or abs(samples * rate - p.rate) > 1e-9 * p.rate:
            fits = max(1.0, HIGHEST_RATE // rate) * rate
            raise ParameterError(
                f'rate of the force sensor must be a whole multiple of {rate:g} Hz, got '
                f'{p.rate:g} Hz; {fits:g} Hz would do'
            )
        self.samples = samples  #: internal samples per reading
        self._wrenches = np.empty((samples, 6))
        self._rng = np.random.default_rng(seed)
        names = ('noise', 'drift', 'range', 'resolution')
        self._constants = np.array([p.per_axis(name) for name in names])
        self._constants[1] /= np.sqrt(rate)
        self._offset = p.per_axis('bias')
        self._zero = np.zeros(6)
        self._sections = np.array([low_pass(cut, p.rate) for cut in p.cutoffs]).reshape(-1, 6)
        self._memory = np.zeros((p.filter, 2, 6))
        self._before: FloatArray | None = None
        # One more row than samples, for the step of the random walk.
        self._block = max(1, self._DRAWN // (6 * (samples + 1))), samples + 1, 6
        self._drawn = np.empty((0, samples + 1, 6))
        self._next = 0
        self._resting: deque[FloatArray] = deque(maxlen=max(1, round(TARE_TIME * rate)))

    def measure(
        self, wrench: FloatArray, *, start: FloatArray | None = None, moving: bool = False
    ) -> FloatArray:
        """Return the next reading, shape (6,): force [N] and torque [N m], x y z each."""
        # ``wrench`` has the mean of each internal sample, shape (samples, 6), or the last sample,
        # shape (6,), with a linear change from the previous reading, or from ``start`` after a
        # jump. A reading of a ``moving`` needle is not used for the tare.
        wrenches = np.array(wrench, dtype=np.float64)
        if wrenches.ndim == 2 and len(wrenches) != self.samples:
            raise ShapeError(
                f'wrench must have shape (6,) or ({self.samples}, 6), got {wrenches.shape}'
            )
        if self._next == len(self._drawn):
            self._drawn = self._rng.standard_normal(self._block)
            self._next = 0
        if self._before is None:
            # Filters start in the steady state of the first sample.
            limit = self._constants[2]
            first = wrenches if wrenches.ndim == 1 else wrenches[0]
            value = np.clip(first + self._offset, -limit, limit)
            b, a = self._sections[:, :3], self._sections[:, 3:]
            self._memory[:, 0] = (1.0 - b[:, :1]) * value
            self._memory[:, 1] = (b[:, 2:] - a[:, 2:]) * value
            self._before = first
        if wrenches.ndim == 1:
            straight(self._before if start is None else start, wrenches, self._wrenches)
            self._before, wrenches = wrenches, self._wrenches
        else:
            self._before = wrenches[-1]
        reading = np.empty(6)
        sense(
            wrenches, self._drawn[self._next], self._constants, self._sections, self._memory,
            self._offset, self._zero, reading,
        )  # fmt: skip
        self._next += 1
        if moving:
            self._resting.clear()
        else:
            self._resting.append(reading)
        return reading

    def tare(self) -> None:
        """Zero on the mean of the last tenth of a second; JobError without readings at rest."""
        found, needed = len(self._resting), self._resting.maxlen
        if found != needed:
            raise JobError(f'{found} of {needed} readings at rest so far')
        self._zero += np.mean(self._resting, axis=0)
        self._resting.clear()
