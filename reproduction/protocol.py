# SPDX-License-Identifier: Apache-2.0
"""Commanded motion and force in the experiments of sections 3.2.2.2 and 3.2.2.3."""

from collections.abc import Mapping
from dataclasses import dataclass
from math import cos, pi, sin
from pathlib import Path
from typing import Final, NamedTuple

from needle_insertion.report.paper_tables import FORCE_LEVELS

#: Recordings shipped with the source tree.
SHIPPED_BAGS: Final = Path(__file__).parents[1] / 'bags'

#: Insertion depth at which the tip is past the tissue, so that nothing is cut [m].
START_DEPTH: Final = 0.1

#: Speeds of the strokes [m/s], in the range of manual insertion.
SPEEDS: Final = (0.002, 0.005, 0.010, 0.015, 0.020)

STROKE_TIME, REST_TIME = 0.75, 0.15  #: Time of one stroke, and of a rest [s].

#: Acceleration and deceleration time of a stroke [s], and its number of steps.
EASE_TIME, _EASE_STEPS = 0.05, 5

#: Push that determines the break-away force: its largest force [N], which moves every sampled
#: needle, its duration, and the return time [s].
PUSH, PUSH_TIME, RETURN_TIME = 1.0, 1.5, 0.25

DIRECTIONS: Final = 8  #: Number of directions of the presses, evenly around the circle.

#: Times of one press [s]: force up or down, force held, at rest.
RAMP_TIME, HOLD_TIME, RELEASED_TIME = 0.15, 0.35, 0.15

#: Default and largest speed at which a run is recorded, in multiples of real time.
SPEED: Final = 10.0
FASTEST: Final = 100.0


class TrajectoryPoint(NamedTuple):
    """Point of the commanded trajectory: motion if it has positions, else force."""

    time: float
    positions: tuple[float, ...] = ()
    effort: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class ExperimentProtocol:
    """One experiment on the simulated robot."""

    name: str  #: First part of the names of its bags.
    joints: tuple[str, ...]  #: Commanded joints.
    #: Trajectory: times [s], insertion depths [m], forces [N].
    points: tuple[TrajectoryPoint, ...]
    motion: str  #: Topic of the motion, sampled as often as ``/base_wrench``.
    plant: Mapping[str, object]  #: Parameters of the plant, with its mode.

    @property
    def duration(self) -> float:
        return self.points[-1].time

    @property
    def sampled(self) -> tuple[str, str]:
        """Topics sampled at the rate of the plant."""
        return '/base_wrench', self.motion

    @property
    def topics(self) -> tuple[str, ...]:
        """Topics of a bag: inputs of the identification, commands and configuration."""
        return *self.sampled, '/joint_trajectory', '/plant/configuration'


def _friction_points() -> tuple[TrajectoryPoint, ...]:
    """Return the protocol of section 3.2.2.2, with the tip past the tissue: a push, strokes."""
    # Strokes begin and end with an acceleration within the limits of the base.
    points = [
        TrajectoryPoint(REST_TIME, effort=(0.0,)),
        TrajectoryPoint(REST_TIME + PUSH_TIME, effort=(PUSH,)),
    ]
    for time in (RETURN_TIME, REST_TIME):
        points.append(TrajectoryPoint(points[-1].time + time, positions=(START_DEPTH,)))
    easing = [EASE_TIME * k / _EASE_STEPS for k in range(1, _EASE_STEPS + 1)]
    times = [*easing, *(STROKE_TIME - time for time in reversed(easing)), STROKE_TIME]
    for speed in SPEEDS:
        end = START_DEPTH + _travel(STROKE_TIME, speed)
        for begin, direction in ((START_DEPTH, 1.0), (end, -1.0)):
            start = points[-1].time
            depths = [begin + direction * _travel(time, speed) for time in times]
            points += [
                TrajectoryPoint(start + t, (at,)) for t, at in zip(times, depths, strict=True)
            ]
            points.append(TrajectoryPoint(start + STROKE_TIME + REST_TIME, (depths[-1],)))
    return tuple(points)


def _travel(time: float, speed: float) -> float:
    """Return the distance in a stroke [m] after a time [s]; the speed rises and falls linearly."""
    begun, left = min(time, EASE_TIME), min(STROKE_TIME - time, EASE_TIME)
    steady = time - begun - (EASE_TIME - left)
    return speed * (steady + (begun**2 + EASE_TIME**2 - left**2) / (2.0 * EASE_TIME))


def _stiffness_points() -> tuple[TrajectoryPoint, ...]:
    """Return the protocol of section 3.2.2.3: at each force level one press in each direction."""
    points = [TrajectoryPoint(RELEASED_TIME, effort=(0.0, 0.0))]
    for level in FORCE_LEVELS:
        for k in range(DIRECTIONS):
            angle = 2.0 * pi * k / DIRECTIONS
            force = level * cos(angle), level * sin(angle)
            for time, effort in (
                (RAMP_TIME, force),
                (HOLD_TIME, force),
                (RAMP_TIME, (0.0, 0.0)),
                (RELEASED_TIME, (0.0, 0.0)),
            ):
                points.append(TrajectoryPoint(points[-1].time + time, effort=effort))
    return tuple(points)


#: Experiments by name.
PROTOCOLS: Final[Mapping[str, ExperimentProtocol]] = {
    'friction': ExperimentProtocol(
        name='friction',
        joints=('insertion',),
        points=_friction_points(),
        motion='/joint_states',
        plant={'mode': 'robot', 'depth': START_DEPTH},
    ),
    'stiffness': ExperimentProtocol(
        name='stiffness',
        joints=('x', 'z'),
        points=_stiffness_points(),
        motion='/end_effector_pose',
        plant={'mode': 'indenter', 'indenter.force_rate': 10.0},
    ),
}


def indenter_name(entry: str) -> str:
    """Return the indenter parameter of a stiffness entry: ``stiffness_xx`` for ``k_xx``."""
    return entry.replace('k_', 'stiffness_')
