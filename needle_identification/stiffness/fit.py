r"""
Stiffness of the tissue in the plane of deflection: section 3.2.2.3 of [Boroomand2014]_.

The end-effector presses the tissue with force F and moves it by d; the tissue answers with -F.
Per force level the stiffness matrix K is the least-squares solution over the presses of

.. math:: F = K d, \qquad K = \begin{bmatrix} k_{xx} & k_{xz} \\ k_{zx} & k_{zz} \end{bmatrix}

The field of the tissue's force, -K d, has the curl

.. math:: \frac{\partial F_x}{\partial z} - \frac{\partial F_z}{\partial x} = k_{zx} - k_{xz}

and is that of a spring where the curl is zero, which is where K is symmetric.

References
----------
.. [Boroomand2014] A. Boroomand, M. Tavakoli, R. Sloboda, N. Usmani, "Dynamical modeling
   and controllability analysis of a flexible needle in soft tissue", 2014, section 3.2.2.3.

"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from math import atan2, ceil, exp, hypot, inf, isfinite, log, nan, pi, sqrt
from typing import Final, NamedTuple, TypeVar

from needle_dynamics import (
    FloatArray,
)
from needle_identification.errors import IdentificationError
from needle_identification.estimation.estimate import ParameterEstimate, Statistic, statistic
from needle_identification.estimation.regression import ESTIMATORS, regress
from needle_identification.recordings.recording import IndentationRecording
from needle_ros.errors import (
    ParameterError,
)
from needle_ros.settings import check_constants, constant
import numpy as np
from numpy.linalg import norm
from numpy.typing import NDArray
from scipy.linalg import cho_solve_banded, cholesky_banded, solve_triangular
from scipy.optimize import brentq, minimize_scalar
from scipy.special import fdtri, stdtr, stdtrit

#: Bins in the shortest hold: what is steady is judged on their means.
_BINS: Final = 10.0

#: A longer step between bins ends what is steady [bins].
_GAP: Final = 4

#: Steady: positions stay within this part of their whole range.
_STEADY_MOTION: Final = 0.05

#: Steady: the force changes from begin to end by at most this part of what it may vary; a ramp,
#: however slow, uses up all of it.
_STEADY_TREND: Final = 1.0 / 3.0

#: A band this much wider than the noise [standard deviations] is not left by chance.
_BAND: Final = 12.0

#: Fewest samples of a hold or rest, and presses of a level.
_FEWEST_SAMPLES: Final = 4
_FEWEST_PRESSES: Final = 3

#: Noise below this part of the largest value is that of rounding.
_ROUNDING: Final = 1e-8

#: The displacements must spread this many times their error in both directions: attenuation by
#: noise in the regressor is then below 1 %. Below the lower limit a column is nothing but noise.
_SMALLEST_SPREAD: Final = 10.0
_LARGEST_NOISE: Final = 3.0

#: Forces within this angle press in the same direction [rad].
_SAME_DIRECTION: Final = pi / 18.0

#: What is worth a warning, as a part of what was measured.
_WORTH_SAYING: Final = 0.1

#: Scatter over noise, standard errors, and directions, beyond or below which is a warning.
_SCATTER: Final = 2.0
_CLEARLY: Final = 3.0
_FEW_DIRECTIONS: Final = 4

_Item = TypeVar('_Item', ParameterEstimate, Statistic)

_ENTRIES: Final = ('k_xx', 'k_xz', 'k_zx', 'k_zz')


@dataclass(frozen=True, slots=True, kw_only=True)
class StiffnessSettings:
    """How stiffness is identified."""

    contact_length: float = constant(
        1.0,
        'm',
        'length of tissue that the end-effector presses; 1 m gives the number of the source',
        open_low=True,
    )
    level_tolerance: float = constant(
        0.05, 'N', 'forces this close are one level, and steady within it', open_low=True
    )
    rest_force: float = constant(0.1, 'N', 'force up to which it counts as rest', open_low=True)
    hold_time: float = constant(
        0.1, 's', 'shortest steady force that counts as a hold or a rest', open_low=True
    )
    settle_time: float = constant(0.02, 's', 'left out at the beginning of each hold and rest')
    largest_asymmetry: float = constant(
        0.1, '1', 'antisymmetric part over symmetric up to which it counts as a spring'
    )
    estimator: str = 'ordinary'

    def __post_init__(self) -> None:
        check_constants(self)
        if self.estimator not in ESTIMATORS:
            raise ParameterError(
                f'estimator must be one of {", ".join(ESTIMATORS)}, got {self.estimator!r}'
            )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Presses:
    """
    What each press gave, relative to the rests around it.

    Attributes
    ----------
    time : ndarray, shape (m,)
        Middle of the hold [s].
    displacement, force : ndarray, shape (m, 2)
        Mean displacement [m] and force on the tissue [N] along x and z.
    displacement_error, force_error : ndarray, shape (m, 2)
        Their standard errors, with the autocorrelation of the samples.
    off_plane : ndarray, shape (m,)
        Displacement out of the plane [m].
    level, direction : int ndarray, shape (m,)
        Index of the force level and of the direction.

    """

    time: FloatArray
    displacement: FloatArray
    force: FloatArray
    displacement_error: FloatArray
    force_error: FloatArray
    off_plane: FloatArray
    level: NDArray[np.int64]
    direction: NDArray[np.int64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LevelEstimate:
    """
    Stiffness at one force.

    Attributes
    ----------
    force : float
        Mean magnitude of the force [N].
    parameters : tuple of ParameterEstimate
        k_xx, k_xz, k_zx, k_zz [N/m].
    curl : ParameterEstimate
        k_zx - k_xz [N/m], the curl of the tissue's force -K d.
    spring : ParameterEstimate
        Frobenius norm of the antisymmetric part over that of the symmetric part [1]. A ratio of
        norms is never negative and tends to be too large near zero; its interval, that of the
        size of the signed ratio, is right there too and holds zero where that of the curl does.
    is_spring : bool
        True if all of the interval of ``spring`` is within the setting ``largest_asymmetry``.
    words : str
        Whether it is a spring, and by what.
    principal : (ParameterEstimate, ParameterEstimate)
        Larger and smaller principal stiffness, of the symmetric part [N/m].
    angle : ParameterEstimate
        Direction of the larger one, from x toward z, in (-pi/2, pi/2] [rad]; undetermined where
        the two agree within their errors.
    tissue_stiffness : ParameterEstimate
        k_a = k_zz / contact length [N/m^2].
    presses, directions : int
        Presses used, and how many directions they have.
    residual : float
        Root mean square of what the matrix leaves of the force [N].
    determination : float
        Coefficient of determination R^2.
    condition : float
        Condition number of the displacements; the larger, the less two directions they have.

    """

    force: float
    parameters: tuple[ParameterEstimate, ...]
    curl: ParameterEstimate
    spring: ParameterEstimate
    is_spring: bool
    words: str
    principal: tuple[ParameterEstimate, ParameterEstimate]
    angle: ParameterEstimate
    tissue_stiffness: ParameterEstimate
    presses: int
    directions: int
    residual: float
    determination: float
    condition: float

    def __getitem__(self, name: str) -> ParameterEstimate:
        return _named(
            (
                *self.parameters,
                self.curl,
                self.spring,
                *self.principal,
                self.angle,
                self.tissue_stiffness,
            ),
            name,
        )

    @property
    def matrix(self) -> FloatArray:
        """K [N/m], shape (2, 2), rows of force and columns of displacement; nan if unknown."""
        return np.array([p.value for p in self.parameters]).reshape(2, 2)

    @property
    def symmetric(self) -> FloatArray:
        """The part of K that is a spring [N/m], shape (2, 2)."""
        return np.asarray((self.matrix + self.matrix.T) / 2.0)

    @property
    def antisymmetric(self) -> FloatArray:
        """The part of K that has the curl [N/m], shape (2, 2)."""
        return np.asarray((self.matrix - self.matrix.T) / 2.0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StiffnessEstimate:
    """
    Stiffness at one place of the tissue.

    Attributes
    ----------
    name : str
        The recording.
    levels : tuple of LevelEstimate
        By force, from the smallest.
    off_plane : float
        Largest ratio of the displacement out of the plane to that within.
    warnings : tuple of str
        What to know before trusting the numbers.
    presses : Presses
        What was fitted.

    """

    name: str
    levels: tuple[LevelEstimate, ...]
    off_plane: float
    warnings: tuple[str, ...]
    presses: Presses


@dataclass(frozen=True, slots=True, kw_only=True)
class LevelSummary:
    """One force level over several places: force [N] and a column of Table 2."""

    force: float
    statistics: tuple[Statistic, ...]

    def __getitem__(self, name: str) -> Statistic:
        return _named(self.statistics, name)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StiffnessSummary:
    """
    Stiffness over several places, as Table 2.

    Attributes
    ----------
    levels : tuple of LevelSummary
        k_xx, k_xz, k_zx, k_zz, curl and tissue_stiffness, by force from the smallest.
    tissue_stiffness : Statistic
        k_a [N/m^2] at the level asked for.
    estimates : tuple of StiffnessEstimate
        One per place.

    """

    levels: tuple[LevelSummary, ...]
    tissue_stiffness: Statistic
    estimates: tuple[StiffnessEstimate, ...]


def _named(items: Sequence[_Item], name: str) -> _Item:
    for item in items:
        if item.name == name:
            return item
    raise KeyError(f'{name!r}; valid: {", ".join(item.name for item in items)}')


def identify_stiffness(
    recording: IndentationRecording, settings: StiffnessSettings | None = None
) -> StiffnessEstimate:
    """
    Estimate the stiffness matrix at each force level of one recording.

    A hold is the longest time for which force and position stay steady; which steady times are
    rests is told by their force being the one most often returned to. The zeros of force and
    position are followed from rest to rest, so that slow drift and the bias of the sensor go.
    Errors come from the scatter of the presses about the matrix, with Student's t.

    Parameters
    ----------
    recording : IndentationRecording
        Presses in any number of directions and levels, with rests between.
    settings : StiffnessSettings, optional
        How to identify.

    Returns
    -------
    StiffnessEstimate
        One matrix per level; what the presses do not determine is said to be undetermined.

    Raises
    ------
    IdentificationError
        If no press is found, saying what was.

    """
    settings = settings or StiffnessSettings()
    try:
        return _identify(recording, settings)
    except IdentificationError as error:
        raise IdentificationError(f'{recording.name}: {error}') from None


def _identify(recording: IndentationRecording, settings: StiffnessSettings) -> StiffnessEstimate:
    plateaus = _plateaus(recording, settings)
    presses, noise, warnings = _presses(recording, plateaus, settings)
    levels = []
    said: dict[str, list[str]] = {}
    for index in range(int(presses.level.max()) + 1):
        of_level = np.flatnonzero(presses.level == index)
        level, doubts = _level(presses, noise, of_level, settings)
        levels.append(level)
        for doubt, detail in doubts:
            said.setdefault(doubt, []).append(f'{detail} at {level.force:.3g} N')
    warnings += [f'{doubt} ({"; ".join(details)})' for doubt, details in said.items()]
    size = np.maximum(np.hypot(*presses.displacement.T), 1e-15)
    share = np.abs(presses.off_plane) / size
    off_plane = float(share.max())
    if off_plane > _WORTH_SAYING:
        warnings.append(
            f'the end-effector moved out of the plane by up to {off_plane:.0%} of its '
            f'displacement in it (more than {_WORTH_SAYING:.0%}): stiffness may be misjudged'
        )
    return StiffnessEstimate(
        name=recording.name,
        levels=tuple(levels),
        off_plane=off_plane,
        warnings=tuple(warnings + _falling(presses, levels)),
        presses=presses,
    )


class _Plateaus(NamedTuple):
    """
    Steady times: middle [s], means and variances of the means of the channels.

    Channels are force x, z, displacement x, z, off-plane. ``missed`` are times at which the
    force was above rest without being steady.
    """

    time: FloatArray
    mean: FloatArray
    variance: FloatArray
    rest: NDArray[np.bool_]
    missed: int


def _plateaus(recording: IndentationRecording, settings: StiffnessSettings) -> _Plateaus:
    time = recording.time
    channels = np.column_stack([recording.force, recording.position, recording.off_plane])
    if len(time) < _FEWEST_SAMPLES:
        raise IdentificationError(f'too short: {len(time)} samples')
    width = max(settings.hold_time / _BINS, float(np.median(np.diff(time))))
    number, first = np.unique(((time - time[0]) / width).astype(np.int64), return_index=True)
    after = np.append(first[1:], len(time))
    means = np.add.reduceat(channels, first) / (after - first)[:, np.newaxis]
    shortest = max(2, ceil((settings.hold_time + settings.settle_time) / width))
    runs, parts = [], []
    for start, length in _steady(number, means[:, :4], settings.level_tolerance, shortest):
        begin = int(np.searchsorted(time, time[first[start]] + settings.settle_time))
        end = int(after[start + length - 1])
        if end - begin >= _FEWEST_SAMPLES:
            runs.append((start, length))
            parts.append((begin, end))
    if not parts:
        raise IdentificationError(
            f'no force is steady within {settings.level_tolerance:g} N for '
            f'{settings.hold_time:g} s; neither a hold nor a rest'
        )
    mean = np.array([channels[begin:end].mean(axis=0) for begin, end in parts])
    rest = _rests(mean[:, :2], settings.rest_force)
    middle = np.array([time[begin:end].mean() for begin, end in parts])
    zero = np.column_stack([np.interp(time[first], middle[rest], c) for c in mean[rest, :2].T])
    size = np.hypot(*(means[:, :2] - zero).T)
    pressed = size > settings.rest_force
    held = np.zeros(len(means), dtype=np.bool_)
    for (start, length), at_rest in zip(runs, rest, strict=True):
        held[start : start + length] = not at_rest
    edges = np.flatnonzero(np.diff(np.pad(pressed.astype(np.int8), 1))).reshape(-1, 2)
    # Noise crosses the limit of a rest more than once, but not twice that limit.
    high = size > 2.0 * settings.rest_force
    missed = sum(high[up:down].any() and not held[up:down].any() for up, down in edges)
    return _Plateaus(middle, mean, _variances(channels, parts), rest, missed)


def _steady(
    number: NDArray[np.int64], means: FloatArray, tolerance: float, shortest: int
) -> list[tuple[int, int]]:
    """Return (start, length) of the longest steady runs of bins that do not overlap."""
    if len(means) < shortest:
        return []
    # Second differences do not see ramps; their spread is that of the noise times root 6.
    noise = np.median(np.abs(np.diff(means[:, :2], n=2, axis=0, prepend=means[:1, :2])))
    band = max(tolerance, _BAND * float(noise) / (0.6745 * sqrt(6.0)))
    span = float(np.ptp(means[:, 2:], axis=0).max()) * _STEADY_MOTION
    scaled = means / [band, band, span or 1.0, span or 1.0]
    gap = np.concatenate([[0], np.cumsum(np.diff(number) > _GAP)])
    reach = _reach(np.column_stack([scaled, 2.0 * gap]))
    taken = np.zeros(len(means), dtype=np.bool_)
    found = []
    for start in np.argsort(-reach, kind='stable'):
        length = int(reach[start])
        if length < shortest:
            break
        if taken[start] or taken[start + length - 1]:
            continue
        taken[start : start + length] = True
        # Ends of ramps may give a trend to a run that is a hold in its middle.
        begin, end = _trimmed(scaled[start : start + length])
        if _trend(scaled[start + begin : start + end, :2]) <= _STEADY_TREND:
            found.append((int(start) + begin, end - begin))
    return sorted(found)


def _trend(values: FloatArray) -> float:
    """Return the change from first to last row of the line through them."""
    abscissa = np.linspace(-0.5, 0.5, len(values))
    return float(norm(abscissa @ values / (abscissa @ abscissa)))


def _trimmed(values: FloatArray) -> tuple[int, int]:
    """Leave out at both ends, up to a quarter each, what is not like the middle half."""
    quarter = len(values) // 4
    middle = values[quarter : len(values) - quarter]
    reach = _CLEARLY * middle.std(axis=0) + _ROUNDING
    alike = (np.abs(values - middle.mean(axis=0)) <= reach).all(axis=1)
    alike[quarter : len(values) - quarter] = True
    return int(alike.argmax()), len(values) - int(alike[::-1].argmax())


def _reach(values: FloatArray) -> NDArray[np.int64]:
    """For each row, count the rows from it on over which no column varies by more than 1."""
    count = len(values)
    lows, highs = [values], [values]
    while 2 ** len(lows) <= count:
        half = 2 ** (len(lows) - 1)
        lows.append(np.minimum(lows[-1][:-half], lows[-1][half:]))
        highs.append(np.maximum(highs[-1][:-half], highs[-1][half:]))
    end = np.arange(count)
    low, high = np.full_like(values, inf), np.full_like(values, -inf)
    for power in reversed(range(len(lows))):
        rows = np.flatnonzero(end + 2**power <= count)
        lower = np.minimum(low[rows], lows[power][end[rows]])
        higher = np.maximum(high[rows], highs[power][end[rows]])
        fits = (higher - lower <= 1.0).all(axis=1)
        rows = rows[fits]
        low[rows], high[rows] = lower[fits], higher[fits]
        end[rows] += 2**power
    return np.asarray(end - np.arange(count))


def _rests(force: FloatArray, rest_force: float) -> NDArray[np.bool_]:
    """Mark the rests: near the force most often returned to, followed as it drifts."""
    apart = np.hypot(*(force[:, np.newaxis] - force).transpose(2, 0, 1))
    visits = np.count_nonzero(apart <= rest_force, axis=1)
    start = min(range(len(force)), key=lambda i: (-visits[i], hypot(*force[i])))
    rest = np.zeros(len(force), dtype=np.bool_)
    for order in (range(start, len(force)), range(start, -1, -1)):
        zero = force[start]
        for i in order:
            if hypot(*(force[i] - zero)) <= rest_force:
                rest[i], zero = True, force[i]
    return rest


def _variances(channels: FloatArray, parts: list[tuple[int, int]]) -> FloatArray:
    """
    Variance of the mean of each part; the correlation of samples is that of all parts.

    A steady trend within a part is drift or creep, not noise. The sum of autocorrelations ends
    where it is a fifth of the lag, which balances its bias against its noise (A. Sokal, "Monte
    Carlo methods in statistical mechanics", 1997).
    """
    rows, shapes = [], []
    for begin, end in parts:
        line = np.linspace(-1.0, 1.0, end - begin)
        shape = np.column_stack([np.full_like(line, 1.0 / sqrt(len(line))), line / norm(line)])
        rows.append(channels[begin:end] - shape @ (shape.T @ channels[begin:end]))
        shapes.append(shape)
    counts = np.array([[len(row)] for row in rows])
    products = _products(rows, int(counts.max()) // 4 + 1)
    lags = np.arange(len(products))
    # Without mean and trend a part lacks, at each lag, what these two have of the noise.
    taken = _products(shapes, len(lags)).sum(axis=1)
    free = np.maximum(counts.sum() - (2.0 * np.cumsum(taken) - taken[0]), 1.0)
    sums = 2.0 * np.cumsum(products, axis=0) - products[0]
    power = np.where(products[0] > 0.0, products[0] / counts.sum(), inf)
    time = sums / free[:, np.newaxis] / power
    enough = lags[:, np.newaxis] >= 5.0 * time
    enough[-1] = True
    time = np.maximum(np.take_along_axis(time, enough.argmax(axis=0)[np.newaxis], axis=0), 1.0)
    variance = np.array([row.var(axis=0) for row in rows]) * time / counts
    return np.asarray(
        np.maximum(variance, (_ROUNDING * np.abs(channels).max(axis=0) + 1e-15) ** 2)
    )


def _products(rows: Sequence[FloatArray], lags: int) -> FloatArray:
    """Sum the products of samples by their lag over all rows of shape (n, c), shape (lags, c)."""
    products = np.zeros((lags, rows[0].shape[1]))
    for row in rows:
        spectrum = np.fft.rfft(row, 2 * len(row), axis=0)
        found = np.fft.irfft(np.abs(spectrum) ** 2, axis=0)[: min(lags, len(row))]
        products[: len(found)] += found
    return products


class _Noise(NamedTuple):
    """Variance of the holds, shape (m, 2), and covariance of the zeros, shape (m, m)."""

    force: FloatArray
    displacement: FloatArray
    force_zero: FloatArray
    displacement_zero: FloatArray

    def of(self, matrix: FloatArray, chosen: NDArray[np.int64], each: bool) -> FloatArray:
        """Covariance of each row of F - K d, shape (2, m, m); noise of ``each`` or pooled."""
        force, displacement = self.force[chosen], self.displacement[chosen]
        squares: FloatArray = matrix**2
        if each:
            force, displacement = _floored(force), _floored(displacement)
        else:
            force, displacement, squares = (
                np.full_like(a, a.mean()) for a in (force, displacement, squares)
            )
        among = np.ix_(chosen, chosen)
        return np.array(
            [
                np.diag(force[:, row] + displacement @ squares[row])
                + self.force_zero[among]
                + squares[row].sum() * self.displacement_zero[among]
                for row in range(2)
            ]
        )


def _floored(variance: FloatArray) -> FloatArray:
    """Keep a hold that rounding made quiet by chance from outweighing all others."""
    return np.asarray(np.maximum(variance, 0.1 * variance.mean(axis=0)))


def _presses(
    recording: IndentationRecording, plateaus: _Plateaus, settings: StiffnessSettings
) -> tuple[Presses, _Noise, list[str]]:
    """Take the holds relative to the rests; say what drifted and what was left out."""
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
        zero, covariance = _zero(
            plateaus.time[rest],
            plateaus.mean[rest, channels],
            plateaus.variance[rest, channels].mean(axis=1),
            time,
        )
        change[:, channels] = plateaus.mean[hold, channels] - zero
        covariances.append(covariance)
    force, displacement = change[:, :2], change[:, 2:4]
    noise = _Noise(
        plateaus.variance[hold, :2], plateaus.variance[hold, 2:4], covariances[0], covariances[1]
    )
    size = np.hypot(*force.T)
    presses = Presses(
        time=time,
        displacement=displacement,
        force=force,
        displacement_error=np.sqrt(noise.displacement + np.diag(covariances[1])[:, np.newaxis]),
        force_error=np.sqrt(noise.force + np.diag(covariances[0])[:, np.newaxis]),
        off_plane=change[:, 4],
        level=_grouped(size, settings.level_tolerance),
        direction=_directions(force),
    )
    warnings = []
    if plateaus.missed:
        warnings.append(
            f'presses left out: {plateaus.missed}, without a force steady within '
            f'{settings.level_tolerance:g} N for {settings.hold_time:g} s'
        )
    for what, unit, channels, usual in (
        ('force', 'N', slice(0, 2), float(size.min())),
        ('position', 'm', slice(2, 4), float(np.median(np.hypot(*displacement.T)))),
    ):
        drift = float(np.hypot(*np.ptp(plateaus.mean[rest, channels], axis=0)))
        if drift > _WORTH_SAYING * usual:
            warnings.append(
                f'the {what} at rest drifted by {drift:.2g} {unit}, which was taken out'
            )
    for array in (getattr(presses, name) for name in Presses.__slots__):
        array.setflags(write=False)
    return presses, noise, warnings


def _zero(
    times: FloatArray, rests: FloatArray, variance: FloatArray, at: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """
    Follow the zero from the rests: a random walk, seen with noise of known variance.

    Its pace is that of the largest likelihood. Without drift every rest counts for every hold;
    where drift exceeds the noise the zero is interpolated between neighbors.

    Parameters
    ----------
    times : ndarray, shape (r,)
        Times of the rests.
    rests : ndarray, shape (r, c)
        Their means in channels of one kind.
    variance : ndarray, shape (r,)
        Variance of these.
    at : ndarray, shape (m,)
        Where to tell the zero.

    Returns
    -------
    zero : ndarray, shape (m, c)
        Zeros.
    covariance : ndarray, shape (m, m)
        Their covariance in each channel.

    """
    mean: FloatArray = rests.mean(axis=0)
    knots, place = np.unique(np.concatenate([times, at]), return_inverse=True)
    seen, asked = place[: len(times)], place[len(times) :]
    precision = np.zeros((len(knots), len(knots)))
    precision[seen, seen] = 1.0 / variance
    pace = _pace(times, rests, variance) if len(times) > 1 else variance[0]
    if len(knots) > 1:
        difference = np.diff(np.eye(len(knots)), axis=0)
        precision += difference.T @ (difference / (pace * np.diff(knots))[:, np.newaxis])
    covariance = np.linalg.inv(precision)
    gain = covariance[np.ix_(asked, seen)] / variance
    zero: FloatArray = mean + gain @ (rests - mean)
    return zero, np.asarray(covariance[np.ix_(asked, asked)])


def _pace(times: FloatArray, rests: FloatArray, variance: FloatArray) -> float:
    """Return the variance per second of the random walk that most likely gave the rests."""
    step, change = np.diff(times), np.diff(rests, axis=0)
    slow = 0.01 * float(np.median(variance)) / float(step.sum())
    fast = 100.0 * max(slow, float((change**2).max() / step.min()))

    def unlikeliness(logarithm: float) -> float:
        banded = np.zeros((2, len(step)))
        banded[0] = np.exp(logarithm) * step + variance[:-1] + variance[1:]
        banded[1, :-1] = -variance[1:-1]
        factor = cholesky_banded(banded, lower=True)
        fitted = cho_solve_banded((factor, True), change)
        return float(2.0 * change.shape[1] * np.log(factor[0]).sum() + (change * fitted).sum())

    found = minimize_scalar(unlikeliness, bounds=(log(slow), log(fast)), method='bounded')
    return exp(found.x)


def _grouped(sizes: FloatArray, tolerance: float) -> NDArray[np.int64]:
    """Give values numbers by size: a new one beyond the tolerance from the mean of the last."""
    group = np.zeros(len(sizes), dtype=np.int64)
    members: list[float] = []
    number = -1
    for i in np.argsort(sizes, kind='stable'):
        if not members or sizes[i] - sum(members) / len(members) > tolerance:
            number, members = number + 1, []
        members.append(float(sizes[i]))
        group[i] = number
    return group


def _directions(force: FloatArray) -> NDArray[np.int64]:
    """Give directions of forces numbers, beginning after the widest gap between them."""
    angle = np.arctan2(force[:, 1], force[:, 0])
    order = np.sort(angle)
    gaps = np.diff(order, append=order[0] + 2.0 * pi)
    first = order[(int(gaps.argmax()) + 1) % len(order)]
    return _grouped((angle - first) % (2.0 * pi), _SAME_DIRECTION)


class _Fit(NamedTuple):
    """
    A stiffness matrix with its errors.

    ``factors`` A, shape (2, 2, 2), and ``correlation`` R, shape (2, 2), make the covariance of
    rows r and s of the matrix: R_rs A_r A_s^T. Columns that are not ``known`` are nan.
    """

    matrix: FloatArray
    known: NDArray[np.bool_]
    factors: FloatArray
    correlation: FloatArray
    freedom: float
    residual: FloatArray
    scale: float
    condition: float

    def derived(
        self, name: str, symbol: str, unit: str, value: float, gradient: FloatArray
    ) -> ParameterEstimate:
        """
        Return what depends on the matrix, by propagation along its gradient, shape (2, 2).

        The degrees of freedom are those of Satterthwaite: between those of one row and of both.
        """
        if not self.known[np.any(gradient != 0.0, axis=0)].all() or not isfinite(value):
            return ParameterEstimate(name=name, symbol=symbol, unit=unit)
        variance, freedom = self.spread(gradient)
        error = sqrt(variance)
        reach = error * float(stdtrit(freedom, 0.975))
        return ParameterEstimate(
            name=name,
            symbol=symbol,
            unit=unit,
            value=value,
            error=error,
            interval=(value - reach, value + reach),
            determined=True,
        )

    def spread(self, gradient: FloatArray) -> tuple[float, float]:
        """Return variance and its degrees of freedom."""
        along = np.einsum('rij,ri->rj', self.factors, gradient)
        parts = along @ along.T @ self.correlation
        variance = max(float(np.trace(parts)), 0.0)
        spread = float(np.trace(parts @ parts))
        return variance, self.freedom * variance**2 / spread if spread > 0.0 else self.freedom


_UNKNOWN: Final = _Fit(
    matrix=np.full((2, 2), nan),
    known=np.zeros(2, dtype=np.bool_),
    factors=np.zeros((2, 2, 2)),
    correlation=np.eye(2),
    freedom=0.0,
    residual=np.zeros((1, 2)),
    scale=0.0,
    condition=inf,
)


def _fit(presses: Presses, noise: _Noise, chosen: NDArray[np.int64], estimator: str) -> _Fit:
    """Solve F = K d over the chosen presses, as far as they determine K."""
    displacement, force = presses.displacement[chosen], presses.force[chosen]
    error = sqrt(float(np.mean(presses.displacement_error[chosen] ** 2)) * len(chosen))
    if len(chosen) < _FEWEST_PRESSES:
        return _UNKNOWN
    # A column of noise alone would pass for a regressor.
    columns = np.flatnonzero(norm(displacement, axis=0) > _LARGEST_NOISE * error)
    spread = np.linalg.svd(displacement[:, columns], compute_uv=False)
    if not len(columns) or spread[-1] < _SMALLEST_SPREAD * error:
        return _UNKNOWN._replace(condition=float(spread[0] / spread[-1]) if len(columns) else inf)
    displacement = displacement[:, columns]
    start = np.zeros((2, 2))
    start[:, columns] = np.linalg.lstsq(displacement, force, rcond=None)[0].T
    covariances = noise.of(start, chosen, estimator == 'weighted')
    matrix, factors = np.full((2, 2), nan), np.zeros((2, 2, 2))
    known = np.isin(np.arange(2), columns)
    residual = np.empty_like(force)
    freedom = float(len(chosen) - len(columns))
    freedoms = [freedom, freedom]
    whitened = []
    for row, covariance in enumerate(covariances):
        size = float(np.mean(np.diag(covariance)))
        root = np.linalg.cholesky(covariance / size)
        x, y = (solve_triangular(root, a, lower=True) for a in (displacement, force[:, row]))
        fit = regress(
            x,
            y,
            estimator='ordinary' if estimator == 'weighted' else estimator,
            noisy=np.ones(len(columns), dtype=np.bool_),
            regressor_noise=np.full(len(columns), error / sqrt(len(chosen))),
        )
        deviation, freedoms[row], left = _deviation(fit.residual, freedom, estimator)
        matrix[row, columns] = fit.values
        known[columns] &= fit.determined
        residual[:, row] = root @ fit.residual
        normal = np.linalg.inv(x.T @ x)
        factor = deviation * np.linalg.cholesky(normal)
        factors[row][np.ix_(columns, np.arange(len(columns)))] = factor
        whitened.append((left, fit.residual / sqrt(size)))
    (left_x, scaled_x), (left_z, scaled_z) = whitened
    norms = float(norm(left_x) * norm(left_z))
    together = float(left_x @ left_z) / norms if norms > 0.0 else 0.0
    return _Fit(
        matrix=matrix,
        known=known,
        factors=factors,
        correlation=np.array([[1.0, together], [together, 1.0]]),
        freedom=min(freedoms),
        residual=residual,
        scale=sqrt(float(scaled_x @ scaled_x + scaled_z @ scaled_z) / (2.0 * freedom)),
        condition=fit.condition,
    )


def _deviation(
    residual: FloatArray, freedom: float, estimator: str
) -> tuple[float, float, FloatArray]:
    """
    Return the standard deviation that residuals tell, its freedom, and what of them counts.

    With few presses the scatter of all tells more than that of each (as a sandwich would take
    it). For ``huber`` that of the clipped residuals, P. J. Huber, "Robust Statistics", 7.6; as
    many degrees of freedom are lost as residuals are clipped.
    """
    if estimator != 'huber':
        return sqrt(float(residual @ residual) / freedom), freedom, residual
    limit = 1.345 * 1.4826 * float(np.median(np.abs(residual)))
    left = np.clip(residual, -limit, limit)
    share = float(np.mean(np.abs(residual) <= limit))
    count = len(residual)
    correction = (1.0 + (count - freedom) / count * (1.0 - share) / share) / share
    deviation = correction * sqrt(float(left @ left) / freedom)
    return deviation, max(freedom - count * (1.0 - share), 1.0), left


def _level(
    presses: Presses, noise: _Noise, chosen: NDArray[np.int64], settings: StiffnessSettings
) -> tuple[LevelEstimate, list[tuple[str, str]]]:
    """Return what the presses of one level tell, and warnings."""
    fit = _fit(presses, noise, chosen, settings.estimator)
    (_, k_xz), (k_zx, k_zz) = fit.matrix.tolist()
    parameters = tuple(
        fit.derived(name, name, 'N/m', float(fit.matrix[index]), _unit(*index))
        for name, index in zip(_ENTRIES, np.ndindex(2, 2), strict=True)
    )
    curl = fit.derived('curl', 'curl F', 'N/m', k_zx - k_xz, _SKEW)
    spring = _spring(fit, curl.value)
    first, second, angle = _principal(fit)
    force = presses.force[chosen]
    size = float(np.hypot(*force.T).mean())
    is_spring, words = _verdict(spring, curl, settings.largest_asymmetry)
    directions = len(np.unique(presses.direction[chosen]))
    residual = float((fit.residual**2).sum())
    about = float(((force - force.mean(axis=0)) ** 2).sum())
    level = LevelEstimate(
        force=size,
        parameters=parameters,
        curl=curl,
        spring=spring,
        is_spring=is_spring,
        words=words,
        principal=(first, second),
        angle=angle,
        tissue_stiffness=fit.derived(
            'tissue_stiffness',
            'k_a',
            'N/m^2',
            k_zz / settings.contact_length,
            _unit(1, 1) / settings.contact_length,
        ),
        presses=len(chosen),
        directions=directions,
        residual=sqrt(residual / len(chosen)) if fit.known.any() else nan,
        determination=1.0 - residual / about if fit.known.any() and about > 0.0 else nan,
        condition=fit.condition,
    )
    return level, list(_said(level, fit))


def _unit(row: int, column: int) -> FloatArray:
    """Return the gradient of one entry of the matrix."""
    gradient = np.zeros((2, 2))
    gradient[row, column] = 1.0
    return gradient


#: Gradient of the curl k_zx - k_xz.
_SKEW: Final = np.array([[0.0, -1.0], [1.0, 0.0]])


def _spring(fit: _Fit, curl: float) -> ParameterEstimate:
    """Return |K_a| / |K_s| = |curl| / (sqrt(2) |K_s|), its interval folded at zero."""
    symmetric = (fit.matrix + fit.matrix.T) / 2.0
    size = sqrt(2.0) * float(norm(symmetric)) or nan
    gradient = (_SKEW - 2.0 * curl / size**2 * symmetric) / size
    signed = fit.derived('spring', '|K_a|/|K_s|', '1', curl / size, gradient)
    if not signed.determined:
        return signed
    _, freedom = fit.spread(gradient)
    return replace(
        signed,
        value=abs(signed.value),
        interval=_folded(abs(signed.value), signed.error, freedom),
    )


def _folded(value: float, error: float, freedom: float) -> tuple[float, float]:
    """
    Return the 95 % interval of the size of a quantity whose sign does not matter.

    It holds each size from which the value found is not farther off than 95 % of values are;
    zero is among them where the interval of Student's t of the signed quantity holds zero.
    """
    if error <= _ROUNDING * value:
        return value, value
    found = value / error
    farthest = float(stdtrit(freedom, 0.975))

    def excess(size: float) -> float:
        """Probability that a value is nearer to this size than the one found, less 95 %."""
        off = abs(size - found)
        near = [off, max(-off, -size), min(-size, off - 2.0 * size), -off - 2.0 * size]
        above, below, mirrored, lowest = stdtr(freedom, near)
        return float(above - below + mirrored - lowest) - 0.95

    low = brentq(excess, 0.0, found) if found > farthest else 0.0
    return low * error, brentq(excess, found, found + 1.01 * farthest) * error


def _verdict(spring: ParameterEstimate, curl: ParameterEstimate, limit: float) -> tuple[bool, str]:
    """Say whether all, none or part of what the figure may be is below the limit."""
    if not spring.determined:
        return False, 'undetermined: the presses do not determine the whole matrix'
    low, high = spring.interval
    figure = (
        f'antisymmetric part {spring.value:.2%} of the symmetric, 95 % interval '
        f'{low:.2%} to {high:.2%}, limit {limit:.0%}; curl '
        + ('zero within its error' if low == 0.0 else f'{curl.value:.3g} N/m')
    )
    if high <= limit:
        return True, f'a spring: {figure}'
    return False, f'{"not a spring" if low > limit else "cannot be told"}: {figure}'


def _principal(fit: _Fit) -> tuple[ParameterEstimate, ParameterEstimate, ParameterEstimate]:
    """
    Return the principal stiffnesses and the direction of the larger one.

    Where they agree within their errors the larger one is too large by chance and the smaller
    one too small: their intervals then reach over that of their mean.
    """
    k = fit.matrix
    half, shear = (k[0, 0] - k[1, 1]) / 2.0, (k[0, 1] + k[1, 0]) / 2.0
    mean, radius = (k[0, 0] + k[1, 1]) / 2.0, hypot(half, shear)
    stretch, slide = np.diag([0.5, -0.5]), np.array([[0.0, 0.5], [0.5, 0.0]])
    cosine, sine = (half / radius, shear / radius) if radius > 0.0 else (1.0, 0.0)
    outward, around = cosine * stretch + sine * slide, cosine * slide - sine * stretch
    middle = fit.derived('', '', '', mean, np.eye(2) / 2.0)
    apart = fit.known.all() and _apart(fit, np.array([half, shear]), stretch, slide)
    found = []
    for number, sign in ((1, 1.0), (2, -1.0)):
        one = fit.derived(
            f'principal_stiffness_{number}',
            f'k_{number}',
            'N/m',
            mean + sign * radius,
            np.eye(2) / 2.0 + sign * outward,
        )
        if one.determined and not apart:
            ends = (*one.interval, *middle.interval)
            one = replace(one, interval=(min(ends), max(ends)))
        found.append(one)
    angle = fit.derived(
        'principal_angle',
        'phi',
        'rad',
        atan2(shear, half) / 2.0 if apart else nan,
        around / (2.0 * (radius or 1.0)),
    )
    return found[0], found[1], angle


def _apart(fit: _Fit, found: FloatArray, stretch: FloatArray, slide: FloatArray) -> bool:
    """Test at 1 % whether the two principal stiffnesses differ (F test)."""
    (a, _), (b, _), (c, freedom) = (fit.spread(g) for g in (stretch, slide, stretch + slide))
    covariance = np.array([[a, (c - a - b) / 2.0], [(c - a - b) / 2.0, b]])
    if np.linalg.det(covariance) <= 0.0:
        return bool(norm(found) > _ROUNDING * norm(fit.matrix))
    return bool(found @ np.linalg.solve(covariance, found) / 2.0 > fdtri(2, freedom, 0.99))


def _said(level: LevelEstimate, fit: _Fit) -> Iterator[tuple[str, str]]:
    """Warn of what makes the matrix of a level doubtful, with a detail of this level."""
    if not fit.known.all():
        lacking = ', '.join(p.symbol for p in level.parameters if not p.determined)
        yield (
            f'{lacking} undetermined: that takes three presses in two directions or more',
            f'{level.presses} in {level.directions}',
        )
        return
    if level.directions < _FEW_DIRECTIONS:
        yield 'few directions, the source has 8', f'{level.directions}'
    if fit.scale > _SCATTER:
        yield (
            'presses scatter more than their noise, so that F = K d does not quite hold',
            f'{fit.scale:.2g} times',
        )
    k_xx, k_zz = level['k_xx'].value, level['k_zz'].value
    low, high = fit.derived('', '', '', k_xx - k_zz, np.diag([1.0, -1.0])).interval
    if (low > 0.0 or high < 0.0) and abs(k_xx - k_zz) > _WORTH_SAYING * abs(k_zz):
        yield (
            'k_xx differs from k_zz: the tissue has directions, or the motion left the plane',
            f'{k_xx:.3g} and {k_zz:.3g} N/m',
        )


def _falling(presses: Presses, levels: Sequence[LevelEstimate]) -> list[str]:
    """Warn where more force gave less displacement along it."""
    along = (presses.force * presses.displacement).sum(axis=1) / np.hypot(*presses.force.T)
    error = np.hypot(*presses.displacement_error.T)
    falls: dict[tuple[int, int], int] = {}
    directions = range(int(presses.direction.max()) + 1)
    for direction in directions:
        same = presses.direction == direction
        met = np.unique(presses.level[same])
        where = [same & (presses.level == level) for level in met]
        for (low, before), (high, after) in pairwise(zip(met, where, strict=True)):
            rise = along[after].mean() - along[before].mean()
            if rise < -_CLEARLY * hypot(error[after].mean(), error[before].mean()):
                falls[low, high] = falls.get((low, high), 0) + 1
    return [
        f'in {count} of {len(directions)} directions the displacement falls as the force grows '
        f'from {levels[low].force:.3g} to {levels[high].force:.3g} N'
        for (low, high), count in sorted(falls.items())
    ]


def summarize_stiffness(
    estimates: Sequence[StiffnessEstimate],
    *,
    force: float | None = None,
    level_tolerance: float = StiffnessSettings().level_tolerance,
) -> StiffnessSummary:
    """
    Put the estimates of several places together, as in Table 2.

    Parameters
    ----------
    estimates : sequence of StiffnessEstimate
        One per place; a level that some lack is that of the others.
    force : float, optional
        Level whose tissue stiffness is asked for [N]; default: the largest, as in the source.
    level_tolerance : float, optional
        Levels of different places this close are one [N].

    Returns
    -------
    StiffnessSummary
        Means, standard deviations and standard errors per level.

    Raises
    ------
    IdentificationError
        If there are no estimates, or none at the force asked for.

    """
    levels = [level for estimate in estimates for level in estimate.levels]
    if not levels:
        raise IdentificationError('no recordings to identify from')
    group = _grouped(np.array([level.force for level in levels]), level_tolerance)
    summaries = []
    for number in range(int(group.max()) + 1):
        members = [level for level, of in zip(levels, group, strict=True) if of == number]
        summaries.append(
            LevelSummary(
                force=float(np.mean([level.force for level in members])),
                statistics=tuple(
                    statistic([level[name] for level in members])
                    for name in (*_ENTRIES, 'curl', 'tissue_stiffness')
                ),
            )
        )
    asked = summaries[-1]
    if force is not None:
        asked = min(summaries, key=lambda summary: abs(summary.force - force))
        if abs(asked.force - force) > level_tolerance:
            raise IdentificationError(
                f'no level at {force:g} N; there are '
                f'{", ".join(f"{summary.force:.3g}" for summary in summaries)} N'
            )
    return StiffnessSummary(
        levels=tuple(summaries),
        tissue_stiffness=asked['tissue_stiffness'],
        estimates=tuple(estimates),
    )
