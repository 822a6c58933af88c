"""Node `plant`: the simulated needle, or the stand-in for the robot and its force sensor."""

from __future__ import annotations

from dataclasses import dataclass
import sys
from typing import Any

from builtin_interfaces.msg import Time as TimeMessage
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PointStamped, WrenchStamped
from needle_dynamics.base_node import COMMAND, NeedleNode, run, SENSOR
from needle_dynamics.errors import NeedleError, ParameterError
from needle_dynamics.force_sensor import ForceSensor, ForceSensorParameters
from needle_dynamics.integrators import Integrator
from needle_dynamics.model import NeedleModel
from needle_dynamics.parameters import check_constants, constant
from needle_dynamics.plant import BaseMotion, BaseParameters, Plant, Sample
import numpy as np
from rcl_interfaces.msg import IntegerRange, ParameterDescriptor
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory

_NANOSECONDS = 1_000_000_000


@dataclass(frozen=True, slots=True, kw_only=True)
class PlantSettings:
    """What the node itself needs to know."""

    rate: float = constant(1000.0, 'Hz', 'samples per second', low=1.0, high=10_000.0)
    depth: float = constant(0.02, 'm', 'inserted length at the start', open_low=True)
    tip_deflection: float = constant(
        0.0, 'm', 'deflection of the tip at the start', low=-0.1, high=0.1
    )
    step: float = constant(2e-5, 's', 'longest step of the integrator', low=1e-7, high=1e-2)
    command_timeout: float = constant(
        0.1, 's', 'age at which a command no longer counts', open_low=True
    )
    force_limit: float = constant(1e3, 'N', 'largest force that a command may ask for')
    torque_limit: float = constant(1.0, 'N m', 'largest torque that a command may ask for')
    backlog: float = constant(0.5, 's', 'delay beyond which samples are given up', open_low=True)

    def __post_init__(self) -> None:
        check_constants(self)


