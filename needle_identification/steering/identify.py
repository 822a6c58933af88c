# SPDX-License-Identifier: Apache-2.0
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

Their constants have priors, so that all causes are fitted together. Each recording has its own
slope and path noise (`needle_identification.steering.mixed`), so that the readings of a recording
are not independent. The search for the lengths starts from a grid (variable projection
[Golub2003]_). Their intervals are profile likelihood intervals, in which the order of motion is
unknown as well: they contain all optima and orders that fit alike. Their level is the one of
Student's t; its degrees of freedom are from the scatter of the variances over the ratios
[Satterthwaite1946]_.

References
----------
.. [Golub2003] G. H. Golub, V. Pereyra, "Separable nonlinear least squares: the variable projection
   method and its applications", Inverse Problems 19, 2003.
.. [Satterthwaite1946] F. E. Satterthwaite, "An approximate distribution of estimates of variance
   components", Biometrics Bulletin 2(6), 1946.

"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from math import exp, inf, isfinite, log1p, sqrt
from typing import Final, NamedTuple

from needle_dynamics.arrays import FloatArray
from needle_dynamics.display import Progress, progress_of
from needle_dynamics.parameters import NeedleParameters
from needle_dynamics.steering.parameters import bending_length
from needle_identification.errors import IdentificationError
from needle_identification.estimation.estimate import ParameterEstimate
from needle_identification.steering.estimate import (
    LAYER,
    MediumEstimate,
    SteeringEstimate,
    symbol_and_unit,
)
from needle_identification.steering.mixed import MixedModel, variances
from needle_identification.steering.recording import (
    DEVIATIONS,
    NominalLayers,
    ORDERS,
    readings,
    SteeringRecording,
    TERMS,
    UNIFORM,
)
from needle_identification.steering.search import (
    FREE,
    held_out,
    interval,
    Optimum,
    rms_of,
    Search,
    searched,
    skin_of,
    Tips,
)
from needle_ros.errors import ParameterError
from needle_ros.quantities import SIGNED_PAIRS
from needle_ros.settings import check_choice
import numpy as np
from scipy.special import stdtrit

_WORSE: Final = 1.5  # smallest ratio of held-out errors and residuals that is reported
_LEAST: Final = 1e-4  # least weight of a ratio of variances, for intervals and predictions
#: Path noise that is reported [rad^2/m]: the path turns by 2 degrees in 0.1 m.
_WANDERS: Final = 0.01
_BETTER: Final = 20.0  # gain of the deviance by other axes of the tip that is reported
_ROTATED: Final = 0.06  # rotation between frames that is reported [rad]
_LARGEST: Final = 0.5  # largest error of a drift constant that is determined [prior deviations]


@dataclass(frozen=True, slots=True, kw_only=True)
class SteeringSettings:
    """Settings of the steering identification."""

    terms: tuple[str, ...] = tuple(TERMS)  #: causes of drift
    order: str | None = None  #: ``together`` or ``guide first``; None selects the better
    free_length: float | None = None  #: known free length [m]; None to estimate it
    #: Nominal needle in its tissue; if this has layers, the stiffness of each over its nominal one
    #: is estimated. None: uniform tissue.
    tissue: NeedleParameters | None = None

    def __post_init__(self) -> None:
        if not self.terms:
            raise ParameterError(f'terms must be at least one of {", ".join(TERMS)}')
        for term in self.terms:
            check_choice('terms', term, TERMS)
        if self.order is not None:
            check_choice('order', self.order, ORDERS)
        low, high = FREE
        if self.free_length is not None and not low <= self.free_length <= high:
            raise ParameterError(
                f'free_length must be in [{low:g}, {high:g}] m, got {self.free_length!r}'
            )
        if self.tissue is not None and min(self.tissue.tissue.stiffnesses) <= 0.0:
            raise ParameterError(
                'each layer of tissue needs a nominal stiffness > 0 N/m^2, got '
                f'{", ".join(f"{one:g}" for one in self.tissue.tissue.stiffnesses)}'
            )

    @property
    def layers(self) -> NominalLayers:
        """Layers whose stiffness is estimated."""
        if self.tissue is None or len(self.tissue.tissue.starts) == 1:
            return UNIFORM
        tissue, stiffness = self.tissue.tissue, self.tissue.bending_stiffness
        lengths = (bending_length(stiffness, one) for one in tissue.stiffnesses)
        return NominalLayers(tissue.starts, tuple(lengths))


