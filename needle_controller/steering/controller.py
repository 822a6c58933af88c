r"""
The controller that steers the tip to a target by guide and roll, one step at a time.

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
The needle is turned only if that leaves less out of reach than the guide alone can. As long as a
turn is left, the bevel may later push wherever it has to.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf, isfinite, sqrt, tau
from typing import Final, NamedTuple

from needle_controller.steering.responses import SteeringModel
from needle_dynamics.arrays import ComplexArray, FloatArray
from needle_ros.errors import JobError, ParameterError, ShapeError
import numpy as np
from numpy.typing import ArrayLike

#: Part of the later positions that is counted on.
_COUNTED: Final = 0.8

#: Positions of the guide that are compared.
_TRIED: Final = 121

#: Directions in which the bevel may push, and positions of the guide with each that are compared.
_ROLLS, _COARSE = 16, 13

#: Mean square of what is out of reach that a turn must be worth [m^2].
_TURN: Final = 1e-4**2

#: Cost of a load on the guide beyond its limit [m^2/N^2]: more than any distance.
_OVERLOAD: Final = 1.0

#: Standard deviation of the part of the bevel's load that a robot at rest takes away.
_LET_GO: Final = 0.03

#: Place of the load of the bevel among the causes.
_BEVEL: Final = 3

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


class Reach(NamedTuple):
    """
    Where the tip can be brought, by each hypothesis.

    Attributes
    ----------
    middles : ndarray of complex, shape (h,)
        Where it goes without further motion, x + i z [m].
    sizes : ndarray of complex, shape (h,)
        How far it can be brought from there, along x + i along z [m].
    weights : ndarray, shape (h,)
        Probability of each hypothesis.

    """

    middles: ComplexArray
    sizes: ComplexArray
    weights: FloatArray


class OutOfReachError(JobError):
    """
    No motion of guide and roll brings the tip to the target.

    Parameters
    ----------
    why : str
        For people.
    reach : Reach
        What is within reach.

    """

    def __init__(self, why: str, reach: Reach) -> None:
        super().__init__(why)
        self.reach = reach


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


class Guidance(NamedTuple):
    """
    What to do before the next step: guide and needle move while the tip rests.

    Attributes
    ----------
    x, z : float
        Where the guide shall be [m].
    roll : float
        Roll of the needle [rad].

    """

    x: float
    z: float
    roll: float = 0.0


class _Predicted(NamedTuple):
    """
    Where the tip is by each hypothesis.

    Attributes
    ----------
    means : ndarray of complex, shape (h,)
        Mean, x + i z [m].
    variances : ndarray, shape (h,)
        Variance along each axis [m^2].
    shared : ndarray of complex, shape (h, constants)
        Covariance with each of the unknown constants.

    """

    means: ComplexArray
    variances: FloatArray
    shared: ComplexArray


class _Ends(NamedTuple):
    """
    Where the tip ends by each hypothesis without further positions of the guide.

    Attributes
    ----------
    means : ndarray of complex, shape (h,)
        Mean, x + i z [m].
    errors : ndarray, shape (h,)
        Standard deviation along each axis [m].
    shifts : ndarray, shape (h, positions)
        What each further position of the guide does.
    turned : ndarray, shape (h,)
        How far later turns can push it along each axis [m].

    """

    means: ComplexArray
    errors: FloatArray
    shifts: FloatArray
    turned: FloatArray


class _Choice(NamedTuple):
    """A position of the guide, x + i z [m], and what it leaves out of reach [m^2]."""

    cost: float
    guide: complex


class SteeringController:
    """
    Steers the tip to a target: takes a look at each depth, and returns what to do next.

    Parameters
    ----------
    model : SteeringModel
        What may be true, with the depths of the looks.
    target : array_like, shape (2,)
        Where the tip shall be at the last depth, x and z in the frame of the sensor [m].
    position_limit : float
        Farthest position of the guide along x and along z [m]; 0 for a guide that cannot move.
    turns : int
        How often the needle may be turned.
    load_limit : float
        Largest force of the guide on needle and tissue that is planned, along x and along z [N].
    roll : float
        Roll of the needle at the start [rad].
    step_limit : float
        Farthest that the guide may go from one step to the next along x and along z [m].

    Attributes
    ----------
    target : ndarray, shape (2,)
        The target [m].
    step : int
        Number of looks so far.
    turns : int
        Turns that are left.
    weights : ndarray, shape (h,)
        Probability of each hypothesis.

    Raises
    ------
    ShapeError, ParameterError
        If the target is not two finite numbers, or a limit is not valid.
    OutOfReachError
        If the tip cannot be brought there; the message says what is within reach.

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
    ...     x, z, _ = control.next(needle.tip[[0, 2]])
    ...     needle.move(guide=(x, z))
    ...     needle.move(depth=depth)
    >>> miss = np.hypot(*(needle.tip[[0, 2]] - control.target))
    >>> print(f'{1e3 * miss:.1f} mm')
    0.0 mm

    """

    def __init__(
        self,
        model: SteeringModel,
        target: ArrayLike,
        position_limit: float = 6e-3,
        turns: int = 0,
        load_limit: float = inf,
        roll: float = 0.0,
        step_limit: float = inf,
    ) -> None:
        if not 0.0 <= position_limit < inf:
            raise ParameterError(
                f'position_limit must be finite and >= 0, got {position_limit!r} m'
            )
        if not load_limit > 0.0:
            raise ParameterError(f'load_limit must be > 0, got {load_limit!r} N')
        if not step_limit > 0.0:
            raise ParameterError(f'step_limit must be > 0, got {step_limit!r} m')
        if isinstance(turns, float) or turns < 0:
            raise ParameterError(f'turns must be a whole number >= 0, got {turns!r}')
        if not isfinite(roll):
            raise ParameterError(f'roll must be finite, got {roll!r} rad')
        if position_limit == 0.0 and turns == 0:
            raise ParameterError('position_limit and turns cannot both be 0: nothing would move')
        self._model, self._limit, self._load_limit = model, position_limit, load_limit
        #: Farthest that the guide may have gone after so many steps, from 1 [m].
        self._ways = np.minimum(
            step_limit * np.arange(1.0, model.steps + 1.0), 2.0 * position_limit
        )
        self.step, self.turns = 0, turns
        count, size = len(model.lengths), len(model.prior)
        #: Position of the guide, x + i z, and direction of the bevel over that at zero roll, in
        #: each step; the latter on the skin, too.
        self._guide = np.zeros(model.steps, dtype=np.complex128)
        self._turned = np.full(model.steps + 1, np.exp(-1j * roll))
        self._roll = roll
        self._mean = np.zeros((count, size), dtype=np.complex128)
        self._mean[:, _BEVEL] = 1j * model.push
        self._covariance = np.empty((count, size, size), dtype=np.complex128)
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
            If the tip cannot be brought there. The target stays as it was then.

        """
        new = np.array(target, dtype=np.float64)
        if new.shape != (2,):
            raise ShapeError(f'target must be x and z, got shape {new.shape}')
        if not np.isfinite(new).all():
            raise ParameterError(f'target must be finite, got {new.tolist()} m')
        before, self.target = self.target, new
        if self.chance < _REFUSED:
            error = OutOfReachError(self._unreachable(), self.reach)
            self.target = before
            raise error

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
            Number of the depth; by default the last one. Guide and roll are expected to stay as
            they were last sent.

        Returns
        -------
        TipEstimate
            Mean and covariance over all hypotheses.

        """
        return self._over_all(self._tip(at, self._held()))

    def _over_all(self, predicted: _Predicted) -> TipEstimate:
        w = self.weights
        mean = complex(w @ predicted.means)
        apart = predicted.means - mean
        planes = np.array([apart.real, apart.imag])
        spread = (w * planes) @ planes.T
        return TipEstimate(_planes(mean), spread + w @ predicted.variances * np.eye(2))

    def _held(self) -> ComplexArray:
        """Return where the guide was, and is if it rests from now on, shape (n,)."""
        guide, done = self._guide.copy(), min(self.step, self._model.steps)
        guide[done:] = guide[done - 1] if done else 0.0
        return guide

    def _tip(self, at: int, guide: ComplexArray) -> _Predicted:
        """Return where the tip is at a depth by each hypothesis."""
        model = self._model
        rows = np.empty_like(self._mean)
        rows[:, :-2] = model.causes[:, at]
        rows[:, _BEVEL] = model.bevel[:, at] @ self._turned
        rows[:, -2:] = (model.between[:, :, at] @ guide).T
        means = model.guide[:, at] @ guide + (self._mean * rows).sum(axis=1)
        shared = np.matmul(self._covariance, rows.conj()[..., np.newaxis])[..., 0]
        let_go = _LET_GO * model.elastic[:, at] * np.abs(self._mean[:, _BEVEL])
        return _Predicted(means, (shared * rows).sum(axis=1).real + let_go**2, shared)

    @property
    def chance(self) -> float:
        """How probable it is that the tip can still come within a millimeter of the target."""
        chance, errors = 1.0, self._ends(self.turns, self.step + 1).errors[:, np.newaxis]
        middles, sizes, w = self.reach
        need = self._goal - middles
        for plane, size in ((need.real, sizes.real), (need.imag, sizes.imag)):
            off = np.abs(plane[:, np.newaxis] + errors * _ABSCISSAS)
            chance *= float(w @ ((off <= _REACHED + size[:, np.newaxis]) @ _WEIGHTS))
        return chance

    @property
    def reach(self) -> Reach:
        """Where the tip can be brought from here."""
        ends, k = self._ends(self.turns, self.step + 1), self.step
        middles = ends.means.copy()
        sizes = np.array(ends.turned * (1.0 + 1.0j), dtype=np.complex128)
        there = self._guide[k - 1] if 0 < k <= self._model.steps else 0j
        for unit, at in ((1.0, there.real), (1.0j, there.imag)):
            center, half = self._room(np.array([at]), ends.shifts.shape[1])
            middles += unit * (ends.shifts @ center[0])
            sizes += unit * (np.abs(ends.shifts) @ half[0])
        return Reach(middles, sizes, self.weights)

    def _room(self, begin: FloatArray, count: int) -> tuple[FloatArray, FloatArray]:
        """Return middle and half width of where the guide can go from positions, (m, count)."""
        ways, limit = self._ways[:count], self._limit
        low = np.maximum(begin[:, np.newaxis] - ways, -limit)
        high = np.minimum(begin[:, np.newaxis] + ways, limit)
        return 0.5 * (low + high), 0.5 * (high - low)

    @property
    def _goal(self) -> complex:
        return complex(*self.target)

    @property
    def warning(self) -> str:
        """What is to be said of the target now, '' for nothing."""
        return '' if self.chance >= _WARNED else self._unreachable()

    def _ends(self, turns: int, first: int) -> _Ends:
        """Return where the tip ends with so many turns from a step on, counted from 1."""
        k, model = self.step, self._model
        guide = self._guide.copy()
        guide[k:] = 0.0
        end = self._tip(-1, guide)
        means, turned = end.means, np.zeros(len(end.means))
        if turns:
            later = model.bevel[:, -1, first:]
            load = self._mean[:, _BEVEL]
            means = means - load * (later @ self._turned[first:])
            turned = _COUNTED * sqrt(0.5) * np.abs(load) * np.abs(later).sum(axis=1)
        return _Ends(means, np.sqrt(end.variances), model.guide[:, -1, k:], turned)

    def _unreachable(self) -> str:
        middles, sizes, w = self.reach
        middle, size = 1e3 * complex(w @ middles), 1e3 * complex(w @ sizes)
        x, z = 1e3 * self.target
        return (
            f'the target x = {x:.2f} mm, z = {z:.2f} mm is out of reach: from here a tip at '
            f'x = {middle.real:.2f} ± {size.real:.2f} mm, z = {middle.imag:.2f} ± '
            f'{size.imag:.2f} mm'
        )

    # What is done.

    def next(self, tip: Sequence[float] | FloatArray | None) -> Guidance:
        """
        Take a look at the tip, and return where guide and roll shall be in the next step.

        Parameters
        ----------
        tip : array_like of shape (2,) or None
            Position of the tip in x and z in the frame of the sensor [m]; None if it was not seen.

        Returns
        -------
        Guidance
            Guide and roll; after the last look as they are.

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
        self.see(tip, self.step)
        return self.plan()

    def see(self, tip: Sequence[float] | FloatArray | None, at: int, noise: float = 0.0) -> None:
        """
        Take a look at the tip, of now or of an earlier depth.

        Parameters
        ----------
        tip : array_like of shape (2,) or None
            As for `next`.
        at : int
            Number of the depth, not greater than `step`.
        noise : float
            Its standard deviation along each axis, if that is more than is believed [m].

        Raises
        ------
        ParameterError
            If there is no such depth yet.
        ShapeError, JobError, SteeringFaultError
            As for `next`.

        """
        if self.step > self._model.steps:
            raise JobError(f'all {self._model.steps} steps are done')
        if not 0 <= at <= self.step:
            raise ParameterError(f'at must be in [0, {self.step}], got {at!r}')
        predicted, variance = self._tip(at, self._held()), self._model.belief.noise**2
        variance = max(variance, noise**2)
        seen = self._checked(tip, self._over_all(predicted), variance)
        if seen is not None:
            self._learn(complex(*seen), predicted, variance)

    def plan(self) -> Guidance:
        """
        Return where guide and roll shall be in the next step, and go on to it.

        Returns
        -------
        Guidance
            As from `next`.

        """
        k = self.step
        if k < self._model.steps:
            self._guide[k] = self._choose()
        self.step += 1
        there = self._guide[min(k, self._model.steps - 1)]
        return Guidance(float(there.real), float(there.imag), self._roll)

    def _checked(
        self, tip: Sequence[float] | FloatArray | None, there: TipEstimate, variance: float
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
        # What is absurd is infinitely far.
        with np.errstate(over='ignore', invalid='ignore'):
            distance = float(off @ np.linalg.solve(there.covariance + variance * np.eye(2), off))
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

    def _learn(self, seen: complex, predicted: _Predicted, variance: float) -> None:
        """Update each hypothesis, and their probabilities."""
        whole = predicted.variances + variance
        off = seen - predicted.means
        gain = predicted.shared / whole[:, np.newaxis]
        self._mean += off[:, np.newaxis] * gain
        self._covariance -= gain[..., np.newaxis] * predicted.shared.conj()[:, np.newaxis]
        self._logs -= 0.5 * np.abs(off) ** 2 / whole + np.log(whole)

    def _choose(self) -> complex:
        """Return the next position of the guide, and turn the needle if that is worth it."""
        ends = self._ends(self.turns, self.step + 2)
        tried = self._tried(_TRIED)
        best = self._best(ends, tried)
        if self.turns == 0 or best.cost < _TURN:
            return best.guide
        # As it is, but for a turn now.
        left = self.turns - 1
        base = self._ends(left, self.step + 2)
        columns = slice(self.step + 1, self.step + 2 if left else None)
        load = self._mean[:, _BEVEL] * self._model.bevel[:, -1, columns].sum(axis=1)
        rolls = self._roll + tau * np.arange(1 - _ROLLS // 2, _ROLLS // 2 + 1) / _ROLLS
        ways = np.exp(-1j * rolls)
        others = [base._replace(means=base.means + load * (way - self._way)) for way in ways]
        few = self._tried(_COARSE)
        costs = [sum(float(cost.min()) for cost in self._costs(one, few)) for one in others]
        k = int(np.argmin(costs))
        if costs[k] + _TURN > best.cost:
            return best.guide
        self._roll, self.turns = float(rolls[k]), left
        self._turned[self.step + 1 :] = ways[k]
        return self._best(others[k], tried).guide

    def _tried(self, count: int) -> tuple[FloatArray, FloatArray]:
        """Return positions that the guide may have next, in x and in z [m]."""
        there = complex(self._guide[self.step - 1]) if self.step else 0j
        found = []
        for at in (there.real, there.imag):
            (middle,), (half,) = (one[0] for one in self._room(np.array([at]), 1))
            found.append(middle + half * np.linspace(-1.0, 1.0, count if half else 1))
        return found[0], found[1]

    @property
    def _way(self) -> complex:
        """Direction of the bevel now over that at zero roll."""
        return complex(np.exp(-1j * self._roll))

    def _costs(
        self, ends: _Ends, tried: tuple[FloatArray, FloatArray]
    ) -> tuple[FloatArray, FloatArray]:
        """Return the mean square of what positions leave out of reach, in x and in z [m^2]."""
        w, now, after = self.weights, ends.shifts[:, :1], ends.shifts[:, 1:]
        sizes, need = np.abs(after), self._goal - ends.means
        spread = ends.errors[:, np.newaxis, np.newaxis] * _ABSCISSAS
        felt, stiffness = self._felt()
        found = []
        for plane, force, to in (
            (need.real, felt.real, tried[0]), (need.imag, felt.imag, tried[1]),
        ):  # fmt: skip
            center, half = self._room(to, after.shape[1])
            left = plane[:, np.newaxis] - now * to - after @ center.T
            later = _COUNTED * (sizes @ half.T) + ends.turned[:, np.newaxis]
            off = np.abs(left[..., np.newaxis] + spread)
            short = np.maximum(0.0, off - later[..., np.newaxis])
            over = np.maximum(0.0, np.abs(force + stiffness * to) - self._load_limit)
            found.append(w @ (short**2 @ _WEIGHTS) + _OVERLOAD * over**2)
        return found[0], found[1]

    def _felt(self) -> tuple[complex, float]:
        """Return the load on a guide that goes to zero [N], and what a shift adds [N/m]."""
        if self._load_limit == inf:
            return 0j, 0.0
        k, w, model = self.step, self.weights, self._model
        guide = self._guide.copy()
        guide[k:] = 0.0
        loads = model.causes_load[:, k] * self._mean[:, :-2]
        loads[:, _BEVEL] = (model.bevel_load[:, k] @ self._turned) * self._mean[:, _BEVEL]
        force = w @ (model.guide_load[:, k] @ guide + loads.sum(axis=1))
        return complex(force), float(w @ model.guide_load[:, k, k])

    def _best(self, ends: _Ends, tried: tuple[FloatArray, FloatArray]) -> _Choice:
        """Return the best of positions along each axis."""
        w, shifts, limit = self.weights, ends.shifts, self._limit
        # The plan for the mean: least squares, with a price of motion.
        weighted = w[:, np.newaxis] * shifts
        normal = weighted.T @ shifts + _MOTION * np.eye(shifts.shape[1])
        plan = np.linalg.solve(normal, weighted.T @ (self._goal - ends.means))[0]
        whole, found = 0.0, list[float]()
        wants = plan.real, plan.imag
        for cost, to, wanted in zip(self._costs(ends, tried), tried, wants, strict=True):
            away = _AWAY * (to - np.clip(wanted, -limit, limit)) ** 2
            at = int(np.argmin(cost + away))
            whole += float(cost[at])
            found.append(float(to[at]))
        return _Choice(whole, complex(*found))


def _planes(value: complex) -> FloatArray:
    return np.array([value.real, value.imag])
