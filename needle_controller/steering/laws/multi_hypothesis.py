# SPDX-License-Identifier: Apache-2.0
r"""
Steering law for all hypotheses: bring the tip to a target by guide and roll, one step at a time.

**Estimation.** Each hypothesis of `SteeringModel` is linear: a tip measurement updates its state
by a Kalman update, and its weight by the likelihood of the measurement. All hypotheses together
are a mixture of normal distributions. A measurement may have a gross error, such as breathing,
with a probability that is learned: see `needle_controller.compiled.hypotheses`.

**Control.** In a hypothesis the final position of the tip is

.. math:: c + a_k b_k + u, \quad |u| \le r = \rho \sum_{j>k} |a_j| b_{max}

with c from past motion and expected disturbances, the next position of the guide :math:`b_k`, and
the contribution u of later positions. The next position minimizes the mean squared distance of the
target from the reachable set, over all hypotheses and their errors: **the plan keeps the target
reachable for every hypothesis**, because the tissue is identified only during the insertion. Among
equivalent positions, the nearest to the position :math:`b` is used that brings the tip to the line
to the target over the next four depths,

.. math:: b = b_0 + \frac{\sum w \, g \, (l - \bar z)}{(1 + \sigma^2) \sum w \, g^2 + \rho^2},

with the present position :math:`b_0`, the distance of the expected tip from the line
:math:`l - \bar z`, the shift :math:`g` of the tip per shift of the guide, whose relative variance
is :math:`\sigma^2`, and sums over hypotheses with weights :math:`w` and over depths. The needle is
turned only if that reduces the distance below the best distance by the guide alone. As long as a
turn is left, the later load of the bevel may have any direction. A hypothesis with windup has its
own roll of the tip, :math:`\max(\phi - d, \min(\phi + d, \varphi))` after a roll of the base
to :math:`\phi`, with the previous roll of the tip :math:`\varphi` and the lag :math:`d`.

**Planned path.** After `MultiHypothesisLaw.follow`, :math:`l` is the planned path instead of the
line, :math:`b_0` moves by the plan, and the expected squared deviation from the path over the next
four depths is added to the mean squared distance of the target from the reachable set, with the
weight `guide_plan.PATH`.
"""

from collections.abc import Mapping, Sequence
from math import cos, inf, nan, sin
from typing import Any, NamedTuple

from needle_controller.compiled import guide_plan, hypotheses
from needle_controller.steering.law import (
    checked_target,
    checked_tip,
    Forecast,
    GuideSetpoint,
    SteeringFaultError,
    SteeringLaw,
    TipEstimate,
)
from needle_controller.steering.planned_path import PlannedPath
from needle_controller.steering.responses import SteeringModel
from needle_controller.steering.sensor_axes import SensorAxes
from needle_controller.steering.settings import SteeringLimits
from needle_dynamics.arrays import ComplexArray, FloatArray
from needle_ros.errors import JobError, ParameterError, ShapeError
from needle_ros.settings import checked
import numpy as np
from numpy.typing import ArrayLike

#: Probability of a hit below which a target is rejected at the start, or is warned of later.
_REFUSED, _WARNED = 0.05, 0.5

#: Logarithm of the weight of a kinematic hypothesis at the start, over the others, with turns.
_ROLLED = -3.0


class Reach(NamedTuple):
    """Reachable set of the tip, for each hypothesis."""

    middles: ComplexArray  #: final position without further motion, x + i z [m]
    sizes: ComplexArray  #: half width of the reachable set, along x + i along z [m]
    weights: FloatArray  #: hypothesis weights


class OutOfReachError(JobError):
    """No motion of guide and roll brings the tip to the target; it has the reachable set."""

    def __init__(self, why: str, reach: Reach) -> None:
        super().__init__(why)
        self.reach = reach

    def __reduce__(self) -> tuple[Any, ...]:
        return OutOfReachError, (str(self), self.reach)


