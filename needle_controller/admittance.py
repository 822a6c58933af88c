"""Admittance: turns the force of a law into positions, for a robot that takes nothing else."""

from __future__ import annotations

from typing import Final

from needle_controller.laws.axis import Axis
from needle_ros.timing import NANOSECONDS

#: Longest time of one step, in periods: time that samples were missing is not made up.
_LONGEST: Final = 2.0


class Admittance:
    r"""
    A virtual needle base, driven by the force of a law; where it goes, the robot is sent.

    The base has the inertia and the friction that the law believes in, so that the law sees the
    plant that it was made for:

    .. math:: M \dot{v} = f - \mu_v v - \mu_s(v)

    Each step is the exact flow under a constant force, in which Coulomb friction is set-valued: a
    force below friction holds the position, and a constant one leads to the speed
    :math:`(f - \mu_s) / \mu_v`. The base never gives more energy than it was given.

    Parameters
    ----------
    axis : Axis
        Inertia and friction.
    period : float
        Sample period [s].
    speed : float
        Largest speed of the base [m/s].
    lead : float
        Farthest that the command may be from the measurement [m].
    depths : tuple of float
        Least and largest inserted length to command [m].

    Attributes
    ----------
    axis : Axis
        As given; it may be exchanged between steps.
    position : float or None
        Inserted length that the robot is sent to [m]; None before the first step.
    velocity : float
        Velocity of the base [m/s].
    answered : int or None
        Stamp of the last step [ns]; None at rest.

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
        self,
        axis: Axis,
        *,
        period: float,
        speed: float,
        lead: float,
        depths: tuple[float, float],
    ) -> None:
        self.axis = axis
        self._period, self._speed, self._lead = period, speed, lead
        self._low, self._high = depths
        self.position: float | None = None
        self.velocity = 0.0
        #: What the robot was last measured at [m].
        self._measured = 0.0
        self.answered: int | None = None

    def step(self, force: float, measured: float, stamp: int) -> float:
        """
        Move under a force until the next sample; a stamp that was answered changes nothing.

        Parameters
        ----------
        force : float
            Force on the base, less known loads [N].
        measured : float
            Inserted length at which the robot is [m].
        stamp : int
            Time of the measurement [ns].

        Returns
        -------
        float
            Inserted length to send the robot to [m].

        """
        before = measured if self.position is None else self.position
        elapsed = self._period
        if self.answered is not None:
            longest = _LONGEST * self._period
            elapsed = min(max((stamp - self.answered) / NANOSECONDS, 0.0), longest)
        self.answered, self._measured = stamp, measured
        most = self._speed
        aim, velocity = self.axis.propagate(before, self.velocity, force, elapsed)
        velocity = min(max(velocity, -most), most)
        aim = min(max(aim, before - most * elapsed), before + most * elapsed)
        # It goes no farther out of the range, wherever it is.
        within = min(max(aim, min(self._low, before)), max(self._high, before))
        within = min(max(within, measured - self._lead), measured + self._lead)
        self.velocity = velocity if within == aim else 0.0
        self.position = within
        return within

    def hold(self) -> float | None:
        """
        Come to rest at once.

        Returns
        -------
        float or None
            Inserted length at which the robot shall stay [m]: the last one; None if there is none.

        """
        self.velocity, self.answered = 0.0, None
        return self.position

    def give_way(self) -> float | None:
        """
        Come to rest where the robot was last measured, so that it no longer pushes.

        Returns
        -------
        float or None
            As for `hold`.

        """
        if self.position is not None:
            self.position = self._measured
        return self.hold()
