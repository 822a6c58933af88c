# SPDX-License-Identifier: Apache-2.0
"""Node that records topics to an MCAP bag with the QoS that their publishers offer."""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
import sys
import time
from typing import Any, Final, NamedTuple

from needle_identification.bags.topics import DURATIONS, OfferedQos, WORDS
from needle_identification.bags.writer import BagWriter, COMPRESSIONS, described
from needle_identification.errors import RecordingError
from needle_ros.base_node import BaseNode, message_class, messages_of, steady_timer
from needle_ros.contract import BASE_WRENCH, JOINT_STATES, RECORDED, TOPICS
from needle_ros.errors import MessageError
from needle_ros.event_log import Severity
from needle_ros.run_node import run
from needle_ros.status import Diagnosis, RecorderStatus
from needle_ros.timing import set_time
from needle_ros.wire import MessageReader
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from rclpy.topic_endpoint_info import TopicEndpointInfo
from std_msgs.msg import Header
from std_srvs.srv import Trigger

_DISCOVERY_PERIOD: Final = 0.1  # period of topic discovery [s]
_FLUSH_PERIOD: Final = 0.5  # period of flushes to the disk [s]
_TAKE_PERIOD: Final = 0.005  # period of taking received messages [s]
_DEPTH: Final = 5000  # queue length of a topic
_AT_ONCE: Final = 1000  # largest number of its messages that are taken at once

#: Last parts of the names of topics that are recorded best effort: retransmission would increase
#: the CPU load of the plant by a third.
_LOSSY: Final = {topic.name.rpartition('/')[2] for topic in TOPICS if topic.qos.lossy}

_NOT_FOR_ALL: Final = ('/rosout', '/parameter_events')  # not included in *


class _Recorded(NamedTuple):
    """Subscription of a topic, its requested QoS, and the QoS that its publishers have offered."""

    kind: type
    subscription: Subscription
    best_effort: bool
    latched: bool
    offered: dict[tuple[int, ...], OfferedQos]


