# SPDX-License-Identifier: Apache-2.0
"""Hold of a reference: it advances only while the needle can follow."""

from collections import deque
from typing import Final

from needle_controller.reference.generator import ReferenceGenerator
from needle_controller.reference.setpoint import Setpoint

#: Longest gap in the measurements, and largest age of one, before the law restarts [s].
_GAP, _PERIODS = 0.01, 2.5
#: Least response, as a fraction of the commanded force or of the velocity of the reference.
_NOTHING: Final = 0.1


class ReferenceHold:
    """
    Hold the time of a motion while force is at its limit or missing; then restart at the needle.

    A force is missing if the robot, which reports forces, reports none for commands beyond the dry
    friction of a needle at rest. A gap in the measurements has the same effect.
    """

    def __init__(self, guide: ReferenceGenerator, period: float, delay: int) -> None:
        self._guide, self._gap = guide, max(_GAP, _PERIODS * period) + delay * period
        #: Age of the last measurement, or time since the previous one if that is longer [s].
        self._late = 0.0
        #: Last forces [N], the oldest acts; tracking error at the last command [m]; whether the
        #: robot has reported a force, and a commanded force is missing.
        self._forces = deque([0.0], maxlen=delay + 2)
        self._error, self._reports, self.missing = 0.0, False, False

    def measure(self, sample: tuple[float, ...], age: float, friction: float) -> bool:
        """Process time, depth, velocity and force of an age [s]; return whether to restart."""
        guide, missing, (time, _, velocity, reported) = self._guide, self.missing, sample
        # Measurements that are always late or rare are no gap.
        before, self._late = self._late, max(time - guide.now, age)
        gap = self._late > max(self._gap, _PERIODS * before)
        self.missing = guide.waits
        if guide.waits or not guide.moves:
            self._forces.append(0.0)
            return False
        least = _NOTHING * min(map(abs, self._forces))
        self._reports |= abs(reported) >= least > 0.0
        # NaN, a force that is not reported, is not missing.
        none = abs(reported) < least and least > _NOTHING * friction
        if self._reports and none and abs(velocity) <= _NOTHING * abs(guide.ahead(guide.now)[1]):
            self.missing = guide.held = True
            if abs(self._error) > _GAP * guide.limits.speed:
                guide.release()
            return True
        if restart := missing or gap:
            self._forces.append(0.0)
            guide.release()
        return restart

    def command(self, aim: Setpoint, depth: float, force: float, limit: float) -> None:
        """Process the command for a setpoint and insertion depth [m], and its limit [N]."""
        self._error = aim.position - depth
        self._forces.append(force)
        ahead = force * ((self._guide.target or 0.0) - aim.position) > 0.0
        self._guide.held = abs(force) >= limit and ahead and not self._guide.paused
