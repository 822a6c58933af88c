r"""
Identify friction from force and motion of the needle base by linear regression.

With the tip past the tissue, the axial row of equation (16) of the paper is friction (15),
with optional further terms:

.. math:: f_y(t + \tau) = \mu_s \operatorname{sgn}(\dot s) + \mu_v \dot s + ...

Modules:

================  =================================================================================
`filtering`       force and motion through one zero-phase filter, on an even time base
`lag`             the lag tau of the force
`design`          samples in steady motion, regressors (`terms`), and the regression
`intervals`       parameters with standard errors and confidence intervals
`breakaway`       breakaway force
`punctures`       drops of the force on entering new tissue
`comparison`      alternative sets of terms
`checks`          errors and warnings
================  =================================================================================
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from math import nan, sqrt
from typing import Final, NamedTuple

from needle_identification.errors import IdentificationError
from needle_identification.estimation.memory import divided
from needle_identification.estimation.regression import Regression
from needle_identification.estimation.residual_tests import residual_tests
from needle_identification.estimation.screening import Screening
from needle_identification.friction.breakaway import breakaway_force
from needle_identification.friction.checks import (
    check_friction,
    fit_warnings,
    missing_term,
    noise_bias,
    noise_words,
)
from needle_identification.friction.comparison import compare_terms
from needle_identification.friction.design import Design, select_samples
from needle_identification.friction.estimate import Fit, FrictionEstimate
from needle_identification.friction.filtering import (
    filter_signals,
    FilteredSignals,
    HALF_LENGTH,
)
from needle_identification.friction.intervals import parameter_estimates
from needle_identification.friction.lag import find_lag, lag_estimate
from needle_identification.friction.punctures import find_punctures
from needle_identification.friction.settings import AUTO, FrictionSettings
from needle_identification.friction.terms import columns_of
from needle_identification.recordings.recording import Recording
import numpy as np

#: Largest velocity noise threshold, as a fraction of the median speed.
_HIDDEN: Final = 0.2

#: Positions replace velocities if their velocity noise is below this fraction.
_CLEANER: Final = 0.5

#: Time after a change within which the force may deviate from the terms [s], and the p-value
#: of the deviation below which these samples are left out.
_TRANSITION: Final = 0.1
_TRANSITIONS_DIFFER: Final = 0.001

#: Largest difference of parameters that agree [standard errors for white noise].
_CLOSE: Final = 3.0


def identify_friction(
    recording: Recording, settings: FrictionSettings | None = None, among: int = 1
) -> FrictionEstimate:
    """
    Estimate friction from one recording.

    Parameters
    ----------
    recording : Recording
        Force and motion with the needle tip beyond the tissue, without cutting. Without recorded
        velocity, the insertion depth is differentiated by the same zero-phase filter.
    settings : FrictionSettings, optional
        Terms, filter and estimator.
    among : int
        Number of recordings identified together. The probability that an unneeded term is
        suggested for any of them is 2 %.

    Returns
    -------
    FrictionEstimate
        Estimates with standard errors that account for the autocorrelation of the residuals by
        filter and sensor, and warnings.

    Raises
    ------
    IdentificationError
        If the recording has too little motion, or the friction is negative or absent.

    Examples
    --------
    Synthetic strokes, 20 s at 250 samples/s:

    >>> import numpy as np
    >>> time = np.arange(0.0, 20.0, 0.004)
    >>> speed = 0.008 * np.sin(2.0 * time) + 0.006 * np.sin(3.1 * time)
    >>> noise = np.random.default_rng(0).normal(scale=0.01, size=len(time))
    >>> force = 0.56 * np.sign(speed) + 300.0 * speed + noise
    >>> recording = Recording(time=time, speed=speed, force=force)
    >>> estimate = identify_friction(recording)
    >>> low, high = estimate['viscous_friction'].interval
    >>> low < 300.0 < high
    True

    """
    settings = settings or FrictionSettings()
    try:
        return _identify(recording, settings, among)
    except IdentificationError as error:
        raise IdentificationError(f'{recording.name}: {error}') from None


def _identify(recording: Recording, settings: FrictionSettings, among: int) -> FrictionEstimate:
    choice = _chosen(recording, settings)
    signals, design, fit = choice.signals, choice.design, choice.fit
    settings = signals.settings
    has_inertia = 'inertia' in settings.terms
    used = design.used
    mean_speed = float(np.mean(np.abs(design.speed[used])))
    parameters = parameter_estimates(fit, settings, mean_speed, signals.period)
    check_friction(parameters)
    lag = lag_estimate(choice.fine, design, fit)
    tests = (
        ()
        if fit.is_exact or fit.memory is None
        else residual_tests(
            fit.residual,
            time=signals.time,
            speed=design.speed,
            parts=divided(used, signals.correlation),
            memory=fit.memory,
            parameters=len(fit.values),
        )
    )
    comparison = () if fit.is_exact else compare_terms(design, fit, among)
    missing = missing_term(settings.terms, comparison)
    doubts = [missing] if missing else [test.words for test in tests if test.failed]
    return FrictionEstimate(
        name=recording.name,
        terms=settings.terms,
        estimator=settings.estimator,
        parameters=parameters,
        breakaway=breakaway_force(design, parameters),
        # The interval of the lag omits errors by the position resolution and by a mass.
        lag=None if choice.from_positions or has_inertia else lag,
        punctures=find_punctures(design, fit),
        samples=fit.samples,
        residual=sqrt(float(fit.residual @ fit.residual) / fit.samples),
        determination=fit.determination,
        condition=fit.condition,
        tests=tests,
        comparison=comparison,
        warnings=(
            *choice.remarks,
            *fit_warnings(design, fit, parameters, lag, choice.coarse),
            *doubts,
        ),
        fit=Fit(
            time=signals.time,
            speed=design.speed,
            force=signals.force,
            model=np.where(used, signals.force - fit.residual, nan),
            used=used,
        ),
    )


class _Choice(NamedTuple):
    """Signals, samples and fit selected by the data; lag of the force [s] from `find_lag`."""

    signals: FilteredSignals
    design: Design
    fit: Regression
    coarse: float
    fine: float | None
    from_positions: bool
    remarks: tuple[str, ...] = ()


def _chosen(recording: Recording, settings: FrictionSettings) -> _Choice:
    """Select velocity source, estimator and samples; remarks describe unusual choices."""
    simple = replace(settings, estimator='ordinary') if settings.estimator == AUTO else settings
    choice = _first_choice(filter_signals(recording, simple), recording.speed is None)
    if settings.estimator != AUTO:
        return _without_transitions(choice)
    remark = _noise_remark(choice)
    if remark and recording.speed is not None:
        signals = filter_signals(replace(recording, speed=None), simple)
        if _is_cleaner(signals, choice.signals):
            choice = _first_choice(signals, from_positions=True)._replace(
                remarks=(f'{remark}: took the speed from the positions',)
            )
    bias = noise_bias(choice.design, choice.fit)
    if bias and settings.allows_total:
        remark = noise_words(choice.design, bias)
        total = replace(choice.signals, settings=replace(settings, estimator='total'))
        with suppress(IdentificationError):
            choice = _first_choice(total, choice.from_positions)._replace(
                remarks=(*choice.remarks, f'{remark}: took estimator total')
            )
    return _without_transitions(choice)


def _noise_remark(choice: _Choice) -> str:
    """Describe the effect of velocity noise if it is relevant."""
    if bias := noise_bias(choice.design, choice.fit):
        return noise_words(choice.design, bias)
    design = choice.design
    usual = float(np.median(np.abs(design.speed[design.used])))
    if choice.signals.moving_speed < _HIDDEN * usual:
        return ''
    return (
        f'noise of {choice.signals.speed_noise:.2g} m/s in the speed hides motion below '
        f'{choice.signals.moving_speed:.2g} m/s'
    )


def _is_cleaner(positions: FilteredSignals, speeds: FilteredSignals) -> bool:
    """Whether positions give less velocity noise and are not integrated velocities."""
    apart = float(np.std(positions.motion(speeds.time) - speeds.motion(speeds.time)))
    noise = speeds.speed_noise
    return positions.speed_noise < _CLEANER * noise and apart > _CLEANER * noise


def _first_choice(signals: FilteredSignals, from_positions: bool) -> _Choice:
    """Fit at the lag that the motion determines, if any."""
    coarse, fine = 0.0, None
    if 'inertia' not in signals.settings.terms:
        coarse, fine = find_lag(signals)
    design, fit = _fitted(signals, coarse, fine)
    if design.estimates_lag and not fit.errors[-1] < HALF_LENGTH / signals.settings.cutoff:
        # The force is not linear in a lag above the filter length.
        fine = None
        design, fit = _fitted(signals, coarse, fine)
    return _Choice(signals, design, fit, coarse, fine, from_positions)


def _without_transitions(choice: _Choice) -> _Choice:
    """Leave out more samples around each change if the force deviates from the terms there."""
    settings = choice.signals.settings
    count = len(columns_of(settings.terms, settings))
    design = choice.design.far_from_changes(_TRANSITION)
    if choice.fit.is_exact or not design.is_enough or _agree(design, choice.fit, count):
        return choice
    try:
        if design.estimates_lag:
            design = design.with_lag_column()
        fit = design.solve(settings.terms, settings.estimator)
    except IdentificationError:
        # Too few samples remain.
        return choice
    if fit.differs(choice.fit, count) >= _TRANSITIONS_DIFFER:
        return choice
    remark = (
        f'within {_TRANSITION:g} s of starts, stops and reversals the force does not follow the '
        'terms (presliding, play, stick-slip, or a force that settles): left out'
    )
    return choice._replace(design=design, fit=fit, remarks=(*choice.remarks, remark))


def _agree(design: Design, whole: Regression, count: int) -> bool:
    """Whether a subset of samples gives the same parameters within small standard errors."""
    used = design.used
    few = Screening(
        design.regressors(design.signals.settings.terms)[used],
        design.signals.force[used],
        divided(used, design.signals.correlation),
    )
    close = np.abs(few.values - whole.values) <= _CLOSE * few.errors
    return bool((close | ~whole.determined)[:count].all())


def _fitted(
    signals: FilteredSignals, coarse: float, fine: float | None
) -> tuple[Design, Regression]:
    """Fit with the remaining lag as an unknown, or at the coarse lag if ``fine`` is None."""
    settings = signals.settings
    lag = coarse if fine is None else fine
    # The error of a coarse lag is up to half a step.
    error = 0.5 * signals.half_filter * signals.period if fine is None else 0.0
    design = select_samples(signals, lag, abs(lag) + error)
    design.check()
    if fine is not None:
        design = design.with_lag_column()
    return design, design.solve(settings.terms, settings.estimator)
