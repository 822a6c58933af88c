# SPDX-License-Identifier: Apache-2.0
"""Simulated robots with their own joints and units, which know nothing about the controller."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from math import copysign, exp
from typing import Final

from needle_dynamics import NeedleParameters
from needle_ros.wire import Reading
import numpy as np

#: Rate of the robots [Hz], and steps of their simulation in a period.
RATE: Final = 200.0
STEPS: Final = 4

#: A joint that is not the insertion joint.
OTHER: Final = 'door'

_PHANTOM: Final = NeedleParameters.preset('phantom')


@dataclass
class SimulatedRobot:
    """
    Joint with its own unit, and a force sensor in its own axes; subclasses move it.

    `depth` and `velocity` are the truth [m, m/s]. The joint is at `zero` at depth 0, and its
    position grows by 1 / `gain` per meter. `friction` is a factor on the friction of the needle.
    """

    joint: str = 'axis'
    gain: float = 1.0
    zero: float = 0.0
    #: Position of the other joint, in its unit.
    other: float = 1.0
    #: Axis of the sensor into the tissue, and whether it reports the reaction.
    force_axis: str = 'y'
    reaction: bool = False
    friction: float = 1.0
    #: Time constant [s] and dead time [periods] of the drive.
    lag: float = 0.02
    dead: int = 0
    #: Standard deviations of depth [m], velocity [m/s] and force [N].
    noise: tuple[float, float, float] = (2e-6, 1e-4, 0.02)
    depth: float = 0.02
    velocity: float = 0.0
    seed: int = 0

    #: Whether the joint states have a velocity.
    REPORTS_VELOCITY = True

    def __post_init__(self) -> None:
        self._rng = np.random.default_rng(self.seed)
        self.pending: deque[float | None] = deque([None] * self.dead)
        self.goal: float | None = None

    def position(self, depth: float) -> float:
        """Return the position of the joint at a depth [m], in its unit."""
        return depth / self.gain + self.zero

    def take(self, value: float | None) -> None:
        """Receive a command in the unit of the joint, or none, and move for a period."""
        self.pending.append(value)
        value = self.pending.popleft()
        if value is not None:
            self.goal = value
        for _ in range(STEPS):
            self.move(1.0 / RATE / STEPS)

    def move(self, h: float) -> None:
        """Move for a time [s]."""
        raise NotImplementedError

    def resistance(self) -> float:
        """Return the force of the tissue against the motion [N]."""
        dry = _PHANTOM.coulomb_friction * min(abs(self.velocity) / 1e-4, 1.0)
        viscous = _PHANTOM.viscous_friction * self.velocity
        return self.friction * (copysign(dry, self.velocity) + viscous)

    def states(self, stamp: int) -> Reading:
        """Return the joint states."""
        depth, velocity = (
            true + deviation * self._rng.standard_normal()
            for true, deviation in zip((self.depth, self.velocity), self.noise, strict=False)
        )
        velocities = (0.0, velocity / self.gain) if self.REPORTS_VELOCITY else ()
        positions = (self.other, self.position(depth))
        return Reading(stamp, '', (OTHER, self.joint), (positions, velocities, ()))

    def wrench(self, stamp: int) -> Reading:
        """Return the reading of the force sensor."""
        values = [self.noise[2] * self._rng.standard_normal() for _ in range(3)]
        sign = (-1.0 if self.force_axis[0] == '-' else 1.0) * (-1.0 if self.reaction else 1.0)
        values['xyz'.index(self.force_axis[-1])] += sign * self.resistance()
        return Reading(stamp, 'needle_base', (), ((*values, 0.0, 0.0, 0.0),))


class Stage(SimulatedRobot):
    """Follows positions with a lag of first order, without velocities in its joint states."""

    REPORTS_VELOCITY = False

    def move(self, h: float) -> None:
        """Approach the commanded position."""
        if self.goal is None:
            return
        aim = self.gain * (self.goal - self.zero)
        step = (aim - self.depth) * (1.0 - exp(-h / self.lag))
        self.depth, self.velocity = self.depth + step, step / h


class Spindle(SimulatedRobot):
    """Drive with a velocity loop of 5 ms, at most 0.2 m/s, around which positions are followed."""

    def move(self, h: float) -> None:
        """Turn the spindle at the velocity of the drive."""
        if self.goal is None:
            return
        aim = self.gain * (self.goal - self.zero)
        wanted = min(max((aim - self.depth) / self.lag, -0.2), 0.2)
        self.velocity += (wanted - self.velocity) * (1.0 - exp(-h / 5e-3))
        self.depth += self.velocity * h


class Slide(SimulatedRobot):
    """Mass of 0.5 kg with the friction of the needle, moved by forces."""

    def move(self, h: float) -> None:
        """Advance the mass under the last effort."""
        force = (self.goal or 0.0) / self.gain
        push = self.velocity + force * h / 0.5
        dry = self.friction * _PHANTOM.coulomb_friction * h / 0.5
        viscous = self.friction * _PHANTOM.viscous_friction * h / 0.5
        self.velocity = copysign(max(abs(push) - dry, 0.0), push) / (1.0 + viscous)
        self.depth += self.velocity * h
