"""Real nodes over real DDS inside a test: own context, own domain, errors fail the test."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
import gc
from pathlib import Path
from typing import Any

from needle_insertion.experiment.ros_graph import Graph
from needle_ros.base_node import BaseNode
import pytest
from rclpy.node import Node
from rclpy.parameter import Parameter


class RosGraph(Graph):
    """The graph of one test: nodes in its own thread, and processes."""

    def add(self, kind: type, *arguments: Any, **options: Any) -> Any:
        """
        Make a node; a node of the suite is started unless ``start`` is False.

        ``parameters`` are its parameters by name.
        """
        start = options.pop('start', True)
        parameters: Mapping[str, object] = options.pop('parameters', {})
        overrides = [Parameter(name, value=value) for name, value in parameters.items()]
        node = super().add(kind, *arguments, parameter_overrides=overrides, **options)
        if start and isinstance(node, BaseNode):
            assert node.start(), node.failure
        return node

    def listen(self, node: Node, kind: type, topic: str, qos: Any) -> list[Any]:
        """Return a list that fills with the messages of a topic."""
        received: list[Any] = []
        node.create_subscription(kind, topic, received.append, qos)
        return received


@pytest.fixture(scope='session', autouse=True)
def quick_collection() -> None:
    """Keep what was imported out of the collections at the end of each graph."""
    gc.freeze()


@pytest.fixture(autouse=True)
def no_shared_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """
    Let messages go over UDP: here processes are killed.

    Where one that shared memory was killed, Fast DDS 2.14 may crash in others when they end, and
    the ports it leaves behind may keep later ones of the same domain from finding each other.
    """
    monkeypatch.setenv('FASTDDS_BUILTIN_TRANSPORTS', 'UDPv4')


@pytest.fixture
def ros_graph(tmp_path: Path) -> Iterator[RosGraph]:
    """Return a graph for one test."""
    with RosGraph(tmp_path / 'logs') as graph:
        yield graph
