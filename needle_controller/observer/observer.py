"""
Kalman filter of the bending from what a robot measures: encoders, tip deflection, base wrench.

The modal rows of (16) are linear once depth and speed are known, and encoders tell these exactly
enough. Over one sample the depth is frozen at its mean and the modal flow is the exact one, so
that modes far above the sample rate are no trouble; means over the sample, which is what sensors
report, are then linear in the state at its start. The low-pass of the force sensor belongs to the
state: its noise enters before it and is not white behind it.

A tip sample that comes late is taken in where it belongs: the filter keeps its past for a while
and runs it once more from there. The result is that of a filter to which nothing came late.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache
from math import ceil, inf, isfinite, nan
from typing import Final

from needle_controller.compiled.filter import (
    begin,
    BENDING,
    DAMPING,
    DEGREES,
    DENSITY,
    FIXED,
    FORCE_INPUT,
    FORCE_NOISE,
    FORCE_VARIANCE,
    HEADER,
    LATERAL,
    LENGTH,
    LOAD,
    MOMENT,
    MOMENT_INPUT,
    MOMENT_NOISE,
    MOMENT_VARIANCE,
    NIS,
    NOISE,
    observe,
    OUTPUTS,
    outputs,
    PRINTED,
    replay,
    RESPONSE,
    SENSOR,
    STEADY,
    TICKS,
    TIME,
    TIP,
    TIP_PRIOR,
    TIP_SPREAD,
    TIP_VARIANCE,
    WHOLE,
)
from needle_dynamics import (
    FloatArray,
    ForceSensorParameters,
    InsertedLengthError,
    NeedleModel,
    NeedleParameters,
)
from needle_dynamics.compiled.kernels import evaluate, evaluate_many
from needle_dynamics.model import ROUNDING
from needle_dynamics.simulated.tip_sensor import TipParameters
from needle_ros.errors import (
    NeedleError,
    ParameterError,
    ShapeError,
)
from needle_ros.settings import check_constants, constant
import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import cholesky, solve_discrete_lyapunov, solve_triangular
from scipy.signal import butter
from scipy.special import chdtri

#: Encoder samples are taken to be even if their stamps are to this part of the period.
_EVEN: Final = 0.01

#: A wrench belongs to an encoder sample if their stamps differ by less than this part of a period.
_SAME: Final = 0.1

#: Most wrenches that wait for their encoder sample.
_WAITING: Final = 16

#: Exposures of the tip may overlap by this part; more is the same sample twice.
_OVERLAP: Final = 0.1


#: What the plant feels with as it is by default, and hence what the observer believes in.
_SENSOR: Final = ForceSensorParameters()


@lru_cache(maxsize=32)
def _low_pass(
    cutoffs: tuple[float, ...], rate: float
) -> tuple[FloatArray, FloatArray, FloatArray, float]:
    """
    Return the low-pass as transition, input and steady state of memory and reading, and its gain.

    The memory is scaled so that white noise of one before the filter makes it white, of one.
    """
    a: FloatArray = np.zeros((0, 0))
    b: FloatArray = np.zeros(0)
    c: FloatArray = np.zeros(0)
    d = 1.0
    for cutoff in cutoffs:
        over, under = butter(2, cutoff, fs=rate)
        # Transposed direct form II behind what there is.
        own = np.array([[-under[1], 1.0], [-under[2], 0.0]])
        drive = over[1:] - under[1:] * over[0]
        order = len(b)
        a = np.block([[a, np.zeros((order, 2))], [np.outer(drive, c), own]])
        b = np.concatenate([b, drive * d])
        c, d = np.concatenate([over[0] * c, [1.0, 0.0]]), over[0] * d
    order = len(b)
    if order:
        root = cholesky(solve_discrete_lyapunov(a, np.outer(b, b)), lower=True)
        a, b = (solve_triangular(root, value, lower=True) for value in (a @ root, b))
        c = c @ root
    transition, drive = np.zeros((order + 1, order + 1)), np.append(b, d)
    transition[:order, :order], transition[order, :order] = a, c
    steady = np.linalg.solve(np.eye(order + 1) - transition, drive)
    return transition, drive, steady, float(np.sqrt(c @ c + d * d))


def _of_sensor(name: str, channel: int) -> float:
    """Return a constant of the plant's force sensor as it is by default."""
    return float(_SENSOR.per_axis(name)[channel])


