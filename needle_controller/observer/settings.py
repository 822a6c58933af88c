# SPDX-License-Identifier: Apache-2.0
"""Settings of the observer: assumed sensor noise and model uncertainty."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Final

from needle_controller.compiled.filter import LowPass, Noise
from needle_dynamics import FloatArray
from needle_dynamics.simulated.force_sensor import ForceSensorParameters, low_pass
from needle_dynamics.simulated.tip_sensor import TipParameters
from needle_ros.errors import ParameterError
from needle_ros.settings import check_constants, constant, positive
import numpy as np
from scipy.linalg import cholesky, solve_discrete_lyapunov, solve_triangular

_SENSOR: Final = ForceSensorParameters()  #: Default force sensor of the plant, assumed by default.
_SLOWEST: Final = 1e-4  #: Least cutoff over the filter rate: slower filters are singular.


@lru_cache(maxsize=32)
def _low_pass(
    cutoffs: tuple[float, ...], rate: float
) -> tuple[FloatArray, FloatArray, FloatArray, float]:
    """
    Return the low-pass as transition, input and steady state of memory and reading, and its gain.

    The memory is scaled such that white noise of unit variance at the input gives white noise of
    unit variance in the memory.
    """
    a: FloatArray = np.zeros((0, 0))
    b: FloatArray = np.zeros(0)
    c: FloatArray = np.zeros(0)
    d = 1.0
    for cutoff in cutoffs:
        over, under = low_pass(cutoff, rate).reshape(2, 3)
        # Transposed direct form II in series with the previous sections.
        own = np.array([[-under[1], 1.0], [-under[2], 0.0]])
        drive = over[1:] - under[1:] * over[0]
        order = len(b)
        a = np.block([[a, np.zeros((order, 2))], [np.outer(drive, c), own]])
        b = np.concatenate([b, drive * d])
        c, d = np.concatenate([over[0] * c, [1.0, 0.0]]), over[0] * d
    order = len(b)
    if order:
        root = cholesky(solve_discrete_lyapunov(a, np.outer(b, b)), lower=True)
        a, b = (solve_triangular(root, value, lower=True) for value in (a @ root, b))
        c = c @ root
    transition, drive = np.zeros((order + 1, order + 1)), np.append(b, d)
    transition[:order, :order], transition[order, :order] = a, c
    steady = np.linalg.solve(np.eye(order + 1) - transition, drive)
    return transition, drive, steady, float(np.sqrt(c @ c + d * d))


def _of_sensor(name: str, channel: int) -> float:
    return float(_SENSOR.per_axis(name)[channel])


def _read_noise(channel: int, digits: int) -> float:
    """Return the noise of the readings of this sensor, behind its filters."""
    gain = _low_pass(_SENSOR.cutoffs, _SENSOR.rate)[3]
    return round(_of_sensor('noise', channel) * gain, digits)


@dataclass(frozen=True, slots=True, kw_only=True)
class ObserverSettings:
    """Assumed sensors and tissue, beyond `NeedleParameters`; by default those of the plant."""

    irregularity: float = constant(
        1e-3, 'N s^(1/2) m^(-1/2)',
        'root of the spectral density of a distributed lateral force, white in time and depth, '
        'for the model error of the tissue (the default covers a stiffness error of 30 % '
        'down to half the needle)',
    )  # fmt: skip
    initial_deflection: float = positive(
        1e-3, 'm', 'standard deviation of the tip deflection at the start'
    )
    tip_force: float = constant(
        0.5, 'N', 'standard deviation of a lateral force at the tip, such as a bevel load'
    )
    tip_force_time: float = positive(1000.0, 's', 'correlation time of this force')
    tip_noise: float = positive(
        TipParameters().noise, 'm', 'standard deviation of a sample of the tip deflection'
    )
    tip_exposure: float = positive(
        1e-3, 's', 'exposure before the stamp over which a tip sample is the mean'
    )
    tip_latency: float = constant(
        0.0, 's', 'time from the end of the exposure to the stamp of a tip sample', high=1.0
    )
    force_noise: float = positive(
        _read_noise(2, 6), 'N', 'standard deviation of the measured lateral force'
    )
    torque_noise: float = positive(
        _read_noise(3, 8), 'N m', 'standard deviation of the measured moment'
    )
    force_offset: float = constant(
        0.01, 'N', 'standard deviation of the offset of the measured lateral force'
    )
    torque_offset: float = constant(
        1e-3, 'N m', 'standard deviation of the offset of the measured moment'
    )
    offset_time: float = positive(1000.0, 's', 'correlation time of these offsets')
    force_resolution: float = constant(_of_sensor('resolution', 2), 'N', 'force per count')
    torque_resolution: float = constant(_of_sensor('resolution', 3), 'N m', 'torque per count')
    cutoffs: tuple[float, ...] = constant(
        _SENSOR.cutoffs,
        'Hz',
        'low-pass filters of the wrench in series (Butterworth, second order)',
    )
    filter_rate: float = positive(
        _SENSOR.rate, 'Hz', 'sample rate of these filters, with means over the samples as input'
    )
    history: float = positive(
        0.3, 's', 'largest age of a late tip sample; longer gaps restart the observer', high=10.0
    )
    jump: float = positive(5e-3, 'm', 'change of depth between samples that restarts the observer')

    def __post_init__(self) -> None:
        check_constants(self)
        low, high = _SLOWEST * self.filter_rate, 0.5 * self.filter_rate
        if not all(low <= value < high for value in self.cutoffs):
            raise ParameterError(
                f'cutoffs must be in [{low:g}, {high:g}) Hz each, at filter_rate = '
                f'{self.filter_rate:g} Hz, got {self.cutoffs!r}'
            )

    @property
    def sensor_noise(self) -> dict[str, tuple[float, ...]]:
        """Noise of the values of each sensor that the observer uses, by topic."""
        return {
            'base_wrench': (self.force_noise, self.torque_noise),
            'tip_deflection': (self.tip_noise,),
        }

    def noise(self) -> Noise:
        gain = _low_pass(self.cutoffs, self.filter_rate)[3]
        # A count of the reading is uniform rounding.
        counts = self.force_resolution**2 / 12.0, self.torque_resolution**2 / 12.0
        white = (self.force_noise / gain) ** 2, (self.torque_noise / gain) ** 2
        loads = self.tip_force**2, self.force_offset**2, self.torque_offset**2
        decays = 1.0 / self.tip_force_time, 1.0 / self.offset_time, 1.0 / self.offset_time
        density, start = self.irregularity**2, self.initial_deflection**2
        return Noise(density, start, self.tip_noise**2, counts, white, loads, decays)

    def low_pass(self, ticks: int) -> LowPass:
        """Return the low-pass of the wrench over a number of samples of the force sensor."""
        transition, drive, steady, _ = _low_pass(self.cutoffs, self.filter_rate)
        response = np.empty((ticks, len(drive)))
        response[0] = drive
        for tick in range(1, ticks):
            response[tick] = transition @ response[tick - 1]
        noise = np.multiply.outer(self.noise().wrench, response.T @ response)
        whole = np.linalg.matrix_power(transition, ticks)
        return LowPass(ticks, whole, noise, response, steady)