def identify_steering(
    recordings: Sequence[SteeringRecording],
    settings: SteeringSettings | None = None,
    progress: Progress | None = None,
) -> SteeringEstimate:
    """
    Identify free length, bending length, skin and drift from recorded insertions.

    With a nominal needle in layers of tissue, each layer has its own stiffness. A layer that the
    recordings do not determine to a factor of 2 has the value that the others were fitted with.

    Parameters
    ----------
    recordings : sequence of SteeringRecording
        Recordings. All share the free length; recordings of the same medium share bending
        length, skin and drift constants; each recording has a separate offset.
    settings : SteeringSettings, optional
        Drift terms, order, free length and layers.
    progress : bool or callable, optional
        True shows a progress bar; a function is called after each search.

    Returns
    -------
    SteeringEstimate
        Constants with intervals, prediction errors, and warnings about equivalent fits.

    Raises
    ------
    IdentificationError
        If there are no more samples than constants.

    """
    settings = settings or SteeringSettings()
    if not recordings:
        raise IdentificationError('no recordings to identify from')
    orders = ORDERS if settings.order is None else (settings.order,)
    read = [readings(one) for one in recordings]
    _check(read, 1 + len(settings.layers.starts))
    fits: list[_Fit] = []
    with progress_of(progress, len(orders), 'fits') as advance:
        for order in orders:
            tips = Tips(read, order, settings.layers)
            fits.append(_Fit(*searched(tips, settings.terms, settings.free_length)))
            advance()
    best = min(fit.optima[0].deviance for fit in fits)
    ranked = [fit._replace(gap=fit.optima[0].deviance - best) for fit in fits]
    found = _estimate(sorted(ranked, key=lambda fit: fit.gap))
    return replace(found, tissue=settings.tissue)


class _Fit(NamedTuple):
    search: Search
    optima: list[Optimum]
    gap: float = 0.0  # deviance minus that of the best fit


def _check(recordings: Sequence[SteeringRecording], lengths: int) -> None:
    for one in recordings:
        if not one.samples:
            raise IdentificationError(f'{one.name}: no valid sample of the tip')
    for medium in dict.fromkeys(one.medium for one in recordings):
        members = [one.samples for one in recordings if one.medium == medium]
        # The lengths, and offset and direction in each plane.
        unknown = lengths + 1 + 2 * len(members) + 2
        if 2 * sum(members) <= unknown:
            raise IdentificationError(
                f'{unknown} constants of {medium or "these recordings"} need more than '
                f'{unknown // 2} samples of the tip, got {sum(members)}'
            )


def _refined(fit: _Fit) -> _Fit:
    """Return the fit with the lengths integrated out, for the probable ratios of variances."""
    search, x = fit.search, fit.optima[0].x
    models = []
    for model, one, spread in zip(search.models, search.fits(x), search.spreads(x), strict=True):
        # The drift of a single recording contains its slope: nothing can be hidden.
        penalties = -np.linalg.slogdet(spread)[1] * (len(model.depths) > 1)
        weights = one.weights * np.exp(-0.5 * (penalties - penalties.min()))
        kept = weights > _LEAST * weights.sum()
        models.append(MixedModel(model.depths, model.prior, model.ratios[kept], penalties[kept]))
    refined = Search(search.tips, search.terms, search.known, models)
    return fit._replace(search=refined, optima=refined.optima([one.x for one in fit.optima]))


def _freedom(search: Search, x: FloatArray) -> FloatArray:
    """Return the degrees of freedom (k,) of the variance of each variable (Satterthwaite)."""
    found = np.full(len(x), inf)
    parts = zip(search.freedom(x), search.fits(x), search.spreads(x), strict=True)
    for medium, (known, one, spread) in enumerate(parts):
        each = np.diagonal(spread, axis1=1, axis2=2)
        mean = one.weights @ each
        # The ratios of the deviations are uncertain, too.
        scatter = one.weights @ (each / mean - 1.0) ** 2
        own = search.own(medium)
        found[own] = np.minimum(found[own], 1.0 / (1.0 / known + 0.5 * scatter))
    return np.asarray(np.maximum(found, 1.0))


