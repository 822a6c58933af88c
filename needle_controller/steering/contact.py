# SPDX-License-Identifier: Apache-2.0
r"""
Probability of contact along a planned path, and a law that stops before it.

Before each motion, the law predicts the tip at all further depths. A measurement on the way
reveals a part of the deviation, which the guide then corrects within its reach, so that

.. math:: P_{contact} = E\left[ P(l + \mathrm{rest}(d) + e \notin F) \right],

with the path l, the free space F of a place, the deviation d that will be revealed, its rest that
the guide cannot correct, and an error e as large as in one step. The needle behind the tip lies
where the tip passed, shifted by the guide as in the nominal needle. The largest probability of all
places counts.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import pi, sqrt
from typing import cast, Final, NamedTuple, Protocol

from needle_controller.compiled.guide_plan import USED
from needle_controller.steering.free_space import most_clearance, probability_outside
from needle_controller.steering.insertion_plan import Plan
from needle_controller.steering.law import (
    ContactError,
    Forecast,
    GuideSetpoint,
    SteeringLaw,
    TipEstimate,
)
from needle_controller.steering.planned_path import PlannedPath
from needle_controller.steering.responses import SteeringModel
from needle_controller.steering.settings import ContactSettings, REPLAN, SteeringLimits
from needle_dynamics.arrays import FloatArray
from needle_dynamics.steering.needle import inserted_shape, SteeredNeedle
from needle_ros.errors import ParameterError
import numpy as np
from numpy.typing import ArrayLike
from scipy.special import log_ndtr, ndtr

_LEAST: Final = 1e-6**2  #: Least variance of a point [m^2].
#: Probability that is neglected, and the distance at which a normal distribution ends, in
#: standard deviations.
_NEGLIGIBLE, _FAR = 1e-6, 5.0
_SHIFT: Final = 1e-3  #: Motion of the guide for the response of the inserted needle [m].


class FollowingLaw(SteeringLaw, Protocol):
    """Steering law that follows a path, and predicts the tip along it."""

    def forecast(self) -> Forecast:
        """Predict the tip along the path, after `plan`."""

    def redirect(self, path: PlannedPath) -> None:
        """Follow another path from the present depth on."""


class _Contact(NamedTuple):
    """Largest probability of contact, and its depth [m]."""

    probability: float
    depth: float


class _Shaft(NamedTuple):
    """Inserted needle at m places: free space, and its deviation from the nominal needle."""

    places: FloatArray  #: depths [m], shape (m,)
    free: FloatArray  #: free distances [m], shape (m, 16)
    off: FloatArray  #: deviation less the planned path [m], shape (m, 2)
    covariance: FloatArray  #: of the tip when it passed [m^2], shape (m, 2, 2)
    tips: FloatArray  #: tip of the nominal needle when it passed [m], shape (m, 2)


class _Part(NamedTuple):
    """Part of the distribution of a deviation after its correction, at m places."""

    weight: FloatArray  #: probability, shape (m,)
    mean: FloatArray  #: mean [m], shape (m,)
    variance: FloatArray  #: variance [m^2], shape (m,)


class MonitoredLaw:
    """
    Steering law along a plan that stops or replans before contact; a `SteeringLaw`.

    Parameters
    ----------
    law : FollowingLaw
        Law that follows ``path``.
    model : SteeringModel
        Model of the law.
    plan : Plan
        Plan with the free space.
    path : PlannedPath
        Path of the plan, with the depths of the model.
    limits : SteeringLimits
        Limits of the guide.
    settings : ContactSettings
        Limit of the probability, and reaction above it.

    Raises
    ------
    ParameterError
        The plan has no free space, or the law has no forecast.

    """

    def __init__(
        self,
        law: FollowingLaw,
        model: SteeringModel,
        plan: Plan,
        path: PlannedPath,
        limits: SteeringLimits,
        settings: ContactSettings,
    ) -> None:
        missing = [name for name in ('forecast', 'redirect') if not hasattr(law, name)]
        if missing:
            raise ParameterError(
                f'contact.limit must be 1 with a law that has no {" and no ".join(missing)}'
            )
        self.law, self._model, self._path = law, model, path
        self._limits, self._settings = limits, settings
        if not len(plan.free):
            raise ParameterError('contact.limit must be 1 for a plan without free space')
        self._places, self._free = plan.free[:, 0], plan.free[:, 1:]
        #: Planned path at the places, shape (m, 2) [m].
        self._centers = _between(self._places, plan.depths, plan.tip_path.tips)
        self._contact = _Contact(0.0, float(model.depths[0]))
        self._replanned = ''
        # The nominal needle under the same guide.
        steering = replace(model.steering, path_noise=0.0)
        self._needle = SteeredNeedle(model.needle, steering, roll=plan.roll)
        self._needle.move(depth=float(model.depths[0]))
        #: At each depth so far: deviation of the tip from the nominal needle [m], covariance of
        #: the tip [m^2], and nominal tip [m].
        self._passed: list[tuple[FloatArray, FloatArray, FloatArray]] = []

    @property
    def target(self) -> FloatArray:
        return self.law.target

    @property
    def step(self) -> int:
        return self.law.step

    @property
    def warning(self) -> str:
        return self.law.warning or self._replanned

    def aim(self, target: ArrayLike) -> None:
        self.law.aim(target)

    def update(
        self, tip: Sequence[float] | FloatArray | None, at: int, noise: float = 0.0
    ) -> None:
        self.law.update(tip, at, noise)

    def expected(self) -> TipEstimate | None:
        return self.law.expected()

    def status(self) -> Mapping[str, float]:
        return {**self.law.status(), 'contact_probability': self._contact.probability}

    def plan(self) -> GuideSetpoint:
        """Plan the next step, or raise `ContactError`."""
        to, limit = self.law.plan(), self._settings.limit
        if self.step > self._model.steps:
            return to
        forecast = self.law.forecast()
        self._pass(forecast)
        self._contact = max(self._behind(to), self._ahead(forecast))
        if self._contact.probability <= limit:
            return to
        before = self._contact
        if self._settings.action == REPLAN and (path := self._best_path(forecast)) is not None:
            self.law.redirect(path)
            self._path = path
            x, z = path.guide[self.step - 1].tolist()
            to = to._replace(x=x, z=z)
            self._contact = max(self._behind(to), self._ahead(self.law.forecast()))
            if self._contact.probability <= limit:
                self._replanned = f'{_describe(before)}; another path is followed'
                return to
        raise ContactError(f'{_describe(before)}, at most {limit:.0%} are permitted')

    def _ahead(self, forecast: Forecast) -> _Contact:
        """Return the largest probability of contact of the tip."""
        depths, first = self._model.depths, self.step - 1
        # Before the first measurement in tissue, tilt and frame are not known: only the next step.
        last = depths[-1] if first else depths[1]
        chosen = (self._places > depths[first]) & (self._places <= last)
        places, free, centers = self._places[chosen], self._free[chosen], self._centers[chosen]
        if not len(places):
            return _Contact(0.0, float(depths[-1]))
        # A changed target moves the path in proportion to the depth.
        fraction = (depths - depths[0]) / np.ptp(depths)
        moved = np.outer(fraction, self.target - self._path.tips[-1])
        line = (self._path.tips + moved)[first:]
        own = forecast.covariances.copy()
        own[2:] = own[1]
        later = np.diagonal(forecast.covariances - own, axis1=1, axis2=2)
        revealed = np.sqrt(np.maximum(later, 0.0))
        now, limits = forecast.guide[first], self._limits
        # Largest motion of the guide from its present position to each later step.
        steps = np.arange(1, len(depths) - 1 - first)[:, np.newaxis]
        most = np.minimum(steps * limits.guide_step, limits.guide_limit - np.abs(now))
        reach = USED * np.abs(forecast.response[:, first + 1 :]) @ most
        at = depths[first:]
        off = _between(places, at, forecast.means - line)
        revealed, reach = _between(places, at, revealed), _between(places, at, reach[first:])
        base = _between(places, at, line) - centers
        covariance = self._covariance(_between(places, at, own))
        parts = [_uncorrected(*one) for one in zip(off.T, revealed.T, reach.T, strict=True)]
        found = np.zeros(len(places))
        for of_x in parts[0]:
            for of_z in parts[1]:
                weight = of_x.weight * of_z.weight
                rest = np.column_stack([of_x.mean, of_z.mean])
                spread = np.stack([of_x.variance, of_z.variance], axis=1)[:, np.newaxis]
                # Places far from an obstacle do not contribute.
                size = np.sqrt(spread.max(axis=(1, 2)) + np.trace(covariance, axis1=1, axis2=2))
                gap = free.min(axis=1) - np.linalg.norm(base + rest, axis=1)
                near = (weight > _NEGLIGIBLE) & (gap < _FAR * size)
                every = covariance[near] + spread[near] * np.eye(2)
                found[near] += weight[near] * probability_outside(
                    free[near], (base + rest)[near], every
                )
        return _largest(found, places)

    def _pass(self, forecast: Forecast) -> None:
        """Insert the nominal needle to the present depth, where the tip is measured."""
        depths, needle = self._model.depths, self._needle
        needle.move(depth=float(depths[self.step - 1]))
        tip = needle.tip[[0, 2]]
        self._passed.append((forecast.means[0] - tip, forecast.covariances[0], tip))
        chosen = self._places <= depths[self.step - 1]
        columns = (np.array(one) for one in zip(*self._passed, strict=True))
        off, covariance, tips = (
            _between(self._places[chosen], depths[: self.step], one) for one in columns
        )
        self._shaft = _Shaft(
            self._places[chosen], self._free[chosen], off - self._centers[chosen], covariance, tips
        )

    def _behind(self, to: GuideSetpoint) -> _Contact:
        """Return the largest probability of contact of the inserted needle in a guide motion."""
        shaft = self._shaft
        if not len(shaft.places):
            return _Contact(0.0, 0.0)
        self._needle.move(guide=to[:2])
        shape, _ = inserted_shape(self._needle, shaft.places)
        # The nominal needle, moved by the guide within the tissue that is known.
        doubt = (self._model.prior.spread * (shape - shaft.tips)) ** 2
        covariance = self._covariance(shaft.covariance + doubt[:, np.newaxis] * np.eye(2))
        every = probability_outside(shaft.free, shape + shaft.off, covariance)
        return _largest(every, shaft.places)

    def _covariance(self, of_tip: FloatArray) -> FloatArray:
        return of_tip + (_LEAST + self._settings.registration**2) * np.eye(2)

    def _best_path(self, forecast: Forecast) -> PlannedPath | None:
        """Return the path to the target with the largest clearance, or None."""
        first, shaft, needle = self.step - 1, self._shaft, self._needle
        at = self._model.depths[first:]
        moves = forecast.response[first:, first:]
        n, later = moves.shape[1], self._places > at[0]
        # The inserted needle is moved by the next motion of the guide.
        before, _ = inserted_shape(needle, shaft.places)
        x, z = forecast.guide[first].tolist()
        load = needle.guide_load[0]
        needle.move(guide=(x + _SHIFT, z))
        shift = (inserted_shape(needle, shaft.places)[0] - before)[:, 0] / _SHIFT
        stiffness = float(needle.guide_load[0, 0] - load[0]) / _SHIFT
        along = np.zeros((len(shift) + int(later.sum()), n))
        along[: len(shift), 0] = shift
        along[len(shift) :] = _between(self._places[later], at, moves)
        ahead = _between(self._places[later], at, forecast.means) - self._centers[later]
        free = np.vstack([shaft.free, self._free[later]])
        gap = np.vstack([before + shaft.off, ahead])
        guide = forecast.guide
        last = np.vstack([guide[first - 1] if first else np.zeros(2), guide[first:]])
        miss = self.target - forecast.means[-1]
        change = most_clearance(
            free, gap, along, moves[-1], miss, last, self._limits, load, stiffness
        )
        if change is None:
            return None
        guide, tips = guide.copy(), self._path.tips.copy()
        guide[first:] += change
        tips[first:] = forecast.means + moves @ change
        return PlannedPath(depths=self._model.depths, tips=tips, guide=guide)


def monitored(
    law: SteeringLaw,
    model: SteeringModel,
    plan: Plan,
    path: PlannedPath,
    limits: SteeringLimits,
    settings: ContactSettings,
) -> SteeringLaw:
    """Return a law along a plan that is monitored, or as it is if the limit is 1."""
    if settings.limit == 1.0:
        return law
    return MonitoredLaw(cast(FollowingLaw, law), model, plan, path, limits, settings)


def _uncorrected(mean: FloatArray, deviation: FloatArray, reach: FloatArray) -> list[_Part]:
    """Return the rest of a normal deviation beyond the reach of the guide: zero, +, -."""
    size = np.maximum(deviation, sqrt(_LEAST))
    found = []
    for sign in (1.0, -1.0):
        # Mean and variance of a truncated normal distribution.
        a = (reach - sign * mean) / size
        weight = ndtr(-a)
        hazard = np.exp(np.clip(-0.5 * a**2 - log_ndtr(-a), None, 50.0)) / sqrt(2.0 * pi)
        excess = sign * mean - reach + size * hazard
        variance = size**2 * np.maximum(1.0 + a * hazard - hazard**2, 0.0)
        found.append(_Part(weight, sign * excess, variance))
    none = np.zeros(len(mean))
    return [_Part(1.0 - found[0].weight - found[1].weight, none, none), *found]


def _between(places: FloatArray, depths: FloatArray, values: FloatArray) -> FloatArray:
    """Interpolate values by depth, shape (d, ...), at places, shape (m, ...)."""
    if len(depths) == 1:
        return np.repeat(values, len(places), axis=0)
    i = np.clip(np.searchsorted(depths, places, side='right') - 1, 0, len(depths) - 2)
    part = np.clip((places - depths[i]) / (depths[i + 1] - depths[i]), 0.0, 1.0)
    part = part.reshape(-1, *[1] * (values.ndim - 1))
    return np.asarray((1.0 - part) * values[i] + part * values[i + 1])


def _largest(found: FloatArray, places: FloatArray) -> _Contact:
    at = int(found.argmax())
    return _Contact(float(found[at]), float(places[at]))


def _describe(contact: _Contact) -> str:
    return (
        f'contact at a depth of {1e3 * contact.depth:.1f} mm has a probability of '
        f'{contact.probability:.0%}'
    )
