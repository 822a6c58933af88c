# SPDX-License-Identifier: Apache-2.0
r"""
Identify friction from force and motion of the needle base by linear regression.

With the tip past the tissue, the axial row of equation (16) of the paper is friction (15),
with optional further terms:

.. math:: f_y(t + \tau) = \mu_s \operatorname{sgn}(\dot s) + \mu_v \dot s + ...
"""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from math import hypot, isinf, nan, sqrt
from typing import Final, NamedTuple

from needle_identification.errors import IdentificationError
from needle_identification.estimation.memory import Memory
from needle_identification.estimation.prediction import moments
from needle_identification.estimation.regression import Regression
from needle_identification.estimation.residual_tests import residual_tests, ResidualTest
from needle_identification.friction import checks
from needle_identification.friction.breakaway import breakaway_force
from needle_identification.friction.comparison import CandidateFit, compare_terms, other_speed
from needle_identification.friction.design import Design, select_samples
from needle_identification.friction.estimate import Fit, FrictionEstimate
from needle_identification.friction.filtering import filter_signals, FilteredSignals, HALF_LENGTH
from needle_identification.friction.intervals import parameter_estimates
from needle_identification.friction.lag import (
    find_lag,
    lag_estimate,
    SAME_SCALE,
    velocity_delay,
    velocity_scale,
)
from needle_identification.friction.punctures import find_punctures
from needle_identification.friction.settings import AUTO, FrictionSettings
from needle_identification.friction.steady import misfit_at_speeds
from needle_identification.recordings.recording import Recording
from needle_ros.column_units import UNITS
import numpy as np

