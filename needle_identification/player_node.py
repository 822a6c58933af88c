# SPDX-License-Identifier: Apache-2.0
"""Node that plays a recording into the ROS graph with its original timing."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
import signal
import sys
import time
from typing import Any, Final

from builtin_interfaces.msg import Time
from needle_identification.bags.bag import Bag, Recorded
from needle_identification.bags.playback import BagPlayback, PlaybackSettings
from needle_identification.bags.topics import BagTopic, DURATIONS, OfferedQos, UNLIMITED
from needle_identification.errors import RecordingError
from needle_identification.recorder_node import is_hidden
from needle_ros.base_node import BaseNode, message_class, steady_timer
from needle_ros.contract import EMERGENCY_STOP, SYSTEM_STATE
from needle_ros.errors import MessageError, NeedleError, ParameterError
from needle_ros.event_log import Severity
from needle_ros.run_node import run
from needle_ros.status import Diagnosis, PlayerPhase, PlayerStatus
from needle_ros.timing import NANOSECONDS
from rclpy.duration import Duration
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock as ClockMessage
from std_srvs.srv import SetBool, Trigger

#: Time between checks for due messages [s], and the longest burst of one check: a longer
#: burst after a stall would overrun readers and delay services.
_TICK: Final = 1e-3
_LONGEST_BURST: Final = 1e-3

_CHECK: Final = 0.25  # time between checks for other publishers [s]

#: Message by phase, before the path of the bag.
_STATES: Final = {
    PlayerPhase.PLAYING: 'playing',
    PlayerPhase.PAUSED: 'paused in',
    PlayerPhase.ENDED: 'at the end of',
}

_DEPTH: Final = 1000  # queue length of a topic that is not latched
_CLOCK_PERIOD: Final = 1_000_000  # shortest time between two messages on /clock [ns]
_LATE: Final = 0.1  # delay that is reported [s]; less is normal on a busy machine
_FAREWELL: Final = 2.0  # timeout of the acknowledgment of the last messages [s]

#: Last parts of the names of topics with requests of a user to the whole system.
_REQUESTS: Final = (SYSTEM_STATE.name, EMERGENCY_STOP.name)

#: QoS of the subscription of rclpy to /clock.
_CLOCK: Final = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)


class PlayerNode(BaseNode):
    """
    Plays a recording while active, each topic with the QoS that its publishers offered.

    Messages are published byte for byte as stored, in the order and with the timing of their
    reception. Latched messages from before ``start`` are published first. A truncated recording is
    played up to its last complete message. ``~/pause`` stops the recorded time; ``~/step`` then
    plays the next message. With ``publish_clock`` the recorded time is published on /clock, and a
    recorded /clock is not played. ``system_state`` and ``emergency_stop`` are played only if
    ``topics`` names them: a recorded request must not move or stop a needle.
    """

    LIVE = frozenset({'rate'})

    def __init__(self, **node_options: Any) -> None:
        super().__init__('player', **node_options)
        self.declare_text('path', '', 'recording to play: a folder, an .mcap or a .db3 file')
        self.declare_text('topics', ['*'], 'topics to play; * selects all')
        self.declare_settings('', PlaybackSettings())
        self.declare_text('loop', False, 'restart at the end')
        self.declare_text('paused', False, 'start paused')
        self.declare_text('publish_clock', False, 'publish the recorded time on /clock')
        self.declare_text('exit_at_end', True, 'end the process when all is played')
        #: Called after the last message; ``main`` ends the process.
        self.at_end: Callable[[], None] = lambda: None
        self._outputs: dict[str, Publisher] = {}
        self._clock_publisher: Publisher | None = None
        self._left_out: dict[str, str] = {}
        self._contested: set[str] = set()
        self._played = 0

    # Transitions.

    def configure(self) -> None:
        """Open the recording and create its publishers and the services."""
        path = self.text('path')
        if not path:
            raise RecordingError('path must name a recording to play, got nothing')
        settings = self.settings('', PlaybackSettings)
        publishes = self.get_parameter('publish_clock').value
        if publishes and self.get_parameter('use_sim_time').value:
            raise ParameterError(
                'publish_clock and use_sim_time cannot both be true: the player would follow its '
                'own /clock'
            )
        bag = Bag(Path(path).expanduser())
        topics = self._chosen(bag.path, bag.topics(), publishes)
        self._left_out = {}
        kinds = {name: self._imported(name, found) for name, found in topics.items()}
        profiles = {name: _profile(topics[name]) for name, kind in kinds.items() if kind}
        if not profiles:
            reasons = '; '.join(f'{name}: {reason}' for name, reason in self._left_out.items())
            raise RecordingError(f'{path} has nothing to play; {reasons or "no topic is left"}')
        kept = DurabilityPolicy.TRANSIENT_LOCAL
        latched = {name: qos.depth for name, qos in profiles.items() if qos.durability == kept}
        self._playback = BagPlayback(bag, profiles.keys(), latched, settings)
        for name, qos in profiles.items():
            self._outputs[name] = self.create_publisher(kinds[name], name, qos)
        if publishes:
            self._clock_publisher = self.create_publisher(ClockMessage, '/clock', _CLOCK)
        self.create_service(SetBool, '~/pause', self._on_pause)
        self.create_service(Trigger, '~/step', self._on_step)

    def _chosen(
        self, path: Path, topics: Sequence[BagTopic], publishes: bool
    ) -> dict[str, list[BagTopic]]:
        """Return the topics to play by name; reject names that are not in the recording."""
        words = self.get_parameter('topics').value
        named = {self.resolve_topic_name(word) for word in words if word != '*'}
        there = {topic.name for topic in topics}
        if missing := sorted(named - there):
            listing = ', '.join(map(str, topics))
            raise RecordingError(f'{path} has no topic {", ".join(missing)}; it has {listing}')
        if '*' in words:
            requests = {name for name in there if name.rpartition('/')[2] in _REQUESTS}
            named |= {name for name in there - requests if not is_hidden(name)}
        # This node publishes its own configuration.
        named.discard(self.resolve_topic_name('~/configuration'))
        if publishes:
            named.discard('/clock')
        chosen: dict[str, list[BagTopic]] = {}
        for topic in topics:
            if topic.name in named:
                chosen.setdefault(topic.name, []).append(topic)
        return chosen

    def _imported(self, name: str, topics: list[BagTopic]) -> Any:
        """Return the message class of a topic; None, with a warning, if not installed."""
        try:
            return message_class(*(topic.type_name for topic in topics))
        except MessageError as error:
            self._left_out[name] = str(error)
            self.get_logger().warning(f'{name} left out: {error}')
            return None

    def cleanup(self) -> None:
        self._outputs.clear()
        self._clock_publisher = None

    def change(self, changes: Mapping[str, Any]) -> None:
        self._playback.change(self.settings('', PlaybackSettings, changes))

    def activate(self) -> None:
        self._playback.start(paused=bool(self.get_parameter('paused').value))
        self._reset_clock()
        self._played = 0
        # Timers must run while the recorded time is paused.
        tasks = (_TICK, self._on_timer), (_CHECK, self._check_publishers)
        self._timers_of_play = [steady_timer(self, period, act) for period, act in tasks]

    def about(self) -> str:
        return f'plays {", ".join(sorted(self._outputs))} of {self._playback.bag.path}'

    def deactivate(self) -> None:
        """Stop playing and wait until readers have acknowledged the last messages."""
        for timer in self._timers_of_play:
            self.destroy_timer(timer)
        deadline = time.monotonic() + _FAREWELL
        for publisher in self._outputs.values():
            left = max(0.0, deadline - time.monotonic())
            publisher.wait_for_all_acked(Duration(seconds=left))

    # Messages.

    def _on_timer(self) -> None:
        if self._playback.is_running:
            self._guarded(self._play)

    def _guarded(self, action: Callable[[], None]) -> None:
        """Run an action; end with an error if the recording is no longer readable."""
        try:
            action()
        except NeedleError as error:
            self._playback.is_ended = True
            self._end(str(error))

    def _play(self) -> None:
        deadline = time.monotonic() + _LONGEST_BURST
        while self._playback.has_next:
            if not self._playback.is_due():
                self._show_time(self._playback.position)
                return
            self._publish(self._playback.take())
            if time.monotonic() > deadline:
                return
        self._finish()

    def _finish(self) -> None:
        playback = self._playback
        playback.finish(loop=bool(self.get_parameter('loop').value))
        if not playback.is_ended:
            self._reset_clock()
            return
        self._end(playback.damage)

    def _end(self, failure: str) -> None:
        """Report the number of messages played, with the failure or the losses of the bag."""
        bag = self._playback.bag
        report = f'played {self._played} messages of {bag.path}'
        if failure:
            self.failed = True
            self.failure = '; '.join([failure, report, *bag.losses])
            self.get_logger().error(self.failure)
        elif bag.losses:
            self.get_logger().warning('; '.join([report, *bag.losses]))
        else:
            self.get_logger().info(report)
        self.publish_diagnostics()
        self.at_end()

    def _publish(self, messages: Sequence[Recorded]) -> None:
        """Publish messages, and the time of the last message before that message."""
        for message in messages:
            if message is messages[-1]:
                self._show_time(message.received)
            self._outputs[message.topic.name].publish(message.data)
            self._played += 1

    def _reset_clock(self) -> None:
        #: Time last published on /clock [ns].
        self._shown = self._playback.begin - _CLOCK_PERIOD

    def _show_time(self, position: int) -> None:
        """Publish a recorded time [ns] on /clock if it is later than the previous one."""
        # During a pause the time is repeated for nodes that start late.
        step = 0 if self._playback.is_paused else _CLOCK_PERIOD
        if self._clock_publisher is None or position - self._shown < step:
            return
        self._shown = position
        sec, nanosec = divmod(position, NANOSECONDS)
        self._clock_publisher.publish(ClockMessage(clock=Time(sec=sec, nanosec=nanosec)))

    # Services.

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        if not self.is_active:
            response.message = 'not active'
            return response
        self._playback.pause(request.data)
        state = 'paused at' if request.data else 'playing from'
        response.success = True
        response.message = f'{state} {self._playback.seconds(self._playback.position):.6f} s'
        return response

    def _on_step(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if not self.is_active or not self._playback.is_paused:
            response.message = 'not paused; call ~/pause first' if self.is_active else 'not active'
            return response
        if not (self._playback.has_next or self._playback.is_ended):
            self._guarded(self._finish)
        messages = [] if self._playback.is_ended else self._playback.take()
        if not messages:
            response.message = self.failure or 'at the end of the recording'
            return response
        self._publish(messages)
        last = messages[-1]
        response.success = True
        response.message = f'{last.topic.name} at {self._playback.seconds(last.received):.6f} s'
        return response

    # Diagnostics.

    def _check_publishers(self) -> None:
        contested = {
            name
            for name in self._outputs
            # Each node publishes on /diagnostics.
            if name != '/diagnostics' and self.count_publishers(name) > 1
        }
        for name in sorted(contested - self._contested):
            self.get_logger().warning(f'{name} has another publisher: its readers receive both')
        self._contested = contested
        if self._playback.is_paused:
            self._show_time(self._playback.position)

    def diagnose(self) -> Diagnosis[PlayerStatus]:
        if not self.is_active:
            return Diagnosis(Severity.INFO, self.state, PlayerStatus())
        playback = self._playback
        paused = PlayerPhase.PAUSED if playback.is_paused else PlayerPhase.PLAYING
        status = PlayerStatus(
            phase=PlayerPhase.ENDED if playback.is_ended else paused,
            path=str(playback.bag.path),
            position=playback.seconds(playback.position),
            rate=playback.settings.rate,
            delay=playback.late,
            largest_delay=playback.latest,
            messages=self._played,
            loops=playback.loops,
            left_out=', '.join(sorted(self._left_out)),
            duplicate_publishers=', '.join(sorted(self._contested)),
        )
        warnings = [*playback.bag.losses] if playback.is_ended else []
        if self._contested:
            warnings.append(f'other publishers of {status.duplicate_publishers}')
        if playback.late > _LATE and playback.is_running:
            warnings.append(f'{playback.late:.2f} s late: the machine is too slow for this rate')
        if warnings:
            return Diagnosis(Severity.WARNING, '; '.join(warnings), status)
        return Diagnosis(Severity.INFO, f'{_STATES[status.phase]} {playback.bag.path}', status)


def _profile(topics: list[BagTopic]) -> QoSProfile:
    """Return the strongest QoS offered by any publisher, which is compatible with each reader."""
    offered = [qos for topic in topics for qos in topic.offered_qos()] or [OfferedQos()]
    best_effort = all(qos.reliability == 'best_effort' for qos in offered)
    reliability = ReliabilityPolicy.BEST_EFFORT if best_effort else ReliabilityPolicy.RELIABLE
    times = {}
    for name in DURATIONS:
        # Durations that differ between publishers are left unlimited.
        found = {getattr(qos, name) for qos in offered}
        if len(found) == 1 and UNLIMITED not in found:
            times[name] = Duration(nanoseconds=found.pop())
    if not any(qos.durability == 'transient_local' for qos in offered):
        return QoSProfile(depth=_DEPTH, reliability=reliability, **times)
    # The middleware may not report the depth to a recorder: then one message per publisher.
    known = [qos.depth for qos in offered if qos.durability == 'transient_local']
    depth = min(sum(max(1, number) for number in known), _DEPTH)
    durability = DurabilityPolicy.TRANSIENT_LOCAL
    return QoSProfile(depth=depth, reliability=reliability, durability=durability, **times)


def _player() -> PlayerNode:
    node = PlayerNode()

    def end() -> None:
        if node.get_parameter('exit_at_end').value:
            # Same as Ctrl-C: `run` then shuts down in order.
            signal.raise_signal(signal.SIGINT)

    node.at_end = end
    return node


if __name__ == '__main__':
    sys.exit(run(_player))
