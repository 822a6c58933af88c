# SPDX-License-Identifier: Apache-2.0
"""Axial supervisor, without ROS: input checks, stops, requests, force commands."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from time import monotonic
from typing import Final

from needle_controller.controller import Controller, ControllerSettings, Measurement
from needle_controller.force_command import ForceCommand
from needle_controller.gains import AllGains
from needle_controller.hardware import HardwareSettings, Robot
from needle_controller.load_estimator import build_observer, LoadEstimator
from needle_controller.observer.settings import ObserverSettings
from needle_controller.safety.input_monitor import InputMonitor, Refusal, REPEATED
from needle_controller.safety.response_monitor import ResponseMonitor
from needle_controller.safety.safety import FaultKind, Safety, SafetyLimits
from needle_controller.safety.timing_monitor import TimingMonitor
from needle_controller.state_machine import StateMachine
from needle_dynamics import NeedleModel, NeedleParameters
from needle_ros.contract import BASE, INSERTION, JOINT_TRAJECTORY, TARGET, Topic
from needle_ros.errors import JobError, NeedleError, ParameterError
from needle_ros.event_log import Severity
from needle_ros.requests import RequestAction, Verdict, WaitingRequests
from needle_ros.status import ControllerPhase, ControllerStatus
from needle_ros.system_state import CLEAR_STOP, Mode, RETRACT, STOP, STOPPED
from needle_ros.timing import NANOSECONDS
from needle_ros.trajectories import JointPath
from needle_ros.wire import Reading

_WAITING: Final = 'no joint_states yet'


class Supervisor(StateMachine[ForceCommand]):
    """
    Answer each measurement with a force command, and command zero force on any fault.

    Every event is a method: it takes the present time [ns] of the clock that stamps the messages,
    and returns a command. None leaves the last command unchanged. `events` contains lines for the
    log; `fault`: why no force is commanded or the reference waits, else ''. `steady`: `EventLog`.
    """

    def __init__(self, steady: Callable[[], float] = monotonic) -> None:
        super().__init__(steady, {})
        self.receive(targets=True)
        self.safety = Safety(SafetyLimits(), ControllerSettings(), NeedleParameters())
        self._joints = self.safety.streams['joint_states']
        self.retract_depth = 0.0  #: Insertion depth of `retract` [m].
        self.fault, self._kind = '', FaultKind.WAITING
        self._timing = TimingMonitor()
        self._robot: Robot | None = None
        self._last = ForceCommand(0)
        self._answered: tuple[int, int] | None = None  #: Stamp and time of a sample for `finish`.
        self._depth: float | None = None  #: Last valid insertion depth [m].
        #: The controller while configured, and while measurements are answered.
        self.controller: Controller | None = None
        self._active: Controller | None = None
        self.cleanup()

    # Transitions.

    def configure(
        self,
        controller: Controller,
        limits: SafetyLimits,
        observed: ObserverSettings | None = None,
        robot: Robot | None = None,
        *,
        simulated: bool = False,
    ) -> None:
        """Set controller, sensors, robot and kind of time (`Safety`); a latched stop stays."""
        observer = None
        if observed is not None:
            observer = build_observer(controller.parameters, observed, controller.period)
        self.controller, self._robot = controller, robot
        self._following = ResponseMonitor(controller.parameters, controller.settings)
        self.bending = LoadEstimator(controller.parameters, observer, limits.axial_load)
        own = HardwareSettings() if robot is None else robot.settings
        stop, self._time = self.safety.stop, 0
        self.safety = Safety(
            limits,
            controller.settings,
            controller.parameters,
            expected=own.expected,
            noise=None if observed is None else observed.sensor_noise,
            wrench_frame=own.wrench_frame or BASE,
            simulated=simulated,
        )
        self.safety.stop, self._joints = stop, self.safety.streams['joint_states']

    def cleanup(self) -> None:
        self.controller = self._active = None
        self.bending = LoadEstimator(NeedleParameters())

    def change(self, parameters: NeedleParameters, law: str, gains: AllGains) -> None:
        """Continue with other constants, gains or law; see `Controller.change`."""
        if self.controller is not None:
            self.controller.change(parameters, law=law, gains=gains)
            self.bending.model = NeedleModel(parameters)
            self._following.change(parameters)

    @property
    def waits(self) -> bool:
        """Whether no measurement was received yet."""
        return bool(self.fault) and self._kind is FaultKind.WAITING

    def activate(self, now: int, publishers: Mapping[str, int]) -> None:
        """Start to answer measurements; see `watch`."""
        self.fault, self._kind = _WAITING, FaultKind.WAITING
        if self.controller is not None:
            stamped = self._robot is None or self._robot.settings.stamped
            self._timing = TimingMonitor(self.controller.settings, stamped=stamped)
        self._begin(now)
        self.safety.count_publishers(publishers)
        self._active = self.controller
        if self._obeyed is not Mode.STOPPED:
            self._obeyed = Mode.RUNNING
            self.obey(now)

    def deactivate(self, now: int) -> ForceCommand:
        """Command zero force, and discard the motion and its target."""
        if self.controller is not None:
            self.controller.forget()
        self._active = None
        self._waiting.end('the controller is not active')
        return self._command(ForceCommand(now))

    def _begin(self, now: int) -> None:
        self._waiting, self._time = WaitingRequests(self.requests), now
        self.safety.begin(now)
        self._depth, self._origin, self._answered = None, -1, None
        self.requests.forget()
        self.bending.forget()
        if self._robot is not None:
            self._robot.begin()

    def _check_clock(self, now: int) -> ForceCommand | None:
        """Command zero force and discard measurements and requests if the clock was set back."""
        if not (back := self.clock_went_back(now, self._joints.timeout)):
            return None
        self._begin(now)
        return self._release_for(f'clock went back by {back:.3f} s', now, FaultKind.CLOCK)

    # Requests.

    def receive(self, *, targets: bool) -> None:
        self._targets = targets
        topics = (TARGET, JOINT_TRAJECTORY) if targets else (JOINT_TRAJECTORY,)
        self._take_requests(dict.fromkeys(topics, (INSERTION,)))
        self._waiting = WaitingRequests(self.requests)

    def target(
        self, stamp: int, frame: str, depth: float, deflection: float, now: int
    ) -> ForceCommand | None:
        """Take a target insertion depth [m]; its deflection [m] is ignored."""

        def aim(controller: Controller, _elapsed: float) -> None:
            controller.set_target(depth)
            if deflection != 0.0:
                self._warn(
                    'target deflection',
                    f'target deflection {deflection:g} m is ignored: force and torque at the '
                    'base cannot reach it; the depth is taken',
                )

        return self._request(TARGET, stamp, frame, now, aim)

    def trajectory(self, stamp: int, frame: str, path: JointPath, now: int) -> ForceCommand | None:
        """Take a path, which starts at its stamp."""

        def follow(controller: Controller, elapsed: float) -> None:
            controller.follow_joints(path, elapsed)

        answer = self._request(JOINT_TRAJECTORY, stamp, frame, now, follow)
        if path.stops and stamp <= now:
            # A stop waits for no sample.
            self._execute_request(stamp + 1)
        return answer

    def discard(self, reason: str) -> None:
        self._waiting.discard(reason, (INSERTION,))

    def hold(self) -> None:
        if self.controller is not None:
            self.controller.stop_motion()

    def _request(
        self, topic: Topic, stamp: int, frame: str, now: int, act: RequestAction
    ) -> ForceCommand | None:
        answer = self._check_clock(now) if self._active is not None else None
        if not self._is_new(topic, stamp, frame, now):
            return answer
        # Valid from the first sample after its stamp on, in any order of arrival.
        request = self._waiting.add(topic, stamp, (INSERTION,), act)
        since = last if (last := self._joints.last) >= 0 else now
        waits = self._active is not None and self.safety.stop is None
        self._execute_request((since if waits else stamp) + 1, request.elapsed(since))
        return answer

    def _execute_request(self, stamp: int, elapsed: float = 0.0) -> None:
        if (request := self._waiting.take(stamp)) is None:
            return
        if self.authority.mode is Mode.RETRACTING and not self._targets:
            # The motion is from the node `steering`, not from a user.
            self.requests.answer(*request[:2], Verdict.SUPERSEDED, 'the needle is retracted')
            return
        try:
            if self._active is None:
                raise JobError('the controller is not active')
            if self.safety.stop is not None:
                raise JobError(f'{STOPPED}{self.safety.stop}; ~/clear_stop releases')
            request.act(self._active, elapsed)
            self._end_retraction()
        except (JobError, ParameterError) as error:
            self._reject(request.topic, request.stamp, error)
        else:
            self._accept(request.topic, request.stamp)

    def _obstacle(self, word: str, now: int) -> str:
        if word == STOP:
            return ''
        if word != CLEAR_STOP:
            if self._active is None:
                return 'the controller is not active'
            return _WAITING if word == RETRACT and self._depth is None else ''
        self._check_clock(now)
        return self.safety.obstacle(now) or ''

    def _change_mode(self, mode: Mode, before: Mode, now: int) -> ForceCommand | None:
        if mode in (Mode.STOPPED, Mode.RETRACTING) or before is Mode.STOPPED:
            self.requests.supersede(now)
        if mode is Mode.STOPPED:
            return self._stop(self.authority.reason, now)
        if before is Mode.STOPPED and not self._clear(now):
            return None
        if self._active is not None:
            guide = self._active.guide
            (guide.pause if mode is Mode.PAUSED else guide.resume)()
            if mode is Mode.RETRACTING:
                self._retract(self._active, self._depth)
        return None

    def _stop(self, reason: str, now: int) -> ForceCommand:
        self.safety.latch(reason)
        self._waiting.end(f'{STOPPED}{reason}')
        self.bending.forget()
        self.fault, self._kind = reason, FaultKind.STOP
        if self.controller is not None:
            self.controller.guide.forget()
        self.events.add(Severity.ERROR, f'stopped: {reason}; no force until ~/clear_stop')
        return self._release(now)

    def _clear(self, now: int) -> bool:
        """Release the stop, or stop the system again because of a measurement."""
        if (reason := self.safety.clear(now)) is not None:
            self.authority.stop(reason)
            self._obeyed = Mode.STOPPED
            return False
        self.fault, self._kind = _WAITING, FaultKind.WAITING
        self.bending.forget()
        self.events.add(Severity.INFO, 'the stop is cleared')
        return True

    def _retract(self, controller: Controller, depth: float | None) -> None:
        """Withdraw a needle at a depth [m]; one that is less deep rests."""
        self._waiting.end('the needle is retracted', Verdict.SUPERSEDED)
        if depth is not None:
            low, high = controller.settings.depths(controller.parameters)
            controller.set_target(min(max(min(self.retract_depth, depth), low), high))

    def tip(self, reading: Reading, now: int) -> ForceCommand | None:
        if self._active is None:
            return None
        answer, (x, depth, deflection) = self._check_clock(now), reading.values[0]
        if self._is_valid(self.safety.streams['tip_deflection'], reading, [deflection], now):
            answer = self._stop_for(self.safety.guard.tip(deflection, depth, x), now) or answer
            # Every reading beyond a limit is discarded, also a single one.
            if not self.safety.guard.is_beyond('tip_deflection'):
                self.finish()
                self.bending.take_tip(reading.stamp, deflection)
        return answer

    def wrench(self, reading: Reading, now: int) -> ForceCommand | None:
        if self._active is None:
            return None
        answer, values = self._check_clock(now), reading.values[0]
        x, axial, lateral, moment, _, _ = values
        stream, guard = self.safety.streams['base_wrench'], self.safety.guard
        if self._is_valid(stream, reading, [lateral, moment, axial], now):
            answer = self._stop_for(guard.wrench(values[:3], values[3:]), now) or answer
            # The sensor also measures the commanded torque of the base.
            moment -= self._last.torque
            if not guard.is_beyond('base_wrench'):
                self.finish()
                self.bending.take_wrench(reading.stamp, lateral, moment)
                if self._robot is not None:
                    self._robot.reaction = x, axial, lateral
        return answer

    def truth(self, reading: Reading, now: int) -> ForceCommand | None:
        """Take the load of the bent needle from `ground_truth` of the simulation."""
        if self._active is None:
            return None
        answer, (positions, velocities, _) = self._check_clock(now), reading.values
        state = [*positions, *velocities]
        if self._is_valid(self.safety.streams['ground_truth'], reading, state, now):
            try:
                self.bending.take_truth(state)
            except NeedleError as error:
                self._warn('ground_truth', f'ground_truth: {error}; ignored')
        return answer

    def _report(self, stream: InputMonitor, refusal: Refusal) -> None:
        self._warn(f'{stream.name} {refusal.kind}', f'{refusal.line}; ignored')

    def _warn(self, kind: str, line: str | None) -> None:
        if line is not None:
            self.events.add(Severity.WARNING, line, kind)

    def encoders(self, reading: Reading, now: int) -> ForceCommand | None:
        """Answer `joint_states`; a repeated message gets the same command, a late one none."""
        if (controller := self._active) is None:
            return None
        stamp, answer = reading.stamp, self._check_clock(now)
        self.finish()
        refusal = self._joints.check(stamp, now)
        if refusal is not None:
            if refusal.kind == REPEATED:
                return self._again(stamp)
            return answer if refusal.harmless else self._release_for(refusal.line, now)
        self._answered = stamp, now
        self._execute_request(stamp)
        try:
            convert = Measurement.from_reading if self._robot is None else self._robot.measurement
            # A float has too few digits for Unix time.
            self._origin = stamp if self._origin < 0 else self._origin
            measured = convert(reading, self._origin)
        except ParameterError as error:
            self._depth, self._joints.refused = None, str(error)
            return self._release_for(str(error), stamp)
        if measured.is_finite():
            self._stop_for(self.safety.guard.encoders(measured), stamp)
            if self.safety.guard.is_beyond('joint_states'):
                # A single reading is a sensor fault: neither law nor observer uses it.
                if self.safety.stop is not None:
                    return self._command(ForceCommand(stamp))
                return self._release_for('joint_states is beyond a limit', stamp)
            self._depth = measured.depth
            self.bending.take_encoders(stamp, measured)
        answer = self._answer(controller, stamp, measured, (now - stamp) / NANOSECONDS)
        # In lock-step the next sample may wait for the answer to a request of this time.
        self._execute_request(stamp + 1)
        return answer

    def finish(self) -> None:
        """Do what the last command did not wait for: monitors, and the load for the next one."""
        if self._answered is not None:
            self._timing.add(*self._answered)
            self._answered, (stamp, *forces, reference, _) = None, self._last
            if reference and self._depth is not None:
                self._warn('buckling', self.safety.check_force(stamp, self._depth, *forces))
        if not self.bending.waits:
            return
        try:
            self.bending.update()
        except NeedleError as error:
            self._warn('observer', f'observer: {error}')
        self._warn('doubt', self.bending.warning)

    def _again(self, stamp: int) -> ForceCommand:
        if self._last.stamp == stamp:
            return ForceCommand(stamp, self._last.force, self._last.torque)
        return self._command(ForceCommand(stamp))

    def _answer(
        self, controller: Controller, stamp: int, measured: Measurement, age: float
    ) -> ForceCommand | None:
        safety = self.safety
        if safety.stop is not None:
            return self._command(ForceCommand(stamp))
        if safety.duplicate_publishers is not None:
            return self._release_for(safety.duplicate_publishers, stamp, FaultKind.PUBLISHERS)
        command = controller.command(measured, self.bending.load, age)
        if command.fault is not None:
            return self._release_for(command.fault, stamp, FaultKind.CONTROL)
        if command.refusal is not None or not command.is_finite():
            # The memory of the laws is invalid.
            controller.forget()
            return self._stop_for(command.refusal or 'the command is not finite', stamp)
        if command.notice is not None:
            self.events.last_rejection = command.notice
            self.events.add(Severity.ERROR, command.notice)
            if controller.target is None:
                self._waiting.end(command.notice)
        aim = command.setpoint
        error = aim.position - measured.depth, aim.velocity - measured.velocity
        forces = self._last.force, measured.force, self.bending.load
        following, depth = self._following, measured.depth
        step = error[0] if controller.guide.steps else None
        lost = following.update(stamp, depth, aim.velocity, *forces, step, measured.behind)
        receded = controller.guide.receded(depth, aim.velocity)
        fault = safety.guard.tracking(error[0], receded) or following.fault
        if (stopped := self._stop_for(fault, stamp)) is not None:
            return stopped
        controller.guide.waits, controller.relaxed = lost, following.relaxed
        if lost:
            controller.unwind()
            self._log_fault(FaultKind.RESPONSE, following.notice or '', 'the reference waits')
        else:
            self._warn('rest', following.notice)
            if self.fault:
                self.fault = ''
                self.events.add(Severity.INFO, kind='recovery')
        force, torque = 0.0 if following.relaxed else command.force, command.torque
        return self._command(ForceCommand(stamp, force, torque, aim[:2], error))

    def watch(self, now: int, publishers: Mapping[str, int]) -> ForceCommand | None:
        """Check for missing inputs, and for duplicate publishers of commands and measurements."""
        answer, safety = self._check_clock(now), self.safety
        safety.count_publishers(publishers)
        if safety.duplicate_publishers is not None:
            answer = self._release_for(safety.duplicate_publishers, now, FaultKind.PUBLISHERS)
        elif not self._joints.is_current(now):
            line = self._joints.stale(self._joints.silence(now))
            answer = self._release_for(line, now)
        answer = self._stop_for(safety.mixed_sources(now), now) or answer
        if not safety.streams['ground_truth'].is_current(now):
            self.bending.load = 0.0
        for name, line in safety.new_warnings(now).items():
            self._warn(name, line)
        answer = self._stop_for(safety.missing(now), now) or answer
        self._warn('pace', self._timing.compare_rate(self._joints))
        return answer

    def _stop_for(self, reason: str | None, stamp: int) -> ForceCommand | None:
        if reason is None or self.authority.reason:
            return None
        self.authority.stop(reason)
        return self.obey(stamp)

    def _release_for(
        self, fault: str, stamp: int, kind: FaultKind = FaultKind.INPUT
    ) -> ForceCommand:
        self._log_fault(kind, fault, 'no force is commanded')
        return self._release(stamp)

    def _log_fault(self, kind: FaultKind, fault: str, consequence: str) -> None:
        if not self.fault or self._kind is not kind:
            self.events.add(Severity.ERROR, f'{fault}; {consequence}', kind.value)
        self.fault, self._kind = fault, kind

    def _release(self, stamp: int) -> ForceCommand:
        if self.controller is not None:
            self._following.forget()
            self.controller.guide.waits = False
            self.controller.release()
        self._waiting.end(self.fault or 'no force is commanded')
        return self._command(ForceCommand(stamp))

    def _command(self, answer: ForceCommand) -> ForceCommand:
        self._last = answer
        return answer

    def depth(self, now: int) -> float | None:
        """Return the measured insertion depth [m]; None if it is old, or of several robots."""
        single = self.safety.duplicate_publishers is None
        return self._depth if single and self._joints.is_current(now) else None

    @property
    def _phase(self) -> ControllerPhase:
        if self.safety.stop is not None:
            return ControllerPhase.STOPPED
        if self._active is None:
            return ControllerPhase.INACTIVE
        faulty = ControllerPhase.WAITING if self.waits else ControllerPhase.FAULT
        return faulty if self.fault else ControllerPhase.ACTIVE

    def diagnose(self, now: int) -> tuple[Severity, str | None, ControllerStatus]:
        """Return severity, fault if there is any, and status."""
        safety, control, active = self.safety, self.controller, self._active
        warning = safety.warning(now) or self.bending.warning or self._timing.warning(now)
        status = replace(
            safety.status(ControllerStatus() if control is None else control.status(), now),
            phase=self._phase,
            system=self.authority.mode,
            fault=self.fault,
            warning=(warning or '') if active is not None else '',
            observer=self.bending.status(),
            latency=self._timing.status(),
            rejected=self.events.rejected,
            last_rejection=self.events.last_rejection,
            requests=self.requests.status(),
        )
        if safety.stop is not None:
            return Severity.ERROR, f'{safety.stop}; ~/clear_stop releases', status
        held = (self.fault or status.warning) if active is not None else ''
        return Severity.WARNING if held else Severity.INFO, held or None, status
