# SPDX-License-Identifier: Apache-2.0
"""Reference generator of a controller: a target or a path, with pauses, and its hold."""

from collections import deque
from collections.abc import Callable, Sequence
from math import copysign, inf, sqrt
from typing import Final

from needle_controller.reference.path import brake, Joined, Path, Step, Trapezoid
from needle_controller.reference.quintic import halt, MinimumJerk
from needle_controller.reference.setpoint import Reference, ReferenceLimits, Setpoint
from needle_ros.contract import NEWEST
from needle_ros.errors import ParameterError

#: Point-to-point references by name.
REFERENCES: dict[str, type[Trapezoid] | type[MinimumJerk] | type[Step]] = {
    'trapezoid': Trapezoid,
    'minimum_jerk': MinimumJerk,
    'step': Step,
}

#: Longest gap in the measurements, and largest age of one, before the law restarts [s].
_GAP, _PERIODS = 0.01, 2.5
_ROUNDING: Final = 1.0 + 1e-6  #: Tolerance of an age of exactly one period.
#: Number of measurements after a gap that may have waited, twice as many as a controller keeps.
LONGEST_BURST: Final = 2 * NEWEST.depth
_AGAIN: Final = 0.2  #: Longest time between two gaps after which no integral is kept [s].
#: Least response, as a fraction of the commanded force or of the velocity of the reference.
_NOTHING: Final = 0.1
#: Relative tolerance of a reported force: equal to a command, and constant; number of reports in a
#: row that equal a command before a constant force is a loss of commands; its longest time [s].
_EQUAL, _SAME, _TRUSTED, _LOST = 0.05, 0.01, 20, 0.2


class ReferenceGenerator:
    """
    Reference generator: moves to a target or along a path, and can be paused.

    Every change starts at the present setpoint, with the next call of `at`: the reference is
    continuous. ``kind`` is a key of `REFERENCES`, and ``depths`` are the least and largest
    insertion depth [m].
    """

    def __init__(self, kind: str, limits: ReferenceLimits, depths: tuple[float, float]) -> None:
        if kind not in REFERENCES:
            raise ParameterError(f'unknown reference {kind!r}; valid: {", ".join(REFERENCES)}')
        self._kind = REFERENCES[kind]
        self.limits, self._depths = limits, depths
        self._motion: Reference | None = None
        self._start = self.now = 0.0
        self._passed = 0.0  #: Elapsed time of the path at the last change [s].
        self.forget()

    def forget(self) -> None:
        #: Insertion depth at the end of the motion [m]; None without a target or path.
        self.target: float | None = None
        self._closest = inf  #: Least distance from the target up to now [m].
        self._path: Path | None = None
        #: Whether it is paused, waits for a plant that does not follow, or holds one setpoint.
        self.paused = self.waits = self.held = False
        self.release()

    def release(self) -> None:
        """Discard the motion: the next motion starts at the needle, to the same target."""
        self._mark()
        self._motion = None
        self._change: Callable[[Setpoint], Reference] | None = self._plan

    def _mark(self) -> None:
        if isinstance(self._motion, Joined) and self._motion.path is self._path:
            self._passed = max(self.now - self._start - self._motion.offset, self._passed)

    @property
    def moves(self) -> bool:
        return self._motion is not None

    @property
    def steps(self) -> bool:
        """Whether the motion is a step: the reference rests while the needle moves."""
        # Measured for each sample; isinstance with an abstract base takes ten times as long.
        return type(self._motion) is Step

    @property
    def arrived(self) -> bool:
        """Whether the motion to the target or along the path has ended."""
        motion = None if self.paused or self._change is not None else self._motion
        return motion is not None and self.now - self._start >= motion.duration

    def aim(self, depth: float) -> None:
        """Move to an insertion depth [m]; `ParameterError` if not finite or out of range."""
        low, high = self._depths
        if not low <= depth <= high:
            raise ParameterError(f'target depth must be in [{low:g}, {high:g}] m, got {depth!r}')
        self.target, self._path, self._closest = depth, None, inf
        self._replan()

    def follow(
        self,
        times: Sequence[float],
        positions: Sequence[float],
        velocities: Sequence[float] | None = None,
    ) -> None:
        """Follow a path from now on, with times relative to now [s]; see `Path`."""
        path = Path(times, positions, velocities, self.limits, self._depths)
        self.target, self._path, self._passed = path.last, path, 0.0
        self._replan()

    def stop_motion(self) -> None:
        """Discard target and path: brake to rest within the limits, and hold there."""
        self._path = None
        if self._motion is None:
            # No force is commanded.
            self.target = None
        else:
            self.target, self._change = self.ahead(self.now).position, self._halt

    def _halt(self, now: Setpoint) -> Reference:
        motion = self._brake(now)
        self.target, self._closest = motion.at(motion.duration).position, inf
        return motion

    def pause(self) -> None:
        """Brake to rest within the limits and hold the position."""
        if not self.paused:
            self.paused, self._change = True, self._brake

    def resume(self) -> None:
        """Continue to the target, or along the path from the position of the pause."""
        if self.paused:
            self.paused, self._change = False, self._plan

    def _replan(self) -> None:
        # A new target does not end a pause.
        if not self.paused:
            self._change = self._plan

    def at(self, time: float, depth: float, velocity: float = 0.0) -> Setpoint:
        """Return the setpoint at a time [s]; a new motion starts at the needle [m, m/s]."""
        if self.held or self.waits:
            self._start += time - self.now
        self.now, self.held = time, False
        if self._change is not None:
            # A step has no intermediate position.
            anew = self._motion is None or self.steps
            now = self._beginning(depth, velocity) if anew else self.ahead(time)
            self._mark()
            change, self._change = self._change, None
            self._motion, self._start = change(now), time
        return self.ahead(time)

    def receded(self, depth: float, velocity: float) -> float:
        """Return how far a needle moved away from the target [m] while the reference did not."""
        if self.target is None or self._path is not None:
            return 0.0
        to_go = self.target - depth
        if velocity * to_go < 0.0:
            self._closest = inf
        self._closest = min(self._closest, abs(to_go))
        return abs(to_go) - self._closest

    def ahead(self, time: float) -> Setpoint:
        """Return the setpoint at a later time [s] without changes; zero without a motion."""
        return self._motion.at(time - self._start) if self._motion else Setpoint(0.0)

    def _beginning(self, depth: float, velocity: float) -> Setpoint:
        """Return the state of the needle, at most as fast as it can still stop at the target."""
        to_go = (depth if self.target is None else self.target) - depth
        fastest = min(self.limits.speed, sqrt(2.0 * self.limits.acceleration * abs(to_go)))
        return Setpoint(
            depth, copysign(min(max(velocity * copysign(1.0, to_go), 0.0), fastest), to_go)
        )

    def _plan(self, now: Setpoint) -> Reference:
        if self.paused:
            return self._brake(now)
        if self._path is not None:
            if self._kind is not MinimumJerk:
                now = Setpoint(now.position, now.velocity)
            return Joined(now, self._path, self._passed, self.limits)
        target = now.position if self.target is None else self.target
        if self._kind is MinimumJerk:
            return MinimumJerk(now, target, self.limits, self._depths)
        return self._kind(now, target, self.limits)

    def _brake(self, now: Setpoint) -> Reference:
        """Stop within the acceleration limit, without passing the end of the motion."""
        stop = halt if self._kind is MinimumJerk else brake
        motion: Reference = stop(now, self.limits, self._depths)
        if self._path is not None:
            # Half of the braking time: the time of the path to the same position.
            self._passed += 0.5 * motion.duration
        return motion


