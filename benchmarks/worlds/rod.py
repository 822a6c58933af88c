# SPDX-License-Identifier: Apache-2.0
"""
Geometrically exact rod on a foundation along its recorded path, by shooting.

An inextensible rod in space without twist: position r, tangent t, moment m and force n along the
arc length s, with r' = t, t' = m x t / (E I), m' = -t x n, n' = k d. The distance d from the path
is perpendicular to the rod, as there is no friction. Two components of m and all of n at the guide
are found by Newton's method, so that the tip has no moment and only the load of the bevel, which
turns with the tip.
"""

from __future__ import annotations

from math import ceil, sqrt
from typing import Final

from benchmarks.worlds.world import DrawnConstants, grown, IndependentNeedle, native
from needle_controller.steering.law import GuideSetpoint
from needle_dynamics import FloatArray
import numpy as np

#: Largest change of the unknowns in the last iteration, relative to their scale.
_CLOSE, _MOST = 1e-8, 30

#: Part of a motion of the guide for its derivative, and longest motion that is solved at once [m].
_SMALL, _AT_ONCE = 1e-4, 5e-4

#: Number of parts of a motion that does not converge.
_FINER: Final = 8


@native
def _rate(
    state: FloatArray,
    stiffness: float,
    k: float,
    path: FloatArray,
    end: FloatArray,
    found: FloatArray,
) -> None:
    """
    Compute the derivative of a state (r, t, m, n) by the arc length.

    ``path`` are points (k, 3); if ``end`` is not empty, it is the distance from the path.
    """
    r, t, m, n = state[:3], state[3:6], state[6:9], state[9:]
    found[:3] = t
    found[3] = (m[1] * t[2] - m[2] * t[1]) / stiffness
    found[4] = (m[2] * t[0] - m[0] * t[2]) / stiffness
    found[5] = (m[0] * t[1] - m[1] * t[0]) / stiffness
    found[6] = n[1] * t[2] - n[2] * t[1]
    found[7] = n[2] * t[0] - n[0] * t[2]
    found[8] = n[0] * t[1] - n[1] * t[0]
    if k == 0.0:
        found[9:] = 0.0
    elif len(end) > 0:
        found[9:] = k * end
    else:
        found[9:] = k * _distance(path, r, t)


@native
def _distance(path: FloatArray, r: FloatArray, t: FloatArray) -> FloatArray:
    """Return the distance of a point of the rod from the path, perpendicular to the rod [m]."""
    low, high = 0, len(path) - 1
    while high - low > 1:
        middle = (low + high) // 2
        if path[middle, 1] <= r[1]:
            low = middle
        else:
            high = middle
    along = path[high] - path[low]
    # At the end of the path also beyond it.
    part = min((r[1] - path[low, 1]) / along[1], 1.0)
    x, z = r[0] - path[low, 0] - part * along[0], r[2] - path[low, 2] - part * along[2]
    slope = x * t[0] + z * t[2]
    return np.array([x - slope * t[0], -slope * t[1], z - slope * t[2]])


@native
def _step(
    state: FloatArray, h: float, stiffness: float, k: float, path: FloatArray, end: FloatArray
) -> None:
    """Advance a state by the method of Runge and Kutta."""
    one, two, three, four = np.empty((4, 12))
    _rate(state, stiffness, k, path, end, one)
    _rate(state + 0.5 * h * one, stiffness, k, path, end, two)
    _rate(state + 0.5 * h * two, stiffness, k, path, end, three)
    _rate(state + h * three, stiffness, k, path, end, four)
    state += h / 6.0 * (one + 2.0 * two + 2.0 * three + four)


