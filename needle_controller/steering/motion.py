# SPDX-License-Identifier: Apache-2.0
"""Joint motions of needle and guide from rest to rest, and their monitor."""

from collections import deque
from collections.abc import Sequence
from math import ceil, sqrt
from typing import Final, NamedTuple

from needle_controller.reference.quintic import PEAK_ACCELERATION, PEAK_SPEED, Quintic
from needle_controller.reference.setpoint import Setpoint
from needle_controller.steering.settings import ExecutiveSettings
from needle_dynamics.arrays import BoolArray, FloatArray
from needle_ros.contract import JOINT_TRAJECTORY
from needle_ros.requests import Acknowledgement, REPEAT_AFTER, REPEATS, RequestStatus, Verdict
from needle_ros.timing import NANOSECONDS
import numpy as np

#: `PEAK_ACCELERATION` of a motion in points: the cubics between them add 5 %.
_STEEPEST: Final = 1.05 * PEAK_ACCELERATION

_POINTS: Final = 20, 1000  #: Fewest and most points of a motion.
_INTERVAL: Final = 0.05  #: Time from one point of a motion to the next within these bounds [s].

#: Displacement of a joint that follows, unless its tolerance is less [m, rad].
_MOVED: Final = 1e-4
_REACTION: Final = 0.3  #: Time for a robot to react to a motion [s].
_STREAMED: Final = 64  #: Number of kept stamps of a stream of motions: more than in a second.


class JointMotion(NamedTuple):
    """Joint motion of needle and guide, for a robot or a controller."""

    joints: tuple[str, ...]  #: names of the joints
    times: FloatArray  #: times from the start [s], shape (n,)
    positions: FloatArray  #: positions [m, rad], shape (n, joints)
    velocities: FloatArray  #: velocities [m/s, rad/s], shape (n, joints)
    stamp: int = 0  #: time at which it is sent [ns], which identifies it; 0 until it is sent


def smooth(
    joints: tuple[str, ...], begin: FloatArray, end: FloatArray, duration: float
) -> JointMotion:
    """Return a minimum-jerk motion from rest to rest [m, rad] in a duration [s]."""
    fewest, most = _POINTS
    count = ceil(min(max(duration / _INTERVAL, fewest), most))
    times = duration * (np.arange(1, count + 1) / count)
    unit, shift = Quintic(Setpoint(0.0), Setpoint(1.0), duration), end - begin
    parts, rates, _ = np.array([unit.at(time) for time in times.tolist()]).T
    # The last point is exact.
    positions = np.vstack([begin + np.outer(parts[:-1], shift), end])
    return JointMotion(joints, times, positions, np.outer(rates, shift))


def duration_of(shift: FloatArray, settings: ExecutiveSettings) -> float:
    """Return the shortest duration [s] of a smooth motion of the joints by a shift [m, rad]."""
    along, across = float(abs(shift[0])), float(np.hypot(shift[1], shift[2]))
    return max(
        PEAK_SPEED * along / settings.speed,
        PEAK_SPEED * across / settings.guide_speed,
        PEAK_SPEED * float(np.abs(shift[3:]).sum()) / settings.roll_speed,
        sqrt(_STEEPEST * max(along, across) / settings.acceleration),
    )


class MotionRefusal(NamedTuple):
    """Answer of a node that does not execute the last motion."""

    node: str
    verdict: Verdict
    reason: str
    joints: tuple[str, ...]  #: joints that the node moves

    def __str__(self) -> str:
        return f'{self.node} {self.verdict.value} the motion: {self.reason}'


