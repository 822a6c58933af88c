"""Node `controller`: turns encoder readings and a target into forces on the needle."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields
from math import isfinite
import sys
from time import monotonic
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PointStamped
from needle_controller.controller import (
    Command,
    Controller,
    ControllerSettings,
    DEFAULT_GAINS,
    Gains,
    LAWS,
    Measurement,
)
from needle_controller.observer.observer import Observer, ObserverSettings
from needle_controller.reference.guide import REFERENCES
from needle_controller.reference.setpoint import ReferenceLimits
from needle_controller.safety import (
    BY_HAND,
    DROPPED,
    read_encoders,
    REPEATED,
    Safety,
    SafetyLimits,
    SENSORS,
)
from needle_dynamics import (
    NeedleModel,
    NeedleParameters,
)
from needle_dynamics.compiled.cache import announce_compilation
from needle_dynamics.model_node import ModelNode
from needle_ros import contract
from needle_ros.errors import (
    NeedleError,
    ParameterError,
)
from needle_ros.run_node import run
from needle_ros.timing import NANOSECONDS, nanoseconds, seconds
from needle_ros.trajectories import joint_values
from needle_ros.wire import Reading
import numpy as np
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.subscription import Subscription
from std_msgs.msg import Header
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory

_WAITING = 'no joint_states yet'

#: Where to retract to by default [m], or as near to it as the range of depths has.
_RETRACT = 0.01

#: Sources of what is known of the bending.
FEEDBACKS = ('observer', 'ground_truth', 'none')


class ControllerNode(ModelNode):
    """
    Answers each ``joint_states`` with a ``wrench_command`` (force.y [N], torque.x [N m]).

    ``target`` (point.y [m]) is the inserted length to reach, ``joint_trajectory`` (joint
    `insertion`: positions, and speeds or none) a path to follow. Before the first of them, while
    measurements are stale, jump or are not finite, while another node commands too, and after
    ``~/emergency_stop`` or beyond a limit, until ``~/clear_stop``, the command is zero. It carries
    the stamp of the measurement that it answers; one that answers none is of now.
    ``~/pause`` brakes the reference and holds it, ``~/retract`` goes to ``retract_depth``.
    ``reference`` and ``tracking_error`` show what it aims at and how far off it is.

    What the bending adds to the insertion force comes from an observer that takes in
    ``tip_deflection`` and ``base_wrench``, as far as these come. Both are held against the limits
    in any case.
    """

    LIVE = frozenset(
        {
            'law',
            'model.coulomb_friction',
            'model.viscous_friction',
            'retract_depth',
            *(
                f'{law}.{axis}.{item.name}'
                for law, axes in DEFAULT_GAINS.items()
                for axis, gains in axes.items()
                for item in fields(gains)
            ),
        }
    )

    def __init__(self, **node_options: Any) -> None:
        super().__init__('controller', **node_options)
        self.declare_text('law', LAWS[0], f'one of {", ".join(LAWS)}')
        self.declare_text('reference.kind', 'trapezoid', f'one of {", ".join(REFERENCES)}')
        self.declare_text(
            'deflection_feedback',
            FEEDBACKS[0],
            f'one of {", ".join(FEEDBACKS)} (ground_truth: simulation only)',
        )
        self.declare_parameter(
            'retract_depth',
            _RETRACT,
            ParameterDescriptor(
                description='inserted length to retract to [m]', dynamic_typing=True
            ),
        )
        self.declare_settings('', ControllerSettings())
        self.declare_settings('reference.', ReferenceLimits())
        self.declare_settings('safety.', SafetyLimits())
        self.declare_settings('observer.', ObserverSettings())
        for law, axes in DEFAULT_GAINS.items():
            for axis, gains in axes.items():
                self.declare_settings(f'{law}.{axis}.', gains)
        self.declare_model()

        self._controller: Controller | None = None
        self._observer: Observer | None = None
        self._settings = ControllerSettings()
        self._safety = Safety(SafetyLimits(), self._settings, NeedleParameters())
        self._load = 0.0
        self._truths: Subscription | None = None
        #: Stamp, lateral force and moment of the last wrench that no measurement has taken.
        self._wrench_now: tuple[int, float, float] | None = None
        self._fault: str | None = None
        #: Measurements answered, those too late for the delay, and the age of the oldest [s].
        self._answered = self._late = 0
        self._oldest = 0.0
        self._refused = 0
        self._refusal: str | None = None

        self._wrench_command = self.publisher(contract.WRENCH_COMMAND)
        self._reference = self.publisher(contract.REFERENCE)
        self._tracking_error = self.publisher(contract.TRACKING_ERROR)
        self.listen(contract.JOINT_STATES, self._on_joint_states)
        self.subscribe(contract.TARGET, self._on_target)
        self.subscribe(contract.JOINT_TRAJECTORY, self._on_trajectory)
        self.listen(contract.BASE_WRENCH, self._on_wrench)
        self.listen(contract.TIP_DEFLECTION, self._on_tip)
        self.create_service(Trigger, '~/emergency_stop', self._on_emergency_stop)
        self.create_service(Trigger, '~/clear_stop', self._on_clear_stop)
        self.create_service(SetBool, '~/pause', self._on_pause)
        self.create_service(Trigger, '~/retract', self._on_retract)
        #: One that stands still or jumps does not take the watchdog along.
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)

        self._wrench = contract.WRENCH_COMMAND.template()
        self._aim = contract.REFERENCE.template()
        #: What was commanded last: stamp, torque and message.
        self._last: tuple[int, float, bytes] = (0, 0.0, b'')

    # Transitions.

    def configure(self) -> None:
        """Make the controller from the parameters; reject unstable gains."""
        feedback = self.text('deflection_feedback', FEEDBACKS)
        parameters = self.model_parameters()
        self._settings = self.settings('', ControllerSettings)
        self._controller = Controller(
            parameters,
            self.text('law', LAWS),
            gains=self._gains(),
            settings=self._settings,
            reference=self.text('reference.kind', tuple(REFERENCES)),
            limits=self.settings('reference.', ReferenceLimits),
        )
        self._retract_depth({})
        self._model = NeedleModel(parameters)
        noise: dict[str, tuple[float, ...]] = {}
        if feedback == 'ground_truth':
            self._truths = self.listen(contract.GROUND_TRUTH, self._on_ground_truth)
        elif feedback == 'observer':
            observed = self.settings('observer.', ObserverSettings)
            try:
                self._observer = Observer(parameters, observed, 1.0 / self._settings.rate)
            except ParameterError as error:
                raise ParameterError(f'observer.{error}') from error
            noise['base_wrench'] = observed.force_noise, observed.torque_noise
            noise['tip_deflection'] = (observed.tip_noise,)
        stop = self._safety.stop
        self._safety = Safety(
            self.settings('safety.', SafetyLimits),
            self._settings,
            parameters,
            expected=SENSORS if feedback == 'observer' else (),
            noise=noise,
        )
        self._safety.stop = stop

    def _gains(self, changes: Mapping[str, Any] | None = None) -> dict[str, dict[str, Gains]]:
        gains: dict[str, dict[str, Gains]] = {}
        for law, axes in DEFAULT_GAINS.items():
            kind: Any = type(axes['insertion'])
            gains[law] = {axis: self.settings(f'{law}.{axis}.', kind, changes) for axis in axes}
        return gains

    def _retract_depth(self, changes: Mapping[str, Any]) -> float:
        """Return the depth to retract to, or refuse it."""
        value = changes.get('retract_depth', self.get_parameter('retract_depth').value)
        low, high = self._settings.depths(self.model_parameters())
        number = isinstance(value, (int, float)) and not isinstance(value, bool)
        # No farther than the range allows by default, whatever the needle.
        if (changes or value != _RETRACT) and (not number or not low <= value <= high):
            raise ParameterError(f'retract_depth must be in [{low:g}, {high:g}] m, got {value!r}')
        return float(min(max(value, low), high))

    def change(self, changes: Mapping[str, Any]) -> None:
        """Go on with other gains, friction or law; reject what is unstable."""
        if self._controller is None:
            return
        try:
            parameters = self.model_parameters(changes)
            self._retract_depth({k: v for k, v in changes.items() if k == 'retract_depth'})
            self._controller.change(
                parameters,
                law=self.text('law', LAWS, changes),
                gains=self._gains(changes),
            )
        except ParameterError as error:
            self._refuse(f'parameters: {error}')
            raise
        self._model = NeedleModel(parameters)

    def cleanup(self) -> None:
        """Forget the controller, the bending and who tells of it."""
        self._controller = self._observer = None
        self._load = 0.0
        if self._truths is not None:
            self.destroy_subscription(self._truths)
            self._truths = None

    def activate(self) -> None:
        """Begin to answer measurements and to watch for their absence."""
        self._fault = _WAITING
        self._answered = self._late = 0
        self._oldest = 0.0
        self._begin()
        self._count_commanders()
        self._watchdog = self.create_timer(
            min(0.1, 0.5 * self._settings.measurement_timeout),
            self._on_watchdog,
            clock=self._steady,
        )

    def _begin(self) -> None:
        """Know nothing of what was measured."""
        self._safety.begin(self.now())
        self._load = 0.0
        self._wrench_now = None
        if self._observer is not None:
            self._observer.reset()

    def _checked_now(self) -> int:
        """Return the time [ns]; let go and know nothing if it was set back."""
        now = self.now()
        back = self._safety.clock_went_back(now)
        if back:
            self._begin()
            self._let_go(f'clock went back by {back:.3f} s')
        return now

    def deactivate(self) -> None:
        """Let go: zero force, and no memory of the motion nor of its target."""
        if self._controller is not None:
            self._controller.forget()
        self._publish(0.0, 0.0)
        self.destroy_timer(self._watchdog)

    # What comes in.

    def _refuse(self, complaint: str) -> None:
        """Say in one line, and on /diagnostics, what was not taken."""
        self._refused += 1
        self._refusal = complaint
        self.get_logger().error(complaint)
        self.publish_diagnostics()

    def _takes(self, name: str, header: Header) -> bool:
        """Return whether a wish of the user counts; say why if it does not."""
        if self._controller is None or not self.is_active:
            self._refuse(f'{name} refused: the controller is not active')
            return False
        refusal = self._safety.streams[name].check(
            nanoseconds(header.stamp), self._checked_now(), header.frame_id
        )
        if refusal is not None and refusal.kind not in (REPEATED, DROPPED):
            self._refuse(f'{name} refused: {refusal.line}')
        return refusal is None

    def _counts(self, name: str, reading: Reading, values: Sequence[float]) -> bool:
        """Return whether a reading of a sensor counts; say once a second why if it does not."""
        refusal = self._safety.streams[name].check(
            reading.stamp, self._checked_now(), reading.frame, values
        )
        if refusal is not None and refusal.kind not in (REPEATED, DROPPED):
            self._warn(f'{name} {refusal.kind}', f'{refusal.line}; not taken in')
        return refusal is None

    def _warn(self, kind: str, line: str) -> None:
        """Say something of a kind at most once a second."""
        if self._safety.due(kind, monotonic()):
            self.get_logger().warning(line)
            self.publish_diagnostics()

    def _on_target(self, message: PointStamped) -> None:
        if self._controller is None or not self._takes('target', message.header):
            return
        try:
            self._controller.set_target(message.point.y)
        except ParameterError as error:
            self._refuse(f'target refused: {error}')
            return
        if message.point.z != 0.0:
            self.get_logger().warning(
                f'wanted deflection {message.point.z:g} m is ignored: force and torque at the '
                'base cannot reach it; the depth is taken',
                once=True,
            )

    def _on_trajectory(self, message: JointTrajectory) -> None:
        if self._controller is None or not self._takes('joint_trajectory', message.header):
            return
        points, names = message.points, message.joint_names
        times = [seconds(point.time_from_start) for point in points]
        try:
            positions, speeds = (
                [value for value in joint_values('insertion', names, values) if value is not None]
                for values in (
                    [point.positions for point in points],
                    [point.velocities for point in points],
                )
            )
            self._controller.follow(times, positions, speeds or None)
        except ParameterError as error:
            self._refuse(f'joint_trajectory refused: {error}')

    def _on_tip(self, reading: Reading) -> None:
        _, _, deflection = reading.values[0]
        if not self.is_active or not self._counts('tip_deflection', reading, [deflection]):
            return
        self._stop_for(self._safety.guard.tip(deflection))
        if self._observer is not None:
            self._observer.add_tip(reading.stamp / NANOSECONDS, deflection)

    def _on_wrench(self, reading: Reading) -> None:
        _, axial, lateral, moment, _, _ = reading.values[0]
        if not self.is_active or not self._counts(
            'base_wrench', reading, [lateral, moment, axial]
        ):
            return
        self._stop_for(self._safety.guard.wrench(axial, lateral, moment))
        if self._observer is None:
            return
        stamp = reading.stamp
        # The sensor also feels the torque that turns the base.
        moment -= self._last[1]
        if stamp > self._safety.streams['joint_states'].last:
            self._wrench_now = stamp, lateral, moment
        else:
            self._observer.add_wrench(stamp / NANOSECONDS, lateral, moment)

    def _on_ground_truth(self, reading: Reading) -> None:
        """Take the load of the bent needle from the simulation."""
        positions, speeds, _ = reading.values
        state = [*positions, *speeds]
        if not self.is_active or not self._counts('ground_truth', reading, state):
            return
        try:
            # What is finite may be too large all the same.
            with np.errstate(over='ignore', invalid='ignore'):
                load = -float(self._model.bias_forces(state)[0])
            if not isfinite(load):
                raise ParameterError('the forces of such a needle are not finite')
        except NeedleError as error:
            self._load = 0.0
            self._warn('ground_truth', f'ground_truth: {error}; not taken in')
            return
        self._load = load

    def _observe(self, stamp: int, measured: Measurement) -> None:
        """Renew what the observer says of the bending."""
        observer, wrench = self._observer, self._wrench_now
        if observer is None:
            return
        own = wrench[1:] if wrench is not None and wrench[0] == stamp else None
        if wrench is not None and wrench[0] <= stamp:
            self._wrench_now = None
        self._load = 0.0
        try:
            observer.update(stamp / NANOSECONDS, measured.depth, measured.speed, own)
            self._load = observer.load
        except NeedleError as error:
            self._warn('observer', f'observer: {error}')

    def _on_joint_states(self, reading: Reading) -> None:
        """Answer a measurement at once, a repeated one as before, one that is late not at all."""
        if not self.is_active or self._controller is None:
            return
        stamp, now = reading.stamp, self._checked_now()
        refusal = self._safety.streams['joint_states'].check(stamp, now)
        if refusal is not None:
            if refusal.kind == REPEATED:
                self._repeat(stamp)
            elif refusal.kind != DROPPED:
                self._let_go(refusal.line)
            return
        age = (now - stamp) / NANOSECONDS
        self._answered += 1
        self._late += age > (self._settings.delay + 1.0) / self._settings.rate
        self._oldest = max(self._oldest, age)
        try:
            positions, speeds, _ = reading.values
            measured = read_encoders(stamp / NANOSECONDS, reading.names, positions, speeds)
        except ParameterError as error:
            self._let_go(str(error), stamp)
            return
        if measured.is_finite():
            self._stop_for(self._safety.guard.encoders(measured.depth, measured.speed), stamp)
            self._observe(stamp, measured)
        self._answer(stamp, measured)

    def _repeat(self, stamp: int) -> None:
        """Command the same again, or nothing if that was not the last word."""
        if self._last[0] == stamp:
            self._wrench_command.publish(self._last[2])
        else:
            self._publish(0.0, 0.0, stamp=stamp)

    def _answer(self, stamp: int, measured: Measurement) -> None:
        """Command what the controller says."""
        safety = self._safety
        if self._controller is None:
            return
        if safety.stop is not None:
            self._publish(0.0, 0.0, stamp=stamp)
            return
        if safety.rivals is not None:
            self._let_go(safety.rivals, stamp)
            return
        command = self._controller.command(measured, self._load)
        if command.fault is not None:
            self._let_go(command.fault, stamp)
            return
        if not command.is_finite():
            # Whatever the laws remember, it is not good any more.
            self._controller.forget()
            self._stop_for('the command is not finite', stamp)
            return
        if command.notice is not None:
            self.get_logger().error(command.notice)
            self._refusal = command.notice
        if self._stop_for(
            safety.guard.tracking(command.setpoint.position - measured.depth), stamp
        ):
            return
        if self._fault is not None:
            self._fault = None
            if safety.due('recovery', monotonic()):
                self.publish_diagnostics()
        limits = self._settings
        safety.saturation.add(
            stamp,
            abs(command.force) >= limits.force_limit or abs(command.torque) >= limits.torque_limit,
        )
        self._publish(command.force, command.torque, stamp)
        self._show(stamp, measured, command)

    def _count_commanders(self) -> None:
        """See who else commands; those that are not active count too."""
        topic = self._wrench_command.topic_name
        self._safety.count_commanders({topic: self.count_publishers(topic)})

    def _on_watchdog(self) -> None:
        """Look for what does not come, and for who should not be there."""
        now, safety = self._checked_now(), self._safety
        self._count_commanders()
        silence = safety.streams['joint_states'].silence(now)
        if silence > self._settings.measurement_timeout:
            self._let_go(f'joint_states is stale: the last came {silence:.3f} s ago')
        elif safety.rivals is not None:
            self._let_go(safety.rivals)
        if safety.streams['ground_truth'].silence(now) > self._settings.measurement_timeout:
            self._load = 0.0
        for line in safety.news(now):
            self._warn(line.partition(' ')[0], f'{line}; the observer goes on without it')
        if safety.limits.sensors_required:
            self._stop_for(safety.warning(now))

    def _stop_for(self, reason: str | None, stamp: int | None = None) -> bool:
        """Stop until it is cleared, if there is a reason; return whether nothing is commanded."""
        if self._safety.latch(reason):
            self._fault = reason
            self._release(stamp)
            self.get_logger().error(f'stopped: {reason}; no force until ~/clear_stop')
            self.publish_diagnostics()
        return reason is not None

    def _on_emergency_stop(
        self, _request: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        self._stop_for(BY_HAND)
        response.success, response.message = True, 'stopped; ~/clear_stop releases'
        return response

    def _on_clear_stop(
        self, _request: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        if self._safety.stop is None:
            response.success, response.message = True, 'there was no stop'
            return response
        reason = self._safety.clear(self._checked_now())
        if reason is not None:
            response.message = f'clear_stop refused: {reason}'
            self._refuse(response.message)
            return response
        self._fault = _WAITING
        response.success, response.message = True, 'cleared; the motion starts anew'
        self.get_logger().info('the stop is cleared')
        self.publish_diagnostics()
        return response

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        if self._controller is None or not self.is_active:
            response.message = 'pause refused: the controller is not active'
            return response
        if request.data:
            self._controller.guide.pause()
        else:
            self._controller.guide.resume()
        response.success, response.message = True, 'paused' if request.data else 'resumed'
        self.publish_diagnostics()
        return response

    def _on_retract(
        self, _request: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        if self._controller is None or not self.is_active or self._safety.stop:
            why = 'stopped; ~/clear_stop releases' if self._safety.stop else 'not active'
            response.message = f'retract refused: the controller is {why}'
            return response
        depth = self._retract_depth({})
        self._controller.guide.resume()
        self._controller.set_target(depth)
        response.success, response.message = True, f'goes to {depth:g} m'
        return response

    # What goes out.

    def _let_go(self, fault: str, stamp: int | None = None) -> None:
        """Command zero force for a reason, said when it begins; ``stamp`` of what it answers."""
        # Those of one kind begin alike, whatever their numbers.
        kind = fault.partition(' ')[0]
        begins = self._fault is None or not self._fault.startswith(kind)
        self._fault = fault
        self._release(stamp)
        if begins and self._safety.due(kind, monotonic()):
            self.get_logger().error(f'{fault}; no force is commanded')
            self.publish_diagnostics()

    def _release(self, stamp: int | None = None) -> None:
        if self._controller is not None:
            self._controller.release()
        self._publish(0.0, 0.0, stamp=stamp)

    def _publish(self, force: float, torque: float, stamp: int | None = None) -> None:
        """Command forces with the stamp of the measurement that they answer, or of now."""
        at = self.now() if stamp is None else stamp
        message = self._wrench.serialize(at, 0.0, force, 0.0, torque, 0.0, 0.0)
        self._last = at, torque, message
        self._wrench_command.publish(message)

    def _show(self, stamp: int, measured: Measurement, command: Command) -> None:
        aim = command.setpoint
        self._reference.publish(self._aim.serialize(stamp, aim.position, aim.speed))
        self._tracking_error.publish(
            self._aim.serialize(stamp, aim.position - measured.depth, aim.speed - measured.speed)
        )

    def diagnose(self) -> tuple[bytes, str, dict[str, object]]:
        """Say what it aims at and what holds it back."""
        values: dict[str, object] = {}
        if self._controller is not None:
            control = self._controller
            values['target [m]'] = control.target
            values['law'] = control.law
            values['paused'] = control.guide.paused
            name, limit = max(
                control.limits.items(), key=lambda item: item[1].radius - item[1].bound
            )
            values['least stable axis'] = name
            values['spectral radius'] = f'{limit.radius:.9g} (at most {limit.bound:.9g})'
        if self._observer is not None and self._observer.ready:
            observer = self._observer
            consistency, (tip, spread) = observer.nis, observer.tip_deflection
            values['tip deflection [m]'] = f'{tip:.6f} +- {spread:.6f}'
            values['load of the bent needle [N]'] = f'{observer.load:.4f}'
            values['observer consistency (NIS)'] = (
                f'{consistency.ratio:.3f} in [{consistency.low:.3f}, {consistency.high:.3f}]'
            )
            values['observer samples refused'] = observer.refused
            values['observer restarts'] = observer.restarts
            values['observer warning'] = observer.warning or ''
        values['measurements answered'] = self._answered
        values['answered too late for the delay'] = self._late
        values['oldest measurement answered [s]'] = f'{self._oldest:.4f}'
        values['inputs refused'] = self._refused
        values['last complaint'] = self._refusal or ''
        now = self.now()
        values.update(self._safety.describe(now))
        if self._safety.stop is not None:
            return DiagnosticStatus.ERROR, f'{self._safety.stop}; ~/clear_stop releases', values
        if self.is_active and self._fault is not None:
            return DiagnosticStatus.WARN, self._fault, values
        warning = self._safety.warning(now) if self.is_active else None
        if warning is not None:
            return DiagnosticStatus.WARN, warning, values
        level, text, _ = super().diagnose()
        return level, text, values


def main() -> int:
    """Run the node; return its exit status."""
    announce_compilation()
    return run(ControllerNode)


if __name__ == '__main__':
    sys.exit(main())
