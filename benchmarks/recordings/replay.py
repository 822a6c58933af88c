# SPDX-License-Identifier: Apache-2.0
"""Steering laws in closed loop on plants that repeat recorded insertions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import hypot, nan
from typing import Any, Final, NamedTuple

from benchmarks.page import PageSection
from benchmarks.recordings.plants import BeamMedium, Medium, recorded_plant, ResponseMedium
from needle_controller.steering.law import build_law, SteeringFaultError, SteeringLaw, TipEstimate
from needle_controller.steering.laws.multi_hypothesis import MultiHypothesisLaw, OutOfReachError
from needle_controller.steering.responses import SteeringModel
from needle_controller.steering.settings import SteeringLimits, SteeringPrior
from needle_controller.steering.simulation import simulate_steering, SteeringPlant
from needle_dynamics import FloatArray
from needle_dynamics.needles import DEFAULT_NEEDLE, NEEDLES
from needle_identification import SteeringRecording
import numpy as np

#: Plants by name.
PLANTS: Final[Mapping[str, type[BeamMedium] | type[ResponseMedium]]] = {
    'fitted beam': BeamMedium,
    'model-free response': ResponseMedium,
}

#: Laws of the project that move the guide, ours first.
LAWS: Final = ('multi_hypothesis', 'springs', 'broyden', 'open_loop')

#: Target: the axis of the guide at the last depth [m].
_TARGET: Final = (0.0, 0.0)


@dataclass(frozen=True, slots=True)
class ReplaySettings:
    """
    Settings of the laws: those of the node by default.

    Attributes
    ----------
    skin : float
        Nominal stiffness of the skin over the stiffness of the tissue [m].
    prior : SteeringPrior
        Prior uncertainty.
    limits : SteeringLimits
        Limits of the guide.

    """

    skin: float = 0.0
    prior: SteeringPrior = field(default_factory=SteeringPrior)
    limits: SteeringLimits = field(default_factory=SteeringLimits)

    def model(self, depths: FloatArray) -> SteeringModel:
        """Return the model for all laws."""
        needle, steering, _ = NEEDLES[DEFAULT_NEEDLE]
        skin = self.skin * needle.tissue_stiffness
        return SteeringModel(needle, replace(steering, skin_stiffness=skin), depths, self.prior)


#: Settings by name.
SETTINGS: Final[Mapping[str, ReplaySettings]] = {
    'node defaults': ReplaySettings(),
    'skin 20 mm': ReplaySettings(skin=0.02),
    'path_noise 3e-3': ReplaySettings(prior=SteeringPrior(path_noise=3e-3)),
}


class ReplayedInsertion(NamedTuple):
    """
    Insertion under a law.

    Attributes
    ----------
    recording, medium : str
        Recording and its medium.
    stopped : str
        Message of the law if it refused the target or stopped the needle, '' otherwise.
    miss : float
        Distance of the tip from the target at the last depth [m]. If the law stopped, the needle
        is inserted with the guide at rest.
    held : bool or None
        Whether the 95 % ellipse of the final tip before the last measurement contains the tip.
    travel, load : float
        Distance traveled by the guide [m], and largest force on the guide [N].

    """

    recording: str
    medium: str
    stopped: str
    miss: float
    held: bool | None
    travel: float
    load: float


def steer(
    name: str, model: SteeringModel, limits: SteeringLimits, plant: SteeringPlant
) -> tuple[str, bool | None, float, float]:
    """Insert a plant to the end; return `stopped`, `held`, `travel` and `load`."""
    expected: TipEstimate | None = None
    law: SteeringLaw | None = None

    def watch(at: SteeringPlant) -> None:
        nonlocal expected
        if at.done and law is not None:
            expected = law.expected()

    stopped, travel, load = '', nan, nan
    try:
        law = build_law(name, model, _TARGET, limits)
        done = simulate_steering(law, plant, lambda tip: tip, watch, limits)
        travel, load = done.travel, done.load
    except (OutOfReachError, SteeringFaultError) as error:
        stopped = str(error)
    while not plant.done:
        plant.insert()
    held = None if expected is None or stopped else expected.contains(plant.tip)
    return stopped, held, travel, load


def replay(
    media: Mapping[str, Sequence[SteeringRecording]],
    fitted: Mapping[str, Medium],
    settings: ReplaySettings,
    law: str,
) -> list[ReplayedInsertion]:
    """Insert every recording once under a law, on the fitted plant of its medium."""
    found = []
    models: dict[bytes, SteeringModel] = {}
    for medium, recordings in media.items():
        for one in recordings:
            key = one.depth.tobytes()
            if key not in models:
                models[key] = settings.model(one.depth)
            plant = recorded_plant(fitted[medium], one)
            stopped, held, travel, load = steer(law, models[key], settings.limits, plant)
            miss = hypot(*plant.tip.tolist())
            found.append(ReplayedInsertion(one.name, medium, stopped, miss, held, travel, load))
    return found


class _Followed(MultiHypothesisLaw):
    """Our law that is told the recorded positions of the guide, and plans nothing."""

    recorded: FloatArray

    def _choose(self) -> complex:
        x, z = self.recorded[self.step + 1].tolist()
        return complex(x, z)


class FollowedInsertion(NamedTuple):
    """
    Recording that our law follows, without a plan.

    Attributes
    ----------
    stopped : str
        Message of the law if it declared the measurements implausible, '' otherwise.
    held, steps : int
        Number of predicted next tips whose 95 % ellipse contains the measurement, and of all.

    """

    stopped: str
    held: int
    steps: int


def follow(model: SteeringModel, recording: SteeringRecording) -> FollowedInsertion:
    """Update our law with the recorded tip and guide at each depth."""
    law = _Followed(model, _TARGET, SteeringLimits(guide_step=np.inf, load_limit=np.inf))
    law.recorded = recording.guide
    held = 0
    noise = model.prior.noise**2 * np.eye(2)
    for k, tip in enumerate(recording.tip):
        if k:
            ahead = law.expected(k)
            held += TipEstimate(ahead.mean, ahead.covariance + noise).contains(tip)
        try:
            law.update(tip, k)
        except SteeringFaultError as error:
            return FollowedInsertion(str(error), held, k)
        if k < len(recording.tip) - 1:
            law.plan()
    return FollowedInsertion('', held, len(recording.tip) - 1)


def figures(found: Sequence[ReplayedInsertion]) -> dict[str, Any]:
    """Return count, stopped, mean, median and 95 % of the miss [mm], and coverage."""
    miss = 1e3 * np.array([one.miss for one in found])
    held = [one.held for one in found if one.held is not None]
    travel = [1e3 * one.travel for one in found if not one.stopped]
    return {
        'insertions': len(found),
        'stopped': sum(bool(one.stopped) for one in found),
        'mean': float(miss.mean()),
        'median': float(np.median(miss)),
        '95 %': float(np.quantile(miss, 0.95)),
        'coverage': float(np.mean(held)) if held else None,
        'guide travel': float(np.mean(travel)) if travel else None,
    }


HEADS: Final = (
    'plant', 'settings', 'law', 'medium', 'insertions', 'stopped', 'mean', 'median', '95 %',
    'coverage', 'guide travel',
)  # fmt: skip


def row(of: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the cells of a row by `HEADS`."""
    return tuple(_cell(name, of[name]) for name in HEADS)


def _cell(name: str, value: Any) -> str:
    if value is None:
        return ''
    if name == 'coverage':
        return f'{100.0 * value:.0f} %'
    return f'{value:.2f}' if isinstance(value, float) else str(value)


def section(rows: Sequence[Mapping[str, Any]], notes: str) -> PageSection:
    """Return the table of closed loops."""
    return PageSection(
        'Closed loop: distance of the tip from the target [mm]',
        HEADS,
        [row(one) for one in rows],
        notes,
    )
