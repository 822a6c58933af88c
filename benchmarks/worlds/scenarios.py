# SPDX-License-Identifier: Apache-2.0
"""Scenarios by name: a needle, a guide, a sensor, and what the laws are given."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any, cast, Final
import zlib

from benchmarks.steering import nominal, PATH_NOISE, TRUE
from benchmarks.worlds.bevel import BevelNeedle, bicycle_curvature, CURVATURE, LEAD
from benchmarks.worlds.breathing import BreathingTissue, draw_breath
from benchmarks.worlds.faulty_guide import FaultyGuide, TURN
from benchmarks.worlds.inclusions import draw_obstacles, Inclusions
from benchmarks.worlds.nonlinear_tissue import HARDENING, NonlinearTissue, YIELDING
from benchmarks.worlds.pointing import PointingNeedle
from benchmarks.worlds.rod import ExactRod
from benchmarks.worlds.sensors import (
    Bursts,
    Colored,
    Distorted,
    Sensor,
    TRACKER,
    ULTRASOUND,
    WhiteNoise,
)
from benchmarks.worlds.stiffness_field import draw_field, StiffnessField
from benchmarks.worlds.world import draw_wander, DrawnConstants, IndependentNeedle
from needle_controller.steering.law import GuideSetpoint
from needle_controller.steering.responses import SteeringModel
from needle_controller.steering.settings import SteeringLimits, SteeringPrior
from needle_controller.steering.simulation import SteeringPlant
from needle_dynamics import FloatArray
from needle_dynamics.steering.needle import SteeredNeedle
from needle_dynamics.steering.parameters import with_lengths
import numpy as np

#: Distance of the tip measurements [m], and numbers of steps of an insertion.
STEP, STEPS = 5e-3, (12, 16, 20, 24)

#: Nominal media: bending lengths of 25, 35 and 50 mm.
MEDIA: Final = ('lambda 25 mm', 'lambda 35 mm', 'lambda 50 mm')

#: Deviation of the needles from their nominal bending length, skin, and curvature.
SPREAD: Final = 0.3

#: Error of the direction of a bevel [rad].
_MOUNTED: Final = 0.1

#: Part of the guide's range with which the targets are made, and changes of its direction.
_RANGE, _LEGS = 0.8, 3

#: Builders of the needle: random numbers, constants and depths.
Build = Callable[[np.random.Generator, DrawnConstants, FloatArray], IndependentNeedle]

#: Builders of the sensor: random numbers.
Sense = Callable[[np.random.Generator], Sensor]


@dataclass(frozen=True, slots=True)
class WorldScenario:
    """A simulated needle with its guide and its sensor."""

    build: Build
    sense: Sense = WhiteNoise
    noise: float = TRACKER  #: standard deviation of a measurement that the laws are given [m]
    guide: float = 6e-3  #: limit of the guide [m]
    curvature: float = 0.0  #: curvature of a needle that is steered by roll [1/m]
    skin: bool = True  #: whether the nominal model has the skin


def _bevel(
    curvature: float, lead: float, rng: np.random.Generator, c: DrawnConstants, depths: FloatArray
) -> IndependentNeedle:
    bend = curvature * (1.0 + SPREAD * rng.uniform(-1.0, 1.0))
    return BevelNeedle(c, depths, bend, lead, roll=_MOUNTED * rng.standard_normal())


def _beam(_rng: np.random.Generator, c: DrawnConstants, depths: FloatArray) -> IndependentNeedle:
    return StiffnessField(c, depths)


def _gained(rng: np.random.Generator, c: DrawnConstants, depths: FloatArray) -> IndependentNeedle:
    x, z = rng.uniform(0.8, 1.2, 2)
    return FaultyGuide(c, depths, gap=5e-4, gain=(x, z))


def _own(rng: np.random.Generator, c: DrawnConstants, depths: FloatArray) -> IndependentNeedle:
    """Return the needle of the project's own model."""
    needle, steering = nominal(MEDIA[1])
    steering = replace(
        steering,
        skin_stiffness=c.skin,
        bevel_load=(float(np.hypot(*c.bevel)),),
        path_noise=PATH_NOISE,
    )
    needle = replace(needle, tissue_stiffness=c.tissue)
    seed, roll = int(rng.integers(2**31)), float(np.arctan2(*c.bevel))
    one = SteeredNeedle(needle, steering, tilt=c.tilt, roll=roll, seed=seed)
    return cast(IndependentNeedle, SteeringPlant(one, depths, c.frame))


def _ultrasound(rng: np.random.Generator) -> Sensor:
    size = float(np.exp(rng.uniform(np.log(2e-4), np.log(1.7e-3))))
    return Colored(WhiteNoise(rng, ULTRASOUND), rng, size)


