# SPDX-License-Identifier: Apache-2.0
"""Slicer node with a plant, a pyigtl peer, and faults."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import closing, ExitStack, suppress
from functools import partial
from itertools import pairwise
from pathlib import Path
import re
import socket
import sys
from typing import Any

from benchmarks.igtl_peer import free_port, Peer, Told
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PointStamped, Pose, PoseArray, PoseStamped, PoseWithCovarianceStamped
from needle_insertion.slicer.link import Frame, Frames, HEADER, LARGEST
from needle_insertion.slicer.needle import LINE, MEASURED, Registration
from needle_insertion.slicer.slicer_node import SlicerNode
from needle_planning import read_plan, write_plan
from needle_ros.base_node import COMMAND, SENSOR
from needle_ros.status import LEVELS, read_reports, SlicerPhase, SlicerStatus
from needle_ros.timing import nanoseconds
import numpy as np
import pyigtl
from pyigtl.messages import MessageBase
import pytest
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from support.anatomies import plan_of
from support.ros_graph import RosGraph
from support.slicer_anatomy import image_message, LABELS, MATRIX, VALUES
from support.slicer_anatomy import TARGET as IN_IMAGE

#: A bent needle at rest, 6 cm deep, with a displaced guide.
PLANT = {'needle': 'bending_35mm', 'steered': True, 'mode': 'robot', 'rate': 200.0, 'depth': 0.06}
HALF = float(np.sqrt(0.5))
REGISTRATION = Registration(rotation=(HALF, 0.0, 0.0, HALF), translation=(0.01, -0.02, 0.03))
IMAGES = {
    'registration.rotation': list(REGISTRATION.rotation),
    'registration.translation': list(REGISTRATION.translation),
}
TARGET = (4e-3, 0.1, -2e-3)


class Room:
    """A graph with a node `slicer`, peers, and an observer."""

    def __init__(self, graph: RosGraph, folder: Path, stack: ExitStack) -> None:
        self.graph, self._folder, self._stack = graph, folder, stack
        self.port = free_port()
        self.probe = graph.node('probe')
        self.targets = graph.listen(self.probe, PointStamped, 'target', COMMAND)
        self.states = graph.statuses(self.probe, SlicerStatus)

    def peer(self, target: Any = ()) -> Peer:
        """Start a peer, which repeats an optional target [m]."""
        in_image = REGISTRATION.to_image(target).tolist() if len(target) else ()
        peer = Peer(self._folder, self.port, in_image)
        self._stack.callback(peer.kill)
        return peer

    def slicer(self, **parameters: Any) -> Any:
        """Create the node in this process."""
        node = self.graph.add(SlicerNode, parameters={'port': self.port, **IMAGES, **parameters})
        self._stack.callback(node.stop)
        return node

    def until(self, condition: Callable[[], Any], what: str) -> None:
        self.graph.spin_until(condition, what, timeout=240.0)

    def wait_for(self, peer: Peer, device: str, count: int = 1) -> list[Told]:
        """Wait for a number of messages of a device, and return all."""
        self.until(lambda: len(peer.told(device)) >= count, f'{device} at the peer')
        return peer.told(device)

    def status(self) -> SlicerStatus:
        """Return the latest status of the node."""
        return (self.states or [SlicerStatus()])[-1]


class Visitor:
    """Peer in this process: the newest message of each device of a plan."""

    def __init__(self, room: Room) -> None:
        self.found: dict[str, Frame] = {}
        self._frames = Frames(self._largest)
        self.socket = socket.socket()
        place = '127.0.0.1', room.port
        room.until(lambda: not self.socket.connect_ex(place), 'a connection')
        self.socket.setblocking(False)

    @staticmethod
    def _largest(_kind: str, device: str) -> int:
        return LARGEST * device.startswith(('NeedlePlan', 'NeedleState'))

    def received(self) -> dict[str, Frame]:
        with suppress(BlockingIOError):
            frames = self._frames.take(self.socket.recv(65536))
            self.found.update((one.device, one) for one in frames)
        return self.found

    def has(self, devices: int) -> bool:
        found = [one for one in self.received() if one != 'NeedleState']
        return len(found) == devices

    def message(self, device: str) -> Any:
        """Return the last message of a device, read by pyigtl."""
        data = self.found[device].data
        found = MessageBase.create_message(self.found[device].kind)
        found.unpack(MessageBase.parse_header(data[: HEADER.size]), data[HEADER.size :])
        return found

    def said(self, words: str, device: str = 'NeedlePlanState') -> bool:
        """Return whether the last state, such as of the planner, has some words."""
        return device in self.received() and words in self.message(device).string

    def send(self, room: Room, data: bytes) -> None:
        sent = 0

        def send() -> bool:
            nonlocal sent
            self.received()
            with suppress(BlockingIOError):
                sent += self.socket.send(data[sent : sent + (1 << 14)])
            return sent == len(data)

        room.until(send, 'the message')

    def close(self) -> None:
        self.socket.close()


def target_message(at: Any) -> bytes:
    """Return a list of markups with a target [mm], as of 3D Slicer."""
    message = pyigtl.PointMessage(np.array([at]), names=['TARGET-1'], device_name='TARGET')
    return bytes(message.pack())


@pytest.fixture
def planning(tmp_path: Path) -> dict[str, Any]:
    """Return the parameters of a node that plans, with its files."""
    (tmp_path / 'labels.yaml').write_text(LABELS)
    labels, output = str(tmp_path / 'labels.yaml'), str(tmp_path / 'plan.yaml')
    return {
        'planning.labels': labels, 'planning.output': output, 'planning.straight': True
    }  # fmt: skip


@pytest.fixture
def room(ros_graph: RosGraph, tmp_path: Path) -> Iterator[Room]:
    with ExitStack() as stack:
        yield Room(ros_graph, tmp_path, stack)


def shapes_at_20_hz(peer: Peer, count: int) -> bool:
    """Return whether a number of consecutive shapes have stamps at 20 Hz."""
    about = [(one.time, int(one.content.split(';')[1])) for one in peer.told('NeedleShapeHeader')]
    for begin in range(len(about) - count):
        (first, _), (last, _) = about[begin], about[begin + count]
        whole = all(b == a + 1 for (_, a), (_, b) in pairwise(about[begin : begin + count + 1]))
        # Stamps of shapes published at 30 Hz: an error of 1/30 s at each end.
        if whole and abs(last - first - count / 20.0) < 0.1:
            return True
    return False


def test_target_is_received_and_needle_is_sent(room: Room) -> None:
    """With the plant as a process: positions in both frames, at 20 Hz."""
    room.graph.start('plant', PLANT)
    room.graph.start('slicer', {'port': room.port, **IMAGES})
    poses = room.graph.latest(room.probe, PoseArray, 'needle_poses', SENSOR)
    tips = room.graph.latest(room.probe, PoseStamped, 'tip_pose', COMMAND)
    peer = room.peer(TARGET)
    room.until(lambda: room.targets, 'the target')
    message = room.targets[-1]
    assert message.header.frame_id == 'needle_entry'
    assert message.header.stamp.sec > 0
    at = message.point
    # Messages have 24 bits: 6e-8 of 0.1 m, in three coordinates.
    np.testing.assert_allclose((at.x, at.y, at.z), TARGET, atol=1e-7)

    # A window of 2 s; a busy machine may need another window.
    room.until(lambda: shapes_at_20_hz(peer, 40), '40 shapes at 20 Hz')
    room.until(lambda: poses.message and tips.message, 'the poses')
    there = [(p.position.x, p.position.y, p.position.z) for p in poses.message.poses]
    seen = peer.told('NeedleShapeZ')[-1]
    # At rest, except for the creep of the guide to its setpoint: 1e-3 mm.
    np.testing.assert_allclose(seen.content, REGISTRATION.to_image(there), atol=1e-3)
    assert peer.told('NeedleShapeHeader')[-1].content.endswith(f';{len(there)};image;{MEASURED}')
    tip = np.array(peer.told('NeedleTip')[-1].content)
    np.testing.assert_allclose(tip[:3, 3], seen.content[-1], atol=1e-3)
    pose, last = tips.message.pose, poses.message.poses[-1]
    assert tips.message.header.frame_id == 'needle_entry'
    for name in ('position', 'orientation'):
        for axis in getattr(pose, name).get_fields_and_field_types():
            ours, theirs = getattr(getattr(pose, name), axis), getattr(getattr(last, name), axis)
            assert ours == pytest.approx(theirs, abs=1e-6)
    # Diagnostics messages; a plant on a busy machine warns of delays.
    room.until(
        lambda: re.search(
            r'^plant \[\w+\]: .+\nslicer \[OK\]: connected with .+; shape: needle_poses$',
            peer.told('NeedleState')[-1].content,
        ),
        'the state of both',
    )


def test_connection_recovers_after_a_kill_of_either_side(room: Room) -> None:
    """The peer reconnects to a new node, and a new peer to the running node."""
    room.graph.start('plant', PLANT)
    node = room.graph.start('slicer', {'port': room.port, **IMAGES})
    first = room.peer(TARGET)
    room.wait_for(first, 'NeedleShapeZ', 5)
    node.kill()
    begin = len(first.told('NeedleShapeZ'))
    node = room.graph.start('slicer', {'port': room.port, **IMAGES})
    room.wait_for(first, 'NeedleShapeZ', begin + 5)
    room.targets.clear()
    room.until(lambda: room.targets, 'the target after the node was killed')

    first.kill()
    second = room.peer(TARGET)
    room.wait_for(second, 'NeedleShapeZ', 5)
    room.targets.clear()
    room.until(lambda: room.targets, 'the target after the peer was killed')
    # With a connected peer, and without a thread to join.
    node.interrupt()


def test_needle_without_shape_sensor_is_a_line(room: Room) -> None:
    """On a robot without needle_poses: from the guide to the tip; the state reports it."""
    room.slicer()
    peer = room.peer()
    joints = room.probe.create_publisher(JointState, 'joint_states', SENSOR)
    tips = room.probe.create_publisher(PointStamped, 'tip_deflection', SENSOR)
    state, tip = JointState(), PointStamped()
    state.name, state.position = ['insertion', 'guide_x', 'guide_z'], [0.05, 1e-3, -2e-3]
    tip.point.x, tip.point.y, tip.point.z = 2e-3, 0.05, 3e-3
    tip.header.stamp.sec, tip.header.frame_id = 12, 'needle_entry'

    def measured() -> bool:
        joints.publish(state)
        tips.publish(tip)
        return bool(peer.told('NeedleShapeHeader'))

    room.until(measured, 'the line')
    assert peer.told('NeedleShapeHeader')[-1].content.endswith(f';2;image;{LINE}')
    line = REGISTRATION.to_image([[1e-3, 0.0, -2e-3], [2e-3, 0.05, 3e-3]])
    points = room.wait_for(peer, 'NeedleShapeZ')[-1]
    np.testing.assert_allclose(points.content, line, atol=1e-4)
    assert points.time == 12.0
    (way,) = np.diff(line, axis=0)
    matrix = np.array(room.wait_for(peer, 'NeedleTip')[-1].content)
    np.testing.assert_allclose(matrix[:3, 1], way / np.linalg.norm(way), atol=1e-6)
    room.until(lambda: room.status().shape_source == LINE, 'the state')
    # Nothing is sent after the end of the inputs.
    room.until(lambda: not room.status().shape_source, 'the end')


def test_needle_of_a_plan_is_sent_to_each_new_peer(room: Room, tmp_path: Path) -> None:
    """As a curve and as a model, in the images whatever the registration is."""
    entry, direction = np.array([0.02, -0.01, 0.1]), np.array([0.6, 0.0, -0.8])
    write_plan(plan_of(entry, direction), tmp_path / 'plan.yaml')
    room.slicer(plan=str(tmp_path / 'plan.yaml'))
    for _ in range(2):
        with closing(Visitor(room)) as peer:
            room.until(partial(peer.has, 2), 'the plan')
        assert peer.found['NeedlePlanModel'].kind == 'POLYDATA'
        points = peer.message('NeedlePlan')
        # Messages have 24 bits.
        np.testing.assert_allclose(points.positions[0], 1e3 * entry, atol=1e-4)
        ends = 1e3 * (entry + 0.06 * direction)
        np.testing.assert_allclose(points.positions[-1], ends, atol=1e-4)


def test_functions_of_plans_are_prepared_before_activation(
    room: Room, planning: dict[str, Any]
) -> None:
    """And only with labels."""
    for parameters, wanted in (({}, False), (planning, True)):
        node = room.graph.add(SlicerNode, start=False, parameters=parameters)
        steps = {step.step for step in node.preparation()}
        assert ({'scipy.optimize', 'line_clearances'} <= steps) == wanted


def test_segmentation_and_target_become_a_plan(room: Room, planning: dict[str, Any]) -> None:
    """Sent and written, by the node as a process; no target starts an insertion."""
    room.graph.start('slicer', {'port': room.port, **planning})
    room.until(lambda: room.states, 'the node')
    with closing(Visitor(room)) as peer:
        peer.send(room, image_message(VALUES, MATRIX))
        room.until(lambda: peer.said('segmentation with 3 structures'), 'the segmentation')
        peer.send(room, target_message(IN_IMAGE))
        room.until(lambda: peer.said('plan for the target'), 'the plan')
        room.until(partial(peer.has, 3), 'the needle')
        plan = read_plan(planning['planning.output'])
        # Messages have 24 bits.
        np.testing.assert_allclose(1e3 * plan.target, IN_IMAGE, atol=1e-4)
        points = peer.message('NeedlePlan').positions
        np.testing.assert_allclose(points[0], 1e3 * plan.entry, atol=1e-4)
        np.testing.assert_allclose(points[-1], IN_IMAGE, atol=1e-3)
        assert peer.found['NeedlePlanModel'].kind == 'POLYDATA'
        peer.send(room, target_message([500.0, 0.0, 0.0]))
        room.until(lambda: peer.said('is outside the image'), 'the failure')
        assert peer.said('no plan for the target (500.0, 0.0, 0.0) mm')
        room.until(lambda: 'no plan' in room.status().planning, 'the status')
    assert room.status().targets == 2
    assert not room.targets


def test_lost_and_damaged_segmentations_are_one_line(room: Room, planning: dict[str, Any]) -> None:
    """The next one is planned, for another peer and the target of the lost one."""
    node = room.slicer(**planning)
    image = image_message(VALUES, MATRIX)
    with closing(Visitor(room)) as peer:
        peer.send(room, target_message(IN_IMAGE) + image[: len(image) // 2])
        room.until(lambda: peer.said('waits for the label map'), 'the target')
    room.until(lambda: node.diagnose().status.rejected, 'the rejection')
    line, lost = node.diagnose().status.last_rejection, 'SEGMENTATION: connection lost,'
    assert re.fullmatch(rf'segmentation refused: {lost} \d+ of {len(image)} bytes received', line)
    assert node.diagnose().status.planning == line
    with closing(Visitor(room)) as peer:
        peer.send(room, image[:-1] + b'\1')
        room.until(lambda: peer.said('segmentation refused: SEGMENTATION: the message is'), '')
        peer.send(room, image)
        room.until(lambda: peer.said('plan for the target'), 'the plan')
    assert not room.targets


@pytest.mark.parametrize('plans', [False, True])
def test_refused_target_is_sent_until_one_is_accepted(
    plans: bool, room: Room, planning: dict[str, Any]
) -> None:
    """In the state of the nodes, and with labels in that of the planner."""
    node = room.slicer(**(planning if plans else {}))
    valid = REGISTRATION.to_image(TARGET).tolist()
    far = pyigtl.TransformMessage(np.diag([2.0, 1.0, 1.0, 1.0]), device_name='TARGET').pack()
    damaged = target_message(valid)[:-1] + b'\1'
    with closing(Visitor(room)) as peer:
        for data, reason in (
            (target_message([float('nan'), 0.0, 0.0]), 'target refused: it must be three finite'),
            (damaged, 'target refused: the message is damaged'),
            (far, 'target refused: the matrix of a TRANSFORM must be a rotation'),
        ):
            peer.send(room, target_message(valid))
            room.until(lambda: 'refused' not in node.diagnose().message, 'the target')
            peer.send(room, data)
            room.until(partial(peer.said, reason, 'NeedleState'), reason)
            if plans:
                room.until(partial(peer.said, reason), 'the state of the planner')
        peer.send(room, target_message(valid))
        room.until(lambda: not peer.said('refused', 'NeedleState'), 'the next target')


def test_ignored_devices_are_named_once(room: Room, capfd: pytest.CaptureFixture[str]) -> None:
    """With what is accepted, and no line for types that are no target."""
    node = room.slicer()
    ignored = [
        pyigtl.PointMessage(np.zeros((1, 3)), names=['a'], device_name='Target'),
        pyigtl.TransformMessage(np.eye(4), device_name='target'),
        pyigtl.ImageMessage(np.zeros((2, 2, 2), dtype=np.uint8), device_name='SEGMENTATION'),
        pyigtl.PolyDataMessage(
            points=np.zeros((3, 3)), polygons=np.array([3, 0, 1, 2]), device_name='Liver'
        ),
    ]
    data = b''.join(one.pack() for one in ignored)
    with closing(Visitor(room)) as peer:
        for _ in range(3):
            peer.send(room, data)
        peer.send(room, target_message(REGISTRATION.to_image(TARGET)))
        room.until(lambda: room.targets, 'the target')
    lines = [one for one in capfd.readouterr().err.splitlines() if ' is ignored: ' in one]
    names = [
        re.search(r"(\w+) of '(\w+)' is ignored: a target is a point named", one) for one in lines
    ]
    assert [one.groups() for one in names if one] == [
        ('TRANSFORM', 'target'), ('IMAGE', 'SEGMENTATION'), ('POINT', 'Target')
    ]  # fmt: skip
    assert node.diagnose().status.targets == 1


def test_predicted_tip_pose_is_sent(room: Room) -> None:
    """Also to a later peer; an invalid pose is not sent."""
    node = room.slicer()
    expected = room.probe.create_publisher(PoseWithCovarianceStamped, 'tip_expected', COMMAND)
    room.until(expected.get_subscription_count, 'the node')
    message = PoseWithCovarianceStamped()
    message.header.frame_id = 'needle_entry'
    position = message.pose.pose.position
    position.x, position.y, position.z = 1e-3, 0.1, float('nan')
    message.pose.pose.orientation.w = 1.0
    expected.publish(message)
    room.until(lambda: node.diagnose().status.rejected == 1, 'the rejection')
    assert 'tip_expected refused' in node.diagnose().status.last_rejection
    position.z = 2e-3
    expected.publish(message)
    for _ in range(2):
        peer = room.peer()
        told = room.wait_for(peer, 'NeedleTipExpected')[-1]
        at = np.array(told.content)[:3, 3]
        np.testing.assert_allclose(at, REGISTRATION.to_image([1e-3, 0.1, 2e-3]), atol=1e-4)
        peer.kill()


def test_invalid_needle_poses_are_rejected(room: Room) -> None:
    """With one line; the node sends the next valid needle."""
    node = room.slicer()

    def refused(complaint: str) -> bool:
        return complaint in node.diagnose().status.last_rejection

    # Best effort, as a driver may offer.
    poses = room.probe.create_publisher(PoseArray, 'needle_poses', SENSOR)
    room.until(poses.get_subscription_count, 'the node')
    good = PoseArray(poses=[Pose(), Pose()])
    good.poses[1].position.y = 0.1
    # As of a plant with a prefix.
    good.header.frame_id = 'left/needle_entry'
    bad = [
        (PoseArray(), 'it has 0 poses'),
        (PoseArray(poses=[Pose(), Pose()]), 'a position is not within 10 m'),
        (PoseArray(poses=[Pose(), Pose()]), 'of norm 0'),
        (PoseArray(poses=[Pose(), Pose()]), "its frame must be needle_entry or none, got 'map'"),
    ]
    bad[1][0].poses[0].position.x = float('inf')
    bad[2][0].poses[1].orientation.w = 0.0
    bad[3][0].header.frame_id = 'map'
    for message, complaint in bad:
        poses.publish(message)
        room.until(partial(refused, complaint), complaint)
    poses.publish(good)
    room.until(lambda: node.diagnose().status.shape_source == MEASURED, 'the shape')


def test_target_flood_is_reported_once_and_the_newest_is_used(
    room: Room, capfd: pytest.CaptureFixture[str]
) -> None:
    """Also for invalid targets: at most one line a second, and shapes continue."""
    node = room.slicer()
    room.until(lambda: room.status().phase is SlicerPhase.WAITING, 'the node')
    # On the axis of the needle, increasing in depth to 10 cm.
    depths = [*np.linspace(0.01, 0.09, 2000).tolist(), *[float('nan')] * 2000, 0.1]
    flood = b''.join(
        pyigtl.StringMessage(' '.join(map(repr, at)), device_name='TARGET').pack()
        for at in REGISTRATION.to_image([[0.0, depth, 0.0] for depth in depths]).tolist()
    )
    with closing(socket.create_connection(('127.0.0.1', room.port))) as one:
        sent = 0
        one.setblocking(False)

        def send() -> bool:
            nonlocal sent
            with suppress(BlockingIOError):
                sent += one.send(flood[sent : sent + (1 << 14)])
            return sent == len(flood)

        room.until(send, 'the flood')
        room.until(
            lambda: room.targets and abs(room.targets[-1].point.y - 0.1) < 1e-6, 'the last target'
        )
    # Fewer than sent; superseded targets of the same moment are dropped.
    assert node.diagnose().status.targets < 1000
    lines = capfd.readouterr().err.splitlines()
    for words in ('only the newest target is used', 'target refused: it must be three finite'):
        times = [float(line.split('[')[2].split(']')[0]) for line in lines if words in line]
        assert times
        assert all(later - earlier > 0.9 for earlier, later in pairwise(times))


def test_targets_while_simulated_time_stands_still_are_two_requests(room: Room) -> None:
    """The stamp identifies a request; the second would get the answer of the first."""
    node = room.slicer(use_sim_time=True)
    clock = room.probe.create_publisher(Clock, '/clock', 10)
    room.until(lambda: room.status().phase is SlicerPhase.WAITING, 'the node')
    visitor = Visitor(room)

    def send(depth: float) -> int:
        """Send a target, and return its stamp [ns]."""
        at = ' '.join(map(repr, REGISTRATION.to_image([0.0, depth, 0.0]).tolist()))
        visitor.send(room, pyigtl.StringMessage(at, device_name='TARGET').pack())
        room.until(lambda: depth in depths(), f'the target at {depth} m')
        return depths()[depth]

    def depths() -> dict[float, int]:
        return {round(one.point.y, 3): nanoseconds(one.header.stamp) for one in room.targets}

    def stands() -> bool:
        clock.publish(Clock(clock=Time(sec=5)))
        return bool(node.get_clock().now().nanoseconds == 5_000_000_000)

    room.until(stands, 'the time')
    with closing(visitor.socket):
        assert [send(0.06), send(0.07)] == [5_000_000_000, 5_000_000_001]


def test_port_in_use_is_reported_and_retried(room: Room) -> None:
    """On /diagnostics; the node listens as soon as the port is free."""
    levels: list[int] = []

    def take(message: DiagnosticArray) -> None:
        levels.extend(one.level for one in read_reports(message) if one.node == '/slicer')

    room.probe.create_subscription(DiagnosticArray, '/diagnostics', take, 10)
    with closing(socket.create_server(('127.0.0.1', room.port))):
        room.slicer()
        room.until(lambda: room.status().phase is SlicerPhase.ERROR, 'the error')
        assert 'the port is in use' in room.status().error
        room.until(lambda: LEVELS.index('ERROR') in levels, 'the level')
    room.until(lambda: room.status().phase is SlicerPhase.WAITING, 'the port')
    with closing(socket.create_connection(('127.0.0.1', room.port))):
        room.until(lambda: room.status().phase is SlicerPhase.CONNECTED, 'the peer')


def test_slicer_ros2_can_subscribe(room: Room) -> None:
    """SlicerROS2 requests reliable topics, with a depth of 100."""
    room.graph.start('plant', PLANT)
    room.slicer()
    poses = room.graph.listen(room.probe, PoseArray, 'needle_poses', 100)
    tips = room.graph.listen(room.probe, PoseStamped, 'tip_pose', 100)
    room.until(lambda: poses and tips, 'shape and tip')


@pytest.mark.parametrize(
    ('parameters', 'complaint'),
    [
        (
            {'registration.rotation': [0.0, 0.0, 0.0, 0.0]},
            'registration.rotation must be a quaternion x, y, z, w of norm 1',
        ),
        ({'host': 'slicer'}, 'host must be an IPv4 address such as 127.0.0.1'),
        ({'role': 'both'}, 'role must be one of server, client'),
        ({'planning.labels': 'none.yaml'}, 'none.yaml cannot be read: No such file or directory'),
        ({'planning.turns': 1}, 'turns must be 0'),
    ],
)
def test_invalid_parameters_are_rejected(
    ros_graph: RosGraph, parameters: dict[str, Any], complaint: str
) -> None:
    """One line with the parameter."""
    node = ros_graph.add(SlicerNode, parameters=parameters, start=False)
    assert not node.start()
    assert complaint in node.failure
    assert '\n' not in node.failure


def test_missing_pyigtl_is_reported_with_its_installation(
    ros_graph: RosGraph, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The node refuses to start; the module itself can be imported."""
    monkeypatch.setitem(sys.modules, 'pyigtl', None)
    node = ros_graph.add(SlicerNode, start=False)
    assert not node.start()
    assert node.failure == (
        "the Python package pyigtl is not installed: python3 -m pip install 'pyigtl>=0.3.4'"
    )
