# SPDX-License-Identifier: Apache-2.0
"""Start of a trajectory over DDS: alike in the plant in mode `robot` and in the controller."""

from __future__ import annotations

from geometry_msgs.msg import WrenchStamped
from needle_dynamics.plant_node import PlantNode
from needle_ros.base_node import COMMAND, SENSOR
from needle_ros.contract import REQUEST_AGE
from needle_ros.requests import Verdict
import pytest
from std_srvs.srv import SetBool
from support.ros_graph import RosGraph
from support.trajectory_bench import Bench, DEPTH, PERIOD, SECOND, trajectory
from trajectory_msgs.msg import JointTrajectory

KINDS = pytest.mark.parametrize('mode', ['robot', 'simulation'])


@KINDS
@pytest.mark.requirement('S-222')
def test_start_in_the_future_is_awaited(ros_graph: RosGraph, mode: str) -> None:
    bench = Bench(ros_graph, mode)
    start = bench.send(bench.time + 2 * SECOND, (0.5, DEPTH + 2e-3))
    assert bench.answer(start)[0] is Verdict.ACCEPTED
    # It begins with the sample before the stamp, or after it.
    assert start - PERIOD <= bench.moved() < start + SECOND


@KINDS
@pytest.mark.requirement('S-222')
def test_trajectory_joins_at_its_points_ahead(ros_graph: RosGraph, mode: str) -> None:
    """It does not go to the points in the past, and ends on time."""
    bench = Bench(ros_graph, mode)
    past, end = DEPTH + 0.02, DEPTH - 4e-3
    start = bench.send(bench.time - 2 * SECOND, (0.5, past), (4.0, past - 0.02), (6.0, end))
    assert bench.answer(start)[0] is Verdict.ACCEPTED
    bench.until(lambda: abs(bench.depth - end) < 2e-4, 'the end')
    # The controller joins with a detour below the error of a limit of acceleration.
    assert max(one.position[0] for one in bench.states) < DEPTH + 1e-3
    assert start + 5.5 * SECOND < bench.time < start + 8 * SECOND


@KINDS
@pytest.mark.requirement('S-223')
@pytest.mark.parametrize(
    ('since', 'verdict', 'reason'),
    [
        (2.0, Verdict.LATE, 'all points are in the past, the last by'),
        (REQUEST_AGE + 1.0, Verdict.REJECTED, 'joint_trajectory is stale: its stamp is'),
        (-REQUEST_AGE - 10.0, Verdict.REJECTED, 'joint_trajectory is stale: its stamp is'),
        (-3600.0, Verdict.REJECTED, 'joint_trajectory is stale: its stamp is'),
    ],
)
def test_past_and_distant_starts_are_rejected(
    ros_graph: RosGraph, mode: str, since: float, verdict: Verdict, reason: str
) -> None:
    bench = Bench(ros_graph, mode)
    bench.until(lambda: bench.time > 8 * SECOND, 'the time')
    start = bench.send(bench.time - round(since * SECOND), (1.0, DEPTH + 5e-3))
    assert bench.answer(start)[0] is verdict
    assert bench.answer(start)[1].startswith(reason)
    end = bench.time + 2 * SECOND
    bench.until(lambda: bench.time > end, 'two seconds')
    assert abs(bench.depth - DEPTH) < 1e-4


@KINDS
@pytest.mark.requirement('S-224')
def test_empty_trajectory_stops_and_holds(ros_graph: RosGraph, mode: str) -> None:
    """Within a millimeter: 0.5 mm from 10 mm/s at 0.1 m/s^2."""
    bench = Bench(ros_graph, mode)
    bench.send(0, (5.0, DEPTH + 0.04))
    bench.moved()
    stamp = bench.send(bench.time)
    assert bench.answer(stamp)[0] is Verdict.ACCEPTED
    at = bench.depth
    bench.until(lambda: bench.time > stamp + SECOND, 'the brake')
    rest = bench.depth
    assert abs(rest - at) < 2e-3
    bench.until(lambda: bench.time > stamp + 3 * SECOND, 'two seconds')
    # A needle at rest in friction: creep below 0.1 mm.
    assert abs(bench.depth - rest) < 1e-4
    assert bench.send(0, (1.0, rest + 2e-3)) == 0
    bench.until(lambda: bench.depth > rest + 1e-3, 'the next motion')


@KINDS
@pytest.mark.requirement('S-278')
def test_path_continues_after_a_pause(ros_graph: RosGraph, mode: str) -> None:
    """For a longer time than the path; no part is skipped, nor faster."""
    bench, duration, way = Bench(ros_graph, mode), 4, 8e-3
    start = bench.send(bench.time, (duration, DEPTH + way))
    bench.until(lambda: bench.depth > DEPTH + way / 8, 'the motion')
    bench.call('pause', SetBool, data=True)
    paused = bench.time
    # It brakes from at most 4 mm/s within 0.2 s, and may be late on a busy machine.
    bench.rests(2e-3, 2 * duration)
    assert bench.depth < DEPTH + way / 2
    bench.call('pause', SetBool, data=False)
    resumed = bench.time
    bench.until(lambda: abs(bench.depth - DEPTH - way) < 2e-4, 'the end')
    left = duration * SECOND - (paused - start)
    # The smooth path of the controller is 0.2 mm from its end for a sixth of its duration.
    assert resumed + left - duration * SECOND / 5 < bench.time < resumed + left + 2 * SECOND


