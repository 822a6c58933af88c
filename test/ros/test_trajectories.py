# SPDX-License-Identifier: Apache-2.0
"""Start time of a trajectory, as in joint_trajectory_controller, and requests that wait for it."""

from __future__ import annotations

from collections.abc import Collection

from needle_ros.contract import JOINT_TRAJECTORY, REQUEST_AGE
from needle_ros.errors import ParameterError
from needle_ros.requests import (
    Acknowledgement,
    LateTrajectoryError,
    RequestLog,
    Verdict,
    WaitingRequests,
)
from needle_ros.trajectories import (
    ErrorCode,
    FollowedJoint,
    JointPath,
    JointReference,
    MOST_POINTS,
    outcome_of,
    Tolerance,
    TrajectoryGoal,
)
import pytest

SECOND = 1_000_000_000
PATH = JointPath(['insertion'], [0.5, 1.0, 2.0], [[0.1], [0.2], [0.3]], [], [[], [], [1.0]])


@pytest.mark.parametrize(
    ('elapsed', 'times', 'positions'),
    [
        (0.0, [0.5, 1.0, 2.0], [[0.1], [0.2], [0.3]]),
        (0.25, [0.25, 0.75, 1.75], [[0.1], [0.2], [0.3]]),
        # A point is reached at its time: it is in the past from then on.
        (0.5, [0.5, 1.5], [[0.2], [0.3]]),
        (1.75, [0.25], [[0.3]]),
    ],
)
def test_path_joins_at_its_first_point_ahead(
    elapsed: float, times: list[float], positions: list[list[float]]
) -> None:
    rest = PATH.after(elapsed)
    # The binary fractions are exact.
    assert (rest.times, rest.positions, rest.velocities) == (times, positions, [])
    assert rest.efforts[-1] == [1.0]


@pytest.mark.parametrize('elapsed', [2.0, 3.0])
def test_path_in_the_past_is_late(elapsed: float) -> None:
    with pytest.raises(LateTrajectoryError, match=rf'in the past, the last by {elapsed - 2.0}'):
        PATH.after(elapsed)
    # A single point at the start is reached on arrival.
    assert JointPath(['insertion'], [0.0], [[0.1]]).after(0.0).times == [0.0]


def test_path_without_points_stops_at_any_time() -> None:
    stop = JointPath([], [], [])
    assert stop.stops
    assert stop.after(3.0) is stop


def test_invalid_times_are_rejected_before_the_start_is_compared() -> None:
    with pytest.raises(ParameterError, match='increasing'):
        PATH._replace(times=[3.0, 2.0, 1.0]).after(2.0)
    many = [float(k) for k in range(MOST_POINTS + 1)]
    with pytest.raises(ParameterError, match='at most'):
        JointPath(['insertion'], many, []).check(0.0)


def test_requests_wait_for_their_stamp_and_replace_the_same_joints() -> None:
    """The first sample after the stamp executes a request; the answers are recorded."""
    log = RequestLog({JOINT_TRAJECTORY: ('insertion', 'guide_x', 'roll')})
    waiting, topic = WaitingRequests(log), JOINT_TRAJECTORY

    def act(_object: object, _elapsed: float) -> None:
        raise AssertionError

    def verdict(stamp: int) -> Verdict:
        answer = log.status().answer_to(topic.name, stamp)
        assert answer is not None
        return answer.verdict

    for stamp, joints in ((10, ('insertion', 'guide_x')), (20, ('roll',)), (30, ('guide_x',))):
        waiting.add(topic, stamp, joints, act)
    assert verdict(10) is Verdict.SUPERSEDED
    assert waiting.take(20) is None
    assert waiting.take(21).stamp == 20
    assert waiting.take(21) is None
    waiting.end('stopped')
    assert verdict(30) is Verdict.REJECTED
    # The clock was set back below the valid age of a request.
    far = round((REQUEST_AGE + 2.0) * SECOND)
    waiting.add(topic, far, ('roll',), act)
    assert waiting.take(SECOND) is None
    assert verdict(far) is Verdict.REJECTED
    assert waiting.take(far + 1) is None


