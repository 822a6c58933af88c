r"""
Friction of a needle from force and motion of its base, by linear regression.

With the tip past the tissue, the axial row of equation (16) of the paper is friction (15),
with optional further terms:

.. math:: f_y(t + \tau) = \mu_s \operatorname{sgn}(\dot s) + \mu_v \dot s + ...

The steps, each in a file of its own:

================  =================================================================================
`filtering`       force and motion through one zero-phase filter, on an even time base
`lag`             the lag tau of the force
`design`          samples in steady motion, regressors (`terms`), and the regression
`intervals`       parameters with standard errors and confidence intervals
`breakaway`       the force at which the needle begins to move
`comparison`      other sets of terms
`checks`          errors and warnings
================  =================================================================================
"""

from __future__ import annotations

from math import nan, sqrt
from typing import Final

from needle_identification.errors import IdentificationError
from needle_identification.estimation.regression import Regression
from needle_identification.estimation.residual_tests import residual_tests
from needle_identification.friction.breakaway import breakaway_force
from needle_identification.friction.checks import check_friction, fit_warnings, missing_term
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
from needle_identification.friction.settings import FrictionSettings
from needle_identification.recordings.recording import Recording
import numpy as np

#: Part of the variance of the force below which the residual is rounding.
_EXACT: Final = 1e-9


def identify_friction(
    recording: Recording, settings: FrictionSettings | None = None
) -> FrictionEstimate:
    """
    Estimate friction from one recording.

    Parameters
    ----------
    recording : Recording
        Force and motion with the needle tip past the tissue, so that nothing is cut. Without
        speeds the inserted length is differentiated, by the same zero-phase filter.
    settings : FrictionSettings, optional
        Terms, filter and estimator.

    Returns
    -------
    FrictionEstimate
        Estimates with standard errors that respect the correlation which filter and sensor leave
        in the residuals, and warnings.

    Raises
    ------
    IdentificationError
        If the recording has too little motion, or the friction is negative or absent.

    Examples
    --------
    From NumPy arrays: strokes in and out with 20 s of motion at 250 samples/s.

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
        return _identify(recording, settings)
    except IdentificationError as error:
        raise IdentificationError(f'{recording.name}: {error}') from None


def _identify(recording: Recording, settings: FrictionSettings) -> FrictionEstimate:
    signals = filter_signals(recording, settings)
    has_inertia = 'inertia' in settings.terms
    coarse, fine = find_lag(signals)
    design, fit = _fitted(signals, coarse, fine)
    if design.estimates_lag and not fit.errors[-1] < HALF_LENGTH / settings.cutoff:
        # Beyond the length of the filter the force is not linear in the lag.
        design, fit = _fitted(signals, coarse, None)
    used = design.used
    mean_speed = float(np.mean(np.abs(design.speed[used])))
    parameters = parameter_estimates(fit, settings, mean_speed, signals.period)
    check_friction(parameters)
    lag = lag_estimate(fine, design, fit)
    is_exact = 1.0 - fit.determination < _EXACT
    tests = (
        ()
        if is_exact
        else residual_tests(
            fit.residual,
            used=used,
            time=signals.time,
            speed=design.speed,
            length=signals.correlation,
            parameters=len(fit.values),
        )
    )
    comparison = () if is_exact else compare_terms(design, fit)
    missing = missing_term(settings.terms, comparison)
    doubts = [missing] if missing else [test.words for test in tests if test.failed]
    return FrictionEstimate(
        name=recording.name,
        terms=settings.terms,
        estimator=settings.estimator,
        parameters=parameters,
        breakaway=breakaway_force(design, parameters),
        # The resolution of positions and a mass make errors of the lag that its interval lacks.
        lag=None if recording.speed is None or has_inertia else lag,
        samples=fit.samples,
        residual=sqrt(float(fit.residual @ fit.residual) / fit.samples),
        determination=fit.determination,
        condition=fit.condition,
        tests=tests,
        comparison=comparison,
        warnings=(
            *fit_warnings(design, fit, parameters, lag, 0.0 if has_inertia else coarse),
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


def _fitted(
    signals: FilteredSignals, coarse: float, fine: float | None
) -> tuple[Design, Regression]:
    """Fit with a further lag as one more unknown, or at the coarse lag if there is no fine one."""
    settings = signals.settings
    lag = coarse if fine is None else fine
    # A coarse lag is wrong by up to half a step.
    error = 0.5 * signals.half_filter * signals.period if fine is None else 0.0
    is_corrected = 'inertia' not in settings.terms
    design = select_samples(signals, lag if is_corrected else 0.0, abs(lag) + error)
    design.check()
    if is_corrected and fine is not None:
        design = design.with_lag_column()
    return design, design.solve(settings.terms, settings.estimator)
