"""The base force-torque sensor (a JR3 in the source): noise, bias, low-pass filter, counts."""

from __future__ import annotations

from dataclasses import dataclass

from needle_dynamics.errors import ParameterError
from needle_dynamics.kernels import FloatArray
from needle_dynamics.parameters import check_constants, constant
import numpy as np
from scipy.signal import butter


@dataclass(frozen=True, slots=True, kw_only=True)
class ForceSensorParameters:
    """Constants of the sensor; zero switches each imperfection off."""

    force_noise: float = constant(0.02, 'N', 'standard deviation of white force noise')
    torque_noise: float = constant(5e-4, 'N m', 'standard deviation of white torque noise')
    force_bias: float = constant(0.0, 'N', 'constant offset of each force', low=-1e3)
    torque_bias: float = constant(0.0, 'N m', 'constant offset of each torque', low=-1e2)
    force_resolution: float = constant(0.0025, 'N', 'force per count')
    torque_resolution: float = constant(1e-4, 'N m', 'torque per count')
    force_range: float = constant(100.0, 'N', 'force at which the sensor saturates', open_low=True)
    torque_range: float = constant(
        5.0, 'N m', 'torque at which the sensor saturates', open_low=True
    )
    cutoff: float = constant(125.0, 'Hz', 'low-pass filter (Butterworth, second order)')

    def __post_init__(self) -> None:
        check_constants(self)


class ForceSensor:
    """
    Turns true wrenches into what the sensor reports, one sample at a time.

    Parameters
    ----------
    parameters : ForceSensorParameters
        Constants.
    rate : float
        Samples per second [Hz].
    seed : int
        Seed of the noise: the same seed gives the same noise.

    Raises
    ------
    ParameterError
        If the cutoff is not below half the rate.

    """

    _BLOCK = 1024

    def __init__(self, parameters: ForceSensorParameters, rate: float, seed: int) -> None:
        p = parameters
        if p.cutoff >= rate / 2.0:
            raise ParameterError(
                f'cutoff must be < half the sample rate = {rate / 2.0:g} Hz (0 switches the '
                f'filter off), got {p.cutoff:g} Hz'
            )
        self._rng = np.random.default_rng(seed)
        self._noise = np.repeat([p.force_noise, p.torque_noise], 3)
        self._bias = np.repeat([p.force_bias, p.torque_bias], 3)
        self._count = np.repeat([p.force_resolution, p.torque_resolution], 3)
        self._range = np.repeat([p.force_range, p.torque_range], 3)
        self._counts = self._count > 0.0
        self._divisor = np.where(self._counts, self._count, 1.0)
        self._filter = butter(2, p.cutoff, fs=rate) if p.cutoff > 0.0 else None
        self._memory: FloatArray | None = None
        self._drawn = np.empty((0, 6))
        self._next = 0

    def measure(self, wrench: FloatArray) -> FloatArray:
        """
        Return the next reading.

        Parameters
        ----------
        wrench : ndarray, shape (6,)
            True force [N] and torque [N m], x y z each.

        Returns
        -------
        ndarray, shape (6,)
            What the sensor reports.

        """
        if self._next == len(self._drawn):
            self._drawn = self._rng.normal(size=(self._BLOCK, 6)) * self._noise + self._bias
            self._next = 0
        reading = np.clip(wrench + self._drawn[self._next], -self._range, self._range)
        self._next += 1
        if self._filter is not None:
            reading = self._low_pass(reading)
        counted = np.round(reading / self._divisor) * self._divisor
        return np.asarray(np.where(self._counts, counted, reading))

    def _low_pass(self, value: FloatArray) -> FloatArray:
        """Filter in transposed direct form II, started in the steady state of the first value."""
        b, a = self._filter  # type: ignore[misc]
        if self._memory is None:
            self._memory = np.array([(1.0 - b[0]) * value, (b[2] - a[2]) * value])
        result = b[0] * value + self._memory[0]
        self._memory[0] = b[1] * value - a[1] * result + self._memory[1]
        self._memory[1] = b[2] * value - a[2] * result
        return np.asarray(result)
