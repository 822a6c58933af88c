# SPDX-License-Identifier: Apache-2.0
"""Compute displacement and force of each hold relative to the rests."""

from dataclasses import dataclass
from math import exp, hypot, log, pi, sqrt
from typing import Final, NamedTuple

from needle_dynamics.arrays import BoolArray, FloatArray, IntArray
from needle_identification.errors import IdentificationError
from needle_identification.recordings.recording import IndentationRecording
from needle_identification.stiffness.plateaus import Plateaus, StiffnessSettings
import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.optimize import minimize_scalar

_SAME_DIRECTION: Final = pi / 18.0  # largest angle between forces of the same direction [rad]
_CLEARLY: Final = 4.0  # smallest ratio of creep or hysteresis to its error
_LEAST_MEMORY: Final = 1e-3  # smallest creep or hysteresis that counts
_FEWEST_FOR_MEMORY: Final = 4  # smallest number of presses with a rest after them
_WORTH_WARNING: Final = 0.1  # relative drift of the zero above which a warning is given


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class Presses:
    """Presses of a recording, relative to the adjacent rests; x and z in columns."""

    time: FloatArray  #: (m,) center of the hold [s]
    displacement: FloatArray  #: (m, 2) mean displacement [m]
    force: FloatArray  #: (m, 2) mean force on the tissue [N]
    displacement_error: FloatArray  #: (m, 2) standard error, for autocorrelated samples
    force_error: FloatArray  #: (m, 2) likewise
    off_plane: FloatArray  #: (m,) displacement out of the plane [m]
    level: IntArray  #: (m,) index of the force level
    direction: IntArray  #: (m,) index of the direction

    def __repr__(self) -> str:
        levels, directions = int(self.level.max()) + 1, int(self.direction.max()) + 1
        return f'<Presses: {len(self.time)} in {directions} directions at {levels} force levels>'


class PressNoise(NamedTuple):
    """Noise of the presses."""

    force: FloatArray  # (m, 2) variance of the means of the holds [N^2]
    displacement: FloatArray  # likewise [m^2]
    force_zero: FloatArray  # (m, m) covariance of the zeros of an axis [N^2]
    displacement_zero: FloatArray  # likewise [m^2]
    force_rounding: FloatArray  # (2, m, m) covariance by the resolution of each axis [N^2]
    displacement_rounding: FloatArray  # likewise [m^2]
    creep: float  # growth of a displacement during its hold, as a fraction
    set: float  # fraction of a displacement that remains at the next rest

    @property
    def systematic(self) -> float:
        """Relative standard error of all stiffnesses by creep and by hysteresis."""
        return hypot(self.creep, self.set)

    def covariance(
        self, matrix: FloatArray, chosen: IntArray, *, pooled: bool
    ) -> tuple[FloatArray, FloatArray]:
        """
        Return the covariance (2, m, m) of F - K d by row of K [N^2], or of pooled noise.

        Also return the share (2,) of rounding in it.
        """
        force, displacement = self.force[chosen], self.displacement[chosen]
        squares: FloatArray = matrix**2
        if pooled:
            force, displacement, squares = (
                np.full_like(a, a.mean()) for a in (force, displacement, squares)
            )
        else:
            # Rounding may give a hold too small a variance.
            force, displacement = (
                np.maximum(a, 0.1 * a.mean(axis=0)) for a in (force, displacement)
            )
        among = np.ix_(chosen, chosen)
        rows, shares = [], []
        for row in range(2):
            noise = np.diag(force[:, row] + displacement @ squares[row])
            noise += self.force_zero[among] + squares[row].sum() * self.displacement_zero[among]
            rounding = self.force_rounding[row] + np.tensordot(
                squares[row], self.displacement_rounding, 1
            )
            rows.append(noise + rounding[among])
            shares.append(np.trace(rounding[among]) / np.trace(rows[-1]))
        return np.array(rows), np.array(shares)


