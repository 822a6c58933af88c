# SPDX-License-Identifier: Apache-2.0
"""ROS graph of a test: nodes in the thread of the test, and processes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, TypeVar

from diagnostic_msgs.msg import DiagnosticArray
from needle_controller.controller_node import ControllerNode
from needle_insertion.graph.ros_graph import Graph
from needle_ros.base_node import BaseNode
from needle_ros.status import ControllerStatus, InputStatus, NodeStatus, read_reports
from needle_ros.timing import nanoseconds
from rclpy.node import Node
from rclpy.parameter import Parameter

#: Log line of a node that compiles or loads a function in the active state.
LATE = 'while the node is active'

_Status = TypeVar('_Status', bound=NodeStatus)


class RosGraph(Graph):
    """ROS graph of a test: nodes in the thread of the test, and processes."""

    def __enter__(self) -> RosGraph:
        super().__enter__()
        return self

    def __exit__(self, *raised: Any) -> None:
        late = [name for node in self._nodes for name in getattr(node, 'late', ())]
        super().__exit__(*raised)
        for log in self._logs.glob('*.log'):
            late += [line for line in log.read_text().splitlines() if LATE in line]
        assert not late, f'functions were compiled or loaded in an active node: {late}'

    def add(self, kind: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
        """Create a node with ``parameters`` by name, and start it unless ``start`` is False."""
        start = options.pop('start', True)
        parameters: Mapping[str, object] = options.pop('parameters', {})
        overrides = [Parameter(name, value=value) for name, value in parameters.items()]
        node = super().add(kind, *arguments, parameter_overrides=overrides, **options)
        if start and isinstance(node, BaseNode):
            assert node.start(), node.failure
        return node

    def listen(self, node: Node, kind: type, topic: str, qos: Any) -> list[Any]:
        """Subscribe to a topic; return the list of received messages."""
        received: list[Any] = []
        node.create_subscription(kind, topic, received.append, qos)
        return received

    def statuses(self, node: Node, kind: type[_Status], qos: Any = 10) -> list[_Status]:
        """Subscribe to /diagnostics; return the list of received statuses of a kind of node."""
        received: list[_Status] = []

        # Each once: a condition is evaluated after each event of the graph.
        def take(message: DiagnosticArray) -> None:
            statuses = [one.status for one in read_reports(message)]
            received.extend(one for one in statuses if isinstance(one, kind))

        node.create_subscription(DiagnosticArray, '/diagnostics', take, qos)
        return received


class GraphBench:
    """Nodes of a test in a graph."""

    graph: RosGraph

    def until(self, condition: Callable[..., Any], what: str) -> None:
        """Spin until a condition holds."""
        self.graph.spin_until(condition, what)


class ControllerBench(GraphBench):
    """Controller and other nodes of a test in a graph."""

    controller: ControllerNode

    @property
    def status(self) -> ControllerStatus:
        """Latest status of the controller."""
        return self.controller.diagnose().status

    def input(self, topic: str) -> InputStatus:
        """Return the status of an input."""
        return self.status.input.get(topic, InputStatus())


def stamp_ns(message: Any) -> int:
    """Return the stamp of a message [ns]."""
    return nanoseconds(message.header.stamp)
