# SPDX-License-Identifier: Apache-2.0
"""Prediction of recordings by a fit to the others."""

from collections.abc import Sequence
from math import sqrt
from typing import Final, NamedTuple

from needle_dynamics.arrays import BoolArray, FloatArray
from needle_identification.steering.estimate import HeldOut
from needle_identification.steering.mixed import covariance, MixedModel
from needle_identification.steering.search import Optimum, Search, Tips
import numpy as np
from scipy.special import chdtri, stdtrit

_START: Final = 0.015  # depth of the measurements that determine offset and slope [m]
_ANY: Final = 1.0  # standard deviation of the offset [m]


class Prediction(NamedTuple):
    """Measured minus predicted tips beyond the first depths, and whether they are expected."""

    errors: FloatArray  # (n, 2) [m]
    held: BoolArray  # (n, 2) within the 95 % interval


def held_out(search: Search, best: Optimum, medium: int) -> HeldOut | None:
    """Predict each recording of a medium from all others; None for a single recording."""
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
        models[medium] = MixedModel(depths, whole.ratios, whole.penalties)
        fitted = Search(Tips(others, search.tips.order), search.terms, search.known, models)
        found.append(predict(search, fitted, fitted.descend(best.x), medium, at))
    rms, freedom = rms_of([one.errors for one in found]), 2 * len(found)
    low, high = (rms * sqrt(freedom / float(chdtri(freedom, p))) for p in (0.025, 0.975))
    coverage = float(np.mean(np.concatenate([one.held for one in found])))
    return HeldOut(rms=rms, interval=(low, high), coverage=coverage)


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
    # The errors along a path are alike: each fitted recording has one error in each plane.
    freedom = max(1, 2 * len(fitted.models[medium].depths) - len(fit.drift))
    half = stdtrit(freedom, 0.975) * np.sqrt(squares - means**2)
    held = np.abs(means) <= half
    return Prediction(means.reshape(2, -1).T, held.reshape(2, -1).T)


def rms_of(errors: Sequence[FloatArray]) -> float:
    return float(np.sqrt(np.mean(np.concatenate(errors) ** 2)))