def find_presses(
    recording: IndentationRecording, plateaus: Plateaus, settings: StiffnessSettings
) -> tuple[Presses, PressNoise, list[str]]:
    """Return the holds relative to the rests, their noise, and warnings."""
    rest, hold = plateaus.rest, ~plateaus.rest
    if not hold.any():
        highest = float(np.hypot(*(recording.force - plateaus.mean[rest, :2][0]).T).max())
        raise IdentificationError(
            f'no hold: no force is steady for {settings.hold_time:g} s and more than '
            f'{settings.rest_force:g} N from rest; the largest is {highest:.3g} N from rest'
        )
    time = plateaus.time[hold]
    change = np.empty((len(time), 5))
    covariances = []
    for channels in (slice(0, 2), slice(2, 4), slice(4, 5)):
        mean, variance = plateaus.mean[rest, channels], plateaus.variance[rest, channels]
        zero, covariance = _follow_zero(plateaus.time[rest], mean, variance.mean(axis=1), time)
        change[:, channels] = plateaus.mean[hold, channels] - zero
        covariances.append(covariance)
    force, displacement = change[:, :2], change[:, 2:4]
    variance, creep = plateaus.variance[hold], _fraction(plateaus.trend[hold, 2:4], displacement)
    left = _remaining(plateaus, displacement)
    level, direction = grouped(np.hypot(*force.T), settings.level_tolerance), _directions(force)
    alike = (direction[:, np.newaxis] == direction) & (level[:, np.newaxis] == level)
    rounding = np.array(
        [
            _of_rounding(size, values, alike)
            for size, values in zip(plateaus.rounding, plateaus.mean[hold].T, strict=True)
        ]
    )
    noise = PressNoise(
        force=variance[:, :2],
        displacement=variance[:, 2:4],
        force_zero=covariances[0],
        displacement_zero=covariances[1],
        force_rounding=rounding[:2],
        displacement_rounding=rounding[2:4],
        creep=creep,
        set=left,
    )
    presses = Presses(
        time=time,
        displacement=displacement,
        force=force,
        displacement_error=np.sqrt(noise.displacement + np.diag(covariances[1])[:, np.newaxis]),
        force_error=np.sqrt(noise.force + np.diag(covariances[0])[:, np.newaxis]),
        off_plane=change[:, 4],
        level=level,
        direction=direction,
    )
    for array in (getattr(presses, name) for name in Presses.__slots__):
        array.setflags(write=False)
    return presses, noise, _warnings(presses, noise, plateaus, settings)


def _of_rounding(variance: float, values: FloatArray, alike: BoolArray) -> FloatArray:
    """Return the covariance (m, m) of values relative to the rest, each rounded to a step."""
    if variance == 0.0:
        return np.zeros(alike.shape)
    # Repetitions of a press have the same error; all presses have that of the rest in common.
    steps = np.rint(values / sqrt(12.0 * variance))
    return np.asarray(variance * (1.0 + (alike & (steps[:, np.newaxis] == steps))))


def _fraction(change: FloatArray, displacement: FloatArray) -> float:
    """Return the factor of changes (m, 2) that follow the displacements; 0 if insignificant."""
    power = float((displacement**2).sum())
    if power == 0.0:
        return 0.0
    factor = float((change * displacement).sum()) / power
    left = change - factor * displacement
    error = sqrt(float((left**2).sum()) / max(1, 2 * len(change) - 1) / power)
    return factor if factor > max(_CLEARLY * error, _LEAST_MEMORY) else 0.0


def _remaining(plateaus: Plateaus, displacement: FloatArray) -> float:
    """Return the fraction of a displacement that remains at the rest after its press."""
    holds = np.flatnonzero(~plateaus.rest)
    follows = np.isin(holds + 1, np.flatnonzero(plateaus.rest))
    if np.count_nonzero(follows) < _FEWEST_FOR_MEMORY:
        return 0.0
    after = plateaus.mean[holds[follows] + 1, 2:4]
    return _fraction(after - after.mean(axis=0), displacement[follows])


