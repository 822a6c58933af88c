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
from math import cos, inf, isfinite, nan, sin
from typing import NamedTuple

from needle_controller.compiled.steering import (
    BEVEL,
    chance,
    choose,
    expect,
    FINE,
    FROZEN,
    LOST,
    MISSING,
    reach,
    SAME,
    see,
    Steering,
    STEP,
    TURNS,
    weights,
)
from needle_controller.steering.responses import SteeringModel
from needle_dynamics.arrays import ComplexArray, FloatArray
from needle_ros.errors import JobError, ParameterError, ShapeError
import numpy as np
from numpy.typing import ArrayLike

#: A target that is reached in less of what may be true is refused at the start, and warned of on
#: the way.
_REFUSED, _WARNED = 0.05, 0.5


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
        from needle_dynamics.compiled.held import Held

        count, size = len(model.lengths), len(model.prior)
        mean = np.zeros((count, size), dtype=np.complex128)
        mean[:, BEVEL] = 1j * model.push
        covariance = np.empty((count, size, size), dtype=np.complex128)
        covariance[:] = model.prior
        self._model = model
        self._now = Steering(
            responses=model.responses,
            limit=float(position_limit),
            load_limit=float(load_limit),
            ways=np.minimum(step_limit * np.arange(1.0, model.steps + 1.0), 2.0 * position_limit),
            target=np.zeros(2),
            mean=mean,
            covariance=covariance,
            logs=np.zeros(count),
            guide=np.zeros(model.steps, dtype=np.complex128),
            turned=np.full(model.steps + 1, complex(cos(roll), -sin(roll))),
            roll=np.array([roll], dtype=np.float64),
            last=np.full(2, nan),
            counts=np.array([0, turns, 0, 0, 0]),
        )
        self._held = Held(self._now)
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
        before = self.target
        self._now.target[:] = new
        if self.chance < _REFUSED:
            error = OutOfReachError(self._unreachable(), self.reach)
            self._now.target[:] = before
            raise error

    # What is known.

    @property
    def target(self) -> FloatArray:
        """The target [m], shape (2,)."""
        return self._now.target.copy()

    @property
    def step(self) -> int:
        """Number of looks so far."""
        return int(self._now.counts[STEP])

    @property
    def turns(self) -> int:
        """Turns that are left."""
        return int(self._now.counts[TURNS])

    @property
    def weights(self) -> FloatArray:
        """Probability of each hypothesis, shape (h,)."""
        return weights(self._now.logs)

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
        x, z, xx, xz, zz = expect(self._held, range(self._model.steps + 1)[at])
        return TipEstimate(np.array([x, z]), np.array([[xx, xz], [xz, zz]]))

    @property
    def chance(self) -> float:
        """How probable it is that the tip can still come within a millimeter of the target."""
        return chance(self._held)

    @property
    def reach(self) -> Reach:
        """Where the tip can be brought from here."""
        middles, sizes, _ = reach(self._held)
        return Reach(middles, sizes, self.weights)

    @property
    def warning(self) -> str:
        """What is to be said of the target now, '' for nothing."""
        return '' if self.chance >= _WARNED else self._unreachable()

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
        seen = np.full(2, nan) if tip is None else np.array(tip, dtype=np.float64)
        if seen.shape != (2,):
            raise ShapeError(f'a look must be x and z, got shape {seen.shape}')
        x, z = seen.tolist()
        variance = max(self._model.belief.noise, noise) ** 2
        kind, off_x, off_z = see(self._held, at, x, z, variance)
        if kind == FINE:
            return
        if kind == LOST:
            missing = self._now.counts[MISSING]
            raise SteeringFaultError(f'the tip was not seen in {missing} looks')
        if kind == FROZEN:
            same = self._now.counts[SAME] + 1
            raise SteeringFaultError(f'the sensor of the tip is frozen: {same} looks are the same')
        raise SteeringFaultError(
            f'the tip is {1e3 * off_x:+.2f} mm in x and {1e3 * off_z:+.2f} mm in z from where any '
            f'needle of the belief can be'
        )

    def plan(self) -> Guidance:
        """
        Return where guide and roll shall be in the next step, and go on to it.

        Returns
        -------
        Guidance
            As from `next`.

        """
        now, k, last = self._now, self.step, self._model.steps - 1
        if k <= last:
            now.guide[k] = self._choose()
        now.counts[STEP] = k + 1
        there = complex(now.guide[min(k, last)])
        return Guidance(there.real, there.imag, float(now.roll[0]))

    def _choose(self) -> complex:
        """Return the next position of the guide, x + i z [m]."""
        return choose(self._held)
