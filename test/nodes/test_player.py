# SPDX-License-Identifier: Apache-2.0
"""Playback of bags: every message, byte for byte, in order, at its time."""

from collections.abc import Callable
from functools import cache
from itertools import pairwise
from pathlib import Path
import signal
import subprocess
import sys
import time
from typing import Any

from builtin_interfaces.msg._time import Time
from mcap.writer import Writer as McapWriter
from needle_identification import Bag, BagWriter
from needle_identification.bags.bag import read_topic
from needle_identification.bags.topics import OfferedQos
from needle_identification.player_node import PlayerNode
from needle_identification.recorder_node import RecorderNode
from needle_ros.base_node import LATCHED, SENSOR
from needle_ros.event_log import Severity
import pytest
from rclpy.node import Node as RosNode
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message, serialize_message
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import get_typestore, Stores
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger
from std_srvs.srv._set_bool import SetBool_Request
from std_srvs.srv._trigger import Trigger_Request
from support.ros_graph import RosGraph

MILLISECOND = 1_000_000
#: Start of the recordings [ns].
EPOCH = 1_700_000_000_123_456_789

#: Queue depth for a busy test.
EVERYTHING = QoSProfile(depth=10_000, reliability=ReliabilityPolicy.RELIABLE)
WEAK = QoSProfile(depth=10_000, reliability=ReliabilityPolicy.BEST_EFFORT)

#: Start paused, so that no message is lost during discovery.
HELD = {'delay': 0.0, 'paused': True}


def text(data: str) -> bytes:
    # Three letters, so that the middleware adds no padding.
    return serialize_message(String(data=data))


@cache
def joints(position: float) -> bytes:
    # Published once: its padding has arbitrary bytes.
    return serialize_message(JointState(name=['insertion'], position=[position]))


def small_bag(path: Path, count: int = 20, step: int = 10, extra: str = '') -> Path:
    """Write two topics with a message each every ``step`` ms, after a latched topic."""
    with BagWriter(path) as bag:
        bag.add_topic('/text', 'std_msgs/msg/String', [OfferedQos(depth=1)])
        offered = OfferedQos('best_effort', 'volatile', 'unknown', 0)
        bag.add_topic('/joints', 'sensor_msgs/msg/JointState', [offered])
        offered = OfferedQos('reliable', 'transient_local', 'unknown', 0)
        bag.add_topic('/latched', 'std_msgs/msg/String', [offered])
        bag.write('/latched', text('old'), EPOCH)
        bag.write('/latched', text('new'), EPOCH + 1)
        if extra:
            bag.add_topic(extra, 'rosgraph_msgs/msg/Clock')
            bag.write(extra, serialize_message(Clock()), EPOCH + 2)
        for k in range(count):
            at = EPOCH + k * step * MILLISECOND + 3
            bag.write('/joints', joints(k / 3.0), at)
            bag.write('/text', text(f'{k:03d}'), at + 1)
            if k % 100 == 99:
                bag.flush()
    return path


def bytes_of(bag: Path, topic: str) -> list[bytes]:
    """Return the messages of a topic of a bag."""
    return [
        data
        for batch in Bag(bag).batches(lambda known: known.name == topic)
        for _, data in batch.messages()
    ]


class Listener:
    """Receives topics as bytes, in order, with their receive times."""

    def __init__(self, ros_graph: RosGraph, **topics: tuple[Any, ...]) -> None:
        self._graph = ros_graph
        self._node = ros_graph.node('listener')
        self.heard: list[tuple[str, bytes, float]] = []
        self._subscriptions = [
            self._node.create_subscription(kind, name, self._taker(name), qos, raw=True)
            for name, (kind, qos) in topics.items()
        ]

    def _taker(self, name: str) -> Callable[..., Any]:
        return lambda data: self.heard.append((name, data, time.monotonic()))

    def of(self, name: str) -> list[bytes]:
        return [data for topic, data, _ in self.heard if topic == name]

    def wait(self) -> None:
        """Wait until every topic has its publisher."""
        self._graph.spin_until(
            lambda: all(each.get_publisher_count() for each in self._subscriptions), 'the player'
        )


