# SPDX-License-Identifier: Apache-2.0
"""Outputs of the node `plant`: samples with sensor faults, displays, reports on samples."""

from collections import deque
from collections.abc import Callable
from functools import partial
import json
from math import ceil
from time import monotonic_ns
from typing import Any, Final

from builtin_interfaces.msg import Time as TimeMessage
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import Point, Pose, PoseArray, Quaternion, TransformStamped, Vector3
from needle_dynamics.simulated.faults import FAULTY, SensorFault
from needle_dynamics.simulated.plant import MeasuredShape, Measurement, SimulatedPlant
from needle_dynamics.simulated.run import Event, PlantRun
from needle_ros import contract
from needle_ros.base_node import BaseNode, profile
from needle_ros.errors import MessageError, ParameterError
from needle_ros.sample_clock import SampleClock
from needle_ros.timing import NANOSECONDS, nanoseconds, RateCounter
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.publisher import Publisher
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Header
from visualization_msgs.msg import Marker

#: Line widths of needle and path [m].
_WIDTH: Final = 1e-3
_PATH_WIDTH: Final = 5e-4

_RATE: Final = 30.0  #: rate of the messages [Hz]


def time_message(stamp: int) -> TimeMessage:
    return TimeMessage(sec=stamp // NANOSECONDS, nanosec=stamp % NANOSECONDS)


def _line(name: str, width: float, shade: float) -> Marker:
    line = Marker(ns=name, type=Marker.LINE_STRIP)
    line.pose.orientation.w = 1.0
    line.scale.x = width
    line.color.r = line.color.g = line.color.b = shade
    line.color.a = 1.0
    return line


def _transform(shape: MeasuredShape, stamp: int, prefix: str) -> TransformStamped:
    (x, y, z), (i, j, k, w) = shape.tip
    made = TransformStamped(child_frame_id=prefix + contract.TIP)
    made.header.frame_id, made.header.stamp = prefix + contract.BASE, time_message(stamp)
    made.transform.translation = Vector3(x=x, y=y, z=z)
    made.transform.rotation = Quaternion(x=i, y=j, z=k, w=w)
    return made


class PlantDisplay:
    """Publishers for displays: ``needle_shape``, ``needle_poses`` and `/tf`."""

    def __init__(self, node: BaseNode) -> None:
        self._node = node
        self._needle_shape = node.publisher(contract.NEEDLE_SHAPE)
        self._needle_poses = node.publisher(contract.NEEDLE_POSES)
        self._tf: Publisher | None = None
        self._shape = _line('needle', _WIDTH, 0.8)
        self._path = _line('path', _PATH_WIDTH, 0.4)
        self._poses = PoseArray()
        self._prefix = ''

    def begin(self, rate: float) -> None:
        """Restart the count of samples, of which there are ``rate`` per second [Hz]."""
        self._samples, self._every = 0, max(1, round(rate / _RATE))

    def use_frames(self, prefix: str) -> None:
        """Set the prefix of all frames, or raise ParameterError."""
        if prefix.startswith('/'):
            raise ParameterError(f'frame_prefix must not begin with a slash, got {prefix!r}')
        self._prefix = prefix
        for drawn in (self._shape, self._path, self._poses):
            drawn.header.frame_id = prefix + contract.ENTRY

    def offer_transform(self, mode: str) -> None:
        """Create the publisher of transforms, or raise ParameterError if that is not possible."""
        try:
            if mode == 'indenter':
                raise MessageError('there is no needle in mode indenter')
            self._tf = self._node.publisher(contract.TF)
        except MessageError as error:
            raise ParameterError(f'publish_tf must be false: {error}') from error

    def publish(self, plant: SimulatedPlant, stamp: int) -> None:
        """Publish the shape of the needle from base to tip, and the path that it cut, if due."""
        self._samples += 1
        if self._samples % self._every:
            return
        lines = self._needle_shape.get_subscription_count()
        poses = self._needle_poses.get_subscription_count()
        wanted = lines or poses or self._tf is not None
        shape = plant.outline() if wanted else None
        if shape is None:
            return
        if self._tf is not None:
            kind: Any = self._tf.msg_type
            self._tf.publish(kind(transforms=[_transform(shape, stamp, self._prefix)]))
        if lines:
            self._publish_line(self._shape, [shape.base.tolist(), *shape.points.tolist()], stamp)
            if len(shape.path):
                self._publish_line(self._path, shape.path.tolist(), stamp)
        if poses:
            self._poses.header.stamp = time_message(stamp)
            self._poses.poses = [
                Pose(position=Point(x=x, y=y, z=z), orientation=Quaternion(x=i, y=j, z=k, w=w))
                for (x, y, z), (i, j, k, w) in zip(
                    shape.points.tolist(), shape.turns.tolist(), strict=True
                )
            ]
            self._needle_poses.publish(self._poses)

    def _publish_line(self, line: Marker, points: list[list[float]], stamp: int) -> None:
        line.header.stamp = time_message(stamp)
        line.points = [Point(x=x, y=y, z=z) for x, y, z in points]
        self._needle_shape.publish(line)


class SamplePublishers:
    """Publishers of all measurements, with a fault; ``saturated`` counts saturated forces."""

    def __init__(self, node: BaseNode, plant_run: PlantRun) -> None:
        streams = (
            contract.JOINT_STATES, contract.BASE_WRENCH, contract.TIP_DEFLECTION,
            contract.GROUND_TRUTH, contract.END_EFFECTOR_POSE,
        )  # fmt: skip
        writers = {topic.name: node.writer(topic) for topic in streams}
        self._events = node.publisher(contract.EVENTS)
        self._clock: Publisher | None = None
        self._node = node
        #: Fault, and topic of the sensor with the fault.
        self.fault: SensorFault | None = None
        self.faulty = ''
        self.saturated = 0
        #: On a steady clock.
        self.rate = RateCounter()
        constants = plant_run.constants
        rate = constants.own.rate
        #: Publish functions for the values of a sample, by topic.
        self._publish: dict[str, Callable[[int, list[float]], None]] = {
            name: partial(_write, writers[name], topic.template().serialize)
            for name, topic in plant_run.topics.items()
        }
        limits = constants.sensor.per_axis('range').tolist()
        # Rounding to counts may leave a saturated reading just below the limit.
        self._full_scale = [limit * (1.0 - 1e-9) for limit in limits]
        self._period = NANOSECONDS / rate
        #: Stamps of the latest samples, for measurements that are published with a delay.
        self._stamps: deque[int] = deque(maxlen=ceil(constants.tip.delay * rate) + 1)

    def offer_clock(self) -> None:
        self._clock = self._node.publisher(contract.CLOCK, always=True)

    @property
    def other_clock(self) -> str:
        """Name of another node that publishes the same time; empty without one."""
        if self._clock is None:
            return ''
        # Not this plant before a restart, which stays in the graph for 20 s.
        own = self._node.get_fully_qualified_name()
        publishers = self._node.get_publishers_info_by_topic(contract.CLOCK.name)
        names = (f'{one.node_namespace.rstrip("/")}/{one.node_name}' for one in publishers)
        return next((name for name in names if name != own), '')

    @property
    def topics(self) -> tuple[str, ...]:
        return tuple(self._publish)

    def begin(self) -> None:
        """Restart the count of saturated values of the force sensor."""
        self.saturated = 0

    def publish_clock(self, stamp: int) -> None:
        """Publish the time, before its sample: subscribers then have the time of the sample."""
        if self._clock is not None:
            self._clock.publish(Clock(clock=time_message(stamp)))

    def publish(self, stamp: int, measured: list[Measurement]) -> None:
        self.rate.add(monotonic_ns())
        for value, limit in zip(measured[0][2], self._full_scale, strict=True):
            if abs(value) >= limit:
                self.saturated += 1
        self._last = stamp, measured[-1]
        fault, faulty, publish = self.fault, self.faulty, self._publish
        stamps = self._stamps
        stamps.append(stamp)
        for topic, age, values in measured:
            # Own stamp, even after a time jump: samples are skipped after a stall.
            at = stamps[-1 - age] if age < len(stamps) else stamp - round(age * self._period)
            if fault is None or topic != faulty:
                publish[topic](at, values)
            else:
                for late, left in fault.apply(at, values, FAULTY[topic]):
                    publish[topic](late, left)

    def repeat(self) -> None:
        """Publish the newest `joint_states` again."""
        stamp, (topic, _, values) = self._last
        # An older clock message may have arrived late: the sample would be ahead of time.
        self.publish_clock(stamp)
        self._publish[topic](stamp, values)

    def publish_events(self, events: list[Event], stamp: int, number: int) -> None:
        """Publish events with the number of the first sample that they affect."""
        array = DiagnosticArray()
        array.header.stamp = time_message(stamp)
        for kind, content in events:
            values = {'sample': number, **content}
            array.status.append(
                DiagnosticStatus(
                    name=self._node.get_fully_qualified_name(),
                    message=kind,
                    values=[
                        KeyValue(key=key, value=json.dumps(value)) for key, value in values.items()
                    ],
                )
            )
        self._events.publish(array)


def _write(
    write: Callable[[bytes], None],
    serialize: Callable[..., bytes],
    stamp: int,
    values: list[float],
) -> None:
    write(serialize(stamp, *values))


class SampleReports:
    """Pass reports to a clock; ``checks`` counts the checks at which the same sample waited."""

    def __init__(
        self,
        node: BaseNode,
        advance: Callable[[], None],
        clock: SampleClock,
        *,
        processed: bool,
        recorded: bool,
    ) -> None:
        self._node, self._advance, self._clock = node, advance, clock
        self.checks = 0
        self._awaited: int | None = None
        if processed:
            self._subscribe(contract.PROCESSED, self._on_processed, self._on_participant)
        if recorded:
            self._subscribe(contract.RECORDED, self._on_recorded, self._on_recorder)

    def check(self) -> None:
        """Count the checks of the sample that waits for its answers."""
        awaited, before = self._clock.awaited, self._awaited
        self.checks = self.checks + 1 if awaited is not None and awaited == before else 0
        self._awaited = awaited

    def _subscribe(
        self, topic: contract.Topic, take: Callable[[Header], None], matched: Callable[[Any], None]
    ) -> None:
        events = SubscriptionEventCallbacks(matched=matched)
        self._node.create_subscription(
            Header, topic.name, take, profile(topic.qos), event_callbacks=events
        )

    def _on_processed(self, message: Header) -> None:
        if self._node.is_active:
            self._clock.answered(nanoseconds(message.stamp), message.frame_id)
            self._advance()

    def _on_participant(self, event: Any) -> None:
        self._clock.participants = event.current_count
        self._node.publish_diagnostics()

    def _on_recorded(self, message: Header) -> None:
        if self._clock.record(message.frame_id, nanoseconds(message.stamp)):
            self._node.publish_diagnostics()
        if self._node.is_active:
            self._advance()

    def _on_recorder(self, event: Any) -> None:
        """Discard the recorder list when a recorder disappears; the others report again."""
        if event.current_count_change < 0:
            self._clock.recorded.clear()