class RecorderNode(BaseNode):
    """
    Records topics while active, each with the QoS that its publishers offer.

    Measurements are subscribed to best effort, as in all nodes of the suite. Messages are stored
    byte for byte with their receive time. A second recording of the same node (``~/stop``,
    ``~/start``) is written to ``path`` with ``_2`` appended.
    """

    def __init__(self, **node_options: Any) -> None:
        super().__init__('recorder', **node_options)
        self.declare_text('path', '', 'folder to record to; it must not exist')
        self.declare_text('topics', ['*'], 'topics to record; * selects all except hidden topics')
        self.declare_text('compression', 'zstd', valid=COMPRESSIONS)
        self._bag: BagWriter | None = None
        self._recordings = 0
        #: Summary of the latest recording.
        self._result = 'not recording'
        self._recorded: dict[str, _Recorded] = {}
        self._left_out: set[str] = set()
        #: Stamp of the newest recorded sample [ns]; a plant may wait for it.
        self._recorded_stamp = 0
        #: Readers of the topics that contain each sample.
        self._sampled = {
            self.resolve_topic_name(topic.name): MessageReader(topic.type_name).read
            for topic in (JOINT_STATES, BASE_WRENCH)
        }
        #: Publication sequence number of the newest message of each topic.
        self._newest: dict[str, int] = {}

    def configure(self) -> None:
        path = self.text('path')
        if not path:
            raise RecordingError('path must name a folder to record to, got nothing')
        self._path = Path(path).expanduser()
        self._compression = self.text('compression', COMPRESSIONS)
        names = self.get_parameter('topics').value
        self._all = '*' in names
        self._names = {self.resolve_topic_name(name) for name in names if name != '*'}
        self._reports = self.publisher(RECORDED, always=True)
        self.create_service(Trigger, '~/start', self._on_start)
        self.create_service(Trigger, '~/stop', self._on_stop)
        # The timers must run while the simulation time is paused.
        steady_timer(self, _DISCOVERY_PERIOD, self._discover)
        steady_timer(self, _FLUSH_PERIOD, self._flush)
        # The timers of ROS 2 Kilted pass an argument to a callback that accepts one.
        steady_timer(self, _TAKE_PERIOD, partial(self._take, _AT_ONCE))

    def cleanup(self) -> None:
        """Complete the bag after an error; otherwise it is complete already."""
        if self._bag is not None:
            self._end(self._bag)

    def deactivate(self) -> None:
        self.cleanup()

    def diagnose(self) -> Diagnosis[RecorderStatus]:
        if self._bag is None:
            return Diagnosis(Severity.INFO, 'not recording', RecorderStatus())
        path, size = str(self._bag.path), self._bag.size
        counts, lost = dict(self._bag.counts), dict(self._bag.lost)
        number = sum(counts.values())
        status = RecorderStatus(path=path, messages=number, size=size, recorded=counts, lost=lost)
        what = f'recording to {self._bag.path}'
        if lost:
            return Diagnosis(Severity.WARNING, f'{what}; lost {described(lost)}', status)
        return Diagnosis(Severity.INFO, what, status)

    # Services.

    def _on_start(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        try:
            if not self.is_active:
                raise RecordingError('not active')
            if self._bag is None:
                self.activate()
            response.success, response.message = True, self.diagnose().message
        except RecordingError as error:
            response.message = str(error)
        return response

    def _on_stop(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Complete the bag; a repeated request gets the same response."""
        if self._bag is not None:
            self._result = self._end(self._bag)
        response.success = self.failure is None
        response.message = self.failure or self._result
        return response

    # Recording.

    def activate(self) -> None:
        number = self._recordings + 1
        path = self._path.with_name(f'{self._path.name}_{number}') if number > 1 else self._path
        self._bag = BagWriter(path, self._compression)
        self._recordings = number
        self._left_out.clear()
        self._newest.clear()
        self.failure = None
        self.get_logger().info(f'recording to {path}')
        self._discover()

    def _end(self, bag: BagWriter) -> str:
        """Complete the bag; return a summary of its content, or the error."""
        self._take(_DEPTH)
        if self._bag is None:
            return self.failure or 'not recording'
        self._release()
        with self._writing(bag):
            bag.close()
        if self.failure:
            return self.failure
        counts = bag.counts
        result = f'recorded {sum(counts.values())} messages to {bag.path}'
        lines = [f'{count:8d} {topic}' for topic, count in sorted(counts.items())]
        self.get_logger().info('\n'.join([result, *lines]))
        if bag.lost:
            lost = f'lost {described(bag.lost)}'
            self.get_logger().warning(lost)
            return f'{result}; {lost}'
        return result

    def _release(self) -> None:
        for recorded in self._recorded.values():
            recorded.subscription.destroy()
        self._recorded.clear()
        self._recorded_stamp = 0
        self._report_recorded(0)
        self._bag = None

    @contextmanager
    def _writing(self, bag: BagWriter) -> Iterator[None]:
        """Stop the recording after a disk error; the bag remains readable up to this point."""
        try:
            yield
        except OSError as error:
            self._release()
            bag.abort()
            self.failed = True
            self.failure = f'recording to {bag.path} stopped: {error.strerror or error}'
            self.get_logger().error(self.failure)
            self.publish_diagnostics()

    def _flush(self) -> None:
        if self._bag is not None:
            with self._writing(self._bag):
                self._bag.flush()

    def _take(self, most: int) -> None:
        """Write the received messages with their time of reception by the middleware."""
        for topic, recorded in list(self._recorded.items()):
            if self._bag is not None:
                with self._writing(self._bag):
                    self._take_from(self._bag, topic, recorded, most)
        if self._bag is not None and self._bag.lost:
            self.report_change()
        if self._sampled.keys() & self._recorded.keys():
            self._report_recorded(self._recorded_stamp or 1)

    def _report_recorded(self, stamp: int) -> None:
        """Publish the stamp [ns] of the newest recorded sample; 0: the plant need not wait."""
        if self._reports.get_subscription_count():
            message = Header(frame_id=self.get_fully_qualified_name())
            set_time(message.stamp, stamp)
            self._reports.publish(message)

    def _take_from(self, bag: BagWriter, topic: str, recorded: _Recorded, most: int) -> None:
        data = b''
        for data, about in messages_of(recorded.subscription, recorded.kind, most):
            # Not every middleware reports the receive time and the sequence number.
            bag.write(topic, data, about['received_timestamp'] or time.time_ns())
            number = about['publication_sequence_number']
            if number is None:
                continue
            newest = self._newest.get(topic, number)
            self._newest[topic] = max(number, newest)
            # Each publisher has its own sequence numbers; a new one may not be recorded yet.
            single = len(recorded.offered) == 1
            if number > newest + 1 and single and self.count_publishers(topic) == 1:
                bag.lost[topic] += number - newest - 1
        if data and topic in self._sampled:
            with suppress(MessageError):
                stamp = self._sampled[topic](data).stamp
                self._recorded_stamp = max(self._recorded_stamp, stamp)

    def _discover(self) -> None:
        for topic, types in self.get_topic_names_and_types():
            wanted = topic in self._names or (self._all and not is_hidden(topic))
            if self._bag is not None and wanted and topic not in self._left_out:
                publishers = self.get_publishers_info_by_topic(topic)
                if publishers:
                    with self._writing(self._bag):
                        self._subscribe(self._bag, topic, types, publishers)

    def _subscribe(
        self, bag: BagWriter, topic: str, types: list[str], publishers: list[TopicEndpointInfo]
    ) -> None:
        """Subscribe; subscribe again if a new publisher offers less than was requested."""
        profiles = [publisher.qos_profile for publisher in publishers]
        best_effort = topic.rpartition('/')[2] in _LOSSY or any(
            q.reliability == ReliabilityPolicy.BEST_EFFORT for q in profiles
        )
        latched = all(q.durability == DurabilityPolicy.TRANSIENT_LOCAL for q in profiles)
        before = self._recorded.get(topic)
        offered = {} if before is None else dict(before.offered)
        offered.update((tuple(p.endpoint_gid), _offer(p.qos_profile)) for p in publishers)
        if before and offered == before.offered:
            return
        try:
            kind = message_class(*types)
            bag.add_topic(topic, types[0], tuple(offered.values()))
        except (MessageError, RecordingError) as error:
            self._left_out.add(topic)
            self.get_logger().warning(f'{topic} left out: {error}')
            return
        if before and before.best_effort >= best_effort and before.latched <= latched:
            self._recorded[topic] = before._replace(offered=offered)
            return
        if before:
            self._take_from(bag, topic, before, _DEPTH)
            before.subscription.destroy()
        reliability = ReliabilityPolicy.BEST_EFFORT if best_effort else ReliabilityPolicy.RELIABLE
        durability = DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
        subscription = self.create_subscription(
            kind,
            topic,
            lambda _: None,
            QoSProfile(depth=_DEPTH, reliability=reliability, durability=durability),
            # No log of a QoS mismatch: the next discovery subscribes again.
            event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False),
            raw=True,
        )
        self.take_over(subscription)
        self._recorded[topic] = _Recorded(kind, subscription, best_effort, latched, offered)


def is_hidden(topic: str) -> bool:
    """Return whether the selection of all topics excludes a topic (full name) as internal."""
    return '/_' in topic or topic in _NOT_FOR_ALL


def _offer(qos: QoSProfile) -> OfferedQos:
    words = {name: getattr(qos, name).name.lower() for name in WORDS}
    times = {name: getattr(qos, name).nanoseconds for name in DURATIONS}
    return OfferedQos(depth=qos.depth, **words, **times)


if __name__ == '__main__':
    sys.exit(run(RecorderNode))
