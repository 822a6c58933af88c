# SPDX-License-Identifier: Apache-2.0
"""Response monitor: check that plant and encoders follow the commands."""

from math import copysign, isnan
from typing import Final, NamedTuple

from needle_controller.controller import ControllerSettings
from needle_controller.laws.law import Axis
from needle_dynamics import NeedleParameters
from needle_ros.timing import NANOSECONDS

_PATIENCE: Final = NANOSECONDS // 10  #: Time without response until the plant is lost [ns].
_LONGEST: Final = NANOSECONDS  #: Time without motion of a robot that is behind its command [ns].
_NOTHING: Final = 0.1  #: Least response, as a fraction of the commanded force or distance.
_RANGE: Final = 0.5  #: Least range of depths that is a motion, as a fraction of the distance.
_WINDOW: Final = NANOSECONDS // 5  #: Longest time of a displacement that shows the friction [ns].

#: Friction as a multiple of the nominal one: the strongest, for a stop while the reference moves;
#: and at rest as a multiple of the observed one, which is between these bounds.
_STRONGER, _WEAKER = 1.5, 0.7
_OBSERVED: Final = 0.1, 4.0


class _Mark(NamedTuple):
    """Stamp [ns] and insertion depth [m] at the start of a lack of response."""

    stamp: int
    depth: float


class StallMonitor:
    """
    Expect a displacement from the applied force, and compare it with the encoders.

    Encoders that do not move while more than ``most`` [m] is expected are frozen, or the needle is
    held by its tissue. ``longest`` is the longest time between two measurements that can be
    compared [s].

    While the reference moves, the expected displacement is the least one, with friction stronger
    than the nominal one, and the lack of motion is a fault. While the reference rests, it is the
    largest one, with friction weaker than in the last motion: stronger friction may hold the
    needle, so this is no fault, but ``relaxed`` is True: no force may act until the reference
    moves, or the encoders do. In the latter case a load has moved the needle, and the force that
    held it is expected to move nothing.
    """

    def __init__(self, axis: Axis, most: float, longest: float) -> None:
        self.axis, self.most, self._longest = axis, most, longest
        self.forget()

    def forget(self) -> None:
        """Expect motion from the next measurement on."""
        self.relaxed = False
        self._stamp: int | None = None
        self._begin(0.0)
        self.notice: str | None = None  #: Message at the measurement where ``relaxed`` begins.
        #: Force that holds the needle against an unknown load while the reference rests [N].
        self._holding = 0.0
        self._learn()

    def _begin(self, depth: float) -> None:
        """Expect motion from a depth [m] on."""
        self._velocity = 0.0
        self._restart(depth)

    def _restart(self, depth: float) -> None:
        """Compare displacements from a depth [m] on; the expected velocity stays."""
        self._depth = self._least = self._largest = depth
        self._expected = 0.0

    def change(self, axis: Axis) -> None:
        self.axis = axis
        self._learn()

    def _learn(self) -> None:
        self._friction = 1.0  #: Friction in the last motion, as a multiple of the nominal one.
        self._mark: _Mark | None = None
        self._impulse = 0.0  #: Impulse since the mark [N s].

    def _observe(self, stamp: int, depth: float, impulse: float) -> None:
        if self._mark is not None:
            self._impulse += impulse
            moved, elapsed = depth - self._mark.depth, stamp - self._mark.stamp
            if abs(moved) > _NOTHING * self.most:
                axis, sign = self.axis, copysign(1.0, moved)
                nominal = axis.coulomb * elapsed / NANOSECONDS + axis.viscous * abs(moved)
                nominal *= 1.0 if moved > 0.0 else axis.withdrawal
                low, high = _OBSERVED
                spent = min(max(sign * self._impulse, low * nominal), high * nominal)
                self._friction = spent / nominal if nominal > 0.0 else 1.0
            elif elapsed <= _WINDOW:
                return
        self._mark, self._impulse = _Mark(stamp, depth), 0.0

    def update(
        self, stamp: int, depth: float, rate: float, force: float, load: float
    ) -> str | None:
        """Process depth [m], velocity of the reference [m/s], and force and load before it [N]."""
        before, self._stamp, self.notice = self._stamp, stamp, None
        elapsed = (stamp - before) / NANOSECONDS if before is not None else 0.0
        if not 0.0 < elapsed <= self._longest:
            elapsed = 0.0
            self._begin(depth)
            self._mark = None
        self._observe(stamp, depth, (force - load) * elapsed)
        self._least, self._largest = min(self._least, depth), max(self._largest, depth)
        moved = depth - self._depth
        if rate != 0.0:
            self.relaxed, self._holding = False, 0.0
        elif self.relaxed:
            self.relaxed = abs(moved) <= _NOTHING * self.most
            return None
        factor, axis = _STRONGER, self.axis
        if rate == 0.0:
            factor = _WEAKER * self._friction
        force -= load
        # The load may need any part of the force that held it.
        force -= min(max(force, min(self._holding, 0.0)), max(self._holding, 0.0))
        if force < 0.0:
            factor *= axis.withdrawal
        push = abs(force) - factor * axis.coulomb
        if push <= 0.0:
            self._velocity = 0.0
        if (push <= 0.0 and rate != 0.0) or self._expected * force < 0.0:
            self._begin(depth)
            return None
        # Implicit step: stable for any friction.
        speed = abs(self._velocity) + elapsed / axis.inertia * push
        speed = max(speed / (1.0 + elapsed / axis.inertia * factor * axis.viscous), 0.0)
        self._velocity = speed
        self._expected += (speed if force > 0.0 else -speed) * elapsed
        if abs(self._expected) <= self.most:
            return None
        # A needle that a load pushes back, and its force forward again, has moved.
        responds = self._largest - self._least > _RANGE * self.most
        self._expected = 0.0
        if responds or abs(moved) > _NOTHING * self.most:
            self._restart(depth)
            return None
        if rate == 0.0:
            self.relaxed = True
            self._holding += force
            self.notice = (
                f'the encoders do not respond to {force:.3g} N at rest; they are frozen, or '
                'friction holds the needle: no force until the next motion'
            )
            return None
        return (
            f'the encoders do not move: {1e3 * abs(moved):.3g} mm measured, more than '
            f'{1e3 * self.most:.3g} mm expected at {force:.3g} N; they are frozen, or the needle '
            'is blocked'
        )


