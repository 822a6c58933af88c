# SPDX-License-Identifier: Apache-2.0
r"""
Estimate friction online by recursive least squares with exponential forgetting.

The information :math:`A = \sum \lambda^{age} x x^T`, :math:`b = \sum \lambda^{age} x f` of the
samples in steady motion is updated; the estimate is the weighted least squares solution over all
of them. Force and velocity pass the filter of `identify_friction`, delayed by half its length,
with the same sample selection. The acceleration is an additional regressor that accounts for a lag
of the force.
"""

from collections import Counter, deque
from itertools import pairwise
from math import ceil, exp, inf, isfinite, nan
from statistics import median
from typing import Final

from needle_dynamics.arrays import FloatArray
from needle_identification.estimation.estimate import ParameterEstimate
from needle_identification.estimation.regression import determinable, Regression
from needle_identification.friction.filtering import CORRELATION_LENGTH, filter_taps, GAP
from needle_identification.friction.intervals import parameter_estimates
from needle_identification.friction.settings import AUTO, FrictionSettings
from needle_identification.friction.terms import columns_of, NeedleMotion, regressors
from needle_ros.errors import ParameterError
import numpy as np

#: Terms that depend on the time since the start or on the insertion depth.
_OF_THE_WHOLE: Final = {'drift', 'length', 'layers', 'cutting', 'spring', 'decay'}

_FEWEST_PARTS: Final = 10.0  # smallest number of independent blocks for an error
_PART_LENGTH: Final = 2.0  # length of a block [correlation lengths of filtered noise]
_REMEMBERED: Final = 8.0  # largest age of a block [forgetting times]: weight 4e-4
_ROUNDING: Final = 1e-7  # relative size of singular values that are rounding errors
_SETTLING: Final = 0.05  # of a sensor with an unknown filter after a change [s]
_LAGS: Final = 5  # number of blocks over which the noise may be correlated
_FIRST: Final = 50  # number of pairs that determine the sampling rate
_LARGEST_STEP: Final = 0.1  # largest step for interpolation of the motion [s]
_SET_BACK: Final = 1.0  # backward step of a clock set back, not of a late message [s]
_LARGEST: Final = {'force': 1e4, 'motion': 100.0}  # [N], and [m] or [m/s]: implausible
_MAX_WAITING: Final = 20_000  # largest number of samples that wait for the other topic


