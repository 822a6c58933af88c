"""
Whether the intervals hold the truth as often as they say, and how near the best the errors are.

Many recordings are made with the plant, the end-effector and the force sensor of the stand-ins,
without ROS, along the protocols of `needle experiment`; each has true parameters of its own. All
that identification reports of each is compared with the truth: the share of 95 % intervals that
hold it, and the mean squared error over the Cramer-Rao bound. No unbiased estimator stays below
the bound, which takes the noise of the readings for what it is in the stand-in: white at the rate
of the sensor, then filtered, then read at the rate of the recording.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial
import json
from math import atan2, pi, sqrt
from multiprocessing import get_context
import os
import sys
import time
from typing import Any, Final, NamedTuple, TypeAlias
from unittest import mock

from benchmarks.measure import environment
from needle_dynamics import (
    FloatArray,
    ForceSensor,
    ForceSensorParameters,
    Indenter,
    IndenterParameters,
    Integrator,
    NeedleModel,
    NeedleParameters,
    ParameterError,
)
from needle_dynamics.simulated.plant import BaseMotion, BaseParameters, Plant
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
from needle_identification.friction.terms import columns_of, regressors
from needle_insertion.experiment.population import draw_friction, draw_stiffness
from needle_insertion.experiment.protocol import (
    DIRECTIONS,
    HOLD_TIME,
    indenter_name,
    Protocol,
    PROTOCOLS,
    START_DEPTH,
)
from needle_insertion.paper.tables import FORCE_LEVELS
from needle_insertion.report.text import table
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solveh_banded
from scipy.signal import butter, sosfilt
from tqdm import tqdm

#: Samples per second of the recordings [Hz].
RATE: Final = 250.0

#: Share of intervals that must hold the truth, and error over the bound that is good enough.
COVERAGE: Final = (0.93, 0.97)
EFFICIENCY: Final = 1.3

#: Draws of one hypercube: what `needle experiment` draws by default.
_DRAWN: Final = 20

#: Longest step of the integrator [s]: a straight needle is exact at any.
_STEP: Final = 1e-3

#: Cases beside the default ones are identified in every so many recordings.
_SIDE: Final = 2

#: Recordings that a process takes at a time.
_CHUNK: Final = 5

#: Readings further apart have independent noise.
_REACH: Final = 24

_MOST_RECORDINGS: Final = 100_000

_BASIC: Final = ('coulomb', 'viscous')

#: Truth and Cramer-Rao bound of the variance by parameter; nan where there is none.
_Truth: TypeAlias = Mapping[str, tuple[float, float]]


class Found(NamedTuple):
    """One parameter from one recording beside the truth."""

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
        Terms, estimator and what is special about the recordings.
    name, unit : str
        The parameter.
    count, undetermined : int
        Estimates, and those of them that were said not to be determined.
    coverage : float
        Share of the 95 % intervals that hold the truth.
    deviation, error, bias : float
        Root mean square of the error made, of the standard errors given, and the mean error.
    efficiency : float or None
        Mean squared error over the Cramer-Rao bound; None where there is no bound.

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
        """Whether coverage and efficiency are as wanted."""
        return COVERAGE[0] <= self.coverage <= COVERAGE[1] and (
            self.efficiency is None or self.efficiency <= EFFICIENCY
        )

    def cells(self) -> tuple[str, ...]:
        """Return the cells of a table."""
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
    """Keeps what a sensor would feel, for any number of sensors to read."""

    def __init__(self) -> None:
        super().__init__(ForceSensorParameters(rate=RATE), RATE, 0)
        self.wrenches: list[tuple[FloatArray, dict[str, Any]]] = []

    def measure(self, wrench: FloatArray, **how: Any) -> FloatArray:
        self.wrenches.append((wrench, how))
        return wrench

    def read(self, parameters: ForceSensorParameters, seed: int) -> FloatArray:
        """Return the insertion force that a sensor reads, shape (n,)."""
        sensor = ForceSensor(parameters, RATE, seed)
        return np.array([sensor.measure(wrench, **how)[1] for wrench, how in self.wrenches])


class Motion(NamedTuple):
    """A base in robot mode: time, measured motion, shape (n,) each, and what the sensor feels."""

    time: FloatArray
    depth: FloatArray
    speed: FloatArray
    felt: _Felt


def insertion(parameters: NeedleParameters) -> Motion:
    """Run the friction protocol on the plant in robot mode."""
    protocol = PROTOCOLS['friction']
    base = BaseMotion(BaseParameters(), START_DEPTH, (parameters.minimum_depth, parameters.length))
    start = NeedleModel(parameters).state_at(START_DEPTH, 0.0)
    felt = _Felt()
    plant = Plant(Integrator(parameters, start, _STEP), felt, RATE, base)
    _command(plant, protocol)
    samples = [plant.advance() for _ in range(_samples(protocol))]
    return Motion(
        np.arange(1, len(samples) + 1) / RATE,
        np.array([sample.joint_position for sample in samples]),
        np.array([sample.speed for sample in samples]),
        felt,
    )


def _samples(protocol: Protocol) -> int:
    return round(protocol.duration * RATE) + 1


def _command(machine: Plant | Indenter, protocol: Protocol) -> None:
    points = protocol.points
    machine.follow(
        protocol.joints,
        [point.time for point in points],
        [point.positions for point in points],
        [point.effort for point in points],
    )


def sensor_lag(parameters: ForceSensorParameters) -> float:
    """Return by how much the filters of the sensor delay a slow force [s]."""
    late = 0.0
    for cutoff in parameters.cutoffs:
        b, a = butter(2, cutoff, fs=parameters.rate)
        order = np.arange(3)
        late += float(b @ order / b.sum() - a @ order / a.sum()) / parameters.rate
    return late


def reading_noise(parameters: ForceSensorParameters, axis: int) -> FloatArray:
    """
    Return the covariance of the noise of readings by the distance of two.

    White noise at the rate of the sensor passes its filters; every so many samples one is read
    and rounded.

    Parameters
    ----------
    parameters : ForceSensorParameters
        The sensor.
    axis : int
        Force x y z, torque x y z.

    Returns
    -------
    ndarray, shape (_REACH,)
        Covariance of readings 0, 1, 2, ... apart [N^2].

    """
    every = round(parameters.rate / RATE)
    response = np.zeros(2 * _REACH * every)
    response[0] = parameters.per_axis('noise')[axis]
    for cutoff in parameters.cutoffs:
        response = sosfilt(butter(2, cutoff, fs=parameters.rate, output='sos'), response)
    later = [response[every * k :] for k in range(_REACH)]
    covariance = np.array([response[: len(part)] @ part for part in later])
    covariance[0] += parameters.per_axis('resolution')[axis] ** 2 / 12.0
    return covariance


def information(regressors: FloatArray, noise: FloatArray, used: NDArray[np.bool_]) -> FloatArray:
    """
    Return Fisher's information on the coefficients of regressors.

    Parameters
    ----------
    regressors : ndarray, shape (n, k)
        Regressors at even times.
    noise : ndarray, shape (m,)
        Covariance of the noise by distance, zero beyond.
    used : ndarray of bool, shape (n,)
        What is known of these.

    Returns
    -------
    ndarray, shape (k, k)
        Its inverse is the Cramer-Rao bound of normal noise.

    """
    at = np.flatnonzero(used)
    banded = np.zeros((len(noise), len(at)))
    for row in range(min(len(noise), len(at))):
        apart = at[row:] - at[: len(at) - row]
        near = apart < len(noise)
        banded[row, : len(apart)][near] = noise[apart[near]]
    x = regressors[at]
    return np.asarray(x.T @ solveh_banded(banded, x, lower=True))


@dataclass(frozen=True, slots=True, kw_only=True)
class FrictionCase:
    """
    What is identified from which recording.

    Attributes
    ----------
    stand_in : str
        Which recording.
    terms : tuple of str
        Terms of the friction force.
    estimator : str
        One of `ESTIMATORS`.
    speed : bool
        False if the recording has positions only.
    late : bool
        Whether the force is late, or early, by an unknown part of a sample period.
    speed_noise : float
        Standard deviation of white noise of the speed [m/s], which the stand-in has none of.

    """

    stand_in: str = 'plain'
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
    '(15), no filter': FrictionCase(stand_in='unfiltered'),
    '+ offset': FrictionCase(stand_in='biased', terms=(*_BASIC, 'offset')),
    '+ inertia': FrictionCase(stand_in='unfiltered', terms=(*_BASIC, 'inertia')),
    '+ inertia, stamps off': FrictionCase(
        stand_in='unfiltered', terms=(*_BASIC, 'inertia'), late=True
    ),
    '+ direction': FrictionCase(stand_in='one-way', terms=(*_BASIC, 'direction')),
    '+ break-away': FrictionCase(stand_in='sticky', terms=(*_BASIC, 'stribeck')),
}


def friction(seed: int, number: int) -> list[Found]:
    """
    Identify one recording of friction, every so many in all cases.

    Parameters
    ----------
    seed, number : int
        Seed of the study and number of the recording; together they seed all that is random.

    Returns
    -------
    list of Found
        Every parameter of every case.

    """
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
        if name in {case.stand_in for case in cases.values()}
        for needle in [NeedleParameters.preset('phantom', **drawn, **changes)]
    }
    motions['biased'] = motions['unfiltered'] = motions['plain']
    bias = float(rng.uniform(-0.5, 0.5))
    # Stamps are trusted to one sample, no better, where a mass is asked for.
    late = float(rng.uniform(-1.0, 1.0)) / RATE
    sensors = dict.fromkeys(motions, ForceSensorParameters())
    sensors['biased'] = ForceSensorParameters(force_bias=bias)
    sensors['unfiltered'] = ForceSensorParameters(filter=0)
    readings = {
        name: motion.felt.read(sensors[name], int(rng.integers(2**32)))
        for name, (_, motion) in motions.items()
        if name in {case.stand_in for case in cases.values()}
    }
    found: list[Found] = []
    for name, case in cases.items():
        needle, motion = motions[case.stand_in]
        sensor = sensors[case.stand_in]
        moved = motion.time - (late if case.late else 0.0)
        depth, speed = (np.interp(moved, motion.time, a) for a in (motion.depth, motion.speed))
        speed = speed + case.speed_noise * rng.standard_normal(len(speed))
        settings = FrictionSettings(terms=case.terms, estimator=case.estimator)
        recording = Recording(
            name=f'{name} {number}',
            time=motion.time,
            depth=depth,
            speed=speed if case.speed else None,
            force=readings[case.stand_in],
        )
        estimate = identify_friction(recording, settings)
        truth = friction_truth(needle, sensor, motion, settings)
        if case.speed_noise:
            # The bound takes the speed for known.
            truth = {parameter: (value, np.nan) for parameter, (value, _) in truth.items()}
        found += [
            _compared(name, parameter, truth)
            for parameter in (*estimate.parameters, estimate.breakaway, estimate.lag)
            if parameter is not None
        ]
    return found


def friction_truth(
    needle: NeedleParameters,
    sensor: ForceSensorParameters,
    motion: Motion,
    settings: FrictionSettings,
) -> _Truth:
    """
    Return true parameters and Cramer-Rao bounds.

    The bound takes every reading while the needle counts as moving, with the noise of the sensor
    as its filters leave it, and as unknown the coefficients of the terms: what starts, stops and
    lag cost an estimator is not in it.
    """
    coulomb, viscous = needle.coulomb_friction, needle.viscous_friction
    breakaway = needle.breakaway_friction if needle.friction_law == 'stribeck' else 1.0
    true = {
        'coulomb_friction': coulomb,
        'viscous_friction': viscous,
        'offset': float(sensor.per_axis('bias')[1]),
        'moving_mass': needle.moving_mass,
        'withdrawal_coulomb': (needle.withdrawal_friction - 1.0) * coulomb,
        'withdrawal_viscous': (needle.withdrawal_friction - 1.0) * viscous,
        'withdrawal_friction': needle.withdrawal_friction,
        'stribeck_friction': (breakaway - 1.0) * coulomb,
        'breakaway_friction': breakaway,
        'breakaway_force': breakaway * coulomb,
        'lag': sensor_lag(sensor) - needle.moving_mass / viscous,
    }
    names = [column.name for column in columns_of(settings.terms)]
    speed = motion.speed
    acceleration = np.gradient(speed, motion.time)
    known = information(
        regressors(speed, acceleration, settings.terms, settings),
        reading_noise(sensor, 1),
        np.abs(speed) > settings.moving_speed,
    )
    bound = dict(zip(names, np.diag(np.linalg.inv(known)).tolist(), strict=True))
    # No reading tells a mass from a lag of unknown size.
    bound.pop('moving_mass', None)
    return {name: (value, bound.get(name, np.nan)) for name, value in true.items()}


def _compared(case: str, found: ParameterEstimate, truth: _Truth) -> Found:
    return Found(
        case, found.name, found.unit, *truth[found.name], found.value, found.error, *found.interval
    )


def stiffness(seed: int, number: int) -> list[Found]:
    """
    Identify one recording of stiffness, every so many by all estimators.

    Parameters
    ----------
    seed, number : int
        Seed of the study and number of the recording; together they seed all that is random.

    Returns
    -------
    list of Found
        Every parameter of every level, by estimator.

    """
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
    found: list[Found] = []
    for estimator in ESTIMATORS[: None if number % _SIDE == 0 else 1]:
        levels = identify_stiffness(recording, StiffnessSettings(estimator=estimator)).levels
        if len(levels) != len(truths):
            raise IdentificationError(
                f'{recording.name}: {len(levels)} levels found of {len(truths)}'
            )
        for level, truth in zip(levels, truths, strict=True):
            found += [_compared(f'K, {estimator}', level[name], truth) for name in truth]
    return found


def stiffness_truth(
    matrix: FloatArray, force: float, sensor: ForceSensorParameters, tissue: IndenterParameters
) -> _Truth:
    """
    Return true parameters of one level and Cramer-Rao bounds.

    The bound takes all readings of all holds, of force and position, with their noise, and the
    zeros of both for known.
    """
    angles = 2.0 * pi / DIRECTIONS * np.arange(DIRECTIONS)
    forces = force * np.column_stack([np.cos(angles), np.sin(angles)])
    displacement = np.linalg.solve(matrix, forces.T).T
    constant = np.ones((round(RATE * HOLD_TIME), 1))
    held = np.ones(len(constant), dtype=np.bool_)
    of_force = 1.0 / information(constant, reading_noise(sensor, 0), held).item()
    of_position = (tissue.position_noise**2 + tissue.encoder_resolution**2 / 12.0) / len(constant)
    noise = of_force * np.eye(2) + of_position * matrix @ matrix.T
    covariance = np.kron(noise, np.linalg.inv(displacement.T @ displacement))
    true = _parts(matrix)
    # Differences along each entry give the gradients, exact to the step squared.
    step = 1e-3
    changes = []
    for entry in np.eye(4).reshape(4, 2, 2):
        more, less = _parts(matrix + step * entry), _parts(matrix - step * entry)
        changes.append([(more[name] - less[name]) / (2.0 * step) for name in true])
    gradients = np.array(changes).T
    bounds = np.einsum('ni,ij,nj->n', gradients, covariance, gradients)
    return {
        name: (value, float(bound))
        for (name, value), bound in zip(true.items(), bounds, strict=True)
    }


def _parts(matrix: FloatArray) -> dict[str, float]:
    """Return what is reported of a stiffness matrix, by name."""
    symmetric = (matrix + matrix.T) / 2.0
    half, shear = (matrix[0, 0] - matrix[1, 1]) / 2.0, symmetric[0, 1]
    mean, radius = np.trace(matrix) / 2.0, np.hypot(half, shear)
    curl = matrix[1, 0] - matrix[0, 1]
    values = {
        **dict(zip(('k_xx', 'k_xz', 'k_zx', 'k_zz'), matrix.ravel(), strict=True)),
        'curl': curl,
        'spring': abs(curl) / sqrt(2.0) / np.linalg.norm(symmetric),
        'principal_stiffness_1': mean + radius,
        'principal_stiffness_2': mean - radius,
        'principal_angle': atan2(shear, half) / 2.0,
        'tissue_stiffness': matrix[1, 1] / StiffnessSettings().contact_length,
    }
    return {name: float(value) for name, value in values.items()}


def summarized(found: Iterable[Found]) -> list[Row]:
    """
    Put the estimates of each parameter in each case together.

    Parameters
    ----------
    found : iterable of Found
        Estimates, those of a parameter in a case in any order.

    Returns
    -------
    list of Row
        Case by case, in the order in which they first come.

    """
    groups: dict[tuple[str, str], list[Found]] = {}
    for one in found:
        groups.setdefault((one.case, one.name), []).append(one)
    cases = list(dict.fromkeys(case for case, _ in groups))
    return [_row(groups[key]) for key in sorted(groups, key=lambda key: cases.index(key[0]))]


def _row(group: list[Found]) -> Row:
    first = group[0]
    truth, bound, value, error, low, high = np.array([one[3:] for one in group]).T
    known = np.isfinite(value)
    wrong = value - truth
    if first.unit == 'rad':
        # Directions of a line: half a turn makes no difference.
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


_STUDIES: Final[Mapping[str, Callable[[int, int], list[Found]]]] = {
    'friction': friction,
    'stiffness': stiffness,
}


def studied(
    study: Callable[[int, int], list[Found]], recordings: int, seed: int, workers: int
) -> Iterator[list[Found]]:
    """
    Identify many recordings on all cores.

    Parameters
    ----------
    study : callable
        `friction` or `stiffness`.
    recordings, seed : int
        How many, and the seed of the study: the same seed gives the same recordings.
    workers : int
        Processes; 1 for none beside this one.

    Yields
    ------
    list of Found
        What each recording gave, in order.

    """
    job = partial(study, seed)
    if workers == 1:
        yield from map(job, range(recordings))
        return
    # Processes share the cores already.
    with (
        mock.patch.dict(os.environ, OPENBLAS_NUM_THREADS='1', OMP_NUM_THREADS='1'),
        ProcessPoolExecutor(workers, mp_context=get_context('spawn')) as pool,
    ):
        yield from pool.map(job, range(recordings), chunksize=_CHUNK)


def run(options: argparse.Namespace) -> int:
    """
    Study both kinds of recordings and print the table.

    Returns
    -------
    int
        0, whatever was found.

    Raises
    ------
    ParameterError
        If a number is out of range.

    """
    if not 2 <= options.recordings <= _MOST_RECORDINGS:
        raise ParameterError(
            f'--recordings must be in [2, {_MOST_RECORDINGS}], got {options.recordings}'
        )
    if options.seed < 0:
        raise ParameterError(f'--seed must be >= 0, got {options.seed}')
    begin = time.perf_counter()
    workers = os.cpu_count() or 1
    rows: list[Row] = []
    for name, study in _STUDIES.items():
        recordings = studied(study, options.recordings, options.seed, workers)
        shown = tqdm(recordings, total=options.recordings, desc=name, disable=None, leave=False)
        rows += summarized(found for recording in shown for found in recording)
    spent = time.perf_counter() - begin
    if options.json:
        document = {
            'recordings': options.recordings,
            'seed': options.seed,
            'seconds': round(spent, 1),
            'rows': [{**asdict(row), 'holds': row.holds} for row in rows],
        }
        sys.stdout.write(f'{json.dumps(document, indent=2)}\n')
        return 0
    heads = (
        'case',
        'parameter',
        'n',
        'coverage',
        'error made',
        'error given',
        'bias',
        'over bound',
        'holds',
    )
    wrong = sum(not row.holds for row in rows)
    sys.stdout.write(
        f'{environment()}\n\n{table([row.cells() for row in rows], heads)}\n\n'
        f'{options.recordings} recordings of each kind, seed {options.seed}, '
        f'one in {_SIDE} for cases beside the default: '
        f'{len(rows) - wrong} of {len(rows)} lines hold: coverage of the 95 % intervals within '
        f'{COVERAGE[0]:.0%} to {COVERAGE[1]:.0%}, mean squared error at most {EFFICIENCY:g} times '
        f'the Cramer-Rao bound\n{spent:.0f} s on {workers} cores\n'
    )
    return 0
