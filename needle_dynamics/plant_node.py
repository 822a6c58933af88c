"""Node `plant`: the simulated needle, or the stand-in for a robot and its force sensor."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from math import cos, sin
import sys
from time import monotonic_ns
from typing import Any

from builtin_interfaces.msg import Time as TimeMessage
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import Point, PointStamped, Pose, PoseArray, PoseStamped, WrenchStamped
from needle_dynamics.compiled.cache import announce_compilation
from needle_dynamics.model_node import ModelNode
from needle_dynamics.simulated.assembly import assemble, MODES
from needle_dynamics.simulated.faults import Fault, FaultParameters, FAULTS
from needle_dynamics.simulated.force_sensor import ForceSensorParameters, HIGHEST_RATE
from needle_dynamics.simulated.indenter import Indenter, IndenterParameters, Press
from needle_dynamics.simulated.plant import BaseParameters, Plant, Sample, TipParameters
from needle_ros.base_node import COMMAND, run, SENSOR
from needle_ros.errors import (
    JobError,
    NeedleError,
    ParameterError,
)
from needle_ros.pace import Pace
from needle_ros.packed import Layout, Reading
from needle_ros.settings import check_constants, constant
from needle_ros.timing import NANOSECONDS, seconds, Window
import numpy as np
from rcl_interfaces.msg import IntegerRange, ParameterDescriptor
from rclpy.clock import Clock as NodeClock
from rclpy.clock_type import ClockType
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory
from visualization_msgs.msg import Marker

#: As rclpy listens to it.
CLOCK = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)

#: Streams that a fault can hit, and how many of their values a bias changes.
_FAULTY = {'joint_states': 1, 'base_wrench': 6, 'tip_deflection': 1}

#: Time between looks at the graph [s]; looks after which an unanswered sample is repeated.
_WATCH = 0.1
_REPEAT = 5

#: More commands per sample than this are worth a word.
_TOO_MANY = 3.0

_NO_FAULT = 'none'

#: For people: pictures of the needle per second, and points of each.
_PICTURES = 30.0
_POINTS = 21

#: How thick the needle is drawn [m].
_THICKNESS = 1e-3


def _message(stamp: int) -> TimeMessage:
    return TimeMessage(sec=stamp // NANOSECONDS, nanosec=stamp % NANOSECONDS)


@dataclass(frozen=True, slots=True)
class _Command:
    """Forces on the needle, and the time from which they count [ns]."""

    stamp: int
    force: float = 0.0
    torque: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class PlantSettings:
    """What the node itself needs to know."""

    rate: float = constant(
        1000.0, 'Hz', 'samples per second of simulated time', low=1.0, high=HIGHEST_RATE
    )
    real_time_factor: float = constant(
        1.0, '1', "pace of simulated time over that of the node's clock; 0: as fast as possible",
        high=100.0,
    )  # fmt: skip
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
    backlog: float = constant(0.5, 's', 'delay that is made up after a stall', open_low=True)

    def __post_init__(self) -> None:
        check_constants(self)


class PlantNode(ModelNode):
    """
    The needle, or the end-effector, with its sensors.

    Lengths in m, forces in N, torques in N m, positive into the tissue. In mode `simulation`
    the needle moves under ``wrench_command`` (force.y, torque.x); in mode `robot` the base
    follows ``joint_trajectory`` (joint `insertion`: positions, or efforts for a push). Both
    publish ``joint_states``, ``base_wrench``, ``tip_deflection`` and ``ground_truth``, and for
    people ``needle_shape`` and ``needle_poses``. In mode `indenter` the end-effector presses the
    tissue by ``joint_trajectory`` (efforts of the joints `x` and `z`) and shows ``base_wrench``
    and ``end_effector_pose``. A trajectory begins when it comes, or with the activation if it
    came before.

    Samples are taken at exact multiples of the period of simulated time, see `Pace`; with
    ``publish_clock`` or ``lockstep`` it is /clock. The command that is newest when a sample is
    taken acts until the next one. A command carries the stamp of the sample that it answers;
    with ``lockstep`` the next sample waits for it. ``~/pause`` stops time, ``~/step`` takes one
    sample, ``~/reset`` puts the needle and its noise back to their start while time goes on.
    """

    LIVE = frozenset(
        {
            'model.coulomb_friction',
            'model.viscous_friction',
            'fault.kind',
            'fault.topic',
            *(f'fault.{item.name}' for item in fields(FaultParameters)),
        }
    )

    def __init__(self, **node_options: Any) -> None:
        super().__init__('plant', **node_options)
        self.declare_text('mode', MODES[0], f'one of {", ".join(MODES)}')
        self.declare_text('publish_clock', False, 'publish the simulated time on /clock')
        self.declare_text(
            'lockstep', False, 'each sample waits for the command that answers the one before it'
        )
        self.declare_text('paused', False, 'begin with time standing still')
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
        self.declare_text('fault.kind', _NO_FAULT, f'{_NO_FAULT}, or one of {", ".join(FAULTS)}')
        self.declare_text('fault.topic', 'joint_states', f'one of {", ".join(_FAULTY)}')
        self.declare_settings('fault.', FaultParameters())

        self._settings = PlantSettings()
        self._plant: Plant | Indenter | None = None
        self._halted: str | None = None
        #: The command that acts, and the newest.
        self._held = self._newest = _Command(0)
        self._fault: Fault | None = None
        self._faulty = ''
        #: Others that command, beyond the one that may.
        self._rivals = 0
        self._looks = 0
        self._sampled = self._made_up = 0
        self._saturated = 0
        #: By a steady clock.
        self._commands, self._samples = Window(), Window()
        #: Commands not taken: not valid, of too long ago, older than one that came before.
        self._refused = self._stale = self._overtaken = 0

        publisher = self.create_lifecycle_publisher
        self._joint_states = publisher(JointState, 'joint_states', SENSOR)
        self._base_wrench = publisher(WrenchStamped, 'base_wrench', SENSOR)
        self._tip_deflection = publisher(PointStamped, 'tip_deflection', SENSOR)
        self._ground_truth = publisher(JointState, 'ground_truth', SENSOR)
        self._end_effector_pose = publisher(PoseStamped, 'end_effector_pose', SENSOR)
        self._needle_shape = publisher(Marker, 'needle_shape', SENSOR)
        self._needle_poses = publisher(PoseArray, 'needle_poses', SENSOR)
        self._clock_topic: Publisher | None = None
        self.listen(WrenchStamped, 'wrench_command', COMMAND, self._on_command)
        self.create_subscription(JointTrajectory, 'joint_trajectory', self._on_trajectory, COMMAND)
        self.create_service(Trigger, '~/tare', self._on_tare)
        self.create_service(SetBool, '~/pause', self._on_pause)
        self.create_service(Trigger, '~/step', self._on_step)
        self.create_service(Trigger, '~/reset', self._on_reset)

        self._wrench = Layout('needle_base', numbers=6)
        self._tip = Layout('needle_entry', numbers=3)
        self._joints = Layout('', names=['insertion', 'rotation'], counts=(2, 2, 2))
        self._pose = PoseStamped()
        self._pose.header.frame_id = 'needle_entry'
        self._pose.pose.orientation.w = 1.0
        self._shape = Marker(ns='needle', type=Marker.LINE_STRIP)
        self._shape.header.frame_id = 'needle_entry'
        self._shape.pose.orientation.w = 1.0
        self._shape.scale.x = _THICKNESS
        self._shape.color.r = self._shape.color.g = self._shape.color.b = 0.8
        self._shape.color.a = 1.0
        self._poses = PoseArray()
        self._poses.header.frame_id = 'needle_entry'

    # Transitions.

    def configure(self) -> None:
        """Make the plant from the parameters."""
        self._settings = self.settings('', PlantSettings)
        lockstep = bool(self.get_parameter('lockstep').value)
        publishes = lockstep or bool(self.get_parameter('publish_clock').value)
        if publishes and self.get_parameter('use_sim_time').value:
            raise ParameterError(
                f'{"lockstep" if lockstep else "publish_clock"} and use_sim_time cannot both be '
                'true: the plant would follow its own /clock'
            )
        mode = self.text('mode', MODES)
        if lockstep and mode != 'simulation':
            raise ParameterError(
                'lockstep must be false but in mode simulation, where commands answer samples, '
                f'got mode {mode!r}'
            )
        self._pace = Pace(
            self._settings.rate,
            self._settings.real_time_factor,
            self._settings.backlog,
            own=publishes,
            lockstep=lockstep,
        )
        if mode == 'simulation' and self._settings.command_timeout < 1.0 / self._settings.rate:
            raise ParameterError(
                f'command_timeout must be at least a period, {1.0 / self._settings.rate:g} s, got '
                f'{self._settings.command_timeout:g} s'
            )
        self._set_fault({})
        # Compile, or load what was compiled, before time counts.
        self._make_plant().advance()
        self._plant = self._make_plant()
        if publishes:
            self._clock_topic = self.create_publisher(Clock, '/clock', CLOCK)

    def _make_plant(self) -> Plant | Indenter:
        settings, sensor = self._settings, self.settings('sensor.', ForceSensorParameters)
        limits = sensor.per_axis('range').tolist()
        # Rounding to counts may leave a saturated reading just below.
        self._full_scale = [limit * (1.0 - 1e-9) for limit in limits]
        plant = assemble(
            self.text('mode', MODES),
            rate=settings.rate,
            seed=self.get_parameter('seed').value,
            step=settings.step,
            depth=settings.depth,
            tip_deflection=settings.tip_deflection,
            force_limit=settings.force_limit,
            model=self.model_parameters(),
            sensor=sensor,
            tip=self.settings('tip.', TipParameters),
            base=self.settings('base.', BaseParameters),
            indenter=self.settings('indenter.', IndenterParameters),
        )
        if isinstance(plant, Plant):
            self._names = names = plant.integrator.model.coordinate_names
            self._truth = Layout('', names=names, counts=(len(names), len(names), 0))
        return plant

    def cleanup(self) -> None:
        """Forget the plant."""
        self._plant = None
        if self._clock_topic is not None:
            self.destroy_publisher(self._clock_topic)
            self._clock_topic = None

    def change(self, changes: Mapping[str, Any]) -> None:
        """Go on with other friction, or another fault; the state stays."""
        if any(name.startswith('model.') for name in changes):
            parameters = self.model_parameters(changes)
            if isinstance(self._plant, Plant):
                self._plant.integrator.change(parameters)
        if any(name.startswith('fault.') for name in changes):
            self._set_fault(changes)

    def _set_fault(self, changes: Mapping[str, Any]) -> None:
        """Let measurements suffer from what the parameters say."""
        kind = self.text('fault.kind', (_NO_FAULT, *FAULTS), changes)
        topic = self.text('fault.topic', tuple(_FAULTY), changes)
        parameters = self.settings('fault.', FaultParameters, changes)
        self._fault, self._faulty = None, topic
        if kind != _NO_FAULT:
            rate, seed = self._settings.rate, self.get_parameter('seed').value
            self._fault = Fault(kind, parameters, rate, seed)

    def activate(self) -> None:
        """Begin to sample now."""
        self._halted = None
        self._sampled = self._made_up = self._saturated = 0
        self._rivals = 0
        self._held = self._newest = _Command(0)
        pictured = self._settings.rate * max(1.0, self._settings.real_time_factor)
        #: Samples from one picture to the next.
        self._picture = max(1, round(pictured / _PICTURES))
        self._pace.begin(self.now(), paused=bool(self.get_parameter('paused').value))
        self._timer = self.create_timer(self._pace.tick, self._on_timer)
        steady = NodeClock(clock_type=ClockType.STEADY_TIME)
        self._watch = self.create_timer(_WATCH, self._on_watch, clock=steady)

    def deactivate(self) -> None:
        """Stop sampling."""
        self.destroy_timer(self._timer)
        self.destroy_timer(self._watch)

    # Commands.

    def _counts_from(self, stamp: int) -> int | None:
        """Return the time from which a command counts [ns]; None if it is not taken."""
        if not self.is_active:
            return None
        self._commands.add(monotonic_ns())
        now = self._pace.simulated(self.now())
        # Who has no clock leaves the stamp empty: it counts from now.
        stamp = stamp or now
        timeout = self._settings.command_timeout
        age = (now - stamp) / NANOSECONDS
        if abs(age) > timeout:
            self._stale += 1
            self.get_logger().error(
                f'a command of {age:.3f} s ago is not taken: command_timeout is {timeout:g} s',
                throttle_duration_sec=1.0,
            )
            return None
        # A newer one from the future is one of before the clock was set back.
        if stamp < self._newest.stamp <= now + timeout * NANOSECONDS:
            self._overtaken += 1
            return None
        return stamp

    def _on_command(self, reading: Reading) -> None:
        stamp = self._counts_from(reading.stamp)
        if stamp is None:
            return
        _, force, _, torque, _, _ = reading.values[0]
        limits = self._settings.force_limit, self._settings.torque_limit
        if reading.frame not in ('', 'needle_base'):
            self._refuse(f'wrench_command must be in needle_base, got {reading.frame!r}', stamp)
        # Written so that NaN is refused too.
        elif abs(force) <= limits[0] and abs(torque) <= limits[1]:
            self._take(_Command(stamp, force, torque))
        else:
            self._refuse(
                f'wrench_command must be within {limits[0]:g} N and {limits[1]:g} N m, got '
                f'force.y = {force}, torque.x = {torque}',
                stamp,
            )

    def _take(self, command: _Command) -> None:
        """Let a command act from the next sample on."""
        if self._rivals:
            command = _Command(command.stamp)
        self._newest = command
        if self._pace.awaited is not None:
            self._pace.answered(command.stamp)
            self._on_timer()

    def _refuse(self, complaint: str, stamp: int) -> None:
        """Apply no force instead of a command."""
        self._refused += 1
        self.get_logger().error(f'{complaint}; no force is applied', throttle_duration_sec=1.0)
        self._take(_Command(stamp))

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
                [seconds(point.time_from_start) for point in points],
                [point.positions for point in points],
                [point.effort for point in points],
            )
        except ParameterError as error:
            self._refused += 1
            self.get_logger().error(f'joint_trajectory: {error}')

    # Services.

    def _answer(self, response: Any, what: str, act: Callable[[], str]) -> Any:
        """Do what a service asks for, or say why not."""
        try:
            if self._plant is None or not self.is_active:
                raise JobError('the plant is not active')
            response.message = act()
            response.success = True
        except (JobError, ParameterError) as error:
            response.message = f'{what} refused: {error}'
        self.publish_diagnostics()
        return response

    def _on_tare(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        def tare() -> str:
            if self._plant is not None:
                self._plant.tare()
            return 'the force sensor is zeroed'

        return self._answer(response, 'tare', tare)

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        def pause() -> str:
            if request.data:
                self._pace.pause()
                return f'paused at {self._pace.stamp / NANOSECONDS:.6f} s'
            self._pace.resume(self.now())
            return 'time goes on'

        return self._answer(response, 'pause', pause)

    def _on_step(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        def step() -> str:
            self._sample(self._pace.step(self.now()))
            return f'stepped to {self._pace.stamp / NANOSECONDS:.6f} s'

        return self._answer(response, 'step', step)

    def _on_reset(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        def reset() -> str:
            self._plant = self._make_plant()
            self._held = self._newest = _Command(self._newest.stamp)
            self._halted = None
            self._set_fault({})
            return 'needle and noise are at their start; time goes on'

        return self._answer(response, 'reset', reset)

    # Samples.

    def _on_timer(self) -> None:
        """Take every sample that is due, each stamped with its own time."""
        due = self._pace.due(self.now())
        self._made_up += max(0, due - 1)
        for _ in range(due):
            self._sample(self._pace.take())

    def _on_watch(self) -> None:
        """Look who commands, and ask again for an answer that does not come."""
        commanders = self.count_publishers('wrench_command')
        rivals = max(0, commanders - 1)
        if rivals != self._rivals:
            self._rivals = rivals
            self._newest = _Command(self._newest.stamp)
            if rivals:
                self.get_logger().error(f'{commanders} nodes command; no force is applied')
        self._looks = self._looks + 1 if self._pace.awaited is not None else 0
        if self._looks and self._looks % _REPEAT == 0 and not self._pace.paused:
            self._publish_joints(*self._last_joints)
        self.report_change()

    def _sample(self, stamp: int) -> None:
        plant, held = self._plant, self._held
        if self._clock_topic is not None:
            # Before the sample, so that who answers it has its time.
            self._clock_topic.publish(Clock(clock=_message(stamp)))
        if plant is None or self._halted is not None:
            return
        try:
            sample = plant.advance(held.force, held.torque)
        except NeedleError as error:
            self._halted = str(error)
            self.get_logger().error(f'{error}; the plant stands still')
            self.report_change()
            return
        self._sampled += 1
        self._samples.add(monotonic_ns())
        reading = sample.wrench.tolist()
        for value, limit in zip(reading, self._full_scale, strict=True):
            if abs(value) >= limit:
                self._saturated += 1
        self._pass('base_wrench', stamp, reading, self._publish_wrench)
        if isinstance(sample, Press):
            self._show_press(sample, stamp)
        else:
            self._show_needle(sample, stamp)
        # What is newest now acts until the next sample.
        fresh = stamp - self._newest.stamp <= self._settings.command_timeout * NANOSECONDS
        self._held = self._newest if fresh else _Command(self._newest.stamp)

    def _pass(
        self,
        topic: str,
        stamp: int,
        values: list[float],
        publish: Callable[[int, list[float]], None],
    ) -> None:
        """Publish a measurement, or what a fault makes of it."""
        if self._fault is None or topic != self._faulty:
            publish(stamp, values)
            return
        for at, left in self._fault.leaves(stamp, values, _FAULTY[topic]):
            publish(at, left)

    def _publish_wrench(self, stamp: int, values: list[float]) -> None:
        self._base_wrench.publish(self._wrench.serialize(stamp, *values))

    def _publish_joints(self, stamp: int, values: list[float]) -> None:
        self._joint_states.publish(self._joints.serialize(stamp, *values))

    def _publish_tip(self, stamp: int, values: list[float]) -> None:
        deflection, depth = values
        self._tip_deflection.publish(self._tip.serialize(stamp, 0.0, depth, deflection))

    def _show_needle(self, sample: Sample, stamp: int) -> None:
        state = sample.state.tolist()
        middle = len(state) // 2
        seen = sample.tip
        if seen is not None:
            late = round(seen.age / self._settings.rate * NANOSECONDS)
            self._pass(
                'tip_deflection', stamp - late, [seen.deflection, seen.depth], self._publish_tip
            )
        self._ground_truth.publish(self._truth.serialize(stamp, *state))
        if self._sampled % self._picture == 0:
            self._draw(sample, _message(stamp))
        values = [
            sample.joint_position, state[1], sample.speed, state[middle + 1],
            sample.force, self._held.torque,
        ]  # fmt: skip
        self._last_joints = stamp, values
        # Last: who answers it has the rest of the sample.
        self._pass('joint_states', stamp, values, self._publish_joints)

    def _draw(self, sample: Sample, time: TimeMessage) -> None:
        """Show the shape of the needle, from its base through the entry point to its tip."""
        if not isinstance(self._plant, Plant):
            return
        seen = self._needle_shape.get_subscription_count()
        if not (seen or self._needle_poses.get_subscription_count()):
            return
        model = self._plant.integrator.model
        points = model.shape(sample.state, _POINTS)
        slopes = np.gradient(points[:, 1], points[:, 0])
        outside = model.parameters.length - sample.depth
        shape, poses = self._shape, self._poses
        shape.header.stamp = poses.header.stamp = time
        shape.points = [Point(y=-outside), *(Point(y=y, z=z) for y, z in points.tolist())]
        self._needle_shape.publish(shape)
        poses.poses = []
        for (y, z), slope in zip(points.tolist(), np.arctan(slopes).tolist(), strict=True):
            pose = Pose(position=Point(y=y, z=z))
            # Along the needle is y of the pose.
            pose.orientation.x, pose.orientation.w = sin(0.5 * slope), cos(0.5 * slope)
            poses.poses.append(pose)
        self._needle_poses.publish(poses)

    def _show_press(self, sample: Press, stamp: int) -> None:
        position = self._pose.pose.position
        self._pose.header.stamp = _message(stamp)
        position.x, position.y, position.z = sample.position.tolist()
        self._end_effector_pose.publish(self._pose)

    def diagnose(self) -> tuple[bytes, str, dict[str, object]]:
        """Say where the needle is, how time goes, and what went wrong."""
        if self._plant is None:
            return super().diagnose()
        pace, rate = self._pace, self._settings.rate
        now = monotonic_ns()
        samples, commands = self._samples.rate(now), self._commands.rate(now)
        values: dict[str, object] = {
            **self._plant.report,
            'real-time factor': f'{samples / rate:.3f}',
            'commands per second [Hz]': f'{commands:.1f}',
            'samples made up after stalls': self._made_up,
            'samples given up': pace.lost,
            'waited for the machine [s]': f'{pace.waited / NANOSECONDS:.3f}',
            'commands refused': self._refused,
            'commands too old': self._stale,
            'commands overtaken': self._overtaken,
            'saturated readings': self._saturated,
        }
        if not self.is_active:
            return *super().diagnose()[:2], values
        if self._halted:
            return DiagnosticStatus.ERROR, self._halted, values
        if self._rivals:
            return DiagnosticStatus.ERROR, f'{self._rivals + 1} nodes command', values
        warnings = []
        if pace.paused:
            warnings.append(f'paused at {pace.stamp / NANOSECONDS:.6f} s')
        if self._looks >= _REPEAT:
            warnings.append(f'no command answers the sample of {pace.stamp / NANOSECONDS:.6f} s')
        if pace.lost:
            warnings.append(f'{pace.lost} samples given up after stalls')
        if commands > _TOO_MANY * max(samples, rate):
            warnings.append(f'{commands:.0f} commands come per second for {samples:.0f} samples')
        if self._fault is not None:
            warnings.append(f'{self._faulty} has the fault {self.text("fault.kind")}')
        if warnings:
            return DiagnosticStatus.WARN, '; '.join(warnings), values
        return *super().diagnose()[:2], values


def main() -> int:
    """Run the node; return its exit status."""
    announce_compilation()
    return run(PlantNode)


if __name__ == '__main__':
    sys.exit(main())
