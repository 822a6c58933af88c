# SPDX-License-Identifier: Apache-2.0
"""One state of controller, steering and plant over DDS, whichever node receives a request."""

from __future__ import annotations

from typing import Any

from needle_controller.controller_node import ControllerNode
from needle_controller.steering.motion_control import STILL
from needle_controller.steering_node import SteeringNode
from needle_dynamics.plant_node import PlantNode
from needle_ros.base_node import COMMAND, SENSOR
from needle_ros.status import SteeringPhase
from needle_ros.system_state import Mode
from nodes.test_steering import Bench, STEERING
import pytest
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool
from std_srvs.srv import SetBool, Trigger
from support.ros_graph import RosGraph

NODES = ('controller', 'steering', 'plant')


class System(Bench):
    """Plant, controller and steering in lock-step, and a user."""

    def __init__(self, graph: RosGraph) -> None:
        super().__init__(graph, mode='simulation', use_sim_time=True)
        parameters = {
            'use_sim_time': True,
            'steered': True,
            'rate': 200.0,
            'reference.speed': 0.06,
            'reference.acceleration': 1.0,
            'needle': 'bending_35mm',
            'deflection_feedback': 'none',
        }
        self.controller = graph.add(ControllerNode, parameters=parameters)
        self.takers = 2
        self.depths: list[float] = []
        self.user.create_subscription(JointState, 'joint_states', self._on_state, 100)

    def _on_state(self, message: JointState) -> None:
        self.depths.append(message.position[message.name.index('insertion')])

    @property
    def modes(self) -> set[Mode]:
        return {
            node.diagnose().status.system for node in (self.controller, self.steering, self.plant)
        }

    def call(self, service: str, data: bool | None = None) -> Any:
        kind = Trigger if data is None else SetBool
        client = self.user.create_client(kind, service)
        self.until(client.service_is_ready, service)
        request = kind.Request() if data is None else SetBool.Request(data=data)
        answer = client.call_async(request)
        self.until(answer.done, f'the answer of {service}')
        self.user.destroy_client(client)
        return answer.result()

    def agree(self, mode: Mode) -> None:
        self.until(lambda: self.modes == {mode}, f'the mode {mode}')

    def rest(self) -> float:
        """Wait until needle and guide rest, and return the insertion depth [m]."""

        def rests() -> bool:
            before = [self.at(name) for name in ('insertion', 'guide_x', 'guide_z')]
            count = len(self.depths) + 40
            self.until(lambda: len(self.depths) > count, 'samples')
            after = [self.at(name) for name in ('insertion', 'guide_x', 'guide_z')]
            return max(abs(b - a) for a, b in zip(before, after, strict=True)) < 1e-5

        self.until(rests, 'rest')
        return self.at('insertion')


@pytest.mark.requirement('S-004', 'S-005', 'S-017', 'S-088')
@pytest.mark.parametrize('asked', NODES)
def test_requests_hold_for_the_whole_system(ros_graph: RosGraph, asked: str) -> None:
    """Pause, resume, retract, stop and clear during an insertion, by any of the nodes."""
    system = System(ros_graph)
    system.aim()
    system.until(lambda: system.at('insertion') > 0.015, 'the insertion')
    assert system.call(f'{asked}/pause', data=True).success
    system.agree(Mode.PAUSED)
    depth = system.rest()
    assert system.steering._loop.steers
    assert system.call(f'{asked}/pause', data=False).success
    system.until(lambda: system.at('insertion') > depth + 2e-3, 'the motion')
    begun = max(system.depths)
    assert system.call(f'{asked}/retract').success
    system.agree(Mode.RETRACTING)
    system.until(lambda: system.at('insertion') < begun - 2e-3, 'the withdrawal')
    assert system.call(f'{asked}/stop').success
    system.agree(Mode.STOPPED)
    depth = system.rest()
    assert depth > 0.01
    # Braking from 50 mm/s within 0.2 s, and the delay of the request.
    assert max(system.depths) < begun + 8e-3
    for node in NODES:
        assert not system.call(f'{node}/retract').success
    other = NODES[NODES.index(asked) - 1]
    assert system.call(f'{other}/clear_stop').success
    system.agree(Mode.RUNNING)
    # Without force the bent needle relaxes by less than what counts as rest.
    assert system.rest() == pytest.approx(depth, abs=STILL)
    assert system.call(f'{other}/retract').success
    system.until(lambda: abs(system.at('insertion') - 0.01) < 5e-4, 'the retract depth')
    system.until(lambda: abs(system.at('guide_x')) + abs(system.at('guide_z')) < 3e-4, 'the guide')