@native
def _shoot(
    guess: FloatArray,
    start: FloatArray,
    length: float,
    size: float,
    stiffness: float,
    k: float,
    skin: float,
    entry: FloatArray,
    path: FloatArray,
    cutting: bool,
    load: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Integrate from the guide; return the remaining load and moment of the tip, and its state."""
    state = start.copy()
    t = start[3:6]
    # Moments perpendicular to the rod.
    state[6], state[8] = guess[0], guess[1]
    state[7] = -(guess[0] * t[0] + guess[1] * t[2]) / t[1]
    state[9:] = guess[2:]
    count = ceil(length / size)
    h = length / count
    none = end = np.empty(0)
    fading = done = 0.0
    stops = np.array([0.0, path[-1, 1]])
    inside = 0
    for _ in range(count):
        left = h
        # A step ends at the skin and at the end of the path.
        while k > 0.0 and inside < 2 and state[1] + left * state[4] > stops[inside]:
            part = min(max((stops[inside] - state[1]) / state[4], 0.0), left)
            _step(state, part, stiffness, 0.0 if inside == 0 else k, path, none)
            left -= part
            done += part
            if inside == 0:
                away = state[:3] - entry
                state[9] += skin * away[0]
                state[11] += skin * away[2]
            elif cutting:
                end, fading = _distance(path, state[:3], state[3:6]), length - done
            inside += 1
        if fading > 0.0:
            # The distance falls to zero at the tip, which is on its path.
            middle = max(0.0, 1.0 - (done + 0.5 * left - (length - fading)) / fading)
            _step(state, left, stiffness, k, path, middle * end)
        else:
            _step(state, left, stiffness, 0.0 if inside == 0 else k, path, none)
        done += left
    if k == 0.0:
        # The needle is on the skin.
        state[9:] += skin * (state[:3] - entry)
        state[10] = guess[3]
    t = state[3:6]
    across = load - (load @ t) * t
    off = np.empty(5)
    off[:3], off[3], off[4] = state[9:] - across, state[6], state[8]
    return off, state


@native
def _solve(
    guess: FloatArray,
    start: FloatArray,
    motion: FloatArray,
    length: float,
    size: float,
    stiffness: float,
    k: float,
    skin: float,
    entry: FloatArray,
    path: FloatArray,
    cutting: bool,
    load: FloatArray,
) -> tuple[bool, FloatArray]:
    """
    Find moments and forces at the guide after its motion, in place.

    Returns success and the state of the tip.
    """
    scale = np.array([1e-2, 1e-2, 1.0, 1.0, 1.0])
    slopes, found = np.empty((5, 5)), np.empty(12)
    moving = np.abs(motion).max() > 0.0
    for _ in range(_MOST):
        off, found = _shoot(
            guess, start, length, size, stiffness, k, skin, entry, path, cutting, load
        )
        for i in range(5):
            other, small = guess.copy(), 1e-6 * scale[i]
            other[i] += small
            there, _ = _shoot(
                other, start, length, size, stiffness, k, skin, entry, path, cutting, load
            )
            slopes[:, i] = (there - off) / small
        if moving:
            # The tip of a rod with the old load would be far away: begin with the linear change.
            moved = start.copy()
            moved[:3] += _SMALL * motion
            there, _ = _shoot(
                guess, moved, length, size, stiffness, k, skin, entry, path, cutting, load
            )
            off += (there - off) / _SMALL
            start[:3] += motion
        if not (np.isfinite(slopes).all() and np.isfinite(off).all()):
            break
        change = np.linalg.solve(slopes, off)
        guess -= change
        if not moving and np.abs(change / scale).max() < _CLOSE:
            return True, found
        moving = False
    return False, found


class ExactRod(IndependentNeedle):
    """
    Rod in space; the guide is at y = -L0, and the insertion depth is along the needle.

    ``size`` is the largest step along the rod and the longest increment of the path [m].
    """

    def __init__(
        self, constants: DrawnConstants, depths: FloatArray, size: float = 2.5e-3
    ) -> None:
        super().__init__(constants, depths)
        self._size, self._inserted = size, 0.0
        x, z = constants.tilt
        ahead = sqrt(1.0 - x * x - z * z)
        self._start = np.array([0.0, -constants.free, 0.0, x, ahead, z, *[0.0] * 6])
        self._guess, self._skin = np.zeros(5), 0.0
        self._entry, self._path = np.zeros(3), np.array([[0.0, 1.0, 0.0], [0.0, 2.0, 0.0]])
        self._end = self._start
        # The skin is where the loaded tip is at the start.
        self._solve(cutting=False)
        self._entry, self._skin = self._end[:3].copy(), constants.skin

    def _solve(self, motion: FloatArray | None = None, *, cutting: bool) -> None:
        """Compute the state of the tip; a needle that cuts ends on its path."""
        shift = np.zeros(3) if motion is None else motion
        c = self.constants
        x, z = c.load(self._inserted - 0.5 * self._size)
        load = np.array([x, 0.0, z])
        path = np.ascontiguousarray(self._path)
        good, end = _solve(
            self._guess, self._start, shift, c.free + self._inserted, 2.0 * self._size,
            c.stiffness, c.tissue if self._inserted > 0.0 else 0.0, self._skin, self._entry, path,
            cutting, load,
        )  # fmt: skip
        if not good:
            raise ArithmeticError('the shape of the rod does not converge')
        self._end = end

    @property
    def position(self) -> FloatArray:
        return np.array(self._end[[0, 2]])

    @property
    def guide_load(self) -> FloatArray:
        return np.array([self._guess[[2, 4]]])

    def guide(self, to: GuideSetpoint) -> None:
        motion = np.array([to.x, -self.constants.free, to.z]) - self._start[:3]
        parts = max(1, ceil(np.abs(motion).max() / _AT_ONCE))
        guess, start = self._guess.copy(), self._start.copy()
        try:
            for _ in range(parts):
                self._solve(motion / parts, cutting=False)
        except ArithmeticError:
            self._guess, self._start = guess, start
            for _ in range(_FINER * parts):
                self._solve(motion / (_FINER * parts), cutting=False)

    def advance(self, depth: float) -> None:
        first = self._end[:3].copy()
        if self._inserted == 0.0:
            self._path = np.array([first, first])
            self._path[0, 1] -= self._size
        else:
            # The path continues from the tip, which has moved since the last increment: the mean
            # of both positions has the same effect, and no jump.
            self._path[-1, [0, 2]] = 0.5 * (self._path[-1] + first)[[0, 2]]
        for at in grown(self._inserted, depth, self._size):
            self._inserted = at
            self._solve(cutting=True)
            self._path = np.vstack([self._path, self._end[:3]])