class PlantNode(NeedleNode):
    """
    Publishes ``joint_states``, ``base_wrench``, ``tip_deflection`` and ``ground_truth``.

    Lengths in m, forces in N, torques in N m, positive into the tissue. In mode `simulation`
    the needle moves under ``wrench_command`` (force.y, torque.x); in mode `robot` the base
    follows ``joint_trajectory`` (joint `insertion`). Samples are taken on the node's clock at
    exact multiples of the period: after a stall the missing ones are made up, not dropped.
    """

    def __init__(self, **node_options: Any) -> None:
        super().__init__('plant', **node_options)
        self.declare_text('mode', 'simulation', 'simulation or robot')
        self.declare_parameter(
            'seed',
            1,
            ParameterDescriptor(
                description='seed of the sensor noise: the same seed gives the same noise',
                integer_range=[IntegerRange(from_value=0, to_value=2**62)],
            ),
        )
        self.declare_settings('', PlantSettings())
        self.declare_model()
        self.declare_settings('sensor.', ForceSensorParameters())
        self.declare_settings('base.', BaseParameters())

        self._settings = PlantSettings()
        self._plant: Plant | None = None
        self._halted: str | None = None
        self._lost = 0
        self._force = self._torque = 0.0
        self._command_time: int | None = None
        self._bad_commands = 0

        publisher = self.create_lifecycle_publisher
        self._joint_states = publisher(JointState, 'joint_states', SENSOR)
        self._base_wrench = publisher(WrenchStamped, 'base_wrench', SENSOR)
        self._tip_deflection = publisher(PointStamped, 'tip_deflection', SENSOR)
        self._ground_truth = publisher(JointState, 'ground_truth', SENSOR)
        self.create_subscription(WrenchStamped, 'wrench_command', self._on_command, COMMAND)
        self.create_subscription(JointTrajectory, 'joint_trajectory', self._on_trajectory, COMMAND)

        self._joints = JointState(name=['insertion', 'rotation'])
        self._truth = JointState()
        self._wrench = WrenchStamped()
        self._wrench.header.frame_id = 'needle_base'
        self._tip = PointStamped()
        self._tip.header.frame_id = 'needle_entry'

    # Transitions.

    def configure(self) -> None:
        """Make the plant from the parameters."""
        settings = self.settings('', PlantSettings)
        parameters = self.model_parameters()
        seed = self.get_parameter('seed').value
        sensor = ForceSensor(self.settings('sensor.', ForceSensorParameters), settings.rate, seed)
        model = NeedleModel(parameters)
        self._truth.name = list(model.coordinate_names)
        state = model.state_at(settings.depth, settings.tip_deflection)
        integrator = Integrator(parameters, state, settings.step)
        base = None
        if self.text('mode', ('simulation', 'robot')) == 'robot':
            reach = parameters.minimum_depth, parameters.length
            base = BaseMotion(self.settings('base.', BaseParameters), settings.depth, reach)
        self._settings = settings
        self._plant = Plant(integrator, sensor, settings.rate, base)
        # Compile, or load what was compiled, before time counts.
        Integrator(parameters, state, settings.step).advance(settings.step)

    def activate(self) -> None:
        """Begin to sample now."""
        self._halted = None
        self._lost = self._sampled = 0
        self._command_time = None
        self._start = self.get_clock().now().nanoseconds
        self._timer = self.create_timer(1.0 / self._settings.rate, self._on_timer)

    def deactivate(self) -> None:
        """Stop sampling."""
        self.destroy_timer(self._timer)

    # Commands.

    def _on_command(self, message: WrenchStamped) -> None:
        force, torque = message.wrench.force.y, message.wrench.torque.x
        limits = self._settings.force_limit, self._settings.torque_limit
        # Written so that NaN is refused too.
        if not (abs(force) <= limits[0] and abs(torque) <= limits[1]):
            self._bad_commands += 1
            self.get_logger().error(
                f'wrench_command must be within {limits[0]:g} N and {limits[1]:g} N m, got '
                f'force.y = {force}, torque.x = {torque}; no force is applied',
                throttle_duration_sec=1.0,
            )
            force = torque = 0.0
        self._force, self._torque = force, torque
        self._command_time = self.get_clock().now().nanoseconds

    def _on_trajectory(self, message: JointTrajectory) -> None:
        if self._plant is None or self._plant.base is None:
            self.get_logger().error('joint_trajectory is followed in mode robot only')
            return
        if 'insertion' not in message.joint_names:
            self.get_logger().error(
                f"joint_trajectory needs the joint 'insertion', got {list(message.joint_names)}"
            )
            return
        joint = message.joint_names.index('insertion')
        points = [point for point in message.points if len(point.positions) > joint]
        times = [p.time_from_start.sec + p.time_from_start.nanosec / _NANOSECONDS for p in points]
        try:
            self._plant.base.follow(
                self._plant.time,
                self._plant.integrator.depth,
                np.array(times),
                np.array([point.positions[joint] for point in points]),
            )
        except ParameterError as error:
            self.get_logger().error(f'joint_trajectory: {error}')

    # Samples.

    def _on_timer(self) -> None:
        """Take every sample that is due, each stamped with its own time."""
        now = self.get_clock().now().nanoseconds
        rate = self._settings.rate
        due = int((now - self._start) * rate / _NANOSECONDS) - self._sampled
        if self._start == 0 or due < 0:
            # The first /clock has come, or the clock was set back: sample on from here.
            self._start, self._sampled = now, 0
            return
        most = max(1, int(self._settings.backlog * rate))
        if due > most:
            # Time that was given up is skipped, and said on /diagnostics.
            self._lost += due - most
            self._start += round((due - most) / rate * _NANOSECONDS)
            due = most
        for _ in range(due):
            self._sampled += 1
            stamp = self._start + round(self._sampled / rate * _NANOSECONDS)
            self._sample(stamp)

    def _sample(self, stamp: int) -> None:
        plant = self._plant
        if plant is None or self._halted is not None:
            return
        age = float('inf')
        if self._command_time is not None:
            age = (stamp - self._command_time) / _NANOSECONDS
        if age > self._settings.command_timeout:
            self._force = self._torque = 0.0
        try:
            self._show(plant.advance(self._force, self._torque), stamp)
        except NeedleError as error:
            self._halted = str(error)
            self.get_logger().error(f'{error}; the plant stands still')
            self.report_change()

    def _show(self, sample: Sample, stamp: int) -> None:
        time = TimeMessage(sec=stamp // _NANOSECONDS, nanosec=stamp % _NANOSECONDS)
        state = sample.state
        middle = len(state) // 2
        joints, truth, wrench, tip = self._joints, self._truth, self._wrench.wrench, self._tip
        for message in (joints, self._wrench, tip, truth):
            message.header.stamp = time
        joints.position = [sample.depth, state[1]]
        joints.velocity = [sample.speed, state[middle + 1]]
        joints.effort = [sample.force, self._torque]
        truth.position = state[:middle].tolist()
        truth.velocity = state[middle:].tolist()
        force, torque = wrench.force, wrench.torque
        force.x, force.y, force.z, torque.x, torque.y, torque.z = sample.wrench.tolist()
        tip.point.y = sample.depth
        tip.point.z = sample.tip_deflection
        self._joint_states.publish(joints)
        self._base_wrench.publish(self._wrench)
        self._tip_deflection.publish(tip)
        self._ground_truth.publish(truth)

    def diagnose(self) -> tuple[bytes, str, dict[str, object]]:
        """Say where the needle is and what went wrong."""
        if self._plant is None:
            return super().diagnose()
        values: dict[str, object] = {
            'inserted length [m]': f'{self._plant.integrator.depth:.6f}',
            'samples given up': self._lost,
            'commands refused': self._bad_commands,
        }
        if self._halted:
            return DiagnosticStatus.ERROR, self._halted, values
        if self._lost:
            return DiagnosticStatus.WARN, f'{self._lost} samples given up after stalls', values
        level, message, _ = super().diagnose()
        return level, message, values


def main() -> int:
    """Run the node; return its exit status."""
    return run(PlantNode)


if __name__ == '__main__':
    sys.exit(main())
