# SPDX-License-Identifier: Apache-2.0
"""Insert the needle of a simulated plant with real nodes, and record everything."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

from geometry_msgs.msg import PointStamped
from needle_identification.recorder_node import is_hidden
from needle_insertion.graph.lockstep import (
    activate_plant,
    RunSample,
    start_nodes,
    WARM_UP,
    Witness,
)
from needle_insertion.graph.messages import listen_states, target_message
from needle_insertion.graph.ros_graph import Graph, GraphError
from needle_insertion.progress import Show
from needle_ros import contract
from needle_ros.base_node import COMMAND
from rclpy.duration import Duration
from trajectory_msgs.msg import JointTrajectory

#: Timeout of the arrival of a message on a busy machine [s].
_ARRIVAL: Final = Duration(seconds=30.0)

#: Timeout of a sample on a busy machine, and period of the checks for the end of the run [s].
_STALL, _CHECK = 60.0, 0.05


class SimulatedRun:
    """
    Start nodes and a plant, send a target, and record everything.

    In lock-step the plant waits at each sample until the action is complete and all its messages
    have arrived: a message arrives at the same sample on any machine. `states` has the latest
    state of each node by its name.
    """

    def __init__(self, graph: Graph, show: Show, *, lockstep: bool = True) -> None:
        self._graph, self._show, self._lockstep = graph, show, lockstep
        self.node = graph.node('demo')
        self.states = listen_states(self.node)

    def insert(
        self,
        bag: Path,
        nodes: Mapping[str, Mapping[str, object]],
        start: float,
        target: tuple[float, float, float],
        proceeds: Callable[[RunSample], bool],
        motion: JointTrajectory | None = None,
    ) -> None:
        """
        Insert from a depth to a target [m], and record until `proceeds` returns False.

        `nodes` are the parameters of the nodes, the plant last; `motion` is published with the
        target.
        """
        aim = self._publisher(PointStamped, contract.TARGET.name)
        move = self._publisher(JointTrajectory, contract.JOINT_TRAJECTORY.name) if motion else None
        waiting = True

        def act(sample: RunSample) -> bool:
            nonlocal waiting
            if waiting and sample.time >= WARM_UP:
                waiting = False
                aim(target_message(sample.stamp, target))
                if move is not None:
                    move(motion)
            done = (sample.depth - start) / (target[1] - start)
            self._show('inserting', min(max(done, 0.0), 1.0))
            return proceeds(sample)

        graph, node = self._graph, self.node
        witness = Witness(node, act, lockstep=self._lockstep)
        recorded = {'recorder': {'path': str(bag)}, **nodes}
        started = start_nodes(graph, node, recorded, self._show_start, lockstep=self._lockstep)
        self._show('starting plant')
        # The bag must contain every sample, and lock-step must include all nodes.
        activate_plant(
            graph,
            node,
            self.states,
            self._lockstep * (2 + ('steering' in nodes)),
            'the recorder and the nodes in lock-step',
            lambda: witness.is_matched and self._is_recorded(),
        )
        graph.spin_until(
            lambda: witness.ended,
            'the next sample',
            _STALL,
            sign=lambda: witness.stamp,
            period=_CHECK,
        )
        for one in started:
            one.interrupt()

    def _publisher(self, kind: type, topic: str) -> Callable[[Any], None]:
        """Return a function that publishes and waits for all subscribers."""
        publisher = self.node.create_publisher(kind, topic, COMMAND)

        def publish(message: Any) -> None:
            publisher.publish(message)
            if not publisher.wait_for_all_acked(_ARRIVAL):
                raise GraphError(f'{topic} did not arrive')

        return publish

    def _show_start(self, name: str) -> None:
        message = self.states[name].report.message if name in self.states else ''
        self._show(f'starting {name}' + (f': {message}' if message else ''))

    def _is_recorded(self) -> bool:
        node = self.node
        return all(
            'recorder' in [one.node_name for one in node.get_subscriptions_info_by_topic(topic)]
            for topic, _ in node.get_topic_names_and_types()
            if node.count_publishers(topic) and not is_hidden(topic)
        )
