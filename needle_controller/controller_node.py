"""Node `controller`: turns encoder readings and a target into a wrench at the needle base."""

from __future__ import annotations

from collections.abc import Mapping
import sys
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PointStamped, WrenchStamped
from needle_controller.axis import Setpoint
from needle_controller.controller import (
    Command,
    Controller,
    ControllerSettings,
    LAWS,
    Measurement,
)
from needle_controller.inverse_dynamics import InverseDynamicsGains
from needle_controller.pid import PidGains
from needle_controller.reference import ReferenceLimits, REFERENCES
from needle_dynamics import NeedleError, NeedleModel, ParameterError
from needle_dynamics.base_node import COMMAND, NeedleNode, run, SENSOR
from rclpy.subscription import Subscription
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

_NANOSECONDS = 1_000_000_000

_WAITING = 'no joint_states yet'

#: Rotation by PID: a closed loop of 20 rad/s on the rotary inertia of the source's needle.
_ROTATION_PID = PidGains(kp=2.1e-7, ki=0.0, kd=2.1e-8)


class ControllerNode(NeedleNode):
    """
    Answers each ``joint_states`` with a ``wrench_command`` (force.y [N], torque.x [N m]).

    ``target`` (point.y [m]) is the inserted length to reach. Before the first target, while
    measurements are stale or not finite, and after ``~/emergency_stop`` the command is zero.
    ``reference`` and ``tracking_error`` show what it aims at and how far off it is.
    """

    LIVE = frozenset({'model.coulomb_friction', 'model.viscous_friction'})

    def __init__(self, **node_options: Any) -> None:
        super().__init__('controller', **node_options)
        self.declare_text('law', LAWS[0], f'one of {", ".join(LAWS)}')
        self.declare_text('actuation', 'physical', 'physical: force and torque at the base')
        self.declare_text('reference.kind', 'trapezoid', f'one of {", ".join(REFERENCES)}')
        self.declare_text('deflection_feedback', 'none', 'none, or ground_truth (simulation only)')
        self.declare_settings('', ControllerSettings())
        self.declare_settings('reference.', ReferenceLimits())
        self.declare_settings('inverse_dynamics.insertion.', InverseDynamicsGains())
        self.declare_settings('inverse_dynamics.rotation.', InverseDynamicsGains())
        self.declare_settings('pid.insertion.', PidGains())
        self.declare_settings('pid.rotation.', _ROTATION_PID)
        self.declare_model()

        self._controller: Controller | None = None
        self._settings = ControllerSettings()
        self._load = 0.0
        self._fault: str | None = None
        self._stopped = False
        self._last_stamp = 0
        self._arrived = 0

        publisher = self.create_lifecycle_publisher
        self._wrench_command = publisher(WrenchStamped, 'wrench_command', COMMAND)
        self._reference = publisher(JointState, 'reference', SENSOR)
        self._tracking_error = publisher(JointState, 'tracking_error', SENSOR)
        self.create_subscription(JointState, 'joint_states', self._on_joint_states, SENSOR)
        self.create_subscription(PointStamped, 'target', self._on_target, COMMAND)
        self.create_service(Trigger, '~/emergency_stop', self._on_emergency_stop)
        self.create_service(Trigger, '~/clear_stop', self._on_clear_stop)

        self._wrench = WrenchStamped()
        self._wrench.header.frame_id = 'needle_base'
        self._aim = JointState(name=['insertion'])
        self._error = JointState(name=['insertion'])

    # Transitions.

    def configure(self) -> None:
        """Make the controller from the parameters; refuse gains that cannot be stable."""
        self.text('actuation', ('physical',))
        parameters = self.model_parameters()
        self._settings = self.settings('', ControllerSettings)
        self._controller = Controller(
            self.text('law', LAWS),
            parameters,
            self._settings,
            inverse_dynamics=(
                self.settings('inverse_dynamics.insertion.', InverseDynamicsGains),
                self.settings('inverse_dynamics.rotation.', InverseDynamicsGains),
            ),
            pid=(
                self.settings('pid.insertion.', PidGains),
                self.settings('pid.rotation.', PidGains),
            ),
            reference=self.text('reference.kind', tuple(REFERENCES)),
            limits=self.settings('reference.', ReferenceLimits),
        )
        self._model = NeedleModel(parameters)
        self._truth: Subscription | None = None
        if self.text('deflection_feedback', ('none', 'ground_truth')) == 'ground_truth':
            self._truth = self.create_subscription(
                JointState, 'ground_truth', self._on_ground_truth, SENSOR
            )

    def change(self, changes: Mapping[str, Any]) -> None:
        """Go on with other friction; refuse what the gains cannot be stable with."""
        parameters = self.model_parameters(changes)
        if self._controller is not None:
            self._controller.change(parameters)
            self._model = NeedleModel(parameters)

    def cleanup(self) -> None:
        """Forget the ground truth."""
        self._load = 0.0
        if self._truth is not None:
            self.destroy_subscription(self._truth)

    def activate(self) -> None:
        """Begin to answer measurements and to watch for their absence."""
        self._fault = _WAITING
        self._last_depth: float | None = None
        self._arrived = self._last_stamp = 0
        self._watchdog = self.create_timer(
            0.5 * self._settings.measurement_timeout, self._on_watchdog
        )

    def deactivate(self) -> None:
        """Let go: zero force, and no memory of the motion nor of its target."""
        if self._controller is not None:
            self._controller.forget()
        self._publish_wrench(0.0, 0.0)
        self.destroy_timer(self._watchdog)

    # What comes in.

    def _on_target(self, message: PointStamped) -> None:
        if self._controller is None:
            return
        try:
            self._controller.set_target(message.point.y)
        except ParameterError as error:
            self.get_logger().error(f'target refused: {error}')
            return
        if message.point.z != 0.0:
            self.get_logger().warning(
                f'wanted deflection {message.point.z:g} m cannot be reached by force and torque '
                'at the base (physical actuation); the depth is',
                once=True,
            )

    def _on_ground_truth(self, message: JointState) -> None:
        try:
            bias = self._model.bias_forces([*message.position, *message.velocity])
        except NeedleError as error:
            self._load = 0.0
            self.get_logger().warning(f'ground_truth: {error}', throttle_duration_sec=1.0)
            return
        self._load = -float(bias[0])

    def _on_joint_states(self, message: JointState) -> None:
        """Answer a measurement at once; older ones than the last are not answered."""
        stamp = message.header.stamp.sec * _NANOSECONDS + message.header.stamp.nanosec
        if not self.is_active or self._controller is None:
            return
        age = (self.get_clock().now().nanoseconds - stamp) / _NANOSECONDS
        if abs(age) > self._settings.measurement_timeout:
            self._let_go(f'joint_states is stale: its stamp is {age:.3f} s old')
            return
        if stamp <= self._last_stamp:
            return
        self._last_stamp = stamp
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
        if not measured.is_finite():
            self._let_go(f'joint_states must be finite, got {measured}')
            return
        if self._stopped:
            self._publish_wrench(0.0, 0.0)
            return
        if self._fault is not None:
            self._resume(measured)
        self._last_depth = measured.depth
        command = self._controller.command(measured, self._load)
        self._publish_wrench(command.force, command.torque)
        self._show(message, measured, command)

    def _resume(self, measured: Measurement) -> None:
        """Go on after a fault; not towards a target set for a needle that was elsewhere."""
        self._fault = None
        last = self._last_depth
        if self._controller is not None and last is not None and self._controller.target:
            moved = abs(measured.depth - last)
            if moved > self._settings.jump:
                self._controller.forget()
                self.get_logger().error(
                    f'the needle is {moved:.6f} m from where it was before the fault; the target '
                    'is forgotten'
                )
        self.publish_diagnostics()

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

    # What goes out.

    def _let_go(self, fault: str) -> None:
        """Command zero force for a reason, said once when it begins."""
        begins = self._fault in (None, _WAITING)
        self._fault = fault
        if self._controller is not None:
            self._controller.release()
        self._publish_wrench(0.0, 0.0)
        if begins:
            self.get_logger().error(f'{fault}; no force is commanded')
            self.publish_diagnostics()

    def _publish_wrench(self, force: float, torque: float) -> None:
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
            values['target [m]'] = self._controller.target
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
