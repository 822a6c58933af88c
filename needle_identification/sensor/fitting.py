# SPDX-License-Identifier: Apache-2.0
"""
Fit bias, delay and noise of a tip sensor, with clocks that drift apart and other scales or axes.

The delay may change linearly with time, and the error linearly with the true position (scale,
rotation). Both are tested in one fit (F tests at 1e-4). They are kept only if they are significant
and large enough to matter. The noise would otherwise include them as slow noise.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from math import acos, degrees, exp, sqrt
from typing import Final, NamedTuple

from needle_dynamics.arrays import FloatArray
from needle_identification.errors import IdentificationError
from needle_identification.sensor.alignment import DELAYS
from needle_identification.sensor.noise import NoiseFit, NoiseLikelihood
from needle_identification.sensor.truth import TruePath
import numpy as np
from numpy.linalg import norm
from scipy.special import fdtrc

_ROUNDS: Final = 20  # largest number of linearizations of the delay
_SETTLED: Final = 1e-7  # change of the delay in the last round [s]
_LARGEST_STEP: Final = 0.05  # of the delay in a round [s]

_CHANCE: Final = 1e-4  # probability of a drift or a linear error by chance
_DRIFT: Final = 2e-3  # smallest drift of the clocks over a recording that counts [s]
_NOTABLE: Final = 0.1  # smallest linear error that counts, over the white noise
_MOVED: Final = 0.1  # smallest motion of a principal direction, over the largest
_SINGULAR: Final = 1e6  # largest condition number of a fit that separates its constants
_AXIS: Final = 0.999  # smallest component of a direction that is called an axis
_SLOW: Final = 2.0  # error of every second row over the noise of a path that is too slow


class _Terms(NamedTuple):
    drift: bool
    linear: bool


@dataclass(frozen=True, kw_only=True, slots=True)
class SensorFit:
    """Noise and constants of a recording."""

    noise: NoiseFit  #: biases, and if the true position moves the delay
    delay: float  #: in the middle of the recording [s]
    drift: float  #: growth of the delay from the first to the last sample [s]
    linear: FloatArray  #: (k, m) error by principal component of the true position [1]
    directions: FloatArray  #: (m, k) of the components
    center: FloatArray  #: (k,) true position of the biases, if the error depends on it [m]
    left: FloatArray  #: (n, k) errors without delay and linear part [m]

    @property
    def has_linear(self) -> bool:
        """Whether the error depends on the true position."""
        return bool(self.linear.any())


class _Fitter:
    """Fits of a recording at times (n,), with positions (n, k)."""

    def __init__(self, path: TruePath, time: FloatArray, tip: FloatArray, delay: float) -> None:
        self._path, self._time, self._tip = path, time, tip
        self._phase = (time - 0.5 * (time[0] + time[-1])) / (time[-1] - time[0])
        true = path.at(time - delay)
        self._center = true.mean(axis=0)
        _, sizes, directions = np.linalg.svd(true - self._center, full_matrices=False)
        moved = directions[sizes > _MOVED * sizes[0]]
        #: All axes, if all of them move.
        self.directions = np.eye(tip.shape[1]) if len(moved) == tip.shape[1] else moved

    def likelihood(self, delay: float, drift: float, terms: _Terms) -> NoiseLikelihood:
        at = self._time - delay - drift * self._phase
        true, slopes = self._path.at(at), self._path.slopes(at)
        shared = [slopes, slopes * self._phase[:, np.newaxis]] if terms.drift else [slopes]
        own = (true - self._center) @ self.directions.T if terms.linear else None
        return NoiseLikelihood(self._time, self._tip - true, np.array(shared), own)

    def fit(self, delay: float, drift: float, terms: _Terms) -> tuple[NoiseFit, float, float]:
        """Linearize the delay until it is settled, for the noise of the first fit."""
        fit, k = self.likelihood(delay, drift, terms).best(), self._tip.shape[1]
        for _ in range(_ROUNDS):
            limits = -_LARGEST_STEP, _LARGEST_STEP
            change = np.clip(fit.constants[k : k + 1 + terms.drift], *limits)
            delay += float(change[0])
            drift += float(change[1]) if terms.drift else 0.0
            fit = self.likelihood(delay, drift, terms).fit(fit.log_ratio, fit.log_time)
            if np.abs(change).max() < _SETTLED:
                break
        return fit, delay, drift

    def tested(self, delay: float) -> tuple[_Terms, float, float]:
        """Return the terms that are significant and notable, delay and drift."""
        both, k = _Terms(drift=True, linear=True), self._tip.shape[1]
        if self.likelihood(delay, 0.0, both).condition() > _SINGULAR:
            both = _Terms(drift=True, linear=False)
        fit, found, drift = self.fit(delay, 0.0, both)
        freedom = max(k * (fit.information - 1.0) - (len(fit.constants) - k), 1.0)
        drifts = abs(drift) > _DRIFT and _is_clear(
            np.array([drift]), fit.covariance[k + 1 : k + 2, k + 1 : k + 2], freedom
        )
        linear = False
        if both.linear:
            constants = fit.constants[k + 2 :]
            true = self._path.at(self._time - found - drift * self._phase) - self._center
            effect = true @ self.directions.T @ constants.reshape(k, -1).T
            linear = sqrt(float(np.mean(effect**2))) > _NOTABLE * exp(fit.log_noise)
            linear = linear and _is_clear(constants, fit.covariance[k + 2 :, k + 2 :], freedom)
        return _Terms(drift=drifts, linear=linear), found, drift

    def final(self, delay: float) -> SensorFit:
        """Fit with the terms that count; without any, as if they had not been tested."""
        terms, found, drift = self.tested(delay)
        k = self._tip.shape[1]
        start = (found, drift if terms.drift else 0.0) if any(terms) else (delay, 0.0)
        _, delay, drift = self.fit(*start, terms)
        fit = self.likelihood(delay, drift, terms).best()
        true = self._path.at(self._time - delay - drift * self._phase)
        linear = np.zeros((k, len(self.directions)))
        if terms.linear:
            linear = fit.constants[k + 1 + terms.drift :].reshape(k, -1)
        part = (true - self._center) @ self.directions.T @ linear.T
        return SensorFit(
            noise=fit,
            delay=delay,
            drift=drift,
            linear=linear,
            directions=self.directions,
            center=self._center,
            left=self._tip - true - part,
        )


def _is_clear(constants: FloatArray, covariance: FloatArray, freedom: float) -> bool:
    """Test whether constants (q,) differ from zero (F test)."""
    count = len(constants)
    value = float(constants @ np.linalg.solve(covariance, constants)) / count
    return float(fdtrc(count, freedom, max(value, 0.0))) < _CHANCE


def fit_sensor(path: TruePath, time: FloatArray, tip: FloatArray, delay: float) -> SensorFit:
    """Fit bias and noise at times (n,) of positions (n, k); if the tip moves, also the delay."""
    if path.moves:
        fitter = _Fitter(path, time, tip, delay)
        alone = _Terms(drift=False, linear=False)
        if fitter.likelihood(delay, 0.0, alone).condition() > _SINGULAR:
            raise IdentificationError(
                'the true position moves at a constant velocity, which does not separate bias '
                'and delay: hold the tip, or reverse the motion'
            )
        return fitter.final(delay)
    left, k = tip - path.at(time), tip.shape[1]
    noise = NoiseLikelihood(time, left, None).best()
    return SensorFit(
        noise=noise,
        delay=0.0,
        drift=0.0,
        linear=np.zeros((k, 0)),
        directions=np.zeros((0, k)),
        center=path.at(time[:1])[0],
        left=left,
    )


def fit_warnings(
    fit: SensorFit, path: TruePath, axes: tuple[str, ...], offset: float, duration: float
) -> Iterator[str]:
    """Warn of different or drifting clocks, linear errors, and a path recorded too slowly."""
    total = offset + fit.delay
    if offset or (path.moves and not DELAYS[0] < fit.delay < DELAYS[1]):
        yield (
            f'the true position fits {abs(total):.3g} s {"later" if total > 0.0 else "earlier"}: '
            'clocks differ, corrected; the delay is unknown'
        )
    if fit.drift:
        yield (
            f'the clock of the tip sensor gains {1e3 * fit.drift:.3g} ms in {duration:.3g} s on '
            'that of the true position, corrected; the delay is unknown'
        )
    if fit.has_linear:
        # The image of a direction is a column of (directions + linear).
        images = fit.directions.T + fit.linear
        place = ', '.join(f'{1e3 * value:.4g}' for value in fit.center)
        words = ', '.join(map(_described, fit.directions, images.T, [axes] * len(images.T)))
        yield (
            f'the error depends on the true position (scale, rotated axes): {words}; not counted '
            f'as noise, and the bias is that at {place} mm'
        )
    missed = path.error_at_half_rate()
    if missed > _SLOW * exp(fit.noise.log_noise):
        yield (
            f'the true position is recorded at {1.0 / path.interval:.3g} Hz, too slowly: each '
            f'second row is off by {1e3 * missed:.2g} mm from the others; record it faster, or '
            'move slower'
        )


def _described(direction: FloatArray, image: FloatArray, axes: tuple[str, ...]) -> str:
    """Describe how a motion along a direction is measured."""
    scale = float(norm(image))
    angle = degrees(acos(min(float(direction @ image) / scale, 1.0)))
    main = int(np.abs(direction).argmax())
    name = axes[main]
    if abs(direction[main]) < _AXIS:
        name = f'({", ".join(f"{value:.2f}" for value in direction)})'
    return (
        f'motion along {name} is measured {scale:.4f} times as long and turned by {angle:.2g} deg'
    )
