# SPDX-License-Identifier: Apache-2.0
"""Search for the lengths with the highest likelihood, their intervals, and predictions."""

from collections.abc import Callable, Iterator, Sequence
from copy import copy
from functools import lru_cache
from itertools import product
from math import copysign, exp, inf, log, sqrt
from typing import Final, NamedTuple

from needle_dynamics.arrays import FloatArray
from needle_identification.steering.estimate import HeldOut
from needle_identification.steering.mixed import covariance, Likelihood, MixedModel
from needle_identification.steering.recording import (
    DEVIATIONS,
    drift,
    NominalLayers,
    SimulatedCauses,
    SteeringRecording,
    TERMS,
    TipResponses,
    UNIFORM,
)
from needle_ros.quantities import signed
import numpy as np
from scipy.optimize import least_squares
from scipy.special import chdtri, stdtrit

FREE: Final = (1e-3, 0.3)  #: bounds of the free length [m]
LENGTH: Final = (4e-3, 0.5)  #: bounds of the bending length [m]
SKIN: Final = (0.0, 0.5)  #: bounds of the skin [m]
#: Standard deviation of the logarithm of the stiffness of a layer over its nominal one, around the
#: mean of all layers: weak, for layers that the recordings hardly determine.
_LAYERS: Final = 1.0
#: Interval of the logarithm of the bending length of a layer that is determined: the stiffness is
#: known to a factor of 2.
_KNOWN: Final = 0.5 * log(2.0)
_SCALE: Final = 0.02  # the search variable of the skin is skin / (skin + scale) [m]

#: Grid of the global search: free lengths, bending lengths and skins [m].
_FREES: Final = (0.006, 0.016, 0.04, 0.1, 0.25)
_LENGTHS: Final = (0.006, 0.01, 0.016, 0.025, 0.04, 0.065, 0.11, 0.2, 0.4)
_SKINS: Final = (0.0, 0.006, 0.02, 0.08, 0.5)

_ROUNDS: Final = 12  # largest number of rounds of a search
_SETTLED: Final = 1e-3  # gain of the deviance in the last round
_STEP: Final = 1e-4  # step of a derivative
_NOTHING: Final = 1e-4  # weight of a ratio without effect on a search
_ROLLED: Final = 0.1  # roll that excites the bevel [rad]
_APART: Final = 0.05  # least difference between the variables of different optima
_NEAR: Final = 0.02  # relative tolerance of the ends of intervals

_NOISE: Final = 1e-4  # noise of a reading before the first fit [m]

_START: Final = 0.015  # depth of the measurements that determine offset and slope [m]
_ANY: Final = 1.0  # standard deviation of the offset [m]


class Tips:
    """Tip responses of recordings at given lengths, in one order of guide and insertion."""

    def __init__(
        self, recordings: Sequence[SteeringRecording], order: str, layers: NominalLayers = UNIFORM
    ) -> None:
        self.recordings, self.order, self.layers = recordings, order, layers
        self.known = [one.known for one in recordings]
        pairs = list(zip(recordings, self.known, strict=True))
        self.moved = [np.column_stack([one.depth, one.guide])[known] for one, known in pairs]
        self.measured = [one.tip[known].T for one, known in pairs]  # (2, n) [m]
        self._insertions = [SimulatedCauses(one, order, layers.starts) for one in recordings]
        self.of = lru_cache(maxsize=8000)(self._responses)

    def with_axes(self, x: str, z: str) -> 'Tips':
        """Return the same recordings with these signed axes as x and z of the tip."""
        pairs = [(sign, 'xz'.index(axis)) for sign, axis in map(signed, (x, z))]
        found = copy(self)
        found.measured = [np.array([s * tip[k] for s, k in pairs]) for tip in self.measured]
        return found

    def _responses(self, at: int, *lengths: float) -> TipResponses:
        return self._insertions[at].responses(*lengths)


class Optimum(NamedTuple):
    """Best lengths as search variables (k,), with -2 log likelihood and its curvature (k, k)."""

    x: FloatArray
    deviance: float
    curvature: FloatArray

    @property
    def spread(self) -> FloatArray:
        """Covariance of the variables, with a deviation of 1 if they are not determined."""
        return np.asarray(np.linalg.inv(0.5 * self.curvature + np.eye(len(self.x))))


