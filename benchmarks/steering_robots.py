# SPDX-License-Identifier: Apache-2.0
"""Robots of a steered insertion in simulated time, and the commander of one of them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import partial
from typing import Any

from benchmarks.steering_nodes import (
    COMMANDED,
    DIRECT,
    GOAL_ANSWER,
    GraphNode,
    HARDWARE,
    PERIOD,
    ROUTES,
    SETTINGS,
    SLIDE,
)
from needle_controller.steering.motion import JointMotion
from needle_dynamics.arrays import FloatArray
from needle_dynamics.simulated.commands import GUIDE_JOINTS
from needle_dynamics.simulated.run import Event, Executions, PlantRun, TRAJECTORY
from needle_ros.contract import (
    BASE,
    BASE_WRENCH,
    ENTRY,
    INSERTION,
    JOINT_COMMANDS,
    JOINT_STATES,
    JOINT_TRAJECTORY,
    TIP_DEFLECTION,
)
from needle_ros.requests import Acknowledgement, RequestLog, Verdict, WaitingRequests
from needle_ros.system_state import Mode
from needle_ros.timing import NANOSECONDS
from needle_ros.trajectories import JointPath
from needle_ros.wire import Reading
import numpy as np


class RobotNode(GraphNode):
    """
    Driver of the robot and the sensors, as `PlantNode` with its `PlantTrajectories`.

    The needle of a robot with an adapter (`HARDWARE`) is moved by another driver, which does not
    have the state of the system; its guide is moved by this node.
    """

    def _begin(self) -> None:
        graph, self._mode, self._retracted = self.graph, Mode.RUNNING, 0
        self._is_plant = graph.robot != HARDWARE
        moves_needle = graph.robot in (DIRECT, COMMANDED)
        self._moved = (INSERTION, *GUIDE_JOINTS) if moves_needle else GUIDE_JOINTS
        self._log = RequestLog({JOINT_TRAJECTORY: self._moved}, steady=graph.steady)
        self._waiting = WaitingRequests(self._log)
        self._executions = Executions(graph.run, self._moved)
        #: Largest force on the base along the needle [N].
        self.push = 0.0
        graph.run.begin()
        graph.run.commands.count_commanders(1)
        self.obey(graph.now)

    @property
    def requests(self) -> RequestLog:
        return self._log

    def measure(self, measured: Iterable[tuple[str, int, Sequence[float]]], now: int) -> None:
        """Publish the measurements of a sample."""
        if not self.runs or self.paused:
            return
        for name, _, values in measured:
            if name == BASE_WRENCH.name:
                self.push = max(self.push, abs(values[1]))
            if name in ROUTES:
                self.graph.post(name, _reading(name, now, values), self.name)
        self._executions.sampled = now
        if not self._executions.paused:
            self._waiting.execute(now + PERIOD, self.graph.run, 0.0)

    def take(self, topic: str, content: Any, now: int) -> None:
        run = self.graph.run
        if topic == JOINT_TRAJECTORY.name:
            self._follow(content, now)
        elif topic == JOINT_COMMANDS.name:
            run.command_joints(content, now)
            self._executions.forget(run.commanded)
        elif self.graph.robot == HARDWARE:
            ((position,), *_) = content.values
            depth = SLIDE.sign * SLIDE.scale * (position - SLIDE.zero)
            own = content._replace(names=(INSERTION,), values=((depth,), (), ()))
            run.command_joints(own, now)
        else:
            _, force, _, torque, _, _ = content.values[0]
            run.commands.offer(content.stamp, content.frame, force, torque, now)

    def _follow(self, move: JointMotion, now: int) -> None:
        """Follow a trajectory, from its stamp on."""
        own = [k for k, name in enumerate(move.joints) if name in self._moved]
        joints = tuple(move.joints[k] for k in own)
        stopped, log, topic = self.authority.reason, self._log, JOINT_TRAJECTORY
        if not own or log.check(topic, move.stamp, now, '', joints) is not None:
            return
        if stopped:
            log.answer(topic, move.stamp, Verdict.SUPERSEDED, f'stopped: {stopped}')
            return
        times, positions = move.times.tolist(), move.positions[:, own].tolist()
        path = JointPath(joints, times, positions, efforts=[[]] * len(times))
        act = partial(self._execute, path, joints)
        request = self._waiting.add(topic, move.stamp, joints, act)
        sampled = self._executions.sampled or now
        only = request if self._executions.paused else None
        self._waiting.execute(sampled + PERIOD, self.graph.run, request.elapsed(sampled), only)

    def _execute(
        self, path: JointPath, joints: tuple[str, ...], _run: PlantRun, elapsed: float
    ) -> None:
        self._executions.follow(path, joints, elapsed)

    def request(self, word: str, now: int) -> bool:
        success, _ = self.authority.request(word)
        self.obey(now)
        return success

    def watch(self, now: int) -> None:
        self.obey(now)

    def obey(self, now: int) -> None:
        mode, before = self.authority.mode, self._mode
        new, self._retracted = self.authority.compare(before, self._retracted)
        self._mode, run = mode, self.graph.run
        ends = mode in (Mode.STOPPED, Mode.RETRACTING) or before is Mode.STOPPED
        if new and ends:
            self._log.supersede(now)
            self._waiting.end(f'the system is {mode.value}', Verdict.SUPERSEDED)
            self._executions.forget(self._moved)
        if new and mode is Mode.STOPPED:
            self._halt()
        elif new and mode is Mode.RETRACTING and self._is_plant:
            run.withdraw()
        elif new and mode is Mode.PAUSED:
            self._executions.pause(withdraws=before is Mode.RETRACTING and self._is_plant)
        if new and before is Mode.PAUSED:
            self._executions.resume()
        run.commands.stopped = mode is Mode.STOPPED and self._is_plant
        run.mode = mode if self._is_plant else Mode.RUNNING

    def stop(self, _now: int) -> None:
        self._halt()
        self.runs = False

    def _halt(self) -> None:
        """Stop the guide, and the needle; a foreign driver is stopped by the controller only."""
        if self._is_plant:
            self.graph.run.halt()
            return
        at = [*self.graph.guide.values()]
        rest = {'joints': GUIDE_JOINTS, 'times': [0.05], 'positions': [at], 'efforts': [[]]}
        self.graph.run.perform(Event(TRAJECTORY, rest))


class CommanderNode(GraphNode):
    """
    Driver of ros2_control: follow goals joint by joint, and send positions as `joint_commands`.

    It has neither the state of the system nor the services of a user.
    """

    def _begin(self) -> None:
        graph, joints = self.graph, SETTINGS.joints
        self._log = RequestLog({}, steady=graph.steady)
        plant: Any = graph.run.plant
        at = {**plant.report.joint, INSERTION: plant.depth}
        #: Positions [m], and by joint the path (times [ns], positions [m]) that it follows.
        self._at = {name: float(at[name]) for name in joints}
        self._paths: dict[str, tuple[FloatArray, FloatArray]] = {}

    @property
    def requests(self) -> RequestLog:
        return self._log

    def place(self, joint: str, position: float) -> None:
        """Begin with a joint at a position [m]."""
        self._at[joint] = position

    def take(self, _topic: str, content: Any, now: int) -> None:
        move: JointMotion = content
        verdict = Verdict.ACCEPTED
        if {*move.joints} <= {*self._at} and np.isfinite(move.positions).all():
            times = (move.times * NANOSECONDS).astype(np.int64) + move.stamp - now
            for k, name in enumerate(move.joints):
                ahead = times > 0
                begin, end = (np.append(0, times[ahead]), move.positions[ahead, k])
                self._paths[name] = begin + now, np.append(self._at[name], end)
        else:
            verdict = Verdict.REJECTED
        answer = Acknowledgement(JOINT_TRAJECTORY.name, move.stamp, verdict)
        self.graph.post(GOAL_ANSWER, answer, self.name)

    def publish(self, *, again: bool = False) -> None:  # noqa: ARG002
        """Send the positions of the joints, in each period."""
        now = self.graph.now
        for name, (times, positions) in self._paths.items():
            self._at[name] = float(np.interp(now, times, positions))
        command = Reading(now, '', tuple(self._at), (tuple(self._at.values()), (), ()))
        self.graph.post(JOINT_COMMANDS.name, command, self.name)

    def obey(self, now: int) -> None:
        """Ignore the state of the system, which is not a topic of ros2_control."""

    def stop(self, _now: int) -> None:
        self.runs = False

    def watch(self, now: int) -> None:
        """Check nothing: a driver has no timeout of its goals."""

    def request(self, _word: str, _now: int) -> bool:
        return False


def _reading(name: str, stamp: int, values: Sequence[float]) -> Reading:
    """Return a measurement as a message."""
    if name != JOINT_STATES.name:
        frame = ENTRY if name == TIP_DEFLECTION.name else BASE
        return Reading(stamp, frame, (), (tuple(values),))
    names = (INSERTION, *GUIDE_JOINTS)
    count = len(names)
    columns = tuple(tuple(values[k : k + count]) for k in range(0, 3 * count, count))
    return Reading(stamp, '', names, columns)
