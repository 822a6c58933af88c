"""Private ROS graph of tests, demo and experiments."""

from pathlib import Path

from needle_dynamics.plant_node import PlantNode
from needle_insertion.graph.ros_graph import Graph
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
