# SPDX-License-Identifier: Apache-2.0
"""Averaged tip measurements, and a steering law with checked measurements and setpoints."""

from collections.abc import Mapping
from math import nan, sqrt
from typing import Any, Final, NamedTuple

from needle_controller.compiled.guide_plan import HIT
from needle_controller.compiled.hypotheses import MOST_MISSING, MOST_SAME
from needle_controller.steering.checked_law import CheckedPlans, expected_of, guarded, report_of
from needle_controller.steering.law import (
    GuideSetpoint,
    SteeringFaultError,
    SteeringLaw,
    TipEstimate,
)
from needle_controller.steering.settings import ExecutiveSettings
from needle_dynamics.arrays import BoolArray, FloatArray
from needle_ros.errors import ParameterError
from needle_ros.event_log import EventLog, Severity
from needle_ros.quantities import DEVIATION_OVER_MEDIAN, NORMAL
import numpy as np
from scipy.special import stdtrit

_OUTLIER: Final = 5.0  #: Distance of an outlier from the median, in standard deviations.
_FARTHEST: Final = 0.1  #: Largest distance of the tip from the guide before an insertion [m].
_FEW: Final = 3  #: Least number of readings for outlier rejection.

SAME: Final = 1e-6  #: Tolerance of equal positions [m, rad].


class AveragedTipMeasurement(NamedTuple):
    """Result of an averaged tip measurement."""

    tip: FloatArray  #: position of the tip, x, y, z [m]
    error: float  #: standard error along x or z, from the scatter of the readings [m]; 0 for few
    readings: int  #: number of valid readings
    frozen: bool  #: whether at least three readings are identical in x and z


class TipMeasurements:
    """Averaged tip measurement at a depth, or during the motion through it."""

    def __init__(self) -> None:
        self._readings: list[tuple[float, ...]] = []

    def take(self, tip: tuple[float, ...], before: float = 0.0) -> None:
        """Add a reading of the tip, x, y, z [m], at a distance before the depth [m]."""
        self._readings.append((*tip, before))

    def average(self, noise: float) -> AveragedTipMeasurement | None:
        """
        Return the mean without outliers, or during motion a fitted line at the depth; or None.

        ``noise`` is the least standard deviation of a measurement in the outlier test [m].
        """
        if not self._readings:
            return None
        rows = np.array(self._readings)
        tips, before = rows[:, :3], rows[:, 3]
        basis = np.ones((len(tips), 1))
        if len(tips) > _FEW and np.ptp(before) > 0.0:
            basis = np.column_stack([basis, before])
        kept: BoolArray = np.ones(len(tips), dtype=np.bool_)
        if len(tips) >= _FEW:
            off = np.abs(tips - basis @ _fitted(basis, tips))
            scatter = DEVIATION_OVER_MEDIAN * np.median(off, axis=0)
            scatter = np.maximum(scatter, noise * sqrt(len(tips)))
            kept = np.asarray((off <= _OUTLIER * scatter).all(axis=1))
            if kept.sum() < basis.shape[1]:
                return AveragedTipMeasurement(_fitted(basis, tips)[0], 0.0, 1, frozen=False)
        tips, basis = tips[kept], basis[kept]
        found, count = np.linalg.lstsq(basis, tips, rcond=None)[0], len(tips)
        left, error = tips - basis @ found, 0.0
        free = count - basis.shape[1]
        if free > 1:
            # The error at the end of a line is twice the error of a mean.
            scale = basis.shape[1] / sqrt(free * count)
            error = float(np.sqrt((left[:, [0, 2]] ** 2).sum(axis=0)).max()) * scale
        across = tips[:, [0, 2]]
        frozen = count >= _FEW and bool((across == across[0]).all())
        tip = found[0]
        if frozen:
            # Exactly, so that measurements can be compared.
            tip[[0, 2]] = across[0]
        return AveragedTipMeasurement(tip, error, count, frozen)


def _fitted(basis: FloatArray, tips: FloatArray) -> FloatArray:
    """Return the median, or a line through the medians of the first and of the last half."""
    if basis.shape[1] == 1:
        return np.median(tips, axis=0)[np.newaxis]
    order = np.argsort(basis[:, 1])
    halves = np.array_split(order, 2)
    (one, other) = (np.median(tips[half], axis=0) for half in halves)
    (at, to) = (float(np.median(basis[half, 1])) for half in halves)
    slope = (other - one) / (to - at) if to > at else np.zeros(3)
    return np.array([one - at * slope, slope])


