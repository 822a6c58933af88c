# SPDX-License-Identifier: Apache-2.0
"""Publishers, subscriptions and services exist only while a node is configured."""

from __future__ import annotations

from collections import Counter
from functools import partial
from pathlib import Path
from typing import Any

from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from needle_controller.controller_node import ControllerNode
from needle_controller.force_command import ForceCommand
from needle_controller.steering_node import SteeringNode
from needle_dynamics.plant_node import PlantNode
from needle_identification.identification_node import IdentificationNode
from needle_identification.player_node import PlayerNode
from needle_identification.recorder_node import RecorderNode
from needle_insertion.slicer.slicer_node import SlicerNode
from needle_ros.base_node import BaseNode, steady_timer
from needle_ros.wire import Reading
import pytest
from rclpy.lifecycle import TransitionCallbackReturn
from reproduction.protocol import SHIPPED_BAGS
from support.ros_graph import RosGraph

DONE = TransitionCallbackReturn.SUCCESS


def entities(node: BaseNode) -> Counter[str]:
    """Count the publishers, subscriptions, services, clients and timers of a node by name."""
    return Counter(
        [
            *(f'publisher {one.topic_name}' for one in node.publishers),
            *(f'subscription {one.topic_name}' for one in node.subscriptions),
            *(f'service {one.service_name}' for one in node.services),
            *(f'client {one.service_name}' for one in node.clients),
            *('timer' for _ in node.timers),
        ]
    )


@pytest.mark.parametrize(
    ('kind', 'topic'),
    [
        (PlantNode, 'publisher /joint_states'),
        (ControllerNode, 'publisher /wrench_command'),
        (SteeringNode, 'publisher /joint_trajectory'),
        (SlicerNode, 'publisher /target'),
        (RecorderNode, 'publisher /joint_states/_recorded'),
        (PlayerNode, 'publisher /joint_states'),
        (IdentificationNode, 'publisher /friction'),
    ],
)
@pytest.mark.parametrize('end', ['cleanup', 'shutdown', 'shutdown while active'])
def test_cleanup_and_shutdown_destroy_what_was_created(
    ros_graph: RosGraph, tmp_path: Path, kind: Any, topic: str, end: str
) -> None:
    """Requests of a user to stop the system are answered in every state."""
    paths = {RecorderNode: tmp_path / 'bag', PlayerNode: SHIPPED_BAGS / 'friction_01'}
    parameters = {'path': str(paths[kind])} if kind in paths else {}
    node = ros_graph.add(kind, start=False, parameters=parameters)
    before = entities(node)
    assert not before[topic]
    stops = before[f'service /{node.get_name()}/stop']
    assert stops == (kind in (PlantNode, ControllerNode, SteeringNode))
    for _ in range(2):
        assert node.start(), node.failure
        assert entities(node)[topic] == 1
        if end != 'shutdown while active':
            assert node.trigger_deactivate() == DONE
        assert (node.trigger_cleanup() if end == 'cleanup' else node.trigger_shutdown()) == DONE
        assert entities(node) == before
        if end != 'cleanup':
            break


def test_destroyed_timer_is_not_called(ros_graph: RosGraph) -> None:
    """Not even if it is due already: a socket, for example, would be opened again."""
    node, late = ros_graph.add(PlantNode, start=False), []
    # Without the override, 23 of 1000 destroyed timers are called.
    for _ in range(50):
        calls: list[int] = []
        timers = [steady_timer(node, 1e-3, partial(calls.append, one)) for one in range(20)]
        ros_graph.spin_until(calls.copy, 'the first timer')
        for timer in timers:
            node.destroy_timer(timer)
        again: list[int] = []
        before = len(calls)
        timer = steady_timer(node, 1e-3, partial(again.append, 0))
        ros_graph.spin_until(again.copy, 'a later timer')
        node.destroy_timer(timer)
        late += calls[before:]
    assert not late


def test_failed_configuration_leaves_nothing(ros_graph: RosGraph) -> None:
    """Its publishers were created before the error."""
    parameters = {'publish_tf': True, 'mode': 'indenter'}
    node = ros_graph.add(PlantNode, start=False, parameters=parameters)
    before = entities(node)
    assert not node.start()
    assert node.failure is not None
    assert node.failure.startswith('publish_tf must be false')
    assert entities(node) == before