def _read_noise(channel: int, digits: int) -> float:
    """Return the noise with which that sensor is read, behind its filters."""
    gain = _low_pass(_SENSOR.cutoffs, _SENSOR.rate)[3]
    return round(_of_sensor('noise', channel) * gain, digits)


@dataclass(frozen=True, slots=True, kw_only=True)
class ObserverSettings:
    """
    What the observer believes of sensors and tissue beside `NeedleParameters`.

    The defaults are those of the plant's sensors as they are by default.
    """

    irregularity: float = constant(
        1e-3, 'N s^(1/2) m^(-1/2)',
        'root of the spectral density of a distributed lateral force, white in time and depth, '
        'by which the tissue differs from the model (the default covers a stiffness 30 % off '
        'down to half the needle)',
    )  # fmt: skip
    initial_deflection: float = constant(
        1e-3, 'm', 'standard deviation of the tip deflection at the start', open_low=True
    )
    tip_noise: float = constant(
        TipParameters().noise, 'm', 'standard deviation of a sample of the tip deflection',
        open_low=True,
    )  # fmt: skip
    tip_exposure: float = constant(
        1e-3, 's', 'time before its stamp over which a tip sample is the mean', open_low=True
    )
    force_noise: float = constant(
        _read_noise(2, 6), 'N', 'standard deviation of the lateral force as it is read',
        open_low=True,
    )  # fmt: skip
    torque_noise: float = constant(
        _read_noise(3, 8), 'N m', 'standard deviation of the moment as it is read', open_low=True
    )
    force_resolution: float = constant(_of_sensor('resolution', 2), 'N', 'force per count')
    torque_resolution: float = constant(_of_sensor('resolution', 3), 'N m', 'torque per count')
    cutoffs: tuple[float, ...] = field(
        default=_SENSOR.cutoffs,
        metadata={
            'description': 'low-pass filters of the wrench one after the other '
            '(Butterworth, second order) [Hz]'
        },
    )
    filter_rate: float = constant(
        _SENSOR.rate, 'Hz', 'rate at which these filters run, each on means over its samples',
        open_low=True,
    )  # fmt: skip
    history: float = constant(
        0.25, 's', 'how far back a late tip sample may begin; longer gaps start anew',
        open_low=True, high=10.0,
    )  # fmt: skip
    jump: float = constant(
        5e-3, 'm', 'change of depth from one sample to the next that starts anew', open_low=True
    )

    def __post_init__(self) -> None:
        check_constants(self)
        try:
            cutoffs = tuple(float(value) for value in self.cutoffs)
        except (TypeError, ValueError):
            cutoffs = (nan,)
        if not all(0.0 < value < self.filter_rate / 2.0 for value in cutoffs):
            raise ParameterError(
                f'cutoffs must be > 0 and below half the filter_rate = '
                f'{self.filter_rate / 2.0:g} Hz each, got {self.cutoffs!r}'
            )
        object.__setattr__(self, 'cutoffs', cutoffs)


@dataclass(frozen=True, slots=True, kw_only=True)
class Consistency:
    """
    Whether errors are as large as the filter says: squares of errors over their variances.

    Attributes
    ----------
    ratio : float
        Their mean over all degrees of freedom; 1 in a filter that is consistent.
    low, high : float
        Band of chi^2 that holds it with 95 %.
    degrees : int
        Degrees of freedom; without any the ratio is not a number.

    """

    ratio: float
    low: float
    high: float
    degrees: int

    @classmethod
    def of(cls, total: float, degrees: int) -> Consistency:
        """
        Judge a sum of NIS or NEES.

        Parameters
        ----------
        total : float
            The sum.
        degrees : int
            Number of measurements (NIS), or of runs times 2 n (NEES).

        Returns
        -------
        Consistency
            The sum over its degrees of freedom, with the band.

        """
        if degrees == 0:
            return cls(ratio=nan, low=0.0, high=inf, degrees=0)
        low, high = (float(chdtri(degrees, tail)) / degrees for tail in (0.975, 0.025))
        return cls(ratio=float(total) / degrees, low=low, high=high, degrees=degrees)

    @property
    def holds(self) -> bool:
        """Whether the ratio is within the band; with no measurements it is."""
        return self.degrees == 0 or self.low <= self.ratio <= self.high


