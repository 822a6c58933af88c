"""The node that speaks with 3D Slicer: a plant, a peer by pyigtl, and what may go wrong."""

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
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import (
    PointStamped,
    Pose,
    PoseArray,
    PoseStamped,
    PoseWithCovarianceStamped,
)
from needle_insertion.slicer.needle import LINE, MEASURED
from needle_insertion.slicer.registration import Registration
from needle_insertion.slicer.slicer_node import SlicerNode
from needle_ros.base_node import COMMAND, SENSOR
import numpy as np
import pyigtl
import pytest
from sensor_msgs.msg import JointState
from support.ros_graph import RosGraph

#: A needle that bends, at rest 6 cm deep with its guide aside.
PLANT = {
    'model.preset': 'bending_35mm',
    'steered': True,
    'mode': 'robot',
    'rate': 200.0,
    'depth': 0.06,
}
HALF = float(np.sqrt(0.5))
REGISTRATION = Registration(rotation=(HALF, 0.0, 0.0, HALF), translation=(0.01, -0.02, 0.03))
IMAGES = {
    'registration.rotation': list(REGISTRATION.rotation),
    'registration.translation': list(REGISTRATION.translation),
}
TARGET = (4e-3, 0.1, -2e-3)


class Room:
    """A graph with a node `slicer`, peers, and one who watches."""

    def __init__(self, graph: RosGraph, folder: Path, stack: ExitStack) -> None:
        self.graph, self._folder, self._stack = graph, folder, stack
        self.port = free_port()
        self.probe = graph.node('probe')
        self.targets = graph.listen(self.probe, PointStamped, 'target', COMMAND)
        self.states = graph.listen(self.probe, DiagnosticArray, '/diagnostics', 10)

    def peer(self, target: Any = ()) -> Peer:
        """Start a peer; it repeats a target [m] if it is given one."""
        in_image = REGISTRATION.to_image(target).tolist() if len(target) else ()
        peer = Peer(self._folder, self.port, in_image)
        self._stack.callback(peer.kill)
        return peer

    def slicer(self, **parameters: Any) -> Any:
        """Make the node in this process."""
        node = self.graph.add(SlicerNode, parameters={'port': self.port, **IMAGES, **parameters})
        self._stack.callback(node.stop)
        return node

    def until(self, condition: Callable[[], Any], what: str) -> None:
        self.graph.spin_until(condition, what, timeout=240.0)

    def wait_for(self, peer: Peer, device: str, count: int = 1) -> list[Told]:
        """Wait for so many messages of a device, and return all."""
        self.until(lambda: len(peer.told(device)) >= count, f'{device} at the peer')
        return peer.told(device)

    def state(self, name: str = '/slicer') -> str:
        """Return what a node said last of its state."""
        said = [one.message for a in self.states for one in a.status if one.name == name]
        return said[-1] if said else ''


@pytest.fixture
def room(ros_graph: RosGraph, tmp_path: Path) -> Iterator[Room]:
    with ExitStack() as stack:
        yield Room(ros_graph, tmp_path, stack)


def shapes_at_20_hz(peer: Peer, count: int) -> bool:
    """Return whether so many shapes have come in a row, 20 a second by their stamps."""
    about = [(one.time, int(one.content.split(';')[1])) for one in peer.told('NeedleShapeHeader')]
    for begin in range(len(about) - count):
        (first, _), (last, _) = about[begin], about[begin + count]
        whole = all(b == a + 1 for (_, a), (_, b) in pairwise(about[begin : begin + count + 1]))
        # The stamps are those of shapes that come at 30 Hz: off by 1/30 s at each end.
        if whole and abs(last - first - count / 20.0) < 0.1:
            return True
    return False


def test_a_target_comes_in_and_the_needle_goes_out(room: Room) -> None:
    """With the plant as a process: where they are, in both frames, and 20 times a second."""
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

    # A window of 2 s; a machine that is busy may need another one.
    room.until(lambda: shapes_at_20_hz(peer, 40), '40 shapes at 20 Hz')
    room.until(lambda: poses.message and tips.message, 'the poses')
    there = [(p.position.x, p.position.y, p.position.z) for p in poses.message.poses]
    seen = peer.told('NeedleShapeZ')[-1]
    # It rests, but for the creep of the guide to where it is sent: 1e-3 mm.
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
    # What the nodes say, in words; a plant on a machine that is busy warns of it.
    room.until(
        lambda: re.search(
            r'^plant \[\w+\]: .+\nslicer \[OK\]: connected with .+; shape: needle_poses$',
            peer.told('NeedleState')[-1].content,
        ),
        'the state of both',
    )


def test_it_goes_on_after_either_side_was_killed(room: Room) -> None:
    """The peer connects anew to a new node, and a new peer to the node that is there."""
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
    # With a peer that is connected, and no thread to wait for.
    node.interrupt()


