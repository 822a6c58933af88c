"""Node `plant`: the simulated needle, or the stand-in for a robot and its force sensor."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import ceil
import sys
from typing import Any

from builtin_interfaces.msg import Time as TimeMessage
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PointStamped, PoseStamped, WrenchStamped
from needle_dynamics.base_node import COMMAND, NeedleNode, run, SENSOR
from needle_dynamics.errors import JobError, NeedleError, ParameterError
from needle_dynamics.force_sensor import ForceSensor, ForceSensorParameters, HIGHEST_RATE
from needle_dynamics.indenter import Indenter, IndenterParameters, Press
from needle_dynamics.integrators import Integrator
from needle_dynamics.kernels import FloatArray
from needle_dynamics.model import NeedleModel
from needle_dynamics.parameters import check_constants, constant
from needle_dynamics.plant import (
    BaseMotion,
    BaseParameters,
    Plant,
    Sample,
    TipParameters,
    TipSensor,
)
import numpy as np
from rcl_interfaces.msg import IntegerRange, ParameterDescriptor
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory

#: What the node stands in for.
MODES = ('simulation', 'robot', 'indenter')

#: As rclpy listens to it.
CLOCK = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)

_NANOSECONDS = 1_000_000_000

#: Time between ticks that is short enough for whoever listens [s].
_TICK = 1e-3


def _message(stamp: int) -> TimeMessage:
    return TimeMessage(sec=stamp // _NANOSECONDS, nanosec=stamp % _NANOSECONDS)


@dataclass(frozen=True, slots=True, kw_only=True)
class PlantSettings:
    """What the node itself needs to know."""

    rate: float = constant(
        1000.0, 'Hz', 'samples per second of simulated time', low=1.0, high=HIGHEST_RATE
    )
    real_time_factor: float = constant(
        1.0, '1', "pace of simulated time over that of the node's clock", high=100.0, open_low=True
    )
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
    modal_limit: float = constant(
        1e4, 'N m^-1/2', 'largest generalized force on q1..qn that a command may ask for'
    )
    backlog: float = constant(0.5, 's', 'delay that is made up after a stall', open_low=True)

    def __post_init__(self) -> None:
        check_constants(self)


class PlantNode(NeedleNode):
    """
    The needle, or the end-effector, with its sensors.

    Lengths in m, forces in N, torques in N m, positive into the tissue. In mode `simulation`
    the needle moves under ``wrench_command`` (force.y, torque.x) or ``generalized_command``
    (efforts of d, theta and q1..qn), whichever came last; in mode `robot` the base
    follows ``joint_trajectory`` (joint `insertion`: positions, or efforts for a push). Both
    publish ``joint_states``, ``base_wrench``, ``tip_deflection`` and ``ground_truth``. In mode
    `indenter` the end-effector presses the tissue by ``joint_trajectory`` (efforts of the joints
    `x` and `z`) and shows ``base_wrench`` and ``end_effector_pose``. A trajectory begins when it
    comes, or with the activation if it came before.

    Samples are taken at exact multiples of the period of simulated time, which starts at the
    node's now and runs ``real_time_factor`` times as fast; with ``publish_clock`` it is /clock.
    After a stall the missing samples are made up. What is beyond the backlog is given up at a
    factor of one, where the stamps are the node's clock; else simulated time waits.
    """

    LIVE = frozenset({'model.coulomb_friction', 'model.viscous_friction'})

    def __init__(self, **node_options: Any) -> None:
        super().__init__('plant', **node_options)
        self.declare_text('mode', MODES[0], f'one of {", ".join(MODES)}')
        self.declare_text('publish_clock', False, 'publish the simulated time on /clock')
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
        self.declare_settings('tip.', TipParameters())
        self.declare_settings('base.', BaseParameters())
        self.declare_settings('indenter.', IndenterParameters())

        self._settings = PlantSettings()
        self._plant: Plant | Indenter | None = None
        self._halted: str | None = None
        #: Samples given up, and time that simulated time waited [ns].
        self._lost = self._waited = 0
        self._force = self._torque = 0.0
        self._modal: FloatArray | None = None
        self._command_time: int | None = None
        self._bad_commands = 0

        publisher = self.create_lifecycle_publisher
        self._joint_states = publisher(JointState, 'joint_states', SENSOR)
        self._base_wrench = publisher(WrenchStamped, 'base_wrench', SENSOR)
        self._tip_deflection = publisher(PointStamped, 'tip_deflection', SENSOR)
        self._ground_truth = publisher(JointState, 'ground_truth', SENSOR)
        self._end_effector_pose = publisher(PoseStamped, 'end_effector_pose', SENSOR)
        self._clock_topic: Publisher | None = None
        self.create_subscription(WrenchStamped, 'wrench_command', self._on_command, COMMAND)
        self.create_subscription(JointState, 'generalized_command', self._on_generalized, COMMAND)
        self.create_subscription(JointTrajectory, 'joint_trajectory', self._on_trajectory, COMMAND)
        self.create_service(Trigger, '~/tare', self._on_tare)

        self._joints = JointState(name=['insertion', 'rotation'])
        self._truth = JointState()
        self._wrench = WrenchStamped()
        self._wrench.header.frame_id = 'needle_base'
        self._tip = PointStamped()
        self._tip.header.frame_id = 'needle_entry'
        self._pose = PoseStamped()
        self._pose.header.frame_id = 'needle_entry'
        self._pose.pose.orientation.w = 1.0

    # Transitions.

    def configure(self) -> None:
        """Make the plant from the parameters."""
        self._settings = self.settings('', PlantSettings)
        publishes = self.get_parameter('publish_clock').value
        if publishes and self.get_parameter('use_sim_time').value:
            raise ParameterError(
                'publish_clock and use_sim_time cannot both be true: the plant would follow its '
                'own /clock'
            )
        # Compile, or load what was compiled, before time counts.
        self._make_plant().advance()
        self._plant = self._make_plant()
        if publishes:
            self._clock_topic = self.create_publisher(Clock, '/clock', CLOCK)

    def _make_plant(self) -> Plant | Indenter:
        settings, seed = self._settings, self.get_parameter('seed').value
        mode = self.text('mode', MODES)
        sensor = ForceSensor(self.settings('sensor.', ForceSensorParameters), settings.rate, seed)
        base = self.settings('base.', BaseParameters)
        tip = TipSensor(self.settings('tip.', TipParameters), settings.rate, seed)
        tissue = self.settings('indenter.', IndenterParameters)
        parameters = self.model_parameters()
        if mode == 'indenter':
            return Indenter(tissue, sensor, settings.rate, seed, settings.force_limit)
        model = NeedleModel(parameters)
        self._truth.name = list(model.coordinate_names)
        state = model.state_at(settings.depth, settings.tip_deflection)
        reach = parameters.minimum_depth, parameters.length
        return Plant(
            Integrator(parameters, state, settings.step),
            sensor,
            settings.rate,
            BaseMotion(base, settings.depth, reach, settings.force_limit)
            if mode == 'robot'
            else None,
            tip,
        )

    def cleanup(self) -> None:
        """Forget the plant."""
        self._plant = None
        if self._clock_topic is not None:
            self.destroy_publisher(self._clock_topic)
            self._clock_topic = None

    def change(self, changes: Mapping[str, Any]) -> None:
        """Go on with other friction; the state stays."""
        parameters = self.model_parameters(changes)
        if isinstance(self._plant, Plant):
            self._plant.integrator.change(parameters)

    def activate(self) -> None:
        """Begin to sample now."""
        self._halted = None
        self._lost = self._waited = 0
        rate, factor = self._settings.rate, self._settings.real_time_factor
        # Several samples at a tick are well: no more ticks than in real time are needed.
        tick = max(1.0 / (rate * factor), min(1.0 / rate, _TICK))
        #: Most samples at one tick when simulated time may wait: a burst would overrun readers.
        self._burst = ceil(2.0 * rate * factor * tick)
        self._begin(self.get_clock().now().nanoseconds)
        self._timer = self.create_timer(tick, self._on_timer)

    def _begin(self, now: int) -> None:
        """Let simulated time start at the node's now."""
        #: Node's clock and simulated time that belong together [ns].
        self._wall = self._start = now
        self._sampled = 0
        self._command_time = None

    def _simulated(self) -> int:
        """Return the simulated time now [ns]."""
        elapsed = self.get_clock().now().nanoseconds - self._wall
        return self._start + round(elapsed * self._settings.real_time_factor)

    def deactivate(self) -> None:
        """Stop sampling."""
        self.destroy_timer(self._timer)

    # Commands.

    def _on_command(self, message: WrenchStamped) -> None:
        force, torque = message.wrench.force.y, message.wrench.torque.x
        limits = self._settings.force_limit, self._settings.torque_limit
        # Written so that NaN is refused too.
        if abs(force) <= limits[0] and abs(torque) <= limits[1]:
            self._take(force, torque, None)
        else:
            self._refuse(
                f'wrench_command must be within {limits[0]:g} N and {limits[1]:g} N m, got '
                f'force.y = {force}, torque.x = {torque}'
            )

    def _on_generalized(self, message: JointState) -> None:
        settings, names = self._settings, self._truth.name
        if not isinstance(self._plant, Plant):
            return
        efforts = dict(zip(message.name, message.effort, strict=False))
        if sorted(message.name) != sorted(names) or len(message.effort) != len(names):
            self._refuse(
                f'generalized_command needs an effort for each of {", ".join(names)}, got '
                f'{list(message.effort)} for {", ".join(message.name) or "none"}'
            )
            return
        forces = [efforts[name] for name in names]
        limits = settings.force_limit, settings.torque_limit, settings.modal_limit
        bounds = [*limits[:2], *limits[2:] * (len(names) - 2)]
        if all(abs(force) <= bound for force, bound in zip(forces, bounds, strict=True)):
            # Insertion makes d smaller.
            self._take(-forces[0], forces[1], np.array(forces[2:]))
        else:
            self._refuse(
                f'generalized_command must be within {limits[0]:g} N, {limits[1]:g} N m and '
                f'{limits[2]:g} N m^-1/2, got {forces}'
            )

    def _take(self, force: float, torque: float, modal: FloatArray | None) -> None:
        """Apply a command from now on."""
        self._force, self._torque, self._modal = force, torque, modal
        if self.is_active:
            self._command_time = self._simulated()

    def _refuse(self, complaint: str) -> None:
        """Apply no force instead of a command."""
        self._bad_commands += 1
        self.get_logger().error(f'{complaint}; no force is applied', throttle_duration_sec=1.0)
        self._take(0.0, 0.0, None)

    def _on_trajectory(self, message: JointTrajectory) -> None:
        points = message.points
        if (
            self.get_parameter('mode').value == 'simulation'
            and self.count_subscribers('joint_trajectory') > 1
        ):
            # It is the reference of a controller.
            return
        try:
            if self._plant is None:
                raise ParameterError('the plant is not configured')
            self._plant.follow(
                message.joint_names,
                [
                    point.time_from_start.sec + point.time_from_start.nanosec / _NANOSECONDS
                    for point in points
                ],
                [point.positions for point in points],
                [point.effort for point in points],
            )
        except ParameterError as error:
            self._bad_commands += 1
            self.get_logger().error(f'joint_trajectory: {error}')

    def _on_tare(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        try:
            if self._plant is None or not self.is_active:
                raise JobError('the plant is not active')
            self._plant.tare()
        except JobError as error:
            response.message = f'tare refused: {error}'
        else:
            response.success, response.message = True, 'the force sensor is zeroed'
        return response

    # Samples.

    def _on_timer(self) -> None:
        """Take every sample that is due, each stamped with its own time."""
        settings = self._settings
        rate, factor = settings.rate, settings.real_time_factor
        due = int((self._simulated() - self._start) * rate / _NANOSECONDS) - self._sampled
        if self._start == 0 or due < 0:
            # The first /clock has come, or the clock was set back: sample on from here.
            self._begin(self.get_clock().now().nanoseconds)
            return
        beyond = due - max(1, int(settings.backlog * rate * factor))
        if beyond > 0:
            late = round(beyond / (rate * factor) * _NANOSECONDS)
            self._wall += late
            due -= beyond
            if factor == 1.0:
                # Time that was given up is skipped, and said on /diagnostics.
                self._lost += beyond
                self._start += late
            else:
                self._waited += late
        if factor != 1.0:
            due = min(due, self._burst)
        for _ in range(due):
            self._sampled += 1
            self._sample(self._start + round(self._sampled / rate * _NANOSECONDS))
        if self._clock_topic is not None:
            newest = self._start + round(self._sampled / rate * _NANOSECONDS)
            self._clock_topic.publish(Clock(clock=_message(newest)))

    def _sample(self, stamp: int) -> None:
        plant = self._plant
        if plant is None or self._halted is not None:
            return
        age = float('inf')
        if self._command_time is not None:
            age = (stamp - self._command_time) / _NANOSECONDS
        if age > self._settings.command_timeout:
            self._force, self._torque, self._modal = 0.0, 0.0, None
        try:
            sample = (
                plant.advance(self._force, self._torque, self._modal)
                if isinstance(plant, Plant)
                else plant.advance(self._force, self._torque)
            )
        except NeedleError as error:
            self._halted = str(error)
            self.get_logger().error(f'{error}; the plant stands still')
            self.report_change()
            return
        time = _message(stamp)
        self._wrench.header.stamp = time
        force, torque = self._wrench.wrench.force, self._wrench.wrench.torque
        force.x, force.y, force.z, torque.x, torque.y, torque.z = sample.wrench.tolist()
        self._base_wrench.publish(self._wrench)
        if isinstance(sample, Press):
            self._show_press(sample, time)
        else:
            self._show_needle(sample, stamp, time)

    def _show_needle(self, sample: Sample, stamp: int, time: TimeMessage) -> None:
        state = sample.state
        middle = len(state) // 2
        joints, truth, tip = self._joints, self._truth, self._tip
        for message in (joints, truth):
            message.header.stamp = time
        joints.position = [sample.joint_position, state[1]]
        joints.velocity = [sample.speed, state[middle + 1]]
        joints.effort = [sample.force, self._torque]
        truth.position = state[:middle].tolist()
        truth.velocity = state[middle:].tolist()
        seen = sample.tip
        if seen is not None:
            late = round(seen.age / self._settings.rate * _NANOSECONDS)
            tip.header.stamp = _message(stamp - late) if late else time
            tip.point.y, tip.point.z = seen.depth, seen.deflection
            self._tip_deflection.publish(tip)
        self._ground_truth.publish(truth)
        # Last: who answers it has the rest of the sample.
        self._joint_states.publish(joints)

    def _show_press(self, sample: Press, time: TimeMessage) -> None:
        position = self._pose.pose.position
        self._pose.header.stamp = time
        position.x, position.y, position.z = sample.position.tolist()
        self._end_effector_pose.publish(self._pose)

    def diagnose(self) -> tuple[bytes, str, dict[str, object]]:
        """Say where the needle is and what went wrong."""
        if self._plant is None:
            return super().diagnose()
        values: dict[str, object] = {
            **self._plant.report,
            'samples given up': self._lost,
            'waited for the machine [s]': f'{self._waited / _NANOSECONDS:.3f}',
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
