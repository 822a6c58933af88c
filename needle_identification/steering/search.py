"""Nonlinear least squares search for the lengths, and their profile intervals."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from math import copysign, exp, inf, log, sqrt
from typing import Final

from needle_dynamics.arrays import FloatArray
from needle_identification.steering.recording import SteeringRecording
from needle_identification.steering.response import drift, responses
import numpy as np
from scipy.optimize import least_squares

#: Bounds of free length, bending length and skin [m].
FREE: Final = (1e-3, 0.3)
LENGTH: Final = (4e-3, 0.5)
SKIN: Final = (0.0, 0.5)

#: Start values of the search: bending lengths, free length [m] and scaled skin.
_STARTS: Final = (0.018, 0.035, 0.07)
_START_FREE, _START_SKIN = 0.03, 0.1

SKIN_SCALE: Final = 0.02  #: the scale of the skin in the search [m]
_UNIT: Final = 1e-4  # unit of the residuals in the search [m], for values of order 1

#: Finite difference step [search variables]; the responses are exact to rounding.
_STEP: Final = 1e-5

#: Largest number of iterations for an end of an interval, and relative tolerance.
_TRIALS, _NEAR = 12, 0.01

_KEPT: Final = 256  # size of the cache of media at given lengths


class Search:
    """
    Tip residuals of recorded insertions as a function of the lengths (variable projection).

    The variables are the logarithm of the free length, unless ``free`` [m] is given, and for each
    medium the logarithm of the bending length, and the skin over its scale.
    """

    def __init__(
        self,
        recordings: Sequence[SteeringRecording],
        terms: tuple[str, ...],
        order: str,
        free: float | None,
    ) -> None:
        self.recordings, self.terms, self.order = recordings, terms, order
        self.known = free
        self.media = tuple(dict.fromkeys(one.medium for one in recordings))
        self.members = {
            medium: [k for k, one in enumerate(recordings) if one.medium == medium]
            for medium in self.media
        }
        low = [log(LENGTH[0]), SKIN[0] / SKIN_SCALE] * len(self.media)
        high = [log(LENGTH[1]), SKIN[1] / SKIN_SCALE] * len(self.media)
        if free is None:
            low, high = [log(FREE[0]), *low], [log(FREE[1]), *high]
        self._bounds = np.array([low, high])
        # The columns of a medium depend on its lengths only.
        self._part = lru_cache(maxsize=_KEPT)(self._columns)
        self._left = lru_cache(maxsize=_KEPT)(self._rest)

    def lengths(self, x: FloatArray) -> tuple[float, list[tuple[float, float]]]:
        """Return the free length [m], and bending length and skin of each medium [m]."""
        own = x.tolist()
        free = self.known if self.known is not None else exp(own.pop(0))
        pairs = zip(own[::2], own[1::2], strict=True)
        return free, [(exp(length), SKIN_SCALE * skin) for length, skin in pairs]

    def design(self, x: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
        """Return linear columns (2 n, c) and the tip without guide response, by medium."""
        free, lengths = self.lengths(x)
        return [self._part(k, free, *own) for k, own in enumerate(lengths)]

    def _columns(
        self, medium: int, free: float, length: float, skin: float
    ) -> tuple[FloatArray, FloatArray]:
        """Return linear columns of a medium, and the tip without guide response."""
        rows, left = [], []
        members = self.members[self.media[medium]]
        for k, at in enumerate(members):
            one = self.recordings[at]
            r = responses(one, free, length, skin, self.order)
            n, known = len(one.depth), np.tile(one.known, 2)
            offsets = np.zeros((2 * n, 2 * len(members)))
            offsets[:n, 2 * k] = offsets[n:, 2 * k + 1] = 1.0
            columns = np.hstack([*(drift(term, one, r) for term in self.terms), offsets])
            rows.append(columns[known])
            left.append((one.tip - r.guide).T.ravel()[known])
        return np.vstack(rows), np.concatenate(left)

    def _rest(self, medium: int, free: float, length: float, skin: float) -> FloatArray:
        """Return the residuals of a medium at the best linear constants."""
        columns, left = self._part(medium, free, length, skin)
        return np.asarray(left - columns @ np.linalg.lstsq(columns, left)[0])

    def residual(self, x: FloatArray) -> FloatArray:
        """Return the residuals of all media at the best linear constants [m]."""
        free, lengths = self.lengths(x)
        return np.concatenate([self._left(k, free, *own) for k, own in enumerate(lengths)])

    def _search(self, first: FloatArray, free: Sequence[int]) -> tuple[FloatArray, float]:
        """Search over variables with these indices; return all variables and the cost [m^2]."""
        at = list(free)
        x = first.copy()

        def residual(values: FloatArray) -> FloatArray:
            x[at] = values
            return self.residual(x) / _UNIT

        low, high = self._bounds[:, at]
        start = np.clip(first[at], low, high)
        found = least_squares(residual, start, bounds=(low, high), x_scale='jac', xtol=1e-8)
        x[at] = found.x
        return x, _UNIT**2 * float(found.cost)

    def best(self, near: FloatArray | None = None) -> tuple[FloatArray, float]:
        """Return the best variables (k,) and half their sum of squares [m^2]."""
        if near is not None:
            return self._search(near, range(len(near)))
        found = []
        for start in _STARTS:
            first = [log(start), _START_SKIN] * len(self.media)
            if self.known is None:
                first = [log(_START_FREE), *first]
            found.append(self._search(np.array(first), range(len(first))))
        return min(found, key=lambda one: one[1])

    def slopes(self, x: FloatArray) -> FloatArray:
        """Return derivatives of the fitted tip by the variables at fixed linear constants [m]."""
        values = [np.linalg.lstsq(a, y)[0] for a, y in self.design(x)]

        def fitted(at: FloatArray) -> FloatArray:
            parts = zip(self.design(at), values, strict=True)
            return np.concatenate([a @ v - y for (a, y), v in parts])

        steps = _STEP * np.eye(len(x))
        return np.array([(fitted(x + h) - fitted(x - h)) / (2.0 * _STEP) for h in steps]).T

    def interval(
        self, x: FloatArray, cost: float, k: int, width: float, rise: float
    ) -> tuple[float, float]:
        """Return the profile likelihood interval of variable k; infinite at a search bound."""
        return (
            float(x[k]) - self._end(x, cost, k, -width, rise),
            float(x[k]) + self._end(x, cost, k, width, rise),
        )

    def _end(self, x: FloatArray, cost: float, k: int, first: float, rise: float) -> float:
        """Return the distance from the best value to an end of the interval."""
        others = [i for i in range(len(x)) if i != k]
        bound = float(self._bounds[int(first > 0.0), k])
        reach = abs(bound - float(x[k]))
        start = x.copy()
        trial, near, near_rise, far, far_rise = abs(first), 0.0, 0.0, inf, inf
        for _ in range(_TRIALS):
            trial = min(trial, reach)
            start[k] = bound if trial == reach else x[k] + copysign(trial, first)
            if others:
                start, there = self._search(start, others)
            else:
                there = 0.5 * float(np.sum(self.residual(start) ** 2))
            now = sqrt(max(0.0, 2.0 * (there - cost)))
            if abs(now - rise) <= _NEAR * rise:
                return trial
            if now > rise:
                far, far_rise = trial, now
            elif trial == reach:
                return inf
            else:
                near, near_rise = trial, now
            # The root of the rise is nearly linear: secant steps.
            if far < inf:
                trial = near + (far - near) * (rise - near_rise) / (far_rise - near_rise)
            else:
                trial *= min(max(rise / max(now, 1e-3 * rise), 1.1), 4.0)
        return trial
