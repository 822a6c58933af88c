r"""
Identify the bending of a needle in tissue from guide and tip positions.

For a given free length L0, and bending length lambda and skin of each medium, the tip position is
linear in the motion of the guide, an offset of each recording, and the constants of these drift
terms:

============  =================================================================================
``tilt``      tilt of the guide, in x and z
``frame``     rotation between robot and tracker frames: an apparent drift with depth
``bevel``     lateral load of the bevel, as the curvature of a long needle, along z and x at zero
              roll
============  =================================================================================

The lengths are estimated by variable projection: the linear constants are solved for at each step
[Golub2003]_. Intervals of the lengths are profile likelihood intervals, which are far from
symmetric with few samples.

References
----------
.. [Golub2003] G. H. Golub, V. Pereyra, "Separable nonlinear least squares: the variable projection
   method and its applications", Inverse Problems 19, 2003.

"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import exp, inf, isfinite, nan, sqrt
from typing import Final, NamedTuple

from needle_dynamics.arrays import FloatArray
from needle_identification.errors import IdentificationError
from needle_identification.estimation.estimate import ParameterEstimate
from needle_identification.steering.estimate import CONSTANTS, MediumEstimate, SteeringEstimate
from needle_identification.steering.recording import SteeringRecording
from needle_identification.steering.response import ORDERS, TERMS
from needle_identification.steering.search import FREE, Search, SKIN_SCALE
from needle_ros.errors import ParameterError
import numpy as np
from scipy.special import stdtrit

_SEVERAL: Final = 8  # smallest number of recordings of a medium whose spread determines the errors
_AS_GOOD: Final = 0.02  # relative difference of residuals below which fits are equivalent
_LENGTHS: Final = 2  # number of nonlinear constants of a medium


@dataclass(frozen=True, slots=True, kw_only=True)
class SteeringSettings:
    """
    Settings of the steering identification.

    Raises
    ------
    ParameterError
        If a value is not valid.

    """

    #: Drift terms, of `TERMS`; None selects the term with the smallest residual.
    terms: tuple[str, ...] | None = None
    #: Whether guide and needle move ``together`` between samples, or the ``guide first``; None
    #: selects the order with the smaller residual.
    order: str | None = None
    free_length: float | None = None  #: known free length [m]; None to estimate it

    def __post_init__(self) -> None:
        for term in self.terms or ():
            if term not in TERMS:
                raise ParameterError(f'terms must be of {", ".join(TERMS)}, got {term!r}')
        if self.order is not None and self.order not in ORDERS:
            raise ParameterError(f'order must be one of {", ".join(ORDERS)}, got {self.order!r}')
        low, high = FREE
        if self.free_length is not None and not low <= self.free_length <= high:
            raise ParameterError(
                f'free_length must be in [{low:g}, {high:g}] m, got {self.free_length!r}'
            )


def identify_steering(
    recordings: Sequence[SteeringRecording],
    settings: SteeringSettings | None = None,
    progress: Callable[[], object] | None = None,
) -> SteeringEstimate:
    """
    Identify free length, bending length, skin and drift from recorded insertions.

    Parameters
    ----------
    recordings : sequence of SteeringRecording
        Recordings. All share the free length; recordings of the same medium share bending
        length, skin and drift constants; each recording has a separate offset.
    settings : SteeringSettings, optional
        Drift terms, order and free length.
    progress : callable, optional
        Called after each fit.

    Returns
    -------
    SteeringEstimate
        Constants with intervals, and warnings about equivalent drift terms.

    Raises
    ------
    IdentificationError
        If there are no more samples than constants.

    """
    settings = settings or SteeringSettings()
    if not recordings:
        raise IdentificationError('no recordings to identify from')
    sets = [(term,) for term in TERMS] if settings.terms is None else [settings.terms]
    orders = ORDERS if settings.order is None else (settings.order,)
    fits: list[_Fit] = []
    for terms in sets:
        for order in orders:
            search = Search(recordings, terms, order, settings.free_length)
            _check(search)
            # The lengths hardly depend on the drift terms.
            fits.append(_Fit(search, *search.best(fits[0].x if fits else None)))
            if progress is not None:
                progress()
    best = min(fits, key=lambda fit: fit.cost)
    samples = 2 * sum(one.samples for one in recordings)
    alternatives = {
        fit.search.terms: sqrt(2.0 * fit.cost / samples)
        for fit in fits
        if fit.search.order == best.search.order
    }
    return _estimate(best, alternatives)


class _Fit(NamedTuple):
    search: Search
    x: FloatArray
    cost: float


def _check(search: Search) -> None:
    for one in search.recordings:
        if not one.samples:
            raise IdentificationError(f'{one.name}: no valid sample of the tip')
    for medium, members in search.members.items():
        samples = 2 * sum(search.recordings[k].samples for k in members)
        unknown = _LENGTHS + 1 + 2 * len(members) + sum(len(TERMS[term]) for term in search.terms)
        if samples <= unknown:
            raise IdentificationError(
                f'{unknown} constants of {medium or "these recordings"} need more than '
                f'{unknown // 2} samples of the tip, got {samples // 2}'
            )


class _Errors(NamedTuple):
    """Errors of the search variables, then of the linear constants of each medium."""

    errors: FloatArray  # (k,) standard errors
    units: FloatArray  # (k,) the same for unit variance of the samples
    freedom: list[int]  # degrees of freedom by medium
    values: list[FloatArray]  # linear constants by medium
    left: list[FloatArray]  # residuals by medium [m]


def _errors(search: Search, x: FloatArray) -> _Errors:
    """Return the errors of the fit, with independent recordings or white noise."""
    parts = search.design(x)
    slopes = search.slopes(x)
    total = len(x) + sum(a.shape[1] for a, _ in parts)
    normal, even, middle = np.zeros((3, total, total))
    freedom, values, left = [], [], []
    row, column = 0, len(x)
    for (columns, wanted), members in zip(parts, search.members.values(), strict=True):
        own = np.asarray(np.linalg.lstsq(columns, wanted)[0])
        rest = wanted - columns @ own
        jacobian = np.zeros((len(rest), total))
        jacobian[:, : len(x)] = slopes[row : row + len(rest)]
        jacobian[:, column : column + len(own)] = columns
        squares = jacobian.T @ jacobian
        normal += squares
        free = len(rest) - len(own) - _LENGTHS
        even += squares * float(rest @ rest) / free
        if len(members) >= _SEVERAL:
            # Differences between insertions are correlated within each insertion.
            starts = np.cumsum([0, *(2 * search.recordings[k].samples for k in members[:-1])])
            scores = np.add.reduceat(jacobian * rest[:, np.newaxis], starts, axis=0)
            middle += scores.T @ scores * len(scores) / (len(scores) - 1)
            free = len(scores) - 1
        else:
            middle += squares * float(rest @ rest) / free
        freedom.append(free)
        values.append(own)
        left.append(rest)
        row, column = row + len(rest), column + len(own)
    scale = np.sqrt(np.diag(normal))
    scale[scale == 0.0] = 1.0
    inverse = np.linalg.pinv(normal / np.outer(scale, scale), rcond=1e-13, hermitian=True)
    inverse = inverse / np.outer(scale, scale)
    # The spread of few recordings may be small by chance.
    both = [np.diag(inverse @ one @ inverse) for one in (even, middle)]
    errors = np.asarray(np.sqrt(np.maximum(*both)))
    return _Errors(errors, np.sqrt(np.diag(inverse)), freedom, values, left)


def _estimate(fit: _Fit, alternatives: Mapping[tuple[str, ...], float]) -> SteeringEstimate:
    """Compute errors and intervals, and assemble the result."""
    search, x, cost = fit
    e = _errors(search, x)
    quantiles = stdtrit(np.array(e.freedom), 0.975).tolist()

    def length(name: str, at: int, quantile: float) -> ParameterEstimate:
        """Return a search variable as a constant with a profile interval."""
        width = quantile * float(e.errors[at])
        rise = quantile * float(e.errors[at] / e.units[at]) if e.units[at] > 0.0 else inf
        if not isfinite(rise):
            return _constant(name)
        low, high = search.interval(x, cost, at, width, rise)
        value, error = float(x[at]), float(e.errors[at])
        if name == 'skin':
            low, value, high = (SKIN_SCALE * one for one in (low, value, high))
            # The lower bound of the skin is zero.
            return _constant(name, value, SKIN_SCALE * error, max(0.0, low), high)
        if not (isfinite(low) and isfinite(high)):
            return _constant(name)
        value = exp(value)
        return _constant(name, value, value * error, exp(low), exp(high))

    if search.known is None:
        free = length('free_length', 0, max(quantiles))
    else:
        free = _constant('free_length', search.known, 0.0, search.known, search.known)
    media, column = [], len(x)
    for k, (medium, members) in enumerate(search.members.items()):
        at = len(x) - _LENGTHS * (len(search.media) - k)
        found = [length('bending_length', at, quantiles[k]), length('skin', at + 1, quantiles[k])]
        names = [name for term in search.terms for name in TERMS[term]]
        for j, name in enumerate(names):
            value, error = float(e.values[k][j]), float(e.errors[column + j])
            half = quantiles[k] * error
            found.append(_constant(name, value, error, value - half, value + half))
        column += len(e.values[k])
        media.append(
            MediumEstimate(
                medium=medium,
                parameters=tuple(found),
                rms=float(np.sqrt(np.mean(e.left[k] ** 2))),
                samples=len(e.left[k]) // 2,
                recordings=len(members),
            )
        )
    return SteeringEstimate(
        free_length=free,
        media=tuple(media),
        terms=search.terms,
        order=search.order,
        alternatives=alternatives,
        residuals=tuple(_residuals(search, e.left)),
        warnings=tuple(_warnings(search, alternatives)),
    )


def _residuals(search: Search, left: Sequence[FloatArray]) -> list[FloatArray]:
    """Return the residuals of each recording, in input order."""
    found = {}
    for members, rest in zip(search.members.values(), left, strict=True):
        ends = np.cumsum([2 * search.recordings[at].samples for at in members])
        for at, own in zip(members, np.split(rest, ends[:-1]), strict=True):
            found[at] = own.reshape(2, -1).T
    return [found[at] for at in sorted(found)]


def _constant(
    name: str, value: float = nan, error: float = inf, low: float = -inf, high: float = inf
) -> ParameterEstimate:
    """Return a constant; it is undetermined if its interval is unbounded."""
    symbol, unit = CONSTANTS[name]
    if not (isfinite(low) and isfinite(high)):
        return ParameterEstimate(name=name, symbol=symbol, unit=unit)
    return ParameterEstimate(
        name=name, symbol=symbol, unit=unit, value=value, error=error, interval=(low, high),
        determined=True,
    )  # fmt: skip


def _warnings(search: Search, alternatives: Mapping[tuple[str, ...], float]) -> Iterator[str]:
    """Warn of drift terms that the recordings cannot distinguish."""
    best = min(alternatives.values())
    equal = [terms for terms, rms in alternatives.items() if rms <= (1.0 + _AS_GOOD) * best]
    if len(equal) > 1:
        each = ', '.join(f'{terms[0]} {1e3 * alternatives[terms]:.3f} mm' for terms in equal)
        yield (
            f'these explain the drift equally well (rms: {each}); all of it is attributed to '
            f'{search.terms[0]}. A motion of the guide in air identifies the frame, a rotation of '
            'the needle at half the depth identifies the bevel'
        )
