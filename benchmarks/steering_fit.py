# SPDX-License-Identifier: Apache-2.0
"""Identification of simulated steered insertions: errors and coverage of the constants."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from math import nan, sqrt
import os
from typing import Final, NamedTuple

from benchmarks.calibration import COVERAGE
from benchmarks.measure import Bar
from benchmarks.page import Answer, PageSection, Tick
from needle_dynamics import NeedleParameters, SteeredNeedle, SteeringParameters
from needle_dynamics.steering.parameters import tissue_of
from needle_identification import identify_steering, SteeringRecording, SteeringSettings
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
        replace(NEEDLE, tissue_stiffness=tissue),
        steering,
        guide=guide[0],
        tilt=truth.tilt,
        roll=float(rolls[0]),
        seed=seed,
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


def compare(tick: Tick, recordings: int = 1000) -> Answer:
    """Fit simulated insertions, and count intervals that contain the true value."""
    rows, bars = [], []
    with processes(os.cpu_count() or 1) as pool:
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
            # The coverage from a hundred fits has an error of 2 %.
            slack = 0.0 if fits >= 1000 else 1.4 * sqrt(0.0475 / fits)
            of = f'coverage of lambda, {name}'
            bars.append(Bar(of, coverage[0], COVERAGE[0] - slack, '', at_least=True))
            bars.append(Bar(of, coverage[0], COVERAGE[1] + slack))
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
    return [section], bars
