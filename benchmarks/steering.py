# SPDX-License-Identifier: Apache-2.0
"""Laws that steer the tip to a target, compared on the same needles."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from math import cos, inf, pi, sin, sqrt
from typing import Final, NamedTuple

from benchmarks.measure import Bar
from benchmarks.page import Answer, PageSection, Tick
from needle_controller.steering.law import SteeringFaultError, SteeringLaw
from needle_controller.steering.laws.broyden import BroydenLaw
from needle_controller.steering.laws.multi_hypothesis import MultiHypothesisLaw, OutOfReachError
from needle_controller.steering.laws.open_loop import OpenLoopLaw
from needle_controller.steering.laws.roll_to_target import RollToTargetLaw
from needle_controller.steering.laws.springs import SpringsLaw
from needle_controller.steering.responses import SteeringModel
from needle_controller.steering.settings import SIMULATION_LIMITS, SteeringPrior
from needle_controller.steering.simulation import GroundTruth, sample_truth, simulate_steering
from needle_dynamics import FloatArray, NeedleParameters, SteeringParameters
from needle_dynamics.needles import NEEDLES
from needle_dynamics.steering.parameters import tissue_of
from needle_ros.process import cores
from needle_ros.process_pool import processes
import numpy as np
from scipy.optimize import lsq_linear

#: Steps [m], depths of targets [steps], and their distance from the axis [m].
STEP, DEPTHS, ASIDE = 5e-3, (12, 24), 6e-3

#: Limits of the laws: 6 mm for the position of the guide.
LIMITS: Final = SIMULATION_LIMITS

#: Free length [m], and stiffness of the skin over the stiffness of the tissue [m].
FREE, SKIN = 0.04, 0.02

#: Bending length of each medium [m]; for layers, their depths and bending lengths.
MEDIA: Final[Mapping[str, tuple[tuple[float, float], ...]]] = {
    'lambda 25 mm': ((0.0, 0.025),),
    'lambda 35 mm': ((0.0, 0.035),),
    'lambda 50 mm': ((0.0, 0.05),),
    'layers of 50, 30, 40 mm': ((0.0, 0.05), (0.02, 0.03), (0.06, 0.04)),
}

#: Repeated insertions then differ by 0.3 mm along each axis at 100 mm.
PATH_NOISE: Final = 1e-4

#: Unknown parameters of the needles: drift of about 6 mm without steering.
TRUE: Final = SteeringPrior(tilt=0.02, frame=0.03, bevel=0.1, path_noise=PATH_NOISE)

#: Standard deviation of a tip reading [m], readings during a rest, and lost fraction.
SENSORS: Final = {'EM': (1.8e-4, 20, 0.0), 'ultrasound': (3e-4, 12, 0.05)}

#: Sensor, and relative deviation of needles from their nominal parameters.
CASES: Final = (('EM', 0.3), ('EM', 0.5), ('ultrasound', 0.3))

CONTROLLERS: Final = ('ours', 'plan for the mean', 'springs', 'Broyden', 'open loop')

#: Load of a rotated bevel [N], error of its direction [rad], largest number of rotations, and
#: largest distance of a target from the drifted tip, as a fraction of the reachable distance.
BEVEL, MOUNTED, TURNS, WITHIN = 0.8, 0.1, 6, 0.9

#: Controllers of a needle with a bevel.
TURNING: Final = ('guide and roll', 'roll', 'roll towards the target', 'open loop')

#: Largest distance from the target without a warning [m].
_MISSED: Final = 2e-3


class End(NamedTuple):
    """
    End of an insertion under a controller.

    Attributes
    ----------
    miss : float
        Distance of the tip from the target [m].
    way : float
        Travel of the guide [m].
    turns : int
        Number of rotations of the needle.
    load : float
        Largest lateral force on the guide [N].
    time : float
        Median time of a controller step [s].

    """

    miss: float
    way: float
    turns: int
    load: float
    time: float


class SteeringOutcome(NamedTuple):
    """
    Results of a needle.

    Attributes
    ----------
    medium : str
        Medium.
    reachable : bool
        Whether the target was reachable with all parameters known except the path.
    ends : dict
        End of the insertion by controller.
    refused, warned, held : bool
        Whether our controller rejected the target, reported it as out of reach later, and whether
        its interval contained the tip.
    look : float
        Time of a tip measurement update of our controller [s].

    """

    medium: str
    reachable: bool
    ends: dict[str, End]
    refused: bool
    warned: bool
    held: bool
    look: float


@lru_cache
def nominal(medium: str, bevel: float = 0.0) -> tuple[NeedleParameters, SteeringParameters]:
    """Return the nominal parameters in a medium, with the load of a bevel [N]."""
    needle = NEEDLES['phantom'].needle
    (_, first), *others = MEDIA[medium]
    ei = needle.bending_stiffness
    needle = replace(
        needle,
        tissue_stiffness=tissue_of(ei, first),
        layer_depths=tuple(at for at, _ in others),
        layer_stiffnesses=tuple(tissue_of(ei, length) for _, length in others),
    )
    skin = SKIN * needle.tissue_stiffness
    return needle, SteeringParameters(free_length=FREE, skin_stiffness=skin, bevel_load=(bevel,))


@lru_cache(maxsize=256)
def _model(
    medium: str, steps: int, sensor: str, spread: float, bevel: float = 0.0
) -> SteeringModel:
    sigma, count, lost = SENSORS[sensor]
    noise = sigma / sqrt(count * (1.0 - lost))
    prior = SteeringPrior(spread=spread, path_noise=PATH_NOISE, noise=noise)
    return SteeringModel(*nominal(medium, bevel), STEP * np.arange(steps + 1), prior)


class MeanPlan(MultiHypothesisLaw):
    """Our controller with a different plan: a quadratic program for the mean of the hypotheses."""

    def _choose(self) -> complex:
        # The final position of an unconstrained guide is the final tip position without guide.
        (means, _, w), limit = self.reach, self._now.limit
        shifts = self._model.responses.guide[:, -1, self.step :]
        # The hypotheses are repetitions of the grid.
        shifts = np.tile(shifts, (len(w) // len(shifts), 1))
        rows = np.sqrt(w)[:, np.newaxis] * shifts
        rows = np.vstack([rows, 0.1 * np.eye(shifts.shape[1])])
        found = []
        need = np.sqrt(w) * (complex(*self.target) - means)
        for plane in (need.real, need.imag):
            wanted = np.concatenate([plane, np.zeros(shifts.shape[1])])
            found.append(float(lsq_linear(rows, wanted, (-limit, limit), method='bvls').x[0]))
        return complex(*found)


class _Trial:
    """A needle with its target, inserted under one controller after the other."""

    def __init__(self, truth: GroundTruth, depths: FloatArray, sensor: str, seed: int) -> None:
        self.truth, self.depths = truth, depths
        self._sensor, self._seed = sensor, seed
        self.target = np.zeros(2)
        self.look = inf
        self.said = ''

    def known(self) -> SteeringModel:
        """Return the true parameters except the path."""
        truth, known = self.truth, SteeringPrior(spread=0.0)
        return SteeringModel(truth.needle, truth.steering, self.depths, known)

    def end(self, law: SteeringLaw) -> tuple[FloatArray, End]:
        """Return the final tip position and the end of the insertion."""
        plant = self.truth.plant(self.depths)
        try:
            done = simulate_steering(law, plant, _sensor(self._sensor, self._seed))
        except SteeringFaultError as error:
            # The insertion stopped before the target depth.
            self.said = str(error)
            return np.full(2, inf), End(inf, 0.0, 0, 0.0, inf)
        self.look, self.said = done.times[-1], done.warning
        miss = float(np.hypot(*(plant.tip - self.target)))
        time = float(np.median(done.times[:-1]))
        return plant.tip, End(miss, done.travel, done.turns, done.load, time)


def _drawn(spread: float, sensor: str, seed: int, bevel: float = 0.0) -> tuple[str, _Trial]:
    """Return the medium and the needle of a seed; a bevel of known direction has a load [N]."""
    rng = np.random.default_rng(seed)
    medium = list(MEDIA)[seed % len(MEDIA)]
    steps = int(rng.integers(DEPTHS[0], DEPTHS[1] + 1))
    truth = sample_truth(*nominal(medium), replace(TRUE, spread=spread), rng, seed)
    aside, angle = ASIDE * sqrt(rng.uniform()), rng.uniform(0.0, 2.0 * pi)
    if bevel:
        load = bevel * (1.0 + spread * rng.uniform(-1.0, 1.0))
        off = MOUNTED * rng.standard_normal()
        truth = replace(
            truth,
            bevel=load * np.array([sin(off), cos(off)]),
            steering=replace(truth.steering, bevel_load=(load,)),
        )
    found = _Trial(truth, STEP * np.arange(steps + 1.0), sensor, seed)
    found.target = aside * np.array([sin(angle), cos(angle)])
    return medium, found


def insert(sensor: str, spread: float, seed: int) -> SteeringOutcome:
    """
    Insert one needle under each controller that moves the guide.

    `spread` is the relative deviation of the needle from its nominal parameters; the seed defines
    the needle, its target and all noise.
    """
    medium, one = _drawn(spread, sensor, seed)
    truth = one.truth
    depths, target = one.depths, one.target
    alone = one.known()
    causes = np.array([np.zeros(2), truth.frame, truth.tilt, truth.bevel])
    drift = alone.responses.causes[0, -1, :4] @ causes
    could = LIMITS.guide_limit * np.abs(alone.responses.guide[0, -1]).sum()
    ends: dict[str, End] = {}
    warned = held = refused = False
    look = inf
    model = _model(medium, len(depths) - 1, sensor, spread)
    try:
        ours = MultiHypothesisLaw(model, target, LIMITS)
    except OutOfReachError:
        refused = True
    else:
        tip, ends['ours'] = one.end(ours)
        there = ours.expected()
        warned, look = bool(one.said), one.look
        held = there.contains(tip)
        ends['plan for the mean'] = one.end(MeanPlan(model, target, LIMITS))[1]
    others: Mapping[str, SteeringLaw] = {
        'springs': SpringsLaw(model, target, LIMITS),
        'Broyden': BroydenLaw(model, target, LIMITS),
        'open loop': OpenLoopLaw(model, target, LIMITS),
    }
    ends |= {name: one.end(law)[1] for name, law in others.items()}
    reachable = bool((np.abs(target - drift) <= could).all())
    return SteeringOutcome(medium, reachable, ends, refused, warned, held, look)


def turn(seed: int) -> SteeringOutcome:
    """Insert one needle with a bevel under controllers with and without rotation."""
    sensor, spread = CASES[0]
    medium, one = _drawn(spread, sensor, seed, BEVEL)
    truth, depths = one.truth, one.depths
    alone = one.known()
    # Reachable set of the bevel with a load to one side.
    could = float(np.hypot(*truth.bevel)) * np.abs(alone.responses.bevel[0, -1]).sum()
    one.target *= could / ASIDE
    causes = np.array([np.zeros(2), truth.frame, truth.tilt])
    drift = alone.responses.causes[0, -1, :3] @ causes
    model = _model(medium, len(depths) - 1, sensor, spread, BEVEL)
    laws: dict[str, SteeringLaw] = {
        TURNING[2]: RollToTargetLaw(model, one.target, replace(LIMITS, turns=len(depths))),
        TURNING[3]: OpenLoopLaw(model, one.target, LIMITS),
    }
    turned = replace(LIMITS, turns=TURNS)
    refused = False
    try:
        laws[TURNING[0]] = MultiHypothesisLaw(model, one.target, turned)
        laws[TURNING[1]] = MultiHypothesisLaw(model, one.target, replace(turned, guide_limit=0.0))
    except OutOfReachError:
        refused = True
    ends = {name: one.end(law)[1] for name, law in laws.items()}
    reachable = bool(np.hypot(*(one.target - drift)) <= WITHIN * could)
    return SteeringOutcome(medium, reachable, ends, refused, False, False, one.look)


def _sensor(name: str, seed: int) -> Callable[[FloatArray], FloatArray | None]:
    """Return a function for the mean of sensor readings; None if all are lost."""
    rng = np.random.default_rng([seed, 1])
    sigma, count, lost = SENSORS[name]

    def sensor(tip: FloatArray) -> FloatArray | None:
        seen = int(rng.binomial(count, 1.0 - lost))
        noise = sigma / sqrt(max(seen, 1)) * rng.standard_normal(2)
        return np.asarray(tip + noise) if seen else None

    return sensor


def compare(tick: Tick, needles: int = 1000) -> Answer:
    """Steer a number of needles per case, evenly over all media, under each controller."""
    rows: list[tuple[str, ...]] = []
    bars: list[Bar] = []
    limits = {
        ('EM', 0.3): {'median': 0.15, 'mean': 0.20, '95 %': 0.45},
        ('EM', 0.5): {'mean': 0.30},
        ('ultrasound', 0.3): {'mean': 0.35},
    }
    others: list[tuple[str, ...]] = []
    with processes(cores()) as pool:
        for sensor, spread in CASES:
            case = f'{sensor}, +-{100.0 * spread:g} %'
            tick(case)
            found = list(pool.map(partial(insert, sensor, spread), range(needles)))
            counted = [one for one in found if one.reachable and not one.refused]
            for medium in (*MEDIA, 'all'):
                of = [one for one in counted if medium in (one.medium, 'all')]
                rows += [(case, medium, name, *_figures(of, name)) for name in CONTROLLERS]
                if medium != 'all' and (sensor, spread) == CASES[0]:
                    bars += _best(of, medium)
            ours = _misses(counted, 'ours')
            bars += [
                Bar(f'{what} of ours, {case}', _statistic(ours, what), limit, 'mm')
                for what, limit in limits[sensor, spread].items()
            ]
            held = float(np.mean([one.held for one in counted]))
            bars.append(Bar(f'coverage, {case}', held, 0.93, '', at_least=True))
            bars.append(Bar(f'coverage, {case}', held, 0.97))
            taken = [one for one in found if not one.refused]
            silent = sum(one.ends['ours'].miss > _MISSED and not one.warned for one in taken)
            bars.append(Bar(f'missed by more than 2 mm without a warning, {case}', silent, 0.0))
            step, look = _times(counted, 'ours')
            others.append(
                (
                    case,
                    f'{sum(one.reachable for one in found)}',
                    f'{sum(one.refused for one in found)}',
                    f'{sum(one.refused and one.reachable for one in found)}',
                    f'{sum(one.warned for one in counted)}',
                    f'{100.0 * held:.1f} %',
                    f'{look:.2f} ms',
                )
            )
            bars.append(Bar(f'a tip update and a step, {case}', look + step, 2.0, 'ms'))
        tick('roll')
        turned = list(pool.map(turn, range(needles)))
    every = [one for one in turned if one.reachable and not one.refused]
    bars.append(
        Bar(
            'mean of roll over roll towards the target',
            float(_misses(every, TURNING[1]).mean() / _misses(every, TURNING[2]).mean()),
            1.0,
        )
    )
    bars.append(Bar('a step, guide and roll', _times(every, TURNING[0])[0], 2.0, 'ms'))
    heads = (
        'controller', 'mean', 'STD', 'median', '95 %', 'within 1 mm', 'guide travel [mm]',
        'turns', 'load on the guide [N]', 'a step [ms]',
    )  # fmt: skip
    return [
        PageSection(
            'Distance of the tip from its target [mm]',
            ('case', 'medium', *heads),
            rows,
            f'{needles} needles of each case, evenly of four media, seeds 0 to {needles - 1}; '
            f'targets within {1e3 * ASIDE:g} mm of the axis, {1e3 * STEP * DEPTHS[0]:g} to '
            f'{1e3 * STEP * DEPTHS[1]:g} mm deep; guide within '
            f'{1e3 * LIMITS.guide_limit:g} mm, steps of {1e3 * STEP:g} mm. Statistics: targets '
            'that are reachable with all parameters known except the path, and that ours did not '
            'reject. Guide travel, turns and load are means, of the load the mean of the largest '
            'value of each insertion.',
        ),
        PageSection(
            'Ours',
            (
                'case', 'within reach', 'refused', 'refused within reach', 'warned',
                'intervals that contain the tip', 'a tip update',
            ),
            others,
        ),
        PageSection(
            'With a bevel: distance of the tip from its target [mm]',
            heads,
            [(name, *_figures(every, name)) for name in TURNING],
            f'Needles as in the first case, whose bevel pushes with {BEVEL:g} N +-30 %, in a '
            f'direction that is known to {MOUNTED:g} rad. Ours turns it {TURNS} times at most. '
            'Targets are in the reachable set of a bevel with a load to one side. Statistics: the '
            f'{len(every)} targets within {100.0 * WITHIN:g} % of it, relative to the drifted '
            'tip, that none of ours rejected.',
        ),
    ], bars  # fmt: skip


def _statistic(values: FloatArray, what: str) -> float:
    """Return a metric of distances."""
    if what == 'mean':
        return float(values.mean())
    return float(np.quantile(values, 0.95 if what == '95 %' else 0.5))


def _misses(of: Sequence[SteeringOutcome], name: str) -> FloatArray:
    return np.array([1e3 * one.ends[name].miss for one in of])


def _times(of: Sequence[SteeringOutcome], name: str) -> tuple[float, float]:
    """Return the median times of a step and of a tip measurement update [ms]."""
    step = float(np.median([1e3 * one.ends[name].time for one in of]))
    return step, float(np.median([1e3 * one.look for one in of]))


def _figures(of: Sequence[SteeringOutcome], name: str) -> tuple[str, ...]:
    miss = _misses(of, name)
    ends = [one.ends[name] for one in of]
    return (
        f'{miss.mean():.3f}',
        f'{miss.std():.3f}',
        f'{_statistic(miss, "median"):.3f}',
        f'{_statistic(miss, "95 %"):.3f}',
        f'{100.0 * np.mean(miss <= 1.0):.1f} %',
        f'{1e3 * np.mean([end.way for end in ends]):.0f}',
        f'{np.mean([end.turns for end in ends]):.1f}',
        f'{np.mean([end.load for end in ends]):.1f}',
        f'{1e3 * np.median([end.time for end in ends]):.2f}',
    )


def _best(of: Sequence[SteeringOutcome], medium: str) -> list[Bar]:
    """Return the bars of our controller against the best of the others."""
    bars = []
    for what in ('mean', '95 %'):
        found = {name: _statistic(_misses(of, name), what) for name in CONTROLLERS}
        ours = found.pop('ours')
        # It is also part of our controller.
        del found['plan for the mean']
        bars.append(
            Bar(f'{what} over the best baseline, {medium}', ours / min(found.values()), 1.0)
        )
    return bars