def test_without_a_shape_it_is_a_line_that_says_so(room: Room) -> None:
    """As on a robot without a sensor of the shape: where the guide and the tip are."""
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
    room.until(lambda: room.state().endswith(f'shape: {LINE}'), 'the state')
    # When nothing comes any more nothing is told.
    room.until(lambda: 'shape: none, neither needle_poses' in room.state(), 'the end')


def test_where_the_tip_is_expected_goes_out(room: Room) -> None:
    """Also to a peer that comes later; what is no pose does not."""
    node = room.slicer()
    expected = room.probe.create_publisher(PoseWithCovarianceStamped, 'tip_expected', COMMAND)
    room.until(expected.get_subscription_count, 'the node')
    message = PoseWithCovarianceStamped()
    message.header.frame_id = 'needle_entry'
    position = message.pose.pose.position
    position.x, position.y, position.z = 1e-3, 0.1, float('nan')
    message.pose.pose.orientation.w = 1.0
    expected.publish(message)
    refused = 'refused last'
    room.until(lambda: 'tip_expected refused' in node.diagnose()[2][refused], 'the refusal')
    position.z = 2e-3
    expected.publish(message)
    for _ in range(2):
        peer = room.peer()
        told = room.wait_for(peer, 'NeedleTipExpected')[-1]
        at = np.array(told.content)[:3, 3]
        np.testing.assert_allclose(at, REGISTRATION.to_image([1e-3, 0.1, 2e-3]), atol=1e-4)
        peer.kill()


def test_needles_that_are_none_are_refused_by_a_line(room: Room) -> None:
    """The node lives on, and takes the next one."""
    node = room.slicer()

    def refused(complaint: str) -> bool:
        return complaint in node.diagnose()[2]['refused last']

    # Best effort, as a driver may offer it.
    poses = room.probe.create_publisher(PoseArray, 'needle_poses', SENSOR)
    room.until(poses.get_subscription_count, 'the node')
    good = PoseArray(poses=[Pose(), Pose()])
    good.poses[1].position.y = 0.1
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
    room.until(lambda: node.diagnose()[1].endswith(f'shape: {MEASURED}'), 'the shape')


def test_a_flood_of_targets_is_a_line_and_the_newest_counts(
    room: Room, capfd: pytest.CaptureFixture[str]
) -> None:
    """And so is one of nonsense; nothing is said more than once a second, and shapes go on."""
    node = room.slicer()
    room.until(lambda: room.state().startswith('waits for a peer'), 'the node')
    # On the axis of the needle, ever deeper; 10 cm in the end.
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
            lambda: room.targets and abs(room.targets[-1].point.y - 0.1) < 1e-6, 'the last one'
        )
    # Fewer than there were; the others were older than those of the same moment.
    assert node.diagnose()[2]['targets passed on'] < 1000
    lines = capfd.readouterr().err.splitlines()
    for words in ('only the newest target is used', 'target refused: it must be three finite'):
        times = [float(line.split('[')[2].split(']')[0]) for line in lines if words in line]
        assert times
        assert all(later - earlier > 0.9 for earlier, later in pairwise(times))


def test_it_lives_on_where_the_port_is_in_use(room: Room) -> None:
    """It says so on /diagnostics, and listens as soon as it can."""
    with closing(socket.create_server(('127.0.0.1', room.port))):
        room.slicer()
        room.until(lambda: 'the port is in use' in room.state(), 'the complaint')
        levels = [s.level for a in room.states for s in a.status if 'in use' in s.message]
        assert DiagnosticStatus.ERROR in levels
    room.until(lambda: room.state().startswith('waits for a peer'), 'the port')
    with closing(socket.create_connection(('127.0.0.1', room.port))):
        room.until(lambda: room.state().startswith('connected with'), 'the peer')


def test_slicer_ros2_can_listen(room: Room) -> None:
    """SlicerROS2 asks for reliable topics, with a depth of 100 and nothing else."""
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
        ({'host': 'localhost'}, 'host must be an IPv4 address such as 127.0.0.1'),
        ({'role': 'both'}, 'role must be one of server, client'),
    ],
)
def test_invalid_parameters_are_refused(
    ros_graph: RosGraph, parameters: dict[str, Any], complaint: str
) -> None:
    """In one line that names the parameter."""
    node = ros_graph.add(SlicerNode, parameters=parameters, start=False)
    assert not node.start()
    assert complaint in node.failure
    assert '\n' not in node.failure


def test_without_pyigtl_it_says_how_to_install_it(
    ros_graph: RosGraph, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And is refused; the module itself can be imported, as all nodes can."""
    monkeypatch.setitem(sys.modules, 'pyigtl', None)
    node = ros_graph.add(SlicerNode, start=False)
    assert not node.start()
    assert node.failure == (
        "the Python package pyigtl is not installed: python3 -m pip install 'pyigtl>=0.3.4'"
    )
