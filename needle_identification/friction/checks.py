# SPDX-License-Identifier: Apache-2.0
"""Plausibility checks of a friction estimate: errors and warnings."""

from collections.abc import Iterator, Sequence
from math import inf, sqrt
from typing import Final, NamedTuple

from needle_identification.errors import IdentificationError
from needle_identification.estimation.estimate import check_sign, ParameterEstimate
from needle_identification.estimation.regression import Regression
from needle_identification.friction.comparison import CandidateFit
from needle_identification.friction.design import Design
from needle_identification.friction.terms import columns_of
import numpy as np

_UNUSUAL_LAG: Final = 0.01  # largest lag of usual sensor filters [s]
_MUCH_LARGER: Final = 1.5  # growth of the errors by autocorrelated noise for a warning
_MORE_THAN_NOISE: Final = 1.2  # mu_v times noise of the velocity over the residual
_NOTABLE: Final = 0.5  # bias of mu_v by noise of the velocity that is corrected [standard errors]
_DOUBT: Final = 1e-4  # p-value of the terms at reversals for a warning
_WANDERS: Final = 0.25  # part of the recording: longer correlation is not finite
_FRICTION: Final = ('coulomb_friction', 'viscous_friction')


def check_friction(parameters: Sequence[ParameterEstimate]) -> None:
    """Raise `IdentificationError` if friction is clearly negative or not significant."""
    friction = [parameter for parameter in parameters if parameter.name in _FRICTION]
    # With friction by depth, mu_s is extrapolated.
    by_depth = any(parameter.name == 'length_friction' for parameter in parameters)
    for parameter in friction:
        if by_depth and parameter.name == 'coulomb_friction':
            continue
        check_sign('friction', parameter)
    if friction and all(p.determined and abs(p.value) < 2.0 * p.error for p in friction):
        sizes = ', '.join(f'{p.symbol} = {p.value:.2g} ± {p.error:.2g} {p.unit}' for p in friction)
        raise IdentificationError(
            f'no friction: {sizes}; force and motion do not belong together, or the axes are wrong'
        )


def fit_warnings(
    design: Design,
    fit: Regression,
    parameters: Sequence[ParameterEstimate],
    lag: ParameterEstimate,
    coarse: float,
    described: bool = True,
) -> Iterator[str]:
    """
    Yield warnings.

    ``coarse`` is the corrected lag [s] if ``lag`` is not determined; ``described`` is whether the
    terms describe the friction, otherwise the residual is no noise.
    """
    unknown = [parameter.name for parameter in parameters if not parameter.determined]
    hidden = design.hidden_words()
    if unknown:
        cure = f'use more speeds, or fewer terms{"; " if hidden else ""}{hidden}'
        yield f'the data do not determine {", ".join(unknown)}: {cure}'
    elif hidden:
        yield hidden
    settings = design.signals.settings
    if 'coulomb_friction' not in unknown:
        yield from _of_zero(design)
    if 'stribeck' in settings.terms and not design.reaches('stribeck'):
        slowest = float(np.abs(design.velocity[design.used]).min())
        yield (
            f'no sample is slow enough for the term stribeck: {slowest:.2g} m/s and more, with '
            f'stribeck_speed {settings.stribeck_speed:g} m/s; its coefficient is a guess'
        )
    if 'cutting' in settings.terms and not design.reaches('cutting'):
        yield (
            'the needle does not go into the same tissue twice: the term cutting is friction or '
            'an offset as well'
        )
    if design.signals.cut_off:
        yield (
            f'{100.0 * design.signals.cut_off:.2g} % of the force is at the limits of its sensor, '
            'which cut it off: left out'
        )
    cutoff, rate = settings.cutoff, 1.0 / design.signals.period
    if cutoff > 0.5 * rate:
        yield (
            f'not filtered: the cutoff of {cutoff:g} Hz is beyond half the sampling rate, '
            f'{0.5 * rate:.4g} Hz'
        )
    yield from _of_lag(lag, coarse, design)
    bias = noise_bias(design, fit)
    if bias:
        remedy = (
            ': choose estimator total' if settings.allows_total else ', which nothing corrects'
        )
        yield noise_words(design, bias) + remedy
    if settings.reversals and design.doubt_at_reversals() < _DOUBT:
        yield (
            'at reversals the force does not follow the terms (presliding or breakaway), which '
            'changes the estimates: without reversals these samples are left out'
        )
    if described:
        yield from _of_memory(design, fit)
    known = {parameter.name: parameter for parameter in parameters if parameter.determined}
    if {'moving_mass', 'viscous_friction'} <= set(known):
        mass = 1e-3 * known['viscous_friction'].value
        yield f'a lag of the force of 1 ms looks like {-mass:.2g} kg of moving_mass'


