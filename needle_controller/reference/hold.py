# SPDX-License-Identifier: Apache-2.0
"""Hold of a reference: it advances only while the needle can follow."""

from collections import deque
from math import inf
from typing import Final

from needle_controller.reference.generator import ReferenceGenerator
from needle_controller.reference.setpoint import Setpoint
from needle_ros.contract import NEWEST

#: Longest gap in the measurements, and largest age of one, before the law restarts [s].
_GAP, _PERIODS = 0.01, 2.5
_ROUNDING: Final = 1.0 + 1e-6  #: Tolerance of an age of exactly one period.
#: Number of measurements after a gap that may have waited, twice as many as a controller keeps.
_BURST: Final = 2 * NEWEST.depth
#: Least response, as a fraction of the commanded force or of the velocity of the reference.
_NOTHING: Final = 0.1
#: Relative tolerance of a reported force: equal to a command, and constant; number of reports in a
#: row that equal a command before a constant force is a loss of commands; its longest time [s].
_EQUAL, _SAME, _TRUSTED, _LOST = 0.05, 0.01, 20, 0.2


class ReferenceHold:
    """
    Hold the time of a motion while force is at its limit or missing; then restart at the needle.

    A force is missing if the robot, which reports forces, reports none for commands beyond the dry
    friction of a needle at rest, or holds a force that was commanded while commands change. A gap
    in the measurements has the same effect.
    """

    def __init__(self, guide: ReferenceGenerator, period: float, delay: int) -> None:
        self._guide, self._gap = guide, max(_GAP, _PERIODS * period) + delay * period
        #: Age of the last measurement, or time since the previous one if that is longer [s].
        self._late = 0.0
        #: `_late` before a gap while measurements are late, and their number since then.
        self._usual: float | None = None
        self._waited = 0
        #: Last forces [N], the oldest acts; tracking error at the last command [m]; whether the
        #: robot has reported a force, and a commanded force is missing.
        self._forces = deque([0.0], maxlen=delay + 2)
        self._error, self._reports, self.missing = 0.0, False, False
        #: Number of reports of the commanded force in a row; time and force of the last [s, N].
        self._obeyed, self._report = 0, (-inf, 0.0)

    def measure(self, sample: tuple[float, ...], age: float, friction: float) -> bool:
        """Process time, velocity and force of an age [s]; return whether to restart."""
        guide, missing, (time, velocity, reported) = self._guide, self.missing, sample
        # Measurements that are always late or rare are no gap. After one, those that have waited
        # are no later than usual in the end.
        before, self._late = self._late, max(time - guide.now, age)
        begins = self._late > max(self._gap, _PERIODS * before)
        self._waited = 0 if begins else self._waited + 1
        behind = self._usual is not None and age > _ROUNDING * self._usual
        gap = begins or (behind and self._waited < _BURST)
        self.missing = guide.waits
        if guide.waits or not guide.moves:
            self._forces.append(0.0)
            self._usual = None
            return False
        self._usual = (before if self._usual is None else self._usual) if gap else None
        holds = self._holds(time, reported)
        least = _NOTHING * min(map(abs, self._forces))
        self._reports |= abs(reported) >= least > 0.0
        # NaN, a force that is not reported, is not missing.
        none = abs(reported) < least and least > _NOTHING * friction
        rests = abs(velocity) <= _NOTHING * abs(guide.ahead(guide.now)[1])
        if holds or (self._reports and none and rests):
            self.missing = guide.held = True
            if abs(self._error) > _GAP * guide.limits.speed:
                guide.release()
            return True
        if restart := missing or gap:
            self._forces.append(0.0)
            guide.release()
        return restart

    def _holds(self, time: float, reported: float) -> bool:
        """Return whether a robot reports a force [N] of the past for longer than a gap."""
        (last, held), size = self._report, abs(reported)
        if min(abs(reported - force) for force in self._forces) <= _EQUAL * size:
            self._obeyed, self._report = self._obeyed + 1, (time, reported)
            return False
        if not (abs(reported - held) <= _SAME * size and time - last < _LOST):
            self._obeyed = 0
        return self._obeyed >= _TRUSTED and time - last > self._gap

    def command(self, aim: Setpoint, depth: float, force: float, limit: float) -> None:
        """Process the command for a setpoint and insertion depth [m], and its limit [N]."""
        self._error = aim.position - depth
        self._forces.append(force)
        ahead = force * ((self._guide.target or 0.0) - aim.position) > 0.0
        self._guide.held = abs(force) >= limit and ahead and not self._guide.paused
