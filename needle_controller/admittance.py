# SPDX-License-Identifier: Apache-2.0
"""Admittance: converts the force of a law to positions, for a position-controlled robot."""

from typing import Final

from needle_controller.laws.axis import Axis
from needle_ros.timing import NANOSECONDS

_LONGEST: Final = 2.0  #: Longest step, in periods: missing samples are not made up for.


class Admittance:
    r"""
    Virtual needle base that is driven by the force of a law and commands the robot's position.

    The base has the inertia and the friction of the nominal axis, so that the law controls its
    nominal plant: :math:`M \dot{v} = f - \mu_v v - \mu_s(v)`. Each step is the exact flow under a
    constant force, in which Coulomb friction is set-valued: a force below friction holds the
    position, and a constant larger one leads to the velocity :math:`(f - \mu_s) / \mu_v`. The base
    is passive. ``period`` is the sample period [s], ``speed`` the largest speed of the base [m/s],
    ``lead`` the largest distance of the command from the measurement [m], and ``depths`` the least
    and largest insertion depth to command [m].
    """

    def __init__(
        self, axis: Axis, *, period: float, speed: float, lead: float, depths: tuple[float, float]
    ) -> None:
        self.axis = axis  #: May be exchanged between steps.
        self._period, self._speed, self._lead = period, speed, lead
        self._low, self._high = depths
        #: Commanded insertion depth [m]; None before the first step.
        self.position: float | None = None
        self.velocity = 0.0  #: Velocity of the base [m/s].
        self.measured = 0.0  #: Last measured insertion depth [m].
        self.answered: int | None = None  #: Stamp of the last step [ns]; None at rest.

    def step(self, force: float, measured: float, stamp: int) -> float:
        """
        Return the depth to command [m] under a force less known loads [N] until the next sample.

        Takes the measured depth [m] and its stamp [ns]; a repeated stamp changes nothing.
        """
        before = measured if self.position is None else self.position
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
        within = min(max(within, measured - self._lead), measured + self._lead)
        self.velocity = velocity if within == aim else 0.0
        self.position = within
        return within

    def hold(self) -> float | None:
        """Stop the base at once; return the last commanded depth [m], or None."""
        self.velocity, self.answered = 0.0, None
        return self.position

    def give_way(self) -> float | None:
        """Stop the base where it no longer pushes; see `hold`."""
        if self.position is not None:
            # Of a withdrawing needle the measured depth is the deeper one.
            self.position = min(self.measured, self.position)
        return self.hold()
