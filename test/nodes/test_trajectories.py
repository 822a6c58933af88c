# SPDX-License-Identifier: Apache-2.0
"""Start of a trajectory over DDS: alike in the plant in mode `robot` and in the controller."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from needle_controller.controller_node import ControllerNode
from needle_dynamics.plant_node import PlantNode
from needle_ros.base_node import COMMAND, SENSOR
from needle_ros.contract import REQUEST_AGE
from needle_ros.requests import Verdict
import pytest
from sensor_msgs.msg import JointState
from support.ros_graph import RosGraph
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

SECOND = 1_000_000_000
DEPTH = 0.03
#: Period of the samples [ns].
PERIOD = SECOND // 200
KINDS = pytest.mark.parametrize('mode', ['robot', 'simulation'])


class Bench:
    """A plant with its own time, in mode `simulation` with a controller, and a user."""

    def __init__(self, graph: RosGraph, mode: str) -> None:
        self.graph, self.user = graph, graph.node('user')
        self.states = graph.listen(self.user, JointState, 'joint_states', SENSOR)
        self.aims = graph.listen(self.user, JointState, 'reference', SENSOR)
        self.course = self.user.create_publisher(JointTrajectory, 'joint_trajectory', COMMAND)
        plant = {'rate': 200.0, 'depth': DEPTH, 'mode': mode, 'publish_clock': True}
        # A busy machine delays commands.
        self.node: Any = graph.add(PlantNode, parameters={**plant, 'command_timeout': 1.0})
        if mode == 'simulation':
            control = {'rate': 200.0, 'use_sim_time': True, 'measurement_timeout': 1.0}
            self.node = graph.add(
                ControllerNode, parameters={**control, 'safety.tracking_error': 0.1}
            )
        self.until(lambda: self.states and self.course.get_subscription_count(), 'the nodes')
        self.until(lambda: self.time > SECOND, 'the first second')

    def until(self, condition: Callable[[], Any], what: str) -> None:
        self.graph.spin_until(condition, what, 120.0)

    @staticmethod
    def stamp(message: JointState) -> int:
        """Return the stamp of a message [ns]."""
        return int(message.header.stamp.sec) * SECOND + int(message.header.stamp.nanosec)

    @property
    def time(self) -> int:
        """Stamp of the newest sample [ns]."""
        return self.stamp(self.states[-1])

    @property
    def depth(self) -> float:
        return float(self.states[-1].position[0])

    def send(self, stamp: int, *points: tuple[float, float]) -> int:
        """Send depths [m] at times [s]; return the stamp."""
        message = JointTrajectory(joint_names=['insertion'])
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, SECOND)
        for at, depth in points:
            point = JointTrajectoryPoint(positions=[depth])
            whole, part = divmod(round(at * SECOND), SECOND)
            point.time_from_start.sec, point.time_from_start.nanosec = whole, part
            message.points.append(point)
        self.course.publish(message)
        return stamp

    def answer(self, stamp: int) -> tuple[Verdict, str]:
        """Wait for the final answer to a stamp."""
        found: list[Any] = []

        def answered() -> bool:
            status = self.node.diagnose().status.requests
            found[:] = [status.answer_to('joint_trajectory', stamp)]
            return found[0] is not None and found[0].verdict is not Verdict.RECEIVED

        self.until(answered, 'the answer')
        return found[0].verdict, found[0].reason

    def moved(self) -> int:
        """Return the stamp of the first sample away from the start [ns]."""
        self.until(lambda: abs(self.depth - DEPTH) > 1e-4, 'a motion')
        return next(self.stamp(one) for one in self.states if abs(one.position[0] - DEPTH) > 1e-5)


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
