"""Node `plant`: simulated needle, optionally moved by a simulated robot, or simulated indenter."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from functools import partial
import json
from math import ceil
import sys
from time import monotonic_ns
from typing import Any

from builtin_interfaces.msg import Time as TimeMessage
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import Point, Pose, PoseArray, Quaternion, TransformStamped, Vector3
from needle_dynamics.model_node import ModelNode
from needle_dynamics.simulated.assembly import defaults_of, LARGEST_SEED, MODES, SETTINGS
from needle_dynamics.simulated.faults import FaultParameters, FAULTS, FAULTY, SensorFault
from needle_dynamics.simulated.indenter import JOINTS as PRESS_JOINTS
from needle_dynamics.simulated.measured import MeasuredShape
from needle_dynamics.simulated.run import Event, PARAMETERS, PlantRun, RESET, TARE, TRAJECTORY
from needle_ros import contract
from needle_ros.base_node import profile
from needle_ros.errors import JobError, MessageError, NeedleError, ParameterError, printable
from needle_ros.event_log import Severity
from needle_ros.publishers_node import offer_lease, Publishers
from needle_ros.requests import RequestLog, Verdict
from needle_ros.run_node import run
from needle_ros.sample_clock import SampleClock
from needle_ros.status import Diagnosis, PlantPhase, PlantStatus
from needle_ros.timing import NANOSECONDS, nanoseconds, RateCounter, seconds
from needle_ros.trajectories import MOST_POINTS
from needle_ros.wire import Reading
from rcl_interfaces.msg import IntegerRange, ParameterDescriptor
from rclpy.clock import Clock as NodeClock
from rclpy.clock_type import ClockType
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.publisher import Publisher
from rclpy.subscription import Subscription
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Header
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory
from visualization_msgs.msg import Marker

#: Period of the graph checks [s]; number of checks after which an unanswered sample is repeated,
#: and after which the missing answer is reported.
_WATCH = 0.1
_REPEAT, _LONG = 5, 20

#: Commands per sample above which a warning is reported.
_TOO_MANY = 3.0

_NO_FAULT = 'none'

#: Rate of the visualization messages [Hz], and line widths of needle and path [m].
_PICTURES = 30.0
_WIDTH, _PATH_WIDTH = 1e-3, 5e-4


def _moved_joints(mode: str, *, steered: bool) -> tuple[str, ...]:
    """Return the joints that follow trajectories."""
    if mode == 'indenter':
        return PRESS_JOINTS
    insertion = (contract.INSERTION,) if mode == 'robot' else ()
    guide = tuple(joint.name for joint in contract.STEERING_JOINTS) if steered else ()
    return (*insertion, *guide)


def _message(stamp: int) -> TimeMessage:
    return TimeMessage(sec=stamp // NANOSECONDS, nanosec=stamp % NANOSECONDS)


def _line(name: str, width: float, shade: float) -> Marker:
    """Return a line marker in the frame of the entry point."""
    line = Marker(ns=name, type=Marker.LINE_STRIP)
    line.header.frame_id = contract.ENTRY
    line.pose.orientation.w = 1.0
    line.scale.x = width
    line.color.r = line.color.g = line.color.b = shade
    line.color.a = 1.0
    return line


def _transform(seen: MeasuredShape, stamp: int) -> TransformStamped:
    """Return the transform from the base to the tip."""
    (x, y, z), (i, j, k, w) = seen.tip
    made = TransformStamped(child_frame_id=contract.TIP)
    made.header.frame_id, made.header.stamp = contract.BASE, _message(stamp)
    made.transform.translation = Vector3(x=x, y=y, z=z)
    made.transform.rotation = Quaternion(x=i, y=j, z=k, w=w)
    return made


class PlantNode(ModelNode):
    """
    Simulated plant: the needle or the end-effector, with sensors.

    Lengths in m, forces in N, torques in N m, positive into the tissue. In mode `simulation`
    the needle moves under ``wrench_command`` (force.y, torque.x); in mode `robot` the base
    follows ``joint_trajectory`` (joint `insertion`: positions, or efforts for a push). Both
    publish ``joint_states``, ``base_wrench``, ``tip_deflection`` and ``ground_truth``, and for
    visualization ``needle_shape`` and ``needle_poses``. With ``steered`` the needle bends and cuts
    its path, and its guide and roll follow ``joint_trajectory`` in both modes. In mode `indenter`
    the end-effector presses the tissue according to ``joint_trajectory`` (efforts of the joints
    `x` and `z`) and publishes ``base_wrench`` and ``end_effector_pose``. A trajectory starts on
    arrival, or at the activation if it arrived earlier. ``joint_commands`` are sent by a driver of
    ros2_control: efforts in mode `simulation`, positions in mode `robot`. Only one node may
    publish commands, on one of the two topics.

    Samples are taken at exact multiples of the period of simulated time, see `SampleClock`; with
    ``publish_clock`` or ``lockstep`` this time is /clock. `Commands` selects the command that acts
    from one sample to the next. A command carries the stamp of the sample to which it responds;
    with ``lockstep`` the next sample waits for this command, and for all nodes that report
    processed samples, such as `steering`. ``~/pause`` stops time, ``~/step`` takes one sample,
    ``~/reset`` restores the initial state of needle and noise while time continues. ``~/events``
    records every input other than commands, so that the run can be recomputed.
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

    KERNELS = (
        'needle_dynamics.compiled.axis',
        'needle_dynamics.compiled.cut',
        'needle_dynamics.compiled.force_sensor',
        'needle_dynamics.compiled.friction',
        'needle_dynamics.compiled.integrals',
        'needle_dynamics.compiled.normal_modes',
        'needle_dynamics.compiled.step:advance',
    )

    def __init__(self, **node_options: Any) -> None:
        super().__init__('plant', **node_options)
        self.declare_text('mode', MODES[0], f'one of {", ".join(MODES)}')
        self.declare_text('publish_clock', False, 'publish the simulated time on /clock')
        self.declare_text(
            'lockstep',
            False,
            'each sample waits for the command in response to the previous sample, and for all '
            'nodes that process samples',
        )
        self.declare_text('paused', False, 'start with time paused')
        self.declare_text(
            'publish_tf', False, f'publish {contract.TIP} in {contract.BASE} on {contract.TF.name}'
        )
        self.declare_parameter(
            'seed',
            1,
            ParameterDescriptor(
                description='seed of the sensor noise: the same seed gives the same noise',
                integer_range=[IntegerRange(from_value=0, to_value=LARGEST_SEED)],
            ),
        )
        self.declare_text(
            'steered', False, 'the needle bends, cuts its own path, and has a movable guide'
        )
        self.declare_model()
        preset = str(self.get_parameter('model.preset').value)
        for prefix in SETTINGS:
            if prefix != 'model.':
                self.declare_settings(prefix, defaults_of(prefix, preset))
        self.declare_text('fault.kind', _NO_FAULT, f'{_NO_FAULT}, or one of {", ".join(FAULTS)}')
        self.declare_text('fault.topic', 'joint_states', f'one of {", ".join(FAULTY)}')
        self.declare_settings('fault.', FaultParameters())

        self._run: PlantRun | None = None
        #: Number of samples taken before the latest configuration.
        self._number = 0
        self._halted: str | None = None
        self._fault: SensorFault | None = None
        self._faulty = ''
        #: Graph checks during which the same sample has waited for its answers, and its stamp.
        self._looks = 0
        self._awaited: int | None = None
        self._sampled = self._made_up = self._saturated = 0
        self._refused_trajectories = 0
        #: Joints that follow trajectories, and the log of trajectory requests.
        self._moved: tuple[str, ...] = ()
        self._requests = RequestLog({})
        #: On a steady clock.
        self._command_rate, self._sample_rate = RateCounter(), RateCounter()

        offer_lease(self, contract.MEASURER)
        streams = (
            contract.JOINT_STATES, contract.BASE_WRENCH, contract.TIP_DEFLECTION,
            contract.GROUND_TRUTH, contract.END_EFFECTOR_POSE,
        )  # fmt: skip
        self._streams = {topic.name: self.publisher(topic) for topic in streams}
        #: Publish functions for the values of a sample, by topic.
        self._publish: dict[str, Callable[[int, list[float]], None]] = {}
        self._needle_shape = self.publisher(contract.NEEDLE_SHAPE)
        self._needle_poses = self.publisher(contract.NEEDLE_POSES)
        self._events = self.publisher(contract.EVENTS)
        self._clock_topic: Publisher | None = None
        self._tf: Publisher | None = None
        self._commanders = Publishers(self, contract.COMMANDER, self._look_who_commands)
        self._commands = self.listen(
            contract.WRENCH_COMMAND, self._on_command, self._look_who_commands
        )
        self._joint_commands = self.listen(
            contract.JOINT_COMMANDS, self._on_joint_commands, self._look_who_commands
        )
        #: Number of publishers of commands matched by DDS, including stale entries, and time of
        #: change [ns].
        self._matched, self._matched_at = 0, 0
        self._trajectories: Subscription | None = None
        #: Lock-step reports of nodes that have processed or recorded a sample.
        self._reports: list[Subscription] = []
        self.create_service(Trigger, '~/tare', self._on_tare)
        self.create_service(SetBool, '~/pause', self._on_pause)
        self.create_service(Trigger, '~/step', self._on_step)
        self.create_service(Trigger, '~/reset', self._on_reset)

        self._shape = _line('needle', _WIDTH, 0.8)
        self._path = _line('path', _PATH_WIDTH, 0.4)
        self._poses = PoseArray()
        self._poses.header.frame_id = contract.ENTRY

    # Transitions.

    def configure(self) -> None:
        """Build the plant from the parameters."""
        plant_run = PlantRun(self.values(), self._number)
        constants = plant_run.constants
        own, mode = constants.own, constants.mode
        lockstep = bool(self.get_parameter('lockstep').value)
        publishes = lockstep or bool(self.get_parameter('publish_clock').value)
        if publishes and self.get_parameter('use_sim_time').value:
            raise ParameterError(
                f'{"lockstep" if lockstep else "publish_clock"} and use_sim_time cannot both be '
                'true: the plant would follow its own /clock'
            )
        if lockstep and mode != 'simulation':
            raise ParameterError(
                'lockstep must be false except in mode simulation, where commands answer samples, '
                f'got mode {mode!r}'
            )
        if mode == 'simulation' and own.command_timeout < 1.0 / own.rate:
            raise ParameterError(
                f'command_timeout must be at least a period, {1.0 / own.rate:g} s, got '
                f'{own.command_timeout:g} s'
            )
        real_time = not publishes and own.real_time_factor == 1.0
        if mode == 'simulation' and real_time and own.backlog > 0.5 * own.command_timeout:
            raise ParameterError(
                f'backlog must be at most half of command_timeout, {own.command_timeout:g} s, got '
                f'{own.backlog:g} s: an overloaded plant would send samples that are too old to '
                'answer'
            )
        self._time = SampleClock(
            own.rate, own.real_time_factor, own.backlog, own=publishes, lockstep=lockstep
        )
        self._set_fault({})
        # Load or compile functions before the first sample.
        constants.make().take(0.0, 0.0)
        self._publish = {
            name: partial(self._write, self._streams[name], topic.template().serialize)
            for name, topic in plant_run.topics.items()
        }
        limits = constants.sensor.per_axis('range').tolist()
        # Rounding to counts may leave a saturated reading just below the limit.
        self._full_scale = [limit * (1.0 - 1e-9) for limit in limits]
        self._period = NANOSECONDS / own.rate
        #: Stamps of the latest samples, for measurements that are published with a delay.
        self._stamps: deque[int] = deque(maxlen=ceil(constants.tip.delay * own.rate) + 1)
        self._patience = 0.25 * own.backlog * NANOSECONDS
        self._exhausted = (
            f'commands supplied more than {own.power_limit:g} J within a second (power_limit); '
            'no force is applied until the energy is half of this'
        )
        if self.get_parameter('publish_tf').value:
            self._tf = self._offer_tf(mode)
        self._run = plant_run
        if publishes:
            self._clock_topic = self.publisher(contract.CLOCK, always=True)
        if lockstep:
            self._reports.append(
                self._hear(contract.PROCESSED, self._on_processed, self._on_participant)
            )
        if publishes or own.real_time_factor != 1.0:
            # With simulated time, the plant waits for recorders.
            self._reports.append(
                self._hear(contract.RECORDED, self._on_recorded, self._on_recorder)
            )
        if mode != 'simulation' or constants.steered:
            # In mode `simulation`, `insertion` is the reference of a controller.
            self._trajectories = self.subscribe(contract.JOINT_TRAJECTORY, self._on_trajectory)
            self._moved = _moved_joints(mode, steered=constants.steered)
            self._requests = RequestLog({contract.JOINT_TRAJECTORY: self._moved})

    def _offer_tf(self, mode: str) -> Publisher:
        """Create the publisher of transforms, or raise ParameterError if that is not possible."""
        try:
            if mode == 'indenter':
                raise MessageError('there is no needle in mode indenter')
            return self.publisher(contract.TF)
        except MessageError as error:
            raise ParameterError(f'publish_tf must be false: {error}') from error

    @staticmethod
    def _write(
        publisher: Publisher,
        serialize: Callable[..., bytes],
        stamp: int,
        values: list[float],
    ) -> None:
        publisher.publish(serialize(stamp, *values))

    def cleanup(self) -> None:
        """Discard the plant."""
        if self._run is not None:
            self._number = self._run.number
        self._run = None
        if self._clock_topic is not None:
            self.destroy_publisher(self._clock_topic)
            self._clock_topic = None
        if self._tf is not None:
            self.destroy_publisher(self._tf)
            self._tf = None
        if self._trajectories is not None:
            self.destroy_subscription(self._trajectories)
            self._trajectories, self._moved, self._requests = None, (), RequestLog({})
        for report in self._reports:
            self.destroy_subscription(report)
        self._reports = []

    def change(self, changes: Mapping[str, Any]) -> None:
        """Apply changed friction or fault parameters; the state is kept."""
        if self._run is not None:
            self._run.perform(Event(PARAMETERS, changes))
        if any(name.startswith('fault.') for name in changes):
            self._set_fault(changes)

    def _set_fault(self, changes: Mapping[str, Any]) -> None:
        """Set the fault of the measurements from the parameters."""
        kind = self.text('fault.kind', (_NO_FAULT, *FAULTS), changes)
        topic = self.text('fault.topic', tuple(FAULTY), changes)
        parameters = self.settings('fault.', FaultParameters, changes)
        self._fault, self._faulty = None, topic
        if kind != _NO_FAULT:
            rate, seed = self.get_parameter('rate').value, self.get_parameter('seed').value
            self._fault = SensorFault(kind, parameters, float(rate), seed)

    def activate(self) -> None:
        """Start sampling."""
        if self._run is None:
            return
        self._halted = None
        self._sampled = self._made_up = self._saturated = 0
        self._run.begin()
        self._look_who_commands()
        own = self._run.constants.own
        #: Samples between two visualization messages.
        self._picture = max(1, round(own.rate * max(1.0, own.real_time_factor) / _PICTURES))
        self._time.begin(self.now(), paused=bool(self.get_parameter('paused').value))
        self._timer = self.create_timer(self._time.tick, self._on_timer)
        steady = NodeClock(clock_type=ClockType.STEADY_TIME)
        self._watch = self.create_timer(_WATCH, self._on_watch, clock=steady)

    def about(self) -> str:
        """Describe mode, constants, rate and topics."""
        values = self.values()
        takes = [contract.JOINT_TRAJECTORY.name] if self._trajectories else []
        if values['mode'] == 'simulation':
            takes.append(contract.WRENCH_COMMAND.name)
        if values['mode'] != 'indenter':
            takes.append(contract.JOINT_COMMANDS.name)
        steered = ', steered' if values['steered'] else ''
        return (
            f'mode {values["mode"]}{steered}, preset {values["model.preset"]}, '
            f'{values["rate"]:g} Hz; takes {" and ".join(takes)}, publishes '
            f'{", ".join(self._publish)}'
        )

    def deactivate(self) -> None:
        """Stop sampling."""
        self.destroy_timer(self._timer)
        self.destroy_timer(self._watch)

    # Commands.

    def _on_command(self, reading: Reading) -> None:
        def offer(plant_run: PlantRun, now: int) -> tuple[bool, str]:
            _, force, _, torque, _, _ = reading.values[0]
            return plant_run.commands.offer(reading.stamp, reading.frame, force, torque, now)

        self._take_command(offer)

    def _on_joint_commands(self, reading: Reading) -> None:
        self._take_command(lambda plant_run, now: plant_run.command_joints(reading, now))

    def _take_command(self, offer: Callable[[PlantRun, int], tuple[bool, str]]) -> None:
        """Handle a command from either topic."""
        plant_run = self._run
        if plant_run is None or not self.is_active:
            return
        self._command_rate.add(monotonic_ns())
        if sum(self._count_matched()) != self._matched:
            # The match event may be pending: no command of a second node may act.
            self._look_who_commands()
        counts, complaint = offer(plant_run, self._time.simulated(self.now()))
        if complaint:
            self.get_logger().error(printable(complaint), throttle_duration_sec=1.0)
        if counts and self._time.awaited is not None:
            self._time.answered(plant_run.commands.newest.stamp)
            self._on_timer()

    def _hear(
        self, topic: contract.Topic, take: Callable[[Header], None], matched: Callable[[Any], None]
    ) -> Subscription:
        """Subscribe to reports."""
        return self.create_subscription(
            Header,
            topic.name,
            take,
            profile(topic.qos),
            event_callbacks=SubscriptionEventCallbacks(matched=matched),
        )

    def _on_processed(self, message: Header) -> None:
        """Record that a node has processed a sample."""
        if self.is_active:
            self._time.answered(nanoseconds(message.stamp), message.frame_id)
            self._on_timer()

    def _on_participant(self, event: Any) -> None:
        """Count the nodes for which each sample waits."""
        self._time.participants = event.current_count
        self.publish_diagnostics()

    def _on_recorded(self, message: Header) -> None:
        """Record the newest sample of a recorder."""
        recorded, stamp = self._time.recorded, nanoseconds(message.stamp)
        before = len(recorded)
        recorded[message.frame_id] = stamp
        if not stamp:
            # A zero stamp marks the end of the recording.
            del recorded[message.frame_id]
        if len(recorded) != before:
            self.publish_diagnostics()
        if self.is_active:
            self._on_timer()

    def _on_recorder(self, event: Any) -> None:
        """Discard the recorder list when a recorder disappears; the others report again."""
        if event.current_count_change < 0:
            self._time.recorded.clear()

    def _count_matched(self) -> tuple[int, int]:
        """Return the DDS-matched publishers of each command topic, including stale entries."""
        return self._commands.get_publisher_count(), self._joint_commands.get_publisher_count()

    def _on_trajectory(self, message: JointTrajectory) -> None:
        """Execute a trajectory if it is new and valid, and acknowledge it."""
        stamp = nanoseconds(message.header.stamp)
        # In mode `simulation`, `insertion` is addressed to the controller.
        moved = [name for name in message.joint_names if name in self._moved]
        now = self._time.simulated(self.now()) if self.is_active else stamp
        known = self._requests.check(contract.JOINT_TRAJECTORY, stamp, now, '', moved)
        if known is not None:
            if known.verdict is Verdict.REJECTED:
                self._reject(known.reason)
        else:
            verdict, reason = Verdict.ACCEPTED, ''
            try:
                self._follow(message)
            except ParameterError as error:
                verdict, reason = Verdict.REJECTED, str(error)
                self._reject(reason)
            self._requests.answer(contract.JOINT_TRAJECTORY, stamp, verdict, reason, moved)
        self._publish_answers()

    def _follow(self, message: JointTrajectory) -> None:
        if self._run is None:
            raise ParameterError('the plant is not configured')
        points = message.points[: MOST_POINTS + 1]
        if len(points) > MOST_POINTS:
            raise ParameterError(f'a path may have at most {MOST_POINTS} points')
        content = {
            'joints': list(message.joint_names),
            'times': [seconds(point.time_from_start) for point in points],
            'positions': [list(point.positions) for point in points],
            'efforts': [list(point.effort) for point in points],
        }
        self._run.perform(Event(TRAJECTORY, content))

    def _reject(self, reason: str) -> None:
        self._refused_trajectories += 1
        self.get_logger().error(
            printable(f'joint_trajectory rejected: {reason}'), throttle_duration_sec=1.0
        )

    def _publish_answers(self) -> None:
        """Publish the status if it lacks results of requests."""
        if self._requests.due():
            self.publish_diagnostics()

    # Services.

    def _answer(self, response: Any, what: str, act: Callable[[PlantRun], str]) -> Any:
        """Execute a service request, or report the reason for its rejection."""
        try:
            if self._run is None or not self.is_active:
                raise JobError('the plant is not active')
            response.message = act(self._run)
            response.success = True
        except (JobError, ParameterError) as error:
            response.message = f'{what} refused: {error}'
        self.publish_diagnostics()
        return response

    def _on_tare(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        def tare(plant_run: PlantRun) -> str:
            plant_run.perform(Event(TARE))
            return 'the force sensor is zeroed'

        return self._answer(response, 'tare', tare)

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        def pause(_run: PlantRun) -> str:
            if request.data:
                self._time.pause()
                return f'paused at {self._time.stamp / NANOSECONDS:.6f} s'
            self._time.resume(self.now())
            return 'time resumed'

        return self._answer(response, 'pause', pause)

    def _on_step(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        def step(_run: PlantRun) -> str:
            self._sample(self._time.step(self.now()))
            return f'stepped to {self._time.stamp / NANOSECONDS:.6f} s'

        return self._answer(response, 'step', step)

    def _on_reset(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        def reset(plant_run: PlantRun) -> str:
            plant_run.perform(Event(RESET))
            self._requests.supersede(self._time.simulated(self.now()))
            self._halted = None
            self._set_fault({})
            return 'needle and noise reset; time continues'

        return self._answer(response, 'reset', reset)

    # Samples.

    def _on_timer(self) -> None:
        """Take all due samples, each stamped with its own time."""
        due = self._time.due(self.now())
        self._made_up += max(0, due - 1)
        end = monotonic_ns() + self._patience
        for _ in range(due):
            self._sample(self._time.take())
            if monotonic_ns() > end:
                # Commands are waiting: they must not become too old on an overloaded machine.
                break

    def _on_watch(self) -> None:
        """Check for command publishers, and repeat a sample that is not answered."""
        if self._run is None:
            return
        self._look_who_commands()
        self._publish_answers()
        awaited, before = self._time.awaited, self._awaited
        self._looks = self._looks + 1 if awaited is not None and awaited == before else 0
        self._awaited = awaited
        if self._looks and self._looks % _REPEAT == 0 and not self._time.paused:
            stamp, (topic, _, values) = self._last
            if self._clock_topic is not None:
                # An older clock message may have arrived late: the sample would be ahead of time.
                self._clock_topic.publish(Clock(clock=_message(stamp)))
            self._publish[topic](stamp, values)
        self.report_change()

    def _look_who_commands(self, came: int = 0) -> None:
        """Count the command publishers; no force acts while there are several."""
        matched, now = sum(self._count_matched()), monotonic_ns()
        before, several = self._matched, max(self._matched, matched) > 1
        if matched != before:
            self._matched, self._matched_at = matched, now
        if self._run is None:
            return
        # A publisher may have appeared and disappeared while this process was blocked.
        if (several and matched != before) or (before and came):
            self._run.commands.hush(self._time.simulated(self.now()))
        # DDS may count a short-lived publisher forever; after a second the graph is reliable.
        fresh = now - self._matched_at < NANOSECONDS
        wrenches, joints = self._count_matched() if fresh else (0, 0)
        # A driver has no lease: it counts while it is in the graph.
        drivers = self.get_publishers_info_by_topic(contract.JOINT_COMMANDS.name)
        count = self._commanders.count(contract.WRENCH_COMMAND, wrenches)
        count += max(len(drivers), joints)
        if self._run.commands.count_commanders(count):
            if self._run.commands.duplicates:
                self.get_logger().error(
                    f'{count} nodes command; no force is applied', throttle_duration_sec=1.0
                )
            self.report_change()

    def _sample(self, stamp: int) -> None:
        """Take a sample and publish it."""
        plant_run = self._run
        if self._clock_topic is not None:
            # Published before the sample, so that subscribers have the time of the sample.
            self._clock_topic.publish(Clock(clock=_message(stamp)))
        if plant_run is None or self._halted is not None:
            return
        was_exhausted = plant_run.commands.exhausted
        try:
            measured = plant_run.take(stamp)
        except NeedleError as error:
            self._halted = str(error)
            self.get_logger().error(f'{error}; the plant has stopped')
            self.report_change()
            return
        self._sampled += 1
        self._sample_rate.add(monotonic_ns())
        if plant_run.commands.exhausted and not was_exhausted:
            self.get_logger().error(self._exhausted, throttle_duration_sec=1.0)
        events = plant_run.events()
        if events:
            self._tell(events, stamp, plant_run.number)
        for value, limit in zip(measured[0][2], self._full_scale, strict=True):
            if abs(value) >= limit:
                self._saturated += 1
        if self._sampled % self._picture == 0:
            self._draw(plant_run, stamp)
        self._last = stamp, measured[-1]
        fault, faulty, publish = self._fault, self._faulty, self._publish
        stamps = self._stamps
        stamps.append(stamp)
        for topic, age, values in measured:
            # Own stamp, even after a time jump: samples are skipped after a stall.
            at = stamps[-1 - age] if age < len(stamps) else stamp - round(age * self._period)
            if fault is None or topic != faulty:
                publish[topic](at, values)
            else:
                for late, left in fault.leaves(at, values, FAULTY[topic]):
                    publish[topic](late, left)

    def _tell(self, events: list[Event], stamp: int, number: int) -> None:
        """Publish events with the number of the first sample that they affect."""
        array = DiagnosticArray()
        array.header.stamp = _message(stamp)
        for kind, content in events:
            values = {'sample': number, **content}
            array.status.append(
                DiagnosticStatus(
                    name=self.get_fully_qualified_name(),
                    message=kind,
                    values=[
                        KeyValue(key=key, value=json.dumps(value)) for key, value in values.items()
                    ],
                )
            )
        self._events.publish(array)

    def _draw(self, plant_run: PlantRun, stamp: int) -> None:
        """Publish the shape of the needle from base to tip, and the path that it cut."""
        lines = self._needle_shape.get_subscription_count()
        poses = self._needle_poses.get_subscription_count()
        wanted = lines or poses or self._tf is not None
        seen = plant_run.plant.outline() if wanted else None
        if seen is None:
            return
        if self._tf is not None:
            kind: Any = self._tf.msg_type
            self._tf.publish(kind(transforms=[_transform(seen, stamp)]))
        if lines:
            self._draw_line(self._shape, [seen.base.tolist(), *seen.points.tolist()], stamp)
            if len(seen.path):
                self._draw_line(self._path, seen.path.tolist(), stamp)
        if poses:
            self._poses.header.stamp = _message(stamp)
            self._poses.poses = [
                Pose(position=Point(x=x, y=y, z=z), orientation=Quaternion(x=i, y=j, z=k, w=w))
                for (x, y, z), (i, j, k, w) in zip(
                    seen.points.tolist(), seen.turns.tolist(), strict=True
                )
            ]
            self._needle_poses.publish(self._poses)

    def _draw_line(self, line: Marker, points: list[list[float]], stamp: int) -> None:
        line.header.stamp = _message(stamp)
        line.points = [Point(x=x, y=y, z=z) for x, y, z in points]
        self._needle_shape.publish(line)

    @property
    def _phase(self) -> PlantPhase:
        if not self.is_active:
            return PlantPhase.INACTIVE
        if self._halted:
            return PlantPhase.HALTED
        return PlantPhase.PAUSED if self._time.paused else PlantPhase.RUNNING

    def _status(self, plant_run: PlantRun) -> PlantStatus:
        clock, given, now = self._time, plant_run.commands, monotonic_ns()
        late = self._looks >= _LONG
        return replace(
            plant_run.plant.report,
            phase=self._phase,
            halt=self._halted or '',
            time=clock.stamp / NANOSECONDS,
            real_time_factor=self._sample_rate.rate(now) / plant_run.constants.own.rate,
            command_rate=self._command_rate.rate(now),
            commanders=given.duplicates + 1 if given.duplicates else 0,
            exhausted=given.exhausted,
            computed_later=self._made_up,
            skipped=clock.lost,
            waited=clock.waited / NANOSECONDS,
            awaited=clock.missing if late else '',
            rejected=given.refused + self._refused_trajectories,
            stale=given.stale,
            superseded=given.overtaken,
            saturated=self._saturated,
            sensor_fault='' if self._fault is None else self.text('fault.kind'),
            faulty_topic='' if self._fault is None else self._faulty,
            lockstep_nodes=clock.participants + len(clock.recorded),
            requests=self._requests.status(),
        )

    def diagnose(self) -> Diagnosis[PlantStatus]:
        """Report needle state, timing and errors."""
        if self._run is None:
            return Diagnosis(Severity.INFO, self.state, PlantStatus())
        status = self._status(self._run)
        rate, commands = self._run.constants.own.rate, status.command_rate
        samples = status.real_time_factor * rate
        if status.phase is PlantPhase.INACTIVE:
            return Diagnosis(Severity.INFO, self.state, status)
        if self._halted:
            return Diagnosis(Severity.ERROR, self._halted, status)
        if status.commanders:
            return Diagnosis(Severity.ERROR, f'{status.commanders} nodes command', status)
        if status.exhausted:
            return Diagnosis(Severity.ERROR, self._exhausted, status)
        warnings = []
        if status.phase is PlantPhase.PAUSED:
            warnings.append(f'paused at {status.time:.6f} s')
        if status.awaited:
            warnings.append(f'{status.awaited} the sample of {status.time:.6f} s')
        if status.skipped:
            warnings.append(f'{status.skipped} samples skipped after stalls')
        if commands > _TOO_MANY * max(samples, rate):
            warnings.append(f'{commands:.0f} commands per second for {samples:.0f} samples')
        if status.sensor_fault:
            warnings.append(f'{status.faulty_topic} has the fault {status.sensor_fault}')
        severity = Severity.WARNING if warnings else Severity.INFO
        return Diagnosis(severity, '; '.join(warnings) or self.state, status)


def main() -> int:
    """Run the node; return its exit status."""
    return run(PlantNode)


if __name__ == '__main__':
    sys.exit(main())
