"""Node `controller`: turns encoder readings and a target into forces on the needle."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace
import sys
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PointStamped, WrenchStamped
from needle_controller.axis import Setpoint
from needle_controller.continuous import ACTUATIONS
from needle_controller.controller import (
    AXES,
    Command,
    Controller,
    ControllerSettings,
    LAWS,
    Measurement,
)
from needle_controller.inverse_dynamics import InverseDynamicsGains
from needle_controller.observer import Observer, ObserverSettings
from needle_controller.pid import PidGains
from needle_controller.reference import ReferenceLimits, REFERENCES
from needle_dynamics import (
    FloatArray,
    ForceSensorParameters,
    NeedleError,
    NeedleModel,
    NeedleParameters,
    ParameterError,
)
from needle_dynamics.base_node import COMMAND, NeedleNode, run, SENSOR
from needle_dynamics.plant import joint_values
import numpy as np
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.subscription import Subscription
from sensor_msgs.msg import JointState
from std_msgs.msg import Header
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory

_NANOSECONDS = 1_000_000_000

_WAITING = 'no joint_states yet'

#: Where to retract to by default [m], or as near to it as the range of depths has.
_RETRACT = 0.01

#: Gains by law and axis. Rotation by PID: a closed loop of 20 rad/s on the rotary inertia of the
#: source's needle. Deflection by PID: at 1 kHz it is stable from 12 cm on.
_GAINS: dict[str, dict[str, InverseDynamicsGains | PidGains]] = {
    'inverse_dynamics': {axis: InverseDynamicsGains() for axis in AXES},
    'pid': {
        'insertion': PidGains(),
        'rotation': PidGains(kp=2.1e-7, ki=0.0, kd=2.1e-8),
        'deflection': PidGains(kp=5.0, ki=20.0, kd=0.02),
    },
}

#: Sources of what is known of the bending.
FEEDBACKS = ('observer', 'ground_truth', 'none')


def _observer_defaults() -> ObserverSettings:
    """Return the settings that fit the force sensor of the plant as it is by default."""
    sensor = ForceSensorParameters()
    settings = ObserverSettings(cutoffs=sensor.cutoffs, filter_rate=sensor.rate)
    force, torque = sensor.per_axis('noise')[2:4]
    return replace(
        settings,
        force_noise=round(float(force) * settings.noise_gain, 6),
        torque_noise=round(float(torque) * settings.noise_gain, 8),
    )


def _stamp(header: Header) -> int:
    return int(header.stamp.sec) * _NANOSECONDS + int(header.stamp.nanosec)


class ControllerNode(NeedleNode):
    """
    Answers each ``joint_states`` with a ``wrench_command`` (force.y [N], torque.x [N m]).

    With ``actuation: modal``, which only a simulated needle has, the answer is a
    ``generalized_command`` (efforts of d, theta and q1..qn) instead.

    ``target`` (point.y [m]) is the inserted length to reach, ``joint_trajectory`` (joint
    `insertion`: positions, and speeds or none) a path to follow. Before the first of them, while
    measurements are stale, jump or are not finite, and after ``~/emergency_stop`` the command is
    zero. ``~/pause`` brakes the reference and holds it, ``~/retract`` goes to ``retract_depth``.
    ``reference`` and ``tracking_error`` show what it aims at and how far off it is.

    What the bending adds to the insertion force comes from an observer that takes in
    ``tip_deflection`` and ``base_wrench``, as far as these come.
    """

    LIVE = frozenset(
        {
            'law',
            'model.coulomb_friction',
            'model.viscous_friction',
            'retract_depth',
            *(
                f'{law}.{axis}.{item.name}'
                for law, axes in _GAINS.items()
                for axis, gains in axes.items()
                for item in fields(gains)
            ),
        }
    )

    def __init__(self, **node_options: Any) -> None:
        super().__init__('controller', **node_options)
        self.declare_text('law', LAWS[0], f'one of {", ".join(LAWS)}')
        self.declare_text(
            'actuation',
            ACTUATIONS[0],
            'physical: force and torque at the base; modal: a force on every coordinate',
        )
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
        self.declare_settings('observer.', _observer_defaults())
        for law, axes in _GAINS.items():
            for axis, gains in axes.items():
                self.declare_settings(f'{law}.{axis}.', gains)
        self.declare_model()

        self._controller: Controller | None = None
        self._observer: Observer | None = None
        self._settings = ControllerSettings()
        self._load = 0.0
        #: Deflections and rates that the ground truth last had, and its stamp.
        self._truth: tuple[int, tuple[FloatArray, FloatArray]] | None = None
        #: Measurement that waits for the ground truth of its time.
        self._pending: tuple[int, Measurement, JointState] | None = None
        #: Stamp, lateral force and moment of the last wrench that no measurement has taken.
        self._wrench_now: tuple[int, float, float] | None = None
        self._is_modal = False
        self._fault: str | None = None
        self._stopped = False
        self._last_stamp = 0
        self._arrived = 0
        #: Measurements answered, those too late for the delay, and the age of the oldest [s].
        self._answered = self._late = 0
        self._oldest = 0.0
        self._refused = 0
        self._refusal: str | None = None

        publisher = self.create_lifecycle_publisher
        self._wrench_command = publisher(WrenchStamped, 'wrench_command', COMMAND)
        self._generalized_command = publisher(JointState, 'generalized_command', COMMAND)
        self._reference = publisher(JointState, 'reference', SENSOR)
        self._tracking_error = publisher(JointState, 'tracking_error', SENSOR)
        self.create_subscription(JointState, 'joint_states', self._on_joint_states, SENSOR)
        self.create_subscription(PointStamped, 'target', self._on_target, COMMAND)
        self.create_subscription(JointTrajectory, 'joint_trajectory', self._on_trajectory, COMMAND)
        self.create_service(Trigger, '~/emergency_stop', self._on_emergency_stop)
        self.create_service(Trigger, '~/clear_stop', self._on_clear_stop)
        self.create_service(SetBool, '~/pause', self._on_pause)
        self.create_service(Trigger, '~/retract', self._on_retract)
        #: Subscriptions to what the bending is known from.
        self._senses: list[Subscription] = []

        self._wrench = WrenchStamped()
        self._wrench.header.frame_id = 'needle_base'
        self._generalized = JointState()
        self._aim = JointState(name=['insertion'])
        self._error = JointState(name=['insertion'])

    # Transitions.

    def configure(self) -> None:
        """Make the controller from the parameters; refuse gains that cannot be stable."""
        actuation = self.text('actuation', ACTUATIONS)
        feedback = self.text('deflection_feedback', FEEDBACKS)
        if actuation == 'modal' and feedback != 'ground_truth':
            raise ParameterError(
                'deflection_feedback must be ground_truth with actuation modal, which only a '
                f'simulated needle has, got {feedback!r}'
            )
        parameters = self.model_parameters()
        self._settings = self.settings('', ControllerSettings)
        self._controller = Controller(
            self.text('law', LAWS),
            parameters,
            self._settings,
            inverse_dynamics=self._gains('inverse_dynamics', InverseDynamicsGains),
            pid=self._gains('pid', PidGains),
            reference=self.text('reference.kind', tuple(REFERENCES)),
            limits=self.settings('reference.', ReferenceLimits),
            actuation=actuation,
        )
        self._is_modal = actuation == 'modal'
        self._retract_depth({})
        self._take_model(parameters)
        senses: list[tuple[type, str, Any]] = []
        if feedback == 'ground_truth':
            senses = [(JointState, 'ground_truth', self._on_ground_truth)]
        elif feedback == 'observer':
            observed = self.settings('observer.', ObserverSettings)
            try:
                self._observer = Observer(parameters, observed, 1.0 / self._settings.rate)
            except ParameterError as error:
                raise ParameterError(f'observer.{error}') from error
            senses = [
                (PointStamped, 'tip_deflection', self._on_tip),
                (WrenchStamped, 'base_wrench', self._on_wrench),
            ]
        self._senses = [self.create_subscription(*sense, SENSOR) for sense in senses]

    def _gains(
        self, law: str, kind: type[Any], changes: Mapping[str, Any] | None = None
    ) -> tuple[Any, ...]:
        return tuple(self.settings(f'{law}.{axis}.', kind, changes) for axis in AXES)

    def _take_model(self, parameters: NeedleParameters) -> None:
        self._model = NeedleModel(parameters)
        self._generalized.name = list(self._model.coordinate_names)

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
        """Go on with other gains, friction or law; refuse what cannot be stable."""
        if self._controller is None:
            return
        try:
            parameters = self.model_parameters(changes)
            self._retract_depth({k: v for k, v in changes.items() if k == 'retract_depth'})
            self._controller.change(
                parameters,
                law=self.text('law', LAWS, changes),
                inverse_dynamics=self._gains('inverse_dynamics', InverseDynamicsGains, changes),
                pid=self._gains('pid', PidGains, changes),
            )
        except ParameterError as error:
            self._refuse(f'parameters: {error}')
            raise
        self._take_model(parameters)

    def cleanup(self) -> None:
        """Forget the bending and who tells of it."""
        self._load, self._truth, self._observer = 0.0, None, None
        for sense in self._senses:
            self.destroy_subscription(sense)
        self._senses = []

    def activate(self) -> None:
        """Begin to answer measurements and to watch for their absence."""
        self._fault = _WAITING
        self._arrived = self._last_stamp = 0
        self._answered = self._late = 0
        self._oldest = 0.0
        self._pending = self._wrench_now = None
        if self._observer is not None:
            self._observer.reset()
        self._watchdog = self.create_timer(
            0.5 * self._settings.measurement_timeout, self._on_watchdog
        )

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

    def _on_target(self, message: PointStamped) -> None:
        if self._controller is None:
            return
        try:
            self._controller.set_target(message.point.y, message.point.z)
        except ParameterError as error:
            self._refuse(f'target refused: {error}')
            return
        if message.point.z != 0.0 and not self._is_modal:
            self.get_logger().warning(
                f'wanted deflection {message.point.z:g} m cannot be reached by force and torque '
                'at the base (physical actuation); the depth is',
                once=True,
            )

    def _on_trajectory(self, message: JointTrajectory) -> None:
        if self._controller is None:
            return
        points, names = message.points, message.joint_names
        times = [
            point.time_from_start.sec + point.time_from_start.nanosec / _NANOSECONDS
            for point in points
        ]
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

    def _on_tip(self, message: PointStamped) -> None:
        if self._observer is not None and self.is_active:
            self._observer.add_tip(_stamp(message.header) / _NANOSECONDS, message.point.z)

    def _on_wrench(self, message: WrenchStamped) -> None:
        if self._observer is None or not self.is_active:
            return
        stamp, wrench = _stamp(message.header), message.wrench
        # The sensor also feels the torque that turns the base.
        moment = wrench.torque.x - self._wrench.wrench.torque.x
        if stamp > self._last_stamp:
            self._wrench_now = stamp, wrench.force.z, moment
        else:
            self._observer.add_wrench(stamp / _NANOSECONDS, wrench.force.z, moment)

    def _on_ground_truth(self, message: JointState) -> None:
        """Take the load of the bent needle, or all of its bending, from the simulation."""
        try:
            bias = self._model.bias_forces([*message.position, *message.velocity])
        except NeedleError as error:
            self._load, self._truth = 0.0, None
            self.get_logger().warning(f'ground_truth: {error}', throttle_duration_sec=1.0)
            return
        self._load = -float(bias[0])
        if not self._is_modal:
            return
        stamp = _stamp(message.header)
        bend = np.array(message.position[2:]), np.array(message.velocity[2:])
        self._truth = stamp, bend
        pending, self._pending = self._pending, None
        if pending is not None and pending[0] == stamp:
            self._answer(pending[1], pending[2], bend)

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
            observer.update(stamp / _NANOSECONDS, measured.depth, measured.speed, own)
            self._load = observer.load
        except NeedleError as error:
            self.get_logger().warning(f'observer: {error}', throttle_duration_sec=1.0)

    def _on_joint_states(self, message: JointState) -> None:
        """Answer a measurement at once; older ones than the last are not answered."""
        stamp = _stamp(message.header)
        if not self.is_active or self._controller is None:
            return
        age = (self.get_clock().now().nanoseconds - stamp) / _NANOSECONDS
        if abs(age) > self._settings.measurement_timeout:
            self._let_go(f'joint_states is stale: its stamp is {age:.3f} s old')
            return
        if stamp <= self._last_stamp:
            return
        self._last_stamp = stamp
        self._answered += 1
        self._late += age > (self._settings.delay + 1.0) / self._settings.rate
        self._oldest = max(self._oldest, age)
        self._arrived = self.get_clock().now().nanoseconds
        try:
            i = message.name.index('insertion')
            depth, speed = message.position[i], message.velocity[i]
            angle = angular_speed = 0.0
            if 'rotation' in message.name:
                j = message.name.index('rotation')
                angle, angular_speed = message.position[j], message.velocity[j]
        except (ValueError, IndexError):
            self._let_go(
                "joint_states needs position and velocity of 'insertion', got names "
                f'{list(message.name)}, {len(message.position)} positions, '
                f'{len(message.velocity)} velocities'
            )
            return
        measured = Measurement(
            time=stamp / _NANOSECONDS,
            depth=depth,
            speed=speed,
            angle=angle,
            angular_speed=angular_speed,
        )
        if measured.is_finite():
            self._observe(stamp, measured)
        if self._stopped:
            self._publish(0.0, 0.0)
        elif self._is_modal and (self._truth is None or self._truth[0] != stamp):
            self._pending = stamp, measured, message
        else:
            self._answer(measured, message, self._truth[1] if self._truth else None)

    def _answer(
        self,
        measured: Measurement,
        message: JointState,
        bend: tuple[FloatArray, FloatArray] | None,
    ) -> None:
        """Command what the controller says."""
        if self._controller is None:
            return
        command = self._controller.command(measured, self._load, bend)
        if command.fault is not None:
            self._let_go(command.fault)
            return
        if command.notice is not None:
            self.get_logger().error(command.notice)
            self._refusal = command.notice
        if self._fault is not None:
            self._fault = None
            self.publish_diagnostics()
        self._publish(command.force, command.torque, command.modal)
        self._show(message, measured, command)

    def _on_watchdog(self) -> None:
        age = (self.get_clock().now().nanoseconds - self._arrived) / _NANOSECONDS
        if self._arrived and age > self._settings.measurement_timeout:
            self._let_go(f'joint_states is stale: the last came {age:.3f} s ago')

    def _on_emergency_stop(
        self, _request: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        self._stopped = True
        self._let_go('emergency stop')
        response.success, response.message = True, 'stopped; ~/clear_stop releases'
        return response

    def _on_clear_stop(
        self, _request: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        self._stopped = False
        response.success, response.message = True, 'cleared; the motion starts anew'
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
        if self._controller is None or not self.is_active or self._stopped:
            why = 'stopped; ~/clear_stop releases' if self._stopped else 'not active'
            response.message = f'retract refused: the controller is {why}'
            return response
        depth = self._retract_depth({})
        self._controller.guide.resume()
        self._controller.set_target(depth)
        response.success, response.message = True, f'goes to {depth:g} m'
        return response

    # What goes out.

    def _let_go(self, fault: str) -> None:
        """Command zero force for a reason, said once when it begins."""
        begins = self._fault in (None, _WAITING)
        self._fault = fault
        if self._controller is not None:
            self._controller.release()
        self._publish(0.0, 0.0)
        if begins:
            self.get_logger().error(f'{fault}; no force is commanded')
            self.publish_diagnostics()

    def _publish(self, force: float, torque: float, modal: FloatArray | None = None) -> None:
        if self._is_modal:
            forces = self._generalized
            forces.header.stamp = self.get_clock().now().to_msg()
            rest = [0.0] * (len(forces.name) - 2) if modal is None else modal.tolist()
            # Insertion makes d smaller.
            forces.effort = [-force, torque, *rest]
            self._generalized_command.publish(forces)
            return
        message = self._wrench
        message.header.stamp = self.get_clock().now().to_msg()
        message.wrench.force.y = force
        message.wrench.torque.x = torque
        self._wrench_command.publish(message)

    def _show(self, message: JointState, measured: Measurement, command: Command) -> None:
        aim: Setpoint = command.setpoint
        self._aim.header.stamp = self._error.header.stamp = message.header.stamp
        self._aim.position = [aim.position]
        self._aim.velocity = [aim.speed]
        self._error.position = [aim.position - measured.depth]
        self._error.velocity = [aim.speed - measured.speed]
        self._reference.publish(self._aim)
        self._tracking_error.publish(self._error)

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
            values['least stable axis'] = ': '.join(filter(None, (name, limit.axis)))
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
        if self._stopped:
            return DiagnosticStatus.ERROR, 'emergency stop; ~/clear_stop releases', values
        if self.is_active and self._fault is not None:
            return DiagnosticStatus.WARN, self._fault, values
        level, text, _ = super().diagnose()
        return level, text, values


def main() -> int:
    """Run the node; return its exit status."""
    return run(ControllerNode)


if __name__ == '__main__':
    sys.exit(main())
