"""Axial supervisor, without ROS: input checks, stops, requests, force commands."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from time import monotonic
from typing import Final

from needle_controller.controller import Controller, ControllerSettings, Gains, Measurement
from needle_controller.force_command import ForceCommand, ServiceResult
from needle_controller.hardware import Robot, STAMPS
from needle_controller.load_estimator import LoadEstimator
from needle_controller.observer.observer import Observer
from needle_controller.observer.settings import ObserverSettings
from needle_controller.safety.encoders import read_encoders
from needle_controller.safety.input_monitor import REPEATED
from needle_controller.safety.latency_monitor import LatencyMonitor
from needle_controller.safety.limits import SafetyLimits
from needle_controller.safety.rate_monitor import RateMonitor
from needle_controller.safety.response_monitor import ResponseMonitor
from needle_controller.safety.safety import Safety
from needle_dynamics import euler_loads, NeedleModel, NeedleParameters
from needle_ros.contract import BASE, ENTRY, INSERTION, JOINT_TRAJECTORY, TARGET, Topic
from needle_ros.errors import JobError, NeedleError, ParameterError
from needle_ros.event_log import EventLog, Severity
from needle_ros.requests import RequestLog, Verdict
from needle_ros.status import ControllerPhase, ControllerStatus
from needle_ros.timing import NANOSECONDS
from needle_ros.trajectories import joint_values, MOST_POINTS
from needle_ros.wire import Reading

_WAITING: Final = 'no joint_states yet'

#: Topics used by the observer.
_SENSORS: Final = ('base_wrench', 'tip_deflection')


class Supervisor:
    """
    Answer each measurement with a force command, and command zero force on any fault.

    Every event is a method: it takes the present time [ns] of the clock that stamps the messages,
    and returns a command. None leaves the last command unchanged. `events` contains lines for the
    log. Without a target, during a fault, and from a stop until it is cleared, all forces are
    zero.

    Parameters
    ----------
    steady : callable
        As for `EventLog`.

    Attributes
    ----------
    events : EventLog
        Lines for the log.
    requests : RequestLog
        Targets and trajectories, and the answers to them.
    safety : Safety
        Inputs, limits and the stop.
    controller : Controller or None
        Reference and laws, while configured.
    bending : LoadEstimator
        Load of the bent needle.
    fault : str or None
        Why no force is commanded, apart from a stop.
    retract_depth : float
        Insertion depth of `retract` [m].

    """

    def __init__(self, steady: Callable[[], float] = monotonic) -> None:
        self._steady = steady
        self.events = EventLog(steady)
        self.receive(targets=True)
        self.safety = Safety(SafetyLimits(), ControllerSettings(), NeedleParameters())
        self.retract_depth = 0.0
        self.fault: str | None = None
        self._lateness = LatencyMonitor()
        self._pace: RateMonitor | None = None
        self._off_pace = False
        self._robot: Robot | None = None
        self._read = read_encoders
        self._deflection_ignored = False
        self._last = ForceCommand(0)
        self._following = ResponseMonitor()
        #: Stamp of a request that waits for the next sample [ns], its topic and its execution.
        self._due: tuple[int, Topic, Callable[[Controller], None]] | None = None
        self.controller: Controller | None = None
        self.cleanup()

    # Transitions.

    def configure(
        self,
        controller: Controller,
        limits: SafetyLimits,
        observed: ObserverSettings | None = None,
        robot: Robot | None = None,
    ) -> None:
        """
        Set the controller; a latched stop stays.

        Parameters
        ----------
        controller : Controller
            Reference and laws.
        limits : SafetyLimits
            Limits of the measurements.
        observed : ObserverSettings, optional
            Noise and sensors, for the load of the bent needle from an observer.
        robot : Robot, optional
            Reads the joint states of a robot with topics of its own.

        Raises
        ------
        ParameterError
            If the settings of the observer are not valid.

        """
        noise: dict[str, tuple[float, ...]] = {}
        observer = None
        if observed is not None:
            try:
                observer = Observer(controller.parameters, observed, controller.period)
            except ParameterError as error:
                raise ParameterError(f'observer.{error}') from error
            noise['base_wrench'] = observed.force_noise, observed.torque_noise
            noise['tip_deflection'] = (observed.tip_noise,)
        self.controller = controller
        self.bending = LoadEstimator(controller.parameters, observer, limits.axial_load)
        self._robot = robot
        self._read = robot.measurement if robot is not None else read_encoders
        stop = self.safety.stop
        self.safety = Safety(
            limits,
            controller.settings,
            controller.parameters,
            expected=_SENSORS if observer is not None else (),
            noise=noise,
            wrench_frame=(robot.settings.wrench_frame if robot is not None else '') or BASE,
        )
        self.safety.stop = stop

    def cleanup(self) -> None:
        """Discard controller and load estimate."""
        self.controller = None
        self.bending = LoadEstimator(NeedleParameters())
        #: The controller while measurements are answered.
        self._active: Controller | None = None

    def change(
        self, parameters: NeedleParameters, law: str, gains: Mapping[str, Mapping[str, Gains]]
    ) -> None:
        """
        Continue with other constants, gains or law; see `Controller.change`.

        Parameters
        ----------
        parameters : NeedleParameters
            Needle and tissue.
        law : str
            Name of the law.
        gains : Mapping
            Gains by law and axis.

        Raises
        ------
        ParameterError
            If the gains are unstable. Nothing is changed then.

        """
        if self.controller is not None:
            self.controller.change(parameters, law=law, gains=gains)
            self.bending.model = NeedleModel(parameters)

    @property
    def watch_period(self) -> float:
        """Longest time between two calls of `watch` [s]."""
        timeout = self.safety.streams['joint_states'].timeout / NANOSECONDS
        return min(0.1, 0.5 * timeout)

    @property
    def waits(self) -> bool:
        """Whether no measurement was received yet."""
        return self.fault == _WAITING

    def activate(self, now: int, publishers: Mapping[str, int]) -> None:
        """
        Start to answer measurements; see `watch`.

        Parameters
        ----------
        now, publishers
            As for `watch`.

        """
        self.fault = _WAITING
        if self.controller is not None:
            self._lateness = LatencyMonitor(self.controller.delay, self.controller.period)
            settings, robot = self.controller.settings, self._robot
            # Receive times do not resolve single periods.
            stamped = robot is None or robot.settings.stamps == STAMPS[0]
            pace = RateMonitor(settings.rate, settings.measurement_timeout)
            self._pace = pace if stamped else None
        self._begin(now)
        self.safety.count_publishers(publishers)
        self._active = self.controller

    def deactivate(self, now: int) -> ForceCommand:
        """
        Command zero force, and discard the motion and its target.

        Parameters
        ----------
        now : int
            Time [ns].

        """
        if self.controller is not None:
            self.controller.forget()
        self._active = None
        self._drop_due('the controller is not active')
        return self._command(ForceCommand(now))

    def _begin(self, now: int) -> None:
        """Discard all measurements and requests."""
        self._due = None
        self.safety.begin(now)
        self.requests.forget()
        self.bending.forget()
        if self._robot is not None:
            self._robot.begin()

    def _check_clock(self, now: int) -> ForceCommand | None:
        """Command zero force and discard measurements and requests if the clock was set back."""
        back = self.safety.clock_went_back(now)
        if not back:
            return None
        self._begin(now)
        return self._release_for(f'clock went back by {back:.3f} s', now)

    # Requests.

    def receive(self, *, targets: bool) -> None:
        """
        Set which requests are accepted.

        Parameters
        ----------
        targets : bool
            Whether this controller accepts targets; otherwise only trajectories.

        """
        moved = (INSERTION,)
        takes = {TARGET: moved, JOINT_TRAJECTORY: moved} if targets else {JOINT_TRAJECTORY: moved}
        self.requests = RequestLog(takes, ('', ENTRY), self._steady)

    def target(
        self, stamp: int, frame: str, depth: float, deflection: float, now: int
    ) -> ForceCommand | None:
        """
        Take a target insertion depth [m]; its deflection [m] is ignored.

        Parameters
        ----------
        stamp : int
            Stamp of the message [ns]; 0 if it has none.
        frame : str
            Frame of the message.
        depth, deflection : float
            Insertion depth and deflection [m].
        now : int
            Time [ns].

        Returns
        -------
        ForceCommand or None
            The command, if there is a new value.

        """

        def aim(controller: Controller) -> None:
            controller.set_target(depth)
            if deflection != 0.0 and not self._deflection_ignored:
                self._deflection_ignored = True
                self.events.add(
                    Severity.WARNING,
                    f'target deflection {deflection:g} m is ignored: force and torque at the '
                    'base cannot reach it; the depth is taken',
                )

        return self._request(TARGET, stamp, frame, now, aim)

    def trajectory(
        self,
        stamp: int,
        frame: str,
        joints: Sequence[str],
        times: Sequence[float],
        positions: Sequence[Sequence[float]],
        velocities: Sequence[Sequence[float]],
        now: int,
    ) -> ForceCommand | None:
        """
        Take a path: times from now [s], positions [m] of the joints, velocities [m/s] or none.

        Parameters
        ----------
        stamp, frame, now
            As for `target`.
        joints : sequence of str
            Names of the joints.
        times : sequence of float
            Times of the points [s].
        positions, velocities : sequence of sequence of float
            Of each point, by joint [m, m/s].

        Returns
        -------
        ForceCommand or None
            The command, if there is a new value.

        """

        def follow(controller: Controller) -> None:
            if len(times) > MOST_POINTS:
                raise ParameterError(f'a path may have at most {MOST_POINTS} points')
            lengths, rates = (
                [one for one in joint_values(INSERTION, joints, values) if one is not None]
                for values in (positions, velocities)
            )
            controller.follow(times, lengths, rates or None)

        return self._request(JOINT_TRAJECTORY, stamp, frame, now, follow)

    def _request(
        self, topic: Topic, stamp: int, frame: str, now: int, act: Callable[[Controller], None]
    ) -> ForceCommand | None:
        """Execute a request if it is new and valid, and acknowledge it."""
        answer = self._check_clock(now) if self._active is not None else None
        known = self.requests.check(topic, stamp, now, frame, (INSERTION,))
        if known is not None:
            if known.verdict is Verdict.REJECTED:
                self.events.reject(f'{topic.name} rejected: {known.reason}')
            return answer
        self._drop_due(f'a newer {topic.name} is followed', Verdict.SUPERSEDED)
        # Valid from the first sample after its stamp on, in any order of arrival.
        self._due = stamp, topic, act
        self.requests.answer(topic, stamp, Verdict.RECEIVED)
        newest = self.safety.streams['joint_states'].last
        waits = self._active is not None and self.safety.stop is None and newest >= 0
        self._do_due((newest if waits else stamp) + 1)
        return answer

    def _do_due(self, stamp: int) -> None:
        """Execute the request that was sent before a stamp [ns], if any, and acknowledge it."""
        if self._due is None or self._due[0] >= stamp:
            return
        (sent, topic, act), self._due = self._due, None
        verdict, reason = Verdict.ACCEPTED, ''
        try:
            if self._active is None:
                raise JobError('the controller is not active')
            if self.safety.stop is not None:
                raise JobError(f'stopped: {self.safety.stop}; ~/clear_stop releases')
            act(self._active)
        except (JobError, ParameterError) as error:
            verdict, reason = Verdict.REJECTED, str(error)
            self.events.reject(f'{topic.name} rejected: {reason}')
        self.requests.answer(topic, sent, verdict, reason, (INSERTION,))

    def _drop_due(self, reason: str, verdict: Verdict = Verdict.REJECTED) -> None:
        """Reject a request that still waits for a sample, if any."""
        if self._due is not None:
            (sent, topic, _), self._due = self._due, None
            self.requests.answer(topic, sent, verdict, reason)

    def emergency_stop(self, now: int) -> ServiceResult:
        """
        Stop until it is cleared.

        Parameters
        ----------
        now : int
            Time [ns].

        """
        self.requests.supersede(now)
        answer = self._stop_for('emergency stop', now)
        return ServiceResult(True, 'stopped; ~/clear_stop releases', answer)

    def clear_stop(self, now: int) -> ServiceResult:
        """
        Release the stop, unless a measurement is still beyond a limit.

        Parameters
        ----------
        now : int
            Time [ns].

        Returns
        -------
        ServiceResult
            Whether it is released, or why not.

        """
        if self.safety.stop is None:
            return ServiceResult(True, 'there was no stop')
        answer = self._check_clock(now)
        reason = self.safety.clear(now)
        if reason is not None:
            message = f'clear_stop refused: {reason}'
            self.events.reject(message)
            return ServiceResult(False, message, answer)
        self.fault = _WAITING
        self.bending.forget()
        self.events.add(Severity.INFO, 'the stop is cleared')
        return ServiceResult(True, 'cleared; the motion restarts', answer)

    def pause(self, hold: bool) -> ServiceResult:
        """
        Brake the reference to rest and hold it, or let it continue.

        Parameters
        ----------
        hold : bool
            Whether to hold.

        Returns
        -------
        ServiceResult
            Rejected unless the controller is active.

        """
        if self._active is None:
            return ServiceResult(False, 'pause refused: the controller is not active')
        guide = self._active.guide
        (guide.pause if hold else guide.resume)()
        self.events.add(Severity.INFO)
        return ServiceResult(True, 'paused' if hold else 'resumed')

    def retract(self, now: int) -> ServiceResult:
        """
        Retract to `retract_depth`.

        Parameters
        ----------
        now : int
            Time [ns].

        Returns
        -------
        ServiceResult
            Rejected during a stop, and unless the controller is active.

        """
        if self._active is None or self.safety.stop is not None:
            why = 'stopped; ~/clear_stop releases' if self.safety.stop else 'not active'
            return ServiceResult(False, f'retract refused: the controller is {why}')
        self.requests.supersede(now)
        self._drop_due('the needle is retracted', Verdict.SUPERSEDED)
        self._active.guide.resume()
        self._active.set_target(self.retract_depth)
        return ServiceResult(True, f'retracting to {self.retract_depth:g} m')

    # Sensors.

    def tip(self, reading: Reading, now: int) -> ForceCommand | None:
        """
        Take a `tip_deflection` measurement.

        Parameters
        ----------
        reading : Reading
            The message.
        now : int
            Time [ns].

        Returns
        -------
        ForceCommand or None
            The command, if there is a new value.

        """
        if self._active is None:
            return None
        answer, deflection = self._check_clock(now), reading.values[0][2]
        if self._is_valid('tip_deflection', reading, [deflection], now):
            answer = self._stop_for(self.safety.guard.tip(deflection), now) or answer
            # Every reading beyond a limit is discarded, also a single one.
            if not self.safety.guard.is_beyond('tip_deflection'):
                self.bending.take_tip(reading.stamp, deflection)
        return answer

    def wrench(self, reading: Reading, now: int) -> ForceCommand | None:
        """
        Take a `base_wrench` measurement.

        Parameters
        ----------
        reading, now
            As for `tip`.

        Returns
        -------
        ForceCommand or None
            The command, if there is a new value.

        """
        if self._active is None:
            return None
        answer, (_, axial, lateral, moment, _, _) = self._check_clock(now), reading.values[0]
        if self._is_valid('base_wrench', reading, [lateral, moment, axial], now):
            answer = (
                self._stop_for(self.safety.guard.wrench(axial, lateral, moment), now) or answer
            )
            # The sensor also measures the commanded torque of the base.
            moment -= self._last.torque
            newest = self.safety.streams['joint_states'].last
            if not self.safety.guard.is_beyond('base_wrench'):
                self.bending.take_wrench(reading.stamp, lateral, moment, newest)
        return answer

    def truth(self, reading: Reading, now: int) -> ForceCommand | None:
        """
        Take the load of the bent needle from `ground_truth` of the simulation.

        Parameters
        ----------
        reading, now
            As for `tip`.

        Returns
        -------
        ForceCommand or None
            The command, if there is a new value.

        """
        if self._active is None:
            return None
        answer, (positions, velocities, _) = self._check_clock(now), reading.values
        state = [*positions, *velocities]
        if self._is_valid('ground_truth', reading, state, now):
            try:
                self.bending.take_truth(state)
            except NeedleError as error:
                self._warn('ground_truth', f'ground_truth: {error}; ignored')
        return answer

    def _is_valid(self, name: str, reading: Reading, values: Sequence[float], now: int) -> bool:
        """Return whether a measurement is valid; log the reason once a second if not."""
        refusal = self.safety.streams[name].check(reading.stamp, now, reading.frame, values)
        if refusal is not None and not refusal.harmless:
            self._warn(f'{name} {refusal.kind}', f'{refusal.line}; ignored')
        return refusal is None

    def _warn(self, kind: str, line: str) -> None:
        self.events.add(Severity.WARNING, line, kind)

    def encoders(self, reading: Reading, now: int) -> ForceCommand | None:
        """
        Answer `joint_states`; a repeated message gets the same command, a late one none.

        Parameters
        ----------
        reading, now
            As for `tip`.

        Returns
        -------
        ForceCommand or None
            The command, with the stamp of the reading.

        """
        controller = self._active
        if controller is None:
            return None
        stamp, answer = reading.stamp, self._check_clock(now)
        refusal = self.safety.streams['joint_states'].check(stamp, now)
        if refusal is not None:
            if refusal.kind == REPEATED:
                return self._again(stamp)
            return answer if refusal.harmless else self._release_for(refusal.line, now)
        self._lateness.add(now, (now - stamp) / NANOSECONDS)
        self._do_due(stamp)
        try:
            measured = self._read(reading)
        except ParameterError as error:
            return self._release_for(str(error), stamp)
        if measured.is_finite():
            self._stop_for(self.safety.guard.encoders(measured), stamp)
            if self.safety.guard.is_beyond('joint_states'):
                # A single reading is a sensor fault: neither law nor observer uses it.
                if self.safety.stop is not None:
                    return self._command(ForceCommand(stamp))
                return self._release_for('joint_states is beyond a limit', stamp)
            try:
                self.bending.update(stamp, measured)
            except NeedleError as error:
                self._warn('observer', f'observer: {error}')
            if self.bending.warning is not None:
                self._warn('doubt', self.bending.warning)
        return self._answer(controller, stamp, measured)

    def _again(self, stamp: int) -> ForceCommand:
        """Repeat the last command if it answered this stamp, else command zero force."""
        last = self._last
        if last.stamp == stamp:
            return ForceCommand(stamp, last.force, last.torque)
        return self._command(ForceCommand(stamp))

    def _answer(
        self, controller: Controller, stamp: int, measured: Measurement
    ) -> ForceCommand | None:
        safety = self.safety
        if safety.stop is not None:
            return self._command(ForceCommand(stamp))
        if safety.duplicate_publishers is not None:
            return self._release_for(safety.duplicate_publishers, stamp)
        command = controller.command(measured, self.bending.load)
        if command.fault is not None:
            return self._release_for(command.fault, stamp)
        if not command.is_finite():
            # The memory of the laws is invalid.
            controller.forget()
            return self._stop_for('the command is not finite', stamp)
        if command.notice is not None:
            self.events.last_rejection = command.notice
            self.events.add(Severity.ERROR, command.notice)
        aim = command.setpoint
        error = aim.position - measured.depth, aim.velocity - measured.velocity
        stopped = self._stop_for(safety.guard.tracking(error[0]), stamp)
        if stopped is not None:
            return stopped
        lost = self._following.update(
            stamp, measured.depth, aim.position, self._last.force, measured.force
        )
        if lost != controller.guide.waits:
            controller.guide.wait(lost)
        if lost:
            controller.unwind()
            self._log_fault(
                'the plant does not follow: it reports '
                f'{measured.force:.3g} N, {self._last.force:.3g} N is commanded',
                'the reference waits',
            )
        elif self.fault is not None:
            self.fault = None
            self.events.add(Severity.INFO, kind='recovery')
        force, torque, limits = command.force, command.torque, controller.settings
        most = euler_loads(controller.parameters, max(measured.depth, 0.0)).pinned
        if force > most:
            self._warn(
                'buckling',
                f"{force:.3g} N exceeds Euler's load {most:.3g} N of the part outside of the "
                'tissue: without a guide it buckles; lower force_limit',
            )
        full = abs(force) >= limits.force_limit or abs(torque) >= limits.torque_limit
        safety.saturation.add(stamp, full)
        return self._command(ForceCommand(stamp, force, torque, aim[:2], error))

    def watch(self, now: int, publishers: Mapping[str, int]) -> ForceCommand | None:
        """
        Check for missing inputs, and for duplicate publishers of commands and measurements.

        Parameters
        ----------
        now : int
            Time [ns].
        publishers : Mapping[str, int]
            Number of nodes that publish a topic, with this node, by topic.

        Returns
        -------
        ForceCommand or None
            The command, if there is a new value.

        """
        answer, safety = self._check_clock(now), self.safety
        safety.count_publishers(publishers)
        timeout = safety.streams['joint_states'].timeout / NANOSECONDS
        silence = safety.streams['joint_states'].silence(now)
        if safety.duplicate_publishers is not None:
            answer = self._release_for(safety.duplicate_publishers, now)
        elif silence > timeout:
            answer = self._release_for(
                f'joint_states is stale: none received for {silence:.3f} s', now
            )
        answer = self._stop_for(safety.mixed_sources(now), now) or answer
        if safety.streams['ground_truth'].silence(now) > timeout:
            self.bending.load = 0.0
        for line in safety.new_warnings(now):
            self._warn(line.partition(' ')[0], f'{line}; the observer continues without it')
        if safety.limits.sensors_required:
            answer = self._stop_for(safety.warning(now), now) or answer
        self._watch_pace()
        return answer

    def _watch_pace(self) -> None:
        """Log the start of a deviation of the measurement rate from the nominal rate."""
        if self._pace is None:
            return
        joints = self.safety.streams['joint_states']
        self._pace.add(joints.last, joints.step)
        line = self._pace.warning()
        if line is not None and not self._off_pace:
            self._warn('pace', line)
        self._off_pace = line is not None

    # Zero force.

    def _stop_for(self, reason: str | None, stamp: int) -> ForceCommand | None:
        """Latch a stop, if there is a reason and no stop yet."""
        if not self.safety.latch(reason):
            return None
        self.fault = reason
        self.bending.forget()
        self.events.add(Severity.ERROR, f'stopped: {reason}; no force until ~/clear_stop')
        return self._release(stamp)

    def _release_for(self, fault: str, stamp: int) -> ForceCommand:
        """Command zero force on a fault, and log its beginning."""
        self._log_fault(fault, 'no force is commanded')
        return self._release(stamp)

    def _log_fault(self, fault: str, consequence: str) -> None:
        """Record a fault, and log its beginning."""
        # The first word of the line identifies the kind of fault.
        kind = fault.partition(' ')[0]
        if self.fault is None or not self.fault.startswith(kind):
            self.events.add(Severity.ERROR, f'{fault}; {consequence}', kind)
        self.fault = fault

    def _release(self, stamp: int) -> ForceCommand:
        self._drop_due(self.fault or 'no force is commanded')
        self._following.forget()
        if self.controller is not None:
            self.controller.guide.wait(False)
            self.controller.release()
        return self._command(ForceCommand(stamp))

    def _command(self, answer: ForceCommand) -> ForceCommand:
        self._last = answer
        return answer

    # Status.

    @property
    def _phase(self) -> ControllerPhase:
        if self.safety.stop is not None:
            return ControllerPhase.STOPPED
        if self._active is None:
            return ControllerPhase.INACTIVE
        if self.fault is None:
            return ControllerPhase.ACTIVE
        return ControllerPhase.WAITING if self.waits else ControllerPhase.FAULT

    def _warning(self, now: int) -> str:
        if self._active is None:
            return ''
        pace = self._pace.warning() if self._pace is not None else None
        late = self._lateness.warning(now)
        return self.safety.warning(now) or self.bending.warning or late or pace or ''

    def _status(self, now: int) -> ControllerStatus:
        safety, control = self.safety, self.controller
        paused = self._active is not None and self._active.guide.paused
        status = ControllerStatus(
            phase=self._phase,
            fault=self.fault or '',
            stop=safety.stop or '',
            stops=safety.stops,
            warning=self._warning(now),
            duplicate_publishers=safety.duplicate_publishers or '',
            observer=self.bending.status(),
            latency=self._lateness.status(),
            command_rate=safety.saturation.rate(now),
            saturated_fraction=safety.saturation.share(now),
            input=safety.inputs(now),
            rejected=self.events.rejected,
            last_rejection=self.events.last_rejection,
            requests=self.requests.status(paused=paused),
        )
        if control is None:
            return status
        name, limit = max(control.limits.items(), key=lambda item: item[1].radius - item[1].bound)
        return replace(
            status,
            target=control.target,
            law=control.law,
            least_stable_axis=name,
            spectral_radius=limit.radius,
            spectral_radius_limit=limit.bound,
            learned=control.learned,
        )

    def diagnose(self, now: int) -> tuple[Severity, str | None, ControllerStatus]:
        """
        Return severity, fault if there is any, and status.

        Parameters
        ----------
        now : int
            Time [ns].

        """
        status = self._status(now)
        if self.safety.stop is not None:
            return Severity.ERROR, f'{self.safety.stop}; ~/clear_stop releases', status
        held = (self.fault or status.warning) if self._active is not None else ''
        return Severity.WARNING if held else Severity.INFO, held or None, status