class ResponseMonitor:
    """
    Compare the commanded force with the response that the robot reports.

    A plant does not follow if it reports almost no force while a force is commanded, and the
    needle rests while its reference moves. It follows again as soon as one of these conditions
    ends. A robot that reports no force is not checked. ``lost`` is whether the plant does not
    follow. See `StallMonitor` for ``fault`` and ``relaxed``; ``notice`` is a message for the user.
    """

    def __init__(self, parameters: NeedleParameters, settings: ControllerSettings) -> None:
        most, longest = 0.5 * settings.jump, settings.longest_gap
        self._stall = StallMonitor(Axis.insertion(parameters), most, longest)
        self.forget()

    def change(self, parameters: NeedleParameters) -> None:
        self._stall.change(Axis.insertion(parameters))

    def forget(self) -> None:
        """Reset to a plant that follows."""
        self.lost = False
        self.fault: str | None = None
        self.notice: str | None = None
        self._mark: _Mark | None = None
        self._behind: _Mark | None = None
        self._stall.forget()

    @property
    def relaxed(self) -> bool:
        return self._stall.relaxed

    def update(
        self,
        stamp: int,
        depth: float,
        rate: float,
        commanded: float,
        reported: float,
        load: float = 0.0,
        step: float | None = None,
        behind: bool | None = None,
    ) -> bool:
        """
        Process a measurement at a stamp [ns]; return whether the plant does not follow.

        Takes insertion depth [m], velocity of the reference [m/s], also while it waits, the last
        commanded and the reported force [N], NaN if there is none, the known load against the
        force [N], the distance [m] to a reference that steps: it rests while the needle moves, and
        whether a robot that follows positions is behind its command, None for another robot. With
        positions the force is virtual and precedes the robot by its delay: the robot is compared
        with its command instead.
        """
        applied = commanded if isnan(reported) else reported
        self.fault = None
        if behind is not None or (step is not None and abs(step) <= self._stall.most):
            self._stall.forget()
        else:
            # Far from a step, the needle must move as behind a moving reference.
            self.fault = self._stall.update(stamp, depth, step or rate, applied, load)
        self.fault = self.fault or self._check_robot(stamp, depth, behind=bool(behind))
        self.lost = self._is_lost(stamp, depth, rate, commanded, reported)
        self.notice = self._stall.notice
        if self.lost:
            self.notice = (
                f'the plant does not follow: it reports {reported:.3g} N, {commanded:.3g} N is '
                'commanded'
            )
        return self.lost

    def _check_robot(self, stamp: int, depth: float, *, behind: bool) -> str | None:
        """
        Return why a robot that is behind its position command is blocked, or None.

        The command stays within ``hardware.lead`` of the measurement, also of a frozen encoder.
        """
        moved = 0.0 if self._behind is None else abs(depth - self._behind.depth)
        if not behind:
            self._behind = None
        elif self._behind is None or moved > _NOTHING * self._stall.most:
            self._behind = _Mark(stamp, depth)
        elif stamp - self._behind.stamp > _LONGEST:
            return (
                f'the robot does not follow its position command: {1e3 * moved:.3g} mm in '
                f'{_LONGEST / NANOSECONDS:g} s; it is blocked, later than that, or its encoders '
                'are frozen'
            )
        return None

    def _is_lost(
        self, stamp: int, depth: float, rate: float, commanded: float, reported: float
    ) -> bool:
        # Without a command no response is expected.
        if commanded == 0.0 or not abs(reported) < _NOTHING * abs(commanded):
            self._mark = None
            return False
        if self._mark is None:
            self._mark = _Mark(stamp, depth)
        mark = self._mark
        elapsed = min(stamp - mark.stamp, _PATIENCE) / NANOSECONDS
        moved = abs(depth - mark.depth) > _NOTHING * abs(rate) * elapsed
        late = stamp - mark.stamp > _PATIENCE
        lost = not moved and (self.lost or (late and rate != 0.0))
        if not lost and (self.lost or late):
            self._mark = None
        return lost