class Search:
    """
    Likelihood of recorded insertions as a function of the lengths.

    The variables are the logarithm of the free length, unless ``free`` [m] is given, and for each
    medium the logarithm of the bending length, skin / (skin + scale), and the logarithms of the
    bending length in deeper layers.
    """

    def __init__(
        self,
        tips: Tips,
        terms: tuple[str, ...],
        free: float | None,
        models: Sequence[MixedModel] = (),
    ) -> None:
        self.tips, self.terms, self.known = tips, terms, free
        self.width = 1 + len(tips.layers.starts)  #: number of variables of a medium
        media = [one.medium for one in tips.recordings]
        self.members = {
            medium: [k for k, other in enumerate(media) if other == medium]
            for medium in dict.fromkeys(media)
        }
        self.models = models or self.models_for([_NOISE] * len(self.members))
        ends = zip(FREE, LENGTH, SKIN, strict=True)
        self.bounds = np.array([self.variables(*end, len(self.members)) for end in ends])
        #: Length of the longest interval of each variable that is determined.
        self.ranges = np.ptp(self.bounds, axis=0)
        if self.layered:
            for medium in range(len(self.members)):
                of_layers = self.layers(medium)
                self.bounds[:, of_layers] = np.log(LENGTH)[:, np.newaxis]
                self.ranges[of_layers] = _KNOWN
        self._part = lru_cache(maxsize=64)(self._fit)

    def models_for(self, noises: Sequence[float]) -> list[MixedModel]:
        """Return the model of each medium for the noise of its readings [m]."""
        deviations = [DEVIATIONS[term] for term in self.terms for _ in TERMS[term]]
        return [
            MixedModel([self.tips.moved[at] for at in members], noise / np.array(deviations))
            for noise, members in zip(noises, self.members.values(), strict=True)
        ]

    def variables(self, free: float, length: float, skin: float, media: int = 1) -> FloatArray:
        """Return the search variables for the same lengths [m] of all media."""
        own = [log(length), skin / (skin + _SCALE), *map(log, self._deeper(length))] * media
        return np.array(own if self.known is not None else [log(free), *own])

    def lengths(self, x: FloatArray) -> list[tuple[float, ...]]:
        """Return free length, bending length, skin, and deeper lengths of each medium [m]."""
        own = x.tolist()
        free = self.known if self.known is not None else exp(own.pop(0))
        each = [own[k : k + self.width] for k in range(0, len(own), self.width)]
        return [(free, exp(length), skin_of(u), *map(exp, deeper)) for length, u, *deeper in each]

    def _deeper(self, length: float) -> list[float]:
        """Return the bending lengths of deeper layers with nominal ratios to the first [m]."""
        first, *deeper = self.tips.layers.lengths
        return [length * one / first for one in deeper]

    @property
    def layered(self) -> bool:
        return len(self.tips.layers.starts) > 1

    def layers(self, medium: int) -> list[int]:
        """Return the indices of the bending length in each layer."""
        first, _, *deeper = self.own(medium)[-self.width :]
        return [first, *deeper]

    def apart(self, x: FloatArray) -> FloatArray:
        """Return the deviations of layers from the mean of their medium, over the prior one."""
        if not self.layered:
            return np.zeros(0)
        nominal = np.log(self.tips.layers.lengths)
        logs = [4.0 * (nominal - x[self.layers(k)]) for k in range(len(self.members))]
        return np.concatenate([(one - one.mean()) / _LAYERS for one in logs])

    def design(self, at: int, *lengths: float) -> tuple[FloatArray, FloatArray]:
        """Return the response to the guide (2, n), and to the drift constants (2, n, c)."""
        one, known = self.tips.recordings[at], self.tips.known[at]
        r = self.tips.of(at, *lengths)
        return r.guide[known].T, drift(self.terms, one, r)[:, known]

    def fits(self, x: FloatArray) -> list[Likelihood]:
        return [self._part(k, *own) for k, own in enumerate(self.lengths(x))]

    def _fit(self, medium: int, *lengths: float) -> Likelihood:
        members = list(self.members.values())[medium]
        parts = [self.design(at, *lengths) for at in members]
        left = [
            self.tips.measured[at] - guide for at, (guide, _) in zip(members, parts, strict=True)
        ]
        return self.models[medium].likelihood([columns for _, columns in parts], left)

    def deviance(self, x: FloatArray) -> float:
        """Return -2 log likelihood of all media, with the prior of layers."""
        return sum(one.deviance for one in self.fits(x)) + float(np.sum(self.apart(x) ** 2))

    def descend(self, first: FloatArray, free: Sequence[int] | None = None) -> Optimum:
        """Search over variables with these indices: least squares by the weights of each round."""
        at = list(range(len(first)) if free is None else free)
        low, high = self.bounds
        x = np.clip(first, low, high)
        now, jacobian = self.deviance(x), np.zeros((1, len(at)))
        for _ in range(_ROUNDS if at else 0):
            trial = x.copy()
            found = least_squares(
                self._residual(x, at),
                x[at],
                bounds=(low[at], high[at]),
                x_scale='jac',
                max_nfev=6,
                ftol=1e-5,
            )
            trial[at] = found.x
            gain, jacobian = now - self.deviance(trial), found.jac
            if gain > 0.0:
                x, now = trial, now - gain
            if gain < _SETTLED:
                break
        return Optimum(x, now, 2.0 * jacobian.T @ jacobian)

    def steps(self, x: FloatArray) -> Iterator[tuple[float, FloatArray]]:
        """Return a small step of each variable within the bounds, and the variables after it."""
        for k in range(len(x)):
            there = x.copy()
            there[k] += _STEP if x[k] + _STEP < self.bounds[1, k] else -_STEP
            yield float(there[k] - x[k]), there

    def changes(self, x: FloatArray, medium: int, at: int, drift: FloatArray) -> FloatArray:
        """Return derivatives (2, n, k) of the tip by the variables, for a constant drift."""

        def tip(there: FloatArray) -> FloatArray:
            guide, columns = self.design(at, *self.lengths(there)[medium])
            return np.asarray(guide + columns @ drift)

        each = [(tip(there) - tip(x)) / step for step, there in self.steps(x)]
        return np.stack(each, axis=-1)

    def information(self, x: FloatArray) -> FloatArray:
        """Return the information (k,) of the motions of guide and roll on each variable."""
        found = np.zeros(len(x))
        for medium, (one, members) in enumerate(
            zip(self.fits(x), self.members.values(), strict=True)
        ):
            rolls = [np.ptp(self.tips.recordings[at].roll) for at in members]
            drift = one.drift * (max(rolls) > _ROLLED)
            columns = [self.design(at, *self.lengths(x)[medium])[1] for at in members]
            changes = [self.changes(x, medium, at, drift) for at in members]
            for k in range(len(x)):
                own = [change[..., k] for change in changes]
                left = self.models[medium].likelihood(columns, own).residuals
                found[k] += one.weights @ ((left**2).sum(axis=1) / one.variances)
        return found

    def own(self, medium: int) -> list[int]:
        """Return the indices of the variables on which a medium depends."""
        first = int(self.known is None)
        begin = first + self.width * medium
        return [*range(first), *range(begin, begin + self.width)]

    def freedom(self, x: FloatArray) -> list[float]:
        """Return the degrees of freedom of the white noise of each medium."""
        return [
            max(model.freedom - one.known - self.width - 1, 1.0)
            for model, one in zip(self.models, self.fits(x), strict=True)
        ]

    def spreads(self, x: FloatArray) -> list[FloatArray]:
        """Return the covariances (K, k, k) of the variables of each medium, by ratio."""
        changed = [(step, self.fits(there)) for step, there in self.steps(x)]
        apart = self.apart(x)
        prior = np.array([(self.apart(there) - apart) / step for step, there in self.steps(x)])
        found: list[FloatArray] = []
        for medium, one in enumerate(self.fits(x)):
            scale = np.sqrt(one.variances)[:, np.newaxis]
            steps = [(changed[k][1][medium], changed[k][0]) for k in self.own(medium)]
            each = [(there.residuals - one.residuals) / (step * scale) for there, step in steps]
            jacobian = np.stack(each, axis=-1)
            normal = np.swapaxes(jacobian, 1, 2) @ jacobian
            normal += prior[self.own(medium)] @ prior[self.own(medium)].T
            # A deviation of 1 if they are not determined.
            found.append(np.asarray(np.linalg.inv(normal + np.eye(len(steps)))))
        return found

    def residuals(self, x: FloatArray) -> list[FloatArray]:
        """Return measured minus fitted tips of each recording (n, 2) [m]."""
        found = {}
        for one, lengths, members in zip(
            self.fits(x), self.lengths(x), self.members.values(), strict=True
        ):
            for at in members:
                guide, columns = self.design(at, *lengths)
                left = self.tips.measured[at] - guide - columns @ one.drift
                found[at] = left.T - left.mean(axis=1)
        return [found[at] for at in sorted(found)]

    def _residual(self, x: FloatArray, at: list[int]) -> Callable[[FloatArray], FloatArray]:
        """Return the residuals for least squares near x by the variables with these indices."""
        each = [(one, one.weights > _NOTHING) for one in self.fits(x)]
        factors = [np.sqrt(one.weights / one.variances)[kept, np.newaxis] for one, kept in each]
        models = [m.limited(kept) for m, (_, kept) in zip(self.models, each, strict=True)]
        near, there = Search(self.tips, self.terms, self.known, models), x.copy()

        def residual(values: FloatArray) -> FloatArray:
            there[at] = values
            parts = zip(factors, near.fits(there), strict=True)
            return np.concatenate(
                [*((own * one.residuals).ravel() for own, one in parts), self.apart(there)]
            )

        return residual

    def optima(self, near: Sequence[FloatArray] = ()) -> list[Optimum]:
        """Return distinct optima, the best first; from a grid without near points."""
        found: list[Optimum] = []
        for one in sorted(map(self.descend, near or self._starts()), key=lambda one: one.deviance):
            if all(np.abs(one.x - other.x).max() > _APART for other in found):
                found.append(one)
        return found

    def least(self, medium: int) -> float:
        """Return the least deviance of a medium on a coarse grid."""
        frees = _FREES[1::2] if self.known is None else [self.known]
        points = product(frees, _LENGTHS[1::2], _SKINS[::2])
        return min(
            self._part(medium, free, length, skin, *self._deeper(length)).deviance
            for free, length, skin in points
        )

    def _starts(self) -> list[FloatArray]:
        starts = []
        for skin in _SKINS:
            trials = []
            for free in _FREES if self.known is None else [self.known]:
                x, total = self.variables(free, 1.0, skin)[: -self.width], 0.0
                for k in range(len(self.members)):
                    each = {
                        one: self._part(k, free, one, skin, *self._deeper(one)).deviance
                        for one in _LENGTHS
                    }
                    best = min(_LENGTHS, key=each.__getitem__)
                    x = np.append(x, self.variables(free, best, skin)[-self.width :])
                    total += each[best]
                trials.append((total, x))
            starts.append(min(trials, key=lambda one: one[0])[1])
        return starts