def call(
    ros_graph: RosGraph,
    kind: type[SetBool] | type[Trigger],
    service: str,
    request: SetBool_Request | Trigger_Request,
) -> tuple[bool, str]:
    client = ros_graph.node('caller').create_client(kind, f'player/{service}')
    ros_graph.spin_until(client.service_is_ready, service)
    # A response to an undiscovered client is lost: repeat a harmless request until a response.
    probe = Trigger.Request() if kind is Trigger else SetBool.Request(data=True)
    if kind is SetBool:
        answers = []

        def answered() -> bool:
            answers.append(client.call_async(probe))
            return any(answer.done() for answer in answers)

        ros_graph.spin_until(answered, 'answer')
    answer = client.call_async(request)
    ros_graph.spin_until(answer.done, 'answer')
    return answer.result().success, answer.result().message


def go(ros_graph: RosGraph) -> None:
    """Start a player that is paused."""
    assert call(ros_graph, SetBool, 'pause', SetBool.Request(data=False))[0]


def play(ros_graph: RosGraph, bag: Path, **parameters: bool | float | list[str]) -> PlayerNode:
    return ros_graph.add(PlayerNode, parameters={'path': str(bag), **HELD, **parameters})


BOTH = {'text': (String, EVERYTHING), 'joints': (JointState, WEAK)}


@pytest.mark.parametrize('rate', [0.0, 1.0, 20.0])
def test_playback_is_identical_and_ordered(
    ros_graph: RosGraph, tmp_path: Path, rate: float
) -> None:
    """In order within and across topics, at any rate."""
    bag = small_bag(tmp_path / 'bag')
    player = play(ros_graph, bag, rate=rate)
    listener = Listener(ros_graph, **BOTH)
    listener.wait()
    go(ros_graph)
    ros_graph.spin_until(lambda: len(listener.heard) >= 40, 'the messages')
    for topic in BOTH:
        assert listener.of(topic) == bytes_of(bag, f'/{topic}')
    assert player.diagnose().status.messages == 42


def test_recording_of_the_playback_equals_the_original(
    ros_graph: RosGraph, tmp_path: Path
) -> None:
    """Recorder, player, recorder: the second bag has the bytes of the first."""
    bag = small_bag(tmp_path / 'bag')
    play(ros_graph, bag, rate=2.0)
    topics = ['/text', '/joints', '/latched']
    again = tmp_path / 'again'
    recorder = ros_graph.add(RecorderNode, parameters={'path': str(again), 'topics': topics})
    probe = ros_graph.node('probe')
    ros_graph.spin_until(
        lambda: all(probe.count_subscribers(topic) for topic in topics), 'the recorder'
    )
    go(ros_graph)
    ros_graph.spin_until(
        lambda: all(recorder.diagnose().status.recorded.get(topic) == 20 for topic in topics[:2]),
        'the messages in the bag',
    )
    recorder.stop()
    for topic in ('/text', '/joints'):
        assert bytes_of(again, topic) == bytes_of(bag, topic)
    assert bytes_of(again, '/latched')[-1] == text('new')
    # The player is never early: the duration of the second bag differs only by the delivery of its
    # first message.
    times = [received for received, _ in read_topic(again, '/text')]
    assert times[-1] - times[0] > 0.5 * 190 * MILLISECOND / 2.0


@pytest.mark.parametrize('rate', [0.5, 10.0])
def test_playback_timing(ros_graph: RosGraph, tmp_path: Path, rate: float) -> None:
    """No message is early; the player reports delays."""
    step = 20 if rate < 1.0 else 200
    bag = small_bag(tmp_path / 'bag', step=step)
    player = play(ros_graph, bag, rate=rate)
    listener = Listener(ros_graph, text=(String, EVERYTHING))
    listener.wait()
    begin = time.monotonic()
    go(ros_graph)
    ros_graph.spin_until(lambda: len(listener.heard) == 20, 'the messages')
    due = [k * step * 1e-3 / rate for k in range(20)]
    came = [at - begin for _, _, at in listener.heard]
    assert all(at >= wanted for at, wanted in zip(came, due, strict=True))
    status = player.diagnose().status
    assert 0.0 <= status.delay <= status.largest_delay
    ros_graph.spin_until(
        lambda: player.diagnose().status.position == pytest.approx(19e-3 * step), 'the end'
    )