class Observer:
    """
    Estimates q1 to qn and their rates while the needle moves.

    Parameters
    ----------
    parameters : NeedleParameters
        Needle and tissue as the observer believes them to be.
    settings : ObserverSettings
        Noise and sensors.
    period : float
        Sample period of encoders and wrench [s].

    Attributes
    ----------
    refused : int
        Samples that were not taken in: late or repeated encoder samples; tip samples and
        wrenches that are not finite, repeated, older than the history, far ahead of the
        encoders, or (a wrench) between encoder samples.
    restarts : int
        How often the observer started anew by itself.
    warning : str or None
        Why it last did; None if it did not since it was made or `reset`.

    Raises
    ------
    ParameterError
        If the period is not positive, not shorter than the history, or not a whole number of
        samples of the force sensor's filter.

    """

    def __init__(
        self, parameters: NeedleParameters, settings: ObserverSettings, period: float
    ) -> None:
        if not 0.0 < period < settings.history:
            raise ParameterError(
                f'period must be > 0 and < history = {settings.history:g} s, got {period!r}'
            )
        ticks = round(settings.filter_rate * period)
        if ticks < 1 or abs(ticks - settings.filter_rate * period) > _EVEN:
            raise ParameterError(
                f'filter_rate must be a whole multiple of the sample rate {1.0 / period:g} Hz, '
                f'got {settings.filter_rate:g} Hz'
            )
        self.period = float(period)
        self.settings = settings
        self.model = NeedleModel(parameters)
        self._swells = parameters.swelling != 0.0
        self._fixed, self._sensor = _constants(parameters, settings, ticks)
        n, modes = parameters.modes, self.model.modes
        self._modes = modes.series, modes.terms, modes.constants
        tissue = self.model.tissue
        self._tissue = np.column_stack(
            [np.array(tissue.starts), np.array(tissue.stiffnesses), tissue.offsets(modes)]
        )
        self._reach = modes.reach * parameters.length
        slack = ROUNDING * parameters.length
        self._least, self._most = parameters.minimum_depth - slack, self._reach + slack
        size = 2 * n + 2 * self._sensor.shape[2] + 1
        slots = ceil(settings.history / period) + 2
        self._size = size
        self._at = np.zeros(n * (n + 1) + 4 * n)
        self._series_work = np.zeros(modes.series.shape[1] + 4 * n)
        self._basis = np.zeros((2 * n + 1, n))
        self._present = np.zeros((2 * n + 1, n))
        self._pairs = np.zeros((slots, 2, size, size))
        self._book = np.zeros((slots, size + HEADER + 2 * n + 2 * n * n))
        self._tips = np.zeros((2 * slots, 3))
        self._work = np.zeros((7, size, size))
        self._jacobian = np.zeros((2 * n, 2 * n))
        self._out = np.zeros(2 * n + OUTPUTS)
        self._at_depth = nan
        self._origin: float | None = None
        self._time = self._depth = self._speed = self._frozen = 0.0
        self._growth = 1.0
        self._slot = self._oldest = self._count = 0
        self._looked = False
        self.reset()
        self._warm_up()

    def reset(self) -> None:
        """Forget all measurements; the next encoder sample starts anew."""
        self.refused = self.restarts = 0
        self.warning: str | None = None
        self._begun = False
        self._waiting: list[tuple[float, float, float]] = []

    def _warm_up(self) -> None:
        """Compile, or load what was compiled, before time counts."""
        depth = self.model.parameters.length
        self.update(0.0, depth, 0.0)
        self.update(self.period, depth, 0.0)
        self.add_tip(self.period, 0.0)
        self._look()
        self._origin = None
        self.reset()

    # Measurements.

    def update(
        self,
        time: float,
        depth: float,
        speed: float,
        wrench: tuple[float, float] | None = None,
    ) -> None:
        """
        Take in a sample of the encoders, and of the base wrench if there is one.

        The first sample is where the observer starts from; its wrench does not count. A gap is
        bridged as if the depth had gone evenly. A gap longer than the history, a clock set back
        by more than it, or a jump of depth starts the observer anew with a `warning`.

        Parameters
        ----------
        time : float
            When it was taken [s]. Steps within 1 % of the period count as one period.
        depth, speed : float
            Inserted length [m] and insertion speed [m/s], positive into the tissue.
        wrench : tuple of float, optional
            Lateral force along z [N] and moment about x at the base [N m], less any torque that
            turns the base; each not a number where it is missing.

        Raises
        ------
        ParameterError
            If time, depth or speed is not finite; the estimate stays as it is.
        InsertedLengthError
            If the depth is outside its range; the estimate stays as it is.

        """
        if not (isfinite(time) and isfinite(depth) and isfinite(speed)):
            raise ParameterError(
                f'time, depth and speed must be finite, got {time!r}, {depth!r} and {speed!r}'
            )
        if not self._least <= depth <= self._most:
            low = self.model.parameters.minimum_depth
            raise InsertedLengthError(
                f'inserted length {depth:.6g} m is outside [{low:g}, {self._reach:g}] m '
                '(minimum_depth to the hub); the estimate is held'
            )
        # An integer would have the kernel compiled anew for it.
        time, depth, speed = float(time), min(float(depth), self._reach), float(speed)
        if self._origin is None:
            self._origin = time
        time -= self._origin
        elapsed, history = time - self._time, self.settings.history
        if self._begun:
            if -history <= elapsed <= 0.0:
                self.refused += 1
                return
            if not 0.0 < elapsed <= history:
                self._restart(f'encoders went from {self._time:g} to {time:g} s')
            elif abs(depth - self._depth) > self.settings.jump:
                self._restart(f'depth jumped from {self._depth:g} to {depth:g} m')
        if self._begun:
            lateral = moment = nan
            if wrench is not None:
                lateral = float(wrench[0]) if isfinite(wrench[0]) else nan
                moment = float(wrench[1]) if isfinite(wrench[1]) else nan
            self._go_on(time, depth, speed, lateral, moment)
        else:
            self._begin(time, depth)
        self._time, self._depth, self._speed = time, depth, speed
        if self._waiting:
            waiting, self._waiting = self._waiting, []
            for stamp, lateral, moment in waiting:
                self.add_wrench(stamp, lateral, moment)

    def add_wrench(self, stamp: float, lateral: float, moment: float) -> None:
        """
        Take in a base wrench that comes apart from the encoder sample of the same time.

        Parameters
        ----------
        stamp : float
            When it was taken [s], on the clock of `update`: the time of an encoder sample, which
            may be still to come.
        lateral, moment : float
            As for `update`; not a number where missing.

        """
        if not (self._begun and isfinite(stamp) and (isfinite(lateral) or isfinite(moment))):
            self.refused += 1
            return
        time, slack = float(stamp) - (self._origin or 0.0), _SAME * self.period
        if time > self._time + slack and len(self._waiting) < _WAITING:
            self._waiting.append((stamp, lateral, moment))
            return
        times, slot = self._book[:, self._size + TIME], self._slot
        while slot != self._oldest and times[slot] > time + slack:
            slot = (slot or len(times)) - 1
        readings = self._book[slot, self._size + LATERAL : self._size + MOMENT + 1]
        if slot == self._oldest or abs(times[slot] - time) > slack or np.isfinite(readings).any():
            self.refused += 1
            return
        readings[0] = lateral if isfinite(lateral) else nan
        readings[1] = moment if isfinite(moment) else nan
        self._replay(float(times[(slot or len(times)) - 1]))

    def add_tip(self, stamp: float, deflection: float) -> None:
        """
        Take in a sample of the tip deflection, however late within the history.

        Parameters
        ----------
        stamp : float
            When it was taken, the end of its exposure [s], on the clock of `update`. It may be
            ahead of the last encoder sample, and earlier than tip samples that came before.
        deflection : float
            Mean deflection over the exposure [m].

        """
        if not (self._begun and isfinite(stamp) and isfinite(deflection)):
            self.refused += 1
            return
        exposure = self.settings.tip_exposure
        end = float(stamp) - (self._origin or 0.0)
        start = end - exposure
        slack = _OVERLAP * exposure
        oldest = float(self._book[self._oldest, self._size + TIME])
        tips, count = self._tips, self._count
        place = count
        while place > 0 and tips[place - 1, 1] > end:
            place -= 1
        floor = max(oldest, float(tips[place - 1, 1])) if place > 0 else oldest
        ceiling = float(tips[place, 0]) if place < count else inf
        late, ahead = start < floor - slack, end > self._time + self.settings.history
        if late or ahead or end > ceiling + slack:
            self.refused += 1
            return
        start, end = max(start, floor), min(end, ceiling)
        if count == len(tips):
            gone = int(np.count_nonzero(tips[:count, 1] <= oldest))
            if gone == 0:
                self.refused += 1
                return
            tips[: count - gone] = tips[gone:count]
            count, place = count - gone, max(place - gone, 0)
        tips[place + 1 : count + 1] = tips[place:count].copy()
        tips[place] = start, end, deflection
        self._count = count + 1
        if start < self._time:
            self._replay(start)

    def _replay(self, since: float) -> None:
        replay(
            self._fixed, self._sensor, self._pairs, self._book, self._tips, self._work,
            self._count, self._oldest, self._slot, since,
        )  # fmt: skip
        self._looked = False

    def _restart(self, reason: str) -> None:
        self.warning = f'{reason}; the observer started anew'
        self._waiting.clear()
        self.restarts += 1
        self._begun = False

    def _begin(self, time: float, depth: float) -> None:
        self._begun, self._looked = True, False
        self._slot = self._oldest = self._count = 0
        self._frozen, self._growth = depth, self._growth_at(time)
        self._evaluate(depth)
        begin(
            self._fixed, self._sensor, self._tissue, self._at, self._basis, self._pairs,
            self._book, self._work, 0, time, self.period, depth, self._growth,
        )  # fmt: skip

    def _go_on(
        self, time: float, depth: float, speed: float, lateral: float, moment: float
    ) -> None:
        """Go to the next sample, or over a gap in samples of which only the last is measured."""
        start, elapsed, period = self._time, time - self._time, self.period
        before, advance = self._depth, depth - self._depth
        count = max(1, round(elapsed / period))
        span = elapsed / count
        if abs(span - period) < _EVEN * period:
            span = period
        for k in range(1, count):
            middle = before + advance * (k - 0.5) / count
            self._step(start + elapsed * k / count, span, middle, advance / elapsed, nan, nan)
        if count == 1:
            # Mean of the cubic through both ends; a noisy speed does not take it beyond them.
            mean = before + 0.5 * advance + span * (self._speed - speed) / 12.0
            mean = min(max(mean, min(before, depth)), max(before, depth))
            pace = 0.5 * (self._speed + speed)
        else:
            mean, pace = depth - 0.5 * advance / count, advance / elapsed
        self._step(time, span, mean, pace, lateral, moment)

    def _step(
        self, time: float, span: float, depth: float, speed: float, lateral: float, moment: float
    ) -> None:
        old = self._slot
        new = old + 1 if old + 1 < len(self._book) else 0
        if new == self._oldest:
            self._oldest = new + 1 if new + 1 < len(self._book) else 0
        growth = self._growth_at(time) if self._swells else self._growth
        moved = depth != self._frozen or growth != self._growth
        self._evaluate(depth)
        observe(
            self._fixed, self._sensor, self._tissue, self._at, self._basis, self._pairs,
            self._book, self._tips, self._work, self._count, old, new, time, span, depth, speed,
            growth, moved, lateral, moment,
        )  # fmt: skip
        self._slot, self._frozen, self._growth = new, depth, growth
        self._looked = False

    def _growth_at(self, time: float) -> float:
        return self.model.tissue.growth(max(time, 0.0))

    def _evaluate(self, depth: float) -> None:
        """Evaluate the modes without what `ModeShapes.packed` allocates."""
        if depth == self._at_depth:
            return
        self._at_depth = depth
        series, terms, modes = self._modes
        length = self.model.parameters.length
        if modes.shape[1] == 2:
            evaluate(depth / length, series, terms, self._series_work, self._at)
        else:
            evaluate_many(depth / length, length, modes, series, self._series_work, self._at)

    # Estimates.

    def _look(self) -> FloatArray:
        """Return the outputs at the present depth, computed once a sample."""
        if not self._begun:
            raise NeedleError('the observer has no estimate before the first encoder sample')
        if not self._looked:
            self._evaluate(self._depth)
            outputs(
                self._fixed, self._tissue, self._at, self._basis, self._book[self._slot],
                self._pairs[self._slot, 0], self._work, self._depth, self._growth,
                self.period, self._present, self._jacobian, self._out,
            )  # fmt: skip
            self._looked = True
        return self._out

    @property
    def ready(self) -> bool:
        """Whether there is an estimate; what follows raises `NeedleError` before."""
        return self._begun

    @property
    def modal(self) -> tuple[FloatArray, FloatArray]:
        """Estimate of q1 to qn [m^3/2] and of their rates [m^3/2 / s], shape (n,) each."""
        n = self.model.modes.count
        out = self._look()
        return out[:n].copy(), out[n : 2 * n].copy()

    @property
    def covariance(self) -> FloatArray:
        """Covariance of the modal coordinates and their rates, SI units; shape (2 n, 2 n)."""
        self._look()
        matrix = self._jacobian @ self._normal_covariance() @ self._jacobian.T
        return np.asarray(0.5 * (matrix + matrix.T))

    @property
    def tip_deflection(self) -> tuple[float, float]:
        """Estimate of the tip deflection now, and its standard deviation [m]."""
        out, first = self._look(), 2 * self.model.modes.count
        return float(out[first + TIP]), float(out[first + TIP_SPREAD])

    @property
    def load(self) -> float:
        """
        Force of the bent needle against insertion [N].

        It is row d of the bias forces (13) with its sign turned: what inverse dynamics has to
        add to the insertion force. Modes that are not below half the sample rate do not count:
        the estimates of their rates are noise, and the load goes with the square of it.
        """
        return float(self._look()[2 * self.model.modes.count + LOAD])

    @property
    def nis(self) -> Consistency:
        """
        Consistency of the measurements over the history: normalized innovations squared.

        Each innovation is that of the measurement where it belongs in time, given all earlier
        ones, also those that came later.
        """
        if not self._begun:
            return Consistency.of(0.0, 0)
        book, first, last = self._book, self._oldest, self._slot
        rows = np.arange(first, last + 1 if last >= first else last + 1 + len(book)) % len(book)
        total = float(book[rows, self._size + NIS].sum())
        return Consistency.of(total, round(float(book[rows, self._size + DEGREES].sum())))

    def nees(self, modal: ArrayLike, rates: ArrayLike) -> float:
        """
        Return the normalized estimation error squared (NEES) against the truth, for studies.

        Parameters
        ----------
        modal, rates : array_like, shape (n,)
            True modal coordinates and rates.

        Returns
        -------
        float
            Distributed as chi^2 with 2 n degrees of freedom if the filter is consistent.

        Raises
        ------
        ShapeError
            If a shape is wrong.

        """
        truth = np.concatenate([np.asarray(modal, dtype=float), np.asarray(rates, dtype=float)])
        if truth.shape != (len(self._jacobian),):
            raise ShapeError(
                f'modal and rates must have shape ({self.model.modes.count},) each, got '
                f'{np.shape(modal)} and {np.shape(rates)}'
            )
        error = truth - self._look()[: len(truth)]
        # In normal coordinates, where nothing is close to singular.
        normal = np.linalg.solve(self._jacobian, error)
        return float(normal @ np.linalg.solve(self._normal_covariance(), normal))

    def _normal_covariance(self) -> FloatArray:
        modal = len(self._jacobian)
        return self._pairs[self._slot, 0, :modal, :modal]


