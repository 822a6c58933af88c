# SPDX-License-Identifier: Apache-2.0
"""Admittance: converts the force of a law to positions, for a position-controlled robot."""

from collections import deque
from typing import Final

from needle_controller.controller import BaseState
from needle_controller.laws.law import Axis
from needle_ros.timing import NANOSECONDS

_LONGEST: Final = 2.0  #: Longest step, in periods: missing samples are not made up for.
_CLOSE: Final = 0.1  #: Distance of a command from a robot that has followed it, as a part of lead.


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

    A base at rest moves no needle that something else has moved: it restarts at the measured depth
    of a needle that is less deep, or deeper by more than ``lead``.
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
        self._ahead = lead  #: Least distance of the command from a robot that is less deep [m].
        #: Depth at which the base gives way [m]; None while it moves.
        self._goal: float | None = None
        self._stamp: int | None = None  #: Stamp of the last command that may have moved [ns].
        self.answered: int | None = None  #: Stamp of the last step [ns]; None at rest.
        #: States of the last steps; the first one is by the delay of the law before now.
        self._states = deque[BaseState](maxlen=delay + 1)

    def state(self, measured: float) -> BaseState:
        """Return the state for the law, at a measured depth [m]."""
        return self._states[0] if self._states else BaseState(self._rest(measured), 0.0)

    def _rest(self, measured: float) -> float:
        """Return where the base rests, at a measured depth [m]."""
        if self.position is None:
            return measured
        ahead, close = self.position - measured, _CLOSE * self._lead
        stays = -self._lead - close <= ahead <= self._ahead + close
        return self.position if stays else measured

    def _near(self, position: float, measured: float) -> float:
        return min(max(position, measured - self._lead), measured + self._lead)

    def _elapsed(self, last: int | None, stamp: int) -> float:
        """Return the time to move since a stamp [s]; a period at first."""
        if last is None:
            return self._period
        return min(max((stamp - last) / NANOSECONDS, 0.0), _LONGEST * self._period)

    def step(self, force: float, measured: float, stamp: int) -> float:
        """
        Return the depth to command [m] under a force less known loads [N] until the next sample.

        Takes the measured depth [m] and its stamp [ns]; a repeated stamp changes nothing.
        """
        before = self.position
        if before is None or self.answered is None:
            before = self._rest(measured)
        if not self._states:
            self._states.append(BaseState(before, self.velocity))
        elapsed = self._elapsed(self.answered, stamp)
        self.answered, self._ahead, self._goal, self._stamp = stamp, self._lead, None, stamp
        most = self._speed
        aim, velocity = self.axis.propagate(before, self.velocity, force, elapsed)
        velocity = min(max(velocity, -most), most)
        aim = min(max(aim, before - most * elapsed), before + most * elapsed)
        # A base outside the range does not move further out.
        within = min(max(aim, min(self._low, before)), max(self._high, before))
        near = self._near(within, measured)
        self.velocity = velocity if near == aim else 0.0
        self.position = near
        behind = abs(near - measured) > _CLOSE * self._lead
        self._states.append(BaseState(near, self.velocity, near != within, behind))
        return near

    def place(self, position: float, stamp: int) -> None:
        """Command a depth [m] at once, within ``lead`` of the measured one."""
        self.position, self._ahead, self._goal, self._stamp = position, self._lead, None, stamp

    def hold(self, measured: float | None) -> float | None:
        """
        Stop the base at once, at a measured depth [m]; return the depth to command.

        Returns None before the first step, and if the depth is not known.
        """
        self.velocity, self.answered = 0.0, None
        self._states.clear()
        if measured is None:
            # The robot comes to its command meanwhile, or is elsewhere afterwards.
            self._ahead = 0.0
        if self.position is None or measured is None:
            return None
        rest = self._rest(measured)
        if rest != self.position and self._goal is not None:
            # Something else has moved the needle: it does not return.
            self._goal = rest
        self.position = rest
        self._ahead = min(self._ahead, max(self.position - measured, 0.0))
        return self.position

    def give_way(self, measured: float, stamp: int) -> float | None:
        """Move the base with ``speed`` to where it no longer pushes, and stop; see `hold`."""
        if self.position is not None:
            if self._goal is None:
                # Of a withdrawing needle the measured depth is the deeper one.
                self._goal = min(measured, self.position)
            most = self._speed * self._elapsed(self._stamp, stamp)
            self.position = max(self.position - most, min(self._goal, self.position))
            self._stamp = max(stamp, self._stamp or stamp)
        return self.hold(measured)
