# SPDX-License-Identifier: Apache-2.0
"""Admittance: converts the force of a law to positions, for a position-controlled robot."""

from collections import deque
from typing import Final

from needle_controller.controller import BaseState
from needle_controller.laws.law import Axis
from needle_ros.timing import NANOSECONDS

_LONGEST: Final = 2.0  #: Longest step, in periods: missing samples are not made up for.


class Admittance:
    r"""
    Virtual needle base that is driven by the force of a law and commands the robot's position.

    The base has the inertia and the friction of the nominal axis, and the law is given its state
    instead of the measured one: it controls its nominal plant, independent of the delay of the
    robot, :math:`M \dot{v} = f - \mu_v v - \mu_s(v)`. Each step is the exact flow under a constant
    force, in which Coulomb friction is set-valued: a force below friction holds the position, and
    a constant larger one leads to the velocity :math:`(f - \mu_s) / \mu_v`. The base is passive.
    ``period`` is the sample period [s], ``speed`` the largest speed of the base [m/s],
    ``lead`` the largest distance of the command from the measurement [m], ``depths`` the least and
    largest insertion depth to command [m], and ``delay`` the delay of the law [samples].
    """

    def __init__(
        self,
        axis: Axis,
        *,
        period: float,
        speed: float,
        lead: float,
        depths: tuple[float, float],
        delay: int = 0,
    ) -> None:
        self.axis = axis  #: May be exchanged between steps.
        self._period, self._speed, self._lead = period, speed, lead
        self._low, self._high = depths
        #: Commanded insertion depth [m]; None before the first step.
        self.position: float | None = None
        self.velocity = 0.0  #: Velocity of the base [m/s].
        self.measured = 0.0  #: Last measured insertion depth [m].
        self.answered: int | None = None  #: Stamp of the last step [ns]; None at rest.
        #: States of the last steps; the first one is by the delay of the law before now.
        self._states = deque[BaseState](maxlen=delay + 1)

    def state(self, measured: float) -> BaseState:
        """Return the state for the law, at a measured depth [m]."""
        rest = measured if self.position is None else self._near(self.position, measured)
        return self._states[0] if self._states else BaseState(rest, 0.0)

    def _near(self, position: float, measured: float) -> float:
        return min(max(position, measured - self._lead), measured + self._lead)

    def step(self, force: float, measured: float, stamp: int) -> float:
        """
        Return the depth to command [m] under a force less known loads [N] until the next sample.

        Takes the measured depth [m] and its stamp [ns]; a repeated stamp changes nothing.
        """
        before = measured if self.position is None else self.position
        if not self._states:
            self._states.append(BaseState(before, self.velocity))
        elapsed = self._period
        if self.answered is not None:
            longest = _LONGEST * self._period
            elapsed = min(max((stamp - self.answered) / NANOSECONDS, 0.0), longest)
        self.answered, self.measured = stamp, measured
        most = self._speed
        aim, velocity = self.axis.propagate(before, self.velocity, force, elapsed)
        velocity = min(max(velocity, -most), most)
        aim = min(max(aim, before - most * elapsed), before + most * elapsed)
        # A base outside the range does not move further out.
        within = min(max(aim, min(self._low, before)), max(self._high, before))
        near = self._near(within, measured)
        self.velocity = velocity if near == aim else 0.0
        self.position = near
        self._states.append(BaseState(near, self.velocity, waits=near != within))
        return near

    def hold(self) -> float | None:
        """Stop the base at once; return the last commanded depth [m], or None."""
        self.velocity, self.answered = 0.0, None
        self._states.clear()
        return self.position

    def give_way(self) -> float | None:
        """Stop the base where it no longer pushes; see `hold`."""
        if self.position is not None:
            # Of a withdrawing needle the measured depth is the deeper one.
            self.position = min(self.measured, self.position)
        return self.hold()
