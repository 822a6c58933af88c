# SPDX-License-Identifier: Apache-2.0
"""A plant with its own time, or a plant and a controller, and a user who sends trajectories."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from needle_controller.controller_node import ControllerNode
from needle_dynamics.plant_node import PlantNode
from needle_ros.base_node import COMMAND, SENSOR
from needle_ros.requests import Verdict
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger
from support.ros_graph import RosGraph
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

SECOND = 1_000_000_000
DEPTH = 0.03
#: Period of the samples [ns].
PERIOD = SECOND // 200


def trajectory(
    stamp: int,
    points: Sequence[tuple[float, Sequence[float]]],
    joints: Sequence[str] = ('insertion',),
    field: str = 'positions',
) -> JointTrajectory:
    """Return a message with positions or another field at times [s], and a stamp [ns]."""
    message = JointTrajectory(joint_names=[*joints])
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, SECOND)
    for at, values in points:
        point = JointTrajectoryPoint(**{field: [*values]})
        whole, part = divmod(round(at * SECOND), SECOND)
        point.time_from_start.sec, point.time_from_start.nanosec = whole, part
        message.points.append(point)
    return message


class Bench:
    """A plant with its own time, in mode `simulation` with a controller, and a user."""

    def __init__(self, graph: RosGraph, mode: str, **more: object) -> None:
        self.graph, self.user = graph, graph.node('user')
        self.states = graph.listen(self.user, JointState, 'joint_states', SENSOR)
        self.aims = graph.listen(self.user, JointState, 'reference', SENSOR)
        self.course = self.user.create_publisher(JointTrajectory, 'joint_trajectory', COMMAND)
        plant = {'rate': 200.0, 'depth': DEPTH, 'mode': mode, 'publish_clock': True}
        # A busy machine delays commands.
        self.node: Any = graph.add(PlantNode, parameters={**plant, 'command_timeout': 1.0, **more})
        self.plant = self.node
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
        self.course.publish(trajectory(stamp, [(at, [depth]) for at, depth in points]))
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

    def ask(self, service: str, kind: Any = Trigger, **fields: Any) -> Any:
        """Call a service of any node; return its response."""
        client = self.user.create_client(kind, service)
        self.until(client.service_is_ready, service)
        answer = client.call_async(kind.Request(**fields))
        self.until(answer.done, f'the response of {service}')
        self.user.destroy_client(client)
        return answer.result()

    def call(self, service: str, kind: Any = Trigger, **fields: Any) -> None:
        """Call a service of the node that follows `insertion`, which succeeds."""
        response = self.ask(f'{self.node.get_name()}/{service}', kind, **fields)
        assert response.success, response

    def rests(self, margin: float, seconds: int = 2) -> float:
        """Check that the needle brakes within a margin [m], and rests; return its depth [m]."""
        at, begin = self.depth, self.time
        self.until(lambda: self.time > begin + SECOND, 'the brake')
        rest = self.depth
        assert abs(rest - at) < margin
        self.until(lambda: self.time > begin + (1 + seconds) * SECOND, 'the rest')
        # Creep of a needle at rest in friction.
        assert abs(self.depth - rest) < 1e-4
        return rest

    def moved(self) -> int:
        """Return the stamp of the first sample away from the start [ns]."""
        self.until(lambda: abs(self.depth - DEPTH) > 1e-4, 'a motion')
        return next(self.stamp(one) for one in self.states if abs(one.position[0] - DEPTH) > 1e-5)
