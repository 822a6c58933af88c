# SPDX-License-Identifier: Apache-2.0
"""Steering executive with a simulated robot, needle and tracker, in simulated time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

from needle_controller import ExecutiveSettings, SteeringExecutive, SteeringPrior
from needle_controller.steering.insertion_plan import Plan
from needle_controller.steering.law import DEFAULT_LAW
from needle_controller.steering.motion import JointMotion
from needle_controller.steering.settings import ContactSettings
from needle_dynamics import NEEDLES, SteeredNeedle
from needle_ros.contract import JOINT_TRAJECTORY
from needle_ros.requests import RequestLog, Verdict
from needle_ros.wire import Reading
import numpy as np
import pytest

NEEDLE, STEERING, _ = NEEDLES['bending_35mm']
SETTINGS = ExecutiveSettings(measurement_time=0.2)
#: Period of the robot and its tracker [ns].
PERIOD = 10_000_000
SECOND = 100 * PERIOD
TARGET = (2e-3, 0.06, -1e-3)
NAMES = ('insertion', 'guide_x', 'guide_z')
CONTINUOUS = replace(SETTINGS, continuous=True)


class Robot:
    """Executive, robot and needle in tissue softer than the prior."""

    def __init__(
        self,
        own: ExecutiveSettings = SETTINGS,
        prior: SteeringPrior | None = None,
        law: str = DEFAULT_LAW,
        plan: Plan | None = None,
        contact: ContactSettings | None = None,
    ) -> None:
        self.seconds = 0.0
        self.loop = SteeringExecutive(
            NEEDLE,
            STEERING,
            prior or SteeringPrior(),
            own,
            steady=lambda: self.seconds,
            law=law,
            plan=plan,
            contact=contact,
        )
        softer = replace(NEEDLE, tissue_stiffness=0.6 * NEEDLE.tissue_stiffness)
        self.needle = SteeredNeedle(softer, STEERING, tilt=(0.01, 0.02))
        self.now = 1000 * SECOND
        self.at = np.zeros(3)
        #: Motion of each joint: times [ns] and positions.
        self.ways = [(np.zeros(1), np.zeros(1)) for _ in NAMES]
        self.noise = np.random.default_rng(3)
        #: Injected faults: joint motion, reported joint positions, and measured tip position.
        self.moves: Callable[[np.ndarray[Any, Any]], np.ndarray[Any, Any]] = lambda at: at
        self.says: Callable[[Any], Any] = lambda at: at
        self.sees: Callable[[Any], Any] = lambda tip: tip
        self.late = 0
        self.waiting: list[tuple[int, Any]] = []
        self.tracked: list[np.ndarray[Any, Any]] = []
        #: Joints by node, and reason of a rejected motion.
        self.moved = {'controller': NAMES[:1], 'plant': NAMES[1:]}
        self.logs = {
            name: RequestLog({JOINT_TRAJECTORY: joints}, steady=lambda: self.seconds)
            for name, joints in self.moved.items()
        }
        self.rejects: Callable[[str, JointMotion], str] = lambda _name, _move: ''
        #: Stamps of the executed motions, by joint.
        self.begun: list[int] = []

    def tick(self, count: int = 1) -> None:
        """Advance time by a number of periods."""
        for _ in range(count):
            self.now += PERIOD
            self.seconds += 1e-9 * PERIOD
            self.at = self.moves(np.array([np.interp(self.now, *way) for way in self.ways]))
            self.needle.move(depth=float(self.at[0]), guide=self.at[1:].tolist())
            self.tracked.append(self.at)
            x, y, z = self.needle.tip
            tip = np.array([x, y, z]) + 1.8e-4 * self.noise.standard_normal(3)
            self.waiting.append((self.now, self.sees(tip)))
            said = self.says(self.at)
            if said is not None:
                states = self.joints(self.now, said)
                self.post('joint_states', partial(self.take, self.loop.joints, states))
            while self.waiting and self.waiting[0][0] <= self.now - self.late:
                stamp, seen = self.waiting.pop(0)
                if seen is not None:
                    reading = Reading(stamp, 'needle_entry', (), (tuple(seen),))
                    self.post('tip_deflection', partial(self.take, self.loop.tip, reading))
            if self.now % SECOND == 0:
                self.report()
            self.follow(self.loop.watch(self.now))

    @staticmethod
    def joints(stamp: int, at: Any) -> Reading:
        return Reading(stamp, '', NAMES, (tuple(at), (0.0,) * 3, ()))

    def take(self, take: Callable[[Any, int], JointMotion | None], message: Any) -> None:
        """Pass a message to the loop, and send the returned motion."""
        self.follow(take(message, self.now))

    def post(self, _topic: str, deliver: Callable[[], None]) -> None:
        """Deliver a message; here immediately."""
        deliver()

    def follow(self, move: JointMotion | None) -> None:
        """Send a motion to all nodes with joints."""
        if move is not None:
            for name, log in self.logs.items():
                self.post('joint_trajectory', partial(self.execute, name, log, move))

    def execute(self, name: str, log: RequestLog, move: JointMotion) -> None:
        """Start the motion of the own joints at their positions, and acknowledge it."""
        own = [joint for joint in move.joints if joint in self.moved[name]]
        if not own:
            return
        if log.check(JOINT_TRAJECTORY, move.stamp, self.now, '', own) is None:
            why = self.rejects(name, move)
            verdict = Verdict.REJECTED if why else Verdict.ACCEPTED
            log.answer(JOINT_TRAJECTORY, move.stamp, verdict, why, own)
            times = self.now + 1e9 * np.concatenate([[0.0], move.times])
            for joint in own if not why else ():
                k, column = NAMES.index(joint), move.positions[:, move.joints.index(joint)]
                # Without points it holds.
                self.ways[k] = times, np.concatenate([[self.at[k]], column])
                self.begun.append(move.stamp)
        self.report()

    def report(self) -> None:
        """Publish the status of all nodes with joints."""
        for name, log in self.logs.items():
            status = log.status()
            hear = partial(self.loop.receive, name)
            self.post('diagnostics', partial(self.take, hear, status))

    def request(self, word: str) -> bool:
        """Send a request of a user; return whether it is executed."""
        success, _, move = self.loop.request(word, self.now)
        self.follow(move)
        return success

    def aim(self, point: tuple[float, float, float] = TARGET, frame: str = '') -> str:
        """Send a target; return the reason of a rejection."""
        before = self.loop.events.rejected
        self.follow(self.loop.target(0, frame, point, self.now))
        return self.loop.events.last_rejection if self.loop.events.rejected > before else ''

    def steer(self, ticks: int = 6000) -> None:
        """Send a target, and run until the loop has finished."""
        self.tick(20)
        assert self.aim() == ''
        for _ in range(ticks):
            self.tick()
            if not self.loop.steers:
                return
        pytest.fail(f'steering does not end: {self.loop.phase}')

    @property
    def miss(self) -> float:
        """Distance of the tip from the target [m]."""
        return float(np.hypot(*(self.needle.tip[[0, 2]] - np.array(TARGET)[[0, 2]])))


def inserted(continuous: bool, depth: float) -> Robot:
    """Return a robot during an insertion, at a depth [m]."""
    robot = Robot(CONTINUOUS if continuous else SETTINGS)
    robot.tick(20)
    assert robot.aim() == ''
    while robot.at[0] < depth:
        robot.tick()
        assert robot.loop.steers
    return robot