def searched(
    tips: Tips, terms: tuple[str, ...], free: float | None
) -> tuple[Search, list[Optimum]]:
    """Return a search and its optima, with priors relative to the noise of the fit before."""
    search = Search(tips, terms, free)
    optima = search.optima()
    noises = [sqrt(float(one.weights @ one.variances)) for one in search.fits(optima[0].x)]
    search = Search(tips, terms, free, search.models_for(noises))
    return search, search.optima([one.x for one in optima])


def skin_of(variable: float) -> float:
    """Return the skin [m] of a search variable."""
    return _SCALE * variable / (1.0 - variable)


def interval(
    search: Search, optima: Sequence[Optimum], k: int, rise: float
) -> tuple[float, float]:
    """Return the profile likelihood interval of variable k; infinite at a bound of the search."""
    # It contains all optima whose deviance is within `rise` of the first, which is the best.
    alike = [one for one in optima if one.deviance - optima[0].deviance <= rise]
    level = optima[0].deviance + rise
    alike.sort(key=lambda one: float(one.x[k]))
    low = _end(search, optima, alike[0], k, -1.0, level)
    return low, _end(search, optima, alike[-1], k, 1.0, level)


def _end(
    search: Search, optima: Sequence[Optimum], start: Optimum, k: int, sign: float, level: float
) -> float:
    """Return the end of an interval in a direction from an optimum."""
    others = [i for i in range(len(start.x)) if i != k]
    bound = float(search.bounds[int(sign > 0.0), k])
    seeds = [start.x, *(one.x for one in optima)]

    def above(value: float) -> float:
        """Search over the other variables, from the best of several starts."""
        trials = [np.array(seed) for seed in seeds]
        for trial in trials:
            trial[k] = value
        found = search.descend(min(trials, key=search.deviance), others)
        seeds[0] = found.x
        return found.deviance - level

    near, low, high = float(start.x[k]), start.deviance - level, -1.0
    step, far = sqrt(-start.spread[k, k] * low), near
    while high < 0.0:
        near, low = (far, high) if far != near else (near, low)
        far = near + copysign(min(step, 0.5, abs(bound - near)), sign)
        if far == near:
            return copysign(inf, sign)
        high, step = above(far), 1.5 * step
    width = abs(far - near)
    while abs(far - near) > _NEAR * width and high > _NEAR * (level - start.deviance):
        # A secant that shortens the bracket from both ends.
        middle = near + min(max(low / (low - high), 0.1), 0.9) * (far - near)
        now = above(middle)
        near, low, far, high = (near, low, middle, now) if now >= 0.0 else (middle, now, far, high)
    return far


