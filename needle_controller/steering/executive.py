# SPDX-License-Identifier: Apache-2.0
"""
Steering executive: plan, measure the tip, move the guide, insert the needle; without ROS.

It requests motions of needle and guide, which a position-controlled robot executes, or an axis law
that converts the insertion to forces. The executive processes events, requests and stops; an
insertion follows one of two strategies, `SteppedInsertion` or `ContinuousInsertion`.
"""

from collections.abc import Callable
from dataclasses import replace
from time import monotonic
from typing import Final

from needle_controller.safety.input_monitor import InputMonitor, Refusal
from needle_controller.state_machine import StateMachine
from needle_controller.steering.continuous import ContinuousInsertion
from needle_controller.steering.guarded_law import GuardedLaw
from needle_controller.steering.insertion import SteppedInsertion
from needle_controller.steering.insertion_plan import Plan
from needle_controller.steering.insertion_record import PlannedInsertion, RecordKeeper
from needle_controller.steering.insertion_status import describe, summarize
from needle_controller.steering.law import ContactError, DEFAULT_LAW, SteeringLaw, TipEstimate
from needle_controller.steering.motion import JointMotion
from needle_controller.steering.motion_control import MotionControl, Retraction
from needle_controller.steering.planner import check_plan, describe_target, InsertionPlanner
from needle_controller.steering.planning import Job, StartJob
from needle_controller.steering.settings import (
    ContactSettings,
    ExecutiveSettings,
    SteeringPrior,
    WITHDRAW,
)
from needle_dynamics.arrays import FloatArray
from needle_dynamics.parameters import NeedleParameters
from needle_dynamics.steering.parameters import SteeringParameters
from needle_ros.contract import ENTRY, INSERTION, JOINT_STATES, TARGET, TIP_DEFLECTION
from needle_ros.errors import JobError, NeedleError, ParameterError
from needle_ros.event_log import Severity
from needle_ros.requests import RequestStatus, Verdict
from needle_ros.status import SteeringPhase as Phase
from needle_ros.status import SteeringStatus
from needle_ros.system_state import Mode, RETRACT, STOPPED
from needle_ros.wire import Reading
import numpy as np

#: Changes from one message to the next that are implausible [m, rad].
_JUMPS: Final = (5e-3, 5e-3, 5e-3, 1.0)

#: Tolerance of a joint during a measurement, as a multiple of its tolerance at arrival: a needle
#: that settles at the limit does not end the insertion.
_LEFT: Final = 1.5

_MOVING: Final = (Phase.GUIDING, Phase.INSERTING, Phase.RETRACTING)


