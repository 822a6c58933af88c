# SPDX-License-Identifier: Apache-2.0
"""
Coverage of the confidence intervals, and efficiency of the estimates.

Many recordings are simulated without ROS: the plant or the indenter with its force sensor follows
a protocol of `needle experiment`. Each recording has its own true parameters. The estimates are
compared with these: the fraction of the 95 % intervals that contain the true value, and the mean
squared error over the Cramer-Rao bound (`benchmarks.bounds`), the limit of any unbiased estimator.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from math import pi, sqrt
import os
from typing import Any, Final, NamedTuple, TypeVar
from unittest import mock

from benchmarks.bounds import friction_truth, RATE, stiffness_truth, Truth
from benchmarks.measure import Bar
from benchmarks.page import Answer, PageSection, Tick
from needle_dynamics import FloatArray, Integrator, NeedleModel, NeedleParameters, ParameterError
from needle_dynamics.simulated.base import BaseMotion, BaseParameters
from needle_dynamics.simulated.force_sensor import ForceSensor, ForceSensorParameters
from needle_dynamics.simulated.indenter import Indenter, IndenterParameters
from needle_dynamics.simulated.plant import Plant
from needle_identification import (
    ESTIMATORS,
    FrictionSettings,
    IdentificationError,
    identify_friction,
    identify_stiffness,
    IndentationRecording,
    ParameterEstimate,
    Recording,
    StiffnessSettings,
)
from needle_insertion.report.paper_tables import FORCE_LEVELS
from needle_ros.process import cores, ONE_THREAD
from needle_ros.process_pool import processes
import numpy as np
from reproduction.population import draw_friction, draw_stiffness
from reproduction.protocol import ExperimentProtocol, indenter_name, PROTOCOLS, START_DEPTH

#: Limits of the coverage, and of the mean squared error over the Cramer-Rao bound.
COVERAGE: Final = (0.93, 0.97)
EFFICIENCY: Final = 1.3

#: Samples of one Latin hypercube, the default of `needle experiment`.
_DRAWN: Final = 20

#: Longest step of the integrator [s]; a straight needle is exact for any step.
_STEP: Final = 1e-3

#: Additional cases are identified in every n-th recording.
_SIDE: Final = 2

_MOST_RECORDINGS: Final = 100_000

_BASIC: Final = ('coulomb', 'viscous')

_Result = TypeVar('_Result')


class CalibrationResult(NamedTuple):
    """Estimate of one parameter from one recording, with the true value."""

    case: str
    name: str
    unit: str
    truth: float
    bound: float
    value: float
    error: float
    low: float
    high: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """
    One parameter over many recordings.

    Attributes
    ----------
    case : str
        Terms, estimator and kind of recording.
    name, unit : str
        Parameter.
    count, undetermined : int
        Number of estimates, and number reported as undetermined.
    coverage : float
        Fraction of the 95 % intervals that contain the true value.
    deviation, error, bias : float
        Root mean square of the errors, root mean square of the standard errors, mean error.
    efficiency : float or None
        Mean squared error over the Cramer-Rao bound; None without a bound.

    """

    case: str
    name: str
    unit: str
    count: int
    undetermined: int
    coverage: float
    deviation: float
    error: float
    bias: float
    efficiency: float | None

    @property
    def holds(self) -> bool:
        """Whether coverage and efficiency are within their limits."""
        return COVERAGE[0] <= self.coverage <= COVERAGE[1] and (
            self.efficiency is None or self.efficiency <= EFFICIENCY
        )

    def cells(self) -> tuple[str, ...]:
        return (
            self.case,
            f'{self.name} [{self.unit}]',
            str(self.count - self.undetermined),
            *(
                ('-',) * 4
                if self.count == self.undetermined
                else (
                    f'{self.coverage:.1%}',
                    f'{self.deviation:.3g}',
                    f'{self.error:.3g}',
                    f'{self.bias:.1g}',
                )
            ),
            '-' if self.efficiency is None else f'{self.efficiency:.2f}',
            'yes' if self.holds else 'NO',
        )


class _Felt(ForceSensor):
    """True wrenches of an insertion, to be read by several sensors."""

    def __init__(self) -> None:
        super().__init__(ForceSensorParameters(rate=RATE), RATE, 0)
        self.wrenches: list[tuple[FloatArray, dict[str, Any]]] = []

    def measure(self, wrench: FloatArray, **how: Any) -> FloatArray:
        self.wrenches.append((wrench, how))
        return wrench

    def read(self, parameters: ForceSensorParameters, seed: int) -> FloatArray:
        """Return the insertion force read by a sensor, shape (n,)."""
        sensor = ForceSensor(parameters, RATE, seed)
        return np.array([sensor.measure(wrench, **how)[1] for wrench, how in self.wrenches])


class RobotMotion(NamedTuple):
    """Time [s], measured depth [m] and velocity [m/s], (n,), and true wrenches of an insertion."""

    time: FloatArray
    depth: FloatArray
    speed: FloatArray
    felt: _Felt


def insertion(parameters: NeedleParameters) -> RobotMotion:
    """Run the friction protocol on a plant in robot mode."""
    protocol = PROTOCOLS['friction']
    base = BaseMotion(BaseParameters(), START_DEPTH, (parameters.minimum_depth, parameters.length))
    start = NeedleModel(parameters).state_at(START_DEPTH, 0.0)
    felt = _Felt()
    plant = Plant(Integrator(parameters, start, _STEP), felt, RATE, base)
    _command(plant, protocol)
    samples = [plant.advance() for _ in range(_samples(protocol))]
    return RobotMotion(
        np.arange(1, len(samples) + 1) / RATE,
        np.array([sample.joint_position for sample in samples]),
        np.array([sample.velocity for sample in samples]),
        felt,
    )


def _samples(protocol: ExperimentProtocol) -> int:
    return round(protocol.duration * RATE) + 1


def _command(machine: Plant | Indenter, protocol: ExperimentProtocol) -> None:
    points = protocol.points
    machine.follow(
        protocol.joints,
        [point.time for point in points],
        [point.positions for point in points],
        [point.effort for point in points],
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class FrictionCase:
    """
    A kind of friction recording, and the settings of its identification.

    Attributes
    ----------
    kind : str
        Kind of recording.
    terms : tuple of str
        Terms of the friction force.
    estimator : str
        One of `ESTIMATORS`.
    speed : bool
        False if the recording has positions only.
    late : bool
        Whether the force has an unknown delay (of either sign) of a fraction of a sample period.
    speed_noise : float
        Standard deviation of white noise of the velocity [m/s].

    """

    kind: str = 'plain'
    terms: tuple[str, ...] = _BASIC
    estimator: str = 'ordinary'
    speed: bool = True
    late: bool = False
    speed_noise: float = 0.0


#: Cases by name, the default one first.
FRICTION_CASES: Final[Mapping[str, FrictionCase]] = {
    '(15)': FrictionCase(),
    **{f'(15), {e}': FrictionCase(estimator=e) for e in ESTIMATORS if e != 'ordinary'},
    '(15), total, noisy speed': FrictionCase(estimator='total', speed_noise=2e-4),
    '(15), positions only': FrictionCase(speed=False),
    '(15), no filter': FrictionCase(kind='unfiltered'),
    '+ offset': FrictionCase(kind='biased', terms=(*_BASIC, 'offset')),
    '+ inertia': FrictionCase(kind='unfiltered', terms=(*_BASIC, 'inertia')),
    '+ inertia, stamps off': FrictionCase(
        kind='unfiltered', terms=(*_BASIC, 'inertia'), late=True
    ),
    '+ direction': FrictionCase(kind='one-way', terms=(*_BASIC, 'direction')),
    '+ break-away': FrictionCase(kind='sticky', terms=(*_BASIC, 'stribeck')),
}


def friction(seed: int, number: int) -> list[CalibrationResult]:
    """Identify a friction recording, every n-th in all cases; seed and number define all noise."""
    drawn = draw_friction(_DRAWN, seed + number // _DRAWN)[number % _DRAWN]
    rng = np.random.default_rng([seed, number])
    cases = dict(list(FRICTION_CASES.items())[: None if number % _SIDE == 0 else 1])
    needles: dict[str, dict[str, Any]] = {
        'plain': {},
        'one-way': {'withdrawal_friction': rng.uniform(0.8, 1.25)},
        'sticky': {'friction_law': 'stribeck', 'breakaway_friction': rng.uniform(1.1, 1.5)},
    }
    motions = {
        name: (needle, insertion(needle))
        for name, changes in needles.items()
        if name in {case.kind for case in cases.values()}
        for needle in [NeedleParameters.preset('phantom', **drawn, **changes)]
    }
    motions['biased'] = motions['unfiltered'] = motions['plain']
    bias = float(rng.uniform(-0.5, 0.5))
    # With a mass term, stamps have an uncertainty of one sample.
    late = float(rng.uniform(-1.0, 1.0)) / RATE
    sensors = dict.fromkeys(motions, ForceSensorParameters())
    sensors['biased'] = ForceSensorParameters(force_bias=bias)
    sensors['unfiltered'] = ForceSensorParameters(filter=0)
    readings = {
        name: motion.felt.read(sensors[name], int(rng.integers(2**32)))
        for name, (_, motion) in motions.items()
        if name in {case.kind for case in cases.values()}
    }
    found: list[CalibrationResult] = []
    for name, case in cases.items():
        needle, motion = motions[case.kind]
        sensor = sensors[case.kind]
        moved = motion.time - (late if case.late else 0.0)
        depth, speed = (np.interp(moved, motion.time, a) for a in (motion.depth, motion.speed))
        speed = speed + case.speed_noise * rng.standard_normal(len(speed))
        settings = FrictionSettings(terms=case.terms, estimator=case.estimator)
        recording = Recording(
            name=f'{name} {number}',
            time=motion.time,
            depth=depth,
            velocity=speed if case.speed else None,
            force=readings[case.kind],
        )
        estimate = identify_friction(recording, settings)
        truth = friction_truth(needle, sensor, motion.time, motion.speed, settings)
        if case.speed_noise:
            # The bound assumes a known velocity.
            truth = {parameter: (value, np.nan) for parameter, (value, _) in truth.items()}
        found += [
            _compared(name, parameter, truth)
            for parameter in (*estimate.parameters, estimate.breakaway, estimate.lag)
            if parameter is not None
        ]
    return found


def _compared(case: str, found: ParameterEstimate, truth: Truth) -> CalibrationResult:
    return CalibrationResult(
        case, found.name, found.unit, *truth[found.name], found.value, found.error, *found.interval
    )


def stiffness(seed: int, number: int) -> list[CalibrationResult]:
    """Identify a stiffness recording, every n-th by all estimators; see `friction`."""
    drawn = draw_stiffness(_DRAWN, seed + number // _DRAWN)[number % _DRAWN]
    entropy = int(np.random.default_rng([seed, number]).integers(2**32))
    protocol = PROTOCOLS['stiffness']
    entries: dict[str, Any] = {indenter_name(name): values for name, values in drawn.items()}
    tissue = IndenterParameters(
        force_levels=FORCE_LEVELS,
        force_rate=float(str(protocol.plant['indenter.force_rate'])),
        **entries,
    )
    sensor = ForceSensorParameters()
    indenter = Indenter(tissue, ForceSensor(sensor, RATE, entropy), RATE, entropy)
    _command(indenter, protocol)
    samples = [indenter.advance() for _ in range(_samples(protocol))]
    position = np.array([sample.position for sample in samples])
    recording = IndentationRecording(
        name=f'stiffness {number}',
        time=np.arange(1, len(samples) + 1) / RATE,
        position=position[:, [0, 2]],
        off_plane=position[:, 1],
        force=np.array([sample.wrench[[0, 2]] for sample in samples]),
    )
    truths = [
        stiffness_truth(matrix, force, sensor, tissue)
        for matrix, force in zip(tissue.matrices, FORCE_LEVELS, strict=True)
    ]
    found: list[CalibrationResult] = []
    for estimator in ESTIMATORS[: None if number % _SIDE == 0 else 1]:
        levels = identify_stiffness(recording, StiffnessSettings(estimator=estimator)).levels
        if len(levels) != len(truths):
            raise IdentificationError(
                f'{recording.name}: {len(levels)} levels found of {len(truths)}'
            )
        for level, truth in zip(levels, truths, strict=True):
            found += [_compared(f'K, {estimator}', level[name], truth) for name in truth]
    return found


def summarized(found: Iterable[CalibrationResult]) -> list[Row]:
    """Combine the estimates of each parameter in each case, in order of first appearance."""
    groups: dict[tuple[str, str], list[CalibrationResult]] = {}
    for one in found:
        groups.setdefault((one.case, one.name), []).append(one)
    cases = list(dict.fromkeys(case for case, _ in groups))
    return [_row(groups[key]) for key in sorted(groups, key=lambda key: cases.index(key[0]))]


def _row(group: list[CalibrationResult]) -> Row:
    first = group[0]
    truth, bound, value, error, low, high = np.array([one[3:] for one in group]).T
    known = np.isfinite(value)
    wrong = value - truth
    if first.unit == 'rad':
        # Directions of a line: modulo half a turn.
        turn = pi * np.round(wrong / pi)
        wrong, low, high = wrong - turn, low - turn, high - turn
    held = (low <= truth) & (truth <= high)
    wrong, bound = wrong[known], bound[known]
    return Row(
        case=first.case,
        name=first.name,
        unit=first.unit,
        count=len(group),
        undetermined=int(np.count_nonzero(~known)),
        coverage=float(held[known].mean()) if known.any() else float('nan'),
        deviation=_root_mean_square(wrong),
        error=_root_mean_square(error[known]),
        bias=float(wrong.mean()) if len(wrong) else float('nan'),
        efficiency=float(np.mean(wrong**2 / bound))
        if len(bound) and np.isfinite(bound).all()
        else None,
    )


def _root_mean_square(values: FloatArray) -> float:
    return sqrt(float(np.mean(values**2))) if len(values) else float('nan')


STUDIES: Final[Mapping[str, Callable[[int, int], list[CalibrationResult]]]] = {
    'friction': friction,
    'stiffness': stiffness,
}


#: Default cases of the studies.
DEFAULT_CASES: Final = ('(15)', 'K, ordinary')


def studied(
    study: Callable[[int, int], list[_Result]], recordings: int, seed: int, workers: int
) -> Iterator[list[_Result]]:
    """Yield the results of a study (seed, number) for many recordings, computed in processes."""
    job = partial(study, seed)
    if workers == 1:
        yield from map(job, range(recordings))
        return
    # The processes use all cores.
    with mock.patch.dict(os.environ, ONE_THREAD), processes(workers) as pool:
        yield from pool.map(job, range(recordings))


def compare(tick: Tick, recordings: int = 1000, seed: int = 2014) -> Answer:
    """Compare the estimates from many recordings with the true values."""
    if not 2 <= recordings <= _MOST_RECORDINGS:
        raise ParameterError(f'--recordings must be in [2, {_MOST_RECORDINGS}], got {recordings}')
    if seed < 0:
        raise ParameterError(f'--seed must be >= 0, got {seed}')
    workers = cores()
    rows: list[Row] = []
    for name, study in STUDIES.items():
        found: list[CalibrationResult] = []
        for number, part in enumerate(studied(study, recordings, seed, workers), 1):
            tick(f'{name}, {number} of {recordings}')
            found += part
        rows += summarized(found)
    wrong = sum(not row.holds for row in rows)
    section = PageSection(
        'Estimates and true values',
        (
            'case',
            'parameter',
            'n',
            'coverage',
            'error made',
            'error given',
            'bias',
            'over bound',
            'holds',
        ),
        [row.cells() for row in rows],
        f'{recordings} recordings of each kind, one in {_SIDE} for additional cases, '
        f'seed {seed}. {len(rows) - wrong} of {len(rows)} rows hold: coverage of the 95 % '
        f'intervals from {COVERAGE[0]:.0%} to {COVERAGE[1]:.0%}, mean squared error at most '
        f'{EFFICIENCY:g} times the Cramer-Rao bound. The bars are on the rows of the default '
        f'cases, {" and ".join(DEFAULT_CASES)}, that have a bound.',
    )
    judged = [row for row in rows if row.case in DEFAULT_CASES and row.efficiency is not None]
    coverage = [100.0 * row.coverage for row in judged]
    low, high = (100.0 * limit for limit in COVERAGE)
    bars = [
        Bar('lowest coverage', min(coverage), low, '%', at_least=True),
        Bar('highest coverage', max(coverage), high, '%'),
        Bar(
            'largest mean squared error over its bound',
            max(row.efficiency for row in judged if row.efficiency is not None),
            EFFICIENCY,
        ),
    ]
    return [section], bars