@pytest.mark.requirement('S-268', 'S-270')
@pytest.mark.parametrize('restarts', [False, True])
def test_retraction_ends_at_the_depth_of_the_controller(
    ros_graph: RosGraph, restarts: bool
) -> None:
    """Deeper than `retract_depth` of `steering`, which may start during the retraction."""
    system = System(ros_graph)
    depth = Parameter('retract_depth', value=0.02)
    assert system.controller.set_parameters([depth])[0].successful
    system.aim()
    system.until(lambda: system.at('insertion') > 0.031, 'the insertion')
    if restarts:
        system.steering.stop()
        assert system.call('controller/retract').success
        system.until(lambda: system.at('insertion') < 0.03, 'the withdrawal')
        parameters = {**STEERING, 'use_sim_time': True}
        system.steering = system.graph.add(SteeringNode, parameters=parameters)
    else:
        assert system.call('steering/retract').success
    for phase in (SteeringPhase.RETRACTING, SteeringPhase.IDLE):
        system.until(lambda: system.status.phase is phase, f'the phase {phase}')  # noqa: B023
    assert system.said.startswith('waits for a target')
    # The tolerance of the depth, and the rest of the law in friction.
    assert system.at('insertion') == pytest.approx(0.02, abs=5e-4)
    assert abs(system.at('guide_x')) + abs(system.at('guide_z')) < 3e-4


@pytest.mark.requirement('S-004')
@pytest.mark.parametrize(
    'parameters',
    [
        {},
        {'steered': True, 'needle': 'bending_35mm'},
        {'mode': 'robot', 'steered': True, 'needle': 'bending_35mm'},
        {'mode': 'indenter'},
    ],
    ids=['simulation', 'steered', 'robot', 'indenter'],
)
def test_a_stop_before_the_configuration_holds_after_it(
    ros_graph: RosGraph, parameters: dict[str, object]
) -> None:
    user = ros_graph.node('user')
    plant = ros_graph.add(PlantNode, parameters=parameters, start=False)
    stop = user.create_client(Trigger, 'plant/stop')
    answer = stop.call_async(Trigger.Request())
    ros_graph.spin_until(answer.done, 'the answer')
    assert answer.result().success
    assert plant.start(), plant.failure
    assert plant.diagnose().status.system is Mode.STOPPED


@pytest.mark.requirement('S-006', 'S-088')
@pytest.mark.parametrize('qos', [COMMAND, SENSOR], ids=['reliable', 'best effort'])
def test_emergency_topic_stops_and_a_late_node_knows(ros_graph: RosGraph, qos: QoSProfile) -> None:
    """The force is zero; a node that starts during stop or pause follows it, too."""
    system = System(ros_graph)
    system.aim()
    system.until(lambda: system.at('insertion') > 0.015, 'the insertion')
    emergency = system.user.create_publisher(Bool, 'emergency_stop', qos)
    # Each node has a subscription of each kind; a best-effort publisher matches one of them.
    matched = 3 if qos is SENSOR else 6
    system.until(lambda: emergency.get_subscription_count() == matched, 'the nodes')
    emergency.publish(Bool(data=True))
    system.agree(Mode.STOPPED)
    system.rest()
    late = ros_graph.add(SteeringNode, parameters={'use_sim_time': True})
    system.until(lambda: late.diagnose().status.system is Mode.STOPPED, 'the state')
    late.stop()
    assert system.call('plant/clear_stop').success
    assert system.call('plant/pause', data=True).success
    system.agree(Mode.PAUSED)
    assert late.trigger_activate() == TransitionCallbackReturn.SUCCESS
    system.until(lambda: late._loop._obeyed is Mode.PAUSED, 'the pause')
