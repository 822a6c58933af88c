"""Controllers that steer the tip to a target, all on the same needles."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import lru_cache, partial
from math import cos, pi, sin, sqrt
from multiprocessing import get_context
from time import perf_counter
from typing import Final, NamedTuple, TypeAlias

from benchmarks.measure import Bar
from benchmarks.page import Answer, Section, Tick
from needle_controller.steering import trial
from needle_controller.steering.baselines import Broyden, OpenLoop, Springs
from needle_controller.steering.belief import SteeringBelief
from needle_controller.steering.controller import (
    OutOfReachError,
    SteeringController,
    SteeringFaultError,
)
from needle_controller.steering.responses import SteeringModel
from needle_controller.steering.trial import drawn
from needle_dynamics import FloatArray, NeedleParameters, SteeringParameters
from needle_dynamics.steering.parameters import NEEDLES, tissue_of
import numpy as np

#: Steps [m], limit of the guide [m], depths of targets [steps], and their distance from the axis
#: [m].
STEP, LIMIT, DEPTHS, ASIDE = 5e-3, 6e-3, (12, 24), 6e-3

#: Free length [m], and stiffness of the skin over that of the tissue [m].
FREE, SKIN = 0.04, 0.02

#: Bending length of each medium [m]; of layers the depths at which they begin, and their lengths.
MEDIA: Final[Mapping[str, tuple[tuple[float, float], ...]]] = {
    'lambda 25 mm': ((0.0, 0.025),),
    'lambda 35 mm': ((0.0, 0.035),),
    'lambda 50 mm': ((0.0, 0.05),),
    'layers of 50, 30, 40 mm': ((0.0, 0.05), (0.02, 0.03), (0.06, 0.04)),
}

#: Repeated insertions then differ by 0.3 mm along each axis at 100 mm.
PATH_NOISE: Final = 1e-4

#: What nobody knows of the needles: they drift by some 6 mm if nobody steers them.
TRUE: Final = SteeringBelief(tilt=0.02, frame=0.03, bevel=0.1, path_noise=PATH_NOISE)

#: Deviation of a reading of the tip [m], readings while the needle rests, and part that is lost.
SENSORS: Final = {'EM': (1.8e-4, 20, 0.0), 'ultrasound': (3e-4, 12, 0.05)}

#: Sensor, and part by which needles differ from what is believed.
CASES: Final = (('EM', 0.3), ('EM', 0.5), ('ultrasound', 0.3))

CONTROLLERS: Final = ('ours', 'springs', 'Broyden', 'open loop')

#: Squared distance within which 95 of 100 draws of two normal numbers are.
_ELLIPSE: Final = 5.991

#: A target that is missed by more [m] must not have been missed without a word.
_MISSED: Final = 2e-3


_Controller: TypeAlias = Callable[[FloatArray | None], tuple[float, float]]


class Outcome(NamedTuple):
    """
    What became of an insertion.

    Attributes
    ----------
    medium : str
        Medium.
    reachable : bool
        Whether the guide could have reached the target, if all but the path had been known.
    miss : dict
        Distance of the tip from the target at the end [m], by controller.
    travel : float
        Way of the guide under our controller [m].
    refused, warned, held : bool
        Whether ours refused the target, said on the way that it is out of reach, and whether its
        interval held the tip.
    plan, look : float
        Time of a step of ours, and of the look alone [s].

    """

    medium: str
    reachable: bool
    miss: dict[str, float]
    travel: float
    refused: bool
    warned: bool
    held: bool
    plan: float
    look: float


@lru_cache
def believed(medium: str) -> tuple[NeedleParameters, SteeringParameters]:
    """
    Return needle and tissue as they are believed.

    Parameters
    ----------
    medium : str
        One of `MEDIA`.

    Returns
    -------
    NeedleParameters, SteeringParameters
        Constants.

    """
    needle = NEEDLES['phantom']
    (_, first), *others = MEDIA[medium]
    ei = needle.bending_stiffness
    needle = replace(
        needle,
        tissue_stiffness=tissue_of(ei, first),
        layer_depths=tuple(at for at, _ in others),
        layer_stiffnesses=tuple(tissue_of(ei, length) for _, length in others),
    )
    skin = SKIN * needle.tissue_stiffness
    return needle, SteeringParameters(free_length=FREE, skin_stiffness=skin)


@lru_cache(maxsize=256)
def _model(medium: str, steps: int, sensor: str, spread: float) -> SteeringModel:
    sigma, count, lost = SENSORS[sensor]
    noise = sigma / sqrt(count * (1.0 - lost))
    belief = SteeringBelief(spread=spread, path_noise=PATH_NOISE, noise=noise)
    return SteeringModel(*believed(medium), STEP * np.arange(steps + 1), belief)


def insert(sensor: str, spread: float, seed: int) -> Outcome:
    """
    Insert one needle under each controller.

    Parameters
    ----------
    sensor : str
        One of `SENSORS`.
    spread : float
        Part by which the needle differs from what is believed.
    seed : int
        Seed of the needle, its target and all noise.

    Returns
    -------
    Outcome
        What became of it.

    """
    rng = np.random.default_rng(seed)
    medium = list(MEDIA)[seed % len(MEDIA)]
    needle, steering = believed(medium)
    steps = int(rng.integers(DEPTHS[0], DEPTHS[1] + 1))
    depths: FloatArray = STEP * np.arange(steps + 1.0)
    truth = drawn(needle, steering, replace(TRUE, spread=spread), rng, seed)
    aside, angle = ASIDE * sqrt(rng.uniform()), rng.uniform(0.0, 2.0 * pi)
    target = aside * np.array([sin(angle), cos(angle)])
    alone = SteeringModel(truth.needle, truth.steering, depths, SteeringBelief(spread=0.0))
    causes = np.array([np.zeros(2), truth.frame, truth.tilt, truth.bevel])
    drift = alone.causes[0, -1, :4] @ causes
    could = LIMIT * np.abs(alone.guide[0, -1]).sum()

    def run(controller: _Controller) -> tuple[FloatArray, float]:
        one, way = trial.insert(truth, depths, _look(sensor, seed), controller)
        return truth.tip(one), way

    found: dict[str, float] = {}
    travel = plan = look = 0.0
    refused = warned = held = False
    try:
        ours = SteeringController(_model(medium, steps, sensor, spread), target, LIMIT)
    except OutOfReachError:
        refused = True
    else:
        said: list[str] = []
        times: list[float] = []

        def look_at(tip: FloatArray | None) -> tuple[float, float]:
            begin = perf_counter()
            to = ours.next(tip)
            times.append(perf_counter() - begin)
            if ours.step <= steps:
                said.append(ours.warning)
            return to

        try:
            tip, way = run(look_at)
        except SteeringFaultError:
            # It has stopped short of the target.
            tip, way, said = np.full(2, np.inf), 0.0, ['a fault']
        found['ours'] = float(np.hypot(*(tip - target)))
        there = ours.expected()
        off = tip - there.mean
        held = bool(off @ np.linalg.solve(there.covariance, off) <= _ELLIPSE)
        warned, travel = any(said), way
        plan, look = float(np.median(times[:-1])), times[-1]
    others: Mapping[str, Callable[[], OpenLoop]] = {
        'springs': lambda: Springs(needle, steering, depths, target, LIMIT),
        'Broyden': lambda: Broyden(needle, steering, depths, target, LIMIT),
        'open loop': lambda: OpenLoop(depths, target, LIMIT),
    }
    for name, make in others.items():
        tip, _ = run(make().next)
        found[name] = float(np.hypot(*(tip - target)))
    reachable = bool((np.abs(target - drift) <= could).all())
    return Outcome(medium, reachable, found, travel, refused, warned, held, plan, look)


def _look(sensor: str, seed: int) -> Callable[[FloatArray], FloatArray | None]:
    """Return what takes the mean of the readings of a sensor; None if all are lost."""
    rng = np.random.default_rng([seed, 1])
    sigma, count, lost = SENSORS[sensor]

    def look(tip: FloatArray) -> FloatArray | None:
        seen = int(rng.binomial(count, 1.0 - lost))
        noise = sigma / sqrt(max(seen, 1)) * rng.standard_normal(2)
        return np.asarray(tip + noise) if seen else None

    return look


def compare(tick: Tick, needles: int = 1000) -> Answer:
    """
    Steer many needles under each controller.

    Parameters
    ----------
    tick : callable
        Called with the name of each stage.
    needles : int
        Needles of each case, evenly of all media.

    Returns
    -------
    sections, bars
        A page.

    """
    rows: list[tuple[str, ...]] = []
    bars: list[Bar] = []
    limits = {
        ('EM', 0.3): {'median': 0.15, 'mean': 0.20, '95 %': 0.45},
        ('EM', 0.5): {'mean': 0.30},
        ('ultrasound', 0.3): {'mean': 0.35},
    }
    others: list[tuple[str, ...]] = []
    with ProcessPoolExecutor(mp_context=get_context('spawn')) as pool:
        for sensor, spread in CASES:
            case = f'{sensor}, +-{100.0 * spread:g} %'
            tick(case)
            found = list(pool.map(partial(insert, sensor, spread), range(needles), chunksize=5))
            counted = [one for one in found if one.reachable and not one.refused]
            for medium in (*MEDIA, 'all'):
                of = [one for one in counted if medium in (one.medium, 'all')]
                rows += [(case, medium, name, *_figures(of, name)) for name in CONTROLLERS]
                if medium != 'all' and (sensor, spread) == CASES[0]:
                    bars += _best(of, medium)
            ours = np.array([1e3 * one.miss['ours'] for one in counted])
            bars += [
                Bar(f'{what} of ours, {case}', _statistic(ours, what), limit, 'mm')
                for what, limit in limits[sensor, spread].items()
            ]
            held = float(np.mean([one.held for one in counted]))
            bars.append(Bar(f'coverage, {case}', held, 0.93, '', at_least=True))
            bars.append(Bar(f'coverage, {case}', held, 0.97))
            taken = [one for one in found if not one.refused]
            silent = sum(one.miss['ours'] > _MISSED and not one.warned for one in taken)
            bars.append(Bar(f'missed by more than 2 mm without a word, {case}', silent, 0.0))
            others.append(
                (
                    case,
                    f'{sum(one.reachable for one in found)}',
                    f'{sum(one.refused for one in found)}',
                    f'{sum(one.refused and one.reachable for one in found)}',
                    f'{sum(one.warned for one in counted)}',
                    f'{100.0 * held:.1f} %',
                    f'{1e3 * np.mean([one.travel for one in counted]):.0f} mm',
                    f'{1e3 * np.median([one.plan for one in counted]):.2f} ms',
                    f'{1e3 * np.median([one.look for one in counted]):.2f} ms',
                )
            )
            bars.append(
                Bar(
                    f'a step, {case}', 1e3 * float(np.median([c.plan for c in counted])), 2.0, 'ms'
                )
            )
    return [
        Section(
            'Distance of the tip from its target [mm]',
            ('case', 'medium', 'controller', 'mean', 'STD', 'median', '95 %', 'within 1 mm'),
            rows,
            f'{needles} needles of each case, evenly of four media, seeds 0 to {needles - 1}; '
            f'targets within {1e3 * ASIDE:g} mm of the axis, {1e3 * STEP * DEPTHS[0]:g} to '
            f'{1e3 * STEP * DEPTHS[1]:g} mm deep; guide within {1e3 * LIMIT:g} mm, steps of '
            f'{1e3 * STEP:g} mm. Counted are targets that the guide can reach if all but the path '
            'is known, and that ours did not refuse.',
        ),
        Section(
            'Ours',
            (
                'case', 'within reach', 'refused', 'refused within reach', 'warned',
                'intervals that hold the tip', 'way of the guide', 'a step', 'a look',
            ),
            others,
        ),
    ], bars  # fmt: skip


def _statistic(values: FloatArray, what: str) -> float:
    """Return a figure of distances."""
    if what == 'mean':
        return float(values.mean())
    return float(np.quantile(values, 0.95 if what == '95 %' else 0.5))


def _figures(of: Sequence[Outcome], name: str) -> tuple[str, ...]:
    miss = np.array([1e3 * one.miss[name] for one in of])
    return (
        f'{miss.mean():.3f}',
        f'{miss.std():.3f}',
        f'{_statistic(miss, "median"):.3f}',
        f'{_statistic(miss, "95 %"):.3f}',
        f'{100.0 * np.mean(miss <= 1.0):.1f} %',
    )


def _best(of: Sequence[Outcome], medium: str) -> list[Bar]:
    """Return the bars of ours beside the best of the others."""
    bars = []
    for what in ('mean', '95 %'):
        found = {
            name: _statistic(np.array([1e3 * one.miss[name] for one in of]), what)
            for name in CONTROLLERS
        }
        ours = found.pop('ours')
        bars.append(
            Bar(f'{what} over the best baseline, {medium}', ours / min(found.values()), 1.0)
        )
    return bars
