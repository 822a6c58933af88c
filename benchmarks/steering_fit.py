# SPDX-License-Identifier: Apache-2.0
"""Identification of simulated steered insertions: errors and coverage of the constants."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from math import nan, sqrt
from typing import Final, NamedTuple

from benchmarks.calibration import COVERAGE
from benchmarks.measure import Bar
from benchmarks.page import Answer, PageSection, Tick
from needle_dynamics import FloatArray, NeedleParameters, SteeredNeedle, SteeringParameters
from needle_dynamics.steering.parameters import tissue_of
from needle_identification import identify_steering, SteeringRecording, SteeringSettings
from needle_ros.process import cores
from needle_ros.process_pool import processes
import numpy as np

#: Needle of the paper, and its bending stiffness [N m^2].
NEEDLE: Final = NeedleParameters.preset('phantom')
EI: Final = NEEDLE.bending_stiffness

#: Noise of an electromagnetic tracker [m].
NOISE: Final = 0.18e-3

#: Steps of an insertion, and their length [m].
_STEPS, _STEP = 20, 5e-3

_LIMIT: Final = 6e-3


@dataclass(frozen=True, slots=True, kw_only=True)
class FitTruth:
    """
    True parameters of an insertion.

    Attributes
    ----------
    length, free, skin : float
        Bending length, free length, and ratio of skin stiffness to tissue stiffness [m].
    tilt : tuple of float
        Tilt of the guide in x and z.
    curvature : float
        Curvature of a long needle by its bevel [1/m].
    noise : float
        Noise of the tracker, per axis [m].
    path_noise : float
        Noise of the path [rad^2/m].
    slope : float
        Standard deviation of the rotation between the frames of guide and tip, by insertion [rad].
    guide_first : bool
        Whether the guide moves before the needle.
    medium : str
        Name of the medium.
    borders : tuple of float
        Depths at which deeper layers begin [m].
    ratios : tuple of float
        Stiffness of each deeper layer over that of the first.

    """

    length: float = 0.035
    free: float = 0.04
    skin: float = 0.01
    tilt: tuple[float, float] = (0.01, -0.02)
    curvature: float = 0.0
    noise: float = NOISE
    path_noise: float = 0.0
    slope: float = 0.0
    guide_first: bool = False
    medium: str = 'gel'
    borders: tuple[float, ...] = ()
    ratios: tuple[float, ...] = ()

    @property
    def tissue(self) -> NeedleParameters:
        """Needle in this tissue."""
        first = tissue_of(EI, self.length)
        return replace(
            NEEDLE,
            tissue_stiffness=first,
            layer_depths=self.borders,
            layer_stiffnesses=tuple(one * first for one in self.ratios),
        )


def insertion(
    seed: int,
    truth: FitTruth | None = None,
    roll: Callable[[float], float] | None = None,
    steer: float = 1.5e-3,
) -> SteeringRecording:
    """
    Insert to 100 mm in steps of 5 mm with random guide motion within 6 mm; measure the tip.

    `roll` is the roll of the base [rad] by depth [m], `steer` the deviation of a motion [m].
    """
    truth = truth or FitTruth()
    rng = np.random.default_rng(seed)
    tissue = tissue_of(EI, truth.length)
    steering = SteeringParameters(
        free_length=truth.free,
        skin_stiffness=truth.skin * tissue,
        bevel_load=(truth.curvature * EI / truth.length,),
        path_noise=truth.path_noise,
    )
    depth = np.asarray(np.arange(_STEPS + 1) * _STEP, dtype=np.float64)
    steps = rng.normal(0.0, steer, (len(depth), 2))
    guide = np.clip(np.cumsum(steps, axis=0), -_LIMIT, _LIMIT)
    rolls = np.array([roll(float(d)) if roll else 0.0 for d in depth])
    needle = SteeredNeedle(
        truth.tissue, steering, guide=guide[0], tilt=truth.tilt, roll=float(rolls[0]), seed=seed
    )
    tips = []
    for d, g, r in zip(depth.tolist(), guide, rolls.tolist(), strict=True):
        if truth.guide_first:
            needle.move(guide=g)
        needle.move(depth=d, guide=g, roll=r)
        tips.append(needle.tip[[0, 2]])
    tip = np.array(tips) + rng.normal(0.0, 1e-3, 2)
    tip += depth[:, np.newaxis] * truth.slope * rng.standard_normal(2)
    return SteeringRecording(
        name=f'insertion {seed}',
        medium=truth.medium,
        depth=depth,
        guide=guide,
        roll=rolls,
        tip=tip + truth.noise * rng.standard_normal(tip.shape),
    )


#: Paths that wander, in frames that differ between insertions.
_REAL: Final = FitTruth(path_noise=1e-3, slope=0.02)


def drawn(seed: int) -> FitTruth:
    """Draw a needle, its tissue, the causes of its drift, and the order of guide and needle."""
    rng = np.random.default_rng(seed)
    causes = rng.integers(0, 2, 3)
    tilt = causes[0] * rng.normal(0.0, 0.02, 2)
    return FitTruth(
        length=float(0.03 * np.exp(0.3 * rng.standard_normal())),
        free=float(rng.uniform(0.02, 0.08)),
        skin=float(rng.integers(0, 2) * rng.uniform(0.0, 0.03)),
        tilt=(float(tilt[0]), float(tilt[1])),
        curvature=float(causes[1] * abs(rng.normal(0.0, 0.5))),
        path_noise=float(10.0 ** rng.uniform(-5.0, -2.5)),
        slope=float(causes[2] * 0.02),
        guide_first=bool(rng.integers(0, 2)),
    )


#: Cases: name, true parameters (drawn for each fit if None), and number of insertions per fit.
_CASES: Final = (
    ('one insertion', FitTruth(), 1),
    ('one insertion, no skin', FitTruth(skin=0.0), 1),
    ('one insertion, lambda 50 mm', FitTruth(length=0.05), 1),
    ('one insertion, path and frame vary', _REAL, 1),
    ('two insertions, path and frame vary', _REAL, 2),
    ('four insertions, path and frame vary', _REAL, 4),
    ('ten insertions', FitTruth(), 10),
    ('ten insertions, path and frame vary', _REAL, 10),
    ('one insertion of a population', None, 1),
    ('two insertions of a population', None, 2),
    ('four insertions of a population', None, 4),
    ('ten insertions of a population', None, 10),
)

#: Constants, and their symbols.
_CONSTANTS: Final = {'bending_length': 'lambda', 'free_length': 'L0', 'skin': 'skin'}


class _Fit(NamedTuple):
    """Fit of one case; not a number where a constant is not determined."""

    held: list[float]  # whether the intervals of `_CONSTANTS` contain the true values
    error: float  # of the bending length [m]
    width: float  # of the interval of the bending length [m]
    rms: float  # of the residuals [m]
    predicted: float  # fraction of predicted tips within their interval


def _one(case: int, seed: int) -> _Fit:
    """Fit insertions."""
    _, known, count = _CASES[case]
    truth = known or drawn(seed)
    made = [insertion(1000 * seed + k, truth) for k in range(count)]
    settings = SteeringSettings(terms=('tilt',), order='together') if known else None
    found = identify_steering(made, settings)
    medium = found['gel']
    length = medium['bending_length']
    held = [
        float(one.interval[0] <= true <= one.interval[1]) if one.determined else nan
        for one, true in zip(
            (length, found.free_length, medium['skin']),
            (truth.length, truth.free, truth.skin),
            strict=True,
        )
    ]
    return _Fit(
        held,
        length.value - truth.length if length.determined else nan,
        length.interval[1] - length.interval[0],
        found.rms,
        nan if medium.held_out is None else medium.held_out.coverage,
    )


#: Layered cases: number of layers, and of insertions per fit.
_LAYERED: Final = ((2, 4), (3, 4))


def layered(seed: int, layers: int) -> FitTruth:
    """Draw tissue in layers of equal depth whose stiffness deviates by 30 % each."""
    logs = 0.3 * np.random.default_rng(seed).standard_normal(layers)
    return FitTruth(
        length=0.035 * float(np.exp(-0.25 * logs[0])),
        path_noise=1e-4,
        borders=tuple((np.arange(1, layers) * _STEPS * _STEP / layers).tolist()),
        ratios=tuple(np.exp(logs[1:] - logs[0]).tolist()),
    )


class LayerFit(NamedTuple):
    """Fit of the stiffness of each layer over its nominal one, shape (layers,)."""

    errors: FloatArray  #: logarithm of estimate over true value
    ends: FloatArray  #: of the intervals, shape (layers, 2); nan if not determined
    true: FloatArray

    @property
    def held(self) -> FloatArray:
        """1 where the interval contains the true value, nan where it is not determined."""
        inside = (self.ends[:, 0] <= self.true) & (self.true <= self.ends[:, 1])
        return np.where(np.isfinite(self.ends[:, 0]), inside, nan)


def fit_layers(layers: int, count: int, seed: int) -> LayerFit:
    """Fit the layers of insertions whose nominal stiffness is the same in all layers."""
    truth = layered(seed, layers)
    nominal = replace(truth, length=0.035, ratios=(1.0,) * (layers - 1)).tissue
    made = [insertion(1000 * seed + k, truth) for k in range(count)]
    settings = SteeringSettings(terms=('tilt',), order='together', tissue=nominal)
    gel = identify_steering(made, settings)['gel']
    found = [gel[f'layer_{k}'] for k in range(1, layers + 1)]
    true = np.divide(truth.tissue.tissue.stiffnesses, nominal.tissue.stiffnesses)
    ends = [one.interval if one.determined else (nan, nan) for one in found]
    return LayerFit(np.log([one.value for one in found] / true), np.array(ends), true)


def _bars(name: str, coverage: float, fits: int) -> list[Bar]:
    # The coverage from a hundred fits has an error of 2 %.
    slack = 0.0 if fits >= 1000 else 1.4 * sqrt(0.0475 / fits)
    return [
        Bar(name, coverage, COVERAGE[0] - slack, '', at_least=True),
        Bar(name, coverage, COVERAGE[1] + slack),
    ]


def _layers(tick: Tick, pool: Executor, bars: list[Bar], fits: int) -> PageSection:
    """Fit insertions in layers; add the bars of the coverage."""
    rows = []
    for layers, count in _LAYERED:
        name = f'{layers} layers, {count} insertions'
        tick(name)
        found = list(pool.map(partial(fit_layers, layers, count), range(fits)))
        held = np.array([one.held for one in found])
        errors = np.array([one.errors for one in found])
        known = np.isfinite(held)
        for k in range(layers):
            own = known[:, k]
            widths = [np.log(one.ends[k, 1] / one.ends[k, 0]) for one in found]
            rows.append(
                (
                    name,
                    f'{fits}',
                    f'{k + 1}',
                    f'{100.0 * own.mean():.0f} %',
                    f'{100.0 * held[own, k].mean():.1f} %' if own.any() else '',
                    f'{np.sqrt(np.mean(errors[own, k] ** 2)):.2f}' if own.any() else '',
                    f'{np.nanmedian(widths):.2f}' if own.any() else '',
                )
            )
        bars += _bars(f'coverage of layers, {name}', float(np.nanmean(held)), fits)
    return PageSection(
        'Stiffness of layers',
        (
            'fitted', 'fits', 'layer', 'determined', 'coverage', 'rms error of the logarithm',
            'median width of its interval',
        ),
        rows,
        'Layers of equal depth, to 100 mm, whose stiffness deviates by 30 % each from a nominal '
        'one, with a path noise of 1e-4 rad^2/m; otherwise as above.',
    )  # fmt: skip


def compare(tick: Tick, recordings: int = 1000) -> Answer:
    """Fit simulated insertions, and count intervals that contain the true value."""
    rows, bars = [], []
    with processes(cores()) as pool:
        for k, (name, truth, count) in enumerate(_CASES):
            tick(name)
            fits = max(1, recordings // (1 + 9 * (count > 1) + (truth is None)))
            found = list(pool.map(partial(_one, k), range(fits)))
            held = np.array([one.held for one in found])
            known = np.isfinite(held)
            off = np.array([one.error for one in found])[known[:, 0]]
            width = np.array([one.width for one in found])[known[:, 0]]
            coverage = np.nanmean(held, axis=0).tolist()
            predicted = np.array([one.predicted for one in found])
            rows.append(
                (
                    name,
                    f'{fits}',
                    *(
                        f'{100.0 * one:.1f} %' + (f' ({lost} not determined)' if lost else '')
                        for one, lost in zip(coverage, (~known).sum(axis=0), strict=True)
                    ),
                    f'{1e3 * np.sqrt(np.mean(off**2)):.2f} mm',
                    f'{1e3 * np.median(width):.2f} mm',
                    f'{1e3 * np.mean([one.rms for one in found]):.3f} mm',
                    '' if count == 1 else f'{100.0 * predicted.mean():.1f} %',
                )
            )
            bars += _bars(f'coverage of lambda, {name}', coverage[0], fits)
        layers = _layers(tick, pool, bars, max(1, recordings // 10))
    heads = (
        'fitted', 'fits', *(f'coverage of {name}' for name in _CONSTANTS.values()),
        'rms error of lambda', 'median width of its interval', 'rms of the fit',
        'predicted tips within their interval',
    )  # fmt: skip
    section = PageSection(
        'Bending length from insertions with a moved guide',
        heads,
        rows,
        f'100 mm in steps of 5 mm, noise of the tip {1e3 * NOISE:g} mm per axis; free length, '
        'skin, tilt and offsets are fitted with it. Where path and frame vary, the path noise is '
        f'{_REAL.path_noise:g} rad^2/m, and the rotation between the frames of guide and tip is '
        f'{_REAL.slope:g} rad (standard deviation, by insertion). Of a population: lengths, skin, '
        'path noise, causes of drift (tilt, bevel, frames) and order of guide and needle are '
        'drawn for each fit, and are unknown to it. Predicted: each insertion from the others and '
        'from its first 15 mm.',
    )
    return [section, layers], bars
