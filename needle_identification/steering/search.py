"""The lengths that explain recorded insertions best, and how far they may be wrong."""

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

#: Where the search starts: bending lengths, free length [m] and scaled skin.
_STARTS: Final = (0.018, 0.035, 0.07)
_START_FREE, _START_SKIN = 0.03, 0.1

#: The scale of the skin in the search [m].
SKIN_SCALE: Final = 0.02

#: What is left is searched in this unit [m]: of the size of one, as the search expects.
_UNIT: Final = 1e-4

#: Step of the differences: the responses are exact to rounding [search variables].
_STEP: Final = 1e-5

#: Trials for an end of an interval, and how near to it is there.
_TRIALS, _NEAR = 12, 0.01

#: Media at lengths that are remembered.
_KEPT: Final = 256


class Search:
    """
    Recorded insertions as a function of their lengths: all else is linear, and solved for.

    The variables are the logarithm of the free length, unless it is known, and for each medium the
    logarithm of the bending length, and the skin over its scale.

    Parameters
    ----------
    recordings : sequence of SteeringRecording
        Recordings.
    terms : tuple of str
        What makes the needle drift.
    order : str
        One of `ORDERS`.
    free : float or None
        Free length if it is known [m].

    Attributes
    ----------
    media : tuple of str
        Media in the order in which they first come.
    members : dict
        Places of the recordings by medium.

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
        # A change of one medium leaves the others as they were.
        self._part = lru_cache(maxsize=_KEPT)(self._columns)
        self._left = lru_cache(maxsize=_KEPT)(self._rest)

    def lengths(self, x: FloatArray) -> tuple[float, list[tuple[float, float]]]:
        """
        Return what the variables stand for.

        Parameters
        ----------
        x : ndarray, shape (k,)
            The variables.

        Returns
        -------
        free : float
            Free length [m].
        media : list of tuple of float
            Bending length and skin of each medium [m].

        """
        own = x.tolist()
        free = self.known if self.known is not None else exp(own.pop(0))
        pairs = zip(own[::2], own[1::2], strict=True)
        return free, [(exp(length), SKIN_SCALE * skin) for length, skin in pairs]

    def design(self, x: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
        """
        Return the linear columns of each medium, and what its guide does not explain.

        Parameters
        ----------
        x : ndarray, shape (k,)
            The variables.

        Returns
        -------
        list of tuple of ndarray
            Shapes (2 n, columns) and (2 n,), for the n samples of the medium: of each recording
            x, then z. The last columns are the offsets of each recording.

        """
        free, lengths = self.lengths(x)
        return [self._part(k, free, *own) for k, own in enumerate(lengths)]

    def _columns(
        self, medium: int, free: float, length: float, skin: float
    ) -> tuple[FloatArray, FloatArray]:
        """Return the linear columns of a medium, and what its guide does not explain."""
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
        """Return what is left of a medium at the best linear parameters."""
        columns, left = self._part(medium, free, length, skin)
        return np.asarray(left - columns @ np.linalg.lstsq(columns, left)[0])

    def residual(self, x: FloatArray) -> FloatArray:
        """
        Return what is left at the best linear parameters.

        Parameters
        ----------
        x : ndarray, shape (k,)
            The variables.

        Returns
        -------
        ndarray
            Of all media [m].

        """
        free, lengths = self.lengths(x)
        return np.concatenate([self._left(k, free, *own) for k, own in enumerate(lengths)])

    def _search(self, first: FloatArray, free: Sequence[int]) -> tuple[FloatArray, float]:
        """Search over some of the variables from a start; return all, and the cost [m^2]."""
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
        """
        Return the best lengths.

        Parameters
        ----------
        near : ndarray, shape (k,), optional
            Variables from which to search; otherwise from several starts.

        Returns
        -------
        x : ndarray, shape (k,)
            The variables.
        cost : float
            Half the sum of squares that they leave [m^2].

        """
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
        """
        Differentiate the fitted tip by the variables, at fixed linear parameters.

        Parameters
        ----------
        x : ndarray, shape (k,)
            The variables.

        Returns
        -------
        ndarray, shape (samples, k)
            Derivatives [m].

        """
        values = [np.linalg.lstsq(a, y)[0] for a, y in self.design(x)]

        def fitted(at: FloatArray) -> FloatArray:
            parts = zip(self.design(at), values, strict=True)
            return np.concatenate([a @ v - y for (a, y), v in parts])

        steps = _STEP * np.eye(len(x))
        return np.array([(fitted(x + h) - fitted(x - h)) / (2.0 * _STEP) for h in steps]).T

    def interval(
        self, x: FloatArray, cost: float, k: int, width: float, rise: float
    ) -> tuple[float, float]:
        """
        Find how far a variable may be off: until the others cannot make up for it.

        Parameters
        ----------
        x : ndarray, shape (k,)
            The best variables.
        cost : float
            What they leave [m^2].
        k : int
            Which variable.
        width : float
            Half the width of its interval if the fit were linear.
        rise : float
            The root of twice the rise of the cost at the ends of the interval [m].

        Returns
        -------
        low, high : float
            Ends of the interval; infinite where the search ends before.

        """
        return (
            float(x[k]) - self._end(x, cost, k, -width, rise),
            float(x[k]) + self._end(x, cost, k, width, rise),
        )

    def _end(self, x: FloatArray, cost: float, k: int, first: float, rise: float) -> float:
        """Return how far from the best value an interval ends on one side."""
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
            # Nearly a straight line: follow its chords.
            if far < inf:
                trial = near + (far - near) * (rise - near_rise) / (far_rise - near_rise)
            else:
                trial *= min(max(rise / max(now, 1e-3 * rise), 1.1), 4.0)
        return trial
