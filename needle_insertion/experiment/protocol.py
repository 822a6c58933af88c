"""The experiments of sections 3.2.2.2 and 3.2.2.3: what is commanded, to whom, how often."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import dataclass
from math import cos, pi, sin
from pathlib import Path
from typing import Any, Final, NamedTuple

from needle_dynamics import ParameterError
from needle_dynamics.simulated.force_sensor import HIGHEST_RATE
from needle_insertion.experiment.draw import (
    draw_friction,
    draw_stiffness,
    FORCE_LEVELS,
    TABLE_1,
    TABLE_2,
)

#: Recordings shipped with the source tree.
SHIPPED_BAGS: Final = Path(__file__).parents[2] / 'bags'

#: Inserted length at which the tip has passed the tissue, so that nothing is cut [m].
START_DEPTH: Final = 0.1

#: Speeds of the strokes [m/s]: manual insertion is in this range.
SPEEDS: Final = (0.002, 0.005, 0.010, 0.015, 0.020)

#: Time of one stroke, and of a rest [s].
STROKE_TIME, REST_TIME = 0.75, 0.15

#: Time in which a stroke gains its speed, and loses it [s], and in how many steps.
EASE_TIME, _EASE_STEPS = 0.05, 5

#: The push that finds the break-away: force at its end [N], which moves any needle drawn, its
#: duration, and the time to come back [s].
PUSH, PUSH_TIME, RETURN_TIME = 1.0, 1.5, 0.25

#: Directions in which the tissue is pressed, evenly around the circle.
DIRECTIONS: Final = 8

#: Times of one press [s]: force up or down, force held, at rest.
RAMP_TIME, HOLD_TIME, RELEASED_TIME = 0.15, 0.35, 0.15

#: Sample rates at which strokes and presses are resolved [Hz].
RATES: Final = (40.0, 5000.0)

#: Times real time at which a run is recorded, and the fastest.
SPEED: Final = 10.0
FASTEST: Final = 100.0

#: Most repeats of one call.
_MOST: Final = 1000


class Point(NamedTuple):
    """A point of the commanded trajectory: motion where it has positions, else force."""

    time: float
    positions: tuple[float, ...] = ()
    effort: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Protocol:
    """
    One experiment on the stand-in.

    Attributes
    ----------
    name : str
        Bags are called after it.
    joints : tuple of str
        What the points command.
    points : tuple of Point
        The trajectory: times [s], inserted length [m], force [N].
    motion : str
        Topic of the motion, sampled as often as ``/base_wrench``.
    stand_in : mapping
        Parameters of the plant that make it the stand-in.

    """

    name: str
    joints: tuple[str, ...]
    points: tuple[Point, ...]
    motion: str
    stand_in: Mapping[str, object]

    @property
    def duration(self) -> float:
        """Time of the last point [s]."""
        return self.points[-1].time

    @property
    def sampled(self) -> tuple[str, str]:
        """Topics sampled at the rate of the plant."""
        return '/base_wrench', self.motion

    @property
    def topics(self) -> tuple[str, ...]:
        """Topics that identification needs, and those that say how the bag came about."""
        return *self.sampled, '/joint_trajectory', '/plant/configuration'


def friction_points() -> tuple[Point, ...]:
    """
    Return the protocol of section 3.2.2.2, the tip past the tissue.

    The base is pushed with a force that rises from zero until the needle has moved, and is
    brought back; then one stroke in and one out at each of `SPEEDS`, with rests. Strokes begin
    and end with an acceleration within the limits of the base.
    """
    points = [Point(REST_TIME, effort=(0.0,)), Point(REST_TIME + PUSH_TIME, effort=(PUSH,))]
    for time in (RETURN_TIME, REST_TIME):
        points.append(Point(points[-1].time + time, positions=(START_DEPTH,)))
    easing = [EASE_TIME * k / _EASE_STEPS for k in range(1, _EASE_STEPS + 1)]
    times = [*easing, *(STROKE_TIME - time for time in reversed(easing)), STROKE_TIME]
    for speed in SPEEDS:
        end = START_DEPTH + _travel(STROKE_TIME, speed)
        for begin, direction in ((START_DEPTH, 1.0), (end, -1.0)):
            start = points[-1].time
            depths = [begin + direction * _travel(time, speed) for time in times]
            points += [Point(start + t, (at,)) for t, at in zip(times, depths, strict=True)]
            points.append(Point(start + STROKE_TIME + REST_TIME, (depths[-1],)))
    return tuple(points)


def _travel(time: float, speed: float) -> float:
    """Return the way of a stroke after a time, the speed rising and falling evenly at its ends."""
    begun, left = min(time, EASE_TIME), min(STROKE_TIME - time, EASE_TIME)
    cruised = time - begun - (EASE_TIME - left)
    return speed * (cruised + (begun**2 + EASE_TIME**2 - left**2) / (2.0 * EASE_TIME))


def stiffness_points() -> tuple[Point, ...]:
    """
    Return the protocol of section 3.2.2.3: at each force level one press in each direction.

    A press is a force in the plane (x, z) that rises, is held, falls to zero and rests there.
    """
    points = [Point(RELEASED_TIME, effort=(0.0, 0.0))]
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
                points.append(Point(points[-1].time + time, effort=effort))
    return tuple(points)


#: Experiments by name.
PROTOCOLS: Final[Mapping[str, Protocol]] = {
    'friction': Protocol(
        name='friction',
        joints=('insertion',),
        points=friction_points(),
        motion='/joint_states',
        stand_in={'mode': 'robot', 'depth': START_DEPTH},
    ),
    'stiffness': Protocol(
        name='stiffness',
        joints=('x', 'z'),
        points=stiffness_points(),
        motion='/end_effector_pose',
        stand_in={'mode': 'indenter', 'indenter.force_rate': 10.0},
    ),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Campaign:
    """
    Repeats of one experiment.

    Attributes
    ----------
    protocol : Protocol
        What is done each time.
    repeats : int
        How often.
    seed : int
        Seed of the draws; the k-th run, counted from zero, has the sensor noise of seed + k.
    rate : float
        Samples per second [Hz].
    fixed : bool
        Take the means of the paper's tables each time instead of drawing around them.

    Raises
    ------
    ParameterError
        If a number is out of range.

    """

    protocol: Protocol
    repeats: int = 20
    seed: int = 2014
    rate: float = 250.0
    fixed: bool = False

    def __post_init__(self) -> None:
        if not 1 <= self.repeats <= _MOST:
            raise ParameterError(f'--repeats must be in [1, {_MOST}], got {self.repeats}')
        if self.seed < 0:
            raise ParameterError(f'--seed must be >= 0, got {self.seed}')
        if not RATES[0] <= self.rate <= RATES[1]:
            raise ParameterError(
                f'--rate must be in [{RATES[0]:g}, {RATES[1]:g}] Hz, got {self.rate}'
            )

    def runs(self) -> dict[str, dict[str, object]]:
        """Return the parameters of the plant by the name of the bag."""
        digits = max(2, len(str(self.repeats)))
        common = {
            **self.protocol.stand_in,
            'rate': self.rate,
            # A whole multiple is wanted.
            'sensor.rate': HIGHEST_RATE // self.rate * self.rate,
        }
        return {
            f'{self.protocol.name}_{k + 1:0{digits}d}': {**common, 'seed': self.seed + k, **drawn}
            for k, drawn in enumerate(self._drawn())
        }

    def _drawn(self) -> list[dict[str, Any]]:
        if self.protocol.name == 'friction':
            friction = draw_friction(self.repeats, self.seed)
            if self.fixed:
                friction = [{name: mean for name, (mean, _) in TABLE_1.items()}] * self.repeats
            return [{f'model.{name}': v for name, v in drawn.items()} for drawn in friction]
        stiffness = draw_stiffness(self.repeats, self.seed)
        if self.fixed:
            stiffness = [{name: means for name, (means, _) in TABLE_2.items()}] * self.repeats
        levels = {'indenter.force_levels': list(FORCE_LEVELS)}
        return [
            {**levels, **{f'indenter.{node_name(name)}': list(v) for name, v in drawn.items()}}
            for drawn in stiffness
        ]


def node_name(entry: str) -> str:
    """Return the indenter's name of an entry of the stiffness matrix."""
    return entry.replace('k_', 'stiffness_')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `needle experiment`."""
    parser.add_argument('which', choices=tuple(PROTOCOLS), help='what to identify from it')
    parser.add_argument('output', type=Path, metavar='DIR', help='folder for the bags')
    for name, kind, default, unit, words in (
        ('repeats', int, 20, 'N', 'bags to record'),
        ('seed', int, 2014, 'N', 'of the draws; the k-th run, from 0, has the noise of seed + k'),
        ('rate', float, 250.0, 'Hz', 'of the samples'),
        ('speed', float, SPEED, 'X', 'times real time'),
    ):
        parser.add_argument(
            f'--{name}',
            type=kind,
            default=default,
            metavar=unit,
            help=f'{words} (default {default:g})',
        )
    parser.add_argument(
        '--fixed', action='store_true', help='the means of the tables, not draws around them'
    )