def _estimate(ranked: Sequence[_Fit]) -> SteeringEstimate:
    """Return the constants of the first fit, with the intervals of all that fit alike."""
    search, best = (first := _refined(ranked[0])).search, first.optima[0]
    fits, residuals = search.fits(best.x), search.residuals(best.x)
    information = search.information(best.x)
    freedom = search.freedom(best.x)
    rises = [
        log1p(stdtrit(free, 0.975) ** 2 / free) * (free + 1.0)
        for free in _freedom(search, best.x).tolist()
    ]
    alike = [first, *(_refined(fit) for fit in ranked[1:] if fit.gap < max(rises))]

    @cache
    def ends(at: int) -> tuple[float, float]:
        """Return the profile interval of a variable, if guide or roll alone determine it."""
        rise = rises[at]
        if search.ranges[at] ** 2 * information[at] <= 4.0 * rise:
            return -inf, inf
        each = [
            interval(fit.search, fit.optima, at, rise - fit.gap) for fit in alike if fit.gap < rise
        ]
        low, high = min(low for low, _ in each), max(high for _, high in each)
        return (-inf, inf) if search.ranges[at] < high - low < inf else (low, high)

    def length(name: str, at: int, shown: Callable[[float], float]) -> ParameterEstimate:
        """Return the constant of a variable with its interval."""
        x, step = float(best.x[at]), 1e-6
        low, high = ends(at)
        if name == 'skin' and high < inf:
            # The lower bound of the skin is zero.
            low = max(low, 0.0)
        if not (isfinite(low) and isfinite(high)):
            return _constant(name, shown(x))
        error = sqrt(best.spread[at, at]) * abs(shown(x + step) - shown(x)) / step
        return _constant(name, shown(x), error, *sorted((shown(low), shown(high))))

    def layers(medium: int) -> Iterator[ParameterEstimate]:
        """Return the stiffness of each layer over its nominal one."""
        pairs = zip(search.layers(medium), search.tips.layers.lengths, strict=True)
        for k, (at, nominal) in enumerate(pairs if search.layered else (), 1):
            yield length(f'{LAYER}{k}', at, partial(_stiffness_ratio, nominal))

    if search.known is None:
        free = length('free_length', 0, exp)
    else:
        free = _constant('free_length', search.known, 0.0, search.known, search.known)
    media = []
    for k, (medium, members) in enumerate(search.members.items()):
        at = search.layers(k)[0]
        one, left = fits[k], [residuals[own] for own in members]
        paths = variances(search.models[k].ratios) * one.variances[:, np.newaxis]
        path_noise, slopes = (one.weights @ paths).tolist()
        media.append(
            MediumEstimate(
                medium=medium,
                parameters=(
                    length('bending_length', at, exp),
                    length('skin', at + 1, skin_of),
                    *layers(k),
                    *_drift(search, best, k, float(stdtrit(freedom[k], 0.975))),
                ),
                rms=rms_of(left),
                noise=sqrt(float(one.weights @ one.variances)),
                path_noise=path_noise,
                slope=sqrt(slopes),
                held_out=held_out(search, best, k),
                samples=sum(map(len, left)),
                recordings=len(members),
            )
        )
    return SteeringEstimate(
        free_length=free,
        media=tuple(media),
        terms=search.terms,
        order=search.tips.order,
        residuals=tuple(residuals),
        optima=len(first.optima),
        warnings=(*_warnings(alike, min(rises), media), *_axes(search)),
    )


def _axes(search: Search) -> Iterator[str]:
    """Warn if the needle explains other axes of the tip far better."""
    tips = [search.tips.with_axes(x, z) for x, z in SIGNED_PAIRS]
    others = [Search(one, search.terms, search.known) for one in tips]
    for k, medium in enumerate(search.members):
        least = [one.least(k) for one in others]
        x, z = SIGNED_PAIRS[int(np.argmin(least))]
        if least[0] - min(least) > _BETTER:
            yield (
                f'{medium or "these recordings"}: the guide explains the tip far better with {x} '
                f'as x and {z} as z: axes of the tip or of the guide are exchanged or reversed'
            )


