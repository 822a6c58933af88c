r"""
The controller that steers the tip to a target by moving the guide, one step at a time.

**What it knows.** Each hypothesis of `SteeringModel` is linear, so that what a look at the tip
says of its constants is a Kalman update, and what it says of the hypothesis is the likelihood of
that look. Together they are a mixture of normal distributions.

**What it does.** In a hypothesis the tip would end at

.. math:: c + a_k b_k + u, \quad |u| \le r = \rho \sum_{j>k} |a_j| b_{max}

with c what has been done and is expected, the next position of the guide :math:`b_k`, and what
later positions can still add. The next position is the one that leaves least of the target out of
reach, in the mean square over all hypotheses and their errors: **what any of the tissues that may
be true would need later must stay possible**, since it is later that the tissue is known. Where
many positions do that equally, it is the one nearest to a plan for the mean, of least motion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf, isfinite
from typing import Final, NamedTuple

from needle_controller.steering.responses import SteeringModel
from needle_dynamics.arrays import FloatArray
from needle_ros.errors import JobError, ParameterError, ShapeError
import numpy as np
from numpy.typing import ArrayLike

#: Part of the later positions that is counted on.
_COUNTED: Final = 0.8

#: Positions of the guide that are compared.
_TRIED: Final = 121

#: Abscissas and weights of a normal distribution.
_ABSCISSAS: Final = np.array([-(3.0**0.5), 0.0, 3.0**0.5])
_WEIGHTS: Final = np.array([1.0, 4.0, 1.0]) / 6.0

#: Cost of being away from the plan for the mean, and of motion in that plan [shift of the tip per
#: shift of the guide, squared].
_AWAY, _MOTION = 1e-5, 1e-2

#: A look at this squared distance from what is expected, in standard deviations, is no look at
#: this needle: by chance one in 3 million has it. So many of them are a fault.
_IMPOSSIBLE, _MOST_IMPOSSIBLE = 30.0, 2

#: Looks without a change while the needle goes on, from which on the sensor has frozen.
_FROZEN: Final = 2

#: Looks that may be missing in a row.
_MOST_MISSING: Final = 6

#: A target that is reached in less of what may be true is refused at the start, and warned of on
#: the way; reached is what is no farther from it than this [m].
_REFUSED, _WARNED = 0.05, 0.5
_REACHED: Final = 1e-3


class OutOfReachError(JobError):
    """No motion of the guide brings the tip to the target."""


class SteeringFaultError(JobError):
    """The tip that is seen is not that of this needle, or it is not seen."""


@dataclass(frozen=True, slots=True, eq=False)
class TipEstimate:
    """
    Where the tip is, or will be.

    Attributes
    ----------
    mean : ndarray, shape (2,)
        Position in x and z in the frame of the sensor [m].
    covariance : ndarray, shape (2, 2)
        Its covariance [m^2].

    """

    mean: FloatArray
    covariance: FloatArray


class _Predicted(NamedTuple):
    """
    Where the tip is by each hypothesis.

    Attributes
    ----------
    means, variances : ndarray, shape (h, 2)
        Mean [m] and variance [m^2] in x and z.
    shared : ndarray, shape (h, 2, constants)
        Covariance with each of the unknown constants.

    """

    means: FloatArray
    variances: FloatArray
    shared: FloatArray


class SteeringController:
    """
    Steers the tip to a target: takes a look at each depth, and returns where the guide shall go.

    Parameters
    ----------
    model : SteeringModel
        What may be true, with the depths of the looks.
    target : array_like, shape (2,)
        Where the tip shall be at the last depth, x and z in the frame of the sensor [m].
    position_limit : float
        Farthest position of the guide along x and along z [m].

    Attributes
    ----------
    target : ndarray, shape (2,)
        The target [m].
    step : int
        Number of looks so far.
    weights : ndarray, shape (h,)
        Probability of each hypothesis.

    Raises
    ------
    ShapeError, ParameterError
        If the target is not two finite numbers, or the limit is not positive.
    OutOfReachError
        If the guide cannot bring the tip there; the message says what is within reach.

    Examples
    --------
    A needle whose tissue is 20 % softer than believed, and whose guide is tilted:

    >>> from dataclasses import replace
    >>> import numpy as np
    >>> from needle_controller.steering.controller import SteeringController
    >>> from needle_controller.steering.responses import SteeringModel
    >>> from needle_dynamics import SteeredNeedle, STEERING_PRESETS
    >>> believed, steering, _ = STEERING_PRESETS['bending_35mm']
    >>> depths = np.linspace(0.0, 0.1, 21)
    >>> control = SteeringController(SteeringModel(believed, steering, depths), (2e-3, -1e-3))
    >>> softer = replace(believed, tissue_stiffness=0.8 * believed.tissue_stiffness)
    >>> needle = SteeredNeedle(softer, steering, tilt=(0.02, 0.01))
    >>> for depth in depths[1:]:
    ...     needle.move(guide=control.next(needle.tip[[0, 2]]))
    ...     needle.move(depth=depth)
    >>> miss = np.hypot(*(needle.tip[[0, 2]] - control.target))
    >>> print(f'{1e3 * miss:.1f} mm')
    0.0 mm

    """

    def __init__(
        self, model: SteeringModel, target: ArrayLike, position_limit: float = 6e-3
    ) -> None:
        if not 0.0 < position_limit < inf:
            raise ParameterError(
                f'position_limit must be positive and finite, got {position_limit!r} m'
            )
        self._model, self._limit = model, position_limit
        count, size = len(model.lengths), len(model.prior)
        self.step = 0
        self._guide = np.zeros((model.steps, 2))
        self._mean = np.zeros((count, 2, size))
        self._covariance = np.empty((count, 2, size, size))
        self._covariance[:] = model.prior
        self._logs = np.zeros(count)
        self._last: FloatArray | None = None
        self._same = self._impossible = self._missing = 0
        self.target = np.zeros(2)
        self.aim(target)

    def aim(self, target: ArrayLike) -> None:
        """
        Go on to another target at the same depth.

        Parameters
        ----------
        target : array_like, shape (2,)
            Where the tip shall be at the last depth, x and z in the frame of the sensor [m].

        Raises
        ------
        ShapeError, ParameterError
            If the target is not two finite numbers.
        OutOfReachError
            If the guide cannot bring the tip there. The target stays as it was then.

        """
        new = np.array(target, dtype=np.float64)
        if new.shape != (2,):
            raise ShapeError(f'target must be x and z, got shape {new.shape}')
        if not np.isfinite(new).all():
            raise ParameterError(f'target must be finite, got {new.tolist()} m')
        before, self.target = self.target, new
        if self.chance < _REFUSED:
            why = self._unreachable()
            self.target = before
            raise OutOfReachError(why)

    # What is known.

    @property
    def weights(self) -> FloatArray:
        """Probability of each hypothesis, shape (h,)."""
        found = np.exp(self._logs - self._logs.max())
        return np.asarray(found / found.sum())

    @property
    def bending(self) -> float:
        """Bending length over the believed one, as far as it is known."""
        return float(self.weights @ self._model.lengths)

    def expected(self, at: int = -1) -> TipEstimate:
        """
        Return where the tip is expected.

        Parameters
        ----------
        at : int
            Number of the depth; by default the last one. The guide is expected to stay where it
            was last sent.

        Returns
        -------
        TipEstimate
            Mean and covariance over all hypotheses.

        """
        return self._over_all(self._tip(at, self._held()))

    def _over_all(self, predicted: _Predicted) -> TipEstimate:
        w = self.weights
        mean = w @ predicted.means
        apart = predicted.means - mean
        spread = (w[:, np.newaxis] * apart).T @ apart
        return TipEstimate(mean, spread + np.diag(w @ predicted.variances))

    def _held(self) -> FloatArray:
        """Return where the guide was, and is if it rests from now on, shape (n, 2)."""
        guide, done = self._guide.copy(), min(self.step, self._model.steps)
        guide[done:] = guide[done - 1] if done else 0.0
        return guide

    def _tip(self, at: int, guide: FloatArray) -> _Predicted:
        """Return where the tip is at a depth by each hypothesis."""
        model = self._model
        rows = np.empty_like(self._mean)
        rows[:, :, :-2] = model.causes[:, np.newaxis, at]
        rows[:, :, -2:] = (model.between[:, :, at] @ guide).transpose(1, 2, 0)
        means = model.guide[:, at] @ guide + (self._mean * rows).sum(axis=2)
        shared = np.matmul(self._covariance, rows[..., np.newaxis])[..., 0]
        return _Predicted(means, (shared * rows).sum(axis=2), shared)

    @property
    def chance(self) -> float:
        """How probable it is that the tip can still come within a millimeter of the target."""
        w, chance = self.weights, 1.0
        begin, errors, shifts = self._ends()
        reach = _REACHED + self._limit * np.abs(shifts).sum(axis=1)
        for plane in range(2):
            need = (self.target[plane] - begin[:, plane])[:, np.newaxis]
            need = np.abs(need + errors[:, plane, np.newaxis] * _ABSCISSAS)
            chance *= float(w @ ((need <= reach[:, np.newaxis]) @ _WEIGHTS))
        return chance

    @property
    def warning(self) -> str:
        """What is to be said of the target now, '' for nothing."""
        return '' if self.chance >= _WARNED else self._unreachable()

    def _ends(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """
        Return where the tip ends without further positions, its error, and what these do.

        Shapes (h, 2), (h, 2) and (h, positions).
        """
        k = self.step
        guide = self._guide.copy()
        guide[k:] = 0.0
        end = self._tip(-1, guide)
        return end.means, np.sqrt(end.variances), self._model.guide[:, -1, k:]

    def _unreachable(self) -> str:
        begin, _, shifts = self._ends()
        w = self.weights
        middle = 1e3 * (w @ begin)
        reach = 1e3 * self._limit * float(w @ np.abs(shifts).sum(axis=1))
        x, z = 1e3 * self.target
        return (
            f'the target x = {x:.2f} mm, z = {z:.2f} mm is out of reach: from here a tip within '
            f'{reach:.2f} mm of x = {middle[0]:.2f} mm, z = {middle[1]:.2f} mm, along each axis'
        )

    # What is done.

    def next(self, tip: Sequence[float] | FloatArray | None) -> tuple[float, float]:
        """
        Take a look at the tip, and return where the guide shall be in the next step.

        Parameters
        ----------
        tip : array_like of shape (2,) or None
            Position of the tip in x and z in the frame of the sensor [m]; None if it was not seen.

        Returns
        -------
        tuple of float
            Position of the guide in x and z [m]; after the last look where it is.

        Raises
        ------
        ShapeError
            If the look does not have two numbers.
        JobError
            If all steps are done.
        SteeringFaultError
            If the tip has not been seen for too long, has frozen, or cannot be that of this
            needle. Then the needle shall stop.

        """
        if self.step > self._model.steps:
            raise JobError(f'all {self._model.steps} steps are done')
        predicted = self._tip(self.step, self._held())
        seen = self._checked(tip, self._over_all(predicted))
        if seen is not None:
            self._learn(seen, predicted)
        k = self.step
        if k < self._model.steps:
            self._guide[k] = self._choose()
        self.step += 1
        x, z = self._guide[min(k, self._model.steps - 1)].tolist()
        return x, z

    def _checked(
        self, tip: Sequence[float] | FloatArray | None, there: TipEstimate
    ) -> FloatArray | None:
        """Return a look that counts; None if there is none."""
        if tip is None or not all(map(isfinite, np.ravel(tip))):
            self._missing += 1
            if self._missing > _MOST_MISSING:
                raise SteeringFaultError(f'the tip was not seen in {self._missing} looks')
            return None
        seen = np.array(tip, dtype=np.float64)
        if seen.shape != (2,):
            raise ShapeError(f'a look must be x and z, got shape {seen.shape}')
        self._missing = 0
        same = self._last is not None and bool((seen == self._last).all())
        self._same = self._same + 1 if same else 0
        self._last = seen
        if self._same >= _FROZEN:
            raise SteeringFaultError(
                f'the sensor of the tip is frozen: {self._same + 1} looks are the same'
            )
        if same:
            return None
        off = seen - there.mean
        noise = self._model.belief.noise**2 * np.eye(2)
        # What is absurd is infinitely far.
        with np.errstate(over='ignore', invalid='ignore'):
            distance = float(off @ np.linalg.solve(there.covariance + noise, off))
        if distance <= _IMPOSSIBLE:
            self._impossible = 0
            return seen
        self._impossible += 1
        if self._impossible >= _MOST_IMPOSSIBLE:
            x, z = 1e3 * off
            raise SteeringFaultError(
                f'the tip is {x:+.2f} mm in x and {z:+.2f} mm in z from where any needle of the '
                f'belief can be'
            )
        return None

    def _learn(self, seen: FloatArray, predicted: _Predicted) -> None:
        """Update each hypothesis, and their probabilities."""
        whole = predicted.variances + self._model.belief.noise**2
        off = seen - predicted.means
        gain = predicted.shared / whole[..., np.newaxis]
        self._mean += off[..., np.newaxis] * gain
        self._covariance -= gain[..., np.newaxis] * predicted.shared[..., np.newaxis, :]
        self._logs -= 0.5 * (off**2 / whole + np.log(whole)).sum(axis=1)

    def _choose(self) -> FloatArray:
        """Return the next position of the guide."""
        w, limit = self.weights, self._limit
        begin, errors, shifts = self._ends()
        later = _COUNTED * limit * np.abs(shifts[:, 1:]).sum(axis=1)
        # The plan for the mean: least squares, with a price of motion.
        weighted = w[:, np.newaxis] * shifts
        normal = weighted.T @ shifts + _MOTION * np.eye(shifts.shape[1])
        plan = np.linalg.solve(normal, weighted.T @ (self.target - begin))[0]
        tried = np.linspace(-limit, limit, _TRIED)
        found = np.empty(2)
        for plane in range(2):
            need = (self.target[plane] - begin[:, plane])[:, np.newaxis]
            need = need - shifts[:, :1] * tried
            need = np.abs(
                need[:, :, np.newaxis] + errors[:, plane, np.newaxis, np.newaxis] * _ABSCISSAS
            )
            short = np.maximum(0.0, need - later[:, np.newaxis, np.newaxis])
            cost = w @ (short**2 @ _WEIGHTS)
            cost += _AWAY * (tried - np.clip(plan[plane], -limit, limit)) ** 2
            found[plane] = tried[int(np.argmin(cost))]
        return found
