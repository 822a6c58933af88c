"""Identification of simulated steered insertions: errors and coverage of the constants."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
import os
from typing import Final

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
    guide_first: bool = False
    medium: str = 'gel'


def insertion(
    seed: int, truth: FitTruth | None = None, roll: Callable[[float], float] | None = None
) -> SteeringRecording:
    """
    Insert to 100 mm in steps of 5 mm with random guide motion within 6 mm; measure the tip.

    `roll` is the roll of the base [rad] by depth [m].
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
    steps = rng.normal(0.0, 1.5e-3, (len(depth), 2))
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
    return SteeringRecording(
        name=f'insertion {seed}',
        medium=truth.medium,
        depth=depth,
        guide=guide,
        roll=rolls,
        tip=tip + truth.noise * rng.standard_normal(tip.shape),
    )


#: Cases: name, true parameters, and number of insertions per fit.
_CASES: Final = (
    ('one insertion', FitTruth(), 1),
    ('one insertion, no skin', FitTruth(skin=0.0), 1),
    ('one insertion, lambda 50 mm', FitTruth(length=0.05), 1),
    ('ten insertions', FitTruth(), 10),
    ('ten insertions, paths that wander', FitTruth(path_noise=3e-5), 10),
)


def _one(case: int, seed: int) -> tuple[float, float, float, float]:
    """Fit insertions; return the interval of the bending length, its error, and the rms."""
    _, truth, count = _CASES[case]
    made = [insertion(1000 * seed + k, truth) for k in range(count)]
    found = identify_steering(made, SteeringSettings(terms=('tilt',), order='together'))
    one = found['gel']['bending_length']
    if not one.determined:
        return -np.inf, np.inf, np.nan, found.rms
    return *one.interval, one.value - truth.length, found.rms


def compare(tick: Tick, recordings: int = 1000) -> Answer:
    """Fit simulated insertions, and count intervals that contain the true value."""
    rows, bars = [], []
    with processes(os.cpu_count() or 1) as pool:
        for k, (name, truth, count) in enumerate(_CASES):
            tick(name)
            fits = recordings if count == 1 else max(1, recordings // 10)
            found = np.array(list(pool.map(partial(_one, k), range(fits))))
            low, high, off, rms = found.T
            known = np.isfinite(off)
            held = (low <= truth.length) & (truth.length <= high)
            coverage = float(held[known].mean())
            rows.append(
                (
                    name,
                    f'{fits}',
                    f'{100.0 * coverage:.1f} %',
                    f'{np.count_nonzero(~known)}',
                    f'{1e3 * np.sqrt(np.mean(off[known] ** 2)):.2f} mm',
                    f'{1e3 * np.median((high - low)[known]):.2f} mm',
                    f'{1e3 * rms.mean():.3f} mm',
                )
            )
            # The coverage from a hundred fits has an error of 2 %.
            slack = 0.0 if count == 1 else 0.03
            bars.append(Bar(f'coverage, {name}', coverage, COVERAGE[0] - slack, '', at_least=True))
            bars.append(Bar(f'coverage, {name}', coverage, COVERAGE[1] + slack))
    heads = (
        'fitted', 'fits', 'coverage', 'not determined', 'rms error of lambda',
        'median width of its interval', 'rms of the fit',
    )  # fmt: skip
    section = PageSection(
        'Bending length from insertions with a moved guide',
        heads,
        rows,
        f'100 mm in steps of 5 mm, noise of the tip {1e3 * NOISE:g} mm per axis; free length, '
        'skin, tilt and offsets are fitted with it.',
    )
    return [section], bars