class MotionMonitor:
    """
    Compare the last motion with the positions of the ``joints`` [m, rad], and with its answers.

    ``tolerances`` of the positions, and all positions, have shape (joints,).
    """

    def __init__(self, joints: Sequence[str], tolerances: FloatArray) -> None:
        self._joints, self._tolerances = list(joints), tolerances
        self._moved = np.minimum(tolerances, _MOVED)
        self._receivers: dict[str, RequestStatus] = {}  #: nodes that take trajectories, by name
        #: Stamps of the motion with its repetitions, and of the motions of a stream [ns].
        self._stamps: list[int] = []
        self._streamed: deque[int] = deque(maxlen=_STREAMED)
        #: Node and stamp of the refusals, which are repeated in each status.
        self._refused: set[tuple[str, int]] = set()
        self.forget()

    def forget(self) -> None:
        """Discard the motion: nothing is monitored."""
        self._stamps.clear()
        self._streamed.clear()
        self._refused.clear()
        self._begin = self._goal = np.zeros(len(self._joints))
        #: Whether each joint still has to follow the motion, shape (joints,).
        self.pending: BoolArray = np.zeros(len(self._joints), dtype=np.bool_)
        self._arrives = False
        self._overdue = np.zeros(len(self._joints), dtype=np.int64)  #: times of late joints [ns]

    def begin(
        self, move: JointMotion, at: FloatArray, *, again: bool = False, arrives: bool = False
    ) -> None:
        """
        Start to monitor a motion from measured positions [m, rad].

        ``again`` marks a repetition of the motion. With ``arrives`` the joints must arrive in
        time, where a part of the motion may have been followed already; otherwise they must begin
        to move in time.
        """
        if not again:
            self._stamps.clear()
        self._stamps.append(move.stamp)
        columns = [self._joints.index(name) for name in move.joints]
        self._begin, self._goal = at.copy(), at.copy()
        self._goal[columns] = move.positions[-1]
        distance, moved = np.abs(self._goal - self._begin), self._moved
        self.pending = distance > (self._tolerances if arrives else moved)
        self._arrives = arrives
        for k in np.flatnonzero(self.pending):
            shift = move.positions[:, columns.index(int(k))] - at[k]
            shift = shift * np.sign(self._goal[k] - at[k])
            point = -1 if arrives else int(np.argmax(shift >= min(moved[k], distance[k])))
            wait = max(REPEAT_AFTER, float(move.times[point]) + _REACTION)
            self._overdue[k] = move.stamp + round(wait * NANOSECONDS)

    def stream(self, move: JointMotion) -> None:
        """Add a motion that is soon replaced by the next: only its answers are monitored."""
        self._streamed.append(move.stamp)

    def is_late(self, at: FloatArray, stamp: int) -> bool:
        """Return whether the motion is overdue at positions [m, rad] with their stamp [ns]."""
        if not self.pending.any():
            return False
        if self._arrives:
            self.pending &= np.abs(at - self._goal) > self._tolerances
        else:
            gone = (at - self._begin) * np.sign(self._goal - self._begin)
            self.pending &= gone < self._moved
        return bool((self.pending & (stamp >= self._overdue)).any())

    @property
    def exhausted(self) -> bool:
        """Whether the largest number of repetitions is reached."""
        return len(self._stamps) > REPEATS

    def process(self, node: str, status: RequestStatus) -> MotionRefusal | None:
        """Process the status of a node; return once that it does not execute the motion."""
        joints = status.takes.get(JOINT_TRAJECTORY.name)
        if joints is None:
            return None
        self._receivers[node] = status
        for one in status.answers:
            if one.topic != JOINT_TRAJECTORY.name or (node, one.stamp) in self._refused:
                continue
            if self._refuses(one):
                self._refused.add((node, one.stamp))
                return MotionRefusal(node, one.verdict, one.reason, joints)
        return None

    def _refuses(self, answer: Acknowledgement) -> bool:
        if answer.verdict is Verdict.REJECTED:
            return answer.stamp in self._stamps or answer.stamp in self._streamed
        # The motions before the newest are superseded by it.
        return answer.verdict is Verdict.SUPERSEDED and answer.stamp in self._stamps[-1:]

    @property
    def sent(self) -> bool:
        """Whether the motion was sent; joints at their goal need none."""
        return bool(self._stamps)

    def failure(self) -> str:
        """Describe how often the motion was sent, and which nodes answered."""
        topic, count = JOINT_TRAJECTORY.name, len(self._stamps)
        late = np.flatnonzero(self.pending) if self.pending.any() else range(len(self._joints))
        names = {self._joints[k] for k in late}
        answers = {
            node: [status.answer_to(topic, stamp) for stamp in self._stamps]
            for node, status in self._receivers.items()
            if names & {*status.takes[topic]}
        }
        silent = [node for node, found in answers.items() if not any(found)]
        last = [found[-1] for found in answers.values()]
        if not answers:
            why = f'no node reports that it takes {topic}'
        elif silent:
            why = f'no answer of {" and ".join(silent)}'
        elif any(answer and answer.verdict is Verdict.LATE for answer in last):
            why = 'it arrived too late'
        else:
            why = f'{" and ".join(answers)} accepted it'
        return f'{topic} sent {count} time{"s" * (count > 1)}, {why}'