class ReferenceHold:
    """
    Hold the time of a motion while force is at its limit or missing; then restart at the needle.

    A force is missing if the robot, which reports forces, reports none for commands beyond the dry
    friction of a needle at rest, or holds a force that was commanded while commands change. A gap
    in the measurements has the same effect.
    """

    def __init__(self, guide: ReferenceGenerator, period: float, delay: int) -> None:
        self._guide, self._gap = guide, max(_GAP, _PERIODS * period) + delay * period
        #: Age of the last two measurements, or time since the previous one if that is longer [s].
        self._late = deque([0.0, 0.0], maxlen=2)
        #: Least of them before a gap while measurements are late, their number since then, and
        #: time of the last gap [s].
        self._usual: float | None = None
        self._waited, self._gap_at = 0, -inf
        #: Last forces [N], the oldest acts; tracking error at the last command [m]; whether the
        #: robot has reported a force, and a commanded force is missing.
        self._forces = deque([0.0], maxlen=delay + 2)
        self._error, self._reports, self.missing = 0.0, False, False
        #: Whether the last gap followed another one: an integral that each gap keeps, while the
        #: reference restarts at the needle, is a constant force that no error ends.
        self.repeated = False
        #: Number of reports of the commanded force in a row; time and force of the last [s, N].
        self._obeyed, self._report = 0, (-inf, 0.0)

    def measure(self, sample: tuple[float, ...], age: float, friction: float) -> bool:
        """Process time, velocity and force of an age [s]; return whether to restart."""
        guide, missing, (time, velocity, reported) = self._guide, self.missing, sample
        # Measurements that are always late or rare are no gap. After one, those that have waited
        # are no later than usual in the end.
        before, late = min(self._late), max(time - guide.now, age)
        self._late.append(late)
        begins = late > max(self._gap, _PERIODS * before)
        self._waited = 0 if begins else self._waited + 1
        self.repeated = begins and time - self._gap_at < _AGAIN
        self._gap_at = time if begins else self._gap_at
        behind = self._usual is not None and age > _ROUNDING * self._usual
        gap = begins or (behind and self._waited < LONGEST_BURST)
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
        if holds or (
            self._reports
            and abs(reported) < least
            and least > _NOTHING * friction
            and abs(velocity) <= _NOTHING * abs(guide.ahead(guide.now).velocity)
        ):
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
        for force in self._forces:
            if abs(reported - force) <= _EQUAL * size:
                self._obeyed, self._report = self._obeyed + 1, (time, reported)
                return False
        if not (abs(reported - held) <= _SAME * size and time - last < _LOST):
            self._obeyed = 0
        return self._obeyed >= _TRUSTED and time - last > self._gap

    def command(self, aim: Setpoint, depth: float, force: float, *, limited: bool) -> None:
        """Process the command for a setpoint and depth [m]; at a limit the motion is held."""
        self._error = aim.position - depth
        self._forces.append(force)
        ahead = force * ((self._guide.target or 0.0) - aim.position) > 0.0
        self._guide.held = limited and ahead and not self._guide.paused