@KINDS
@pytest.mark.requirement('S-278')
def test_start_during_a_pause_is_awaited(ros_graph: RosGraph, mode: str) -> None:
    """The path begins with the end of the pause."""
    bench = Bench(ros_graph, mode)
    bench.send(bench.time + 2 * SECOND, (2.0, DEPTH + 4e-3))
    bench.call('pause', SetBool, data=True)
    # It rests from the beginning, but for creep.
    bench.rests(1e-4, 4)
    assert abs(bench.depth - DEPTH) < 1e-4
    bench.call('pause', SetBool, data=False)
    bench.until(lambda: abs(bench.depth - DEPTH - 4e-3) < 2e-4, 'the end')


@pytest.mark.requirement('S-279')
def test_motion_that_is_requested_in_a_pause_replaces_the_path(ros_graph: RosGraph) -> None:
    """For its joints; those of the paused path that it does not name continue afterwards."""
    bench = Bench(ros_graph, 'robot', steered=True, needle='bending_35mm')
    goals = {'insertion': DEPTH + 8e-3, 'guide_x': 4e-3}
    message = trajectory(bench.time, [(4.0, [*goals.values()])], [*goals])
    bench.course.publish(message)
    bench.until(lambda: bench.depth > DEPTH + 1e-3, 'the motion')
    bench.call('pause', SetBool, data=True)
    depth = bench.rests(2e-3, 1)
    bench.send(bench.time, (0.5, depth - 2e-3))
    bench.until(lambda: abs(bench.depth - depth + 2e-3) < 1e-4, 'the motion in the pause')
    bench.call('pause', SetBool, data=False)
    bench.until(lambda: abs(bench.states[-1].position[1] - 4e-3) < 1e-4, 'the guide')
    assert abs(bench.depth - depth + 2e-3) < 1e-4


@KINDS
@pytest.mark.requirement('S-274', 'S-278')
def test_stop_during_a_pause_ends_path_and_pause(ros_graph: RosGraph, mode: str) -> None:
    """After the clearance nothing moves until the next path, which is awaited as usual."""
    bench = Bench(ros_graph, mode)
    bench.send(bench.time, (5.0, DEPTH + 0.02))
    bench.moved()
    bench.call('pause', SetBool, data=True)
    bench.call('stop')
    bench.call('clear_stop')
    bench.call('pause', SetBool, data=False)
    depth = bench.rests(2e-3)
    start = bench.send(bench.time + SECOND, (0.5, depth + 2e-3))
    assert bench.answer(start)[0] is Verdict.ACCEPTED
    bench.until(lambda: bench.depth > depth + 1e-3, 'the next motion')


@pytest.mark.requirement('S-278')
def test_pause_keeps_the_force_of_a_press_at_rest(ros_graph: RosGraph) -> None:
    """There is no motion to hold."""
    user = ros_graph.node('user')
    wrenches = ros_graph.listen(user, WrenchStamped, 'base_wrench', SENSOR)
    plant = ros_graph.add(PlantNode, parameters={'rate': 200.0, 'mode': 'indenter'})
    push = user.create_publisher(JointTrajectory, 'joint_trajectory', COMMAND)
    ros_graph.spin_until(push.get_subscription_count, 'the plant')
    push.publish(trajectory(0, [(0.5, [0.0, -1.0])], ['x', 'z'], 'effort'))
    force = plant._run.plant.references

    def arrived() -> bool:
        return force()['z'].arrived and force()['z'].effort == -1.0

    ros_graph.spin_until(arrived, 'the press')
    client = user.create_client(SetBool, 'plant/pause')
    ros_graph.spin_until(client.service_is_ready, 'the service')
    answer = client.call_async(SetBool.Request(data=True))
    ros_graph.spin_until(answer.done, 'the answer')
    count = len(wrenches) + 100
    ros_graph.spin_until(lambda: len(wrenches) > count, 'samples')
    assert arrived()


@KINDS
@pytest.mark.requirement('S-274')
@pytest.mark.parametrize('services', [('stop', 'clear_stop'), ('retract',)], ids=' '.join)
def test_stop_and_retraction_supersede_earlier_trajectories(
    ros_graph: RosGraph, mode: str, services: tuple[str, ...]
) -> None:
    """Also one that arrives after the clearance, with points ahead."""
    bench = Bench(ros_graph, mode)
    stamp = bench.time - PERIOD
    for service in services:
        bench.call(service)
    bench.send(stamp, (4.5, DEPTH + 5e-3))
    assert bench.answer(stamp) == (Verdict.SUPERSEDED, 'a newer request has priority')
    end = bench.time + SECOND
    bench.until(lambda: bench.time > end, 'a second')
    assert bench.depth < DEPTH + 1e-4


@pytest.mark.requirement('S-287')
def test_repeated_retraction_of_the_plant_withdraws_again(ros_graph: RosGraph) -> None:
    """A needle that was moved since the first one, without a controller."""
    bench = Bench(ros_graph, 'robot')
    bench.call('retract')
    bench.until(lambda: bench.depth < 0.0105, 'the retraction')
    bench.send(0, (4.0, 0.02))
    bench.until(lambda: bench.depth > 0.0195, 'the path')
    bench.call('retract')
    bench.until(lambda: bench.depth < 0.0105, 'the second retraction')


@pytest.mark.requirement('S-290')
def test_path_after_a_retraction_of_the_plant_ends_it(ros_graph: RosGraph) -> None:
    """A pause and its end do not withdraw the needle: they continue the path."""
    bench = Bench(ros_graph, 'robot')
    bench.call('retract')
    bench.until(lambda: bench.depth < 0.0105, 'the retraction')
    bench.rests(1e-3, 1)
    bench.send(0, (2.0, 0.02))
    bench.until(lambda: bench.depth > 0.012, 'the path')
    bench.call('pause', SetBool, data=True)
    bench.rests(2e-3, 1)
    bench.call('pause', SetBool, data=False)
    bench.until(lambda: bench.depth > 0.0195, 'the end of the path')
