# SPDX-License-Identifier: Apache-2.0
"""Private ROS graph of tests, demo and experiments."""

import os
from pathlib import Path
import signal
from threading import Timer
import weakref

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from needle_dynamics.plant_node import PlantNode
from needle_insertion.graph.ros_graph import Graph
import pytest
from std_srvs.srv import Trigger


def threads() -> int:
    """Return the number of threads of this process; a DDS participant has several."""
    return len(list(Path('/proc/self/task').iterdir()))


def use(graph: Graph) -> None:
    """Run a node and call one of its services from another node."""
    asker, plant = graph.node('asker'), graph.add(PlantNode)
    assert plant.start()
    client = asker.create_client(Trigger, 'plant/tare')
    graph.spin_until(client.service_is_ready, 'the service')
    answer = client.call_async(Trigger.Request())
    graph.spin_until(answer.done, 'the answer')


def test_graph_leaves_no_nodes_or_threads(tmp_path: Path) -> None:
    """A remaining node would be a duplicate in the next graph."""
    counts = []
    for _ in range(3):
        with Graph(tmp_path) as graph:
            use(graph)
        counts.append(threads())
    assert counts[2] <= counts[0]


def test_queued_task_does_not_keep_the_nodes(tmp_path: Path) -> None:
    """The servers of a kept node would answer, or fail to answer, clients of the next graph."""
    with Graph(tmp_path) as graph:
        node = graph.node('user')
        graph.executor.create_task(node.get_name)
        kept = weakref.ref(node), weakref.ref(graph.context)
        del node
    del graph.context
    assert [one() for one in kept] == [None, None]


def test_signal_at_any_time_is_an_interrupt(tmp_path: Path) -> None:
    """Also during the conversion of a message, where rclpy would raise RuntimeError."""
    status = DiagnosticStatus(values=20 * [KeyValue()])
    previous = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with Graph(tmp_path) as graph:
            node = graph.node('user')
            publisher = node.create_publisher(DiagnosticArray, 'load', 1)
            node.create_subscription(DiagnosticArray, 'load', lambda _message: None, 1)

            def publish() -> None:
                publisher.publish(DiagnosticArray(status=20 * [status]))

            for number in range(40):
                Timer(0.02 + 1e-4 * number, os.kill, (os.getpid(), signal.SIGINT)).start()
                with pytest.raises(KeyboardInterrupt):
                    graph.spin_until(publish, 'a signal')
    finally:
        signal.signal(signal.SIGINT, previous)