class SteeringExecutive(StateMachine[JointMotion]):
    """
    Execute a steered insertion, and stop it on any fault.

    Every event is a method: it takes the time ``now`` [ns] of the clock that stamps the messages,
    and returns a `JointMotion` of needle and guide to send; None leaves the last motion in effect.
    A motion is sent again until the joints follow it, see `MotionMonitor`. `fault` is the reason
    of the stop, '' without a stop.

    Parameters
    ----------
    needle, steering : NeedleParameters, SteeringParameters
        Nominal needle and tissue, and their constants for steering.
    prior : SteeringPrior
        Prior uncertainty of all constants.
    settings : ExecutiveSettings
        Steps, tip measurements and limits.
    steady : callable
        As for `EventLog`.
    start : callable
        Starts the computation of a plan, see `StartJob`.
    law : str
        Steering law, see `build_law`.
    plan : Plan, optional
        Plan that all insertions follow.
    contact : ContactSettings, optional
        Monitoring of the clearance along the plan.

    Raises
    ------
    ParameterError
        The plan is outside the settings.
    """

    def __init__(
        self,
        needle: NeedleParameters,
        steering: SteeringParameters,
        prior: SteeringPrior,
        settings: ExecutiveSettings,
        steady: Callable[[], float] = monotonic,
        start: StartJob = Job,
        law: str = DEFAULT_LAW,
        plan: Plan | None = None,
        contact: ContactSettings | None = None,
    ) -> None:
        super().__init__(steady, {TARGET: (INSERTION,)})
        self.settings = settings
        timeout = settings.measurement_timeout
        self._joint_stream = InputMonitor(JOINT_STATES.name, timeout, jumps=_JUMPS)
        self._tip_stream = InputMonitor(TIP_DEFLECTION.name, timeout, frames=('', ENTRY))
        self._streams = self._joint_stream, self._tip_stream
        self.fault, self._noise = '', prior.noise
        if plan is not None:
            check_plan(plan, settings)
        self._contact = contact or ContactSettings()
        self.planner = InsertionPlanner(
            needle, steering, prior, settings, start, law, plan, self._contact
        )
        self._motions = MotionControl(settings, self.events)
        self.keeper = RecordKeeper()  #: record of the insertion, for an executive after a restart
        self._tip: tuple[float, ...] | None = None  #: the newest reading of the tip [m]
        self._deepest = 0.0  #: largest insertion depth so far [m]
        #: The latest insertion, and the retraction after it.
        self._insertion: SteppedInsertion | None = None
        self._retraction: Retraction | None = None

    @property
    def phase(self) -> Phase:
        if self.planner.job is not None:
            return Phase.PLANNING
        if self._retraction is not None:
            return Phase.IDLE if self._retraction.ended else Phase.RETRACTING
        if self._insertion is None:
            return Phase.IDLE
        return Phase.STOPPED if self.fault else self._insertion.phase

    @property
    def steers(self) -> bool:
        """Whether an insertion is under way."""
        return self.phase in (Phase.GUIDING, Phase.INSERTING, Phase.MEASURING)

    @property
    def _moves(self) -> bool:
        return self.phase in _MOVING and self._motions.known

    @property
    def busy(self) -> bool:
        """Whether a plan is being computed: simulated time may wait for it."""
        return self.phase is Phase.PLANNING

    @property
    def law(self) -> SteeringLaw | None:
        return None if self._insertion is None else self._insertion.law.law

    @property
    def expected(self) -> TipEstimate | None:
        """Expected position of the tip at the target depth; a new one after each plan."""
        return None if self._insertion is None else self._insertion.law.expected

    @property
    def depth(self) -> float:
        """Depth of the target of the latest insertion [m]."""
        return 0.0 if self._insertion is None else float(self._insertion.law.depths[-1])

    def target(
        self, stamp: int, frame: str, point: tuple[float, float, float], now: int
    ) -> JointMotion | None:
        """Plan an insertion to a target x, y, z [m], or change its target; a stamp may be 0."""
        if not self._is_new(TARGET, stamp, frame, now):
            return None
        try:
            if not np.isfinite(point).all():
                raise ParameterError(f'target must be finite, got {list(point)}')
            self._check_mode()
            if self.steers and self._insertion is not None:
                self._insertion.law.change_target(point)
                self.events.add(Severity.INFO, f'target changed to {describe_target(point)}')
            else:
                self._plan(stamp, point, now)
        except NeedleError as error:
            self._reject(TARGET, stamp, str(error))
            return None
        self._end_retraction()
        planning = self.phase is Phase.PLANNING
        self._accept(TARGET, stamp, Verdict.RECEIVED if planning else Verdict.ACCEPTED)
        return self._begin_if_planned(now) if planning else None

    def _check_mode(self) -> None:
        """Raise `JobError` if the system does not permit an insertion now."""
        if self.authority.reason:
            raise JobError(f'{STOPPED}{self.authority.reason}; ~/clear_stop releases')
        if self.phase is Phase.RETRACTING:
            raise JobError('the needle is withdrawn; wait until it rests, or stop it')
        if self._obeyed is Mode.PAUSED and not self.steers:
            raise JobError('paused; resume before the next insertion')

    def _check_ready(self, now: int) -> FloatArray:
        for stream in self._streams:
            if stream.publishers > 1:
                raise JobError(f'{stream.publishers} nodes publish {stream.name}')
            timeout = self.settings.measurement_timeout
            if stream.counted is None or stream.silence(now) > timeout:
                valid, why = ('valid ', f'; {stream.refused}') if stream.refused else ('', '')
                raise JobError(f'no {valid}{stream.name} received within {timeout:g} s{why}')
        if not self._motions.known:
            raise JobError('no positions of needle and guide received')
        return self._motions.at

    def _plan(self, stamp: int, point: tuple[float, float, float], now: int) -> None:
        at, last = self._check_ready(now), self._insertion
        begun = None if last is None else float(last.law.depths[0])
        request = self.planner.prepare(
            PlannedInsertion(stamp, point, at), begun, self._tip, self.authority.state.newest
        )
        self._cancel(Verdict.SUPERSEDED, 'a newer target was received')
        self.planner.start(request)
        steps = len(request.depths) - 1
        self.events.add(Severity.INFO, f'planning to {describe_target(point)} in {steps} steps')

    def _cancel(self, verdict: Verdict, why: str) -> None:
        request = self.planner.cancel()
        if request is None:
            return
        self.requests.answer(TARGET, request.stamp, verdict, why)
        self.events.add(Severity.INFO, f'planning cancelled: {why}')

    def _begin_if_planned(self, now: int) -> JointMotion | None:
        taken = None if self._obeyed is Mode.PAUSED else self.planner.take()
        if taken is None:
            return None
        (stamp, point, planned, depths, _), job = taken
        settings, motions = self.settings, self._motions
        try:
            law, at = job.result(), self._check_ready(now)
            moved = np.flatnonzero(np.abs(at - planned) > settings.tolerances)
            if len(moved):
                raise JobError(f'{settings.joints[moved[0]]} has moved during planning')
            guarded = GuardedLaw(law, depths, self._noise, settings, self.events)
            self.planner.resume(taken[0], guarded)
        except NeedleError as error:
            self._reject(TARGET, stamp, str(error))
            return None
        self._accept(TARGET, stamp)
        strategy = ContinuousInsertion if settings.continuous else SteppedInsertion
        self._insertion, self.fault = strategy(guarded, motions, settings), ''
        self._retraction = None
        self.keeper.begin(taken[0], self._insertion, self.authority)
        motions.discard_stop()
        begins = f'is resumed in step {guarded.step}' if guarded.step else 'begins'
        line = f'insertion to {describe_target(point)} in {len(depths) - 1} steps {begins}'
        self.events.add(Severity.INFO, line)
        if not guarded.step and self._deepest > at[0] + settings.tolerances[0]:
            self.events.add(
                Severity.WARNING,
                f'a needle was {1e3 * self._deepest:.1f} mm deep before: in the same tissue this '
                'one may follow the old path',
            )
        return self._insertion.begin(at, now)

    def _obstacle(self, word: str, _now: int) -> str:
        if word == RETRACT and not self._motions.known:
            return 'no positions of needle and guide received'
        return ''

    def _change_mode(self, mode: Mode, before: Mode, now: int) -> JointMotion | None:
        if mode in (Mode.STOPPED, Mode.RETRACTING) or before is Mode.STOPPED:
            self.requests.supersede(now)
        if mode is Mode.STOPPED:
            if not (self.steers or self._moves):
                self.events.add(Severity.ERROR, f'{STOPPED}{self.authority.reason}')
            return self.halt(self.authority.reason, now)
        self._motions.discard_stop()
        if mode is Mode.RETRACTING:
            return self._retract(before, now)
        if mode is Mode.PAUSED:
            return self._motions.pause(now) if self._moves else None
        if self._retraction is not None:
            # A user moves the needle by the controller.
            self._retraction.ended = True
        if before is Mode.PAUSED:
            return self._run(lambda insertion: insertion.resume(now), now)
        return None

    def _retract(self, before: Mode, now: int) -> JointMotion | None:
        """End an insertion; the retraction begins with the next positions of the joints."""
        self._cancel(Verdict.SUPERSEDED, 'the needle is retracted')
        halt = None
        if self.steers:
            halt = self._motions.pause(now) if self._moves else None
            self.fault = 'a user has requested the retraction'
        if before is Mode.PAUSED or self._retraction is None or self._retraction.ended:
            self._motions.monitor.forget()
            self._retraction = Retraction(self._motions, self.settings, self.events)
        return halt

    def _stop(self, why: str, now: int) -> JointMotion | None:
        self.authority.stop(why)
        return self.obey(now)

    def halt(self, why: str, now: int) -> JointMotion | None:
        """End the insertion or retraction for a reason: brake to rest, and cancel a plan."""
        self.requests.supersede(now)
        self._cancel(Verdict.REJECTED, f'{STOPPED}{why}')
        moves = self._moves
        if not (self.steers or moves):
            return None
        self.fault, self._retraction = why, None
        if self._obeyed is Mode.RETRACTING:
            self._retraction = Retraction(self._motions, self.settings, self.events)
        self._motions.monitor.forget()
        self.events.add(Severity.ERROR, f'{STOPPED}{why}')
        return self._motions.stop(now) if moves else None

    def receive(self, node: str, status: RequestStatus, now: int) -> JointMotion | None:
        """Process the status of another node by name: its answers to the motions."""
        refusal = self._motions.monitor.process(node, status)
        if refusal is None:
            return None
        if self.steers:
            return self._stop(str(refusal), now)
        if self._retraction is not None:
            self._retraction.refuse(refusal)
        elif self.phase is Phase.STOPPED and not refusal.reason.startswith(STOPPED):
            # A node that is stopped itself rejects the motion to rest, too.
            self.events.add(Severity.ERROR, f'the stop failed: {refusal}')
        return None

    def joints(self, reading: Reading, now: int) -> JointMotion | None:
        """Process `joint_states`."""
        states = [reading.joint(name) for name in self.settings.joints]
        at = [state[0] for state in states if state is not None]
        if len(at) < len(states) or not reading.values[0]:
            self.events.reject(
                f'joint_states needs positions of {", ".join(self.settings.joints)}, got names '
                f'{list(reading.names)}, {len(reading.values[0])} positions'
            )
            return None
        if not self._is_valid(self._joint_stream, reading, at, now):
            return None
        motions, stamp = self._motions, reading.stamp
        motions.measure(np.array(at), stamp)
        self._deepest = max(self._deepest, at[0])
        if self.phase is Phase.STOPPED:
            return motions.stop_again(stamp, now)
        if self._obeyed is Mode.PAUSED:
            return None
        if not self.steers:
            if self.phase is Phase.DONE and motions.beyond:
                self.fault = f'after the insertion {motions.departure()}'
                return self._stop(self.fault, now)
            return None if self._retraction is None else self._retraction.follow(stamp, now)
        if departure := motions.departure():
            return self._stop(departure, now)
        if self.phase is Phase.MEASURING:
            return self._check_rest(now)
        if motions.monitor.is_late(motions.at, stamp):
            return self._run(lambda _insertion: motions.repeat(now), now)
        return self._run(lambda insertion: insertion.follow(stamp, now), now)

    def _check_rest(self, now: int) -> JointMotion | None:
        """Check needle and guide during a tip measurement."""
        left = self._motions.away(_LEFT)
        if not left.any():
            return None
        line = f'during the measurement of the tip {self._motions.missed(left)}'
        if left[1:].any() or self._motions.at[0] > self._motions.goal[0]:
            return self._stop(line, now)
        # Tissue pushes a needle back while it gets no force; the controller returns it.
        self.events.add(Severity.WARNING, f'{line}; measured again at its goal')
        return self._run(lambda insertion: insertion.measure_again(now), now)

    def _run(
        self, process: Callable[[SteppedInsertion], JointMotion | None], now: int
    ) -> JointMotion | None:
        """Pass an event to the insertion under way, and stop it on a fault."""
        insertion = self._insertion
        if insertion is None or not self.steers or self._obeyed is Mode.PAUSED:
            return None
        try:
            move = process(insertion)
        except ContactError as error:
            if self._contact.action != WITHDRAW:
                return self._stop(str(error), now)
            self.events.add(Severity.ERROR, f'{error}; the needle is withdrawn')
            self.authority.request(RETRACT)
            move, self.fault = self.obey(now), str(error)
            return move
        except NeedleError as error:
            return self._stop(str(error), now)
        if insertion.phase is Phase.DONE:
            line, severity = insertion.law.outcome()
            self.events.add(severity, f'done: {line}')
        return move

    def tip(self, reading: Reading, now: int) -> JointMotion | None:
        """Process `tip_deflection`."""
        tip = reading.values[0]
        if not self._is_valid(self._tip_stream, reading, tip, now):
            return None
        self._tip = tip
        return self._run(lambda insertion: insertion.tip(reading.stamp, tip, now), now)

    def _report(self, stream: InputMonitor, refusal: Refusal) -> None:
        self.events.reject(f'{stream.name} refused: {refusal.line}')

    def watch(self, now: int) -> JointMotion | None:
        """Check for missing inputs, and whether a plan is computed; call it ten times a second."""
        timeout = self.settings.measurement_timeout
        back = self.clock_went_back(now, self._joint_stream.timeout)
        if back:
            for stream in self._streams:
                stream.forget()
            self._motions.restart()
            halt = self._stop(f'the clock went back by {back:.3f} s', now)
            self.requests.forget()
            return halt
        if self.phase is Phase.PLANNING:
            return self._begin_if_planned(now)
        silence = self._joint_stream.silence(now)
        silent = f'no joint_states received within {silence:.2f} s' if silence > timeout else ''
        disputed = [
            f'{stream.publishers} nodes publish {stream.name}'
            for stream in self._streams
            if stream.publishers > 1
        ]
        if not self.steers:
            if self._retraction is not None and self._obeyed is Mode.RETRACTING:
                self._retraction.watch(silent and ', '.join([*disputed, silent]))
            return None
        if disputed or silent:
            return self._stop(', '.join(disputed) or silent, now)
        return self._run(lambda insertion: insertion.watch(now), now)

    def count_publishers(self, joint_states: int, tip_deflection: int) -> None:
        """Set the numbers of publishers of the measurements: each must have one source only."""
        self._joint_stream.publishers = joint_states
        self._tip_stream.publishers = tip_deflection

    def diagnose(self, now: int) -> tuple[Severity, str, SteeringStatus]:
        """Return severity, the state in one line, and status."""
        insertion, job = self._insertion, self.planner.job
        status = replace(
            describe(insertion, self._motions.goal, self._noise, active=self.steers),
            phase=self.phase,
            system=self.authority.mode,
            fault=self.fault,
            planned_fraction=None if job is None else job.fraction,
            input={stream.name: stream.status(now) for stream in self._streams},
            rejected=self.events.rejected,
            last_rejection=self.events.last_rejection,
            requests=self.requests.status(),
        )
        failure = '' if self._retraction is None else self._retraction.failure
        if self.authority.reason:
            failure = f'{STOPPED}{self.authority.reason}'
        depth, state = float(self._motions.at[0]), self.authority.state.newest
        advice = '' if insertion else self.planner.advice(depth, state)
        return (*summarize(status, insertion, failure, advice), status)
