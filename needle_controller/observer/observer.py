# SPDX-License-Identifier: Apache-2.0
"""
Kalman filter of the bending with the measurements of a robot: encoders, tip deflection, wrench.

The modal rows of (16) are linear for given depth and velocity, which the encoders measure
accurately enough. Over one sample the depth is frozen at its mean and the modal flow is exact, so
that modes far above the sample rate are admissible; sensor readings, means over the sample, are
then linear in the state at its start. The low-pass of the force sensor is part of the state: its
noise enters before the low-pass and is not white behind it.

A constant force at the tip, such as the load of a bevel, and offsets of the sensor are estimated
too.

A late tip sample is processed at its time: the filter keeps a history and repeats the steps from
there. The result equals the result of a filter without late samples.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from math import ceil, inf, isfinite, nan
from operator import index
from typing import Final, NamedTuple

from needle_controller.compiled.filter import (
    begin,
    estimate,
    expose,
    Filter,
    LOADS,
    observe,
    replay,
    SAMPLE,
)
from needle_controller.laws.law import require_complete
from needle_controller.observer.settings import ObserverSettings
from needle_dynamics import FloatArray, InsertionDepthError, NeedleModel, NeedleParameters
from needle_dynamics.model import ROUNDING
from needle_ros.errors import NeedleError, ParameterError, ShapeError
from needle_ros.timing import NANOSECONDS
import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtri

_EVEN: Final = 0.01  #: Relative deviation of encoder stamps from the period that is ignored.
_NEAR: Final = 0.1  #: Relative tolerance of the filter rate as a multiple of the sample rate.
NEAREST: Final = 0.5  #: Largest stamp difference of a wrench and its encoder sample, in periods.
_WAITING: Final = 16  #: Largest number of wrenches that wait for their encoder sample.
_OVERLAP: Final = 0.1  #: Relative overlap of exposures above which a tip sample is a duplicate.
_LARGEST: Final = 1e6  #: Largest plausible measurement; squares of larger ones overflow [SI].


@lru_cache(maxsize=64)
def largest_mean(degrees: int) -> float:
    """Return the mean NIS that is exceeded by chance with a probability of 1e-6."""
    return float(chdtri(degrees, 1e-6)) / degrees


@dataclass(frozen=True, slots=True, kw_only=True)
class Consistency:
    """Consistency of errors with their variances: mean normalized squared error."""

    ratio: float  #: mean squared error over variance per degree of freedom; 1 if consistent
    low: float  #: lower end of the 95 % band of chi^2 for the ratio
    high: float  #: upper end
    degrees: int  #: degrees of freedom; with 0 the ratio is nan

    @classmethod
    def of(cls, total: float, degrees: int) -> Consistency:
        """Compute ratio and band of a sum of NIS, or of NEES with 2 n degrees for each run."""
        if degrees == 0:
            return cls(ratio=nan, low=0.0, high=inf, degrees=0)
        low, high = (float(chdtri(degrees, tail)) / degrees for tail in (0.975, 0.025))
        return cls(ratio=float(total) / degrees, low=low, high=high, degrees=degrees)

    @property
    def doubtful(self) -> bool:
        """Whether the ratio is too large, by chance with a probability of 1e-6."""
        return self.degrees > 0 and self.ratio > largest_mean(self.degrees)

    @property
    def holds(self) -> bool:
        """Whether the ratio is within the band; true without measurements."""
        return self.degrees == 0 or self.low <= self.ratio <= self.high


class _Encoders(NamedTuple):
    """Sample of the encoders: time since the first sample [s], insertion depth, velocity."""

    time: float
    depth: float
    velocity: float


class _Estimate(NamedTuple):
    modal: FloatArray  #: q [m^3/2] and q_dot [m^3/2 / s], shape (2 n,)
    jacobian: FloatArray  #: derivative by the normal coordinates of the filter, shape (2 n, 2 n)
    deflection: float  #: tip deflection [m]
    deviation: float  #: its standard deviation [m]
    load: float  #: force against insertion [N]


class Observer:
    """
    Estimator of q1 to qn and their rates during the motion.

    Depths [m], velocities [m/s] and deflections [m] are floats, stamps integers in ns on one
    clock.

    Parameters
    ----------
    parameters : NeedleParameters
        Nominal parameters of needle and tissue; the formulation is `complete`.
    settings : ObserverSettings
        Noise and sensors.
    period : float
        Sample period of encoders and wrench [s], shorter than the history, and about a whole
        number of samples of the force sensor's filter.

    """

    def __init__(
        self, parameters: NeedleParameters, settings: ObserverSettings, period: float
    ) -> None:
        require_complete(parameters)
        check_period(settings, period)
        ticks = round(settings.filter_rate * period)
        if ticks < 1 or abs(ticks - settings.filter_rate * period) > _NEAR * ticks:
            raise ParameterError(
                f'filter_rate must be a whole multiple of the sample rate {1.0 / period:g} Hz, '
                f'to {100.0 * _NEAR:g} %, got {settings.filter_rate:g} Hz'
            )
        settings = replace(settings, filter_rate=ticks / period)
        self.period, self.settings = float(period), settings
        self.model = NeedleModel(parameters)
        slots = ceil(settings.history / period) + 2
        self._filter = empty_filter(self.model, settings, ticks, slots, 2 * slots)
        from needle_dynamics.compiled.boxed import Boxed

        self._boxed = Boxed(self._filter)
        #: Computed when needed; the load of the newest sample is known without it [N].
        self._estimate: _Estimate | None = None
        self._load: float | None = None
        #: Stamp of the first sample [ns]: times of the filter are relative to it.
        self._origin: int | None = None
        #: Newest and oldest slot of the filter, and number of exposures of the tip.
        self._slot = self._oldest = self._count = 0
        self.reset()
        # Compile or load the kernels before time is critical.
        first = round(self.period * NANOSECONDS)
        self.update(0, parameters.length, 0.0)
        self.update(first, parameters.length, 0.0)
        self.add_tip(first, 0.0)
        self._estimated()
        self._origin = None
        self.reset()

    def reset(self) -> None:
        """Discard all measurements; the next encoder sample restarts the observer."""
        #: Number of rejected samples: late or repeated encoder samples; tip samples and wrenches
        #: that are not finite, repeated, older than the history, or far ahead of the encoders.
        self.refused = 0
        self.restarts = 0  #: Number of automatic restarts.
        self.warning: str | None = None  #: Reason of the last restart.
        self._last: _Encoders | None = None
        self._load = None
        self._waiting: list[tuple[int, float, float]] = []

    # Measurements.

    def update(
        self, stamp: int, depth: float, velocity: float, wrench: tuple[float, float] | None = None
    ) -> None:
        """
        Process a sample of the encoders, and optionally of the base wrench.

        The observer starts at the first sample, without its wrench. Steps within 1 % of the period
        count as one period. A gap is bridged at constant velocity. A gap longer than the history,
        a clock set back by more than the history, or a jump of depth restarts the observer with a
        `warning`. The wrench is the lateral force along z [N] and the moment about x at the base
        [N m], less any torque that turns the base; nan for a missing component. An invalid sample
        raises `ParameterError` or `InsertionDepthError`, and the estimate does not change.
        """
        needle = self._filter.needle
        fastest = needle.length / self.period
        if not (isfinite(depth) and abs(velocity) <= fastest):
            raise ParameterError(
                'depth and velocity must be finite, and the speed at most a needle length in '
                f'a period, {fastest:g} m/s, got {depth!r} and {velocity!r}'
            )
        slack = ROUNDING * needle.length
        if not needle.minimum_depth <= depth <= needle.maximum_depth + slack:
            low = self.model.parameters.minimum_depth
            raise InsertionDepthError(
                f'insertion depth {depth:.6g} m is outside [{low:g}, {needle.maximum_depth:g}] m '
                '(minimum_depth to the hub); the estimate is held'
            )
        if self._origin is None:
            self._origin = _checked(stamp)
        time = self._seconds(stamp)
        # An integer would trigger a compilation for its type.
        sample = _Encoders(time, min(float(depth), needle.maximum_depth), float(velocity))
        history, last = self.settings.history, self._last
        if last is not None:
            if -history <= time - last.time <= 0.0:
                self.refused += 1
                return
            if not 0.0 < time - last.time <= history:
                self._restart(f'encoders went from {last.time:g} to {time:g} s')
            elif abs(sample.depth - last.depth) > self.settings.jump:
                self._restart(f'depth jumped from {last.depth:g} to {sample.depth:g} m')
        if self._last is None:
            self._slot = self._oldest = self._count = 0
            begin(self._boxed, 0, time, self.period, sample.depth)
            self._load = None
        else:
            lateral, moment = wrench or (nan, nan)
            self._advance(self._last, sample, _finite(lateral), _finite(moment))
        self._last, self._estimate = sample, None
        waiting, self._waiting = self._waiting, []
        for earlier, lateral, moment in waiting:
            self.add_wrench(earlier, lateral, moment)

    def _seconds(self, stamp: int) -> float:
        """Return a time relative to the first sample [s]; exact for any epoch of the clock."""
        return (_checked(stamp) - (self._origin or 0)) / NANOSECONDS

    def add_wrench(self, stamp: int, lateral: float, moment: float) -> None:
        """Process a base wrench at a stamp [ns], with the nearest encoder sample."""
        time, lateral, moment = self._seconds(stamp), _finite(lateral), _finite(moment)
        if self._last is None or not (isfinite(lateral) or isfinite(moment)):
            self.refused += 1
            return
        slack = NEAREST * self.period
        if time > self._last.time + slack and len(self._waiting) < _WAITING:
            self._waiting.append((stamp, lateral, moment))
            return
        samples, slot = self._filter.samples, self._slot
        while slot != self._oldest and samples[slot]['time'] > time + slack:
            slot = (slot or len(samples)) - 1
        sample = samples[slot]
        taken = isfinite(sample['lateral']) or isfinite(sample['moment'])
        if slot == self._oldest or abs(sample['time'] - time) > slack or taken:
            self.refused += 1
            return
        sample['lateral'], sample['moment'] = lateral, moment
        self._replay(float(samples[(slot or len(samples)) - 1]['time']))

    def add_tip(self, stamp: int, deflection: float) -> None:
        """
        Process a mean tip deflection [m], with any delay within the history.

        The stamp [ns] is the end of the exposure plus ``tip_latency``. It may be later than the
        last encoder sample, and earlier than previous tip samples.
        """
        end = self._seconds(stamp) - self.settings.tip_latency
        last, history = self._last, self.settings.history
        if last is None or not abs(deflection) <= _LARGEST or end > last.time + history:
            self.refused += 1
            return
        exposure = self.settings.tip_exposure
        start, slack = end - exposure, _OVERLAP * exposure
        slots = self._count, self._oldest, self._slot
        count = expose(self._boxed, *slots, start, end, slack, float(deflection))
        if count < 0:
            self.refused += 1
            return
        self._count = count
        if start < last.time:
            self._estimate = self._load = None

    def _replay(self, since: float) -> None:
        replay(self._boxed, self._count, self._oldest, self._slot, since)
        self._estimate = self._load = None

    def _restart(self, reason: str) -> None:
        self.warning = f'{reason}; the observer restarted'
        self._waiting.clear()
        self.restarts += 1
        self._last = None

    def _advance(self, last: _Encoders, sample: _Encoders, lateral: float, moment: float) -> None:
        """Step to the next sample, or over a gap in steps without measurements but the last."""
        (start, before, _), (time, depth, velocity) = last, sample
        elapsed, advance, period = time - start, depth - before, self.period
        count = max(1, round(elapsed / period))
        span = elapsed / count
        if abs(span - period) < _EVEN * period:
            span = period
        rate = advance / elapsed
        for k in range(1, count):
            ends = before + advance * (k - 1) / count, before + advance * k / count
            self._step(start + elapsed * k / count, span, *ends, rate, rate, nan, nan)
        rates = (last.velocity, velocity) if count == 1 else (rate, rate)
        ends = before + advance * (count - 1) / count, depth
        self._step(time, span, *ends, *rates, lateral, moment)

    def _step(self, *sample: float) -> None:
        """Process a sample, as `observe` from its time on, in a new slot."""
        old, slots = self._slot, len(self._filter.samples)
        self._slot = (old + 1) % slots
        if self._slot == self._oldest:
            self._oldest = (self._oldest + 1) % slots
        self._load = observe(self._boxed, self._count, old, self._slot, *sample)

    # Estimates.

    def _estimated(self) -> _Estimate:
        if self._last is None:
            raise NeedleError('the observer has no estimate before the first encoder sample')
        if self._estimate is None:
            size = 2 * self.model.modes.count
            modal, jacobian = np.zeros(size), np.zeros((size, size))
            depth = self._last.depth
            found = estimate(self._boxed, self._slot, depth, modal, jacobian)
            self._estimate = _Estimate(modal, jacobian, *found)
        return self._estimate

    @property
    def ready(self) -> bool:
        """Whether there is an estimate; without it the properties below raise `NeedleError`."""
        return self._last is not None

    @property
    def modal(self) -> tuple[FloatArray, FloatArray]:
        """Estimate of q1 to qn [m^3/2] and of their rates [m^3/2 / s], shape (n,) each."""
        q, rates = self._estimated().modal.reshape(2, -1).copy()
        return q, rates

    @property
    def covariance(self) -> FloatArray:
        """Covariance of the modal coordinates and their rates, SI units; shape (2 n, 2 n)."""
        jacobian = self._estimated().jacobian
        matrix = jacobian @ self._normal_covariance() @ jacobian.T
        return np.asarray(0.5 * (matrix + matrix.T))

    @property
    def tip_deflection(self) -> tuple[float, float]:
        """Estimate of the present tip deflection, and its standard deviation [m]."""
        now = self._estimated()
        return now.deflection, now.deviation

    @property
    def load(self) -> float:
        """
        Force of the bent needle against insertion [N]: row d of the bias forces (13), reversed.

        Modes above half the sample rate are left out: the estimates of their rates are noise, and
        the load depends on the square of the rates.
        """
        return self._estimated().load if self._load is None else self._load

    @property
    def tip_force(self) -> tuple[float, float]:
        """Estimate of the lateral force at the tip, and its standard deviation [N]."""
        entry = len(self._estimated().modal)
        variance = self._filter.covariances[self._slot, entry, entry]
        return float(self._filter.states[self._slot, entry]), float(np.sqrt(variance))

    @property
    def nis(self) -> Consistency:
        """NIS over the history: innovations relative to all earlier measurements, also late."""
        if self._last is None:
            return Consistency.of(0.0, 0)
        slots, first = len(self._filter.samples), self._oldest
        count = (self._slot - first) % slots + 1
        samples = self._filter.samples[np.arange(first, first + count) % slots]
        return Consistency.of(float(samples['nis'].sum()), round(samples['degrees'].sum()))

    def nees(self, modal: ArrayLike, rates: ArrayLike) -> float:
        """Return NEES of true modal coordinates and rates, (n,) each: chi^2 of 2 n degrees."""
        truth = np.concatenate([np.asarray(modal, dtype=float), np.asarray(rates, dtype=float)])
        estimated = self._estimated()
        if truth.shape != estimated.modal.shape:
            raise ShapeError(
                f'modal and rates must have shape ({self.model.modes.count},) each, got '
                f'{np.shape(modal)} and {np.shape(rates)}'
            )
        # In normal coordinates, where the covariance is well conditioned.
        normal = np.linalg.solve(estimated.jacobian, truth - estimated.modal)
        return float(normal @ np.linalg.solve(self._normal_covariance(), normal))

    def _normal_covariance(self) -> FloatArray:
        modal = 2 * self.model.modes.count
        return self._filter.covariances[self._slot, :modal, :modal]


def check_period(settings: ObserverSettings, period: float) -> None:
    """Raise `ParameterError` if the history is not longer than the sample period [s]."""
    if not 0.0 < period < settings.history:
        raise ParameterError(
            f'period must be > 0 and < history = {settings.history:g} s, got {period!r}'
        )


def empty_filter(
    model: NeedleModel, settings: ObserverSettings, ticks: int, slots: int, exposures: int
) -> Filter:
    """Return a filter; ``ticks`` is the number of samples of the force sensor in its sample."""
    low_pass, n = settings.low_pass(ticks), model.modes.count
    size = 2 * n + LOADS + 2 * len(low_pass.steady) + 1
    return Filter(
        needle=model.compiled,
        noise=settings.noise(),
        low_pass=low_pass,
        samples=np.zeros(slots, SAMPLE),
        states=np.zeros((slots, size)),
        covariances=np.zeros((slots, size, size)),
        transitions=np.zeros((slots, size, size)),
        shapes=np.zeros((slots, n, n)),
        inverses=np.zeros((slots, n, n)),
        squares=np.zeros((slots, n)),
        tips=np.zeros((slots, n)),
        changes=np.zeros((slots, 2 * n, 2 * n)),
        exposures=np.zeros((exposures, 3)),
    )


def _finite(value: float) -> float:
    """Return a plausible measurement, else NaN."""
    return float(value) if abs(value) <= _LARGEST else nan


def _checked(stamp: int) -> int:
    """Return a stamp as an integer: seconds as a float would lose digits of Unix time."""
    try:
        return index(stamp)
    except TypeError:
        raise ParameterError(f'a stamp must be an integer [ns], got {stamp!r}') from None
