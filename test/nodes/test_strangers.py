"""Nodes that nobody asked for: what they command, and what they measure, moves nothing."""

from __future__ import annotations

from benchmarks.strangers import ASKER, Bystander, LIAR, NEXT, PUSHER
import pytest
from support.ros_graph import RosGraph

#: Tries of each stranger.
TRIES = 5


@pytest.mark.parametrize('when', ['found', 'blind'])
@pytest.mark.parametrize('force', [900.0, 14.0])
def test_a_second_commander_moves_nothing(ros_graph: RosGraph, force: float, when: str) -> None:
    """Whatever it asks for and however short it lives; the first goes on when it is alone."""
    bystander = Bystander(ros_graph)
    found, moved = bystander.endures(PUSHER, force, when, TRIES)
    assert found > 0
    # At 14 N the needle would go 2 mm in 48 ms.
    assert moved < 1e-3
    bystander.until(lambda: bystander.was_told('2 nodes command'), 'the word of it')
    bystander.goes_to(NEXT)
    assert bystander.stops == {'0'}


@pytest.mark.parametrize('ahead', [0.0, 0.09])
def test_a_second_robot_moves_nothing(ros_graph: RosGraph, ahead: float) -> None:
    """What it measures is nobody's needle; its stamps do not make those of the first late."""
    bystander = Bystander(ros_graph)
    word = '2 nodes publish joint_states'
    found, moved = bystander.endures(LIAR, ahead, 30.0, word=word)
    assert found > 0
    assert moved < 1e-3
    bystander.until(lambda: bystander.was_told(word), 'the word of it')
    bystander.goes_to(NEXT)
    assert bystander.stops == {'0'}


def test_a_flood_of_wishes_moves_nothing(ros_graph: RosGraph) -> None:
    """As fast as a process can publish them; then the right one is heard."""
    bystander = Bystander(ros_graph)
    found, moved = bystander.endures(ASKER)
    assert found > 0
    assert moved < 1e-3
    bystander.goes_to(NEXT)
    assert bystander.stops == {'0'}