class Prediction(NamedTuple):
    """Measured minus predicted tips beyond the first depths, and their standard deviations."""

    errors: FloatArray  # (n, 2) [m]
    deviations: FloatArray  # (n, 2) [m]


def held_out(search: Search, best: Optimum, medium: int) -> HeldOut | None:
    """Predict each recording of a medium from all others; None for fewer than two."""
    members = list(search.members.values())[medium]
    if len(members) < 2:
        return None
    found = []
    for k, at in enumerate(members):
        rest = [own for each in search.members.values() for own in each if own != at]
        others = [search.tips.recordings[own] for own in rest]
        models = list(search.models)
        depths = [*models[medium].depths[:k], *models[medium].depths[k + 1 :]]
        whole = models[medium]
        models[medium] = MixedModel(depths, whole.prior, whole.ratios, whole.penalties)
        tips = Tips(others, search.tips.order, search.tips.layers)
        fitted = Search(tips, search.terms, search.known, models)
        found.append(predict(search, fitted, fitted.descend(best.x), medium, at))
    found = [one for one in found if len(one.errors)]
    if len(found) < 2:
        return None
    # The errors along a path are alike: each recording has one error in each plane.
    rms, freedom = rms_of([one.errors for one in found]), 2 * len(found)
    low, high = (rms * sqrt(freedom / float(chdtri(freedom, p))) for p in (0.025, 0.975))
    held = np.concatenate(
        [
            np.abs(one.errors) <= reach * one.deviations
            for one, reach in zip(found, reaches(found), strict=True)
        ]
    )
    return HeldOut(rms=rms, interval=(low, high), coverage=float(np.mean(held)))


