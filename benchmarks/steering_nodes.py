# SPDX-License-Identifier: Apache-2.0
"""
Nodes of a steered insertion in simulated time: robot, axial supervisor and steering executive.

They are the objects behind the ROS nodes. Every node can be stopped, killed, restarted and paused;
the world (needle, base and guide) moves on without its node.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace
from functools import lru_cache
from typing import Any, Final, NamedTuple

from needle_controller import (
    Controller,
    ControllerSettings,
    ExecutiveSettings,
    ForceCommand,
    HardwareSettings,
    Robot,
    SafetyLimits,
    SteeringExecutive,
    SteeringPrior,
)
from needle_controller.reference.setpoint import ReferenceLimits
from needle_controller.steering.motion import JointMotion
from needle_controller.supervisor import Supervisor
from needle_dynamics import NEEDLES
from needle_dynamics.simulated.commands import GUIDE_JOINTS
from needle_dynamics.simulated.run import PlantRun
from needle_ros.contract import (
    BASE,
    BASE_WRENCH,
    DIAGNOSTICS,
    EMERGENCY_STOP,
    JOINT_COMMANDS,
    JOINT_STATES,
    JOINT_TRAJECTORY,
    NEWEST,
    SENSOR,
    SYSTEM_STATE,
    TARGET,
    TIP_DEFLECTION,
    WRENCH_COMMAND,
)
from needle_ros.requests import Acknowledgement, RequestLog, RequestStatus
from needle_ros.system_state import Authority, CLEAR_STOP, PAUSE, RESUME, RETRACT, STOP
from needle_ros.timing import NANOSECONDS
from needle_ros.trajectories import JointPath
from needle_ros.wire import Reading

#: Rate of samples [Hz], and start time [ns].
RATE: Final = 50.0
EPOCH: Final = 1_700_000_000 * NANOSECONDS
PERIOD: Final = round(NANOSECONDS / RATE)

#: Kinds of robots: force commands on the topics of the contract without an adapter; position
#: commands in mm, away from the tissue, through the adapter of the controller; positions that
#: follow the trajectories of `steering`; positions by `joint_commands` of a commander
#: (ros2_control) that follows goals of `steering`. The last two have no controller.
CONTRACT, HARDWARE, DIRECT, COMMANDED = 'contract', 'hardware', 'direct', 'commanded'
ROBOTS: Final = (CONTRACT, HARDWARE, DIRECT, COMMANDED)

#: Topic of the commands of the first two robots; goals of an action, and their answers.
COMMAND: Final = WRENCH_COMMAND.name
GOAL, GOAL_ANSWER = 'goal', 'goal answer'

#: Nodes.
ROBOT, CONTROLLER, STEERING, USER = 'robot', 'controller', 'steering', 'user'
COMMANDER: Final = 'commander'
NODES: Final = {
    CONTRACT: (ROBOT, CONTROLLER, STEERING),
    HARDWARE: (ROBOT, CONTROLLER, STEERING),
    DIRECT: (ROBOT, STEERING),
    COMMANDED: (ROBOT, COMMANDER, STEERING),
}

#: Nodes with the services of a user, and the words of these services.
SERVERS: Final = (ROBOT, CONTROLLER, STEERING)
WORDS: Final = (STOP, PAUSE, RESUME, RETRACT, CLEAR_STOP)

#: Requests to a service by topic, and the topic of the response.
CALLS: Final = {f'{word} at {node}': (word, node) for word in WORDS for node in SERVERS}
RESPONSE: Final = 'response of '

#: Receivers of each topic, where they exist.
ROUTES: Final = {
    BASE_WRENCH.name: (CONTROLLER,),
    TIP_DEFLECTION.name: (CONTROLLER, STEERING),
    JOINT_STATES.name: (CONTROLLER, STEERING),
    COMMAND: (ROBOT,),
    JOINT_COMMANDS.name: (ROBOT,),
    JOINT_TRAJECTORY.name: (CONTROLLER, ROBOT),
    GOAL: (COMMANDER,),
    GOAL_ANSWER: (STEERING,),
    DIAGNOSTICS.name: (STEERING, USER),
    SYSTEM_STATE.name: SERVERS,
    TARGET.name: (STEERING,),
    EMERGENCY_STOP.name: SERVERS,
    **{topic: (node,) for topic, (_, node) in CALLS.items()},
    **{f'{RESPONSE}{topic}': (USER,) for topic in CALLS},
}

#: Topics of measurements, and number of other messages of a topic that a paused node keeps.
_MEASURED: Final = BASE_WRENCH.name, TIP_DEFLECTION.name, JOINT_STATES.name
_KEPT_ELSE: Final = 10

#: Joints of the guide.
_GUIDE: Final = frozenset(GUIDE_JOINTS)

NEEDLE, STEERING_CONSTANTS, _ = NEEDLES['bending_35mm']

#: Speed of the insertion [m/s], acceleration of the axial reference [m/s^2], and settings of the
#: steering executive.
SPEED: Final = 0.02
ACCELERATION: Final = 1.0
#: Four steps are too few to identify a skin.
PRIOR: Final = SteeringPrior(skin=0.0)

SETTINGS: Final = ExecutiveSettings(
    step_length=0.01, speed=SPEED, guide_speed=0.04, acceleration=0.4, measurement_time=0.2,
    settle_time=0.04, patience=2.0,
)  # fmt: skip

#: Robot with position commands: its joint points out of the tissue, in mm, with an offset.
SLIDE: Final = HardwareSettings(
    joint='slide', sign=-1.0, scale=1e-3, zero=120.0, command='position', speed=0.05,
    command_type='joint_state', command_topic='slide_command', state_topic='slide_states',
)  # fmt: skip

#: True needle: softer tissue than the nominal needle, a tilted guide and a bevel.
WORLD: Final[dict[str, object]] = {
    'steered': True,
    'needle': 'bending_35mm',
    'model.tissue_stiffness': 0.8 * NEEDLE.tissue_stiffness,
    'steering.bevel_load': [0.15],
    'rate': RATE,
    'depth': 1e-3,
    'tip.noise': 1e-4,
    'guide.speed_limit': 0.1,
    # A robot with position commands can follow the reference.
    'base.acceleration_limit': ACCELERATION,
    'step': 1e-3,
}


class Posted(NamedTuple):
    """A message in transmission; it arrives `late` [ns] after it was sent."""

    topic: str
    content: Any
    late: int = 0


class NodeNetwork(ABC):
    """World and time of nodes that are connected by messages; see `SteeringGraph`."""

    def __init__(self, robot: str, *, continuous: bool) -> None:
        self.robot, self.continuous = robot, continuous
        self.now = EPOCH
        mode = 'simulation' if robot == CONTRACT else 'robot'
        self.run = PlantRun({**WORLD, 'mode': mode})
        self.nodes: dict[str, GraphNode] = {}

    def steady(self) -> float:
        """Return the time of a steady clock [s]."""
        return (self.now - EPOCH) / NANOSECONDS

    @property
    def guide(self) -> dict[str, float]:
        """Positions of the joints of the guide [m, rad]."""
        plant: Any = self.run.plant
        return {name: plant.report.joint[name] for name in GUIDE_JOINTS}

    @abstractmethod
    def post(self, topic: str, content: Any, sender: str) -> None:
        """Send a message to all receivers of its topic."""


class GraphNode(ABC):
    """
    A node: its messages, its part of the system state, and its answers to requests.

    ``runs`` is whether it takes messages; a paused node keeps them until it is resumed, at most
    ``samples`` of a topic of measurements.
    """

    samples = SENSOR.depth

    def __init__(self, graph: NodeNetwork, name: str) -> None:
        self.graph, self.name = graph, name
        self.runs, self.paused = True, False
        self.kept: deque[Posted] = deque()
        self.start()

    def start(self) -> None:
        """Start, or restart without memory; the latched states of other nodes are received."""
        self.runs, self.paused = True, False
        self.authority = Authority(f'/{self.name}', lambda: self.graph.now)
        for other in self.graph.nodes.values():
            if other is not self and other.runs:
                self.authority.receive(other.authority.state)
        self._begin()

    @abstractmethod
    def _begin(self) -> None:
        """Create the object behind the node, and activate it."""

    @abstractmethod
    def take(self, topic: str, content: Any, now: int, /) -> None:
        """Process a message."""

    @abstractmethod
    def obey(self, now: int, /) -> None:
        """Follow the state of the system."""

    @abstractmethod
    def stop(self, now: int, /) -> None:
        """Deactivate."""

    @property
    @abstractmethod
    def requests(self) -> RequestLog:
        """Requests and their answers."""

    @abstractmethod
    def watch(self, now: int) -> None:
        """Check for missing inputs."""

    @abstractmethod
    def request(self, word: str, now: int) -> bool:
        """Execute a request of a user; return whether it was not refused."""

    def receive(self, posted: Posted, now: int) -> None:
        """Take a message, or keep it while paused."""
        if self.paused:
            self.kept.append(posted)
        elif self.runs and posted.topic == SYSTEM_STATE.name:
            self.authority.receive(posted.content)
            if self.authority.changed:
                self.obey(now)
        elif self.runs and posted.topic == EMERGENCY_STOP.name:
            if posted.content:
                self.request(STOP, now)
        elif self.runs and posted.topic in CALLS:
            success = self.request(CALLS[posted.topic][0], now)
            self.graph.post(f'{RESPONSE}{posted.topic}', success, self.name)
        elif self.runs:
            self.take(posted.topic, posted.content, now)

    def resume(self, now: int) -> None:
        """Continue after a pause with the newest messages of each topic."""
        self.paused, kept = False, list(self.kept)
        self.kept.clear()
        for k, posted in enumerate(kept):
            after = sum(one.topic == posted.topic for one in kept[k + 1 :])
            if after < (self.samples if posted.topic in _MEASURED else _KEPT_ELSE):
                self.receive(posted, now)

    def publish(self, *, again: bool = False) -> None:
        """Publish the system state and the answers to requests, if they are new or ``again``."""
        if self.authority.changed or again:
            self.authority.changed = False
            self.graph.post(SYSTEM_STATE.name, self.authority.state, self.name)
        if self.requests.due() or again:
            content = self.name, self.requests.status()
            self.graph.post(DIAGNOSTICS.name, content, self.name)


class SimulatedController(GraphNode):
    """Axial supervisor, as the node of the same name."""

    samples = NEWEST.depth

    def _begin(self) -> None:
        graph, controller = self.graph, deepcopy(_controller())
        self._supervisor = supervisor = Supervisor(graph.steady)
        supervisor.authority = self.authority
        self._adapter: Robot | None = None
        if graph.robot == HARDWARE:
            self._adapter = Robot(SLIDE)
            self._adapter.configure(controller)
        supervisor.receive(targets=False)
        supervisor.configure(controller, SafetyLimits(), None, self._adapter)
        supervisor.activate(graph.now, _SOURCES)
        self._inputs: dict[str, Callable[[Reading, int], ForceCommand | None]] = {
            JOINT_STATES.name: supervisor.encoders,
            BASE_WRENCH.name: supervisor.wrench,
            TIP_DEFLECTION.name: supervisor.tip,
        }

    @property
    def requests(self) -> RequestLog:
        return self._supervisor.requests

    @property
    def fault(self) -> str:
        """Reason why no force is commanded, '' if there is none."""
        return self._supervisor.fault or ''

    def take(self, topic: str, content: Any, now: int) -> None:
        supervisor = self._supervisor
        if topic == JOINT_TRAJECTORY.name:
            if {*content.joints} <= _GUIDE:
                return
            positions, velocities = content.positions.tolist(), content.velocities.tolist()
            path = JointPath(content.joints, content.times.tolist(), positions, velocities)
            self._act(supervisor.trajectory(content.stamp, '', path, now))
            return
        if topic == JOINT_STATES.name and self._adapter is not None:
            content = _of_slide(content)
        self._act(self._inputs[topic](content, now))

    def obey(self, now: int) -> None:
        self._act(self._supervisor.obey(now))

    def request(self, word: str, now: int) -> bool:
        success, _, command = self._supervisor.request(word, now)
        self._act(command)
        return success

    def watch(self, now: int) -> None:
        self._act(self._supervisor.watch(now, _SOURCES))

    def stop(self, now: int) -> None:
        self._act(self._supervisor.deactivate(now))
        self.runs = False

    def _act(self, answer: ForceCommand | None) -> None:
        """Send a command."""
        if answer is None:
            return
        supervisor = self._supervisor
        command = Reading(answer.stamp, BASE, (), ((0.0, answer.force, 0.0, 0.0, 0.0, 0.0),))
        if self._adapter is not None:
            stopped = supervisor.safety.stop is not None
            depth, load = supervisor.depth(self.graph.now), supervisor.bending.load
            positions = self._adapter.command(answer, depth, load, stopped=stopped)
            if positions is None:
                return
            command = Reading(answer.stamp, '', (SLIDE.joint,), (tuple(positions), (), ()))
        self.graph.post(COMMAND, command, self.name)


class SimulatedSteering(GraphNode):
    """Steering executive, as the node of the same name."""

    def _begin(self) -> None:
        settings = replace(SETTINGS, continuous=self.graph.continuous)
        self.loop = SteeringExecutive(
            NEEDLE, STEERING_CONSTANTS, PRIOR, settings, steady=self.graph.steady
        )
        self.loop.authority = self.authority
        self._goal: JointMotion | None = None  #: last goal, as `TrajectoryClient`

    @property
    def requests(self) -> RequestLog:
        return self.loop.requests

    def take(self, topic: str, content: Any, now: int) -> None:
        loop = self.loop
        if topic == JOINT_STATES.name:
            self._act(loop.joints(content, now))
        elif topic == TIP_DEFLECTION.name:
            self._act(loop.tip(content, now))
        elif topic == TARGET.name:
            stamp, frame, point = content
            self._act(loop.target(stamp, frame, point, now))
        elif topic == GOAL_ANSWER:
            if self._goal is not None and content.stamp == self._goal.stamp:
                self._report(self._goal, (content,), now)
        else:
            node, status = content
            if status.takes:
                self._act(loop.receive(node, status, now))

    def obey(self, now: int) -> None:
        self._act(self.loop.obey(now))

    def request(self, word: str, now: int) -> bool:
        success, _, move = self.loop.request(word, now)
        self._act(move)
        return success

    def watch(self, now: int) -> None:
        self.obey(now)
        self._act(self.loop.watch(now))

    def stop(self, now: int) -> None:
        self._act(self.loop.halt('the node was deactivated', now))
        self.runs = False

    def _act(self, move: JointMotion | None) -> None:
        """Send a motion, or a goal."""
        if move is None:
            return
        if self.graph.robot == COMMANDED:
            self._goal = move
            self._report(move, (), self.graph.now)
            self.graph.post(GOAL, move, self.name)
        else:
            self.graph.post(JOINT_TRAJECTORY.name, move, self.name)

    def _report(self, goal: JointMotion, answers: tuple[Acknowledgement, ...], now: int) -> None:
        """Process the answers to a goal, as `TrajectoryClient`."""
        status = RequestStatus({JOINT_TRAJECTORY.name: goal.joints}, answers)
        self._act(self.loop.receive(COMMANDER, status, now))


#: Publishers of commands and measurements, as counted by the controller.
_SOURCES: Final = dict.fromkeys((COMMAND, JOINT_STATES.name, BASE_WRENCH.name), 1)


@lru_cache(maxsize=1)
def _controller() -> Controller:
    """Return a controller at rest, to be copied: the check of its stability takes time."""
    limits = ReferenceLimits(speed=2.0 * SPEED, acceleration=ACCELERATION)
    return Controller(NEEDLE, settings=ControllerSettings(rate=RATE), limits=limits)


def _of_slide(reading: Reading) -> Reading:
    """Return the joint states of the robot with position commands, without velocities."""
    position = reading.values[0][0] / (SLIDE.sign * SLIDE.scale) + SLIDE.zero
    return Reading(reading.stamp, '', (SLIDE.joint,), ((position,), (), ()))