class GuardedLaw:
    """
    Pass averaged tip measurements to a steering law, and check its setpoints.

    Faults of the tip sensor, slip of the needle, setpoints outside the limits and exceptions of
    the law raise a `NeedleError`. ``depths`` are of the tip measurements [m], shape (n + 1,), and
    ``noise`` is the configured standard deviation of a measurement [m].
    """

    def __init__(
        self,
        law: SteeringLaw,
        depths: FloatArray,
        noise: float,
        settings: ExecutiveSettings,
        events: EventLog,
    ) -> None:
        self.law, self.depths, self.steps = law, depths, len(depths) - 1
        self._noise, self._settings, self._events = noise, settings, events
        limits = settings.limits(float(np.diff(depths).max()))
        self._plans = CheckedPlans(law, self.steps, limits)
        self.expected: TipEstimate | None = None  #: tip at the target depth, new after each plan
        self.measured: AveragedTipMeasurement | None = None  #: last measurement
        self._scatter = 0.0  #: largest deviation of a reading of the tip so far [m]
        self._ahead: float | None = None  #: first depth of the tip less the insertion depth [m]
        self._aside = 0.0  #: first distance of the tip from the guide, which is at zero [m]
        #: Successive missing and identical measurements, and the last measurement [m].
        self._missing = self._same = 0
        self._last = np.full(2, nan)
        self._warned = False
        #: Inputs of the law in their order, and its setpoints: ``aim`` x, z [m]; ``tip``, x, y, z
        #: [m], or None, with the fields of `AveragedTipMeasurement`, ``at`` and ``depth`` as in
        #: `update`; ``plan`` x, z [m], roll [rad].
        self.history: list[dict[str, Any]] = []
        self.report = report_of(law)

    @property
    def step(self) -> int:
        """Number of plans so far: the number of the present depth."""
        return self._plans.step

    @property
    def setpoint(self) -> GuideSetpoint:
        """Last setpoint of guide and roll."""
        return self._plans.setpoint

    def aim(self, target: FloatArray) -> None:
        """Change the target, x and z [m]."""
        with guarded(self.law):
            self.law.aim(target)
        self.report = report_of(self.law)
        self._warned = False
        self.history.append({'aim': target.tolist()})

    def change_target(self, point: tuple[float, float, float]) -> None:
        """Change the target, x, y, z [m], where the depth y stays."""
        x, y, z = point
        if abs(y - self.depths[-1]) > SAME:
            raise ParameterError(
                f'the insertion is to a depth of {1e3 * self.depths[-1]:.2f} mm, got '
                f'{1e3 * y:.2f} mm; ~/stop ends it'
            )
        self.aim(np.array([x, z]))

    def repeat(self, entry: Mapping[str, Any]) -> None:
        if 'aim' in entry:
            self.aim(np.array(entry['aim']))
            return
        tip, error, readings, frozen = (entry[name] for name in AveragedTipMeasurement._fields)
        measured = AveragedTipMeasurement(np.array(tip), error, readings, frozen)
        self._take(measured if tip is not None else None, entry['at'], entry['depth'])

    def update(self, readings: TipMeasurements, at: int, depth: float | None = None) -> None:
        """Pass a measurement at a depth number to the law; it may have no readings."""
        depth = float(self.depths[at]) if depth is None else depth
        first = self._ahead is None
        self._take(readings.average(self._noise), at, depth)
        if at == 0 and self._aside > HIT:
            self._events.add(Severity.WARNING, self._frame())
        if first and self._ahead is not None and abs(self._ahead) > HIT:
            self._events.add(Severity.WARNING, self._zero(depth))

    def _take(self, measured: AveragedTipMeasurement | None, at: int, depth: float) -> None:
        self.measured = measured
        entry: dict[str, Any] = {'tip': None, 'error': 0.0, 'readings': 0, 'frozen': False}
        if measured is not None:
            entry = {**measured._asdict(), 'tip': measured.tip.tolist()}
        self.history.append({**entry, 'at': at, 'depth': depth})
        tip: FloatArray | None = None
        noise = 0.0
        if measured is not None:
            self._check_slip(measured, depth)
            tip = measured.tip[[0, 2]]
            if at == 0:
                self._check_origin(tip)
            self._scatter = max(self._scatter, measured.error * sqrt(measured.readings))
            noise = max(measured.error, self._scatter / sqrt(measured.readings))
        self._check_sensor(tip)
        with guarded(self.law):
            self.law.update(tip, at, noise)
        self.report = report_of(self.law)

    def _check_origin(self, tip: FloatArray) -> None:
        self._aside = float(np.hypot(*tip))
        if self._aside > _FARTHEST:
            raise SteeringFaultError(
                f'the tip is {1e3 * self._aside:.0f} mm beside the guide before the insertion, at '
                f'most {1e3 * _FARTHEST:g} mm: is it in m, and in the frame of the target?'
            )

    def _check_slip(self, measured: AveragedTipMeasurement, depth: float) -> None:
        """Compare the depth of the tip with the insertion depth [m]."""
        ahead = float(measured.tip[1]) - depth
        if self._ahead is None:
            self._ahead = ahead
            if abs(ahead) > self._settings.slip_tolerance:
                raise SteeringFaultError(self._zero(depth))
        slipped = ahead - self._ahead
        if abs(slipped) <= self._settings.slip_tolerance:
            return
        if measured.frozen:
            raise SteeringFaultError(
                f'the tip sensor is frozen: {measured.readings} identical readings'
            )
        raise SteeringFaultError(
            f'the tip is {1e3 * abs(slipped):.2f} mm {"less" if slipped < 0.0 else "more"} deep '
            'than the needle was inserted: the needle slips, or the sensor measures another needle'
        )

    def _zero(self, depth: float) -> str:
        at, most = depth + (self._ahead or 0.0), self._settings.slip_tolerance
        return (
            f'the first measurement of the tip is y = {1e3 * at:.2f} mm at an insertion depth of '
            f'{1e3 * depth:.2f} mm, at most {1e3 * most:g} mm apart are valid (slip_tolerance): '
            'correct the zero of the insertion depth or the origin of the tip sensor'
        )

    def _check_sensor(self, tip: FloatArray | None) -> None:
        if tip is None:
            self._missing += 1
            if self._missing > MOST_MISSING:
                raise SteeringFaultError(f'{self._missing} tip measurements are missing')
            return
        self._missing = 0
        self._same = self._same + 1 if np.array_equal(tip, self._last) else 0
        self._last = tip.copy()
        if self._same >= MOST_SAME:
            raise SteeringFaultError(
                f'the tip sensor is frozen: {self._same + 1} identical measurements'
            )

    def plan(self) -> GuideSetpoint:
        """Plan the next step, and log a new warning."""
        k, to = self.step, self._plans.plan()
        self.expected, self.report = expected_of(self.law), report_of(self.law)
        self.history.append({'plan': [*to]})
        if k < self.steps and self.report.warning and not self._warned:
            self._warned = True
            depth = 1e3 * self.depths[k]
            self._events.add(Severity.WARNING, f'at {depth:.2f} mm: {self.report.warning}')
        return to

    def _frame(self) -> str:
        shift = f'the tip was {1e3 * self._aside:.2f} mm beside the guide before the insertion'
        return f'{shift}: tilt of the guide, or origin of the sensor, whose frame the target has'

    def _half_width(self, measured: AveragedTipMeasurement) -> float:
        """Return half the 95 % interval of a coordinate of a measurement by itself [m]."""
        # Readings of one measurement may have a common error; all measurements show it along y.
        taken = [entry for entry in self.history if entry.get('tip') is not None]
        ahead = [entry['tip'][1] - entry['depth'] for entry in taken]
        half, free = NORMAL * max(measured.error, self._noise), len(ahead) - 1
        if free < 1:
            return half
        return max(half, float(stdtrit(free, 0.975) * np.std(ahead, ddof=1)))

    def outcome(self) -> tuple[str, Severity]:
        """Describe the tip at the end; a warning unless it is within 1 mm with its interval."""
        there, measured = self.expected, self.measured
        if measured is None:
            return 'the needle is at the target depth; its tip is not measured', Severity.WARNING
        tip, half = measured.tip.copy(), np.full(3, self._half_width(measured))
        if there is not None:
            # The law estimates x and z from all measurements; their slow error is that of y, too.
            tip[[0, 2]], half[[0, 2]] = there.mean, there.half_width
            half[1] = half.max()
        x, z = self.report.target
        miss = float(np.linalg.norm(tip - (x, self.depths[-1], z)))
        most = miss + float(half.max())
        words = ', '.join(
            f'{axis} = {1e3 * center:.2f} ± {1e3 * width:.2f} mm'
            for axis, center, width in zip('xyz', tip, half, strict=True)
        )
        line = f'the tip is at {words} (95 %), {1e3 * miss:.2f} mm from the target'
        if self._aside > HIT:
            return f'{line}; {self._frame()}', Severity.WARNING
        if most <= HIT:
            return line, Severity.INFO
        return f'{line}, at most {1e3 * most:.2f} mm', Severity.WARNING
