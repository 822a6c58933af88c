"""Real nodes over real DDS inside a test: own context, own domain, errors fail the test."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from needle_dynamics.base_node import NeedleNode
from needle_insertion.graph import Graph
import pytest
from rclpy.executors import SingleThreadedExecutor


class RosGraph(Graph):
    """The graph of one test; lifecycle nodes are started as they are added."""

    def add(self, kind: type, *arguments: Any, **options: Any) -> Any:
        """Make a node in the test's own thread; ``start=False`` leaves it unconfigured."""
        start = options.pop('start', True)
        node = super().add(kind, *arguments, **options)
        if start and isinstance(node, NeedleNode):
            assert node.start(), node.failure
        return node


@pytest.fixture
def ros_graph(tmp_path: Path) -> Iterator[RosGraph]:
    """Return a graph for one test."""
    with RosGraph(tmp_path / 'logs', SingleThreadedExecutor) as graph:
        yield graph