def _warnings(
    presses: Presses, noise: PressNoise, plateaus: Plateaus, settings: StiffnessSettings
) -> list[str]:
    warnings = []
    if plateaus.missed:
        warnings.append(
            f'presses left out: {plateaus.missed}, without a force steady within '
            f'{settings.level_tolerance:g} N for {settings.hold_time:g} s'
        )
    for what, unit, channels, usual in (
        ('force', 'N', slice(0, 2), float(np.hypot(*presses.force.T).min())),
        ('position', 'm', slice(2, 4), float(np.median(np.hypot(*presses.displacement.T)))),
    ):
        drift = float(np.hypot(*np.ptp(plateaus.mean[plateaus.rest, channels], axis=0)))
        if drift > _WORTH_WARNING * usual:
            warnings.append(
                f'the {what} at rest drifted by {drift:.2g} {unit}; the drift was subtracted'
            )
    memory = []
    if noise.creep:
        memory.append(f'the displacement grows by {noise.creep:.1%} during a hold (creep)')
    if noise.set:
        memory.append(f'{noise.set:.1%} of it remain at the next rest (hysteresis or creep)')
    if memory:
        warnings.append(f'{" and ".join(memory)}: the errors include it')
    return warnings


def grouped(sizes: FloatArray, tolerance: float) -> IntArray:
    """Group values (m,) within ``tolerance`` of the group mean; return ascending group numbers."""
    group = np.zeros(len(sizes), dtype=np.int64)
    members: list[float] = []
    number = -1
    for i in np.argsort(sizes, kind='stable'):
        if not members or sizes[i] - sum(members) / len(members) > tolerance:
            number, members = number + 1, []
        members.append(float(sizes[i]))
        group[i] = number
    return group


def _directions(force: FloatArray) -> IntArray:
    angle = np.arctan2(force[:, 1], force[:, 0])
    order = np.sort(angle)
    gaps = np.diff(order, append=order[0] + 2.0 * pi)
    first = order[(int(gaps.argmax()) + 1) % len(order)]
    return grouped((angle - first) % (2.0 * pi), _SAME_DIRECTION)


def _follow_zero(
    times: FloatArray, rests: FloatArray, variance: FloatArray, at: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the zero ``at`` times between rests (r, c), (m, c), and its covariance (m, m)."""
    # A random walk with measurement noise.
    mean: FloatArray = rests.mean(axis=0)
    knots, place = np.unique(np.concatenate([times, at]), return_inverse=True)
    measured, asked = place[: len(times)], place[len(times) :]
    precision = np.zeros((len(knots), len(knots)))
    precision[measured, measured] = 1.0 / variance
    rate = _drift_rate(times, rests, variance) if len(times) > 1 else variance[0]
    if len(knots) > 1:
        difference = np.diff(np.eye(len(knots)), axis=0)
        precision += difference.T @ (difference / (rate * np.diff(knots))[:, np.newaxis])
    covariance = np.linalg.inv(precision)
    gain = covariance[np.ix_(asked, measured)] / variance
    zero: FloatArray = mean + gain @ (rests - mean)
    return zero, np.asarray(covariance[np.ix_(asked, asked)])


def _drift_rate(times: FloatArray, rests: FloatArray, variance: FloatArray) -> float:
    step, change = np.diff(times), np.diff(rests, axis=0)
    slow = 0.01 * float(np.median(variance)) / float(step.sum())
    fast = 100.0 * max(slow, float((change**2).max() / step.min()))

    def negative_log_likelihood(logarithm: float) -> float:
        banded = np.zeros((2, len(step)))
        banded[0] = np.exp(logarithm) * step + variance[:-1] + variance[1:]
        banded[1, :-1] = -variance[1:-1]
        factor = cholesky_banded(banded, lower=True)
        fitted = cho_solve_banded((factor, True), change)
        return float(2.0 * change.shape[1] * np.log(factor[0]).sum() + (change * fitted).sum())

    found = minimize_scalar(
        negative_log_likelihood, bounds=(log(slow), log(fast)), method='bounded'
    )
    return exp(found.x)
