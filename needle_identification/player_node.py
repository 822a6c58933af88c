"""Node that plays a recording into the graph, as it was received."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
import signal
import sys
import time
from typing import Any, Final

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticStatus
from needle_identification.bags.bag import Bag, Recorded
from needle_identification.bags.topics import OfferedQos, Topic
from needle_identification.errors import RecordingError
from needle_identification.recorder_node import is_hidden, message_class
from needle_ros.base_node import BaseNode, run
from needle_ros.errors import (
    NeedleError,
    ParameterError,
)
from needle_ros.settings import check_constants, constant
from needle_ros.timing import NANOSECONDS
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock as ClockMessage
from std_srvs.srv import SetBool, Trigger

#: Time between looks at what is due [s], and the most that one may take: a longer burst after a
#: stall would overrun readers, and services wait meanwhile.
_TICK: Final = 1e-3
_BUSY: Final = 1e-3

#: Time between looks at who else publishes [s].
_LOOK: Final = 0.25

#: Messages of one topic that may wait for a reader, if they are not latched.
_DEPTH: Final = 1000

#: Time between two messages on /clock, at least [ns].
_CLOCK_PERIOD: Final = 1_000_000

#: Delay that is said on /diagnostics [s]: more than a busy machine has now and then.
_LATE: Final = 0.1

#: Time that readers have to take in the last messages [s].
_FAREWELL: Final = 2.0

#: As rclpy listens to it.
_CLOCK: Final = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)


@dataclass(frozen=True, slots=True, kw_only=True)
class PlayerSettings:
    """What is played, and how fast."""

    rate: float = constant(1.0, '1', 'pace over that of the recording; 0: as fast as possible')
    start: float = constant(0.0, 's', 'time in the recording at which to begin')
    end: float = constant(0.0, 's', 'time in the recording at which to end; 0: its end')
    delay: float = constant(
        0.5, 's', 'time before the first message, for readers to find the publishers'
    )

    def __post_init__(self) -> None:
        check_constants(self)
        if 0.0 < self.end <= self.start:
            raise ParameterError(
                f'end must be beyond start = {self.start:g} s, or 0, got {self.end:g} s'
            )


class PlayerNode(BaseNode):
    """
    Plays while active, each topic with the quality of service that its publishers offered.

    Messages go out byte for byte as they were stored, in the order and at the pace in which they
    were received. Latched ones from before ``start`` come first. Of a recording that is cut off,
    what there is is played. ``~/pause`` stops the recorded time; ``~/step`` then plays the next
    message. With ``publish_clock`` the recorded time is /clock, and one in the recording is not
    played.

    Attributes
    ----------
    at_end : callable
        Called when all is played; ``main`` ends the process.

    """

    LIVE = frozenset({'rate'})

    def __init__(self, **node_options: Any) -> None:
        super().__init__('player', **node_options)
        self.declare_text('path', '', 'recording to play: a folder, an .mcap or a .db3 file')
        self.declare_text('topics', ['*'], 'topics to play; * stands for all')
        self.declare_settings('', PlayerSettings())
        self.declare_text('loop', False, 'begin again at the end')
        self.declare_text('paused', False, 'begin paused')
        self.declare_text('publish_clock', False, 'publish the recorded time on /clock')
        self.declare_text('exit_at_end', True, 'end the process when all is played')
        self.at_end: Callable[[], None] = lambda: None
        self._outlets: dict[str, Publisher] = {}
        self._clock_topic: Publisher | None = None
        self._settings = PlayerSettings()
        self._left_out: dict[str, str] = {}
        self._contested: set[str] = set()
        self._played = self._loops = 0
        self._paused = self._ended = False
        self._late = self._latest = 0.0
        self.create_service(SetBool, '~/pause', self._on_pause)
        self.create_service(Trigger, '~/step', self._on_step)

    # Transitions.

    def configure(self) -> None:
        """Open the recording and offer its topics."""
        path = self.text('path')
        if not path:
            raise RecordingError('path must name a recording to play, got nothing')
        self._settings = self.settings('', PlayerSettings)
        publishes = self.get_parameter('publish_clock').value
        if publishes and self.get_parameter('use_sim_time').value:
            raise ParameterError(
                'publish_clock and use_sim_time cannot both be true: the player would follow its '
                'own /clock'
            )
        self._bag = Bag(Path(path))
        topics = self._chosen(self._bag.topics(), publishes)
        self._left_out = {}
        imported = {name: self._imported(name, found) for name, found in topics.items()}
        kinds = {name: kind for name, kind in imported.items() if kind is not None}
        if not kinds:
            said = '; '.join(f'{name}: {reason}' for name, reason in self._left_out.items())
            raise RecordingError(f'{path} has nothing to play; {said or "no topic is left"}')
        self._latched = {
            name: qos.depth
            for name in kinds
            if (qos := _profile(topics[name])).durability == DurabilityPolicy.TRANSIENT_LOCAL
        }
        #: When the recording began [ns].
        self._origin = next(self._bag.messages(lambda _topic: True)).received
        self._wanted = frozenset(kinds)
        self._rewind()
        for name, kind in kinds.items():
            self._outlets[name] = self.create_publisher(kind, name, _profile(topics[name]))
        if publishes:
            self._clock_topic = self.create_publisher(ClockMessage, '/clock', _CLOCK)

    def _chosen(self, topics: tuple[Topic, ...], publishes: bool) -> dict[str, list[Topic]]:
        """Return the topics to play by name; refuse names that are not there."""
        words = self.get_parameter('topics').value
        named = {self.resolve_topic_name(word) for word in words if word != '*'}
        there = {topic.name for topic in topics}
        if missing := sorted(named - there):
            listing = ', '.join(map(str, topics))
            raise RecordingError(
                f'{self._bag.path} has no topic {", ".join(missing)}; it has {listing}'
            )
        if '*' in words:
            named |= {name for name in there if not is_hidden(name)}
        # What this node says itself, now.
        named.discard(self.resolve_topic_name('~/configuration'))
        if publishes:
            named.discard('/clock')
        chosen: dict[str, list[Topic]] = {}
        for topic in topics:
            if topic.name in named:
                chosen.setdefault(topic.name, []).append(topic)
        return chosen

    def _imported(self, name: str, topics: list[Topic]) -> Any:
        """Return the class of the messages of a topic, or say why there is none."""
        try:
            return message_class([topic.type_name for topic in topics])
        except RecordingError as error:
            self._left_out[name] = str(error)
            self.get_logger().warning(f'{name} left out: {error}')
            return None

    def cleanup(self) -> None:
        """Offer nothing more."""
        for outlet in self._outlets.values():
            self.destroy_publisher(outlet)
        self._outlets.clear()
        if self._clock_topic is not None:
            self.destroy_publisher(self._clock_topic)
            self._clock_topic = None

    def change(self, changes: Mapping[str, Any]) -> None:
        """Go on at another pace."""
        settings = self.settings('', PlayerSettings, changes)
        if self.is_active:
            self._anchor(self._position())
        self._settings = settings

    def activate(self) -> None:
        """Begin to play, from the start."""
        self._rewind()
        self._played = self._loops = 0
        self._late = self._latest = 0.0
        self._paused, self._ended = bool(self.get_parameter('paused').value), False
        self._anchor(self._begin, self._settings.delay)
        # A recorded time that stands still must not stop the player.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._ticking = [
            self.create_timer(_TICK, self._on_timer, clock=steady),
            self.create_timer(_LOOK, self._look, clock=steady),
        ]

    def deactivate(self) -> None:
        """Stop playing; what was played last still has to arrive."""
        for timer in self._ticking:
            self.destroy_timer(timer)
        deadline = time.monotonic() + _FAREWELL
        for outlet in self._outlets.values():
            left = max(0.0, deadline - time.monotonic())
            outlet.wait_for_all_acked(Duration(seconds=left))

    # Time.

    def _anchor(self, position: int, delay: float = 0.0) -> None:
        """Let a time of the recording [ns] be now, or in a while [s]."""
        self._now, self._then = position, time.monotonic() + delay

    def _position(self) -> int:
        """Return the time of the recording now [ns]."""
        if self._paused or self._ended or self._settings.rate == 0.0:
            return self._now
        elapsed = max(0.0, time.monotonic() - self._then)
        return self._now + round(elapsed * self._settings.rate * NANOSECONDS)

    def _seconds(self, position: int) -> float:
        return (position - self._origin) / NANOSECONDS

    # Messages.

    def _rewind(self) -> None:
        """Go to the start: gather what was latched before, and have the first message ready."""
        settings = self._settings
        self._begin = self._origin + round(settings.start * NANOSECONDS)
        self._stop = self._origin + round(settings.end * NANOSECONDS) if settings.end else None
        self._before: dict[str, deque[Recorded]] = {}
        messages = self._bag.messages(lambda topic: topic.name in self._wanted)
        last = self._origin
        self._next: Recorded | None = None
        #: Time last shown on /clock [ns].
        self._clocked = self._begin - _CLOCK_PERIOD
        #: Time of the message played last [ns].
        self._last = self._begin
        for message in messages:
            last = message.received
            name = message.topic.name
            if last >= self._begin:
                self._next = message
                break
            if name in self._latched:
                kept = self._before.setdefault(name, deque(maxlen=self._latched[name]))
                kept.append(message)
        self._messages: Iterator[Recorded] = messages
        where = f'{self._bag.path}, whose topics to play end at {self._seconds(last):.3f} s'
        if self._next is None:
            raise RecordingError(f'start = {settings.start:g} s is beyond the end of {where}')
        if self._stop is not None and self._next.received > self._stop:
            raise RecordingError(
                f'{self._bag.path} has no message to play from {settings.start:g} s to '
                f'{settings.end:g} s; the next one is at {self._seconds(last):.3f} s'
            )

    def _on_timer(self) -> None:
        if not (self._paused or self._ended) and time.monotonic() >= self._then:
            self._guarded(self._play)

    def _guarded(self, action: Callable[[], None]) -> None:
        """Stop if the recording is no longer what it was."""
        try:
            action()
        except NeedleError as error:
            self._ended, self.failure = True, str(error)
            self.get_logger().error(self.failure)
            self.publish_diagnostics()

    def _play(self) -> None:
        """Publish what is due."""
        enough = time.monotonic() + _BUSY
        rate = self._settings.rate
        while self._next is not None:
            if rate > 0.0:
                late = self._position() - self._next.received
                if late < 0:
                    self._show_time(self._position())
                    return
                self._late = late / rate / NANOSECONDS
                self._latest = max(self._latest, self._late)
            self._publish(self._next)
            if time.monotonic() > enough:
                return
        self._turn()

    def _turn(self) -> None:
        """At the end: begin again or be done."""
        if self.get_parameter('loop').value:
            self._loops += 1
            self._rewind()
            self._anchor(self._begin)
            return
        self._now = self._last
        self._ended = True
        said = f'played {self._played} messages of {self._bag.path}'
        if self._bag.losses:
            self.get_logger().warning('; '.join([said, *self._bag.losses]))
        else:
            self.get_logger().info(said)
        self.publish_diagnostics()
        self.at_end()

    def _publish(self, message: Recorded) -> None:
        """Publish a message, what was latched before it, and its time; have the next ready."""
        for kept in self._before.values():
            for earlier in kept:
                self._send(earlier)
        self._before.clear()
        self._show_time(message.received)
        self._send(message)
        self._last = message.received
        if self._paused or self._settings.rate == 0.0:
            self._now = message.received
        self._next = next(self._messages, None)
        if self._next is not None and self._stop is not None and self._next.received > self._stop:
            self._next = None

    def _send(self, message: Recorded) -> None:
        self._outlets[message.topic.name].publish(message.data)
        self._played += 1

    def _show_time(self, position: int) -> None:
        """Publish the time of the recording on /clock if it is newer; it never runs back."""
        least = 1 if self._paused else _CLOCK_PERIOD
        if self._clock_topic is None or position - self._clocked < least:
            return
        self._clocked = position
        sec, nanosec = divmod(position, NANOSECONDS)
        self._clock_topic.publish(ClockMessage(clock=Time(sec=sec, nanosec=nanosec)))

    # Services.

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        if not self.is_active:
            response.message = 'not active'
            return response
        self._anchor(self._position())
        self._paused = request.data
        where = f'{self._seconds(self._now):.6f} s'
        response.success = True
        response.message = f'paused at {where}' if self._paused else f'playing from {where}'
        return response

    def _on_step(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if not self.is_active or not self._paused:
            response.message = 'not paused; call ~/pause first' if self.is_active else 'not active'
            return response
        if self._next is None and not self._ended:
            self._guarded(self._turn)
        message = self._next
        if message is None or self._ended:
            response.message = self.failure or 'at the end of the recording'
            return response
        self._publish(message)
        response.success = True
        response.message = f'{message.topic.name} at {self._seconds(message.received):.6f} s'
        return response

    # Diagnostics.

    def _look(self) -> None:
        """See who else publishes what is played: its readers get both."""
        contested = {
            name
            for name in self._outlets
            # Every node has a say there.
            if name != '/diagnostics' and self.count_publishers(name) > 1
        }
        for name in sorted(contested - self._contested):
            self.get_logger().warning(f'{name} has another publisher: its readers get both')
        self._contested = contested

    def diagnose(self) -> tuple[bytes, str, dict[str, object]]:
        """Say where in the recording it is, and whether it keeps the pace."""
        if not self.is_active:
            return super().diagnose()
        values: dict[str, object] = {
            'position [s]': f'{self._seconds(self._position()):.3f}',
            'rate': self._settings.rate,
            'late [s]': f'{self._late:.4f}',
            'latest so far [s]': f'{self._latest:.4f}',
            'messages': self._played,
            'loops': self._loops,
            'left out': ', '.join(sorted(self._left_out)) or 'none',
        }
        complaints = [*self._bag.losses] if self._ended else []
        if self._contested:
            complaints.append(f'{", ".join(sorted(self._contested))}: others publish there, too')
        if self._late > _LATE and not (self._paused or self._ended):
            complaints.append(f'{self._late:.2f} s late: the machine cannot keep this rate')
        if complaints:
            return DiagnosticStatus.WARN, '; '.join(complaints), values
        state = 'at the end of' if self._ended else 'paused in' if self._paused else 'playing'
        return DiagnosticStatus.OK, f'{state} {self._bag.path}', values


def _profile(topics: list[Topic]) -> QoSProfile:
    """Return what to offer: the most that any publisher did, so that every reader is served."""
    offered = [qos for topic in topics for qos in topic.offered_qos()] or [OfferedQos()]
    best_effort = all(qos.reliability == 'best_effort' for qos in offered)
    reliability = ReliabilityPolicy.BEST_EFFORT if best_effort else ReliabilityPolicy.RELIABLE
    if not any(qos.durability == 'transient_local' for qos in offered):
        return QoSProfile(depth=_DEPTH, reliability=reliability)
    # The middleware does not tell the depth to a recorder: then one of each publisher.
    known = [qos.depth for qos in offered if qos.durability == 'transient_local']
    depth = min(sum(max(1, number) for number in known), _DEPTH)
    durability = DurabilityPolicy.TRANSIENT_LOCAL
    return QoSProfile(depth=depth, reliability=reliability, durability=durability)


def _player() -> PlayerNode:
    node = PlayerNode()

    def end() -> None:
        if node.get_parameter('exit_at_end').value:
            # As Ctrl-C: `run` then leaves the graph in order.
            signal.raise_signal(signal.SIGINT)

    node.at_end = end
    return node


def main() -> int:
    """Run the node; return its exit status."""
    return run(_player)


if __name__ == '__main__':
    sys.exit(main())
