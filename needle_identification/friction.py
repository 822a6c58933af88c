r"""
Coulomb and viscous friction from force and motion of the needle base, by linear regression.

Where the acceleration is small the axial row of equation (16) of [Boroomand2014]_ is friction
(15) alone; a force sensor adds an offset b:

.. math:: f_y = \mu_s \operatorname{sgn}(\dot s) + \mu_v \dot s + b

The offset is estimated when the needle moved both ways; in one direction it cannot be told from
mu_s and is taken as zero.

Force and speed pass the same zero-phase low-pass filter, which leaves a linear relation between
them as it is. The Coulomb term is not linear: samples near a start, a stop or a reversal, where
the filter mixes the regimes, are left out.

References
----------
.. [Boroomand2014] A. Boroomand, M. Tavakoli, R. Sloboda, N. Usmani, "Dynamical modeling
   and controllability analysis of a flexible needle in soft tissue", 2014, section 3.2.2.2.

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil, sqrt
from typing import Final

from needle_dynamics import FloatArray
from needle_dynamics.parameters import check_constants, constant
from needle_identification.errors import IdentificationError
from needle_identification.recording import Recording
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d
from scipy.signal import butter, oaconvolve, sosfiltfilt
from scipy.signal.windows import triang
from scipy.special import stdtrit

#: Time in which the filter forgets a step to 2e-4 [periods of its cutoff].
_SETTLING: Final = 2.0

#: Length of the window that spans the correlation of filtered noise [periods of the cutoff].
_WINDOW: Final = 3.0

#: Correlation windows of motion that a standard error needs to mean something.
_FEWEST_WINDOWS: Final = 10.0

#: A longer step between samples is a gap [sample periods].
_GAP: Final = 3.5

#: An even grid of more points than this per sample would be made up of gaps.
_LARGEST_GRID: Final = 10.0

#: Beyond this condition number, where |speed| varies by about 10 %, mu_s and mu_v are not told
#: apart: an error of the force of 1 % would move them by a fifth.
_LARGEST_CONDITION: Final = 20.0

#: Each direction must hold this part of the samples for the offset to be estimated.
_SMALLEST_SHARE: Final = 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class FrictionSettings:
    """How friction is identified."""

    cutoff: float = constant(
        10.0, 'Hz', 'zero-phase low-pass filter of force and speed', open_low=True
    )
    moving_speed: float = constant(
        5e-4, 'm/s', 'speed above which the needle counts as moving', open_low=True
    )
    largest_acceleration: float = constant(
        0.02,
        'm/s^2',
        'acceleration up to which inertia and sensor lag are left out',
        open_low=True,
    )

    def __post_init__(self) -> None:
        check_constants(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class FrictionEstimate:
    """
    Friction of one recording; plus or minus two standard errors hold about 95 %.

    Attributes
    ----------
    name : str
        The recording.
    coulomb_friction, coulomb_error : float
        Coulomb friction mu_s and its standard error [N].
    viscous_friction, viscous_error : float
        Viscous friction mu_v and its standard error [N s/m].
    offset : float or None
        Offset of the force sensor [N]; None if the needle moved in one direction only.
    samples : int
        Samples in steady motion that were used.
    residual : float
        Root mean square of what the model leaves of the filtered force [N].
    determination : float
        Coefficient of determination R^2.
    condition : float
        Condition number of the regressors of mu_s and mu_v, each scaled to unit norm.

    """

    name: str
    coulomb_friction: float
    coulomb_error: float
    viscous_friction: float
    viscous_error: float
    offset: float | None
    samples: int
    residual: float
    determination: float
    condition: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Statistic:
    """
    One coefficient over several recordings.

    Attributes
    ----------
    mean : float
        Mean over the recordings.
    deviation : float or None
        Standard deviation over the recordings, as in Table 1; None for a single recording.
    error : float
        Standard error of the mean.
    interval : (float, float)
        95 % confidence interval of the mean.

    """

    mean: float
    deviation: float | None
    error: float
    interval: tuple[float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class FrictionSummary:
    """Friction over all recordings: mu_s [N], mu_v [N s/m], and what each recording gave."""

    coulomb: Statistic
    viscous: Statistic
    estimates: tuple[FrictionEstimate, ...]


def identify_friction(
    recording: Recording, settings: FrictionSettings | None = None
) -> FrictionEstimate:
    """
    Estimate the friction coefficients of equation (15) from one recording.

    Parameters
    ----------
    recording : Recording
        Force and motion; the needle tip is past the tissue, so that nothing is cut.
    settings : FrictionSettings, optional
        How to identify.

    Returns
    -------
    FrictionEstimate
        Least-squares estimates with standard errors that respect the correlation which the
        filter and the sensor leave in the residuals.

    Raises
    ------
    IdentificationError
        If the recording does not determine the coefficients, saying what it lacks.

    """
    settings = settings or FrictionSettings()
    try:
        return _identify(recording, settings)
    except IdentificationError as error:
        raise IdentificationError(f'{recording.name}: {error}') from None


def _identify(recording: Recording, settings: FrictionSettings) -> FrictionEstimate:
    period, speed, force, lost = _evenly_sampled(recording)
    settling = ceil(_SETTLING / settings.cutoff / period)
    speed, force = _low_pass(np.array([speed, force]), settings.cutoff, period, settling)
    used = _steady(speed, settings.moving_speed, lost, settling)
    used &= np.abs(np.gradient(speed, period)) <= settings.largest_acceleration
    samples = int(np.count_nonzero(used))
    window = triang(ceil(_WINDOW / settings.cutoff / period))
    span = float(window.sum()) ** 2 / float(window @ window)
    windows = samples / span
    if windows < _FEWEST_WINDOWS:
        raise IdentificationError(
            f'steady motion above {settings.moving_speed:g} m/s must last '
            f'{_FEWEST_WINDOWS * span * period:.3g} s in all, lasts {samples * period:.3g} s'
        )
    variance = float(np.var(force[used]))
    if variance == 0.0:
        raise IdentificationError(f'the force must vary, got {force[used][0]:g} N throughout')

    speed, force = np.where(used, speed, 0.0), np.where(used, force, 0.0)
    direction = np.sign(speed)
    condition = _condition(speed[used])
    forward = np.count_nonzero(speed > 0.0) / samples
    both_ways = _SMALLEST_SHARE <= forward <= 1.0 - _SMALLEST_SHARE
    columns = [direction, speed, used.astype(np.float64)]
    regressors = np.column_stack(columns if both_ways else columns[:2])
    normal = np.linalg.inv(regressors.T @ regressors)
    solution = normal @ (regressors.T @ force)
    residual = force - regressors @ solution
    # The fit itself has taken as many degrees of freedom as it has coefficients.
    scores = _covariance(regressors * residual[:, np.newaxis], window)
    scores *= windows / (windows - len(solution))
    errors = np.sqrt(np.diag(normal @ scores @ normal))
    if min(solution[:2] + 2.0 * errors[:2]) < 0.0:
        raise IdentificationError(
            f'friction must not be negative, got mu_s = {solution[0]:.3g} N and '
            f'mu_v = {solution[1]:.3g} N s/m; the force or the motion may have the wrong sign'
        )
    unexplained = float(residual @ residual) / samples
    return FrictionEstimate(
        name=recording.name,
        coulomb_friction=float(solution[0]),
        coulomb_error=float(errors[0]),
        viscous_friction=float(solution[1]),
        viscous_error=float(errors[1]),
        offset=float(solution[2]) if both_ways else None,
        samples=samples,
        residual=sqrt(unexplained),
        determination=1.0 - unexplained / variance,
        condition=condition,
    )


def _evenly_sampled(
    recording: Recording,
) -> tuple[float, FloatArray, FloatArray, NDArray[np.bool_]]:
    """Return the sample period [s], speed and force on an even grid, and where a gap was."""
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
    grid = time[0] + period * np.arange(int(duration / period) + 1)
    after = np.clip(np.searchsorted(time, grid), 1, len(steps))
    lost = steps[after - 1] > _GAP * period
    return (
        period,
        np.interp(grid, time, recording.speed),
        np.interp(grid, time, recording.force),
        lost,
    )


def _low_pass(signals: FloatArray, cutoff: float, period: float, settling: int) -> FloatArray:
    """Filter along the last axis forward and backward, which shifts nothing in time."""
    if cutoff >= 0.5 / period:
        raise IdentificationError(
            f'cutoff must be < half the sample rate = {0.5 / period:g} Hz, got {cutoff:g} Hz'
        )
    if signals.shape[-1] <= 2 * settling:
        raise IdentificationError(
            f'must last > {2 * settling * period:.3g} s for a filter of {cutoff:g} Hz, lasts '
            f'{signals.shape[-1] * period:.3g} s'
        )
    sections = butter(2, cutoff, fs=1.0 / period, output='sos')
    return np.asarray(sosfiltfilt(sections, signals, padlen=settling))


def _steady(
    speed: FloatArray, moving_speed: float, lost: NDArray[np.bool_], settling: int
) -> NDArray[np.bool_]:
    """Mark samples that move and are farther than ``settling`` from any change of regime."""
    regime = np.where(np.abs(speed) > moving_speed, np.sign(speed), 0.0)
    change = np.ones(len(speed), dtype=np.bool_)
    change[1:-1] = lost[1:-1] | (regime[1:-1] != regime[:-2])
    near = maximum_filter1d(change.astype(np.uint8), 2 * settling + 1)
    return np.asarray((regime != 0.0) & (near == 0))


def _condition(speed: FloatArray) -> float:
    """Return the condition number of the columns sgn(s_dot) and s_dot, scaled to unit norm."""
    pace = np.abs(speed)
    cosine = float(pace.mean() / np.sqrt(np.mean(pace**2)))
    condition = sqrt((1.0 + cosine) / max(1.0 - cosine, 1e-16))
    if condition > _LARGEST_CONDITION:
        raise IdentificationError(
            f'speeds must spread by about 10 % for mu_s and mu_v to be told apart, got '
            f'{pace.mean():.3g} m/s with a spread of {pace.std() / pace.mean():.2%}'
        )
    return condition


def _covariance(scores: FloatArray, window: FloatArray) -> FloatArray:
    r"""
    Covariance of the sum of correlated scores, shape (k, k), from scores of shape (n, k).

    Sums over all positions of a triangular window weigh the autocovariances with its own
    autocorrelation, which is the kernel of Parzen: flat at lag zero, never negative. Samples
    that are not used have score zero and keep the others at their true distance.

    References
    ----------
    W. K. Newey, K. D. West, "A simple, positive semi-definite, heteroskedasticity and
    autocorrelation consistent covariance matrix", Econometrica 55(3), 1987.

    """
    sums = oaconvolve(scores, window[:, np.newaxis], axes=0)
    return np.asarray(sums.T @ sums / (window @ window))


def summarize(estimates: Sequence[FrictionEstimate]) -> FrictionSummary:
    """
    Put the estimates of several recordings together, as in Table 1.

    The standard error of the mean is the scatter over the recordings divided by the root of
    their number, which holds whatever makes them differ; but it is never taken as smaller than
    the errors within the recordings alone allow, which few recordings could undercut by chance.
    The interval is wider than two standard errors where few recordings differ by more than
    their own errors: a scatter known from few is itself uncertain (Student's t).

    Parameters
    ----------
    estimates : sequence of FrictionEstimate
        One per recording.

    Returns
    -------
    FrictionSummary
        Means, standard deviations and standard errors.

    Raises
    ------
    IdentificationError
        If there are no estimates.

    """
    if not estimates:
        raise IdentificationError('no recordings to identify from')
    return FrictionSummary(
        coulomb=_statistic([(e.coulomb_friction, e.coulomb_error) for e in estimates]),
        viscous=_statistic([(e.viscous_friction, e.viscous_error) for e in estimates]),
        estimates=tuple(estimates),
    )


def _statistic(pairs: list[tuple[float, float]]) -> Statistic:
    values, errors = np.array(pairs).T
    count = len(values)
    deviation = float(values.std(ddof=1)) if count > 1 else None
    within = float(np.mean(errors**2))
    scatter = (deviation or 0.0) ** 2
    error = sqrt(max(within, scatter) / count)
    reach = error * (float(stdtrit(count - 1, 0.975)) if scatter > within else 2.0)
    mean = float(values.mean())
    return Statistic(
        mean=mean, deviation=deviation, error=error, interval=(mean - reach, mean + reach)
    )
