# SPDX-License-Identifier: Apache-2.0
"""Publishers of the node `plant` for its samples and events, with injected sensor faults."""

from collections import deque
from collections.abc import Callable
from functools import partial
import json
from math import ceil
from time import monotonic_ns

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from needle_dynamics.plant_display_node import time_message
from needle_dynamics.simulated.faults import FAULTY, SensorFault
from needle_dynamics.simulated.measured import Measurement
from needle_dynamics.simulated.run import Event, PlantRun
from needle_ros import contract
from needle_ros.base_node import BaseNode
from needle_ros.timing import NANOSECONDS, RateCounter
from rclpy.publisher import Publisher
from rosgraph_msgs.msg import Clock


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