@pytest.mark.requirement('S-225')
def test_only_a_configured_controller_counts_as_commander(ros_graph: RosGraph) -> None:
    """Not one that is unconfigured, cleaned up or finalized."""
    plant = ros_graph.add(PlantNode)
    ros_graph.add(ControllerNode)
    other = ros_graph.add(
        ControllerNode,
        start=False,
        namespace='other',
        cli_args=['--ros-args', '-r', 'wrench_command:=/wrench_command'],
    )

    def count(number: int) -> None:
        ros_graph.spin_until(lambda: plant._commanders.count() == number, f'{number} commanders')

    names = ros_graph.node('user')
    ros_graph.spin_until(
        lambda: ('controller', '/other') in names.get_node_names_and_namespaces(), 'the node'
    )
    count(1)
    for end in (other.trigger_cleanup, other.trigger_shutdown):
        assert other.trigger_configure() == DONE
        count(2)
        assert end() == DONE
        count(1)


def test_measurements_before_activation_change_nothing(
    ros_graph: RosGraph, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A configured controller receives them; active, it answers the next."""
    ros_graph.add(PlantNode)
    node = ros_graph.add(ControllerNode, start=False)
    supervisor = node._supervisor
    take, answers = supervisor.encoders, list[ForceCommand | None]()

    def encoders(reading: Reading, now: int) -> ForceCommand | None:
        answers.append(take(reading, now))
        return answers[-1]

    monkeypatch.setattr(supervisor, 'encoders', encoders)
    assert node.trigger_configure() == DONE
    ros_graph.spin_until(lambda: len(answers) > 20, 'measurements')
    assert set(answers) == {None}
    assert node.trigger_activate() == DONE
    ros_graph.spin_until(lambda: answers[-1] is not None, 'an answer')


BAG = str(Path(__file__).resolve().parents[2] / 'bags' / 'friction_01')


@pytest.mark.requirement('S-276')
@pytest.mark.parametrize(
    ('kind', 'parameters'),
    [
        (PlantNode, {}),
        (ControllerNode, {}),
        (SteeringNode, {}),
        (RecorderNode, {}),
        (PlayerNode, {'path': BAG}),
        (IdentificationNode, {'live': True}),
        (SlicerNode, {}),
    ],
)
def test_invalid_transitions_are_refused_in_one_line(
    ros_graph: RosGraph,
    capfd: pytest.CaptureFixture[str],
    tmp_path: Path,
    kind: Any,
    parameters: dict[str, object],
) -> None:
    """In each state of each node, which stays in this state and makes valid transitions."""
    if kind is RecorderNode:
        parameters = {'path': str(tmp_path / 'bag')}
    node = ros_graph.add(kind, start=False, parameters=parameters)
    user = ros_graph.node('user')
    change = user.create_client(ChangeState, f'{node.get_name()}/change_state')
    ros_graph.spin_until(change.service_is_ready, 'the service')

    def succeeds(number: int, label: str = '') -> bool:
        request = ChangeState.Request(transition=Transition(id=number, label=label))
        answer = change.call_async(request)
        # A machine that compiles for the first time.
        ros_graph.spin_until(answer.done, 'the answer', 300.0)
        return bool(answer.result().success)

    states = []
    for step in ('', 'configure', 'activate', 'deactivate', 'shutdown'):
        assert not step or succeeds(0, step), node.failure
        machine = node._state_machine
        states.append(machine.current_state[1])
        valid = {number for number, *_ in machine.available_transitions}
        # All numbers of transitions, also those within a transition of the node.
        invalid = [*({*range(100)} - valid)]
        capfd.readouterr()
        assert not any(succeeds(number) for number in invalid)
        assert not succeeds(0, 'dance')
        assert machine.current_state[1] == states[-1]
        log = capfd.readouterr().err
        lines = [line for line in log.splitlines() if f'not valid in state {states[-1]};' in line]
        assert len(lines) == len(invalid) + 1
        assert 'Traceback' not in log
    assert states == ['unconfigured', 'inactive', 'active', 'inactive', 'finalized']
