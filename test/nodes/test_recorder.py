# SPDX-License-Identifier: Apache-2.0
"""Recording of messages byte for byte, with any end of the recorder."""

from collections.abc import Callable, Iterator
import errno
from pathlib import Path
import signal
import subprocess
import sys
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import Point, Pose, PoseStamped
from nav_msgs.msg import Goals
from needle_identification import Bag, BagWriter
from needle_identification.bags.bag import message_counts, read_topic
from needle_identification.bags.messages import definition_of
from needle_identification.bags.topics import UNLIMITED
from needle_identification.recorder_node import RecorderNode
from needle_ros.base_node import COMMAND, LATCHED, SENSOR
from needle_ros.event_log import Severity
from needle_ros.status import RecorderStatus
import pytest
from rcl_interfaces.msg import Log
from rclpy.duration import Duration
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import Trigger
from support.installed import ROOT
from support.ros_graph import RosGraph
import yaml


@pytest.fixture
def record(ros_graph: RosGraph) -> Iterator[Callable[..., Any]]:
    """Return a factory of active recorders, whose bags are closed at the end."""
    nodes = []

    def make(path: Path, **parameters: list[str]) -> RecorderNode:
        nodes.append(ros_graph.add(RecorderNode, parameters={'path': str(path), **parameters}))
        return nodes[-1]

    yield make
    for node in nodes:
        node.stop()


def call(ros_graph: RosGraph, service: str) -> tuple[bool, str]:
    client = ros_graph.node('caller').create_client(Trigger, service)
    ros_graph.spin_until(client.service_is_ready, service)
    answer = client.call_async(Trigger.Request())
    ros_graph.spin_until(answer.done, 'answer')
    return answer.result().success, answer.result().message


def test_topics_are_recorded_with_their_offered_qos(
    ros_graph: RosGraph, record: Callable[..., Any], tmp_path: Path
) -> None:
    """Best effort, reliable and latched topics are complete, byte for byte."""
    probe = ros_graph.node('probe')
    publishers = {
        topic: probe.create_publisher(kind, topic, qos)
        for topic, kind, qos in (
            ('sensor', JointState, SENSOR),
            ('command', String, COMMAND),
            ('latched', String, LATCHED),
        )
    }
    publishers['latched'].publish(String(data='before the recorder'))
    node = record(tmp_path / 'bag')
    ros_graph.spin_until(
        lambda: all(p.get_subscription_count() for p in publishers.values()), 'subscriptions'
    )
    sent = [JointState(name=['insertion'], position=[i / 3.0]) for i in range(50)]
    for message in sent:
        publishers['sensor'].publish(message)
    publishers['command'].publish(String(data='go'))
    ros_graph.spin_until(
        lambda: (
            node.diagnose().status.recorded.get('/sensor') == len(sent)
            and node.diagnose().status.recorded.get('/command')
            and node.diagnose().status.recorded.get('/latched')
            and node.diagnose().status.recorded.get('/recorder/configuration')
        ),
        'the messages',
    )
    node.stop()
    assert [m.position[0] for _, m in read_topic(tmp_path / 'bag', '/sensor')] == [
        message.position[0] for message in sent
    ]
    [(received, latched)] = read_topic(tmp_path / 'bag', '/latched')
    assert latched.data == 'before the recorder'
    assert abs(time.time_ns() - received) < 60e9
    counts = message_counts(tmp_path / 'bag')
    assert counts['/recorder/configuration'] == 1
    assert not {'/rosout', '/parameter_events'} & set(counts)
    information = yaml.safe_load((tmp_path / 'bag' / 'metadata.yaml').read_text())
    offered = {
        topic['topic_metadata']['name']: topic['topic_metadata']['offered_qos_profiles'][0]
        for topic in information['rosbag2_bagfile_information']['topics_with_message_count']
    }
    assert offered['/sensor']['reliability'] == 'best_effort'
    assert offered['/latched']['durability'] == 'transient_local'