def test_latched_messages_reach_late_subscribers(ros_graph: RosGraph, tmp_path: Path) -> None:
    bag = small_bag(tmp_path / 'bag')
    player = ros_graph.add(PlayerNode, parameters={'path': str(bag), 'rate': 0.0, 'delay': 0.0})
    ros_graph.spin_until(lambda: player.diagnose().status.messages == 42, 'the end')
    probe = ros_graph.node('probe')
    heard = ros_graph.listen(probe, String, 'latched', LATCHED)
    ros_graph.spin_until(lambda: heard, 'the latched message')
    assert [message.data for message in heard] == ['new']
    assert player.diagnose().message == f'at the end of {bag}'


def test_qos_equals_the_recorded_qos(ros_graph: RosGraph, tmp_path: Path) -> None:
    """Best effort, reliable or latched."""
    play(ros_graph, small_bag(tmp_path / 'bag'))
    probe = ros_graph.node('probe')

    def offered(topic: str) -> list[QoSProfile]:
        return [each.qos_profile for each in probe.get_publishers_info_by_topic(topic)]

    ros_graph.spin_until(
        lambda: all(offered(topic) for topic in ('/text', '/joints', '/latched')), 'the topics'
    )
    (weak,), (strong,), (latched,) = map(offered, ('/joints', '/text', '/latched'))
    assert weak.reliability == ReliabilityPolicy.BEST_EFFORT
    assert strong.reliability == latched.reliability == ReliabilityPolicy.RELIABLE
    assert strong.durability == DurabilityPolicy.VOLATILE
    assert latched.durability == DurabilityPolicy.TRANSIENT_LOCAL


def test_playback_of_an_interval(ros_graph: RosGraph, tmp_path: Path) -> None:
    """Messages between start and end, after the earlier latched messages."""
    play(ros_graph, small_bag(tmp_path / 'bag'), rate=0.0, start=0.05, end=0.1)
    listener = Listener(ros_graph, latched=(String, EVERYTHING), text=(String, EVERYTHING))
    listener.wait()
    go(ros_graph)
    ros_graph.spin_until(lambda: len(listener.heard) >= 6, 'the messages')
    # From 50 ms to 100 ms of the recording; the message at 100 ms lies 3 ns beyond.
    assert sorted(listener.of('text')) == [text(f'{k:03d}') for k in range(5, 10)]
    assert listener.of('latched') == [text('new')]


def test_loop_repeats_all_messages(ros_graph: RosGraph, tmp_path: Path) -> None:
    player = play(ros_graph, small_bag(tmp_path / 'bag', step=1), rate=10.0, loop=True)
    listener = Listener(ros_graph, text=(String, EVERYTHING))
    listener.wait()
    go(ros_graph)
    ros_graph.spin_until(lambda: len(listener.heard) >= 70, 'three rounds')
    assert listener.of('text')[:60] == 3 * [text(f'{k:03d}') for k in range(20)]
    assert player.diagnose().status.loops >= 3


def test_recorded_requests_are_played_only_by_name(ros_graph: RosGraph, tmp_path: Path) -> None:
    """A replay neither stops nor moves a needle."""
    bag = small_bag(tmp_path / 'bag')
    with BagWriter(tmp_path / 'requests') as writer:
        for name, kind in (
            ('/text', 'std_msgs/msg/String'),
            ('/emergency_stop', 'std_msgs/msg/Bool'),
            ('/left/system_state', 'diagnostic_msgs/msg/DiagnosticStatus'),
        ):
            writer.add_topic(name, kind)
            writer.write(name, bytes_of(bag, '/text')[0], EPOCH)
    player = play(ros_graph, tmp_path / 'requests', paused=True)
    assert set(player._outputs) == {'/text'}
    player.stop()
    named = play(ros_graph, tmp_path / 'requests', paused=True, topics=['/emergency_stop'])
    assert set(named._outputs) == {'/emergency_stop'}