SCENARIOS: Final[Mapping[str, WorldScenario]] = {
    'own': WorldScenario(_own),
    'beam': WorldScenario(_beam),
    'skin not in the model': WorldScenario(_beam, skin=False),
    'hardening': WorldScenario(lambda _, c, depths: NonlinearTissue(c, depths, HARDENING)),
    'yielding': WorldScenario(lambda _, c, depths: NonlinearTissue(c, depths, YIELDING)),
    'rod': WorldScenario(lambda _, c, depths: ExactRod(c, depths)),
    'rod, guide 12 mm': WorldScenario(lambda _, c, depths: ExactRod(c, depths), guide=12e-3),
    'unicycle': WorldScenario(partial(_bevel, CURVATURE, 0.0), curvature=CURVATURE),
    'bicycle': WorldScenario(
        partial(_bevel, bicycle_curvature(), LEAD), curvature=bicycle_curvature()
    ),
    'cuts where it points': WorldScenario(lambda _, c, depths: PointingNeedle(c, depths)),
    'stiffness field': WorldScenario(
        lambda rng, c, depths: StiffnessField(c, depths, draw_field(rng))
    ),
    'inclusions': WorldScenario(lambda rng, c, depths: Inclusions(c, depths, draw_obstacles(rng))),
    'breathing, gated': WorldScenario(
        lambda rng, c, depths: BreathingTissue(c, depths, draw_breath(rng, gated=True))
    ),
    'breathing': WorldScenario(
        lambda rng, c, depths: BreathingTissue(c, depths, draw_breath(rng, gated=False))
    ),
    'faulty guide': WorldScenario(_gained),
    'turned sensor': WorldScenario(lambda _, c, depths: FaultyGuide(c, depths, turn=TURN)),
    'distorted sensor': WorldScenario(_beam, lambda rng: Distorted(WhiteNoise(rng), rng)),
    'colored 0.3 mm': WorldScenario(
        _beam, lambda rng: Colored(WhiteNoise(rng, ULTRASOUND), rng, 3e-4), ULTRASOUND
    ),
    'colored 0.2 to 1.7 mm': WorldScenario(_beam, _ultrasound, ULTRASOUND),
    'bursts': WorldScenario(
        _beam, lambda rng: Bursts(WhiteNoise(rng, ULTRASOUND), rng), ULTRASOUND
    ),
}


class Case:
    """A needle of a scenario with its target; all of it depends on the seed only."""

    def __init__(self, name: str, seed: int) -> None:
        self.scenario, self._key = SCENARIOS[name], [seed, zlib.crc32(name.encode())]
        rng = np.random.default_rng(seed)
        self.medium = MEDIA[seed % len(MEDIA)]
        self.steps = int(rng.choice(STEPS))
        self.depths = STEP * np.arange(self.steps + 1.0)
        length, skin = (1.0 + SPREAD * rng.uniform(-1.0, 1.0, 2)).tolist()
        needle, steering = with_lengths(*nominal(self.medium), length, skin)
        tilt, frame, bevel = (
            size * rng.standard_normal(2) for size in (TRUE.tilt, TRUE.frame, TRUE.bevel)
        )
        self._constants = DrawnConstants(
            stiffness=needle.bending_stiffness,
            tissue=needle.tissue_stiffness,
            skin=steering.skin_stiffness,
            free=steering.free_length,
            tilt=_pair(tilt),
            bevel=_pair(bevel),
            frame=_pair(frame),
            wander=draw_wander(rng),
        )
        self.target = self._reached(rng)

    def world(self) -> IndependentNeedle:
        """Return the needle before its insertion."""
        return self.scenario.build(np.random.default_rng(self._key), self._constants, self.depths)

    def sensor(self) -> Sensor:
        """Return the sensor before the first measurement."""
        return self.scenario.sense(np.random.default_rng([*self._key, 1]))

    def model(self) -> SteeringModel:
        """Return the nominal model that the laws are given."""
        s = self.scenario
        return _model(self.medium, self.steps, s.noise, s.curvature, s.skin)

    def limits(self, *, roll: bool) -> SteeringLimits:
        """Return the defaults of the node, or turns instead of the guide."""
        if roll:
            return SteeringLimits(guide_limit=0.0, turns=self.steps)
        return SteeringLimits(guide_limit=self.scenario.guide)

    def _reached(self, rng: np.random.Generator) -> FloatArray:
        """Return the end of an insertion with random motions within the limits [m]."""
        world, limits = self.world(), self.limits(roll=False)
        guide, roll = np.zeros(2), 0.0
        most = _RANGE * limits.guide_limit
        ends = rng.uniform(-most, most, (_LEGS, 2))
        rolls = rng.uniform(-np.pi, np.pi, _LEGS) if self.scenario.curvature else np.zeros(_LEGS)
        for k in range(self.steps):
            leg = k * _LEGS // self.steps
            change = np.clip(ends[leg] - guide, -limits.guide_step, limits.guide_step)
            guide, roll = guide + change, float(rolls[leg])
            world.guide(GuideSetpoint(float(guide[0]), float(guide[1]), roll))
            world.insert()
        return world.tip


def _pair(values: FloatArray) -> tuple[float, float]:
    x, z = values.tolist()
    return x, z


@lru_cache(maxsize=64)
def _model(medium: str, steps: int, noise: float, curvature: float, skin: bool) -> SteeringModel:
    needle, steering = nominal(medium)
    given: dict[str, Any] = {}
    if curvature:
        # A load F bends the path of a long needle by F lambda / (E I).
        load = curvature * needle.bending_stiffness / float(medium.split()[1]) * 1e3
        steering = replace(steering, bevel_load=(load,))
        given = {'bevel': SPREAD * load}
    if not skin:
        steering = replace(steering, skin_stiffness=0.0)
    return SteeringModel(
        needle, steering, STEP * np.arange(steps + 1.0), SteeringPrior(noise=noise, **given)
    )