def test_measurements_are_subscribed_best_effort(
    ros_graph: RosGraph, record: Callable[..., Any], tmp_path: Path
) -> None:
    """For any offered QoS; the bag contains the offered QoS."""
    probe = ros_graph.node('probe')
    topics = ('/lab/joint_states', '/lab/other')
    for topic in topics:
        probe.create_publisher(JointState, topic, COMMAND)
    node = record(tmp_path / 'bag', topics=list(topics))
    ros_graph.spin_until(
        lambda: all(map(probe.get_subscriptions_info_by_topic, topics)), 'the recorder'
    )
    requested = [
        [one.qos_profile.reliability.name for one in probe.get_subscriptions_info_by_topic(topic)]
        for topic in topics
    ]
    assert requested == [['BEST_EFFORT'], ['RELIABLE']]
    node.stop()
    information = yaml.safe_load((tmp_path / 'bag' / 'metadata.yaml').read_text())
    offered = {
        topic['topic_metadata']['offered_qos_profiles'][0]['reliability']
        for topic in information['rosbag2_bagfile_information']['topics_with_message_count']
        if topic['topic_metadata']['name'] in topics
    }
    assert offered == {'reliable'}


def test_messages_are_stored_byte_for_byte(
    ros_graph: RosGraph,
    record: Callable[..., Any],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Without decoding."""
    written = []
    monkeypatch.setattr(BagWriter, 'write', lambda _bag, *what: written.append(what))
    publisher = ros_graph.node('probe').create_publisher(String, 'text', COMMAND)
    record(tmp_path / 'bag', topics=['text'])
    ros_graph.spin_until(publisher.get_subscription_count, 'subscription')
    publisher.publish(String(data='as it is'))
    ros_graph.spin_until(lambda: written, 'the message')
    assert written[0][:2] == ('/text', serialize_message(String(data='as it is')))


def test_publisher_with_weaker_qos_is_recorded(
    ros_graph: RosGraph, record: Callable[..., Any], tmp_path: Path
) -> None:
    """A best-effort publisher on a reliable topic makes the recorder request less."""
    probe = ros_graph.node('probe')
    reliable = probe.create_publisher(String, 'text', COMMAND)
    node = record(tmp_path / 'bag', topics=['text'])
    ros_graph.spin_until(reliable.get_subscription_count, 'subscription')
    weak = probe.create_publisher(String, 'text', SENSOR)
    ros_graph.spin_until(weak.get_subscription_count, 'the new subscription')

    def both_recorded() -> bool:
        # Repeated: each publisher discovers the new subscription at another time.
        weak.publish(String(data='weak'))
        reliable.publish(String(data='strong'))
        if not node.diagnose().status.messages:
            return False
        node._flush()
        return {m.data for _, m in read_topic(tmp_path / 'bag', '/text')} == {'weak', 'strong'}

    ros_graph.spin_until(both_recorded, 'messages of both')
    node.stop()


def test_topic_of_an_unknown_type_is_reported_once(
    ros_graph: RosGraph, record: Callable[..., Any], tmp_path: Path
) -> None:
    """The other topics are recorded."""
    probe = ros_graph.node('probe')
    logs = ros_graph.listen(probe, Log, '/rosout', 100)
    goals = probe.create_publisher(Goals, 'goals', COMMAND)
    text = probe.create_publisher(String, 'text', COMMAND)
    node = record(tmp_path / 'bag', topics=['goals', 'text'])
    ros_graph.spin_until(text.get_subscription_count, 'subscription')
    reports = ros_graph.listen(probe, DiagnosticArray, '/diagnostics', 10)
    # The recorder checks the graph ten times a second.
    ros_graph.spin_until(lambda: len(reports) >= 2, 'a few more checks')
    assert set(node.diagnose().status.recorded) == {'/text'}
    assert goals.get_subscription_count() == 0
    [said] = [log.msg for log in logs if 'left out' in log.msg]
    assert said.startswith('/goals left out: no definition of nav_msgs/msg/Goals')


def test_services_stop_and_start_recordings(
    ros_graph: RosGraph, record: Callable[..., Any], tmp_path: Path
) -> None:
    """Each recording has a new, complete folder; repeated calls have no effect."""
    record(tmp_path / 'bag')
    assert call(ros_graph, 'recorder/start') == (True, f'recording to {tmp_path / "bag"}')
    success, message = call(ros_graph, 'recorder/stop')
    assert success
    assert message.endswith(f'messages to {tmp_path / "bag"}')
    assert (tmp_path / 'bag' / 'metadata.yaml').exists()
    assert call(ros_graph, 'recorder/stop') == (True, message)
    again = tmp_path / 'bag_2'
    assert call(ros_graph, 'recorder/start') == (True, f'recording to {again}')
    assert call(ros_graph, 'recorder/stop')[0]
    assert (again / 'metadata.yaml').exists()


def test_bag_is_complete_after_an_error_of_the_node(
    ros_graph: RosGraph, record: Callable[..., Any], tmp_path: Path
) -> None:
    """An error of a transition ends the configuration, and its recording with it."""
    node = record(tmp_path / 'bag')

    def fail() -> None:
        raise ValueError('an error')

    node.deactivate = fail
    assert node.trigger_deactivate() == TransitionCallbackReturn.ERROR
    assert node.diagnose().message == 'not recording'
    assert (tmp_path / 'bag' / 'metadata.yaml').exists()


@pytest.mark.parametrize(
    ('parameters', 'complaint'),
    [
        ({}, 'path must name a folder to record to, got nothing'),
        ({'path': 'here'}, 'here exists; a recording must go to a new folder'),
        (
            {'path': 'x', 'compression': 'zip'},
            "compression must be one of zstd, lz4, none, got 'z",
        ),
    ],
)
def test_invalid_parameters_are_rejected_at_start(
    ros_graph: RosGraph,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    parameters: dict[str, str],
    complaint: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'here').mkdir()
    node = ros_graph.add(RecorderNode, start=False, parameters=parameters)
    assert not node.start()
    assert complaint in node.failure


def test_disk_error_ends_the_recording_and_is_reported(
    ros_graph: RosGraph,
    record: Callable[..., Any],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The node continues, and /diagnostics reports the error."""
    probe = ros_graph.node('probe')
    publisher = probe.create_publisher(String, 'text', COMMAND)
    reports = ros_graph.listen(probe, DiagnosticArray, '/diagnostics', 10)
    node = record(tmp_path / 'bag', topics=['text'])
    ros_graph.spin_until(publisher.get_subscription_count, 'subscription')

    def full(*_arguments: Any) -> None:
        raise OSError(errno.ENOSPC, 'No space left on device')

    monkeypatch.setattr(BagWriter, 'write', full)
    publisher.publish(String(data='too much'))
    ros_graph.spin_until(
        lambda: any(r.status[0].level == DiagnosticStatus.ERROR for r in reports), 'the report'
    )
    expected = f'recording to {tmp_path / "bag"} stopped: No space left on device'
    assert node.failure == reports[-1].status[0].message == expected
    assert node.is_active
    assert not (tmp_path / 'bag' / 'metadata.yaml').exists()


def test_full_disk_sets_the_exit_status(ros_graph: RosGraph, tmp_path: Path) -> None:
    """Status 1 after Ctrl-C, with a one-line reason."""
    script = ROOT / 'scripts/recorder'
    node = subprocess.Popen(
        [
            # Limit files to 64 kB.
            *('bash', '-c', f'ulimit -f 64; exec {sys.executable} {script} --ros-args "$@"', ''),
            *('-p', f'path:={tmp_path / "bag"}', '-p', 'compression:=none'),
        ],
        env=ros_graph.environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    assert node.stdout is not None
    publisher = ros_graph.node('probe').create_publisher(String, 'text', COMMAND)
    ros_graph.spin_until(publisher.get_subscription_count, 'the recorder')
    for _ in range(20):
        publisher.publish(String(data=20_000 * 'x'))
    assert any('stopped: File too large' in line for line in node.stdout)
    node.send_signal(signal.SIGINT)
    node.communicate(timeout=60.0)
    assert node.returncode == 1


def test_qos_of_later_publishers_is_recorded(
    ros_graph: RosGraph, record: Callable[..., Any], tmp_path: Path
) -> None:
    """Deadline, lifespan and lease too; the player offers a QoS common to all publishers."""
    probe = ros_graph.node('probe')
    timed = QoSProfile(
        depth=5,
        deadline=Duration(seconds=2.5),
        lifespan=Duration(seconds=30.0),
        liveliness_lease_duration=Duration(seconds=1.5),
    )
    first = probe.create_publisher(String, 'text', timed)
    node = record(tmp_path / 'bag', topics=['text'])
    ros_graph.spin_until(first.get_subscription_count, 'subscription')
    first.publish(String(data='first'))
    ros_graph.spin_until(
        lambda: node.diagnose().status.recorded.get('/text') == 1, 'the first message'
    )
    later = probe.create_publisher(String, 'text', COMMAND)
    ros_graph.spin_until(lambda: len(node._recorded['/text'].offered) == 2, 'the later publisher')
    ros_graph.spin_until(later.get_subscription_count, 'subscription')
    later.publish(String(data='later'))
    ros_graph.spin_until(
        lambda: node.diagnose().status.recorded.get('/text') == 2, 'the second message'
    )
    node.stop()
    (topic,) = Bag(tmp_path / 'bag').topics()
    one, two = topic.offered_qos()
    assert (one.deadline, one.lifespan, one.liveliness_lease_duration) == (
        2_500_000_000, 30_000_000_000, 1_500_000_000
    )  # fmt: skip
    assert (two.deadline, two.lifespan) == (UNLIMITED, UNLIMITED)
    information = yaml.safe_load((tmp_path / 'bag' / 'metadata.yaml').read_text())
    (listed,) = information['rosbag2_bagfile_information']['topics_with_message_count']
    assert listed['message_count'] == 2
    assert listed['topic_metadata']['offered_qos_profiles'] == [
        one.as_mapping(), two.as_mapping()
    ]  # fmt: skip
    assert {m.data for _, m in read_topic(tmp_path / 'bag', '/text')} == {'first', 'later'}


def test_custom_message_type_is_recorded(
    ros_graph: RosGraph,
    record: Callable[..., Any],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Its definition and nested definitions are read from the sourced workspace."""
    for name, text in {
        'nav_msgs/msg/Goals': 'std_msgs/Header header\ngeometry_msgs/PoseStamped[] goals\n',
        'own_msgs/msg/Plan': 'nav_msgs/Goals[2] parts\nOther[<=3] others\n',
        'own_msgs/msg/Other': 'uint8 KIND=3\nfloat64[] values\n',
    }.items():
        path = tmp_path / 'prefix/share' / f'{name}.msg'
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    monkeypatch.setenv('AMENT_PREFIX_PATH', f'/no/such:{tmp_path / "prefix"}')
    publisher = ros_graph.node('probe').create_publisher(Goals, 'goals', COMMAND)
    node = record(tmp_path / 'bag', topics=['goals'])
    ros_graph.spin_until(publisher.get_subscription_count, 'subscription')
    publisher.publish(Goals(goals=[PoseStamped(pose=Pose(position=Point(x=0.5)))]))
    ros_graph.spin_until(lambda: node.diagnose().status.recorded.get('/goals') == 1, 'the message')
    node.stop()
    # Decoded with the definition in the bag.
    [(_, message)] = read_topic(tmp_path / 'bag', '/goals')
    assert message.goals[0].pose.position.x == 0.5
    definition, _ = definition_of('own_msgs/msg/Plan')
    assert 'nav_msgs/Goals[2] parts' in definition
    assert 'MSG: own_msgs/Other\nuint8 KIND=3\nfloat64[] values' in definition
    assert 'MSG: geometry_msgs/Quaternion' in definition


def publish(ros_graph: RosGraph, node: Node, count: int) -> None:
    """Publish numbers on /text at 100 Hz, once the recorder has subscribed."""
    publisher = node.create_publisher(String, 'text', COMMAND)
    ros_graph.spin_until(publisher.get_subscription_count, 'the recorder')
    for i in range(count):
        publisher.publish(String(data=str(i)))
        time.sleep(0.01)


def test_recorded_messages_survive_kill_9(ros_graph: RosGraph, tmp_path: Path) -> None:
    """After SIGKILL only the last half second is missing, and the folder is incomplete."""
    process = ros_graph.start('recorder', {'path': str(tmp_path / 'bag')}).process
    publish(ros_graph, ros_graph.node('probe'), 200)
    process.kill()
    process.wait()
    assert not (tmp_path / 'bag' / 'metadata.yaml').exists()
    data = [message.data for _, message in read_topic(tmp_path / 'bag', '/text')]
    assert data == [str(i) for i in range(len(data))]
    # Half a second is 50 messages; twice that for a busy machine.
    assert len(data) >= 100


def test_ctrl_c_completes_the_bag(ros_graph: RosGraph, tmp_path: Path) -> None:
    """After SIGINT the bag has every message and its metadata."""
    process = ros_graph.start('recorder', {'path': str(tmp_path / 'bag')})
    probe = ros_graph.node('probe')
    reports = ros_graph.statuses(probe, RecorderStatus)
    publish(ros_graph, probe, 50)
    ros_graph.spin_until(
        lambda: any(one.recorded.get('/text') == 50 for one in reports), 'messages'
    )
    process.interrupt()
    assert (tmp_path / 'bag' / 'metadata.yaml').exists()
    assert message_counts(tmp_path / 'bag')['/text'] == 50


def test_lost_messages_are_counted_and_reported(
    ros_graph: RosGraph, record: Callable[..., Any], tmp_path: Path
) -> None:
    """By topic, in diagnostics, summary and bag, after an overflow of the queue."""
    probe = ros_graph.node('probe')
    flood = probe.create_publisher(JointState, 'flood', SENSOR)
    calm = probe.create_publisher(String, 'calm', COMMAND)
    node = record(tmp_path / 'bag', topics=['flood', 'calm'])
    ros_graph.spin_until(
        lambda: flood.get_subscription_count() and calm.get_subscription_count(), 'subscriptions'
    )
    flood.publish(JointState())
    calm.publish(String())

    def counts() -> tuple[int, int]:
        recorded = node.diagnose().status.recorded
        return recorded['/flood'], recorded['/calm']

    ros_graph.spin_until(lambda: counts() == (1, 1), 'the first')
    assert node.diagnose().severity == Severity.INFO
    sent = 20_000
    for _ in range(sent):
        # The queue is full: the recorder is in this thread and is not spun.
        flood.publish(JointState())
    ros_graph.spin_until(lambda: node.diagnose().severity == Severity.WARNING, 'the warning')
    flood.publish(JointState())
    calm.publish(String())

    def are_all_there() -> bool:
        lost = node.diagnose().status.lost['/flood']
        return counts()[1] == 2 and counts()[0] + lost == sent + 2

    ros_graph.spin_until(are_all_there, 'the rest')
    message, status = node.diagnose().message, node.diagnose().status
    lost = status.lost['/flood']
    assert lost > 0
    assert message.endswith(f'lost {lost} of /flood')
    _, answer = call(ros_graph, 'recorder/stop')
    assert answer.endswith(f'; lost {lost} of /flood')
    bag = Bag(tmp_path / 'bag')
    assert bag.losses == [f'the recorder lost {lost} of /flood']
    assert message_counts(tmp_path / 'bag')['/flood'] == status.recorded['/flood']


@pytest.mark.parametrize('earlier', [0, 500])
def test_second_publisher_is_no_loss(
    ros_graph: RosGraph, record: Callable[..., Any], tmp_path: Path, earlier: int
) -> None:
    """Of a topic; it may have published `earlier` messages before, and end again."""
    probe = ros_graph.node('probe')
    deep = QoSProfile(depth=1000)
    first = probe.create_publisher(String, 'text', deep)
    node = record(tmp_path / 'bag', topics=['text'])
    ros_graph.spin_until(first.get_subscription_count, 'the subscription')
    for _ in range(100):
        first.publish(String())
    ros_graph.spin_until(lambda: node.diagnose().status.recorded['/text'] == 100, 'the first')
    stranger = ros_graph.node('stranger')
    second = stranger.create_publisher(String, 'text', deep)
    for _ in range(earlier):
        second.publish(String())
    # Without events of the graph: the recorder has not discovered the publisher of its messages.
    for _ in range(3000):
        if second.get_subscription_count():
            break
        time.sleep(0.01)
    else:
        pytest.fail('the recorder did not subscribe within 30 s')
    for one in (first, second, first):
        one.publish(String())
        node._take(1000)
    stranger.destroy_publisher(second)
    ros_graph.spin_until(lambda: probe.count_publishers('text') == 1, 'its end')
    for _ in range(50):
        first.publish(String())
    ros_graph.spin_until(lambda: node.diagnose().status.recorded['/text'] >= 153, 'the rest')
    assert node.diagnose().status.lost == {}