def reaches(found: Sequence[Prediction]) -> FloatArray:
    """Return the 95 % intervals over the deviations, (r,), by the errors of the others."""
    # A wrong model, not only its constants, makes errors that exceed their deviations.
    squares = np.array([np.sum(np.mean((e / d) ** 2, axis=0)) for e, d in found])
    freedom = 2.0 * (len(found) - 1)
    return np.asarray(stdtrit(freedom, 0.975) * np.sqrt((squares.sum() - squares) / freedom))


def predict(search: Search, fitted: Search, best: Optimum, medium: int, at: int) -> Prediction:
    """Predict a recording of a search from its first depths, by a fit to others."""
    fit = fitted.fits(best.x)[medium]
    moved, tip = search.tips.moved[at], search.tips.measured[at]
    depth = moved[:, 0]
    guide, columns = search.design(at, *search.lengths(best.x)[medium])
    changes = search.changes(best.x, medium, at, fit.drift)
    columns, changes = (a.reshape(2 * len(depth), -1) for a in (columns, changes))
    first = np.tile(depth <= depth.min() + _START, 2)
    rest = ~first
    means, squares = np.zeros((2, np.count_nonzero(rest)))
    for weight, variance, values, own, ratio in zip(
        fit.weights, fit.variances, fit.values, fit.covariances,
        fitted.models[medium].ratios, strict=True,
    ):  # fmt: skip
        total = np.kron(np.eye(2), variance * covariance(moved, ratio) + _ANY**2)
        total += columns @ own @ columns.T + changes @ best.spread @ changes.T
        left = (tip - guide).ravel() - columns @ values
        gain = np.linalg.solve(total[np.ix_(first, first)], total[np.ix_(first, rest)]).T
        mean = left[rest] - gain @ left[first]
        square = mean**2 + np.diag(total)[rest]
        square -= np.einsum('ij,ji->i', gain, total[np.ix_(first, rest)])
        means, squares = means + weight * mean, squares + weight * square
    deviations = np.sqrt(squares - means**2)
    return Prediction(means.reshape(2, -1).T, deviations.reshape(2, -1).T)


def rms_of(errors: Sequence[FloatArray]) -> float:
    return float(np.sqrt(np.mean(np.concatenate(errors) ** 2)))
