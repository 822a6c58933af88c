r"""
Friction of a needle from force and motion of its base, by linear regression.

Where the tip is past the tissue, the axial row of equation (16) of [Boroomand2014]_ is friction
(15), with further terms for those who ask for them:

.. math:: f_y(t + \tau) = \mu_s \operatorname{sgn}(\dot s) + \mu_v \dot s + ...

Force and speed pass the same zero-phase low-pass filter of finite length (Hann), which leaves a
linear relation between them as it is. The terms with sgn are not linear: samples whose filter
reaches a start, a stop or a reversal are left out. The lag tau of the force, by the filters of
the sensor or by clocks that differ, is one more unknown: 2 ms of it would move the force of a
needle that accelerates by more than its friction is known.

References
----------
.. [Boroomand2014] A. Boroomand, M. Tavakoli, R. Sloboda, N. Usmani, "Dynamical modeling
   and controllability analysis of a flexible needle in soft tissue", 2014, section 3.2.2.2.

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import ceil, hypot, log, nan, sqrt
from typing import Final, Protocol, TypeVar

from needle_dynamics import FloatArray
from needle_identification.errors import IdentificationError
from needle_identification.estimation.estimate import ParameterEstimate, Statistic, statistic
from needle_identification.estimation.goodness import residual_tests, ResidualTest
from needle_identification.estimation.regression import (
    BoolArray,
    IntArray,
    regress,
    Regression,
    score_covariance,
)
from needle_identification.friction.terms import (
    columns_of,
    FrictionSettings,
    parameter_estimates,
    regressors,
    TERMS,
)
from needle_identification.recordings.recording import Recording
import numpy as np
from scipy.interpolate import BSpline, make_interp_spline
from scipy.ndimage import maximum_filter1d
from scipy.signal import oaconvolve
from scipy.signal.windows import hann, triang
from scipy.special import ndtri, stdtrit

#: Half the length of a Hann window that halves the power at its cutoff [periods of the cutoff].
_HALF_LENGTH: Final = 0.36

#: Samples per period of the cutoff that are kept after the filter.
_KEPT: Final = 8.0

#: Length of the window that spans the correlation of filtered noise [periods of the cutoff].
WINDOW: Final = 3.0

#: Correlation windows of motion that a standard error needs to mean something.
_FEWEST_WINDOWS: Final = 10.0

#: A longer step between samples is a gap [sample periods].
_GAP: Final = 3.5

#: An even grid of more points than this per sample would be made up of gaps.
_LARGEST_GRID: Final = 10.0

#: Speed that counts as moving, at least [standard deviations of the noise of the speed].
_CLEAR: Final = 5.0

#: Part of the power of the acceleration that may be noise where the lag is estimated.
_LARGEST_NOISE: Final = 0.1

#: Acceleration where the lag is reported, root mean square, in the largest of the recording: less
#: may be what filter and spline leave of jumps. It takes up what is late all the same.
_SMALLEST_ACCELERATION: Final = 0.01

#: Time after a change at which the filters of the sensor have settled too [lags of theirs].
_GUARD: Final = 3.0

#: A lag with more than this is one of clocks [s].
_LONGEST_SETTLING: Final = 0.1

#: Lags looked for [s], and part of the misfit that a lag far from zero must remove.
_LARGEST_LAG: Final = 0.25
_BETTER: Final = 0.5

#: Error of a lag by the cubic spline between samples [sample periods], where one period of the
#: cutoff is one sample; of the fourth order. Speeds of the stand-in, which bends at samples.
_SPLINE: Final = 10.0

#: Lag beyond those of usual sensor filters [s].
_UNUSUAL_LAG: Final = 0.01

_MOST_ITERATIONS: Final = 10

#: Samples on which a lag far from zero is looked for.
_MOST_SAMPLES: Final = 1000

#: Time before the needle breaks away in which the rise of the force is measured [s], part of
#: that force, and of mu_s, it must rise by, and its standard errors.
_RISING: Final = 0.3
_SMALLEST_RISE: Final = 0.05
_CLEAR_RISE: Final = 5.0

#: Part of the variance of the force below which what a model leaves is rounding.
_EXACT: Final = 1e-9

#: Chance of a false alarm of all comparisons of one recording.
_ALARM: Final = 0.05


class _HasName(Protocol):
    @property
    def name(self) -> str: ...


_Named = TypeVar('_Named', bound=_HasName)


@dataclass(frozen=True, slots=True, kw_only=True)
class Comparison:
    """
    Another set of terms beside the chosen one.

    Attributes
    ----------
    terms : tuple of str
        The other set: one term more or one less.
    criterion : str
        What is compared: BIC, with the effective number of samples.
    difference : float
        BIC of the other set minus that of the chosen one, below zero if it is the better; nan
        if it is not determined.
    p_value : float
        Of the Wald test that the terms which differ are zero, with errors that respect
        autocorrelation, corrected for the number of terms tried (Holm).
    supported : bool
        Whether the data support the other set.
    words : str
        The same in words.

    """

    terms: tuple[str, ...]
    criterion: str
    difference: float
    p_value: float
    supported: bool
    words: str


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Fit:
    """
    The filtered signals and the fitted force, for pictures; shape (n,) each.

    Attributes
    ----------
    time : ndarray
        Time on the clock of the recording [s], even.
    speed : ndarray
        Filtered speed [m/s], at the time at which the force shows it.
    force, model : ndarray
        Filtered and fitted force [N]; the fitted one is nan where the sample was not used.
    used : ndarray of bool
        Whether the sample was used.

    """

    time: FloatArray
    speed: FloatArray
    force: FloatArray
    model: FloatArray
    used: BoolArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrictionEstimate:
    """
    Friction of one recording.

    Attributes
    ----------
    name : str
        The recording.
    terms : tuple of str
        Terms of the force.
    estimator : str
        How it was estimated.
    parameters : tuple of ParameterEstimate
        Coefficients of the terms, then what follows from them: ``withdrawal_friction`` (friction
        on withdrawal over that on insertion, at the mean speed) and ``breakaway_friction``
        (friction at rest over mu_s). ``estimate[name]`` gives one.
    breakaway : ParameterEstimate or None
        Force at which the needle began to move after rests with a rising force [N], without the
        offset if that is a term.
    lag : ParameterEstimate or None
        Time by which the force is behind the motion [s], corrected. Undetermined where the speed
        only jumps; what such strokes show of a large lag is corrected, and a warning says so. A
        mass m beside viscous friction makes it less by m / mu_v; None if inertia is a term,
        which it cannot be told from, or if positions alone were recorded, whose counts its error
        does not know. Below 200 samples/s the motion between samples widens its error: 0.8 ms
        at 100 samples/s.
    samples : int
        Samples that were used.
    residual : float
        Root mean square of what the model leaves of the filtered force [N].
    determination : float
        Coefficient of determination R^2.
    condition : float
        Condition number of the regressors, each scaled to unit norm.
    tests : tuple of ResidualTest
        What the residual says of the model.
    comparison : tuple of Comparison
        Whether the data support one term more, or one less.
    warnings : tuple of str
        What to know before using the numbers, in words.
    fit : Fit
        Signals for pictures.

    """

    name: str
    terms: tuple[str, ...]
    estimator: str
    parameters: tuple[ParameterEstimate, ...]
    breakaway: ParameterEstimate | None
    lag: ParameterEstimate | None
    samples: int
    residual: float
    determination: float
    condition: float
    tests: tuple[ResidualTest, ...]
    comparison: tuple[Comparison, ...]
    warnings: tuple[str, ...]
    fit: Fit

    def __getitem__(self, name: str) -> ParameterEstimate:
        """Return the parameter of a name; KeyError names those there are."""
        return _named(self.parameters, name)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrictionSummary:
    """
    Friction over several recordings.

    Attributes
    ----------
    statistics : tuple of Statistic
        One per parameter; ``summary[name]`` gives one.
    estimates : tuple of FrictionEstimate
        What each recording gave.

    """

    statistics: tuple[Statistic, ...]
    estimates: tuple[FrictionEstimate, ...]

    def __getitem__(self, name: str) -> Statistic:
        """Return the statistic of a parameter; KeyError names those there are."""
        return _named(self.statistics, name)


def _named(items: Sequence[_Named], name: str) -> _Named:
    for item in items:
        if item.name == name:
            return item
    raise KeyError(f'{name}; there are {", ".join(item.name for item in items)}')


_LAG: Final = ParameterEstimate(name='lag', symbol='tau', unit='s')


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Signals:
    """
    Filtered signals on an even grid.

    ``reach`` is half the filter, ``blur`` how far from a change that the filtered speed shows
    the filtered force may still be touched by it [samples].
    """

    time: FloatArray
    period: float
    motion: BSpline
    force: FloatArray
    lost: BoolArray
    reach: int
    blur: int
    speed_noise: float
    acceleration_noise: float

    def moved(self, lag: float) -> tuple[FloatArray, FloatArray]:
        """Return speed and acceleration a lag ago, when the force now shown acted."""
        then = np.clip(self.time - lag, self.time[0], self.time[-1])
        return np.asarray(self.motion(then)), np.asarray(self.motion(then, 1))

    def spanning(self, time: float) -> FloatArray:
        """Return a triangular window of a length [s]."""
        return np.asarray(triang(ceil(time / self.period)))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Design:
    """Motion as the force shows it, what of it is used, and the effect of a further lag."""

    speed: FloatArray
    acceleration: FloatArray
    regime: FloatArray
    used: BoolArray
    stroke: IntArray
    lagging: FloatArray


def identify_friction(
    recording: Recording, settings: FrictionSettings | None = None
) -> FrictionEstimate:
    """
    Estimate friction from one recording.

    Parameters
    ----------
    recording : Recording
        Force and motion; the needle tip is past the tissue, so that nothing is cut. Without
        speeds the inserted length is differentiated, by the same zero-phase filter.
    settings : FrictionSettings, optional
        How to identify.

    Returns
    -------
    FrictionEstimate
        Estimates with standard errors that respect the correlation which the filter and the
        sensor leave in the residuals, and what speaks against them.

    Raises
    ------
    IdentificationError
        If the recording holds too little motion, or friction comes out negative.

    """
    settings = settings or FrictionSettings()
    try:
        return _identify(recording, settings)
    except IdentificationError as error:
        raise IdentificationError(f'{recording.name}: {error}') from None


def _identify(recording: Recording, settings: FrictionSettings) -> FrictionEstimate:
    signals = _filtered(recording, settings)
    window = signals.spanning(WINDOW / settings.cutoff)
    coarse, lag = _lag(signals, settings, window)
    design, fit = _fitted(signals, settings, coarse, lag, window)
    corrected = design.lagging.shape[1] > 0
    if corrected and not fit.errors[-1] < _HALF_LENGTH / settings.cutoff:
        # Beyond the length of the filter the force is not linear in the lag.
        corrected = False
        design, fit = _fitted(signals, settings, coarse, None, window)
    pace = float(np.mean(np.abs(design.speed[design.used])))
    parameters = parameter_estimates(fit, settings, pace, signals.period)
    for parameter in parameters[:2]:
        if parameter.name in ('coulomb_friction', 'viscous_friction'):
            _check_sign(parameter)
    _check_size(parameters)
    found = _LAG
    if corrected and lag is not None and _accelerates(design):
        found = _lag_estimate(lag, fit, settings, signals.period)
    # Counts of positions make it wrong by more than its error tells; a mass is taken for it.
    unknown = recording.speed is None or 'inertia' in settings.terms
    exact = 1.0 - fit.determination < _EXACT
    tests = (
        ()
        if exact
        else residual_tests(
            fit.residual,
            used=design.used,
            time=signals.time,
            speed=design.speed,
            length=len(window),
            parameters=len(fit.values),
        )
    )
    comparison = () if exact else _comparisons(signals, design, settings, fit, window)
    used = design.used
    return FrictionEstimate(
        name=recording.name,
        terms=settings.terms,
        estimator=settings.estimator,
        parameters=parameters,
        breakaway=_breakaway(signals, design, settings, parameters),
        lag=None if unknown else found,
        samples=fit.samples,
        residual=sqrt(float(fit.residual @ fit.residual) / fit.samples),
        determination=fit.determination,
        condition=fit.condition,
        tests=tests,
        comparison=comparison,
        warnings=(
            *_unknowns(parameters),
            *_lag_words(found, 0.0 if 'inertia' in settings.terms else coarse, signals.period),
            *_noise_words(signals, design, settings, fit),
            *_mass_words(parameters),
            *_doubts(settings, comparison, tests),
        ),
        fit=Fit(
            time=signals.time,
            speed=design.speed,
            force=signals.force,
            model=np.where(used, signals.force - fit.residual, nan),
            used=used,
        ),
    )


def _filtered(recording: Recording, settings: FrictionSettings) -> _Signals:
    time = recording.time
    if len(time) < 3:
        raise IdentificationError(f'too short: {len(time)} samples')
    steps = np.diff(time)
    period = float(np.median(steps))
    duration = float(time[-1] - time[0])
    if duration > _LARGEST_GRID * len(time) * period:
        raise IdentificationError(
            f'stamps too uneven: {len(time)} samples in {duration:g} s, most within {period:g} s'
        )
    grid = time[0] + period * np.arange(int(duration / period + 1e-6) + 1)
    lost = steps[np.clip(np.searchsorted(time, grid), 1, len(steps)) - 1] > _GAP * period
    taps = filter_taps(settings.cutoff, period)
    half = len(taps) // 2
    if len(grid) <= 4 * half:
        raise IdentificationError(
            f'must last > {4 * half * period:.3g} s for a filter of {settings.cutoff:g} Hz, '
            f'lasts {duration:.3g} s'
        )
    step = max(1, int(1.0 / (_KEPT * settings.cutoff * period)))
    derivative = 1 if recording.speed is None else 0
    measured = recording.depth if recording.speed is None else recording.speed
    raw = np.asarray(np.interp(grid, time, measured), dtype=np.float64)
    motion = _motion(grid, raw, taps, step, derivative)
    impulse = np.zeros(8 * half + 8 * step + 17)
    impulse[len(impulse) // 2] = 1.0
    around = np.arange(len(impulse), dtype=np.float64) * period
    answer = _motion(around, impulse, taps, 1, derivative)
    noise = _white_noise(raw, np.asarray(motion(grid)), np.asarray(motion(grid, 1)))
    return _Signals(
        time=grid[::step],
        period=step * period,
        motion=motion,
        force=_smooth(np.interp(grid, time, recording.force), taps)[::step],
        lost=np.asarray(maximum_filter1d(lost.astype(np.uint8), step)[::step] > 0),
        reach=ceil(half / step),
        blur=max(1, ceil(2 * (half - 1) / step)),
        speed_noise=noise * float(np.linalg.norm(answer(around))),
        acceleration_noise=noise * float(np.linalg.norm(answer(around, 1))),
    )


def filter_taps(cutoff: float, period: float) -> FloatArray:
    """
    Return the filter of force and motion.

    Parameters
    ----------
    cutoff : float
        Frequency at which it halves the power [Hz].
    period : float
        Sample period [s].

    Returns
    -------
    ndarray, shape (2 h + 1,)
        A Hann window with unit sum.

    """
    taps = hann(2 * ceil(_HALF_LENGTH / cutoff / period) + 1)
    return np.asarray(taps / taps.sum(), dtype=np.float64)


def _smooth(signal: FloatArray, taps: FloatArray) -> FloatArray:
    """Filter, with the signal held constant beyond its ends."""
    padded = np.pad(signal, len(taps) // 2, mode='edge')
    return np.asarray(oaconvolve(padded, taps, mode='valid'))


def _motion(
    time: FloatArray, raw: FloatArray, taps: FloatArray, step: int, derivative: int
) -> BSpline:
    """Return the filtered speed as a function of time."""
    start = raw[0] if derivative else 0.0
    smooth = _smooth(raw - start, taps)
    spline = make_interp_spline(time, smooth, k=5 if derivative else 3)
    if derivative:
        spline = make_interp_spline(time[::step], spline(time[::step], 1), k=3)
    elif step > 1:
        spline = make_interp_spline(time[::step], smooth[::step], k=3)
    return spline


def _white_noise(raw: FloatArray, speed: FloatArray, acceleration: FloatArray) -> float:
    """Estimate white noise from fourth differences in steady motion, robustly."""
    unsteady = np.abs(acceleration) > 0.1 * np.max(np.abs(acceleration))
    steady = maximum_filter1d(unsteady.astype(np.uint8), 9) == 0
    steady &= np.abs(speed) > 0.1 * np.max(np.abs(speed))
    differences = np.abs(np.diff(raw, 4))[steady[2:-2]]
    # The 80th percentile: counts of a constant speed may make no noise in half the strokes.
    # The variance of the fourth difference of white noise is 70 times its own.
    size = float(np.quantile(differences, 0.8)) if len(differences) else 0.0
    return size / (1.2816 * sqrt(70.0))


def _design(signals: _Signals, settings: FrictionSettings, lag: float, guarded: float) -> _Design:
    """Mark what is used: steady regimes, away from changes by more than the filters reach."""
    speed, acceleration = signals.moved(lag)
    threshold = max(settings.moving_speed, _CLEAR * signals.speed_noise)
    regime = np.where(np.abs(speed) > threshold, np.sign(speed), 0.0)
    change = np.ones(len(speed), dtype=np.bool_)
    change[1:-1] = signals.lost[1:-1] | (regime[1:-1] != regime[:-2])
    # The sensor settles while the filter does: its outer third weighs little.
    settling = min(_GUARD * guarded, _LONGEST_SETTLING) - _HALF_LENGTH / settings.cutoff / 1.5
    more = max(0, ceil(settling / signals.period))
    margin = signals.blur + more
    used = (regime != 0.0) & (signals.time - lag >= signals.time[0])
    used &= signals.time - lag <= signals.time[-1]
    used &= maximum_filter1d(change.astype(np.uint8), 2 * margin + 1) == 0
    if 'inertia' not in settings.terms:
        large = np.abs(acceleration) > settings.largest_acceleration
        used &= maximum_filter1d(large.astype(np.uint8), 2 * (signals.reach + more) + 1) == 0
    return _Design(
        speed=speed,
        acceleration=acceleration,
        regime=regime,
        used=used,
        stroke=np.cumsum(change),
        lagging=np.empty((len(speed), 0)),
    )


def _regression(
    signals: _Signals,
    design: _Design,
    settings: FrictionSettings,
    terms: Sequence[str],
    window: FloatArray,
) -> Regression:
    terms_part = regressors(design.speed, design.acceleration, terms, settings)
    noise = [
        {'viscous_friction': signals.speed_noise, 'moving_mass': signals.acceleration_noise}.get(
            column.name, 0.0
        )
        for column in columns_of(terms)
    ]
    if design.lagging.shape[1]:
        slope = np.linalg.norm(design.lagging[design.used])
        slope /= np.linalg.norm(design.acceleration[design.used])
        noise.append(float(slope) * signals.acceleration_noise)
    return regress(
        np.column_stack([terms_part, design.lagging]),
        signals.force,
        estimator=settings.estimator,
        window=window,
        groups=design.stroke,
        noisy=np.array(noise) > 0.0,
        regressor_noise=np.array(noise),
        used=design.used,
    )


def _fitted(
    signals: _Signals,
    settings: FrictionSettings,
    coarse: float,
    fine: float | None,
    window: FloatArray,
) -> tuple[_Design, Regression]:
    """Fit with a further lag as one more unknown, or at the coarse one if there is no other."""
    lag = coarse if fine is None else fine
    # A coarse one is wrong by up to half a step.
    guarded = abs(lag) + (0.5 * signals.reach * signals.period if fine is None else 0.0)
    corrected = 'inertia' not in settings.terms
    design = _design(signals, settings, lag if corrected else 0.0, guarded)
    _check(signals, design, settings, window)
    if corrected and fine is not None:
        design = _lagging(signals, design, settings)
    return design, _regression(signals, design, settings, settings.terms, window)


def _lag(
    signals: _Signals, settings: FrictionSettings, window: FloatArray
) -> tuple[float, float | None]:
    """Return a coarse lag, and that of least misfit by Gauss-Newton steps if that can be told."""
    terms = tuple(term for term in settings.terms if term != 'inertia')
    if not terms:
        return 0.0, None
    simple = replace(settings, terms=terms, estimator='ordinary')
    lag = coarse = _coarse_lag(signals, simple)
    for _ in range(_MOST_ITERATIONS):
        design = _design(signals, simple, lag, abs(lag))
        if not _enough(design, window) or _noisy_acceleration(signals, design):
            return coarse, None
        design = _lagging(signals, design, simple)
        used = design.used
        x = regressors(design.speed[used], design.acceleration[used], terms, simple)
        x = np.column_stack([x, design.lagging[used]])
        change = float(np.linalg.lstsq(x, signals.force[used], rcond=None)[0][-1])
        lag += change
        if abs(lag) > 2.0 * _LARGEST_LAG:
            return coarse, None
        # The fit itself takes the last step.
        if abs(change) < 0.05 * signals.period:
            break
    return coarse, lag


def _lag_estimate(
    lag: float, fit: Regression, settings: FrictionSettings, period: float
) -> ParameterEstimate:
    """Return the lag found, with what the spline between samples may add to its error."""
    spline = _SPLINE * period * (settings.cutoff * period) ** 4
    value, low, high = lag + np.array([fit.values[-1], *fit.interval()[-1]])
    reach = hypot(0.5 * (high - low), float(ndtri(0.975)) * spline)
    return replace(
        _LAG,
        value=float(value),
        error=hypot(float(fit.errors[-1]), spline),
        interval=(float(value) - reach, float(value) + reach),
        determined=True,
    )


def _coarse_lag(signals: _Signals, settings: FrictionSettings) -> float:
    """Return a lag of many filter lengths if it fits far better than none, else zero."""
    every = max(1, len(signals.time) // _MOST_SAMPLES)
    time, force = signals.time[::every], signals.force[::every]
    threshold = max(settings.moving_speed, _CLEAR * signals.speed_noise)
    step = signals.reach * signals.period
    count = int(_LARGEST_LAG / step)
    lags = step * np.arange(-count, count + 1)
    misfits = []
    for lag in lags:
        then = np.clip(time - lag, time[0], time[-1])
        speed, acceleration = signals.motion(then), signals.motion(then, 1)
        moving = np.abs(speed) > threshold
        if np.count_nonzero(moving) <= _FEWEST_WINDOWS:
            return 0.0
        x = regressors(speed[moving], acceleration[moving], settings.terms, settings)
        solution = np.linalg.lstsq(x, force[moving], rcond=None)[0]
        misfits.append(float(np.mean((force[moving] - x @ solution) ** 2)))
    best = int(np.argmin(misfits))
    return float(lags[best]) if misfits[best] < _BETTER * misfits[count] else 0.0


def _lagging(signals: _Signals, design: _Design, settings: FrictionSettings) -> _Design:
    """Add what a further second of lag would do to the fitted force."""
    step = 0.5 * signals.period
    early, now, late = (
        regressors(
            design.speed - shift * design.acceleration,
            design.acceleration,
            settings.terms,
            settings,
        )
        for shift in (-step, 0.0, step)
    )
    used = design.used
    solution = np.linalg.lstsq(now[used], signals.force[used], rcond=None)[0]
    column = np.where(used, (late - early) @ solution / (2.0 * step), 0.0)
    return replace(design, lagging=column[:, np.newaxis])


def _noisy_acceleration(signals: _Signals, design: _Design) -> bool:
    power = float(np.mean(design.acceleration[design.used] ** 2))
    return power * _LARGEST_NOISE <= signals.acceleration_noise**2


def _accelerates(design: _Design) -> bool:
    """Return whether what is used accelerates by more than jumps of the speed leave behind."""
    used = float(np.sqrt(np.mean(design.acceleration[design.used] ** 2)))
    return used > _SMALLEST_ACCELERATION * float(np.max(np.abs(design.acceleration)))


def _enough(design: _Design, window: FloatArray) -> bool:
    span = float(window.sum()) ** 2 / float(window @ window)
    return bool(np.count_nonzero(design.used) >= _FEWEST_WINDOWS * span)


def _check(
    signals: _Signals, design: _Design, settings: FrictionSettings, window: FloatArray
) -> None:
    if not _enough(design, window):
        span = float(window.sum()) ** 2 / float(window @ window)
        samples = int(np.count_nonzero(design.used))
        raise IdentificationError(
            f'steady motion above {settings.moving_speed:g} m/s must last '
            f'{_FEWEST_WINDOWS * span * signals.period:.3g} s in all, lasts '
            f'{samples * signals.period:.3g} s: move longer, or choose another axis or topic'
        )
    force = signals.force[design.used]
    if np.ptp(force) == 0.0:
        raise IdentificationError(
            f'the force must vary, got {force[0]:g} N throughout: choose another axis or topic'
        )


def _check_sign(parameter: ParameterEstimate) -> None:
    if parameter.determined and parameter.value + 2.0 * parameter.error < 0.0:
        raise IdentificationError(
            f'friction must not be negative, got {parameter.symbol} = {parameter.value:.3g} '
            f'{parameter.unit}; the force or the motion may have the wrong sign'
        )


def _check_size(parameters: Sequence[ParameterEstimate]) -> None:
    names = ('coulomb_friction', 'viscous_friction')
    friction = [parameter for parameter in parameters if parameter.name in names]
    if friction and all(p.determined and abs(p.value) < 2.0 * p.error for p in friction):
        sizes = ', '.join(f'{p.symbol} = {p.value:.2g} ± {p.error:.2g} {p.unit}' for p in friction)
        raise IdentificationError(
            f'no friction: {sizes}; force and motion do not belong together, or the axes are wrong'
        )


def _comparisons(
    signals: _Signals,
    design: _Design,
    settings: FrictionSettings,
    fit: Regression,
    window: FloatArray,
) -> tuple[Comparison, ...]:
    """Try each term that was not chosen, and each chosen one without."""
    chosen = settings.terms
    more: list[tuple[str, Regression, list[int]]] = []
    for term in TERMS:
        if term in chosen or (term == 'inertia' and design.lagging.shape[1]):
            continue
        if term == 'direction' and (
            settings.estimator == 'total' or not {'coulomb', 'viscous'} <= set(chosen)
        ):
            continue
        start = len(columns_of(chosen))
        which = list(range(start, start + len(columns_of([term]))))
        try:
            tried = _regression(signals, design, settings, (*chosen, term), window)
        except IdentificationError:
            continue
        more.append((term, tried, which))
    samples = _independent(fit, window)
    chances = _holm(
        [
            tried.wald(which)[1] if tried.determined[which].all() else 1.0
            for _, tried, which in more
        ]
    )
    found = [
        _added((*chosen, term), term, tried, which, _bic(tried, fit, samples), chance)
        for (term, tried, which), chance in zip(more, chances, strict=True)
    ]
    for term in chosen:
        rest = tuple(other for other in chosen if other != term)
        if rest and not ('direction' in chosen and term in ('coulomb', 'viscous')):
            names = [column.name for column in columns_of(chosen)]
            which = [names.index(column.name) for column in columns_of([term])]
            simpler = replace(settings, terms=rest, estimator='ordinary')
            less = _regression(signals, design, simpler, rest, window)
            found.append(_removed(rest, term, fit, which, _bic(less, fit, samples)))
    return tuple(found)


def _holm(chances: Sequence[float]) -> list[float]:
    """Correct probabilities for how many they are: that of any false alarm stays as it is."""
    corrected = np.ones(len(chances))
    largest = 0.0
    for rank, k in enumerate(np.argsort(chances)):
        largest = max(largest, min(1.0, (len(chances) - rank) * chances[k]))
        corrected[k] = largest
    return corrected.tolist()


def _independent(fit: Regression, window: FloatArray) -> float:
    """Return how many independent samples the mean of the residual is worth."""
    left = fit.residual[:, np.newaxis]
    worth = fit.samples * float((left**2).sum() / score_covariance(left, window)[0, 0])
    return min(max(worth, len(fit.values) + 1.0), float(fit.samples))


def _bic(other: Regression, chosen: Regression, samples: float) -> float:
    """Return BIC of another fit minus that of the chosen one, of so many independent samples."""
    misfit = float(other.residual @ other.residual) / float(chosen.residual @ chosen.residual)
    return samples * log(misfit) + (len(other.values) - len(chosen.values)) * log(samples)


def _added(
    terms: tuple[str, ...],
    term: str,
    tried: Regression,
    which: list[int],
    difference: float,
    chance: float,
) -> Comparison:
    if not tried.determined[which].all():
        words = f'the data do not tell the term {term} from the others'
        return _compared(terms, nan, 1.0, False, words)
    supported = chance < _ALARM and difference < 0.0
    verdict = 'support' if supported else 'show no'
    sizes = ' and '.join(
        f'{column.name} = {tried.values[k]:.3g} ± {tried.errors[k]:.2g} {column.unit}'
        for k, column in zip(which, columns_of([term]), strict=True)
    )
    words = f'the data {verdict} {term}: {sizes} (p = {chance:.2g})'
    return _compared(terms, difference, chance, supported, words)


def _removed(
    terms: tuple[str, ...], term: str, fit: Regression, which: list[int], difference: float
) -> Comparison:
    if not fit.determined[which].all():
        words = f'the data do not tell the term {term} from the others: leave one out'
        return _compared(terms, nan, 1.0, False, words)
    chance = fit.wald(which)[1]
    supported = chance >= _ALARM and difference < 0.0
    words = f'the data {"can" if supported else "cannot"} do without {term} (p = {chance:.2g})'
    return _compared(terms, difference, chance, supported, words)


def _compared(
    terms: tuple[str, ...], difference: float, chance: float, supported: bool, words: str
) -> Comparison:
    return Comparison(
        terms=terms,
        criterion='BIC',
        difference=difference,
        p_value=chance,
        supported=supported,
        words=words,
    )


def _unknowns(parameters: Sequence[ParameterEstimate]) -> list[str]:
    unknown = [parameter.name for parameter in parameters if not parameter.determined]
    if not unknown:
        return []
    return [f'the data do not determine {", ".join(unknown)}: more speeds, or fewer terms, would']


def _doubts(
    settings: FrictionSettings,
    comparison: Sequence[Comparison],
    tests: Sequence[ResidualTest],
) -> list[str]:
    """Name the best of the terms that are missing; if none is, the tests that failed."""
    missing = [c for c in comparison if c.supported and len(c.terms) > len(settings.terms)]
    if missing:
        best = min(missing, key=lambda c: c.difference)
        return [f'{best.words}: add the term {best.terms[-1]}']
    return [test.words for test in tests if test.failed]


def _lag_words(lag: ParameterEstimate, coarse: float, period: float) -> list[str]:
    """Mention a lag that no usual filter explains, and one that points to a mass."""
    if not lag.determined and coarse:
        way = 'behind' if coarse > 0.0 else 'ahead of'
        size = f'{1e3 * abs(coarse):.2g} ms'
        return [
            f'the force is about {size} {way} the motion (steady strokes tell no more); corrected'
        ]
    if not lag.determined or lag.interval[0] <= 0.0 <= lag.interval[1]:
        return []
    size = f'{1e3 * abs(lag.value):.3g} ± {1e3 * lag.error:.2g} ms'
    if lag.value > max(_UNUSUAL_LAG, period):
        return [f'the force is {size} behind the motion: filters or clocks; corrected']
    if lag.value < 0.0 and -lag.value > period / 2.0:
        return [f'the force is {size} ahead of the motion: clocks, or a mass (term inertia)']
    return []


def _mass_words(parameters: Sequence[ParameterEstimate]) -> list[str]:
    found = {parameter.name: parameter for parameter in parameters if parameter.determined}
    if not {'moving_mass', 'viscous_friction'} <= set(found):
        return []
    mass = 1e-3 * found['viscous_friction'].value
    return [f'1 ms by which the force is late looks like {-mass:.2g} kg of moving_mass']


def _noise_words(
    signals: _Signals, design: _Design, settings: FrictionSettings, fit: Regression
) -> list[str]:
    """Say so if the noise of the speed makes mu_v smaller by more than half its error."""
    names = [column.name for column in columns_of(settings.terms)]
    if settings.estimator == 'total' or 'viscous_friction' not in names:
        return []
    k = names.index('viscous_friction')
    if not fit.determined[k]:
        return []
    x = regressors(design.speed, design.acceleration, settings.terms, settings)[design.used]
    inverse = np.linalg.pinv(x.T @ x)
    short = float(fit.values[k] * fit.samples * signals.speed_noise**2 * inverse[k, k])
    if abs(short) <= 0.5 * fit.errors[k]:
        return []
    noise = f'{signals.speed_noise:.2g} m/s'
    return [
        f'noise of {noise} in the speed takes {short:.2g} N s/m from mu_v: choose estimator total'
    ]


def _breakaway(
    signals: _Signals,
    design: _Design,
    settings: FrictionSettings,
    parameters: Sequence[ParameterEstimate],
) -> ParameterEstimate | None:
    """Return the mean force at which the needle left a rest in which the force rose."""
    # Shorter than `WINDOW`: the rise of the force is short too.
    window = signals.spanning(0.4 * WINDOW / settings.cutoff)
    starts = np.flatnonzero((design.regime[1:] != 0.0) & (design.regime[:-1] == 0.0)) + 1
    changes = np.flatnonzero(np.diff(design.stroke)) + 1
    found, signs = [], []
    dry = [p.value for p in parameters if p.name == 'coulomb_friction' and p.determined]
    least = _SMALLEST_RISE * max(dry, default=0.0)
    for start in starts:
        before, after = changes[changes < start], changes[changes > start]
        rest = int(before[-1]) if len(before) else 0
        end = int(after[0]) if len(after) else len(signals.time)
        push = _push(signals, design, (rest, int(start), end), window, least)
        if push is not None:
            found.append(push)
            signs.append(design.regime[start])
    if not found:
        return None
    values, errors, reaches = np.array(found).T
    value, count, share = float(values.mean()), len(found), float(np.mean(signs))
    error = sqrt(float(errors @ errors)) / count
    reach = sqrt(float(reaches @ reaches)) / count
    for parameter in parameters:
        if parameter.name == 'offset' and parameter.determined:
            value -= share * parameter.value
            error = hypot(error, share * parameter.error)
            reach = hypot(reach, share * (parameter.interval[1] - parameter.value))
    return ParameterEstimate(
        name='breakaway_force',
        symbol='f_b',
        unit='N',
        value=value,
        error=error,
        interval=(value - reach, value + reach),
        determined=True,
    )


def _push(
    signals: _Signals,
    design: _Design,
    span: tuple[int, int, int],
    window: FloatArray,
    least: float,
) -> tuple[float, float, float] | None:
    """Return the size of the force when motion began, its error and the reach of its interval."""
    rest, start, end = span
    most = round(_RISING / signals.period)
    sign = float(design.regime[start])
    early = max(rest + signals.reach, start - most)
    calm = start - signals.blur
    if min(calm - early, 2 * (end - start)) < len(window):
        return None
    if sign * (signals.force[calm] - signals.force[early]) <= 0.5 * least:
        return None
    onset, blur = _onset(signals, design, (max(rest, start - most), start, min(end, start + most)))
    last = round((onset - signals.time[0]) / signals.period) - signals.reach
    first = max(rest + signals.reach, last - most)
    if last - first < len(window):
        return None
    elapsed = signals.time[first:last] - onset
    try:
        line = regress(
            np.column_stack([np.ones_like(elapsed), elapsed]),
            signals.force[first:last],
            window=window,
        )
    except IdentificationError:
        return None
    value, slope = sign * line.values
    rise = slope * (last - first) * signals.period
    if not (slope > _CLEAR_RISE * line.errors[1] and rise > max(_SMALLEST_RISE * value, least)):
        return None
    error = hypot(float(line.errors[0]), slope * blur)
    return float(value), error, error * float(stdtrit(line.effective_samples - 2.0, 0.975))


def _onset(signals: _Signals, design: _Design, span: tuple[int, int, int]) -> tuple[float, float]:
    """Return when a step and a ramp of the speed fit best, and the error of that time [s]."""
    first, start, end = span
    time, speed = signals.time[first:end], design.speed[first:end]
    candidates = signals.time[first : start + 1]
    misfits = np.array(
        [_misfit(time[k:] - time[k], speed[k:]) for k in range(len(candidates))]
    ) + np.concatenate([[0.0], np.cumsum(speed**2)[: len(candidates) - 1]])
    best = int(np.argmin(misfits))
    # Filtered noise: a filter's length counts as one sample.
    independent = max(len(time) / (2 * signals.reach + 1) - 3.0, 1.0)
    close = misfits <= misfits[best] * (1.0 + 4.0 / independent)
    blur = signals.period * max(np.count_nonzero(close) / 4.0, 1.0 / sqrt(12.0))
    # It began since the sample before.
    return float(candidates[best]) - 0.5 * signals.period, float(blur)


def _misfit(time: FloatArray, values: FloatArray) -> float:
    """Return the sum of squares that a straight line leaves."""
    centered, rest = time - time.mean(), values - values.mean()
    spread = float(centered @ centered)
    explained = float(centered @ rest) ** 2 / spread if spread else 0.0
    return float(rest @ rest) - explained


def summarize(estimates: Sequence[FrictionEstimate]) -> FrictionSummary:
    """
    Put the estimates of several recordings together, as in Table 1.

    Parameters
    ----------
    estimates : sequence of FrictionEstimate
        One per recording.

    Returns
    -------
    FrictionSummary
        One `statistic` per parameter, then those of the break-away force and the lag if any
        recording has them.

    Raises
    ------
    IdentificationError
        If there are no estimates.

    """
    if not estimates:
        raise IdentificationError('no recordings to identify from')
    found: dict[str, list[ParameterEstimate]] = {}
    for estimate in estimates:
        for parameter in (*estimate.parameters, estimate.breakaway, estimate.lag):
            if parameter is not None:
                found.setdefault(parameter.name, []).append(parameter)
    return FrictionSummary(
        statistics=tuple(statistic(parameters) for parameters in found.values()),
        estimates=tuple(estimates),
    )
