# SPDX-License-Identifier: Apache-2.0
"""Slow imports and compilation happen before `configure`, while services respond."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import product
from pathlib import Path
import re
from time import thread_time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from lifecycle_msgs.srv import GetState
from needle_controller import LAWS
from needle_controller.controller_node import ControllerNode
from needle_controller.reference.generator import REFERENCES
from needle_controller.steering.law import DEFAULT_LAW, STEERING_LAWS
from needle_controller.steering_node import SteeringNode
from needle_dynamics.compiled.store import SUFFIX
from needle_dynamics.plant_node import PlantNode
from needle_insertion.live.operator import Operator
from needle_ros.base_node import COMMAND, SENSOR
from needle_ros.contract import JOINT_COMMANDS, JOINT_STATES, TIP_DEFLECTION
from needle_ros.status import SteeringPhase, SteeringStatus
import numba
from numba.core.event import install_recorder
import pytest
from rclpy.node import Node
from rclpy.task import Future
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger
from support.ros_graph import RosGraph
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

#: Duration of a large import, which blocks the node [us].
LARGEST_IMPORT = 20_000

#: Longest part of a line of ``-X importtime``: own and cumulative time [us], module.
IMPORT = re.compile(r'import time:\s+\d+ \|\s+(\d+) \|\s*(\S+)')

#: Longest processor time of `configure` and `activate` [s].
LONGEST_BLOCK = 0.2

#: Minimum number of sequential requests answered by a compiling node.
RESPONSES = 10

#: Rate of the nodes [Hz]: other tests load the machine, and a late measurement stops the needle.
RATE = {'rate': 200.0}

STEERED = {'needle': 'bending_35mm', 'steered': True, 'depth': 0.001, **RATE}
STEERING = {
    'step_length': 0.01,
    'speed': 0.05,
    'guide_speed': 0.05,
    'acceleration': 0.4,
    'measurement_time': 0.15,
    'settle_time': 0.02,
    'measurement_timeout': 5.0,
}


class Rig:
    """Node processes that log their imports, and a user."""

    def __init__(self, graph: RosGraph, logs: Path, **nodes: dict[str, Any]) -> None:
        self.graph, self.logs = graph, logs
        graph.environment['PYTHONPROFILEIMPORTTIME'] = '1'
        self.user = graph.node('user')
        self.operator = Operator(self.user)
        self.states = graph.latest(self.user, JointState, 'joint_states', SENSOR)
        self.course = self.user.create_publisher(JointTrajectory, 'joint_trajectory', COMMAND)
        for name, parameters in nodes.items():
            graph.start(name, parameters)
        self.until(lambda: all('active:' in self.log(name) for name in nodes), 'the nodes')
        self.until(lambda: set(nodes) <= set(self.operator.states), '/diagnostics')

    def until(self, condition: Callable[[], Any], event: str) -> None:
        """Spin until a condition holds."""
        self.graph.spin_until(condition, event, 300.0)

    def log(self, name: str) -> str:
        """Return the log of a node."""
        return (self.logs / f'{name}.log').read_text()

    def done(self, response: Future) -> None:
        """Wait for the response to a request."""
        self.until(response.done, 'the response')
        assert response.result().success, response.result()

    @property
    def depth(self) -> float:
        """Insertion depth [m]."""
        message = self.states.message
        return float(message.position[0]) if message else 0.0

    def answer(self, *point: float) -> tuple[bool, str]:
        """Send a target; return whether it is accepted, and the answer."""
        sent = self.operator.target(*point)
        self.until(lambda: sent.done, 'the answer to the target')
        return sent.outcome

    def send(self, *point: float) -> None:
        """Send a target, and repeat it while measurements are missing."""
        accepted = False
        while not accepted:
            accepted, line = self.answer(*point)
            assert accepted or JOINT_STATES.name in line or TIP_DEFLECTION.name in line, line

    def go(self, depth: float) -> None:
        """Move to a depth [m]."""
        self.send(0.0, depth, 0.0)
        self.until(lambda: abs(self.depth - depth) < 1e-4, f'a depth of {depth} m')

    def move(self, depth: float, duration: float) -> None:
        """Send an insertion trajectory, and wait until the needle is near its end."""
        point = JointTrajectoryPoint(positions=[depth])
        point.time_from_start.sec = 0
        point.time_from_start.nanosec = round(1e9 * duration)
        message = JointTrajectory(joint_names=['insertion'], points=[point])
        self.until(self.course.get_subscription_count, 'the subscriber')
        begin = self.depth
        self.course.publish(message)
        self.until(lambda: abs(self.depth - begin) > 1e-4, 'a motion')

    def imports(self) -> Iterator[str]:
        """Yield large imports of active nodes."""
        for path in self.logs.glob('*.log'):
            active = False
            for line in path.read_text().splitlines():
                active |= 'active:' in line
                found = IMPORT.search(line)
                if active and found and int(found[1]) > LARGEST_IMPORT:
                    yield f'{path.stem}: {found[2]} {int(found[1]) / 1e3:.0f} ms'


@pytest.fixture
def rig(ros_graph: RosGraph, tmp_path: Path) -> Iterator[Callable[..., Rig]]:
    """Return a factory of rigs, and check for late imports at the end (RosGraph: compilation)."""
    made: list[Rig] = []

    def make(**nodes: dict[str, Any]) -> Rig:
        made.append(Rig(ros_graph, tmp_path / 'logs', **nodes))
        return made[-1]

    yield make
    for one in made:
        assert not [*one.imports()]


@pytest.mark.parametrize('feedback', ['observer', 'ground_truth', 'none'])
def test_controller_preloads_all_laws(rig: Callable[..., Rig], feedback: str) -> None:
    """Targets, trajectories, pauses, retraction, stops, and live changes of law and gains."""
    one = rig(plant=RATE, controller={'deflection_feedback': feedback, **RATE})
    one.go(0.025)
    for law in LAWS[::-1]:
        one.done(one.operator.set('controller', 'law', law))
        one.go(0.03 if one.depth < 0.028 else 0.025)
    one.done(one.operator.set('controller', 'model.viscous_friction', 310.0))
    one.done(one.operator.ask('pause'))
    one.done(one.operator.ask('resume'))
    one.move(one.depth + 2e-3, 0.5)
    one.done(one.operator.ask('retract'))
    one.done(one.operator.ask('stop'))
    one.done(one.operator.ask('clear'))
    one.go(0.022)


@pytest.mark.parametrize('reference', [*REFERENCES])
def test_controller_preloads_all_references(rig: Callable[..., Rig], reference: str) -> None:
    """Each reference type reaches a target, also during a motion."""
    one = rig(plant=RATE, controller={'reference.kind': reference, **RATE})
    # A step is a tracking error: above `safety.tracking_error` it causes a stop.
    way = 5e-4 if reference == 'step' else 0.01
    one.go(0.02 + way)
    one.send(0.0, 0.02 - way, 0.0)
    one.go(0.02)


@pytest.mark.parametrize(
    'plant',
    [
        {'mode': 'robot', **RATE},
        {'mode': 'robot', 'fault.kind': 'bias', **RATE},
        {'mode': 'robot', 'sensor.filter': 3, **RATE},
        {'mode': 'robot', **STEERED},
    ],
    ids=str,
)
def test_plant_preloads_mode_robot(rig: Callable[..., Rig], plant: dict[str, Any]) -> None:
    """The plant follows positions and applies a push force."""
    one = rig(plant=plant)
    one.move(one.depth + 2e-3, 0.2)
    one.done(one.operator.set('plant', 'model.coulomb_friction', 0.6))


def test_plant_preloads_joint_commands(rig: Callable[..., Rig]) -> None:
    """The needle follows the positions of a driver."""
    one = rig(plant={'mode': 'robot', **STEERED})
    driver = one.user.create_publisher(JointState, JOINT_COMMANDS.name, COMMAND)
    goal = one.depth + 1e-3

    def arrived() -> bool:
        driver.publish(JointState(name=['insertion'], position=[goal]))
        return abs(one.depth - goal) < 1e-4

    one.until(arrived, 'the commanded position')


def test_plant_preloads_mode_indenter(rig: Callable[..., Rig]) -> None:
    """The end-effector presses in both directions."""
    one = rig(plant={'mode': 'indenter', **RATE})
    poses = one.graph.latest(one.user, PoseStamped, 'end_effector_pose', SENSOR)
    point = JointTrajectoryPoint(effort=[0.6, -1.2])
    point.time_from_start.nanosec = 500_000_000
    one.until(lambda: one.course.get_subscription_count() and poses.message, 'the plant')
    one.course.publish(JointTrajectory(joint_names=['x', 'z'], points=[point]))
    one.until(lambda: poses.message.pose.position.z < -9e-4, 'the press')


#: Options of each strategy and, besides the default, each law. The laws do not depend on the mode.
OPTIONS: list[dict[str, Any]] = [{}, {'continuous': True}, {'turns': 1}]
OTHER_LAWS = [{'law': law} for law in STEERING_LAWS if law != DEFAULT_LAW]


@pytest.mark.parametrize(
    ('options', 'mode'),
    [
        *product(OPTIONS, ('robot', 'simulation')),
        *(({'turns': int('roll' in one['law']), **one}, 'robot') for one in OTHER_LAWS),
    ],
    ids=str,
)
def test_steering_preloads_an_insertion(
    rig: Callable[..., Rig], options: dict[str, Any], mode: str
) -> None:
    """With each strategy and each law."""
    nodes = {'plant': {'mode': mode, **STEERED}, 'steering': {**STEERING, **options}}
    if mode == 'simulation':
        nodes['controller'] = {
            'needle': 'bending_35mm', 'steered': True, **RATE,
            'deflection_feedback': 'none', 'reference.speed': 0.05,
        }  # fmt: skip
    one = rig(**nodes)

    one.send(1e-3, 0.031, -1e-3)

    def ended() -> bool:
        status = one.operator.states['steering'].report.status
        ends = (SteeringPhase.DONE, SteeringPhase.STOPPED)
        return isinstance(status, SteeringStatus) and status.phase in ends

    one.until(ended, 'the end of the insertion')


def test_nodes_respond_while_they_compile(ros_graph: RosGraph, tmp_path: Path) -> None:
    """Three nodes share an empty cache: each function is compiled once, before activation."""
    folder, logs = tmp_path / 'code', tmp_path / 'logs'
    ros_graph.environment['NUMBA_CACHE_DIR'] = str(folder)
    user = ros_graph.node('user')
    names = ('plant', 'controller', 'steering')
    reports: list[str] = []

    def hear(array: DiagnosticArray) -> None:
        reports.extend(status.message for status in array.status)

    user.create_subscription(DiagnosticArray, '/diagnostics', hear, 10)
    for name in names:
        ros_graph.start(name)
    for name in names:
        ros_graph.wait_for(user, name)
    stop = user.create_client(Trigger, 'steering/stop')
    answered = {name: _answers(ros_graph, user, name) for name in names}
    ros_graph.spin_until(stop.service_is_ready, 'the service')
    response = stop.call_async(Trigger.Request())
    ros_graph.spin_until(response.done, 'the response of a node that compiles')
    ros_graph.spin_until(
        lambda: all(states()[-1:] == ['active'] for states in answered.values()),
        'the nodes',
        600.0,
    )
    for states in answered.values():
        assert states().count('unconfigured') >= RESPONSES
    assert any(re.match(r'preparing \d+ of \d+ \(\w+\)', report) for report in reports)
    compiled = [
        int(number)
        for path in logs.glob('*.log')
        for number in re.findall(r'(\d+) functions compiled', path.read_text())
    ]
    assert sum(compiled) == len([*folder.glob(f'*{SUFFIX}')])


@pytest.mark.parametrize('kind', [PlantNode, ControllerNode, SteeringNode])
def test_configure_compiles_nothing_after_the_preparation(ros_graph: RosGraph, kind: Any) -> None:
    """
    The executor answers `get_state` and `~/stop` before and after `configure`, not within it.

    The time of the processor is counted, which other processes hardly lengthen, relative to its
    speed.
    """
    node = ros_graph.add(kind, start=False)
    node._preparation.complete()
    with install_recorder('numba:compile') as compilations:
        begun = thread_time()
        assert node.start(), node.failure
        blocked = thread_time() - begun
    assert not compilations.buffer
    assert blocked < LONGEST_BLOCK * _slowness()


def _slowness() -> float:
    """Return the time of a loop over that on a usual processor, 13 ms; at least 1."""
    begun, total = thread_time(), 0
    for k in range(300_000):
        total += k
    return max(1.0, (thread_time() - begun) / 0.013)


def test_late_compilation_of_a_users_function_is_an_error(ros_graph: RosGraph) -> None:
    """A law of the user may call a function that only Numba knows."""
    node = ros_graph.add(PlantNode, parameters=RATE)

    @numba.njit
    def users_law(depth: float) -> float:
        return 2.0 * depth

    assert users_law(0.5) == 1.0
    (name,) = node.late
    assert name.endswith('users_law')
    node.late.clear()


def _answers(graph: RosGraph, user: Node, name: str) -> Callable[[], list[str]]:
    """Request the state of a node repeatedly; return its answers so far."""
    client = user.create_client(GetState, f'{name}/get_state')
    states: list[str] = []

    def ask() -> None:
        client.call_async(GetState.Request()).add_done_callback(take)

    def take(response: Future) -> None:
        states.append(response.result().current_state.label)
        if states[-1] != 'active':
            ask()

    graph.spin_until(client.service_is_ready, f'the node {name}')
    ask()
    return lambda: states