def test_late_request_may_be_sent_again() -> None:
    """Its verdict differs from other rejections, also after transport."""
    log = RequestLog({JOINT_TRAJECTORY: ('insertion',)})
    log.reject(JOINT_TRAJECTORY, 5, LateTrajectoryError('all points are in the past'))
    log.reject(JOINT_TRAJECTORY, 6, ParameterError('invalid'))
    status = type(log.status()).from_values(log.status().to_values())
    late, other = (status.answer_to('joint_trajectory', stamp) for stamp in (5, 6))
    assert (late.verdict, late.refused) == (Verdict.LATE, True)
    assert other.verdict is Verdict.REJECTED


def test_watched_requests_report_each_end_once() -> None:
    """With the joints that something else moves; other requests continue."""
    log, topic = RequestLog({JOINT_TRAJECTORY: ('insertion', 'guide_x', 'roll')}), JOINT_TRAJECTORY
    told: list[tuple[int, Verdict, set[str]]] = []

    def tell(one: Acknowledgement, moved: Collection[str]) -> None:
        told.append((one.stamp, one.verdict, {*moved}))

    def watch(stamp: int, *joints: str) -> int:
        return log.watch(topic, stamp, joints, tell)

    first = watch(10, 'insertion', 'guide_x')
    log.answer(topic, first, Verdict.ACCEPTED, joints=('insertion', 'guide_x'))
    # The stamp identifies a request: the next is 1 ns later.
    second = watch(10, 'roll')
    assert (first, second) == (10, 11)
    log.answer(topic, second, Verdict.ACCEPTED, joints=('roll',))
    assert told == [(10, Verdict.ACCEPTED, set()), (11, Verdict.ACCEPTED, set())]
    told.clear()
    log.answer(topic, 20, Verdict.ACCEPTED, joints=('guide_x',))
    assert told == [(10, Verdict.SUPERSEDED, {'guide_x'})]
    log.end('stopped')
    assert told[1:] == [(11, Verdict.SUPERSEDED, set())]
    rejected = watch(30, 'roll')
    log.reject(topic, rejected, LateTrajectoryError('past'))
    log.end('stopped')
    assert told[2:] == [(30, Verdict.LATE, set())]
    silent = watch(40, 'roll')
    log.unwatch(topic, silent)
    log.answer(topic, silent, Verdict.REJECTED)
    assert len(told) == 3


@pytest.mark.parametrize('arrived', [False, True])
def test_goal_ends_at_its_time_limit(arrived: bool) -> None:
    """The limit counts from the last point, also for a reference that waits."""
    near = {'insertion': Tolerance(1e-3, 0.0)}
    goal = TrajectoryGoal(PATH, {}, near, SECOND // 2, stamp=SECOND)
    joint = FollowedJoint(JointReference(0.3, 0.0, 0.0, arrived), (0.2, 0.0, 0.0))
    end = SECOND + 2 * SECOND + SECOND // 2
    assert goal.check(end, {'insertion': joint}) is None
    outcome = goal.check(end + 1, {'insertion': joint})
    assert outcome is not None
    assert outcome.code is ErrorCode.GOAL_TOLERANCE_VIOLATED
    assert outcome.reason.endswith('0.500 s after the last point')
    assert ('has not arrived' in outcome.reason) is not arrived


@pytest.mark.parametrize('verdict', [Verdict.REJECTED, Verdict.SUPERSEDED])
def test_only_a_rejected_goal_has_an_old_stamp(verdict: Verdict) -> None:
    """A goal that is superseded after a long motion has begun in time."""
    answer = Acknowledgement('joint_trajectory', SECOND, verdict, 'reason')
    now = SECOND + round((REQUEST_AGE + 1.0) * SECOND)
    old = outcome_of(answer, now).code is ErrorCode.OLD_HEADER_TIMESTAMP
    assert old is (verdict is Verdict.REJECTED)


def test_report_of_an_end_may_end_other_requests() -> None:
    log, told = RequestLog({JOINT_TRAJECTORY: ['insertion']}), []

    def end_all(answer: Acknowledgement, _moved: Collection[str]) -> None:
        told.append(answer.stamp)
        log.end('all')

    for stamp in (1, 2):
        log.watch(JOINT_TRAJECTORY, stamp, ['insertion'], end_all)
    log.end('the first')
    assert sorted(told) == [1, 2]


def test_watched_requests_have_unique_stamps() -> None:
    log = RequestLog({JOINT_TRAJECTORY: ['insertion']})
    stamps = [log.watch(JOINT_TRAJECTORY, 7, ['insertion'], lambda *_: None) for _ in range(3)]
    assert len({*stamps}) == 3
