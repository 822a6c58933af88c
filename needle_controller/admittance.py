# SPDX-License-Identifier: Apache-2.0
"""Admittance: converts the force of a law to positions, for a position-controlled robot."""

from typing import Final

from needle_controller.laws.axis import Axis
from needle_ros.timing import NANOSECONDS

#: Longest time of one step, in periods: missing samples are not made up for.
_LONGEST: Final = 2.0


class Admittance:
    r"""
    Virtual needle base that is driven by the force of a law and commands the robot's position.

    The base has the inertia and the friction of the nominal model, so that the law controls its
    nominal plant:

    .. math:: M \dot{v} = f - \mu_v v - \mu_s(v)

    Each step is the exact flow under a constant force, in which Coulomb friction is set-valued: a
    force below friction holds the position, and a constant larger one leads to the velocity
    :math:`(f - \mu_s) / \mu_v`. The base is passive.

    Parameters
    ----------
    axis : Axis
        Inertia and friction.
    period : float
        Sample period [s].
    speed : float
        Largest speed of the base [m/s].
    lead : float
        Largest distance of the command from the measurement [m].
    depths : tuple of float
        Least and largest insertion depth to command [m].

    Examples
    --------
    >>> from needle_controller import Axis
    >>> axis = Axis(inertia=0.3, viscous=300.0, coulomb=0.5)
    >>> base = Admittance(axis, period=0.01, speed=0.05, lead=2e-3, depths=(0.0, 0.2))
    >>> base.step(0.4, measured=0.02, stamp=0)
    0.02
    >>> for k in range(1, 20):
    ...     position = base.step(3.5, measured=base.position, stamp=k * 10_000_000)
    >>> print(f'{base.velocity:.4f} m/s')
    0.0100 m/s

    """

    def __init__(
        self, axis: Axis, *, period: float, speed: float, lead: float, depths: tuple[float, float]
    ) -> None:
        #: May be exchanged between steps.
        self.axis = axis
        self._period, self._speed, self._lead = period, speed, lead
        self._low, self._high = depths
        #: Commanded insertion depth [m]; None before the first step.
        self.position: float | None = None
        #: Velocity of the base [m/s].
        self.velocity = 0.0
        #: Last measured insertion depth [m].
        self.measured = 0.0
        #: Stamp of the last step [ns]; None at rest.
        self.answered: int | None = None

    def step(self, force: float, measured: float, stamp: int) -> float:
        """
        Move under a force until the next sample; a repeated stamp changes nothing.

        Parameters
        ----------
        force : float
            Force on the base, less known loads [N].
        measured : float
            Measured insertion depth of the robot [m].
        stamp : int
            Time of the measurement [ns].

        Returns
        -------
        float
            Insertion depth to command [m].

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
        """
        Stop the base at once.

        Returns
        -------
        float or None
            Insertion depth to hold [m]: the last commanded depth, or None.

        """
        self.velocity, self.answered = 0.0, None
        return self.position

    def give_way(self) -> float | None:
        """
        Stop the base at the last measured position of the robot, so that it no longer pushes.

        Returns
        -------
        float or None
            As for `hold`.

        """
        if self.position is not None:
            self.position = self.measured
        return self.hold()