def _of_zero(design: Design) -> Iterator[str]:
    """Warn if the data do not distinguish the zero of the force sensor from mu_s."""
    terms = design.signals.settings.terms
    if 'coulomb' not in terms or 'offset' in terms:
        return
    if not design.screening.tried(design.columns(['offset']).take(design.rows, axis=0)).determined:
        cure = '' if 'direction' in terms else ', or record both directions'
        yield f'mu_s includes the zero of the force sensor: tare it before contact{cure}'


def _of_lag(lag: ParameterEstimate, coarse: float, design: Design) -> Iterator[str]:
    """Warn of a lag that exceeds usual filters, or that indicates a mass."""
    period = design.signals.period
    if not lag.determined:
        if coarse:
            order = 'behind' if coarse > 0.0 else 'ahead of'
            size = f'{1e3 * abs(coarse):.2g} ms'
            yield f'the force is about {size} {order} the motion (from steady strokes); corrected'
    elif not lag.interval[0] <= 0.0 <= lag.interval[1]:
        size = f'{1e3 * abs(lag.value):.3g} ± {1e3 * lag.error:.2g} ms'
        if low_pass := design.signals.low_pass:
            size += f' (a low-pass filter of about {0.5 / np.pi / low_pass:.2g} Hz)'
        if lag.value > max(_UNUSUAL_LAG, period):
            yield f'the force is {size} behind the motion: filters or clocks; corrected'
        elif lag.value < -period / 2.0:
            yield f'the force is {size} ahead of the motion: clocks, or a mass (term inertia)'


class VelocityBias(NamedTuple):
    """Bias of mu_v by white noise of the velocity, and its error [N s/m]; the noise as a force."""

    bias: float
    error: float
    noise: float  # [N]


def velocity_bias(design: Design, fit: Regression) -> VelocityBias:
    """Return the bias of least squares; the error is inf if the data do not determine mu_v."""
    settings, noise = design.signals.settings, design.signals.velocity_noise
    columns = columns_of(settings.terms, settings)
    names = [column.name for column in columns]
    if 'viscous_friction' not in names:
        return VelocityBias(0.0, 0.0, 0.0)
    k = names.index('viscous_friction')
    if not fit.determined[k]:
        return VelocityBias(0.0, inf, 0.0)
    x = design.regressors(settings.terms).take(design.rows, axis=0)[:, : len(columns)]
    bias = float(fit.values[k] * fit.samples * noise**2 * np.linalg.pinv(x.T @ x)[k, k])
    return VelocityBias(bias, float(fit.errors[k]), float(abs(fit.values[k])) * noise)


def noise_bias(design: Design, fit: Regression) -> float:
    """Return the bias of mu_v by velocity noise [N s/m]; 0 if negligible or corrected."""
    if design.signals.settings.estimator == 'total':
        return 0.0
    found = velocity_bias(design, fit)
    # The noise of the velocity is part of the residual. More was found where a slow sampling does
    # not resolve the motion.
    spread = float(np.linalg.norm(fit.residual)) / sqrt(fit.samples)
    if found.noise > _MORE_THAN_NOISE * spread:
        return 0.0
    return found.bias if found.bias > _NOTABLE * found.error else 0.0


def noise_words(design: Design, bias: float) -> str:
    noise = design.signals.velocity_noise
    return f'noise of {noise:.2g} m/s in the speed reduces mu_v by {bias:.2g} N s/m'


def _of_memory(design: Design, fit: Regression) -> Iterator[str]:
    if fit.memory is None or not fit.memory.length or fit.is_exact:
        return
    growth = float(fit.memory.inflation[fit.determined].max(initial=1.0))
    if growth < _MUCH_LARGER:
        return
    time = fit.memory.length * design.signals.period
    lasts = design.signals.time[-1] - design.signals.time[0]
    how = (
        f'is correlated over about {time:.2g} s'
        if time < _WANDERS * lasts
        else 'wanders for as long as the recording'
    )
    yield f'the noise of the force {how}: the errors grow by {growth:.2g} against white noise'


def missing_term(chosen: Sequence[str], comparisons: Sequence[CandidateFit]) -> str:
    """Return a warning that names the best missing term, or an empty string."""
    missing = [c for c in comparisons if c.supported and len(c.terms) > len(chosen)]
    if not missing:
        return ''
    best = min(missing, key=lambda c: c.difference)
    more = best.terms[len(chosen) :]
    return f'{best.words}: add the term{"s" if len(more) > 1 else ""} {" and ".join(more)}'