def _constants(
    parameters: NeedleParameters, settings: ObserverSettings, ticks: int
) -> tuple[FloatArray, FloatArray]:
    """Return what the compiled step needs: `fixed` and `sensor`."""
    transition, drive, steady, gain = _low_pass(settings.cutoffs, settings.filter_rate)
    fixed = np.zeros(FIXED)
    fixed[DENSITY] = parameters.linear_density
    fixed[BENDING] = parameters.bending_stiffness
    fixed[DAMPING] = parameters.tissue_damping
    fixed[PRINTED] = parameters.formulation == 'as_printed'
    fixed[LENGTH] = parameters.length
    fixed[NOISE] = settings.irregularity**2
    # A count of the reading is uniform rounding.
    fixed[FORCE_VARIANCE] = settings.force_resolution**2 / 12.0
    fixed[MOMENT_VARIANCE] = settings.torque_resolution**2 / 12.0
    fixed[TIP_VARIANCE] = settings.tip_noise**2
    fixed[TICKS] = ticks
    fixed[TIP_PRIOR] = settings.initial_deflection**2
    fixed[FORCE_INPUT] = (settings.force_noise / gain) ** 2
    fixed[MOMENT_INPUT] = (settings.torque_noise / gain) ** 2
    order = len(drive)
    sensor = np.zeros((SENSOR, max(order, ticks), order))
    response, spread = drive, np.zeros((order, order))
    for tick in range(ticks):
        sensor[RESPONSE, tick] = response
        spread += np.outer(response, response)
        response = transition @ response
    sensor[WHOLE, :order] = np.linalg.matrix_power(transition, ticks)
    sensor[FORCE_NOISE, :order] = fixed[FORCE_INPUT] * spread
    sensor[MOMENT_NOISE, :order] = fixed[MOMENT_INPUT] * spread
    sensor[STEADY, 0] = steady
    return fixed, sensor