def _stiffness_ratio(nominal: float, variable: float) -> float:
    """Return the stiffness over the nominal one, for a nominal bending length [m]."""
    return (nominal / exp(variable)) ** 4


def _drift(
    search: Search, best: Optimum, medium: int, quantile: float
) -> Iterator[ParameterEstimate]:
    """Return the drift constants, with the errors of the lengths and of the ratios."""
    one = search.fits(best.x)[medium]
    values = one.drift
    apart = one.values - values
    covariance = np.einsum('k,kij->ij', one.weights, one.covariances)
    covariance += (one.weights * apart.T) @ apart
    slopes = [
        (search.fits(there)[medium].drift - values) / step for step, there in search.steps(best.x)
    ]
    covariance += np.transpose(slopes) @ best.spread @ np.array(slopes)
    names = [(name, DEVIATIONS[term]) for term in search.terms for name in TERMS[term]]
    for (name, prior), value, variance in zip(
        names, values.tolist(), np.diag(covariance), strict=True
    ):
        error = sqrt(variance)
        half = quantile * error if error < _LARGEST * prior else inf
        yield _constant(name, value, error, value - half, value + half)


def _constant(
    name: str, value: float, error: float = inf, low: float = -inf, high: float = inf
) -> ParameterEstimate:
    """Return a constant; without a bounded interval it is undetermined, with the value used."""
    symbol, unit = symbol_and_unit(name)
    found = ParameterEstimate(name=name, symbol=symbol, unit=unit, value=value)
    if not (isfinite(low) and isfinite(high)):
        return found
    return replace(found, error=error, interval=(low, high), determined=True)


def _warnings(
    alike: Sequence[_Fit], rise: float, media: Sequence[MediumEstimate]
) -> Iterator[str]:
    """Warn of fits that the recordings cannot distinguish, and of poor predictions."""
    search, optima = alike[0].search, alike[0].optima
    # The interval of a constant that is hardly determined contains more fits.
    alike = [fit for fit in alike if fit.gap < rise]
    if any(fit.search.tips.order != search.tips.order for fit in alike):
        yield (
            'guide and needle may move together or one after the other: both fit alike, and the '
            'intervals contain both'
        )
    near = [one for one in optima if one.deviance - optima[0].deviance <= rise]
    if len(near) > 1:
        each = ' or '.join(
            f'{1e3 * length:.1f} mm with skin {1e3 * skin:.1f} mm'
            for one in near
            for _, length, skin, *_ in search.lengths(one.x)
        )
        yield f'{len(near)} sets of lengths fit alike, the intervals contain all: lambda {each}'
    names = {name for term in search.terms for name in TERMS[term]}
    for one in media:
        name = one.medium or 'these recordings'
        unknown = [each.name for each in one.parameters if not each.determined]
        if unknown := [each for each in unknown if each in names]:
            yield (
                f'{name}: the causes of drift are not known apart ({", ".join(unknown)} have '
                'probable values). A motion of the guide in air identifies the frame, a rotation '
                'of the needle at half the depth identifies the bevel'
            )
        if one.held_out is not None and one.held_out.rms > _WORSE * one.rms:
            yield (
                f'{name}: a recording is predicted from the others with an error of '
                f'{1e3 * one.held_out.rms:.3f} mm, the residuals have {1e3 * one.rms:.3f} mm'
            )
        if one.path_noise > _WANDERS:
            yield (
                f'{name}: this needle explains little of the motion of the tip: a path noise of '
                f'{one.path_noise:.2g} rad^2/m is beyond that of tissue; check columns, units and '
                'directions'
            )
        for constant in one.parameters:
            if constant.name.startswith('frame') and abs(constant.value) > _ROTATED:
                low, high = constant.interval
                may = 'may differ' if low <= 0.0 <= high else 'differ'
                yield (
                    f'{name}: the frames of guide and tip {may} by {constant.symbol} = '
                    f'{constant.value:.2f} rad ({low:.2f} to {high:.2f}): check the registration '
                    'of the sensor'
                )
