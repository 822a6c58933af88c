# SPDX-License-Identifier: Apache-2.0
"""
Coverage and suggested terms for recordings of an independent simulator, with many kinds of noise.

The plant, its sensor and its protocol are not used: strokes of random speed and length in both
directions with rests at some of the reversals, Coulomb and viscous friction with optional effects,
and noise on force and motion. Results are the coverage of the intervals for autocorrelated noise,
and the correctness of the suggested terms. Fifteen further kinds (`FURTHER`) have errors that the
models of the noise do not contain: their intervals must hold, or a warning must name the cause.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import exp, pi, sqrt
from typing import Final, NamedTuple

from benchmarks.calibration import COVERAGE, studied
from benchmarks.disturbances import (
    aliased,
    Change,
    counted,
    drive_play,
    error_by_speed,
    jitter,
    low_pass,
    lugre,
    more_force,
    MotionSamples,
    outliers,
    pink,
    START_DEPTH,
    sticking,
    with_play,
)
from benchmarks.measure import Bar
from benchmarks.page import Answer, PageSection, Tick
from needle_dynamics import FloatArray
from needle_identification import FrictionSettings, identify_friction, Recording
from needle_ros.process import cores
import numpy as np
from scipy.signal import lfilter

#: Samples in the simulation of the motion per sample of the recording.
_FINER: Final = 4

#: Ranges of stroke acceleration [m/s^2] and duration [s].
_ACCELERATIONS: Final = (0.04, 0.15)
_STROKES: Final = (0.6, 1.8)

#: Duration of rests, at a third of the reversals [s].
_RESTS: Final = (0.1, 0.5)
_REST_SHARE: Final = 0.33


#: Parameters whose intervals are evaluated.
_JUDGED: Final = ('coulomb_friction', 'viscous_friction')


@dataclass(frozen=True, slots=True, kw_only=True)
class NoiseKind:
    """
    A kind of recording: noise of force and motion, and true effects in addition to (15).

    Attributes
    ----------
    white, colored, walk, mains : float
        Standard deviation of white and of exponentially correlated noise of the force [N], of the
        steps of a random walk [N / sqrt(s)], and amplitude of a hum of 50 Hz [N].
    memory : float
        Correlation time of colored noise [s].
    counts : float
        Resolution of the force [N].
    rate, duration : float
        Samples per second, and length [s].
    speed_noise, position_noise, position_counts : float
        White noise of velocity [m/s] and position [m], and resolution of the position [m].
    speed_filter : float
        Time constant of a first-order low-pass filter of the velocity by the driver [s].
    positions_only : bool
        Whether the recording has no velocities.
    speeds : (float, float)
        Range of stroke speeds [m/s], uniform in the logarithm.
    truth : mapping of str to float
        Coefficients of additional terms by parameter name.
    plant, sensor : function of samples, true parameters and a generator; or None
        Change of the simulated samples before noise is added, and of the recorded samples after.

    """

    white: float = 0.02
    colored: float = 0.0
    walk: float = 0.0
    mains: float = 0.0
    memory: float = 0.0
    counts: float = 0.0
    rate: float = 250.0
    duration: float = 40.0
    speed_noise: float = 0.0
    position_noise: float = 0.0
    position_counts: float = 1e-6
    speed_filter: float = 0.0
    positions_only: bool = False
    speeds: tuple[float, float] = (2e-3, 15e-3)
    truth: Mapping[str, float] = field(default_factory=dict)
    plant: Change | None = None
    sensor: Change | None = None


def recorded(
    kind: NoiseKind, rng: np.random.Generator, name: str = ''
) -> tuple[Recording, Mapping[str, float]]:
    """Simulate a recording, with its true parameters by name; `rng` draws strokes and noise."""
    truth = {
        'coulomb_friction': rng.uniform(0.3, 0.8),
        'viscous_friction': rng.uniform(200.0, 400.0),
        **kind.truth,
    }
    step = 1.0 / (kind.rate * _FINER)
    speed = _strokes(rng, kind.duration, step, kind.speeds)
    travel = np.concatenate([[0.0], np.cumsum(0.5 * step * (speed[1:] + speed[:-1]))])
    time = np.asarray(np.arange(len(speed)) * step, dtype=np.float64)
    made = MotionSamples(time, START_DEPTH + travel, speed, _force(truth, time, speed))
    if kind.plant:
        made = kind.plant(made, truth, rng)
    if kind.speed_filter:
        made = made._replace(speed=low_pass(made.speed, kind.speed_filter / step))
    time, depth, speed, force = (values[::_FINER] for values in made)
    n = len(time)
    depth = depth + kind.position_noise * rng.standard_normal(n)
    depth = counted(depth, kind.position_counts)
    speed = speed + (0.0 if kind.positions_only else kind.speed_noise * rng.standard_normal(n))
    force = counted(force + _noise(kind, rng, n), kind.counts)
    read = MotionSamples(time, depth, speed, force)
    if kind.sensor:
        read = kind.sensor(read, truth, rng)
    recording = Recording(
        name=name or 'noise',
        time=read.time,
        depth=read.depth,
        velocity=None if kind.positions_only else read.speed,
        force=read.force,
    )
    return recording, truth


def _strokes(
    rng: np.random.Generator, duration: float, step: float, speeds_between: tuple[float, float]
) -> FloatArray:
    """Return the velocity of strokes in both directions."""
    corners, speeds = [0.0, 0.5], [0.0, 0.0]
    sign = 1.0
    while corners[-1] < duration:
        speed = sign * exp(rng.uniform(*np.log(speeds_between)))
        ramp = abs(speed) / rng.uniform(*_ACCELERATIONS)
        for length, then in ((ramp, speed), (rng.uniform(*_STROKES), speed), (ramp, 0.0)):
            corners.append(corners[-1] + length)
            speeds.append(then)
        if rng.random() < _REST_SHARE:
            corners.append(corners[-1] + rng.uniform(*_RESTS))
            speeds.append(0.0)
        sign = -sign
    return np.asarray(np.interp(np.arange(0.0, duration, step), corners, speeds))


def _force(truth: Mapping[str, float], time: FloatArray, speed: FloatArray) -> FloatArray:
    """Return the force; at rest, the residual friction, a fraction of Coulomb friction."""
    sign = np.sign(speed)
    sign[speed == 0.0] = 0.3
    force = truth['coulomb_friction'] * sign + truth['viscous_friction'] * speed
    force += truth.get('offset', 0.0) + truth.get('force_drift', 0.0) * time
    force += truth.get('stribeck_friction', 0.0) * sign * np.exp(-((speed / 1e-3) ** 2))
    out = speed < 0.0
    force += truth.get('withdrawal_coulomb', 0.0) * np.where(out, -1.0, 0.0)
    force += truth.get('withdrawal_viscous', 0.0) * np.where(out, speed, 0.0)
    return np.asarray(force)


def _noise(kind: NoiseKind, rng: np.random.Generator, n: int) -> FloatArray:
    noise = kind.white * rng.standard_normal(n)
    if kind.colored:
        kept = exp(-1.0 / (kind.rate * kind.memory))
        steps = kind.colored * sqrt(1.0 - kept**2) * rng.standard_normal(n)
        steps[0] /= sqrt(1.0 - kept**2)
        noise += lfilter([1.0], [1.0, -kept], steps)
    noise += np.cumsum(kind.walk / sqrt(kind.rate) * rng.standard_normal(n))
    phase = rng.uniform(0.0, 2.0 * pi)
    noise += kind.mains * np.sin(2.0 * pi * 50.0 * np.arange(n) / kind.rate + phase)
    return np.asarray(noise)


@dataclass(frozen=True, slots=True, kw_only=True)
class NoiseRow:
    """
    A row of the table.

    Attributes
    ----------
    kind : NoiseKind
        NoiseKind of recording.
    terms : tuple of str
        Terms in addition to Coulomb and viscous friction.
    effect : str
        True term that is missing in the fit; '' for none.
    is_hard : bool
        Whether noise is so slow that intervals may be wide.
    cause : str
        Words of a warning that names the cause; '' for none.
    also : str
        Term that describes the error as well: no false advice.

    """

    kind: NoiseKind
    terms: tuple[str, ...] = ()
    effect: str = ''
    is_hard: bool = False
    cause: str = ''
    also: str = ''


#: Rows by name: first kinds of noise, then effects without their term.
LINES: Final[Mapping[str, NoiseRow]] = {
    'white': NoiseRow(kind=NoiseKind()),
    'AR(1), 20 ms': NoiseRow(kind=NoiseKind(white=0.005, colored=0.03, memory=0.02)),
    'AR(1), 0.2 s': NoiseRow(kind=NoiseKind(white=0.005, colored=0.03, memory=0.2)),
    'AR(1), 1 s': NoiseRow(kind=NoiseKind(white=0.005, colored=0.03, memory=1.0), is_hard=True),
    'random walk': NoiseRow(kind=NoiseKind(white=0.005, walk=0.02), is_hard=True),
    'mains, 250 Hz': NoiseRow(kind=NoiseKind(white=0.005, mains=0.03)),
    'mains, 100 Hz': NoiseRow(kind=NoiseKind(white=0.005, mains=0.03, rate=100.0)),
    'drift and its term': NoiseRow(kind=NoiseKind(truth={'force_drift': 0.01}), terms=('drift',)),
    'offset and its term': NoiseRow(kind=NoiseKind(truth={'offset': 0.2}), terms=('offset',)),
    'counts': NoiseRow(kind=NoiseKind(white=0.01, counts=0.02)),
    'positions only, counts': NoiseRow(kind=NoiseKind(positions_only=True)),
    'positions only, 10 um': NoiseRow(kind=NoiseKind(positions_only=True, position_counts=1e-5)),
    'positions only, 1 um': NoiseRow(
        kind=NoiseKind(positions_only=True, position_noise=1e-6, position_counts=0.0)
    ),
    'noisy speed, 1 mm/s': NoiseRow(kind=NoiseKind(speed_noise=1e-3)),
    'filtered speed, 32 ms': NoiseRow(kind=NoiseKind(speed_filter=0.032)),
    'offset': NoiseRow(kind=NoiseKind(truth={'offset': 0.02}), effect='offset'),
    'drift': NoiseRow(kind=NoiseKind(truth={'force_drift': 1e-3}), effect='drift'),
    'direction': NoiseRow(
        kind=NoiseKind(truth={'withdrawal_coulomb': 0.02, 'withdrawal_viscous': 10.0}),
        effect='direction',
    ),
    'Stribeck': NoiseRow(
        kind=NoiseKind(truth={'stribeck_friction': 0.3}, speeds=(5e-4, 15e-3)), effect='stribeck'
    ),
}


def _with_change(change: Change, effect: str = '', cause: str = '') -> NoiseRow:
    return NoiseRow(kind=NoiseKind(plant=change), effect=effect, cause=cause)


#: Errors that the models of the noise do not contain, by name.
FURTHER: Final[Mapping[str, NoiseRow]] = {
    '1/f noise': NoiseRow(kind=NoiseKind(white=0.005, sensor=pink), cause='noise of the force'),
    'counts that stick': NoiseRow(kind=NoiseKind(sensor=sticking)),
    'noise by speed': NoiseRow(
        kind=NoiseKind(white=0.004, sensor=error_by_speed), cause='noise depends on the speed'
    ),
    # Their mean of 6 mN is an offset.
    'outliers of one sign': NoiseRow(
        kind=NoiseKind(sensor=outliers), cause='outliers', also='offset'
    ),
    'play of the encoder': NoiseRow(
        kind=NoiseKind(
            positions_only=True,
            plant=lambda made, _truth, _rng: made._replace(depth=with_play(2e-5, made.depth)),
        )
    ),
    'friction by depth': _with_change(
        more_force(lambda at: np.sign(at.speed) * 2.0 * (at.depth - START_DEPTH)), 'length'
    ),
    'decaying zero': _with_change(more_force(lambda at: 0.15 * np.exp(-at.time / 8.0)), 'decay'),
    'aliased harmonics': _with_change(aliased, cause='noise of the force'),
    'stamps and drops': NoiseRow(kind=NoiseKind(sensor=jitter)),
    'low-pass of 8 Hz': _with_change(
        lambda made, _truth, _rng: made._replace(
            force=low_pass(made.force, 1.0 / (2.0 * pi * 8.0 * made.time[1]))
        ),
        cause='low-pass',
    ),
    'gravity': _with_change(more_force(lambda at: 5.0 * (at.depth - START_DEPTH)), 'spring'),
    'filtered velocity': NoiseRow(
        kind=NoiseKind(speed_filter=0.032), cause='behind the positions: a filter'
    ),
    'LuGre': NoiseRow(kind=NoiseKind(plant=lugre, speeds=(5e-4, 15e-3)), effect='stribeck'),
    'play of the drive': _with_change(drive_play, cause='play'),
    'mass of 20 kg': _with_change(
        more_force(lambda at: 20.0 * np.gradient(at.speed, at.time)), cause='term inertia'
    ),
}

#: Smallest fraction of correct suggestions, and largest fraction of false suggestions.
RIGHT, FALSE = 0.90, 0.02


class NoiseOutcome(NamedTuple):
    """
    Result of one recording.

    Attributes
    ----------
    line : str
        Row of the table.
    errors, given, held : tuple
        For mu_s and mu_v: error, standard error, and whether the interval contains the true value.
    warned : bool
        Whether a warning reports autocorrelated noise.
    advised : str
        Suggested terms.
    causes : tuple of str
        Words of `FURTHER` that a warning contains.

    """

    line: str
    errors: tuple[float, ...]
    given: tuple[float, ...]
    held: tuple[bool, ...]
    warned: bool
    advised: str
    causes: tuple[str, ...]


def outcomes(seed: int, number: int) -> list[NoiseOutcome]:
    """Identify one recording of each kind; seed and number define the noise."""
    return [
        _outcome(name, line, np.random.default_rng([seed, number, k]))
        for k, (name, line) in enumerate({**LINES, **FURTHER}.items())
    ]


def _outcome(name: str, line: NoiseRow, rng: np.random.Generator) -> NoiseOutcome:
    recording, truth = recorded(line.kind, rng, name)
    settings = FrictionSettings(terms=('coulomb', 'viscous', *line.terms))
    found = identify_friction(recording, settings)
    judged = [found[one] for one in _JUDGED]
    advice = [
        words.rpartition('add the term')[2] for words in found.warnings if 'add the term' in words
    ]
    return NoiseOutcome(
        name,
        tuple(one.value - truth[one.name] for one in judged),
        tuple(one.error for one in judged),
        tuple(one.interval[0] <= truth[one.name] <= one.interval[1] for one in judged),
        any('the noise of the force' in words for words in found.warnings),
        ''.join(advice),
        tuple({one.cause for one in FURTHER.values() if one.cause in ' '.join(found.warnings)}),
    )


def compare(tick: Tick, recordings: int = 1000, seed: int = 2014) -> Answer:
    """Compare estimates and suggested terms with the true parameters."""
    found: dict[str, list[NoiseOutcome]] = {name: [] for name in (*LINES, *FURTHER)}
    workers = cores()
    for number, part in enumerate(studied(outcomes, recordings, seed, workers), 1):
        tick(f'noises, {number} of {recordings}')
        for one in part:
            found[one.line].append(one)
    low, high = COVERAGE
    rows, bars = [], []
    coverages: list[float] = []
    wrong: list[float] = []
    for name, line in LINES.items():
        held, errors, given = (
            np.array([getattr(one, what) for one in found[name]])
            for what in ('held', 'errors', 'given')
        )
        right = float(np.mean([line.effect in one.advised.split() for one in found[name]]))
        false = float(np.mean([bool(one.advised) for one in found[name]]))
        warned = float(np.mean([one.warned for one in found[name]]))
        coverage = held.mean(axis=0)
        made, said = (np.sqrt((values**2).mean(axis=0)) for values in (errors, given))
        if not line.effect:
            if line.is_hard:
                bars.append(
                    Bar(
                        f'lowest coverage, {name}', 100.0 * coverage.min(), 100.0 * low, '%',
                        at_least=True,
                    )
                )  # fmt: skip
            else:
                coverages += coverage.tolist()
                wrong.append(false)
        else:
            bars.append(
                Bar(f'right advice, {name}', 100.0 * right, 100.0 * RIGHT, '%', at_least=True)
            )
        rows.append(
            (
                name,
                ' and '.join(f'{share:.1%}' for share in coverage),
                ' and '.join(f'{m / s:.2f}' for m, s in zip(made, said, strict=True)),
                f'{warned:.0%}',
                f'{right:.1%} {line.effect}' if line.effect else f'{false:.1%} false',
            )
        )
    bars += [
        Bar('largest share of false advice', 100.0 * max(wrong), 100.0 * FALSE, '%'),
        Bar(
            'lowest coverage of mu_s and mu_v',
            100.0 * min(coverages),
            100.0 * low,
            '%',
            at_least=True,
        ),
        Bar('highest coverage of mu_s and mu_v', 100.0 * max(coverages), 100.0 * high, '%'),
    ]
    section = PageSection(
        'Other noise, another simulator',
        ('noise or effect', 'coverage mu_s and mu_v', 'made over given', 'warned', 'advice'),
        rows,
        f'{recordings} recordings of 40 s of each kind, seed {seed}, none of them by the plant. '
        'The lines at the end hold an effect that the fit lacks: their intervals need not hold, '
        'but the right term is to be advised. Warned: that the noise has a memory.',
    )
    further, more = _further(found, recordings, seed)
    return [section, further], [*bars, *more]


def _further(
    found: Mapping[str, list[NoiseOutcome]], recordings: int, seed: int
) -> tuple[PageSection, list[Bar]]:
    """Compare intervals, named causes and suggested terms of the further kinds."""
    rows, bars, wrong = [], [], []
    for name, line in FURTHER.items():
        ones = found[name]
        coverage = np.mean([one.held for one in ones], axis=0)
        advice = [one.advised.split() for one in ones]
        right = float(np.mean([line.effect in terms for terms in advice]))
        false = float(np.mean([not set(terms) <= {line.effect, line.also} for terms in advice]))
        named = (
            right if line.effect else float(np.mean([line.cause in one.causes for one in ones]))
        )
        named *= bool(line.effect or line.cause)
        plain = float(np.mean([line.cause in one.causes for one in found['white']]))
        rows.append(
            (
                name,
                ' and '.join(f'{share:.1%}' for share in coverage),
                f'{named:.1%} {line.effect or line.cause}' if named else '-',
                f'{false:.1%}',
                f'{plain:.1%}' if line.cause else '-',
            )
        )
        best = 100.0 * max(float(coverage.min()), named)
        bars.append(Bar(f'holds or named, {name}', best, 100.0 * RIGHT, '%', at_least=True))
        if line.effect:
            bars.append(
                Bar(f'right advice, {name}', 100.0 * right, 100.0 * RIGHT, '%', at_least=True)
            )
        wrong.append(false)
    bars.append(Bar('largest share of false advice, further', 100.0 * max(wrong), 2.0, '%'))
    section = PageSection(
        'Errors that the models of the noise do not contain',
        ('error', 'coverage mu_s and mu_v', 'cause named', 'false advice', 'named in white noise'),
        rows,
        f'{recordings} recordings of 40 s of each kind, seed {seed}. The intervals are to hold, '
        'or a warning or the suggested term is to name the cause. False advice: suggested terms '
        'without the right one.',
    )
    return section, bars
