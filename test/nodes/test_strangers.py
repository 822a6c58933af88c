"""Unexpected other nodes: their commands and measurements do not move the needle."""

from __future__ import annotations

from benchmarks.strangers import ASKER, Bystander, LIAR, NEXT, PUSHER
from needle_ros.status import ControllerStatus, NodeStatus, PlantStatus
import pytest
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
