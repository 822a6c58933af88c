# SPDX-License-Identifier: Apache-2.0
"""
True parameters of simulated recordings, and the Cramer-Rao bound of their estimates.

The bound uses the noise model of the simulation: white at the rate of the sensor, then filtered,
then sampled at the rate of the recording.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import atan2, pi, sqrt
from typing import Final, TypeAlias

from needle_dynamics import FloatArray, NeedleParameters
from needle_dynamics.simulated.force_sensor import ForceSensorParameters
from needle_dynamics.simulated.indenter import IndenterParameters
from needle_identification import FrictionSettings, StiffnessSettings
from needle_identification.friction.terms import columns_of, NeedleMotion, regressors
import numpy as np
from numpy.typing import NDArray
from reproduction.protocol import DIRECTIONS, HOLD_TIME
from scipy.linalg import solveh_banded
from scipy.signal import butter, sosfilt

#: Samples per second of the recordings [Hz].
RATE: Final = 250.0

#: Number of samples after which readings have independent noise.
_REACH: Final = 24

#: True value and Cramer-Rao bound of the variance by parameter; NaN without a bound.
Truth: TypeAlias = Mapping[str, tuple[float, float]]


def sensor_lag(parameters: ForceSensorParameters) -> float:
    """Return the delay [s] of a slowly varying force by the filters of a sensor."""
    late = 0.0
    for cutoff in parameters.cutoffs:
        b, a = butter(2, cutoff, fs=parameters.rate)
        order = np.arange(3)
        late += float(b @ order / b.sum() - a @ order / a.sum()) / parameters.rate
    return late


def reading_noise(parameters: ForceSensorParameters, axis: int) -> FloatArray:
    """
    Return the autocovariance [N^2] of readings 0, 1, 2, ... samples apart, shape (_REACH,).

    White noise at the rate of the sensor passes its filters, is sampled at `RATE`, and rounded.
    The axes are force x y z, torque x y z.
    """
    every = round(parameters.rate / RATE)
    response = np.zeros(2 * _REACH * every)
    response[0] = parameters.per_axis('noise')[axis]
    for cutoff in parameters.cutoffs:
        response = sosfilt(butter(2, cutoff, fs=parameters.rate, output='sos'), response)
    later = [response[every * k :] for k in range(_REACH)]
    covariance = np.array([response[: len(part)] @ part for part in later])
    covariance[0] += parameters.per_axis('resolution')[axis] ** 2 / 12.0
    return covariance


def information(regressors: FloatArray, noise: FloatArray, used: NDArray[np.bool_]) -> FloatArray:
    """
    Return the Fisher information (k, k) on the coefficients of equidistant regressors (n, k).

    `noise` is the autocovariance of the noise by lag, (m,), zero beyond. The inverse is the
    Cramer-Rao bound for normal noise.
    """
    at = np.flatnonzero(used)
    banded = np.zeros((len(noise), len(at)))
    for row in range(min(len(noise), len(at))):
        apart = at[row:] - at[: len(at) - row]
        near = apart < len(noise)
        banded[row, : len(apart)][near] = noise[apart[near]]
    x = regressors[at]
    return np.asarray(x.T @ solveh_banded(banded, x, lower=True))


def friction_truth(
    needle: NeedleParameters,
    sensor: ForceSensorParameters,
    time: FloatArray,
    speed: FloatArray,
    settings: FrictionSettings,
) -> Truth:
    """
    Return the true parameters of a friction recording, and their Cramer-Rao bounds.

    The bound uses each reading while the needle moves, with the filtered noise of the sensor. Only
    the coefficients of the terms are unknown: losses by starts, stops and an unknown lag are not
    included.
    """
    coulomb, viscous = needle.coulomb_friction, needle.viscous_friction
    breakaway = needle.breakaway_friction if needle.friction_law == 'stribeck' else 1.0
    true = {
        'coulomb_friction': coulomb,
        'viscous_friction': viscous,
        'offset': float(sensor.per_axis('bias')[1]),
        'moving_mass': needle.moving_mass,
        'withdrawal_coulomb': (needle.withdrawal_friction - 1.0) * coulomb,
        'withdrawal_viscous': (needle.withdrawal_friction - 1.0) * viscous,
        'withdrawal_friction': needle.withdrawal_friction,
        'stribeck_friction': (breakaway - 1.0) * coulomb,
        'breakaway_friction': breakaway,
        'breakaway_force': breakaway * coulomb,
        'lag': sensor_lag(sensor) - needle.moving_mass / viscous,
    }
    names = [column.name for column in columns_of(settings.terms, settings)]
    still = np.zeros_like(time)
    accelerated, since = np.gradient(speed, time), time - time[0]
    motion = NeedleMotion(speed, accelerated, since, still, still > 0.0, np.sign(speed))
    known = information(
        regressors(motion, settings.terms, settings),
        reading_noise(sensor, 1),
        np.abs(speed) > settings.moving_speed,
    )
    bound = dict(zip(names, np.diag(np.linalg.inv(known)).tolist(), strict=True))
    # A mass is not distinguishable from an unknown lag.
    bound.pop('moving_mass', None)
    return {name: (value, bound.get(name, np.nan)) for name, value in true.items()}


def stiffness_truth(
    matrix: FloatArray, force: float, sensor: ForceSensorParameters, tissue: IndenterParameters
) -> Truth:
    """
    Return the true parameters of one force level, and their Cramer-Rao bounds.

    The bound uses all readings of force and position of all holds, with their noise. The zeros of
    both are known.
    """
    angles = 2.0 * pi / DIRECTIONS * np.arange(DIRECTIONS)
    forces = force * np.column_stack([np.cos(angles), np.sin(angles)])
    displacement = np.linalg.solve(matrix, forces.T).T
    constant = np.ones((round(RATE * HOLD_TIME), 1))
    held = np.ones(len(constant), dtype=np.bool_)
    of_force = 1.0 / information(constant, reading_noise(sensor, 0), held).item()
    of_position = (tissue.position_noise**2 + tissue.encoder_resolution**2 / 12.0) / len(constant)
    noise = of_force * np.eye(2) + of_position * matrix @ matrix.T
    covariance = np.kron(noise, np.linalg.inv(displacement.T @ displacement))
    true = _parts(matrix)
    # Gradients by central differences, with an error of second order.
    step = 1e-3
    changes = []
    for entry in np.eye(4).reshape(4, 2, 2):
        more, less = _parts(matrix + step * entry), _parts(matrix - step * entry)
        changes.append([(more[name] - less[name]) / (2.0 * step) for name in true])
    gradients = np.array(changes).T
    bounds = np.einsum('ni,ij,nj->n', gradients, covariance, gradients)
    return {
        name: (value, float(bound))
        for (name, value), bound in zip(true.items(), bounds, strict=True)
    }


def _parts(matrix: FloatArray) -> dict[str, float]:
    """Return the parameters of a stiffness matrix by name."""
    symmetric = (matrix + matrix.T) / 2.0
    half, shear = (matrix[0, 0] - matrix[1, 1]) / 2.0, symmetric[0, 1]
    mean, radius = np.trace(matrix) / 2.0, np.hypot(half, shear)
    curl = matrix[1, 0] - matrix[0, 1]
    values = {
        **dict(zip(('k_xx', 'k_xz', 'k_zx', 'k_zz'), matrix.ravel(), strict=True)),
        'curl': curl,
        'spring': abs(curl) / sqrt(2.0) / np.linalg.norm(symmetric),
        'principal_stiffness_1': mean + radius,
        'principal_stiffness_2': mean - radius,
        'principal_angle': atan2(shear, half) / 2.0,
        'tissue_stiffness': matrix[1, 1] / StiffnessSettings().contact_length,
    }
    return {name: float(value) for name, value in values.items()}
