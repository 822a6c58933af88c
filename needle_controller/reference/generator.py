# SPDX-License-Identifier: Apache-2.0
"""Reference generator of a controller: a target or a path, with pauses."""

from collections.abc import Callable, Sequence
from math import copysign, sqrt

from needle_controller.reference.path import brake, Joined, Path
from needle_controller.reference.quintic import halt, MinimumJerk
from needle_controller.reference.setpoint import Reference, ReferenceLimits, Setpoint
from needle_controller.reference.trapezoid import Step, Trapezoid
from needle_ros.errors import ParameterError

#: Point-to-point references by name.
REFERENCES: dict[str, type[Trapezoid] | type[MinimumJerk] | type[Step]] = {
    'trapezoid': Trapezoid,
    'minimum_jerk': MinimumJerk,
    'step': Step,
}


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
        return isinstance(self._motion, Step)

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
        self.target, self._path = depth, None
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
        self.target = motion.at(motion.duration).position
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
