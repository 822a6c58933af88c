# SPDX-License-Identifier: Apache-2.0
"""A steered insertion whose messages are lost, delayed or duplicated; without a graph."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st
from needle_controller import SteeringPrior
from needle_controller.steering.executive import SteeringExecutive
from needle_controller.steering.planning import CancelledError, Job, Progress, ThreadJob
from needle_ros.contract import INSERTION, JOINT_TRAJECTORY, Stamp, TARGET, TOPICS
from needle_ros.errors import JobError
from needle_ros.requests import Acknowledgement, PendingRequest, RequestLog, RequestStatus, Verdict
from needle_ros.status import SteeringPhase as Phase
from needle_ros.system_state import Mode, PAUSE, RESUME, STOP
import numpy as np
import pytest
from support.steered_robot import CONTINUOUS, NEEDLE, PERIOD, Robot, SECOND, SETTINGS, STEERING
from support.steered_robot import TARGET as POINT

#: Quick: a tenth of the readings and of the ticks.
QUICK = replace(SETTINGS, measurement_time=0.1, settle_time=0.02, step_length=0.015, speed=0.03,
                guide_speed=0.05, acceleration=0.5)  # fmt: skip
QUICK_CONTINUOUS = replace(CONTINUOUS, step_length=0.015, speed=0.02, guide_speed=0.05,
                           acceleration=0.5, measurement_time=0.1)  # fmt: skip

#: Approximate number of messages of an insertion by topic: sampled topics have many.
FEW = {'joint_trajectory': 40, 'diagnostics': 60, 'joint_states': 800, 'tip_deflection': 800}


class Relayed(Robot):
    """A robot with a relay that loses, delays or duplicates some of its messages."""

    def __init__(self, faults: dict[tuple[str, int], list[float]], **options: Any) -> None:
        # Four steps are too few to identify a skin.
        super().__init__(**{'prior': SteeringPrior(skin=0.0), **options})
        self.faults, self.counts = faults, Counter[str]()
        self.held: list[tuple[int, Callable[[], None]]] = []

    def post(self, topic: str, deliver: Callable[[], None]) -> None:
        """Deliver a message after each of its delays [s]: none of a lost message."""
        self.counts[topic] += 1
        for delay in self.faults.get((topic, self.counts[topic]), [0.0]):
            if delay:
                self.held.append((self.now + round(delay * SECOND), deliver))
            else:
                deliver()

    def tick(self, count: int = 1) -> None:
        for _ in range(count):
            super().tick()
            due = [deliver for at, deliver in self.held if at <= self.now]
            self.held = [one for one in self.held if one[0] > self.now]
            for deliver in due:
                deliver()

    def insert(self, seconds: float = 60.0) -> None:
        """Send a target, and run until the insertion ends and all messages are delivered."""
        self.tick(20)
        self.aim()
        for _ in range(round(seconds * SECOND / PERIOD)):
            self.tick()
            if not self.loop.steers:
                break
        else:
            pytest.fail(f'the insertion does not end: {self.loop.phase}')
        self.tick(round(3 * SECOND / PERIOD))


def check_end(robot: Relayed) -> None:
    """Check that the insertion has reached its target, or has stopped with a reason."""
    if robot.loop.phase is Phase.DONE:
        assert robot.at[0] == pytest.approx(POINT[1], abs=1e-9)
        # Four long steps: 0.5 mm without a fault; a guide at rest misses by 2 mm.
        assert robot.miss < 1e-3
        return
    assert robot.loop.phase is Phase.STOPPED
    assert robot.loop.fault
    before = robot.at
    robot.tick(20)
    assert np.abs(robot.at - before).max() < 1e-9


ONE_FAULT = st.tuples(
    st.sampled_from(['drop', 'delay', 'duplicate']),
    st.sampled_from(sorted(FEW)),
    st.floats(0.0, 1.0),
    st.floats(0.01, 1.0),
)


@pytest.mark.requirement('S-129')
@settings(max_examples=60, deadline=None)
@given(fault=ONE_FAULT, continuous=st.booleans())
def test_single_lost_delayed_or_duplicated_message_is_tolerated(
    fault: tuple[str, str, float, float], continuous: bool
) -> None:
    """Each insertion reaches its target, for a fault of any message."""
    kind, topic, where, delay = fault
    number = 1 + int(where * FEW[topic])
    delays = {'drop': [], 'delay': [delay], 'duplicate': [0.0, delay]}[kind]
    robot = Relayed({(topic, number): delays}, own=QUICK_CONTINUOUS if continuous else QUICK)
    robot.insert()
    assert robot.loop.phase is Phase.DONE, robot.loop.fault
    check_end(robot)


@pytest.mark.requirement('S-129')
@pytest.mark.parametrize('sign', [1.0, -1.0])
@pytest.mark.parametrize('number', range(1, 9))
def test_lost_motion_is_repeated_if_the_robot_rests_beside_its_goal(
    number: int, sign: float
) -> None:
    """Within the tolerances, in either direction: this is not the begin of the next motion."""
    robot = Relayed({('joint_trajectory', number): []}, own=QUICK)
    tolerances = np.array([QUICK.depth_tolerance, QUICK.guide_tolerance, QUICK.guide_tolerance])
    # In the tissue, so that a repeated motion does not begin in front of it.
    robot.says = lambda at: at + 0.7 * sign * tolerances * (at[0] > 1e-3)
    robot.insert()
    assert robot.loop.phase is Phase.DONE, robot.loop.fault


@settings(max_examples=40, deadline=None)
@given(
    faults=st.lists(
        st.tuples(
            st.sampled_from(sorted(FEW)),
            st.floats(0.0, 1.0),
            st.lists(st.just(0.0) | st.floats(0.01, 1.0), max_size=2),
        ),
        max_size=8,
    ),
    continuous=st.booleans(),
)
def test_many_message_faults_end_at_the_target_or_in_a_stop(
    faults: list[tuple[str, float, list[float]]], continuous: bool
) -> None:
    """No insertion hangs, and nothing moves after a stop."""
    chosen = {(topic, 1 + int(where * FEW[topic])): delays for topic, where, delays in faults}
    robot = Relayed(chosen, own=QUICK_CONTINUOUS if continuous else QUICK)
    robot.insert()
    check_end(robot)


@pytest.mark.requirement('S-126')
@pytest.mark.parametrize('continuous', [False, True])
@pytest.mark.parametrize(
    ('silent', 'line'),
    [('controller', 'no answer of controller'), ('plant', 'no answer of plant')],
)
def test_unresponsive_node_is_named_within_five_seconds(
    continuous: bool, silent: str, line: str
) -> None:
    """All motions to it are lost."""
    robot = Relayed({}, own=QUICK_CONTINUOUS if continuous else QUICK)
    execute = robot.execute

    def deaf(name: str, log: RequestLog, move: Any) -> None:
        if name != silent:
            execute(name, log, move)

    setattr(robot, 'execute', deaf)  # noqa: B010
    # A continuous guide that does not follow is detected at the next depth.
    robot.tick(150)
    begun = robot.seconds
    robot.aim()
    while robot.loop.steers:
        robot.tick()
        assert robot.seconds < begun + 20.0
    if continuous and silent == 'plant':
        assert 'the guide is at' in robot.loop.fault
    else:
        assert line in robot.loop.fault
        assert robot.seconds - begun < 5.0 + (silent == 'plant')


@pytest.mark.requirement('S-128')
@pytest.mark.parametrize('continuous', [False, True])
def test_rejected_motion_stops_the_insertion_with_its_reason(continuous: bool) -> None:
    robot = Relayed({}, own=QUICK_CONTINUOUS if continuous else QUICK)
    robot.rejects = lambda name, _move: (
        'speed must be within 0.001 m/s' if name == 'controller' else ''
    )
    robot.insert()
    assert robot.loop.fault == 'controller rejected the motion: speed must be within 0.001 m/s'
    assert robot.at[0] == 0.0


@pytest.mark.requirement('S-008')
@pytest.mark.parametrize('continuous', [False, True])
@pytest.mark.parametrize('depth', [0.004, 0.012, 0.021])
def test_pause_by_the_user_may_last(continuous: bool, depth: float) -> None:
    """Needle and guide rest for a minute; the insertion then continues to its target."""
    robot = Relayed({}, own=QUICK_CONTINUOUS if continuous else QUICK)
    robot.tick(20)
    robot.aim()
    while robot.at[0] < depth:
        robot.tick()
    before = robot.at.copy()
    assert robot.request(PAUSE)
    robot.tick(6000)
    # Braking from the highest speed within 0.2 s, and a period.
    assert before[0] <= robot.at[0] <= before[0] + (0.1 + 0.01) * QUICK.speed
    assert np.abs(robot.at - robot.tracked[-5900]).max() < 1e-9
    assert robot.loop.steers
    assert robot.loop.diagnose(robot.now)[2].system is Mode.PAUSED
    assert robot.request(RESUME)
    while robot.loop.steers:
        robot.tick()
    assert robot.loop.phase is Phase.DONE


def test_lost_stop_is_repeated_and_supersedes_the_motion() -> None:
    """The stop is lost once, and the motion before it is received again after it."""
    robot = Relayed({}, own=SETTINGS)
    robot.tick(20)
    robot.aim()
    while robot.loop.phase is not Phase.INSERTING or robot.at[0] < 0.012:
        robot.tick()
    number = robot.counts['joint_trajectory']
    robot.faults = {('joint_trajectory', number + 1): [], ('joint_trajectory', number + 2): []}
    depth = robot.at[0]
    robot.request(STOP)
    robot.tick(300)
    # Half a second passes until the stop is repeated, at 19 mm/s at most.
    assert robot.at[0] < depth + 0.5 * 1.9 * SETTINGS.speed + 3e-3
    assert robot.loop.fault == 'requested by a user'


# Planning.


class Manual(Job[Any]):
    """A job that is ended by the test."""

    made: list[Manual]

    def _start(self) -> None:
        self.fraction = 0.25
        Manual.made.append(self)

    def result(self) -> Any:
        return self._work(lambda _done, _parts: None)


class Planning(Robot):
    """A robot whose loop computes its plans by `Manual`."""

    def __init__(self) -> None:
        super().__init__()
        Manual.made = []
        self.loop = SteeringExecutive(
            NEEDLE, STEERING, SteeringPrior(), SETTINGS, lambda: self.seconds, Manual
        )
        self.tick(20)

    def verdict(self, stamp: int) -> tuple[str, str]:
        answer = self.loop.requests.status().answer_to('target', stamp)
        return answer.verdict.value, answer.reason

    def aim_at(self, point: tuple[float, float, float] = POINT) -> int:
        self.tick()
        self.follow(self.loop.target(self.now, '', point, self.now))
        return self.now


def test_messages_are_processed_during_planning() -> None:
    robot = Planning()
    stamp = robot.aim_at()
    assert robot.loop.busy
    assert robot.verdict(stamp) == ('received', '')
    robot.tick(2000)
    assert robot.loop.busy
    assert robot.loop.diagnose(robot.now)[2].planned_fraction == 0.25
    Manual.made[0].done = True
    robot.tick()
    assert not robot.loop.busy
    assert robot.loop.phase is Phase.GUIDING
    assert robot.verdict(stamp) == ('accepted', '')


def test_stop_cancels_planning() -> None:
    robot = Planning()
    stamp = robot.aim_at()
    assert robot.request(STOP)
    assert Manual.made[0].cancelled
    assert robot.loop.phase is Phase.IDLE
    assert robot.verdict(stamp) == ('rejected', 'stopped: requested by a user')
    # A target sent before the stop and received after it is not executed.
    assert robot.loop.target(stamp - 1, '', POINT, robot.now) is None
    assert robot.verdict(stamp - 1)[0] == 'superseded'
    assert not robot.loop.busy


def test_new_target_cancels_planning() -> None:
    robot = Planning()
    first, second = robot.aim_at(), robot.aim_at((0.0, 0.05, 0.0))
    assert [one.cancelled for one in Manual.made] == [True, False]
    assert robot.verdict(first) == ('superseded', 'a newer target was received')
    Manual.made[1].done = True
    robot.tick()
    assert robot.verdict(second) == ('accepted', '')
    assert robot.loop.depth == pytest.approx(0.05)


def test_target_out_of_reach_is_rejected_after_planning() -> None:
    robot = Planning()
    stamp = robot.aim_at((0.05, 0.06, 0.0))
    Manual.made[0].done = True
    robot.tick()
    verdict, reason = robot.verdict(stamp)
    assert verdict == 'rejected'
    assert 'out of reach' in reason
    assert robot.loop.phase is Phase.IDLE


def test_needle_moved_during_planning_is_not_inserted() -> None:
    robot = Planning()
    stamp = robot.aim_at()
    robot.ways[0] = robot.now + np.array([0.0, 1e9]), np.array([0.0, 4e-3])
    robot.tick(120)
    Manual.made[0].done = True
    robot.tick()
    reason = 'insertion has moved during planning'
    assert robot.verdict(stamp) == ('rejected', reason)


@pytest.mark.parametrize('kind', [Job, ThreadJob])
def test_a_job_returns_its_result_or_raises_its_error(kind: Any) -> None:
    def wait(job: Job[Any]) -> Job[Any]:
        while not job.done:
            pass
        return job

    assert wait(kind(lambda _progress: 42)).result() == 42

    def fails(_progress: Progress) -> int:
        raise JobError('it cannot be')

    with pytest.raises(JobError, match='it cannot be'):
        wait(kind(fails)).result()


def test_a_thread_ends_when_its_job_is_cancelled() -> None:
    def work(progress: Progress) -> int:
        while True:
            progress(1, 2)

    job = ThreadJob(work)
    with pytest.raises(JobError, match='the job is not done'):
        job.result()
    job.cancel()
    while not job.done:
        pass
    with pytest.raises(CancelledError):
        job.result()


# Acknowledgements.

NOW = 100 * SECOND


def log() -> RequestLog:
    return RequestLog({JOINT_TRAJECTORY: ('insertion', 'guide_x')}, ('', 'needle_entry'))


def accept(own: RequestLog, stamp: int, *joints: str) -> Acknowledgement | None:
    """Send a trajectory; return the answer if it is not executed."""
    answer = own.check(JOINT_TRAJECTORY, stamp, NOW, '', joints)
    if answer is None:
        own.answer(JOINT_TRAJECTORY, stamp, Verdict.ACCEPTED, joints=joints)
    return answer


@pytest.mark.requirement('S-051')
def test_duplicate_request_is_answered_again_and_not_executed() -> None:
    own = log()
    assert accept(own, NOW - 5, 'insertion') is None
    again = accept(own, NOW - 5, 'insertion')
    assert again is not None
    assert again.verdict is Verdict.ACCEPTED
    # Requests without a stamp cannot be distinguished.
    assert accept(own, 0, 'insertion') is None
    assert accept(own, 0, 'insertion') is None


@pytest.mark.requirement('S-052')
def test_an_older_request_for_the_same_joints_is_superseded() -> None:
    own = log()
    assert accept(own, NOW - 3, 'insertion') is None
    late = accept(own, NOW - 4, 'insertion', 'guide_x')
    assert late is not None
    assert late.verdict is Verdict.SUPERSEDED
    assert late.refused
    assert accept(own, NOW - 4, 'guide_x') == late
    assert accept(own, NOW - 5, 'guide_x') is None
    own.supersede(NOW)
    assert accept(own, NOW - 1, 'guide_x') is not None
    assert accept(own, NOW, 'guide_x') is None
    # A clock that is set back makes no request an old one.
    back = NOW - 60 * SECOND
    assert own.check(JOINT_TRAJECTORY, back, back, '', ['guide_x']) is None


@pytest.mark.requirement('S-047')
@pytest.mark.parametrize(
    ('age', 'frame', 'reason'),
    [
        (5.1, '', 'joint_trajectory is stale: its stamp is 5.100 s old'),
        (-5.1, '', 'joint_trajectory is stale: its stamp is 5.100 s ahead'),
        (0.0, 'world', "joint_trajectory must be in frame '' or 'needle_entry', got 'world'"),
    ],
)
def test_stale_request_is_rejected(age: float, frame: str, reason: str) -> None:
    own = log()
    stamp = NOW - round(age * SECOND)
    answer = own.check(JOINT_TRAJECTORY, stamp, NOW, frame, ['insertion'])
    assert answer == Acknowledgement('joint_trajectory', stamp, Verdict.REJECTED, reason)
    # Four seconds: three repetitions and a delay.
    assert accept(own, NOW - 4 * SECOND, 'insertion') is None


@given(
    answers=st.lists(
        st.tuples(
            st.integers(1, 10**19 - 1), st.sampled_from(Verdict), st.text('ab: ,/=', max_size=20)
        ),
        max_size=20,
        unique_by=lambda one: one[0],
    )
)
def test_status_values_round_trip(answers: list[tuple[int, Verdict, str]]) -> None:
    """Its latest answers, for any reasons; other values are ignored."""
    own = log()
    for stamp, verdict, reason in answers:
        own.answer(JOINT_TRAJECTORY, stamp, verdict, reason)
    status = own.status()
    values = {'law': 'pid', 'request': 'x', 'request y z': 'accepted'}
    values |= {key: str(value) for key, value in status.to_values().items()}
    assert RequestStatus.from_values(values) == status
    assert len(status.answers) == min(len(answers), 8)
    for stamp, verdict, _ in answers[-8:]:
        assert status.answer_to('joint_trajectory', stamp).verdict is verdict


@pytest.mark.requirement('S-273')
@pytest.mark.parametrize('digits', [19, 20, 4300, 4301, 10**5])
def test_answers_with_any_number_of_digits_are_read(digits: int) -> None:
    """Python raises an error from 4301 digits on; a stamp of 64 bits has at most 19."""
    status = RequestStatus.from_values({f'request target {"9" * digits}': 'accepted'})
    assert len(status.answers) == (digits <= 19)


def test_status_rate_is_limited_for_many_requests() -> None:
    now = [0.0]
    own = RequestLog({JOINT_TRAJECTORY: ('insertion',)}, steady=lambda: now[0])
    assert not own.due()
    published = 0
    for k in range(1000):
        now[0] = 1e-3 * k
        own.answer(JOINT_TRAJECTORY, k + 1, Verdict.ACCEPTED)
        published += own.due()
    # Each 50 ms of a second.
    assert 19 <= published <= 21
    now[0] += 0.1
    assert own.due()
    assert not own.due()


def test_a_request_is_repeated_until_it_is_answered() -> None:
    now = [0.0]
    pending = PendingRequest(TARGET, 7, 'steering', steady=lambda: now[0])
    times = []
    while not pending.done:
        now[0] += 0.01
        if pending.repeat():
            times.append(now[0])
    assert times == pytest.approx([1.0, 2.0, 3.0], abs=0.02)
    assert pending.outcome == (False, 'steering: no answer to target within 6 s')

    for verdict, line in (
        (Verdict.ACCEPTED, (True, 'node: target accepted')),
        (Verdict.REJECTED, (False, 'node: target rejected: too deep')),
        (Verdict.SUPERSEDED, (False, 'node: target superseded: too deep')),
    ):
        pending = PendingRequest(TARGET, 7, 'steering', steady=lambda: now[0])
        own = RequestLog({TARGET: ()})
        own.answer(TARGET, 7, Verdict.RECEIVED)
        pending.take_status('node', own.status())
        now[0] += 60.0
        # A plan takes its time.
        assert not pending.done
        assert not pending.repeat()
        own.answer(TARGET, 7, verdict, 'too deep' if verdict is not Verdict.ACCEPTED else '')
        pending.take_status('node', own.status())
        assert pending.done
        assert pending.outcome == line


def test_contract_defines_the_topics_of_requests() -> None:
    """A log takes requests only; the topics of requests and samples are these."""
    found = {kind: {one.name for one in TOPICS if one.stamp is kind} for kind in Stamp}
    assert found[Stamp.REQUEST] == {'target', 'joint_trajectory'}
    assert {'joint_states', 'tip_deflection', 'wrench_command'} <= found[Stamp.SAMPLE]
    (sample,) = (one for one in TOPICS if one.name == 'joint_states')
    with pytest.raises(ValueError, match='joint_states is not a request'):
        RequestLog({sample: (INSERTION,)})