class MultiHypothesisLaw(SteeringLaw):
    """
    Steer the tip to a target: one tip measurement and one guide setpoint for each step.

    Parameters
    ----------
    model, target, limits, roll
        As for `build_law`.

    Raises
    ------
    OutOfReachError
        If the target is out of reach; the message contains the reachable set.

    Examples
    --------
    A needle in tissue 20 % softer than nominal, with a tilted guide:

    >>> from dataclasses import replace
    >>> import numpy as np
    >>> from needle_controller import MultiHypothesisLaw, SteeringLimits, SteeringModel
    >>> from needle_dynamics import SteeredNeedle, NEEDLES
    >>> nominal, steering, _ = NEEDLES['bending_35mm']
    >>> depths = np.linspace(0.0, 0.1, 21)
    >>> model = SteeringModel(nominal, steering, depths)
    >>> control = MultiHypothesisLaw(model, (2e-3, -1e-3), SteeringLimits())
    >>> softer = replace(nominal, tissue_stiffness=0.8 * nominal.tissue_stiffness)
    >>> needle = SteeredNeedle(softer, steering, tilt=(0.02, 0.01))
    >>> for depth in depths[1:]:
    ...     control.update(needle.tip[[0, 2]], control.step)
    ...     x, z, _ = control.plan()
    ...     needle.move(guide=(x, z))
    ...     needle.move(depth=depth)
    >>> miss = np.hypot(*(needle.tip[[0, 2]] - control.target))
    >>> print(f'{1e3 * miss:.1f} mm')
    0.0 mm

    """

    def __init__(
        self, model: SteeringModel, target: ArrayLike, limits: SteeringLimits, roll: float = 0.0
    ) -> None:
        roll, limit, turns = checked('roll', roll), limits.guide_limit, limits.turns
        if limit == 0.0 and turns == 0:
            raise ParameterError('guide_limit and turns cannot both be 0: nothing would move')
        points, tips, count = len(model.responses.guide), model.steps + 1, len(model.lengths)
        size = tips + len(model.state_prior.deviations) + 1
        if limits.load_limit < inf:
            size += model.steps
        mean = np.zeros((count, size), dtype=np.complex128)
        mean[:, tips + hypotheses.BEVEL] = 1j * model.push
        self._model, self._axes = model, SensorAxes(model)
        self._use(hypotheses.Steering(
            responses=model.responses,
            prior=model.state_prior,
            path=(model.depths - model.depths[0]) / np.ptp(model.depths),
            waypoints=np.zeros(model.steps + 1, dtype=np.complex128),
            planned=np.zeros(model.steps, dtype=np.complex128),
            following=0.0,
            limit=float(limit),
            load_limit=float(limits.load_limit),
            ranges=np.minimum(limits.guide_step * np.arange(1.0, model.steps + 1.0), 2.0 * limit),
            target=np.zeros(2),
            mean=mean,
            shared=np.empty((count, tips, size), dtype=np.complex128),
            learned=np.zeros((count, tips)),
            logs=model.logs + np.where(model.rolled, _ROLLED if turns else -np.inf, 0.0),
            guide=np.zeros(model.steps, dtype=np.complex128),
            turned=np.full((points, model.steps + 1), complex(cos(roll), -sin(roll))),
            roll=np.full(points + 1, roll),
            last=np.full(2, nan),
            counts=np.array([0, turns, 0, 0, 0, 0]),
            gross=np.zeros(4),
        ))  # fmt: skip
        self._hit_probability: float | None = None  #: None until it is computed for this state
        self.aim(target)

    def aim(self, target: ArrayLike) -> None:
        before, self._now.target[:] = self.target, checked_target(target)
        self._hit_probability = None
        if self.hit_probability < _REFUSED:
            error = OutOfReachError(self._reachable('out of reach'), self.reach)
            self._now.target[:], self._hit_probability = before, None
            raise error

    def follow(self, path: PlannedPath) -> None:
        """Follow a planned path with the depths of the model, before the first measurement."""
        now, tips = self._now, self._model.steps + 1
        waypoints, planned = _complex(path.tips), _complex(path.guide)
        if (len(waypoints), len(planned)) != (tips, tips - 1):
            raise ShapeError(f'a path must have the {tips - 1} steps of the model')
        # In every hypothesis the planned guide leads along the path, until a measurement deviates.
        r, point = self._model.responses, np.arange(len(now.mean)) % len(now.turned)
        bevel = np.einsum('gkj,gj->gk', r.bevel, now.turned)[point]
        load = now.mean[:, tips + hypotheses.BEVEL, np.newaxis]
        now.mean[:, :tips] = waypoints - (r.guide @ planned)[point] - load * bevel
        self._use(now._replace(waypoints=waypoints, planned=planned, following=guide_plan.PATH))
        self._hit_probability = None

    def redirect(self, path: PlannedPath) -> None:
        """Follow another path from the present depth on, with the guide of the planned step."""
        now, planned = self._now, _complex(path.guide)
        now.guide[self.step - 1] = planned[self.step - 1]
        self._use(now._replace(waypoints=_complex(path.tips), planned=planned))
        self._hit_probability = None

    # Estimates.

    @property
    def target(self) -> FloatArray:
        return self._now.target.copy()

    @property
    def step(self) -> int:
        return int(self._now.counts[hypotheses.STEP])

    @property
    def turns(self) -> int:
        return int(self._now.counts[hypotheses.TURNS])

    @property
    def weights(self) -> FloatArray:
        """Probability of each hypothesis, shape (h,)."""
        return hypotheses.weights(self._now.logs)

    @property
    def bending(self) -> float:
        """Estimated bending length, relative to the nominal one."""
        return float(self.weights @ self._model.lengths)

    @property
    def layers(self) -> FloatArray:
        """
        Estimated stiffness of each layer over its nominal one.

        Median, and standard deviation of its logarithm, shape (layers, 2); the layers are those
        with a spread in the prior that begin above the last depth.
        """
        now, w = self._now, self.weights
        tips, spreads = len(now.path), now.prior.deviations[hypotheses.LAYERS :]
        used = w > 0.0
        own = slice(tips + hypotheses.LAYERS, tips + hypotheses.LAYERS + len(spreads))
        seen = slice(0, int(now.counts[hypotheses.MEASURED]))
        known = np.einsum(
            'hu,huk->hk', now.learned[used, seen], np.abs(now.shared[used, seen, own]) ** 2
        )
        # All layers of a hypothesis also differ by its bending length.
        common = -4.0 * np.log(self._model.lengths[used])[:, np.newaxis]
        logs, w = now.mean[used, own].real + common, w[used]
        mean = w @ logs
        variance = w @ (spreads**2 - known + (logs - mean) ** 2)
        return np.column_stack([np.exp(mean), np.sqrt(variance)])

    def expected(self, at: int = -1) -> TipEstimate:
        """Predict the tip at a depth number, at least `step` - 1, with the last guide and roll."""
        number = range(self._model.steps + 1)[at]
        self._check_depth(number, self._model.steps)
        x, z, xx, xz, zz = hypotheses.predict(self._boxed, number)
        return TipEstimate(np.array([x, z]), np.array([[xx, xz], [xz, zz]]))

    def forecast(self) -> Forecast:
        """Predict the tip from the last measured depth on, and how the guide moves it."""
        now, steps, w = self._now, self._model.steps, self.weights
        r, first = self._model.responses, max(0, self.step - 1)
        tips = [self.expected(at) for at in range(first, steps + 1)]
        points, constants = len(r.guide), now.mean[:, steps + 1 :].real
        # Hypothesis i has the responses of the point i modulo the number of points.
        by_point = w.reshape(-1, points).sum(axis=0)
        response = np.einsum('g,gkj->kj', by_point, r.guide)
        for k, between in enumerate(r.between):
            mean = (w * constants[:, k + 1]).reshape(-1, points).sum(axis=0)
            response += np.einsum('g,gkj->kj', mean, between)
        # As `hypotheses.guide_ahead`, which compiled functions only can call.
        done, guide = min(self.step, steps), now.guide.copy()
        guide[done:] = now.planned[done:] + (guide - now.planned)[max(done - 1, 0)]
        return Forecast(
            means=np.array([one.mean for one in tips]),
            covariances=np.array([one.covariance for one in tips]),
            response=response,
            guide=np.column_stack([guide.real, guide.imag]),
        )

    @property
    def hit_probability(self) -> float:
        """Probability that a hit within 1 mm of the target is still possible."""
        if self._hit_probability is None:
            self._hit_probability = guide_plan.hit_probability(self._boxed)
        return self._hit_probability

    @property
    def reach(self) -> Reach:
        middles, sizes, _ = guide_plan.reachable_set(self._boxed)
        return Reach(middles, sizes, self.weights)

    def status(self) -> Mapping[str, float]:
        return {
            'turns_left': self.turns,
            'hit_probability': self.hit_probability,
            'bending_length_ratio': self.bending,
        }

    @property
    def warning(self) -> str:
        """Warning if the target is probably out of reach, '' otherwise."""
        within = f'within reach with a probability of {self.hit_probability:.0%} only'
        return '' if self.hit_probability >= _WARNED else self._reachable(within)

    def _reachable(self, target: str) -> str:
        middles, sizes, w = self.reach
        middle, size = 1e3 * complex(w @ middles), 1e3 * complex(w @ sizes)
        x, z = 1e3 * self.target
        return (
            f'the target x = {x:.2f} mm, z = {z:.2f} mm is {target}: reachable '
            f'on average are x = {middle.real:.2f} ± {size.real:.2f} mm, z = {middle.imag:.2f} ± '
            f'{size.imag:.2f} mm'
        )

    # Steps.

    def update(
        self, tip: Sequence[float] | FloatArray | None, at: int, noise: float = 0.0
    ) -> None:
        if self.step > self._model.steps:
            raise JobError(f'all {self._model.steps} steps are done')
        self._check_depth(at, self.step)
        x, z = checked_tip(tip).tolist()
        noise = checked('noise', noise, 'm', low=0.0)
        variance = max(self._model.prior.noise, noise) ** 2
        self._hit_probability = None
        if self._now.counts[hypotheses.MEASURED] == self._now.learned.shape[1]:
            self._extend()
        before = self._now.counts[hypotheses.MEASURED]
        kind, off_x, off_z = hypotheses.update(self._boxed, at, x, z, variance)
        if kind == hypotheses.VALID:
            used = self._now.counts[hypotheses.MEASURED] > before
            if used and self._now.counts[hypotheses.GROSS] == 0:
                self._axes.check(at, complex(x, z), self._now.guide, variance)
            return
        if kind == hypotheses.LOST:
            missing = self._now.counts[hypotheses.MISSING]
            raise SteeringFaultError(f'{missing} tip measurements are missing')
        if kind == hypotheses.FROZEN:
            same = self._now.counts[hypotheses.SAME] + 1
            raise SteeringFaultError(f'the tip sensor is frozen: {same} identical measurements')
        raise SteeringFaultError(
            f'the tip is {1e3 * off_x:+.2f} mm in x and {1e3 * off_z:+.2f} mm in z from its '
            f'expected position, outside the model uncertainty (prior.*)'
        )

    def plan(self) -> GuideSetpoint:
        now, k, last = self._now, self.step, self._model.steps - 1
        self._hit_probability = None
        if k <= last:
            now.guide[k] = self._choose()
        hypotheses.advance(self._boxed)
        there = complex(now.guide[min(k, last)])
        return GuideSetpoint(there.real, there.imag, float(now.roll[-1]))

    def _extend(self) -> None:
        """Double the largest number of measurements."""
        now = self._now
        self._use(
            now._replace(
                shared=np.concatenate([now.shared, np.empty_like(now.shared)], axis=1),
                learned=np.concatenate([now.learned, np.zeros_like(now.learned)], axis=1),
            )
        )

    def _use(self, now: hypotheses.Steering) -> None:
        from needle_dynamics.compiled.boxed import Boxed

        self._now, self._boxed = now, Boxed(now)

    def _check_depth(self, at: int, most: int) -> None:
        """Raise for a depth after ``most``, or before the previous one: not in the state."""
        least = max(0, self.step - 1)
        if not least <= at <= most:
            raise ParameterError(f'at must be in [{least}, {most}], got {at!r}')

    def _choose(self) -> complex:
        return guide_plan.choose_guide(self._boxed)


def _complex(points: FloatArray) -> ComplexArray:
    return np.array(points @ (1.0, 1.0j), dtype=np.complex128)