def test_pause_step_and_resume(ros_graph: RosGraph, tmp_path: Path) -> None:
    """A step plays one message and returns its topic; no other message is played in a pause."""
    bag = small_bag(tmp_path / 'bag')
    play(ros_graph, bag, rate=0.0, publish_clock=True, topics=['/text', '/joints'])
    topics = {**BOTH, 'clock': (Clock, WEAK)}
    listener = Listener(ros_graph, **topics)
    listener.wait()
    said = [call(ros_graph, Trigger, 'step', Trigger.Request()) for _ in range(3)]
    assert said == [
        (True, '/joints at 0.000000 s'),
        (True, '/text at 0.000000 s'),
        (True, '/joints at 0.010000 s'),
    ]
    last = serialize_message(Clock(clock=_time(3 + 10 * MILLISECOND)))
    ros_graph.spin_until(lambda: last in listener.of('clock'), 'three messages and their times')
    assert listener.of('text') == [text('000')]
    assert listener.of('joints') == [joints(0.0), joints(1.0 / 3.0)]
    # During a pause the clock may be repeated.
    assert list(dict.fromkeys(listener.of('clock'))) == [
        serialize_message(Clock(clock=at)) for at in map(_time, (3, 4, 3 + 10 * MILLISECOND))
    ]
    go(ros_graph)
    ros_graph.spin_until(lambda: len(listener.of('text')) == 20, 'the rest')
    assert call(ros_graph, Trigger, 'step', Trigger.Request()) == (
        False,
        'not paused; call ~/pause first',
    )
    success, message = call(ros_graph, SetBool, 'pause', SetBool.Request(data=True))
    assert success
    assert message.startswith('paused at 0.19')
    assert call(ros_graph, Trigger, 'step', Trigger.Request()) == (
        False,
        'at the end of the recording',
    )
    assert listener.of('joints') == bytes_of(bag, '/joints')


def _time(since: int) -> Time:
    seconds, rest = divmod(EPOCH + since, 10**9)
    clock = Clock()
    clock.clock.sec, clock.clock.nanosec = seconds, rest
    return clock.clock


def test_recorded_time_is_published_as_clock(ros_graph: RosGraph, tmp_path: Path) -> None:
    """With ``publish_clock`` a node with `use_sim_time` has the time of the recording."""
    bag = small_bag(tmp_path / 'bag', extra='/clock')
    play(ros_graph, bag, rate=0.1, publish_clock=True)
    node = ros_graph.add(RosNode, 'follower', parameters={'use_sim_time': True})
    listener = Listener(ros_graph, clock=(Clock, WEAK))
    listener.wait()
    # The paused player still publishes the time.
    ros_graph.spin_until(lambda: node.get_clock().now().nanoseconds >= EPOCH, 'the clock')
    go(ros_graph)
    last = EPOCH + 190 * MILLISECOND + 4
    ros_graph.spin_until(
        lambda: node.get_clock().now().nanoseconds >= last - 2 * MILLISECOND, 'the end'
    )
    assert node.get_clock().now().nanoseconds <= last
    # The zero clock of the bag is not played; the published clock never goes back.
    times = [deserialize_message(data, Clock).clock for data in listener.of('clock')]
    stamps = [at.sec * 10**9 + at.nanosec for at in times]
    assert stamps[0] >= EPOCH
    assert all(late >= early for early, late in pairwise(stamps))
    # Many more than the 20 message times: two seconds are 2000 ticks.
    assert len(stamps) > 100


def test_rate_may_change_during_playback(ros_graph: RosGraph, tmp_path: Path) -> None:
    """An invalid rate is rejected."""
    player = play(ros_graph, small_bag(tmp_path / 'bag', step=60_000), rate=1.0)
    listener = Listener(ros_graph, text=(String, EVERYTHING))
    listener.wait()
    go(ros_graph)
    (refused,) = player.set_parameters([Parameter('rate', value=float('inf'))])
    assert not refused.successful
    assert 'rate out of range' in refused.reason
    (fixed,) = player.set_parameters([Parameter('loop', value=True)])
    assert 'cannot change while configured' in fixed.reason
    ros_graph.spin_until(lambda: listener.heard, 'the first message')
    # One hour of recording per second: 19 minutes take a third of a second.
    assert player.set_parameters([Parameter('rate', value=3600.0)])[0].successful
    ros_graph.spin_until(lambda: len(listener.heard) == 20, 'the rest')


