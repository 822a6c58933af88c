"""Measurements against their limits."""

from __future__ import annotations

from typing import Final

from needle_controller.controller import Measurement
from needle_controller.safety.limits import SafetyLimits

#: Readings in a row that have to be beyond a limit: one alone may be a fault of the sensor.
_IN_A_ROW: Final = 2


class Guard:
    """
    Holds measurements against the limits; two in a row beyond one violate it.

    Parameters
    ----------
    limits : SafetyLimits
        Limits.
    depths : tuple of float
        Least and largest inserted length to control [m].

    """

    def __init__(self, limits: SafetyLimits, depths: tuple[float, float]) -> None:
        self.limits = limits
        low, high = depths
        self._depths = low - limits.depth_tolerance, high + limits.depth_tolerance
        #: What each topic is beyond, and for how many readings in a row.
        self._beyond: dict[str, tuple[str, int]] = {}

    def _hold(self, topic: str, *readings: tuple[str, float, float, str, str]) -> str | None:
        """Compare readings: quantity, value, limit, unit, name of the limit."""
        for quantity, value, limit, unit, name in readings:
            # Written so that what is not a number is beyond every limit.
            if not abs(value) <= limit:
                return self._count(
                    topic,
                    f'{quantity} {value:.6g} {unit} is beyond the limit of {limit:g} {unit} '
                    f'(safety.{name})',
                )
        self._beyond.pop(topic, None)
        return None

    def _count(self, topic: str, line: str) -> str | None:
        count = self._beyond.get(topic, ('', 0))[1] + 1
        self._beyond[topic] = line, count
        return line if count >= _IN_A_ROW else None

    def is_beyond(self, topic: str) -> bool:
        """
        Return whether the last reading of a topic is beyond a limit, alone or not.

        Parameters
        ----------
        topic : str
            The topic.

        Returns
        -------
        bool
            Whether it is.

        """
        return topic in self._beyond

    def encoders(self, measured: Measurement) -> str | None:
        """
        Return the limit that the encoders violate.

        Parameters
        ----------
        measured : Measurement
            Inserted length, angle and their velocities.

        Returns
        -------
        str or None
            The line; None within the limits.

        """
        low, high = self._depths
        depth, limits = measured.depth, self.limits
        if not low <= depth <= high:
            return self._count(
                'joint_states',
                f'inserted length {depth:.6g} m is outside [{low:g}, {high:g}] m '
                '(lowest_depth, highest_depth, safety.depth_tolerance)',
            )
        return self._hold(
            'joint_states',
            ('insertion speed', measured.speed, limits.speed, 'm/s', 'speed'),
            ('angle', measured.angle, limits.angle, 'rad', 'angle'),
            ('angular speed', measured.angular_speed, limits.angular_speed, 'rad/s',
             'angular_speed'),
        )  # fmt: skip

    def tracking(self, error: float) -> str | None:
        """
        Return the limit that the distance from the reference [m] violates.

        Parameters
        ----------
        error : float
            Distance [m].

        Returns
        -------
        str or None
            The line; None within the limit.

        """
        limit = self.limits.tracking_error
        return self._hold('reference', ('tracking error', error, limit, 'm', 'tracking_error'))

    def wrench(self, axial: float, lateral: float, moment: float) -> str | None:
        """
        Return the limit that forces [N] or the moment [N m] on the sensor violate.

        Parameters
        ----------
        axial, lateral, moment : float
            Forces along y and z [N], and moment about x [N m].

        Returns
        -------
        str or None
            The line; None within the limits.

        """
        return self._hold(
            'base_wrench',
            ('axial force', axial, self.limits.axial_load, 'N', 'axial_load'),
            ('lateral force', lateral, self.limits.lateral_load, 'N', 'lateral_load'),
            ('moment', moment, self.limits.moment_load, 'N m', 'moment_load'),
        )

    def tip(self, deflection: float) -> str | None:
        """
        Return the limit that the deflection of the tip [m] violates.

        Parameters
        ----------
        deflection : float
            Deflection [m].

        Returns
        -------
        str or None
            The line; None within the limit.

        """
        limit = self.limits.tip_deflection
        return self._hold(
            'tip_deflection', ('tip deflection', deflection, limit, 'm', 'tip_deflection')
        )

    def forget(self, topic: str) -> None:
        """
        Forget what a topic said last.

        Parameters
        ----------
        topic : str
            The topic.

        """
        self._beyond.pop(topic, None)

    @property
    def violated(self) -> str | None:
        """What was last measured beyond a limit."""
        return next((line for line, _ in self._beyond.values()), None)
