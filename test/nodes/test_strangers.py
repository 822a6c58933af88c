# SPDX-License-Identifier: Apache-2.0
"""Unexpected other nodes: their commands and measurements do not move the needle."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

from benchmarks.strangers import ASKER, Bystander, LIAR, NEXT, PUSHER
from geometry_msgs.msg import WrenchStamped
from needle_dynamics.plant_node import PlantNode
from needle_ros.base_node import COMMAND, profile
from needle_ros.contract import COMMANDER, WRENCH_COMMAND
from needle_ros.publishers_node import Publishers
from needle_ros.status import ControllerStatus, NodeStatus, PlantStatus
import pytest
from rclpy.event_handler import SubscriptionEventCallbacks
from std_msgs.msg import Empty
from support.ros_graph import RosGraph

#: Attempts of each node.
TRIES = 5


@pytest.mark.requirement('S-094', 'S-096')
@pytest.mark.parametrize('when', ['found', 'blind'])
@pytest.mark.parametrize('force', [900.0, 14.0])
def test_second_commander_does_not_move_the_needle(
    ros_graph: RosGraph, force: float, when: str
) -> None:
    """For any force and duration; the first commander continues afterwards."""
    bystander = Bystander(ros_graph)
    found, moved = bystander.endures(PUSHER, force, when, TRIES)
    assert found > 0
    # 14 N would move the needle by 2 mm in 48 ms.
    assert moved < 1e-3
    bystander.until(
        lambda: bystander.reported(
            lambda one: isinstance(one, PlantStatus) and one.commanders == 2
        ),
        'the report',
    )
    bystander.goes_to(NEXT)
    assert bystander.stops == {0}


@pytest.mark.requirement('S-080', 'S-097')
@pytest.mark.parametrize('ahead', [0.0, 0.09])
def test_second_robot_does_not_move_the_needle(ros_graph: RosGraph, ahead: float) -> None:
    """Its measurements are discarded; its stamps do not make measurements of the first late."""
    bystander = Bystander(ros_graph)

    def disputed(status: NodeStatus) -> bool:
        return isinstance(status, ControllerStatus) and (
            status.duplicate_publishers == '2 nodes publish joint_states'
        )

    found, moved = bystander.endures(LIAR, ahead, 30.0, condition=disputed)
    assert found > 0
    assert moved < 1e-3
    bystander.until(lambda: bystander.reported(disputed), 'the report')
    bystander.goes_to(NEXT)
    assert bystander.stops == {0}


@pytest.mark.requirement('S-096')
def test_command_flood_does_not_move_the_needle(ros_graph: RosGraph) -> None:
    """At the maximum rate of a process; a valid command is accepted afterwards."""
    bystander = Bystander(ros_graph)
    found, moved = bystander.endures(ASKER)
    assert found > 0
    assert moved < 1e-3
    bystander.goes_to(NEXT)
    assert bystander.stops == {0}


#: Offers the lease of a commander, and publishes no commands.
LEASE = """
import rclpy, time
from needle_ros.base_node import profile
from needle_ros.contract import COMMANDER
from std_msgs.msg import Empty
rclpy.init()
lease = rclpy.create_node('lease').create_publisher(Empty, COMMANDER.name, profile(COMMANDER.qos))
time.sleep(120)
"""


@pytest.mark.requirement('S-221')
def test_lease_without_commands_hides_no_commander(ros_graph: RosGraph) -> None:
    """When it expires, the commanders in other processes still count."""
    probe, changes, expired = ros_graph.node('probe'), list[None](), list[int]()

    def on_liveliness(event: Any) -> None:
        expired.append(event.not_alive_count)

    for _ in range(2):
        probe.create_publisher(WrenchStamped, WRENCH_COMMAND.name, COMMAND)
    probe.create_subscription(
        Empty,
        COMMANDER.name,
        lambda _message: None,
        profile(COMMANDER.qos),
        event_callbacks=SubscriptionEventCallbacks(liveliness=on_liveliness),
    )
    plant = ros_graph.add(PlantNode, parameters={'rate': 200.0})
    commanders = Publishers(plant, COMMANDER, lambda: changes.append(None))
    ros_graph.spin_until(lambda: commanders.count(WRENCH_COMMAND) == 2, 'the commanders')
    other = subprocess.Popen([sys.executable, '-c', LEASE], env=ros_graph.environment)
    try:
        ros_graph.spin_until(lambda: changes and expired, 'the lease')
    finally:
        other.kill()
        other.wait()
    ros_graph.spin_until(lambda: expired[-1] == 1 and len(changes) > 1, 'its end')
    assert probe.count_publishers(COMMANDER.name) == 1
    assert commanders.count(WRENCH_COMMAND) == 2
    ros_graph.spin_until(lambda: plant.diagnose().status.commanders == 2, 'the report')