class RecursiveFriction:
    """
    Recursive friction estimator with constant time and memory per sample.

    Parameters
    ----------
    settings : FrictionSettings
        Terms, filter and thresholds of steady motion; the estimator is ordinary.
    rate : float
        Constant sampling rate [Hz].
    forgetting : float
        Time of steady motion after which the weight of a sample is 1 / e [s]. Samples at rest
        change neither the estimate nor the weights.

    Examples
    --------
    >>> import numpy as np
    >>> from needle_identification import FrictionSettings, RecursiveFriction
    >>> live = RecursiveFriction(FrictionSettings(), rate=250.0, forgetting=30.0)
    >>> for time in np.arange(0.0, 20.0, 0.004):
    ...     velocity = 0.008 * np.sin(2.0 * time) + 0.006 * np.sin(3.1 * time)
    ...     live.update(time, velocity, force=0.56 * np.sign(velocity) + 300.0 * velocity)
    >>> {found.name: round(found.value, 3) for found in live.estimate()}
    {'coulomb_friction': 0.56, 'viscous_friction': 300.0}

    """

    def __init__(self, settings: FrictionSettings, rate: float, forgetting: float) -> None:
        for name, value in (('rate', rate), ('forgetting', forgetting)):
            if not 0.0 < value < inf:
                raise ParameterError(f'{name} must be finite and > 0, got {value!r}')
        if settings.estimator not in (AUTO, 'ordinary'):
            raise ParameterError(
                f'recursive estimation needs the estimator ordinary, got {settings.estimator!r}'
            )
        if wrong := sorted(_OF_THE_WHOLE & set(settings.terms)):
            raise ParameterError(f'recursive estimation has no term {" or ".join(wrong)}')
        self._settings = settings
        self._period = 1.0 / rate
        self._taps = filter_taps(settings.cutoff, self._period)
        # The filtered acceleration needs a neighbor on either side, the lag another neighbor.
        self._margin = len(self._taps) // 2 + 2
        self._settling = ceil(_SETTLING / self._period)
        self._raw: deque[tuple[float, float]] = deque(maxlen=len(self._taps))
        self._smooth: deque[tuple[float, float]] = deque(maxlen=3)
        self._pending: deque[tuple[float, float, float]] = deque()
        self._estimates_lag = 'inertia' not in settings.terms
        length = ceil(_PART_LENGTH * CORRELATION_LENGTH / settings.cutoff * rate)
        count = len(columns_of(settings.terms, settings)) + self._estimates_lag
        blocks = ceil(_REMEMBERED * forgetting * rate / length)
        decay = exp(-self._period / forgetting)
        self._information = _Information(count, decay, length, blocks)
        self._speed_sum = self._weight = 0.0
        self._time = -inf
        self._regime = 0.0
        self._since_change = 0

    def update(self, time: float, velocity: float, force: float) -> None:
        """Add a sample: time [s], insertion velocity [m/s] and force on the needle [N]."""
        # After a gap, a backward step or a sample that is not finite, the filter restarts.
        if not abs(velocity) + abs(force) < inf:
            self._time = -inf
            return
        if not 0.0 < time - self._time < GAP * self._period:
            self._raw.clear()
            self._smooth.clear()
            self._drop_pending()
        self._time = time
        self._raw.append((velocity, force))
        if len(self._raw) < len(self._taps):
            return
        smooth = self._taps @ np.array(self._raw)
        self._smooth.append((float(smooth[0]), float(smooth[1])))
        if len(self._smooth) == 3:
            (before, _), (now, filtered), (after, _) = self._smooth
            self._select(now, 0.5 * (after - before) / self._period, filtered)

    def _drop_pending(self) -> None:
        self._pending.clear()
        self._since_change = 0

    def _select(self, velocity: float, acceleration: float, force: float) -> None:
        """Use samples in steady motion, after the motion has remained steady for the margin."""
        settings = self._settings
        regime = float(np.sign(velocity)) if abs(velocity) > settings.moving_speed else 0.0
        if self._estimates_lag and abs(acceleration) > settings.largest_acceleration:
            regime = nan
        if regime != self._regime:
            self._drop_pending()
            self._regime = regime
        self._since_change += 1
        if self._since_change <= self._margin + self._settling or abs(regime) != 1.0:
            return
        self._pending.append((velocity, acceleration, force))
        if len(self._pending) > self._margin:
            self._learn(*self._pending.popleft())

    def _learn(self, velocity: float, acceleration: float, force: float) -> None:
        none = np.zeros(1)
        motion = NeedleMotion(
            np.array([velocity]), np.array([acceleration]), none, none, none > 0.0
        )
        row = regressors(motion, self._settings.terms, self._settings)[0]
        if self._estimates_lag:
            row = np.append(row, acceleration)
        self._information.add(row, force)
        decay = self._information.decay
        self._speed_sum = decay * self._speed_sum + abs(velocity)
        self._weight = decay * self._weight + 1.0

    def estimate(self) -> tuple[ParameterEstimate, ...]:
        """Return the parameters of `identify_friction`; undetermined until the motion suffices."""
        mean_speed = self._speed_sum / max(self._weight, 1.0)
        fit = self._information.regression()
        return parameter_estimates(fit, self._settings, mean_speed, self._period)