def test_truncated_recording_is_played_to_its_end(ros_graph: RosGraph, tmp_path: Path) -> None:
    """The readable part is played; the losses are reported at the end."""
    bag = small_bag(tmp_path / 'bag', count=600, step=1)
    file = bag / 'bag_0.mcap'
    content = file.read_bytes()
    file.write_bytes(content[: -len(content) // 4])
    (bag / 'metadata.yaml').unlink()
    whole = bytes_of(bag, '/text')
    assert 0 < len(whole) < 600
    player = play(ros_graph, bag, rate=0.0)
    listener = Listener(ros_graph, text=(String, EVERYTHING))
    listener.wait()
    go(ros_graph)
    ros_graph.spin_until(lambda: len(listener.heard) == len(whole), 'the messages')
    assert listener.of('text') == whole == [text(f'{k:03d}') for k in range(len(whole))]
    ros_graph.spin_until(lambda: player.diagnose().severity == Severity.WARNING, 'the report')
    said = player.diagnose().message
    assert 'bag_0.mcap is cut off' in said
    assert 'the recording was not closed' in said


def test_sqlite_and_single_files_are_played(ros_graph: RosGraph, tmp_path: Path) -> None:
    """With their stored QoS."""
    store = get_typestore(Stores.ROS2_JAZZY)
    with Writer(tmp_path / 'bag', version=8, storage_plugin=StoragePlugin.SQLITE3) as writer:
        connection = writer.add_connection('/text', 'std_msgs/msg/String', typestore=store)
        # The later message first: playback is ordered by time.
        for k in (1, 0, 2):
            writer.write(connection, EPOCH + k * MILLISECOND, text(f'{k:03d}'))
    play(ros_graph, next((tmp_path / 'bag').glob('*.db3')), rate=0.0)
    listener = Listener(ros_graph, text=(String, EVERYTHING))
    listener.wait()
    go(ros_graph)
    ros_graph.spin_until(lambda: len(listener.heard) == 3, 'the messages')
    assert listener.of('text') == [text('000'), text('001'), text('002')]


def test_topic_of_a_missing_type_is_skipped_and_reported(
    ros_graph: RosGraph, tmp_path: Path
) -> None:
    """The other topics are played."""
    path = tmp_path / 'bag'
    path.mkdir()
    foreign_bag(path / 'bag_0.mcap')
    player = play(ros_graph, path)
    assert player.diagnose().status.left_out == '/foreign'
    assert player._left_out == {'/foreign': 'lab_msgs/msg/Force is not installed'}
    go(ros_graph)
    ros_graph.spin_until(lambda: player.diagnose().status.messages == 1, 'the rest')


def foreign_bag(file: Path) -> None:
    """Write a message of an installed type, and a message of a missing type."""
    with file.open('wb') as stream:
        writer = McapWriter(stream)
        writer.start('ros2')
        for topic, kind in (('/text', 'std_msgs/msg/String'), ('/foreign', 'lab_msgs/msg/Force')):
            schema = writer.register_schema(kind, 'ros2msg', b'string data')
            channel = writer.register_channel(topic, 'cdr', schema)
            writer.add_message(channel, EPOCH, text('here'), EPOCH)
        writer.finish()


def test_duplicate_publisher_is_reported(ros_graph: RosGraph, tmp_path: Path) -> None:
    """The topic is still played; /diagnostics warns of duplicate messages."""
    probe = ros_graph.node('probe')
    probe.create_publisher(JointState, 'joints', SENSOR)
    player = play(ros_graph, small_bag(tmp_path / 'bag'))
    ros_graph.spin_until(lambda: player.diagnose().severity == Severity.WARNING, 'the warning')
    assert player.diagnose().message == 'other publishers of /joints'


@pytest.mark.parametrize(
    ('parameters', 'complaint'),
    [
        ({'path': ''}, 'path must name a recording to play, got nothing'),
        ({'path': 'none'}, 'none does not exist; valid: a rosbag2 folder, an .mcap or a .db3'),
        ({'path': 'empty'}, 'empty holds no recording'),
        ({'topics': ['/x']}, 'bag has no topic /x; it has /joints (sensor_msgs/msg/JointState), '),
        (
            {'start': 30.0},
            'start = 30 s is beyond the end of bag, whose topics to play end at 0.19',
        ),
        ({'start': 0.061, 'end': 0.062}, 'bag has no message to play from 0.061 s to 0.062 s'),
        ({'start': 3.0, 'end': 2.0}, 'end must be beyond start = 3 s, or 0, got 2 s'),
        ({'rate': 'inf'}, 'rate must be finite, >= 0'),
        ({'speed': 2.0}, "unknown parameter 'speed'"),
        ({'publish_clock': True, 'use_sim_time': True}, 'cannot both be true'),
    ],
)
def test_invalid_parameters_are_rejected_at_start(
    ros_graph: RosGraph,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    parameters: dict[str, Any],
    complaint: str,
) -> None:
    """With a one-line reason, without playback."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'empty').mkdir()
    small_bag(Path('bag'))
    node = ros_graph.add(PlayerNode, start=False, parameters={'path': 'bag', **parameters})
    assert not node.start()
    assert complaint in node.failure
    assert '\n' not in node.failure


def test_recording_without_installed_types_is_rejected(
    ros_graph: RosGraph, tmp_path: Path
) -> None:
    foreign_bag(tmp_path / 'bag.mcap')
    parameters = {'path': str(tmp_path / 'bag.mcap'), 'topics': ['/foreign']}
    node = ros_graph.add(PlayerNode, start=False, parameters=parameters)
    assert not node.start()
    assert 'has nothing to play; /foreign: lab_msgs/msg/Force is not installed' in node.failure


def process(ros_graph: RosGraph, bag: Path, *settings: str) -> subprocess.Popen[str]:
    """Start the player like ``ros2 run``."""
    words = [f'path:={bag}', *settings]
    options = [word for setting in words for word in ('-p', setting)]
    return subprocess.Popen(
        [sys.executable, '-m', 'needle_identification.player_node', '--ros-args', *options],
        env=ros_graph.environment,
        stderr=subprocess.PIPE,
        text=True,
    )


def test_process_ends_after_delivery(ros_graph: RosGraph, tmp_path: Path) -> None:
    """Like `ros2 bag play`: exit status 0, and the subscriber has every message."""
    bag = small_bag(tmp_path / 'bag')
    listener = Listener(ros_graph, text=(String, EVERYTHING))
    with process(ros_graph, bag, 'rate:=5.0', 'paused:=true') as player:
        listener.wait()
        go(ros_graph)
        ros_graph.spin_until(lambda: player.poll() is not None, 'the end of the player')
        _, said = player.communicate()
    assert player.returncode == 0, said
    assert f'played 42 messages of {bag}' in said
    ros_graph.spin_until(lambda: len(listener.heard) >= 20, 'the messages')
    assert listener.of('text') == bytes_of(bag, '/text')


@pytest.mark.parametrize(('rate', 'count'), [(0.0, 3), (1.0, 2)])
def test_process_fails_at_a_damaged_receive_time(
    ros_graph: RosGraph, tmp_path: Path, rate: float, count: int
) -> None:
    """Exit status 1 and the number of messages played: all at rate 0, else those before."""
    with BagWriter(tmp_path / 'bag') as bag:
        bag.add_topic('/text', 'std_msgs/msg/String')
        for late in (0, 1, 10**18):
            bag.write('/text', text('any'), EPOCH + late)
    with process(ros_graph, tmp_path / 'bag', f'rate:={rate}', 'delay:=0.0') as player:
        _, said = player.communicate(timeout=60.0)
    assert player.returncode == 1, said
    assert 'has a damaged receive time at 0.000 s' in said
    assert f'played {count} messages of {tmp_path / "bag"}' in said


def test_process_continues_without_exit_at_end(ros_graph: RosGraph, tmp_path: Path) -> None:
    """Latched messages stay available; SIGINT ends the process with status 0."""
    bag = small_bag(tmp_path / 'bag')
    probe = ros_graph.node('probe')
    with process(ros_graph, bag, 'rate:=0.0', 'delay:=0.0', 'exit_at_end:=false') as player:
        heard = ros_graph.listen(probe, String, 'latched', LATCHED)
        ros_graph.spin_until(
            lambda: heard and heard[-1].data == 'new', 'the message that was latched last'
        )
        player.send_signal(signal.SIGINT)
        _, said = player.communicate(timeout=30.0)
    assert player.returncode == 0, said


def test_failed_start_of_the_process_is_reported(ros_graph: RosGraph, tmp_path: Path) -> None:
    """Exit status 2 and one line."""
    with process(ros_graph, tmp_path / 'none') as player:
        _, said = player.communicate(timeout=60.0)
    assert player.returncode == 2
    assert f'{tmp_path / "none"} does not exist' in said