_HIDDEN: Final = 0.2  # largest velocity noise threshold, as a fraction of the median speed
_CLEANER: Final = 0.5  # velocity noise of positions that replace velocities, at most
_HALVINGS: Final = 3  # most halvings of the cutoff
_NEGLIGIBLE: Final = 0.25  # bias of mu_v at which the cutoff is low enough [standard errors]
_DEARER: Final = 1.5  # largest growth of the error of mu_v for a lag or motion that noise hides
_TRANSITION: Final = 0.1  # time of a possible deviation after a change [s]
_BEGIN: Final = 0.01  # time after a change in which missing force is tested [s]
_DEVIATES: Final = 3.5  # missing force that leaves these samples out [standard errors]
_LONG_LAG: Final = 0.005  # smallest lag of a filter that is modeled [s]
_SPREADS: Final = 5.0, 1.0, 1.0, 1.0  # smallest steps to its variance [standard errors]


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
    >>> velocity = 0.008 * np.sin(2.0 * time) + 0.006 * np.sin(3.1 * time)
    >>> noise = np.random.default_rng(0).normal(scale=0.01, size=len(time))
    >>> force = 0.56 * np.sign(velocity) + 300.0 * velocity + noise
    >>> recording = Recording(time=time, velocity=velocity, force=force)
    >>> estimate = identify_friction(recording)
    >>> low, high = estimate['viscous_friction'].interval
    >>> low < 300.0 < high
    True

    """
    settings = settings or FrictionSettings()
    alternatives: tuple[_Alternative, ...] = (_with_low_pass, _without_transitions)
    automatic = settings.estimator == AUTO
    if automatic:
        settings = replace(settings, estimator='ordinary')
        alternatives = (
            _from_positions,
            _with_lower_cutoff,
            _with_low_pass,
            _with_total,
            _without_transitions,
        )
    remarks: tuple[str, ...] = ()
    try:
        signals = filter_signals(recording, settings)
        recording, signals, remarks = _compared(recording, signals, automatic)
        chosen = _first(recording, signals, remarks, automatic)
        for alternative in alternatives:
            chosen = alternative(recording, chosen) or chosen
        return _finished(recording.name, chosen, among)
    except IdentificationError as error:
        words = '; '.join((str(error), *remarks))
        raise IdentificationError(f'{recording.name}: {words}') from None


class _Candidate(NamedTuple):
    """Selected samples and their fit; ``coarse`` is the lag [s] from `find_lag`."""

    design: Design
    fit: Regression
    coarse: float
    remarks: tuple[str, ...] = ()


#: Returns a better candidate with an additional remark, or None.
_Alternative = Callable[[Recording, _Candidate], _Candidate | None]


def _fitted(signals: FilteredSignals, *remarks: str) -> _Candidate:
    """Fit at the lag that the motion determines, with its rest as an unknown, if any."""
    settings = signals.settings
    coarse, design = find_lag(signals)
    if design is not None:
        design.check()
        fit = design.solve(settings.terms, settings.estimator)
        # The force is not linear in a lag above the filter length.
        if fit.errors[-1] < HALF_LENGTH / settings.cutoff:
            return _Candidate(design, fit, coarse, remarks)
    # The error of a coarse lag is up to half a step.
    error = 0.5 * signals.half_filter * signals.period
    design = select_samples(signals, coarse, abs(coarse) + error)
    design.check()
    return _Candidate(design, design.solve(settings.terms, settings.estimator), coarse, remarks)


def _compared(
    recording: Recording, signals: FilteredSignals, automatic: bool
) -> tuple[Recording, FilteredSignals, tuple[str, ...]]:
    """Compare the scale of the velocity with the positions, which replace it if ``automatic``."""
    found = velocity_scale(recording)
    if found is None or recording.velocity is None:
        return recording, signals, ()
    ratio, error = found
    unit, own = _unit_of('speed', 1.0 / ratio), _unit_of('depth', ratio)
    words = f'the speed is {ratio:.4g} ± {error:.2g} times the change of the positions'
    words += f' (speed in {unit}?)' if unit else f' (depth in {own}?)' if own else ''
    alone = replace(recording, velocity=None)
    if ratio < 0.0:
        words += ': depth or velocity has the wrong sign'
        # Friction dissipates: the power of the force is positive.
        if not automatic or recording.force @ recording.velocity >= 0.0:
            return recording, signals, (words,)
        positions = filter_signals(alone, signals.settings)
        return alone, positions, (f'{words}: took the speed from the positions',)
    if own or not automatic:
        return recording, signals, (words,)
    positions = filter_signals(alone, signals.settings)
    apart = abs(1.0 - 1.0 / ratio) * float(np.std(recording.velocity))
    if positions.velocity_noise > _CLEANER * apart:
        return recording, signals, (words,)
    return alone, positions, (f'{words}: took the speed from the positions',)


def _unit_of(role: str, size: float) -> str:
    units = UNITS[role].items()
    return next((unit for unit, its in units if abs(size / its - 1.0) < SAME_SCALE), '')


def _from_positions(recording: Recording, chosen: _Candidate) -> _Candidate | None:
    """Differentiate the positions if they have less error than a noisy or filtered velocity."""
    if recording.velocity is None:
        return None
    remark, delay = _noise_remark(chosen), velocity_delay(recording)
    if not (remark or delay):
        return None
    velocities = chosen.design.signals
    positions = filter_signals(replace(recording, velocity=None), velocities.settings)
    # Integrated velocities are no other source.
    apart = float(np.std(positions.motion(velocities.time) - velocities.motion(velocities.time)))
    noise = _CLEANER * (apart if delay else velocities.velocity_noise)
    if not (positions.velocity_noise < noise and apart >= noise):
        return None
    if delay:
        remark = f'the speed is {1e3 * delay:.2g} ms behind the positions: a filter of the driver'
    return _fitted(positions, f'{remark}: took the speed from the positions')


def _first(
    recording: Recording, signals: FilteredSignals, remarks: tuple[str, ...], automatic: bool
) -> _Candidate:
    """Fit; if noise or counts of positions leave too little motion, at a lower cutoff."""
    try:
        return _fitted(signals, *remarks)
    except IdentificationError:
        if not automatic or not signals.from_positions:
            raise
        words, lower = 'noise or counts of the positions leave out most of the motion', signals
        for _ in range(_HALVINGS):
            with suppress(IdentificationError):
                lower = _lowered(recording, lower)
                return _fitted(lower, *remarks, f'{words}: {_cutoff_words(lower)}')
        raise


def _lowered(recording: Recording, signals: FilteredSignals) -> FilteredSignals:
    """Filter the positions with half the cutoff."""
    settings = replace(signals.settings, cutoff=0.5 * signals.settings.cutoff)
    return filter_signals(replace(recording, velocity=None), settings)


def _cutoff_words(signals: FilteredSignals) -> str:
    return f'took a cutoff of {signals.settings.cutoff:g} Hz'


def _with_lower_cutoff(recording: Recording, chosen: _Candidate) -> _Candidate | None:
    """Halve the cutoff while noise of the positions hides motion or lag, or biases mu_v."""
    if not chosen.design.signals.from_positions:
        return None
    found, words = chosen, _harm(chosen)
    for _ in range(_HALVINGS):
        if not _harm(found):
            break
        now = checks.velocity_bias(found.design, found.fit)
        try:
            lower = _fitted(_lowered(recording, found.design.signals))
        except IdentificationError:
            break
        then = checks.velocity_bias(lower.design, lower.fit)
        grows = 1.0 if now.bias > _NEGLIGIBLE * now.error else _DEARER
        if hypot(then.bias, then.error) > grows * hypot(now.bias, now.error):
            break
        found = lower
    if found is chosen or isinf(checks.velocity_bias(found.design, found.fit).error):
        return None
    remark = f'{words}: {_cutoff_words(found.design.signals)}'
    return found._replace(remarks=(*chosen.remarks, remark))


def _harm(chosen: _Candidate) -> str:
    """Return words about the effect of the noise of positions, or an empty string."""
    design, signals = chosen.design, chosen.design.signals
    found = checks.velocity_bias(design, chosen.fit)
    # It grows with the third power of the cutoff.
    if found.bias > _NEGLIGIBLE * found.error:
        return checks.noise_words(design, found.bias)
    if isinf(found.error) and not signals.is_clear:
        return signals.noise_words
    if chosen.coarse and not design.estimates_lag:
        return f'noise of {signals.velocity_noise:.2g} m/s in the speed hides the lag of the force'
    return ''


def _noise_remark(chosen: _Candidate) -> str:
    design = chosen.design
    if bias := checks.noise_bias(design, chosen.fit):
        return checks.noise_words(design, bias)
    signals, usual = design.signals, float(np.median(np.abs(design.velocity[design.used])))
    return '' if signals.moving_speed < _HIDDEN * usual else signals.noise_words


def _with_low_pass(recording: Recording, chosen: _Candidate) -> _Candidate | None:
    """Pass the motion through the low-pass filter of the force, if its lag has a spread."""
    signals, found, square = chosen.design.signals, chosen, 0.0
    source = replace(recording, velocity=None) if signals.from_positions else recording
    with suppress(IdentificationError):
        for least in _SPREADS:
            if not (found.design.estimates_lag and found.design.lag > _LONG_LAG):
                break
            change, error = found.design.lag_spread()[:2]
            square += float(change[0])
            if not abs(change) > least * error or square <= 0.0:
                break
            found = _fitted(filter_signals(source, signals.settings, sqrt(square)), *found.remarks)
    return found


def _with_total(_recording: Recording, chosen: _Candidate) -> _Candidate | None:
    """Choose the estimator total if noise of the velocity biases the viscous friction."""
    signals = chosen.design.signals
    bias = checks.noise_bias(chosen.design, chosen.fit)
    if bias and signals.settings.allows_total:
        remark = f'{checks.noise_words(chosen.design, bias)}: took estimator total'
        settings = replace(signals.settings, estimator='total')
        with suppress(IdentificationError):
            return _fitted(replace(signals, settings=settings), *chosen.remarks, remark)
    return None


def _without_transitions(_recording: Recording, chosen: _Candidate) -> _Candidate | None:
    """Leave out more samples around each change if the force deviates from the terms there."""
    settings = chosen.design.signals.settings
    design = chosen.design.far_from_changes(_TRANSITION)
    if chosen.fit.is_exact or settings.reversals or not design.is_enough:
        return None
    if not chosen.design.excess_after_changes(_BEGIN, chosen.fit.residual) < -_DEVIATES:
        return None
    remark = (
        f'within {_TRANSITION:g} s of starts, stops and reversals the force does not follow the '
        'terms (presliding, play, stick-slip, or a force that settles): left out'
    )
    with suppress(IdentificationError):
        design = design.with_lag_column() if design.estimates_lag else design
        fit = design.solve(settings.terms, settings.estimator)
        return _Candidate(design, fit, chosen.coarse, (*chosen.remarks, remark))
    return None


def _finished(name: str, chosen: _Candidate, among: int) -> FrictionEstimate:
    """Test the chosen fit, compare it with other terms, and assemble the result."""
    design, fit, signals = chosen.design, chosen.fit, chosen.design.signals
    settings, used = signals.settings, design.used
    known = fit.values[: design.terms]
    mean_speed = float(np.mean(np.abs(design.velocity[used])))
    parameters = parameter_estimates(fit, settings, mean_speed, signals.period)
    checks.check_friction(parameters)
    lag = lag_estimate(design, fit)
    tests: tuple[ResidualTest, ...] = ()
    comparison: tuple[CandidateFit, ...] = ()
    misfit, doubts = None, []
    if fit.memory is not None and not fit.is_exact:
        misfit = misfit_at_speeds(design)
        # The other tests need residuals that are noise.
        tests = (misfit,) if misfit else _residual_tests(design, fit, fit.memory)
        comparison = compare_terms(design, fit, among)
        doubts = [other_speed(design, fit), checks.missing_term(settings.terms, comparison)]
    if misfit or not any(doubts):
        doubts = [*(test.words for test in tests if test.failed), *doubts]
    warnings = checks.fit_warnings(design, fit, parameters, lag, chosen.coarse, not misfit)
    return FrictionEstimate(
        name=name,
        terms=settings.terms,
        estimator=settings.estimator,
        parameters=parameters,
        breakaway=breakaway_force(design, parameters),
        # The interval of the lag omits errors by the position resolution and by a mass.
        lag=None if signals.from_positions or 'inertia' in settings.terms else lag,
        punctures=find_punctures(design, fit),
        samples=fit.samples,
        residual=sqrt(float(fit.residual @ fit.residual) / fit.samples),
        determination=fit.determination,
        condition=fit.condition,
        tests=tests,
        comparison=comparison,
        warnings=(*chosen.remarks, *warnings, *filter(None, doubts)),
        fit=Fit(
            time=signals.time,
            velocity=design.velocity,
            force=signals.force,
            model=np.where(used, signals.force - fit.residual, nan),
            used=used,
            moments=moments(
                design.columns(settings.terms).take(design.rows, axis=0),
                fit.residual.take(design.rows),
                known,
            ),
        ),
    )


def _residual_tests(design: Design, fit: Regression, memory: Memory) -> tuple[ResidualTest, ...]:
    return residual_tests(
        fit.residual,
        time=design.signals.time,
        velocity=design.velocity,
        parts=design.parts,
        memory=memory,
        parameters=len(fit.values),
    )