class _Information:
    """Information of k parameters with exponential forgetting, of all samples and by block."""

    def __init__(self, k: int, decay: float, length: int, blocks: int) -> None:
        """Start empty; decay per sample, length of a block, and number of blocks."""
        self.decay, self._length = decay, length
        #: A and, in the last column, b: of all samples, and of the current block.
        self._known, self._part = np.zeros((k, k + 1)), np.zeros((k, k + 1))
        self._count = 0
        self._parts: deque[tuple[FloatArray, int]] = deque(maxlen=blocks)

    def add(self, row: FloatArray, force: float) -> None:
        """Add the regressors (k,) and the force of a sample."""
        products = np.outer(row, np.append(row, force))
        self._known = self.decay * self._known + products
        self._part = self.decay * self._part + products
        self._count += 1
        if self._count % self._length == 0:
            self._parts.append((self._part, self._count))
            self._part = np.zeros_like(self._part)

    def regression(self) -> Regression:
        """Solve; standard errors use the scores of blocks longer than the noise correlation."""
        known, moment = self._known[:, :-1], self._known[:, -1]
        k = len(moment)
        norms = np.sqrt(np.diag(known))
        norms[norms == 0.0] = 1.0
        strengths, directions = np.linalg.eigh(known / np.outer(norms, norms))
        singular = np.sqrt(np.maximum(strengths[::-1], 0.0))
        singular[singular < _ROUNDING * singular[0]] = 0.0
        basis, unknown = determinable(singular, directions[:, ::-1].T)
        basis = basis / norms[:, np.newaxis]
        inverse = basis @ np.linalg.inv(basis.T @ known @ basis) @ basis.T
        values = inverse @ moment
        middle, behind, effective = self._scores(values, inverse)
        if effective < max(_FEWEST_PARTS, k + 1.0):
            unknown[:] = True
        covariance = inverse @ middle @ inverse * effective / max(effective - k, 1.0)
        values[unknown] = nan
        covariance[unknown] = covariance[:, unknown] = nan
        covariance[unknown, unknown] = inf
        return Regression(
            values=values,
            covariance=covariance,
            errors=np.sqrt(np.diag(covariance)),
            determined=~unknown,
            condition=float(singular[0] / singular[-1]) if singular[-1] > 0.0 else inf,
            residual=np.empty(0),
            determination=nan,
            samples=self._count,
            effective_samples=effective,
            degrees_of_freedom=np.maximum(behind * (1.0 - k / max(effective, k + 1.0)), 1.0),
        )

    def _scores(
        self, values: FloatArray, inverse: FloatArray
    ) -> tuple[FloatArray, FloatArray, float]:
        now = self._count
        parts = [*self._parts, (self._part, now)]
        ages = np.array([self.decay ** (now - count) for _, count in parts])
        weighed = ages[:, np.newaxis, np.newaxis] * np.array([part for part, _ in parts])
        information = weighed[:, :, :-1]
        scores = weighed[:, :, -1] - information @ values
        # Contribution of each block to the variance of each parameter, for white noise.
        even = ages * np.einsum('ki,pij,jk->kp', inverse, information, inverse)
        total = even.sum(axis=1)
        behind = np.divide(
            total**2, (even**2).sum(axis=1), out=np.ones(len(total)), where=total > 0
        )
        effective = float(ages.sum() ** 2 / (ages @ ages))
        # Correlation between blocks only increases the errors (Newey and West).
        changes = scores @ inverse
        plain = colored = (changes**2).sum(axis=0)
        for lag in range(1, min(_LAGS + 1, len(changes))):
            weight = 2.0 * (1.0 - lag / (_LAGS + 1.0))
            colored = colored + weight * (changes[lag:] * changes[:-lag]).sum(axis=0)
        growth = np.divide(colored, plain, out=np.ones_like(plain), where=plain > 0.0)
        covariance = growth.max(initial=1.0) * (scores.T @ scores)
        return covariance, behind, min(effective, now / self._length)


