"""
Steering executive: plan, measure the tip, move the guide, insert the needle; without ROS.

It requests motions of needle and guide, which a position-controlled robot executes, or an axis law
that converts the insertion to forces. In steps, the guide moves while the needle rests, and the
needle moves when the guide has arrived: the path is independent of their speeds. With
`continuous`, the needle is inserted without rests, and the guide follows its measured depth.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum
from math import ceil, sqrt
from time import monotonic
from typing import Final

from needle_controller.safety.input_monitor import InputMonitor
from needle_controller.steering.law import GuideSetpoint, SteeringFaultError, TipEstimate
from needle_controller.steering.laws.multi_hypothesis import MultiHypothesisLaw
from needle_controller.steering.monitor import MotionMonitor
from needle_controller.steering.motion import duration_of, JointMotion, smooth
from needle_controller.steering.planning import ComputedJob, Job, Progress, StartJob
from needle_controller.steering.prior import SteeringPrior
from needle_controller.steering.responses import SteeringModel
from needle_controller.steering.settings import ExecutiveSettings
from needle_controller.steering.tip_measurement import AveragedTipMeasurement, TipMeasurements
from needle_dynamics.arrays import BoolArray, FloatArray
from needle_dynamics.parameters import NeedleParameters
from needle_dynamics.steering.parameters import SteeringParameters
from needle_ros.contract import ENTRY, INSERTION, JOINT_STATES, ROLL, TARGET, TIP_DEFLECTION
from needle_ros.errors import JobError, NeedleError, ParameterError
from needle_ros.event_log import EventLog, Severity
from needle_ros.status import RequestLog, RequestStatus, Verdict
from needle_ros.timing import NANOSECONDS
from needle_ros.wire import Reading
import numpy as np

#: Time in which needle and guide brake to rest after a stop [s].
_BRAKING: Final = 0.2

#: Time over which the insertion speed is measured [s].
_SPAN: Final = 0.05

#: Time after which a stop is sent again to a needle that still moves [s], and number of times that
#: it is sent.
_STOP_AGAIN, _STOPS = 0.5, 4

#: Changes from one message to the next that are implausible [m, rad].
_JUMPS: Final = (5e-3, 5e-3, 5e-3, 1.0)

#: Tolerance of a moving joint, as a multiple of its tolerance at rest.
_LAGGING: Final = 5.0

#: Largest displacement of a needle at rest [m].
_STILL: Final = 1e-4

#: Largest depth of a needle outside tissue, where the guide may move freely [m].
_OUTSIDE: Final = 1e-3

#: Tolerance of equal positions [m, rad].
_SAME: Final = 1e-6

#: Most steps of a plan.
_MOST_STEPS: Final = 200

#: Noise of the readings of the tip, as a multiple of the configured noise, that is reported.
_SCATTERED: Final = 3.0

#: Half of an interval of 95 % over the standard deviation.
_NORMAL: Final = 1.96

_NONE: Final = np.zeros(1)


class Phase(Enum):
    """State of the executive; the values are in the field ``phase`` of its status."""

    IDLE = 'idle'
    PLANNING = 'planning'
    GUIDING = 'guiding'
    INSERTING = 'inserting'
    MEASURING = 'measuring'
    DONE = 'done'
    STOPPED = 'stopped'


#: Descriptions of the phases for the user.
_DESCRIPTIONS: Final = {
    Phase.IDLE: 'waits for a target',
    Phase.PLANNING: 'computes the plan',
    Phase.GUIDING: 'the guide moves',
    Phase.INSERTING: 'the needle is inserted',
    Phase.MEASURING: 'measures the tip',
}


class SteeringExecutive:
    """
    Execute a steered insertion, and stop it on any fault.

    Every event is a method: it takes the time now [ns] of the clock that stamps the messages, and
    returns a motion of needle and guide to send; None leaves the last motion in effect.
    A motion is sent again until the joints follow it, see `MotionMonitor`.

    Parameters
    ----------
    needle : NeedleParameters
        Nominal needle and tissue.
    steering : SteeringParameters
        Their constants for steering.
    belief : SteeringPrior
        Prior uncertainty of all constants.
    settings : ExecutiveSettings
        Steps, tip measurements and limits.
    steady : callable
        As for `EventLog`.
    start : callable
        Starts the computation of a plan, see `StartJob`.

    Attributes
    ----------
    settings : ExecutiveSettings
        As given.
    journal : EventLog
        Lines for the log.
    requests : RequestLog
        Targets, and the answers to them.
    phase : Phase
        State.
    fault : str
        Reason of the stop, '' without a stop.
    control : MultiHypothesisLaw or None
        The controller of the latest insertion.
    expected : TipEstimate or None
        Expected position of the tip at the target depth; a new one after each measurement.

    """

    def __init__(
        self,
        needle: NeedleParameters,
        steering: SteeringParameters,
        belief: SteeringPrior,
        settings: ExecutiveSettings,
        steady: Callable[[], float] = monotonic,
        start: StartJob = ComputedJob,
    ) -> None:
        self._needle, self._steering, self._belief = needle, steering, belief
        self.settings = settings
        self.journal = EventLog(steady)
        self.requests = RequestLog({TARGET: (INSERTION,)}, ('', ENTRY), steady)
        timeout = settings.measurement_timeout
        self._joint_stream = InputMonitor(JOINT_STATES.name, timeout, jumps=_JUMPS)
        self._tip_stream = InputMonitor(TIP_DEFLECTION.name, timeout, frames=('', ENTRY))
        self.phase, self.fault = Phase.IDLE, ''
        self.control: MultiHypothesisLaw | None = None
        self.expected: TipEstimate | None = None
        #: Plan in computation; stamp [ns] and target [m] of its request, depths of the steps and
        #: positions of the joints [m, rad] at its start, and the phase before.
        self._start_job = start
        self._job: Job[MultiHypothesisLaw] | None = None
        self._wanted: tuple[int, tuple[float, float, float], FloatArray, FloatArray] = (
            0, (0.0, 0.0, 0.0), _NONE, _NONE,
        )  # fmt: skip
        self._before_plan = Phase.IDLE
        self._depths = np.zeros(1)
        #: Insertion depth where the latest insertion began [m].
        self._begun = 0.0
        #: Positions of the joints: measured, at the start and at the end of the motion; and the
        #: time at which it should end [ns].
        self._at: FloatArray | None = None
        self._origin = self._goal = np.zeros(len(settings.joints))
        self._due = 0
        self._monitor = MotionMonitor(settings.joints, settings.tolerances)
        #: Creates the motion again, from the present positions.
        self._again: Callable[[int], JointMotion | None] = lambda _now: None
        #: Stamp of the newest motion [ns], unique for each motion.
        self._stamp = 0
        #: Positions of the stop, stamp [ns] and insertion depth [m] of the last check for rest,
        #: and number of stops left to send.
        self._halt: FloatArray | None = None
        self._halted: tuple[int, float] | None = None
        self._stops = 0
        #: Largest deviation of a reading of the tip so far [m].
        self._scatter = 0.0
        #: Stamp [ns] and insertion depth [m] at the start of rest.
        self._rest: tuple[int, float] | None = None
        self._look: TipMeasurements | None = None
        #: Stamps between which readings belong to a measurement at rest [ns].
        self._span = 0, 0
        #: Continuous: measurements at the depths, the last depth that was passed, positions of the
        #: guide before and after the next one [m], and when it was sent last [ns].
        self._passing: dict[int, TipMeasurements] = {}
        self._passed = 0
        self._between = np.zeros((2, 2))
        self._sent = 0
        #: An earlier stamp [ns] and insertion depth [m], and insertion speed [m/s].
        self._before: tuple[int, float] | None = None
        self._speed = 0.0
        self._seen: AveragedTipMeasurement | None = None
        #: Depth of the tip less the insertion depth, at the first measurement [m].
        self._ahead: float | None = None
        self._warned = False
        self._time = 0
        #: Stamp of the latest joint states [ns].
        self._latest = 0

    @property
    def steers(self) -> bool:
        """Whether an insertion is under way."""
        return self.phase in (Phase.GUIDING, Phase.INSERTING, Phase.MEASURING)

    @property
    def busy(self) -> bool:
        """Whether a plan is being computed: simulated time may wait for it."""
        return self.phase is Phase.PLANNING

    @property
    def depth(self) -> float:
        """Depth of the target of the latest insertion [m]."""
        return float(self._depths[-1])

    # Requests.

    def target(
        self, stamp: int, frame: str, point: tuple[float, float, float], now: int
    ) -> JointMotion | None:
        """
        Plan an insertion to a target and begin it; during an insertion, change its target.

        Parameters
        ----------
        stamp : int
            Stamp of the message [ns]; 0 if it has none.
        frame : str
            Frame of the message.
        point : tuple of float
            Target of the tip, x, y, z [m].
        now : int
            Time [ns].

        Returns
        -------
        JointMotion or None
            Motion to send.

        """
        known = self.requests.check(TARGET, stamp, now, frame, (INSERTION,))
        if known is not None:
            if known.verdict is Verdict.REJECTED:
                self.journal.refuse(f'target rejected: {known.reason}')
            return None
        try:
            if not np.isfinite(point).all():
                raise ParameterError(f'target must be finite, got {list(point)}')
            if self.steers:
                self._aim(point)
            else:
                self._plan(stamp, point, now)
        except NeedleError as error:
            self._reject(stamp, error)
            return None
        if self.phase is not Phase.PLANNING:
            self.requests.answer(TARGET, stamp, Verdict.ACCEPTED, joints=(INSERTION,))
            return None
        self.requests.answer(TARGET, stamp, Verdict.RECEIVED, joints=(INSERTION,))
        return self._begin_if_planned(now)

    def _reject(self, stamp: int, error: NeedleError) -> None:
        self.journal.refuse(f'target rejected: {error}')
        self.requests.answer(TARGET, stamp, Verdict.REJECTED, str(error))

    def _aim(self, point: tuple[float, float, float]) -> None:
        depth = self.depth
        if abs(point[1] - depth) > _SAME or self.control is None:
            raise ParameterError(
                f'the insertion is to a depth of {1e3 * depth:.2f} mm, got '
                f'{1e3 * point[1]:.2f} mm; ~/stop ends it'
            )
        self.control.aim((point[0], point[2]))
        self._warned = False
        self.journal.say(Severity.INFO, f'target changed to {_words(point)}')

    def _check_ready(self, now: int) -> FloatArray:
        """Return the positions of the joints, if an insertion can begin."""
        for stream in (self._joint_stream, self._tip_stream):
            if stream.publishers > 1:
                raise JobError(f'{stream.publishers} nodes publish {stream.name}')
            timeout = self.settings.measurement_timeout
            if stream.counted is None or stream.silence(now) > timeout:
                raise JobError(f'no {stream.name} received within {timeout:g} s')
        if self._at is None:
            raise JobError('no positions of needle and guide received')
        return self._at

    def _plan(self, stamp: int, point: tuple[float, float, float], now: int) -> None:
        """Start to compute a plan."""
        settings, at = self.settings, self._check_ready(now)
        if at[0] < -_OUTSIDE:
            raise JobError(f'the needle is {-1e3 * at[0]:.2f} mm before the skin')
        depth = max(0.0, float(at[0]))
        if self.control is not None and depth > self._begun + _OUTSIDE:
            raise JobError(
                f'the needle is at {1e3 * depth:.2f} mm and has been steered; retract it to '
                f'{1e3 * self._begun:.2f} mm first'
            )
        off = np.abs(at[1:3]).max()
        begun = self._begun if self.control is not None else 0.0
        if depth > begun + _OUTSIDE and off > settings.guide_tolerance:
            raise JobError(
                f'the guide is {1e3 * off:.2f} mm off its zero with the needle at '
                f'{1e3 * depth:.2f} mm; a needle has to be straight at the start'
            )
        if point[1] < depth + min(settings.step_length, _OUTSIDE):
            raise ParameterError(
                f'the needle is at {1e3 * depth:.2f} mm already, the target at '
                f'{1e3 * point[1]:.2f} mm'
            )
        steps = max(1, ceil((point[1] - depth) / settings.step_length - _SAME))
        if steps > _MOST_STEPS:
            raise ParameterError(
                f'it would take {steps} steps of {1e3 * settings.step_length:g} mm, at most '
                f'{_MOST_STEPS} are possible: increase step_length'
            )
        depths = np.linspace(depth, point[1], steps + 1)
        roll = float(at[3]) if settings.turns else 0.0

        def work(progress: Progress) -> MultiHypothesisLaw:
            model = SteeringModel(
                self._needle,
                self._steering,
                depths,
                self._belief,
                together=settings.continuous,
                progress=progress,
            )
            return MultiHypothesisLaw(
                model,
                (point[0], point[2]),
                settings.guide_limit,
                settings.turns,
                settings.load_limit,
                roll,
                settings.farthest((point[1] - depth) / steps),
            )

        self._cancel(Verdict.SUPERSEDED, 'a newer target was received')
        self._wanted = stamp, point, depths, at
        self._before_plan, self.phase = self.phase, Phase.PLANNING
        self._job = self._start_job(work)
        self.journal.say(Severity.INFO, f'planning to {_words(point)} in {steps} steps')

    def _cancel(self, verdict: Verdict, why: str) -> None:
        """Cancel the computation of a plan, if it is under way."""
        if self._job is None:
            return
        self._job.cancel()
        self._job, self.phase = None, self._before_plan
        self.requests.answer(TARGET, self._wanted[0], verdict, why)
        self.journal.say(Severity.INFO, f'planning cancelled: {why}')

    def _begin_if_planned(self, now: int) -> JointMotion | None:
        """Begin the insertion once its plan is computed."""
        job = self._job
        if job is None or not job.done:
            return None
        stamp, point, depths, planned = self._wanted
        self._job, self.phase = None, self._before_plan
        try:
            control, at = job.result(), self._check_ready(now)
            moved = np.flatnonzero(np.abs(at - planned) > self.settings.tolerances)
            if len(moved):
                raise JobError(f'{self.settings.joints[moved[0]]} has moved during planning')
        except NeedleError as error:
            self._reject(stamp, error)
            return None
        self.requests.answer(TARGET, stamp, Verdict.ACCEPTED, joints=(INSERTION,))
        self.control, self._depths, self._begun = control, depths, float(depths[0])
        self.expected, self.fault, self._halt = None, '', None
        self._ahead, self._warned, self._scatter = None, False, 0.0
        self.journal.say(
            Severity.INFO, f'insertion to {_words(point)} in {len(depths) - 1} steps begins'
        )
        self._goal = np.array([self._begun, *at[1:]])
        straight = self._goal.copy()
        straight[1:3] = 0.0
        return self._send(Phase.GUIDING, straight, now)

    def stop(self, why: str, now: int, silence: float = 0.0) -> JointMotion | None:
        """
        Stop the insertion: needle and guide brake to rest at their positions; cancel a plan.

        Parameters
        ----------
        why : str
            Reason for the user.
        now : int
            Time [ns].
        silence : float
            Age of the latest positions [s].

        Returns
        -------
        JointMotion or None
            Motion to send; None if no joint has to be stopped.

        """
        self.requests.supersede(now)
        self._cancel(Verdict.REJECTED, f'stopped: {why}')
        if not self.steers:
            return None
        moves = self.phase is not Phase.MEASURING
        self.phase, self.fault, self._look = Phase.STOPPED, why, None
        self._monitor.forget()
        self.journal.say(Severity.ERROR, f'stopped: {why}')
        if not moves or self._at is None:
            return None
        end, limit = self._at.copy(), self.settings.guide_limit
        # Includes the braking distance; clipped, because the positions may be implausible.
        end[0] += (0.5 * _BRAKING + silence) * self.settings.speed
        end[0] = min(max(end[0], self._origin[0]), self._goal[0])
        end[1:3] = np.clip(end[1:3], -limit, limit)
        self._halt, self._halted, self._stops = end, None, _STOPS
        return self._send_stop(now)

    def _send_stop(self, now: int) -> JointMotion | None:
        if self._halt is None:
            return None
        end, joints = self._halt, self.settings.joints
        halt = JointMotion(joints, np.array([_BRAKING]), end[np.newaxis], np.zeros((1, len(end))))
        self._stops -= 1
        halt = self._stamped(halt, now)
        self._monitor.forget()
        self._monitor.stream(halt)
        return halt

    def _stop_again(self, stamp: int, depth: float, now: int) -> JointMotion | None:
        """Send the stop again to a needle that still moves."""
        if self._halted is None:
            self._halted = stamp, depth
        since, before = self._halted
        if self._halt is None or stamp - since < _STOP_AGAIN * NANOSECONDS:
            return None
        self._halted = stamp, depth
        if abs(depth - before) < _STILL:
            self._halt = None
            return None
        if not self._stops:
            self._halt = None
            self.journal.say(Severity.ERROR, f'the needle still moves after {_STOPS} stops')
            return None
        self.journal.say(
            Severity.ERROR, 'the needle still moves after the stop; stop command sent again'
        )
        return self._send_stop(now)

    def hear(self, node: str, status: RequestStatus, now: int) -> JointMotion | None:
        """
        Process the status of another node: its answers to the motions.

        Parameters
        ----------
        node : str
            Name of the node.
        status : RequestStatus
            Status of the node.
        now : int
            Time [ns].

        Returns
        -------
        JointMotion or None
            Motion to send.

        """
        refusal = self._monitor.hear(node, status)
        if not refusal:
            return None
        if self.steers:
            return self.stop(refusal, now)
        # Only once: the answer is repeated each second.
        self._monitor.forget()
        if self.phase is Phase.STOPPED:
            self.journal.say(Severity.ERROR, f'the stop failed: {refusal}')
        return None

    # Measurements.

    def joints(self, reading: Reading, now: int) -> JointMotion | None:
        """
        Process `joint_states`.

        Parameters
        ----------
        reading : Reading
            The message.
        now : int
            Time [ns].

        Returns
        -------
        JointMotion or None
            Motion to send.

        """
        names, (positions, *_) = reading.names, reading.values
        found = dict(zip(names, positions, strict=False))
        joints = self.settings.joints
        missing = [name for name in joints if name not in found]
        if missing:
            self.journal.refuse(
                f'joint_states lacks a position of {", ".join(missing)}, got names {list(names)}'
            )
            return None
        at = [found[name] for name in joints]
        refusal = self._joint_stream.check(reading.stamp, now, values=at)
        if refusal is not None:
            if not refusal.harmless:
                self.journal.refuse(f'joint_states refused: {refusal.line}')
            return None
        self._at = np.array(at)
        elapsed = reading.stamp - self._latest if self._latest else 0
        self._latest = reading.stamp
        if self.phase is Phase.STOPPED:
            return self._stop_again(reading.stamp, float(self._at[0]), now)
        if self._astray():
            return self.stop(self._astray(), now)
        if self.phase is Phase.MEASURING and self._missed():
            return self.stop(f'during the measurement of the tip {self._missed()}', now)
        if self.phase not in (Phase.GUIDING, Phase.INSERTING):
            return None
        if self._monitor.paused:
            # The user determines the duration of a pause.
            self._due += elapsed
            self._monitor.wait(elapsed)
        if self._monitor.is_late(self._at, reading.stamp):
            return self._repeat(now)
        if self.phase is Phase.INSERTING and self.settings.continuous:
            return self._follow(reading.stamp, now)
        return self._wait(reading.stamp, now)

    def _repeat(self, now: int) -> JointMotion | None:
        """Send the motion again: the message may have been lost."""
        failure = f'{self._missed(self._monitor.pending)}: {self._monitor.failure()}'
        if self._monitor.exhausted:
            return self.stop(failure, now)
        self.journal.say(Severity.WARNING, f'{failure}; sent again')
        return self._again(now)

    def _astray(self) -> str:
        """Describe the first joint outside its motion, '' if none is."""
        if not self.steers or self._at is None:
            return ''
        low, high = np.minimum(self._origin, self._goal), np.maximum(self._origin, self._goal)
        room = _LAGGING * self.settings.tolerances
        for k, name in enumerate(self.settings.joints[:3]):
            if not low[k] - room[k] <= self._at[k] <= high[k] + room[k]:
                return (
                    f'{name} is at {1e3 * self._at[k]:.3f} mm, outside its motion from '
                    f'{1e3 * self._origin[k]:.3f} to {1e3 * self._goal[k]:.3f} mm'
                )
        return ''

    def _missed(self, which: BoolArray | None = None) -> str:
        """Describe the joints (or given joints) that are not at their goal, '' if all are."""
        settings, at, goal = self.settings, self._at, self._goal
        if at is None:
            return ''
        far = np.abs(at - goal) > settings.tolerances
        far = far if which is None else which
        missed = []
        for k, name in enumerate(settings.joints):
            scale, unit = (1.0, 'rad') if name == ROLL else (1e3, 'mm')
            if far[k]:
                missed.append(
                    f'{name} is at {scale * at[k]:.3f} {unit}, not at {scale * goal[k]:.3f} {unit}'
                )
        return ' and '.join(missed)

    def _wait(self, stamp: int, now: int) -> JointMotion | None:
        """Wait until needle and guide rest at their goal."""
        if stamp < self._due or self._at is None:
            return None
        missed, depth = self._missed(), float(self._at[0])
        if missed:
            self._rest = None
            late = (stamp - self._due) / NANOSECONDS
            if late > self.settings.patience:
                return self.stop(f'{missed}, {late:.1f} s late', now)
        elif self.phase is Phase.GUIDING and self.control is not None and self.control.step:
            depth = float(self._depths[self.control.step])
            return self._send(Phase.INSERTING, np.array([depth, *self._goal[1:]]), now)
        elif self._rest is None or abs(depth - self._rest[1]) > _STILL:
            self._rest = stamp, depth
        elif stamp - self._rest[0] >= self.settings.settle_time * NANOSECONDS:
            self.phase = Phase.MEASURING
            self._look = TipMeasurements()
            self._span = stamp, stamp + round(self.settings.look_time * NANOSECONDS)
        return None

    def tip(self, reading: Reading, now: int) -> JointMotion | None:
        """
        Process `tip_deflection`.

        Parameters
        ----------
        reading, now
            As for `joints`.

        Returns
        -------
        JointMotion or None
            Motion to send.

        """
        tip = reading.values[0]
        refusal = self._tip_stream.check(reading.stamp, now, reading.frame, tip)
        if refusal is not None:
            if not refusal.harmless:
                self.journal.refuse(f'tip_deflection refused: {refusal.line}')
            return None
        if self._look is not None:
            since, until = self._span
            if since < reading.stamp <= until:
                self._look.take(tip)
            return self._step(now) if reading.stamp >= until else None
        if self.phase is Phase.INSERTING and self.settings.continuous and self._at is not None:
            # Insertion depth at the time of the reading.
            depth = float(self._at[0]) - self._speed * (now - reading.stamp) / NANOSECONDS
            at = int(np.searchsorted(self._depths, depth))
            if 0 < at < len(self._depths):
                look = self._passing.setdefault(at, TipMeasurements())
                look.take(tip, float(self._depths[at]) - depth)
        return None

    def watch(self, now: int) -> JointMotion | None:
        """
        Check for missing inputs, and whether a plan is computed; call it ten times a second.

        Parameters
        ----------
        now : int
            Time [ns].

        Returns
        -------
        JointMotion or None
            Motion to send.

        """
        timeout = self.settings.measurement_timeout
        back, self._time = (self._time - now) / NANOSECONDS, now
        if back > timeout:
            for stream in (self._joint_stream, self._tip_stream):
                stream.forget()
            self._stamp = 0
            halt = self.stop(f'the clock went back by {back:.3f} s', now)
            self.requests.forget()
            return halt
        if self.phase is Phase.PLANNING:
            return self._begin_if_planned(now)
        if not self.steers:
            return None
        for stream in (self._joint_stream, self._tip_stream):
            if stream.publishers > 1:
                return self.stop(f'{stream.publishers} nodes publish {stream.name}', now)
        silence = self._joint_stream.silence(now)
        if silence > timeout:
            return self.stop(f'no joint_states received within {silence:.2f} s', now, silence)
        if self._look is not None and now > self._span[1] + timeout * NANOSECONDS:
            return self._step(now)
        return None

    def count_publishers(self, joint_states: int, tip_deflection: int) -> None:
        """
        Set the numbers of publishers of the measurements: each must have one source only.

        Parameters
        ----------
        joint_states, tip_deflection : int
            Number of publishers.

        """
        self._joint_stream.publishers = joint_states
        self._tip_stream.publishers = tip_deflection

    # Steps.

    def _step(self, now: int) -> JointMotion | None:
        """End a measurement of the tip, and begin the next step."""
        control, look, self._look = self.control, self._look, None
        if control is None or look is None or self._at is None:
            return None
        k = control.step
        try:
            # Late readings of the step before.
            self._take(control, self._passing.pop(k - 1, None), k - 1)
            self._take(control, look, k, depth=float(self._at[0]))
        except SteeringFaultError as error:
            return self.stop(str(error), now)
        to = self._planned_at(control, k)
        if k == len(self._depths) - 1:
            self.phase = Phase.DONE
            self.journal.say(Severity.INFO, f'done: {self._outcome()}')
            return None
        if self.settings.continuous:
            self._between = np.array([[0.0, 0.0], [to.x, to.z]])
            self._passing, self._passed, self._before, self._speed = {}, 0, None, 0.0
            self.phase, self._rest, self._sent = Phase.INSERTING, None, 0
            return self._insert(now, float(self._depths[0]))
        goal = np.array([self._goal[0], to.x, to.z, to.roll])[: len(self._goal)]
        return self._send(Phase.GUIDING, goal, now)

    def _take(
        self,
        control: MultiHypothesisLaw,
        look: TipMeasurements | None,
        at: int,
        depth: float | None = None,
    ) -> None:
        """Update the controller by a tip measurement, which may have no readings."""
        if look is None:
            return
        self._seen = seen = look.seen(self._belief.noise)
        slip = self._slip(seen, float(self._depths[at]) if depth is None else depth)
        if slip:
            raise SteeringFaultError(slip)
        if seen is None:
            control.update(None, at)
            return
        self._scatter = max(self._scatter, seen.error * sqrt(seen.readings))
        control.update(seen.tip[[0, 2]], at, max(seen.error, self._scatter / sqrt(seen.readings)))

    def _planned_at(self, control: MultiHypothesisLaw, k: int) -> GuideSetpoint:
        """Plan the next step, and log a new warning."""
        to = control.plan()
        self.expected = control.expected()
        if k < len(self._depths) - 1 and control.warning and not self._warned:
            self._warned = True
            depth = 1e3 * self._depths[k]
            self.journal.say(Severity.WARNING, f'at {depth:.2f} mm: {control.warning}')
        return to

    # Continuous insertion.

    def _insert(self, now: int, begin: float, *, again: bool = False) -> JointMotion:
        """Send the needle to the target depth."""
        start, end = np.array([begin]), self._depths[[-1]]
        self._goal = np.array([end[0], *self._between[1]])
        self._origin = np.array([self._depths[0], *self._between[0]])
        duration = duration_of(np.array([end[0] - begin, 0.0, 0.0]), self.settings)
        self._due = now + round(duration * NANOSECONDS)
        self._again = lambda later: self._insert(later, self._depth_now, again=True)
        move = self._stamped(smooth(self.settings.joints[:1], start, end, duration), now)
        self._monitor.begin(move, np.array([begin, *self._between[0]]), again=again)
        return move

    @property
    def _depth_now(self) -> float:
        """Insertion depth now, within the motion [m]."""
        at = float(self._at[0]) if self._at is not None else 0.0
        return min(max(at, float(self._origin[0])), float(self._goal[0]))

    def _follow(self, stamp: int, now: int) -> JointMotion | None:
        """Send the guide with the needle, and plan at each passed depth."""
        control, at = self.control, self._at
        if control is None or at is None:
            return None
        depth, last = float(at[0]), len(self._depths) - 1
        if self._before is None:
            if depth < self._begun + _STILL:
                return None
            self._before = stamp, depth
        since = (stamp - self._before[0]) / NANOSECONDS
        if since >= _SPAN:
            self._speed, self._before = (depth - self._before[1]) / since, (stamp, depth)
        while self._passed < last - 1 and depth >= self._depths[self._passed + 1]:
            self._passed += 1
            fault = self._pass(control, at)
            if fault:
                return self.stop(fault, now)
        if self._passed == last:
            return self._wait(stamp, now)
        if depth >= self._depths[last] - self.settings.depth_tolerance:
            self._passed, self._due = last, stamp
            return self._end_guide(now)
        if stamp > self._due + self.settings.patience * NANOSECONDS:
            # The guide is at its setpoint of this depth.
            self._goal[1:] = at[1:]
            return self._wait(stamp, now)
        interval = 1.0 / self.settings.rate
        if stamp - self._sent < interval * NANOSECONDS:
            return None
        self._sent = stamp
        low, high = self._depths[self._passed : self._passed + 2].tolist()
        begin, end = self._between
        part = min(max((depth + self._speed * interval - low) / (high - low), 0.0), 1.0)
        way = end - begin
        rate = way * self._speed / (high - low)
        move = self._guide_to(begin + part * way, rate, interval, now)
        self._monitor.stream(move)
        return move

    def _end_guide(self, now: int, *, again: bool = False) -> JointMotion | None:
        """Send the guide to the end of the last step, with a check of its arrival."""
        if self._at is None:
            return None
        self._again = lambda later: self._end_guide(later, again=True)
        move = self._guide_to(self._between[1], np.zeros(2), _BRAKING, now)
        self._monitor.begin(move, self._at, again=again, arrives=True)
        return move

    def _guide_to(
        self, position: FloatArray, velocity: FloatArray, duration: float, now: int
    ) -> JointMotion:
        move = JointMotion(
            self.settings.joints[1:3],
            np.array([duration]),
            position[np.newaxis],
            velocity[np.newaxis],
        )
        return self._stamped(move, now)

    def _pass(self, control: MultiHypothesisLaw, at: FloatArray) -> str:
        """Process the measurement of the depth before, and plan; return the fault, '' if none."""
        k, there = self._passed, self._between[1]
        if np.abs(at[1:3] - there).max() > _LAGGING * self.settings.guide_tolerance:
            x, z = 1e3 * at[1:3]
            return (
                f'the guide is at x = {x:.3f} mm, z = {z:.3f} mm at a depth of '
                f'{1e3 * at[0]:.2f} mm, not at {1e3 * there[0]:.3f} mm, {1e3 * there[1]:.3f} mm'
            )
        try:
            if k > 1:
                self._take(control, self._passing.pop(k - 1, TipMeasurements()), k - 1)
        except SteeringFaultError as error:
            return str(error)
        to = self._planned_at(control, k)
        self._between = np.array([there, [to.x, to.z]])
        self._origin[1:], self._goal[1:] = there, self._between[1]
        return ''

    # Faults and motions.

    def _slip(self, seen: AveragedTipMeasurement | None, depth: float) -> str:
        """Return the fault if tip depth and insertion depth differ, '' if not."""
        if seen is None:
            return ''
        ahead = float(seen.tip[1]) - depth
        if self._ahead is None:
            self._ahead = ahead
        slipped = ahead - self._ahead
        if abs(slipped) <= self.settings.slip_tolerance:
            return ''
        if seen.frozen:
            return f'the tip sensor is frozen: {seen.readings} identical readings'
        return (
            f'the tip is {1e3 * abs(slipped):.2f} mm {"less" if slipped < 0.0 else "more"} deep '
            'than the needle was inserted: it slips, or the sensor measures another needle'
        )

    def _send(self, phase: Phase, goal: FloatArray, now: int) -> JointMotion | None:
        """Send needle and guide to positions, from their last goal."""
        self.phase, self._rest = phase, None
        self._origin, self._goal = self._goal, goal
        return self._move(now, self._origin)

    def _move(self, now: int, begin: FloatArray, *, again: bool = False) -> JointMotion | None:
        duration = duration_of(self._goal - begin, self.settings)
        self._due = now + round(duration * NANOSECONDS)
        if np.abs(self._goal - begin).max() < _SAME:
            # Too short: the times of the points would be equal.
            self._monitor.forget()
            return None
        # Repeated from the present positions, without a jump.
        self._again = lambda later: (
            self._move(later, self._at, again=True) if self._at is not None else None
        )
        move = self._stamped(smooth(self.settings.joints, begin, self._goal, duration), now)
        self._monitor.begin(move, begin, again=again)
        return move

    def _stamped(self, move: JointMotion, now: int) -> JointMotion:
        """Return a motion with a unique stamp: simulated time may stand still."""
        self._stamp = max(now, self._stamp + 1)
        return move._replace(stamp=self._stamp)

    # Status.

    def _outcome(self) -> str:
        """Describe the estimate of the tip at the end."""
        control, there = self.control, self.expected
        if control is None or there is None:
            return ''
        half = _NORMAL * np.sqrt(np.diag(there.covariance))
        (x, z), off = there.mean, float(np.hypot(*(there.mean - control.target)))
        return (
            f'the tip is at x = {1e3 * x:.2f} ± {1e3 * half[0]:.2f} mm, z = {1e3 * z:.2f} ± '
            f'{1e3 * half[1]:.2f} mm (95 %), {1e3 * off:.2f} mm from the target'
        )

    def _describe_control(self) -> tuple[dict[str, object], str]:
        """Return values of the controller for the status, and its warning."""
        values: dict[str, object] = {}
        control = self.control
        if control is None:
            return values, ''
        x, z = control.target.tolist()
        values['target x, y, z [m]'] = f'{x:.6f}, {self.depth:.6f}, {z:.6f}'
        steps = len(self._depths) - 1
        values['step'] = f'{min(control.step, steps)} of {steps}'
        values['guide x, z [m]'] = f'{self._goal[1]:.6f}, {self._goal[2]:.6f}'
        values['turns left'] = control.turns
        values['chance to come within 1 mm'] = f'{control.chance:.3f}'
        values['bending length over the believed one'] = f'{control.bending:.3f}'
        if self.expected is not None:
            half = _NORMAL * np.sqrt(np.diag(self.expected.covariance))
            for name, mean, wide in zip('xz', self.expected.mean, half, strict=True):
                values[f'{name} expected at the target depth [m]'] = f'{mean:.6f} +- {wide:.6f}'
        return values, control.warning if self.steers else ''

    def diagnose(self, now: int) -> tuple[Severity, str, dict[str, object]]:
        """
        Return severity, the state in one line, and values by name.

        Parameters
        ----------
        now : int
            Time [ns].

        """
        values, warning = self._describe_control()
        if self._seen is not None:
            seen, noise = self._seen, self._belief.noise
            values['readings of the last look'] = seen.readings
            values['standard error of the last look [m]'] = f'{seen.error:.2g}'
            if not warning and seen.error > _SCATTERED * noise:
                warning = (
                    f'noise of the tip measurement is {1e3 * seen.error:.2f} mm, above the '
                    f'configured {1e3 * noise:.2f} mm (belief.noise)'
                )
        values['phase'] = self.phase.value
        values |= self.requests.status().to_values()
        values['inputs refused'] = self.journal.refused
        values['last complaint'] = self.journal.complaint
        for stream in (self._joint_stream, self._tip_stream):
            values[f'input {stream.name}'] = stream.describe(now)
        if self.phase is Phase.STOPPED:
            return Severity.ERROR, f'stopped: {self.fault}', values
        if warning:
            return Severity.WARNING, warning, values
        if self.phase is Phase.DONE:
            return Severity.INFO, f'done: {self._outcome()}', values
        state = _DESCRIPTIONS[self.phase]
        if self._job is not None:
            state = f'{state}: {self._job.fraction:.0%}'
        elif self.steers and self._monitor.paused:
            state = f'{state}; {self._monitor.paused} is paused'
        return Severity.INFO, state, values


def _words(point: tuple[float, float, float]) -> str:
    x, y, z = (1e3 * one for one in point)
    return f'x = {x:.2f} mm, z = {z:.2f} mm at a depth of {y:.2f} mm'
