# SPDX-License-Identifier: Apache-2.0
"""Private ROS graph of tests, demo and experiments."""

import os
from pathlib import Path
import signal
import subprocess
import sys
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


#: Subscriptions with events, which are queued while their graph ends.
_ENDS = """
from pathlib import Path
import sys
from needle_insertion.graph.ros_graph import Graph
from needle_ros.base_node import SENSOR
from rclpy.event_handler import SubscriptionEventCallbacks
from std_msgs.msg import Bool
for _ in range(5):
    with Graph(Path(sys.argv[1])) as graph:
        reader, writer, matches = graph.node('reader'), graph.node('writer'), []
        events = SubscriptionEventCallbacks(matched=matches.append)
        for k in range(5):
            reader.create_subscription(Bool, f'topic{k}', print, SENSOR, event_callbacks=events)
        writer.create_publisher(Bool, 'topic0', 1)
        graph.spin_until(lambda: matches, 'a match')
        for k in range(1, 5):
            writer.create_publisher(Bool, f'topic{k}', 1)
print('ended')
"""


def test_queued_events_do_not_crash_the_end(tmp_path: Path) -> None:
    """An event that outlives its subscription would be freed without the lock of Python."""
    done = subprocess.run(
        [sys.executable, '-c', _ENDS, str(tmp_path)],
        capture_output=True,
        text=True,
        timeout=100.0,
        check=False,
    )
    assert (done.returncode, done.stdout.splitlines()[-1:]) == (0, ['ended']), done.stderr


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
