"""The life of a control loop, without ROS: what counts, what stops, and what to command."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from time import monotonic
from typing import Final

from needle_controller.answer import Answer, Reply
from needle_controller.bending import Bending
from needle_controller.controller import Controller, ControllerSettings, Gains, Measurement
from needle_controller.hardware import Robot, STAMPS
from needle_controller.observer.observer import Observer
from needle_controller.observer.settings import ObserverSettings
from needle_controller.safety.encoders import read_encoders
from needle_controller.safety.following import Following
from needle_controller.safety.lateness import Lateness
from needle_controller.safety.limits import SafetyLimits
from needle_controller.safety.pace import Pace
from needle_controller.safety.safety import Safety
from needle_controller.safety.stream import REPEATED
from needle_dynamics import euler_loads, NeedleModel, NeedleParameters
from needle_ros.contract import BASE
from needle_ros.errors import NeedleError, ParameterError
from needle_ros.journal import Journal, Severity
from needle_ros.timing import NANOSECONDS
from needle_ros.trajectories import joint_values, MOST_POINTS
from needle_ros.wire import Reading

_WAITING: Final = 'no joint_states yet'

#: Topics that the observer lives on.
_SENSORS: Final = ('base_wrench', 'tip_deflection')


class Supervisor:
    """
    Answers measurements by forces as long as all is well.

    Every event is a method: it takes the time now [ns] of the clock that stamps the messages, and
    returns what to command because of it. None leaves the last command as it is. `journal` has
    what there is to say. Without a target, during a fault, and from a stop until it is cleared,
    all forces are zero.

    Parameters
    ----------
    steady : callable
        As for `Journal`.

    Attributes
    ----------
    journal : Journal
        What there is to say.
    safety : Safety
        Inputs, limits and the stop.
    controller : Controller or None
        Reference and laws, while configured.
    bending : Bending
        What is known of the bending.
    fault : str or None
        Why no force is commanded, beside a stop.
    retract_depth : float
        Inserted length that `retract` goes to [m].

    """

    def __init__(self, steady: Callable[[], float] = monotonic) -> None:
        self.journal = Journal(steady)
        self.safety = Safety(SafetyLimits(), ControllerSettings(), NeedleParameters())
        self.retract_depth = 0.0
        self.fault: str | None = None
        self._lateness = Lateness()
        self._pace: Pace | None = None
        self._off_pace = False
        self._robot: Robot | None = None
        self._read = read_encoders
        self._deflection_ignored = False
        self._last = Answer(0)
        self._following = Following()
        #: What the user wants, and from which stamp on [ns].
        self._due: tuple[int, str, Callable[[Controller], None]] | None = None
        self.controller: Controller | None = None
        self.cleanup()

    # Its life.

    def configure(
        self,
        controller: Controller,
        limits: SafetyLimits,
        observed: ObserverSettings | None = None,
        robot: Robot | None = None,
    ) -> None:
        """
        Take a controller; a stop that is latched stays.

        Parameters
        ----------
        controller : Controller
            Reference and laws.
        limits : SafetyLimits
            Limits of what is measured.
        observed : ObserverSettings, optional
            Noise and sensors, for the load of the bent needle from an observer.
        robot : Robot, optional
            Reads the joint states of a robot that does not know the contract.

        Raises
        ------
        ParameterError
            If the observer cannot have such settings.

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
        self.bending = Bending(controller.parameters, observer, limits.axial_load)
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
        """Forget controller and bending."""
        self.controller = None
        self.bending = Bending(NeedleParameters())
        #: The controller while measurements are answered.
        self._active: Controller | None = None

    def change(
        self, parameters: NeedleParameters, law: str, gains: Mapping[str, Mapping[str, Gains]]
    ) -> None:
        """
        Go on with other constants, gains or law; see `Controller.change`.

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
        """Whether no measurement has come yet."""
        return self.fault == _WAITING

    def activate(self, now: int, publishers: Mapping[str, int]) -> None:
        """
        Begin to answer measurements; see `watch`.

        Parameters
        ----------
        now, publishers
            As for `watch`.

        """
        self.fault = _WAITING
        if self.controller is not None:
            self._lateness = Lateness(self.controller.delay, self.controller.period)
            settings, robot = self.controller.settings, self._robot
            # Times of arrival say nothing of single periods.
            stamped = robot is None or robot.settings.stamps == STAMPS[0]
            pace = Pace(settings.rate, settings.measurement_timeout)
            self._pace = pace if stamped else None
        self._begin(now)
        self.safety.count_publishers(publishers)
        self._active = self.controller

    def deactivate(self, now: int) -> Answer:
        """
        Let go, without memory of the motion nor of its target.

        Parameters
        ----------
        now : int
            Time [ns].

        Returns
        -------
        Answer
            Zero force.

        """
        if self.controller is not None:
            self.controller.forget()
        self._active = None
        return self._command(Answer(now))

    def _begin(self, now: int) -> None:
        """Know nothing of what was measured."""
        self._due = None
        self.safety.begin(now)
        self.bending.forget()
        if self._robot is not None:
            self._robot.begin()

    def _check_clock(self, now: int) -> Answer | None:
        """Let go and know nothing if the clock was set back."""
        back = self.safety.clock_went_back(now)
        if not back:
            return None
        self._begin(now)
        return self._let_go(f'clock went back by {back:.3f} s', now)

    # Wishes of the user.

    def target(
        self, stamp: int, frame: str, depth: float, deflection: float, now: int
    ) -> Answer | None:
        """
        Take an inserted length to reach [m]; a wanted deflection [m] is ignored.

        Parameters
        ----------
        stamp : int
            Stamp of the message [ns]; 0 if it has none.
        frame : str
            Its frame.
        depth, deflection : float
            Inserted length and deflection that are wanted [m].
        now : int
            Time [ns].

        Returns
        -------
        Answer or None
            What to command, if anything.

        """

        def aim(controller: Controller) -> None:
            controller.set_target(depth)
            if deflection != 0.0 and not self._deflection_ignored:
                self._deflection_ignored = True
                self.journal.say(
                    Severity.WARNING,
                    f'wanted deflection {deflection:g} m is ignored: force and torque at the '
                    'base cannot reach it; the depth is taken',
                )

        return self._wish('target', stamp, frame, now, aim)

    def trajectory(
        self,
        stamp: int,
        frame: str,
        joints: Sequence[str],
        times: Sequence[float],
        positions: Sequence[Sequence[float]],
        velocities: Sequence[Sequence[float]],
        now: int,
    ) -> Answer | None:
        """
        Take a path: times from now [s], positions [m] of the joints, velocities or none.

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
        Answer or None
            What to command, if anything.

        """

        def follow(controller: Controller) -> None:
            if len(times) > MOST_POINTS:
                raise ParameterError(f'a path may have at most {MOST_POINTS} points')
            lengths, rates = (
                [one for one in joint_values('insertion', joints, values) if one is not None]
                for values in (positions, velocities)
            )
            controller.follow(times, lengths, rates or None)

        return self._wish('joint_trajectory', stamp, frame, now, follow)

    def _wish(
        self, name: str, stamp: int, frame: str, now: int, act: Callable[[Controller], None]
    ) -> Answer | None:
        """Do what the user wants if it counts; say why if it does not."""
        if self._active is None:
            self.journal.refuse(f'{name} refused: the controller is not active')
            return None
        answer = self._check_clock(now)
        refusal = self.safety.streams[name].check(stamp, now, frame)
        if refusal is None:
            # It counts from the first sample after its stamp on, also if it overtook a sample.
            self._due = stamp, name, act
            self._do_due(max(self.safety.streams['joint_states'].last, 0) + 1)
        elif not refusal.harmless:
            self.journal.refuse(f'{name} refused: {refusal.line}')
        return answer

    def _do_due(self, stamp: int) -> None:
        """Do what the user wants if it was wanted before a stamp [ns]; say why if it cannot be."""
        if self._due is None or self._due[0] >= stamp:
            return
        (_, name, act), self._due = self._due, None
        try:
            if self._active is not None:
                act(self._active)
        except ParameterError as error:
            self.journal.refuse(f'{name} refused: {error}')

    def emergency_stop(self, now: int) -> Reply:
        """
        Stop until it is cleared.

        Parameters
        ----------
        now : int
            Time [ns].

        Returns
        -------
        Reply
            Success, and zero force.

        """
        answer = self._stop_for('emergency stop', now)
        return Reply(True, 'stopped; ~/clear_stop releases', answer)

    def clear_stop(self, now: int) -> Reply:
        """
        Release the stop, unless something is still beyond a limit.

        Parameters
        ----------
        now : int
            Time [ns].

        Returns
        -------
        Reply
            Whether it is released, or why not.

        """
        if self.safety.stop is None:
            return Reply(True, 'there was no stop')
        answer = self._check_clock(now)
        reason = self.safety.clear(now)
        if reason is not None:
            message = f'clear_stop refused: {reason}'
            self.journal.refuse(message)
            return Reply(False, message, answer)
        self.fault = _WAITING
        self.bending.forget()
        self.journal.say(Severity.INFO, 'the stop is cleared')
        return Reply(True, 'cleared; the motion starts anew', answer)

    def pause(self, hold: bool) -> Reply:
        """
        Brake the reference to rest and hold it, or let it continue.

        Parameters
        ----------
        hold : bool
            Whether to hold.

        Returns
        -------
        Reply
            Refused unless the controller is active.

        """
        if self._active is None:
            return Reply(False, 'pause refused: the controller is not active')
        guide = self._active.guide
        (guide.pause if hold else guide.resume)()
        self.journal.say(Severity.INFO)
        return Reply(True, 'paused' if hold else 'resumed')

    def retract(self) -> Reply:
        """Go to `retract_depth`."""
        if self._active is None or self.safety.stop is not None:
            why = 'stopped; ~/clear_stop releases' if self.safety.stop else 'not active'
            return Reply(False, f'retract refused: the controller is {why}')
        self._due = None
        self._active.guide.resume()
        self._active.set_target(self.retract_depth)
        return Reply(True, f'goes to {self.retract_depth:g} m')

    # Sensors.

    def tip(self, reading: Reading, now: int) -> Answer | None:
        """
        Take in `tip_deflection`.

        Parameters
        ----------
        reading : Reading
            The message.
        now : int
            Time [ns].

        Returns
        -------
        Answer or None
            What to command, if anything.

        """
        if self._active is None:
            return None
        answer, deflection = self._check_clock(now), reading.values[0][2]
        if self._counts('tip_deflection', reading, [deflection], now):
            answer = self._stop_for(self.safety.guard.tip(deflection), now) or answer
            # What is beyond a limit is not believed, be it a single reading.
            if not self.safety.guard.is_beyond('tip_deflection'):
                self.bending.take_tip(reading.stamp, deflection)
        return answer

    def wrench(self, reading: Reading, now: int) -> Answer | None:
        """
        Take in `base_wrench`.

        Parameters
        ----------
        reading, now
            As for `tip`.

        Returns
        -------
        Answer or None
            What to command, if anything.

        """
        if self._active is None:
            return None
        answer, (_, axial, lateral, moment, _, _) = self._check_clock(now), reading.values[0]
        if self._counts('base_wrench', reading, [lateral, moment, axial], now):
            answer = (
                self._stop_for(self.safety.guard.wrench(axial, lateral, moment), now) or answer
            )
            # The sensor also feels the torque that turns the base.
            moment -= self._last.torque
            newest = self.safety.streams['joint_states'].last
            if not self.safety.guard.is_beyond('base_wrench'):
                self.bending.take_wrench(reading.stamp, lateral, moment, newest)
        return answer

    def truth(self, reading: Reading, now: int) -> Answer | None:
        """
        Take the load of the bent needle from `ground_truth` of the simulation.

        Parameters
        ----------
        reading, now
            As for `tip`.

        Returns
        -------
        Answer or None
            What to command, if anything.

        """
        if self._active is None:
            return None
        answer, (positions, velocities, _) = self._check_clock(now), reading.values
        state = [*positions, *velocities]
        if self._counts('ground_truth', reading, state, now):
            try:
                self.bending.take_truth(state)
            except NeedleError as error:
                self._warn('ground_truth', f'ground_truth: {error}; not taken in')
        return answer

    def _counts(self, name: str, reading: Reading, values: Sequence[float], now: int) -> bool:
        """Return whether a reading counts; say once a second why if it does not."""
        refusal = self.safety.streams[name].check(reading.stamp, now, reading.frame, values)
        if refusal is not None and not refusal.harmless:
            self._warn(f'{name} {refusal.kind}', f'{refusal.line}; not taken in')
        return refusal is None

    def _warn(self, kind: str, line: str) -> None:
        self.journal.say(Severity.WARNING, line, kind)

    def encoders(self, reading: Reading, now: int) -> Answer | None:
        """
        Answer `joint_states`: a repeated one as before, one that is late not at all.

        Parameters
        ----------
        reading, now
            As for `tip`.

        Returns
        -------
        Answer or None
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
            return answer if refusal.harmless else self._let_go(refusal.line, now)
        self._lateness.add(now, (now - stamp) / NANOSECONDS)
        self._do_due(stamp)
        try:
            measured = self._read(reading)
        except ParameterError as error:
            return self._let_go(str(error), stamp)
        if measured.is_finite():
            self._stop_for(self.safety.guard.encoders(measured), stamp)
            if self.safety.guard.is_beyond('joint_states'):
                # Alone it is a fault of the sensor: neither law nor observer gets it.
                if self.safety.stop is not None:
                    return self._command(Answer(stamp))
                return self._let_go('joint_states is beyond a limit', stamp)
            try:
                self.bending.update(stamp, measured)
            except NeedleError as error:
                self._warn('observer', f'observer: {error}')
            if self.bending.warning is not None:
                self._warn('doubt', self.bending.warning)
        return self._answer(controller, stamp, measured)

    def _again(self, stamp: int) -> Answer:
        """Command the same again, or nothing if that was not the last word."""
        last = self._last
        if last.stamp == stamp:
            return Answer(stamp, last.force, last.torque)
        return self._command(Answer(stamp))

    def _answer(self, controller: Controller, stamp: int, measured: Measurement) -> Answer | None:
        """Command what the controller says."""
        safety = self.safety
        if safety.stop is not None:
            return self._command(Answer(stamp))
        if safety.rivals is not None:
            return self._let_go(safety.rivals, stamp)
        command = controller.command(measured, self.bending.load)
        if command.fault is not None:
            return self._let_go(command.fault, stamp)
        if not command.is_finite():
            # Whatever the laws remember, it is not good any more.
            controller.forget()
            return self._stop_for('the command is not finite', stamp)
        if command.notice is not None:
            self.journal.complaint = command.notice
            self.journal.say(Severity.ERROR, command.notice)
        aim = command.setpoint
        error = aim.position - measured.depth, aim.speed - measured.speed
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
            self._say_fault(
                'the plant does not follow: it reports '
                f'{measured.force:.3g} N, {self._last.force:.3g} N is commanded',
                'the reference waits',
            )
        elif self.fault is not None:
            self.fault = None
            self.journal.say(Severity.INFO, kind='recovery')
        force, torque, limits = command.force, command.torque, controller.settings
        most = euler_loads(controller.parameters, max(measured.depth, 0.0)).pinned
        if force > most:
            self._warn(
                'buckling',
                f"{force:.3g} N is more than Euler's load {most:.3g} N of the part outside of the "
                'tissue: without a guide it buckles; lower force_limit',
            )
        full = abs(force) >= limits.force_limit or abs(torque) >= limits.torque_limit
        safety.saturation.add(stamp, full)
        return self._command(Answer(stamp, force, torque, aim[:2], error))

    def watch(self, now: int, publishers: Mapping[str, int]) -> Answer | None:
        """
        Look for what does not come, and for who else publishes what may have one source only.

        Parameters
        ----------
        now : int
            Time [ns].
        publishers : Mapping[str, int]
            How many nodes publish them, this one included, by topic.

        Returns
        -------
        Answer or None
            What to command, if anything.

        """
        answer, safety = self._check_clock(now), self.safety
        safety.count_publishers(publishers)
        timeout = safety.streams['joint_states'].timeout / NANOSECONDS
        silence = safety.streams['joint_states'].silence(now)
        if safety.rivals is not None:
            answer = self._let_go(safety.rivals, now)
        elif silence > timeout:
            answer = self._let_go(f'joint_states is stale: the last came {silence:.3f} s ago', now)
        answer = self._stop_for(safety.muddled(now), now) or answer
        if safety.streams['ground_truth'].silence(now) > timeout:
            self.bending.load = 0.0
        for line in safety.news(now):
            self._warn(line.partition(' ')[0], f'{line}; the observer goes on without it')
        if safety.limits.sensors_required:
            answer = self._stop_for(safety.warning(now), now) or answer
        self._watch_pace()
        return answer

    def _watch_pace(self) -> None:
        """Say when measurements begin to come at another rate than the laws are made for."""
        if self._pace is None:
            return
        joints = self.safety.streams['joint_states']
        self._pace.add(joints.last, joints.step)
        line = self._pace.warning()
        if line is not None and not self._off_pace:
            self._warn('pace', line)
        self._off_pace = line is not None

    # No force.

    def _stop_for(self, reason: str | None, stamp: int) -> Answer | None:
        """Stop until it is cleared, if there is a reason and no stop yet."""
        if not self.safety.latch(reason):
            return None
        self.fault = reason
        self.bending.forget()
        self.journal.say(Severity.ERROR, f'stopped: {reason}; no force until ~/clear_stop')
        return self._release(stamp)

    def _let_go(self, fault: str, stamp: int) -> Answer:
        """Command zero force for a reason, said when it begins."""
        self._say_fault(fault, 'no force is commanded')
        return self._release(stamp)

    def _say_fault(self, fault: str, consequence: str) -> None:
        """Take note of a fault, said when it begins."""
        # Those of one kind begin alike, whatever their numbers.
        kind = fault.partition(' ')[0]
        if self.fault is None or not self.fault.startswith(kind):
            self.journal.say(Severity.ERROR, f'{fault}; {consequence}', kind)
        self.fault = fault

    def _release(self, stamp: int) -> Answer:
        self._following.forget()
        if self.controller is not None:
            self.controller.guide.wait(False)
            self.controller.release()
        return self._command(Answer(stamp))

    def _command(self, answer: Answer) -> Answer:
        self._last = answer
        return answer

    # What /diagnostics say.

    def diagnose(self, now: int) -> tuple[Severity, str | None, dict[str, object]]:
        """
        Return how bad it is, what holds it back if anything, and values by name.

        Parameters
        ----------
        now : int
            Time [ns].

        Returns
        -------
        severity : Severity
            How bad it is.
        held : str or None
            What holds it back.
        values : dict
            Values by name.

        """
        values: dict[str, object] = {}
        if self.controller is not None:
            control = self.controller
            name, limit = max(
                control.limits.items(), key=lambda item: item[1].radius - item[1].bound
            )
            values = {
                'target [m]': control.target,
                'law': control.law,
                'paused': control.guide.paused,
                'least stable axis': name,
                'spectral radius': f'{limit.radius:.9g} (at most {limit.bound:.9g})',
            }
            for what, (value, error) in control.learned.items():
                values[what] = f'{value:+.4g} +- {1.96 * error:.2g}'
        values |= {
            **self.bending.describe(),
            **self._lateness.describe(),
            'inputs refused': self.journal.refused,
            'last complaint': self.journal.complaint,
            **self.safety.describe(now),
        }
        if self.safety.stop is not None:
            return Severity.ERROR, f'{self.safety.stop}; ~/clear_stop releases', values
        late = self._lateness.warning(now)
        pace = self._pace.warning() if self._pace is not None else None
        held = self.fault or self.safety.warning(now) or self.bending.warning or late or pace
        held = held if self._active is not None else None
        return Severity.WARNING if held else Severity.INFO, held, values