class LiveFriction:
    """Estimate friction from messages as they arrive, with the motion at the force stamps."""

    # Samples that are not finite, out of order, or in a gap of the motion are discarded and
    # counted. A clock that is set back restarts the estimation.

    def __init__(self, settings: FrictionSettings, forgetting: float) -> None:
        # Checks the arguments except the sampling rate, which is determined later.
        RecursiveFriction(settings, 1.0, forgetting)
        self._settings, self._forgetting = settings, forgetting
        #: Number of discarded samples by reason.
        self.dropped: Counter[str] = Counter()
        self._restart()

    def _restart(self) -> None:
        self._start: int | None = None
        self._motion: deque[tuple[float, float]] = deque(maxlen=_MAX_WAITING)
        self._force: deque[tuple[float, float]] = deque(maxlen=_MAX_WAITING)
        self._last = {'force': -inf, 'motion': -inf}
        self._last_depth: tuple[float, float] | None = None
        self._first: list[tuple[float, float, float]] = []
        self._estimator: RecursiveFriction | None = None
        self.samples = 0

    def take_motion(self, stamp: int, depth: float, velocity: float | None) -> None:
        """Add depth [m] and velocity [m/s], or depth to differentiate, at a stamp [ns]."""
        time = self._time('motion', stamp, depth if velocity is None else velocity)
        if time is None:
            return
        if velocity is None:
            before, self._last_depth = self._last_depth, (time, depth)
            if before is None:
                return
            # The difference quotient is the velocity at the midpoint.
            velocity = (depth - before[1]) / (time - before[0])
            time = (time + before[0]) / 2.0
        self._motion.append((time, velocity))
        self._pair()

    def take_force(self, stamp: int, force: float) -> None:
        """Add the base force on the needle [N], positive into the tissue, at a stamp [ns]."""
        time = self._time('force', stamp, force)
        if time is not None:
            self._force.append((time, force))
            self._pair()

    def estimate(self) -> tuple[ParameterEstimate, ...]:
        """Return the current friction parameters; empty until the sampling rate is determined."""
        return () if self._estimator is None else self._estimator.estimate()

    def _time(self, topic: str, stamp: int, value: float) -> float | None:
        """Return the time since the start [s], or None if the sample is discarded."""
        if not abs(value) <= _LARGEST[topic]:
            self.dropped['implausible' if isfinite(value) else 'not finite'] += 1
            return None
        if self._start is None:
            self._start = stamp
        time = 1e-9 * (stamp - self._start)
        if time < self._last[topic] - _SET_BACK:
            self._restart()
            self.dropped['clock set back'] += 1
            return None
        if time <= self._last[topic]:
            self.dropped['out of order'] += 1
            return None
        self._last[topic] = time
        return time

    def _pair(self) -> None:
        motion = self._motion
        while self._force and motion and motion[-1][0] >= self._force[0][0]:
            time, force = self._force.popleft()
            while len(motion) > 1 and motion[1][0] <= time:
                motion.popleft()
            velocity = _interpolated(motion, time)
            if isfinite(velocity):
                self._pass_on(time, velocity, force)
            else:
                self.dropped['no motion at their time'] += 1

    def _pass_on(self, time: float, velocity: float, force: float) -> None:
        self.samples += 1
        if self._estimator is not None:
            self._estimator.update(time, velocity, force)
            return
        self._first.append((time, velocity, force))
        if len(self._first) == _FIRST:
            period = median(after[0] - before[0] for before, after in pairwise(self._first))
            self._estimator = RecursiveFriction(self._settings, 1.0 / period, self._forgetting)
            for sample in self._first:
                self._estimator.update(*sample)


def _interpolated(motion: deque[tuple[float, float]], time: float) -> float:
    before, velocity = motion[0]
    if before == time:
        return velocity
    if before > time or motion[1][0] - before > _LARGEST_STEP:
        return nan
    after, later = motion[1]
    return velocity + (later - velocity) * (time - before) / (after - before)
