# SPDX-License-Identifier: Apache-2.0
"""Stop, pause and retraction of a steered insertion by a user; without a graph."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from needle_controller.steering.motion import JointMotion
from needle_ros.contract import JOINT_TRAJECTORY
from needle_ros.event_log import Severity
from needle_ros.requests import RequestLog, Verdict
from needle_ros.status import SteeringPhase as Phase
from needle_ros.system_state import Authority, CLEAR_STOP, PAUSE, RESUME, RETRACT, STOP
import numpy as np
from numpy.testing import assert_allclose
import pytest
from support.steered_robot import inserted, Robot, SETTINGS, TARGET

#: Largest displacement after a request [m]: braking from 10 mm/s within 0.2 s, and a period.
BRAKED = 1.1e-3

STRATEGIES = pytest.mark.parametrize('continuous', [False, True])


def own_withdrawal(robot: Robot, depth: float) -> None:
    """Withdraw the needle by the controller, to a depth [m] at 10 mm/s, other than asked."""
    execute = robot.execute

    def withdraw(name: str, log: RequestLog, move: JointMotion) -> None:
        retracts = robot.loop.phase is Phase.RETRACTING
        if name == 'plant' or not retracts:
            execute(name, log, move)
        elif 'insertion' in move.joints:
            why = 'the needle is retracted'
            log.answer(JOINT_TRAJECTORY, move.stamp, Verdict.SUPERSEDED, why)
            robot.report()

    begin = float(robot.at[0])
    times = robot.now + np.array([0.0, max(1e11 * (begin - depth), 1.0)])
    robot.ways[0] = times, np.array([begin, min(depth, begin)])
    setattr(robot, 'execute', withdraw)  # noqa: B010


def withdrawals(robot: Robot, lost: int) -> dict[int, JointMotion]:
    """Collect the motions of a retraction by stamp; a number of the first are lost."""
    moves: dict[int, JointMotion] = {}
    execute = robot.execute

    def keep(name: str, log: RequestLog, move: JointMotion) -> None:
        # The brake before is not of the retraction.
        if move.positions[-1][0] <= 0.01:
            moves[move.stamp] = move
        if move.stamp not in [*moves][:lost]:
            execute(name, log, move)

    setattr(robot, 'execute', keep)  # noqa: B010
    return moves


def assert_rests(robot: Robot) -> None:
    """Check that the retraction has ended without a failure, and moves nothing any more."""
    assert robot.loop.phase is Phase.IDLE
    assert robot.loop.diagnose(robot.now)[0] is Severity.INFO
    before = robot.at.copy()
    robot.tick(200)
    assert_allclose(robot.at, before, atol=1e-12)


def positions(robot: Robot, ticks: int) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    """Run, and return the positions of the joints, shape (ticks, 3)."""
    robot.tick(ticks)
    return np.array(robot.tracked[-ticks:])


@pytest.mark.requirement('S-009')
@STRATEGIES
@pytest.mark.parametrize('depth', [0.004, 0.021, 0.043])
def test_retraction_withdraws_needle_and_straightens_the_guide(
    continuous: bool, depth: float
) -> None:
    """The needle never advances beyond its braking distance; the guide moves toward zero."""
    robot = inserted(continuous, depth)
    begin = robot.at.copy()
    assert robot.request(RETRACT)
    path = positions(robot, 1500)
    end = min(SETTINGS.retract_depth, begin[0])
    assert path[:, 0].max() <= begin[0] + BRAKED
    assert path[-1] == pytest.approx([end, 0.0, 0.0], abs=SETTINGS.depth_tolerance)
    # The guide offset is in proportion to the remaining distance, with the lag of a command.
    largest = np.abs(begin[1:]).max()
    part = np.clip((path[:, 0] - end) / max(begin[0] - end, 1e-3), 0.0, 1.0)
    if begin[0] > end:
        assert_allclose(path[:, 1:], np.outer(part, begin[1:]), atol=0.15 * largest + 1e-4)
    assert robot.loop.phase is Phase.IDLE
    assert not robot.loop.fault.startswith('the')


@pytest.mark.requirement('S-013')
@STRATEGIES
def test_deviation_during_a_retraction_does_not_stop_it(continuous: bool) -> None:
    """The controller withdraws the needle by itself, other than the motions of the node."""
    robot = inserted(continuous, 0.03)
    begin = robot.at.copy()
    own_withdrawal(robot, 0.0)
    assert robot.request(RETRACT)
    path = positions(robot, 600)
    assert path[:, 0].max() <= begin[0] + 1e-9
    assert robot.loop.authority.reason == ''
    assert np.abs(path[-1, 1:]).max() <= SETTINGS.guide_tolerance
    assert_rests(robot)


@pytest.mark.requirement('S-268')
@STRATEGIES
@pytest.mark.parametrize('depth', [0.0, 0.01, 0.02, 0.03])
def test_retraction_ends_where_the_controller_ends_it(continuous: bool, depth: float) -> None:
    """The guide follows the measured depth; the retract depth of the node is 10 mm."""
    robot = inserted(continuous, 0.03)
    begin = robot.at.copy()
    own_withdrawal(robot, depth)
    assert robot.request(RETRACT)
    path = positions(robot, 800)
    assert path[-1] == pytest.approx([depth, 0.0, 0.0], abs=SETTINGS.depth_tolerance)
    assert_rests(robot)
    # While the needle is withdrawn, with the delay of a command and its answer.
    part = np.clip((path[:, 0] - 0.01) / (begin[0] - 0.01), 0.0, 1.0)
    far = np.abs(path[:, 1:] - np.outer(part, begin[1:]))[path[:, 0] > depth + 1e-6]
    assert far.size == 0 or far.max() <= 0.15 * np.abs(begin[1:]).max() + 1e-4


@pytest.mark.requirement('S-009', 'S-265')
@STRATEGIES
@pytest.mark.parametrize('lost', [1, 3])
def test_lost_retraction_is_repeated(continuous: bool, lost: int) -> None:
    """Each motion has all joints and ends at rest; needle and guide stay in proportion."""
    robot = inserted(continuous, 0.03)
    begin, moves = robot.at.copy(), withdrawals(robot, lost)
    assert robot.request(RETRACT)
    path = positions(robot, 1500)
    assert len(moves) == lost + 1
    for move in moves.values():
        assert move.joints == SETTINGS.joints
        assert not move.velocities[-1].any()
    assert path[-1] == pytest.approx([0.01, 0.0, 0.0], abs=SETTINGS.depth_tolerance)
    assert_rests(robot)
    path = path[path[:, 0] < begin[0]]
    part = (path[:, 0] - 0.01) / (path[0, 0] - 0.01)
    assert_allclose(path[:, 1:], np.outer(part, path[0, 1:]), atol=1e-9)


@pytest.mark.requirement('S-266')
@STRATEGIES
def test_retraction_that_does_not_begin_is_reported(continuous: bool) -> None:
    """Sent four times within five seconds, then one line that names the node."""
    robot = inserted(continuous, 0.03)
    moves = withdrawals(robot, 9)
    robot.loop.events.take()
    assert robot.request(RETRACT)
    robot.tick(500)
    assert len(moves) == 4
    errors = [line for severity, line in robot.loop.events.take() if severity is Severity.ERROR]
    (line,) = errors
    assert line.startswith('the retraction has failed: insertion is at 3')
    assert 'not at 10.000 mm' in line
    assert 'joint_trajectory sent 4 times, no answer of controller and plant' in line
    assert robot.loop.diagnose(robot.now)[:2] == (Severity.ERROR, line)
    assert robot.loop.authority.reason == ''
    # A user may request it again.
    del robot.execute
    assert robot.request(RETRACT)
    robot.tick(1500)
    assert_rests(robot)


@pytest.mark.requirement('S-266')
@STRATEGIES
@pytest.mark.parametrize('node', ['controller', 'plant'])
def test_rejected_retraction_is_reported_with_its_reason(continuous: bool, node: str) -> None:
    robot = inserted(continuous, 0.03)
    retracting = lambda: robot.loop.phase is Phase.RETRACTING  # noqa: E731
    robot.rejects = lambda name, _: 'partial goal' if name == node and retracting() else ''
    robot.loop.events.take()
    assert robot.request(RETRACT)
    robot.tick(300)
    errors = [line for severity, line in robot.loop.events.take() if severity is Severity.ERROR]
    assert errors == [f'the retraction has failed: {node} rejected the motion: partial goal']
    assert robot.loop.diagnose(robot.now)[:2] == (Severity.ERROR, errors[0])


@pytest.mark.requirement('S-266')
def test_retraction_that_does_not_arrive_is_reported() -> None:
    """The needle is blocked at 20 mm, or the guide at half of its offset."""
    for joint in (0, 2):
        robot = inserted(False, 0.03)
        least = 0.02 if joint == 0 else 0.5 * robot.at[joint]
        sign = np.sign(least)

        def moves(
            wanted: Any, joint: int = joint, least: float = least, sign: float = sign
        ) -> Any:
            wanted[joint] = sign * max(sign * wanted[joint], sign * least)
            return wanted

        robot.moves = moves
        assert robot.request(RETRACT)
        robot.tick(6000)
        name = SETTINGS.joints[joint]
        assert f'failed: {name} is at {1e3 * least:.3f}' in robot.loop.diagnose(robot.now)[1]


@pytest.mark.requirement('S-267')
def test_lost_joint_states_during_a_retraction_are_reported() -> None:
    """After 0.5 s; the motion under way is withdrawal only, and ends at rest."""
    robot = inserted(False, 0.04)
    assert robot.request(RETRACT)
    robot.tick(50)
    begin = robot.at.copy()
    robot.says = lambda _at: None
    path = positions(robot, 60)
    severity, line, _ = robot.loop.diagnose(robot.now)
    assert severity is Severity.ERROR
    assert line.startswith('the retraction has failed: no joint_states received within 0.5')
    assert robot.loop.authority.reason == ''
    path = np.vstack([path, positions(robot, 1000)])
    assert (np.diff(path[:, 0]) <= 1e-12).all()
    assert path[:, 0].max() <= begin[0]
    assert_allclose(path[-1], path[-2], atol=1e-12)


@pytest.mark.requirement('S-270')
@STRATEGIES
@pytest.mark.parametrize('early', [False, True])
def test_executive_that_starts_during_a_retraction_returns_the_guide(
    continuous: bool, early: bool
) -> None:
    """Before or after it gets the first positions."""
    robot = inserted(continuous, 0.03)
    begin = robot.at.copy()
    assert robot.request(RETRACT)
    robot.tick(100)
    state = robot.loop.authority.state
    robot.loop = Robot(robot.loop.settings).loop
    own_withdrawal(robot, 0.01)
    if not early:
        robot.tick(5)
    robot.loop.authority.receive(state)
    robot.follow(robot.loop.obey(robot.now))
    assert robot.loop.phase is Phase.RETRACTING
    path = positions(robot, 1500)
    assert path[:, 0].max() <= begin[0]
    assert path[-1] == pytest.approx([0.01, 0.0, 0.0], abs=SETTINGS.depth_tolerance)
    assert_rests(robot)


@pytest.mark.requirement('S-270')
def test_retraction_continues_after_a_deactivation() -> None:
    robot = inserted(False, 0.04)
    assert robot.request(RETRACT)
    robot.tick(50)
    robot.follow(robot.loop.halt('the node was deactivated', robot.now))
    robot.tick(1500)
    assert robot.at == pytest.approx([0.01, 0.0, 0.0], abs=SETTINGS.depth_tolerance)
    assert_rests(robot)


@pytest.mark.requirement('S-272')
def test_motion_of_a_user_ends_the_retraction() -> None:
    """A trajectory of the controller, which reports that the system runs again."""
    robot, other = inserted(False, 0.04), Authority('/controller')
    assert robot.request(RETRACT)
    robot.tick(50)
    other.receive(robot.loop.authority.state)
    other.run()
    robot.loop.authority.receive(other.state)
    robot.follow(robot.loop.obey(robot.now))
    count = len(robot.begun)
    robot.tick(800)
    assert len(robot.begun) == count
    assert robot.loop.phase is Phase.IDLE


@pytest.mark.requirement('S-269')
@STRATEGIES
@pytest.mark.parametrize('later', [0.0, 2e-3])
def test_repeated_stop_is_never_deeper_than_the_needle(continuous: bool, later: float) -> None:
    """A person withdraws the needle after the stop; then it may advance by a little."""
    robot = inserted(continuous, 0.03)
    assert robot.request(STOP)
    robot.tick(20)
    depth, follow, sent = float(robot.at[0]), robot.follow, []

    def keep(move: JointMotion | None) -> None:
        if move is not None:
            sent.append(move)
            assert move.positions[:, 0].max() <= robot.at[0]
        follow(move)

    setattr(robot, 'follow', keep)  # noqa: B010
    for pulled in np.linspace(0.0, 0.015, 200):
        robot.ways[0] = np.zeros(1), np.array([depth - pulled])
        robot.tick()
    assert not sent
    for pushed in np.linspace(0.0, later, 100):
        robot.ways[0] = np.zeros(1), np.array([depth - 0.015 + pushed])
        robot.tick()
    robot.tick(200)
    assert bool(sent) == bool(later)


@pytest.mark.requirement('S-006', 'S-007', 'S-016')
@STRATEGIES
@pytest.mark.parametrize('depth', [0.004, 0.021, 0.043])
def test_stop_of_another_node_ends_needle_and_guide(continuous: bool, depth: float) -> None:
    """After it is cleared nothing moves until a new target."""
    robot, other = inserted(continuous, depth), Authority('/controller')
    begin = robot.at.copy()
    other.stop('axial force 40 N is beyond the limit')
    robot.loop.authority.receive(other.state)
    robot.follow(robot.loop.obey(robot.now))
    path = positions(robot, 300)
    assert path[:, 0].max() <= begin[0] + BRAKED
    # The guide moves at 20 mm/s at most, and brakes within 0.2 s.
    assert np.abs(path[:, 1:] - begin[1:]).max() <= 0.2 * SETTINGS.guide_speed
    assert robot.loop.phase is Phase.STOPPED
    assert 'axial force 40 N' in robot.loop.fault
    assert 'stopped: axial force 40 N' in robot.aim()
    other.receive(robot.loop.authority.state)
    assert other.request(CLEAR_STOP)[0]
    robot.loop.authority.receive(other.state)
    robot.follow(robot.loop.obey(robot.now))
    after = positions(robot, 500)
    assert_allclose(after, np.tile(path[-1], (500, 1)), atol=1e-9)
    assert robot.loop.phase is Phase.STOPPED


@pytest.mark.requirement('S-010', 'S-120')
@STRATEGIES
def test_fault_of_an_insertion_stops_the_system(continuous: bool) -> None:
    """The other nodes read the reason in the state."""
    robot = inserted(continuous, 0.02)
    robot.sees = lambda _tip: None
    while robot.loop.steers:
        robot.tick()
    assert robot.loop.fault
    assert robot.loop.authority.reason == robot.loop.fault


@pytest.mark.requirement('S-015')
@STRATEGIES
@pytest.mark.parametrize('silent', [False, True])
def test_stop_does_not_advance_a_resting_needle(continuous: bool, silent: bool) -> None:
    """After a pause, and after a loss of the joint states."""
    robot = inserted(continuous, 0.021)
    assert robot.request(PAUSE)
    robot.tick(800)
    depth = robot.at[0]
    if silent:
        robot.says = lambda _at: None
        robot.tick(100)
        assert robot.loop.authority.reason
    else:
        assert robot.request(STOP)
    path = positions(robot, 300)
    assert path[:, 0].max() <= depth + 1e-9


@pytest.mark.requirement('S-327')
@STRATEGIES
def test_stop_without_recent_positions_moves_nothing(continuous: bool) -> None:
    """A robot that has restarted elsewhere gets no positions from before."""
    robot = inserted(continuous, 0.021)
    robot.says = lambda _at: None
    robot.tick(100)
    assert robot.loop.authority.reason
    for k, position in enumerate((0.01, 0.0, 0.0)):
        robot.ways[k] = np.zeros(1), np.array([position])
    robot.tick(200)
    assert robot.request(CLEAR_STOP)
    assert robot.request(RETRACT)
    assert robot.request(STOP)
    assert_allclose(positions(robot, 300), np.tile([0.01, 0.0, 0.0], (300, 1)))


@pytest.mark.requirement('S-267')
def test_retraction_without_joint_states_is_reported() -> None:
    """Also one that has not begun."""
    robot = inserted(False, 0.021)
    assert robot.request(STOP)
    robot.tick(100)
    robot.says = lambda _at: None
    robot.tick(100)
    assert robot.request(CLEAR_STOP)
    assert robot.request(RETRACT)
    robot.tick(20)
    _, line, _ = robot.loop.diagnose(robot.now)
    assert line.startswith('the retraction has failed: no joint_states received within ')


@pytest.mark.requirement('S-016')
def test_lost_joint_states_do_not_advance_the_needle_beyond_its_motion() -> None:
    """The stop is at the last measured position and its braking distance."""
    robot = inserted(True, 0.021)
    seen = robot.at[0]
    robot.says = lambda _at: None
    while robot.loop.steers:
        robot.tick()
    stopped = robot.at[0]
    path = positions(robot, 300)
    assert path[-1, 0] <= min(stopped, seen + BRAKED) + 1e-9


@pytest.mark.requirement('S-008')
@STRATEGIES
def test_retraction_is_paused_and_resumed(continuous: bool) -> None:
    robot = inserted(continuous, 0.04)
    assert robot.request(RETRACT)
    robot.tick(50)
    assert robot.request(PAUSE)
    robot.tick(100)
    held = robot.at.copy()
    robot.tick(500)
    assert_allclose(robot.at, held, atol=1e-9)
    assert held[0] > 0.015
    assert robot.request(RESUME)
    robot.tick(1500)
    assert robot.at == pytest.approx(
        [SETTINGS.retract_depth, 0.0, 0.0], abs=SETTINGS.depth_tolerance
    )


@pytest.mark.requirement('S-013')
def test_insertion_after_a_retraction_hits_its_target() -> None:
    """A target is refused while the needle is withdrawn, and accepted afterwards."""
    robot = Robot(replace(SETTINGS, retract_depth=0.0))
    robot.tick(20)
    robot.aim()
    while robot.at[0] < 0.02:
        robot.tick()
    assert robot.request(RETRACT)
    assert 'the needle is withdrawn; wait until it rests, or stop it' in robot.aim()
    while robot.loop.phase is Phase.RETRACTING:
        robot.tick()
    assert robot.loop.authority.mode.value == 'retracting'
    robot.steer()
    assert robot.loop.authority.mode.value == 'running'
    assert robot.loop.phase is Phase.DONE
    assert robot.miss < 6e-4


@pytest.mark.requirement('S-006')
@STRATEGIES
@pytest.mark.parametrize(
    ('why', 'fails'),
    [
        ('stopped: requested by a user; ~/clear_stop releases', False),
        ('stopped: a limit', False),
        ('the controller is not active', True),
    ],
)
def test_rejected_stop_fails_unless_the_node_is_stopped_itself(
    continuous: bool, why: str, fails: bool
) -> None:
    """Each node of a stopped system rejects the motion to rest."""
    robot = inserted(continuous, 0.02)
    robot.loop.events.take()
    robot.rejects = lambda name, _move: why if name == 'controller' else ''
    assert robot.request(STOP)
    robot.ways[0] = np.zeros(1), robot.at[:1]
    robot.tick(100)
    said = [line for severity, line in robot.loop.events.take() if severity is Severity.ERROR]
    failed = [f'the stop failed: controller rejected the motion: {why}']
    assert said == ['stopped: requested by a user', *(failed if fails else [])]


@pytest.mark.requirement('S-011', 'S-288')
def test_stop_of_a_retraction_ends_it() -> None:
    robot = inserted(False, 0.04)
    assert robot.request(RETRACT)
    robot.tick(50)
    begin = robot.at.copy()
    assert robot.request(STOP)
    path = positions(robot, 100)
    held = robot.at.copy()
    assert held == pytest.approx(begin, abs=BRAKED)
    # It brakes on its way: a robot that cannot stop at once would return into the tissue.
    velocity = (begin[0] - robot.tracked[-102][0]) / 1e-2
    assert np.diff(path[:, 0]).max() <= 1e-9
    # Half of the braking time at 0.95 mm/s. The law takes the mean velocity of 50 ms, in which the
    # withdrawal accelerates: 10 um less.
    assert begin[0] - held[0] == pytest.approx(0.1 * abs(velocity), abs=2e-5)
    robot.tick(300)
    assert_allclose(robot.at, held, atol=1e-9)
    assert robot.loop.phase is Phase.STOPPED
    assert not robot.request(RETRACT)
    assert robot.request(CLEAR_STOP)
    assert robot.request(RETRACT)
    robot.tick(1500)
    assert robot.at[0] == pytest.approx(SETTINGS.retract_depth, abs=SETTINGS.depth_tolerance)


@pytest.fixture(scope='module')
def resting() -> dict[str, Robot]:
    """Return robots that rest: before an insertion, after one, and after a retraction."""
    idle, done, retracted = Robot(), Robot(), inserted(False, 0.02)
    idle.tick(20)
    done.steer()
    assert retracted.request(RETRACT)
    retracted.tick(1500)
    return {'idle': idle, 'done': done, 'retracted': retracted}


@pytest.mark.requirement('S-345')
@pytest.mark.parametrize('before', ['idle', 'done', 'retracted'])
def test_state_names_a_stop_and_a_pause_while_nothing_moves(
    resting: dict[str, Robot], before: str
) -> None:
    """One line in the log; nothing moves, and the state is as before after the release."""
    robot = resting[before]
    state, at = robot.loop.diagnose(robot.now)[:2], robot.at.copy()
    assert state[0] < Severity.ERROR
    assert 'stopped' not in state[1]
    robot.loop.events.take()
    assert robot.request(STOP)
    robot.tick(100)
    assert robot.loop.diagnose(robot.now)[:2] == (Severity.ERROR, 'stopped: requested by a user')
    assert robot.loop.events.take() == [(Severity.ERROR, 'stopped: requested by a user')]
    assert robot.aim().startswith('target rejected: stopped: requested by a user')
    assert robot.request(CLEAR_STOP)
    assert robot.loop.diagnose(robot.now)[:2] == state
    assert robot.request(PAUSE)
    assert robot.loop.diagnose(robot.now)[:2] == (state[0], f'{state[1]}; paused')
    assert robot.request(RESUME)
    assert robot.loop.diagnose(robot.now)[:2] == state
    assert_allclose(robot.at, at, atol=1e-12)


@pytest.mark.requirement('S-008')
def test_pause_during_planning_holds_the_start() -> None:
    """A target is refused during a pause."""
    robot = Robot()
    robot.tick(20)
    assert robot.request(PAUSE)
    assert robot.aim() == 'target rejected: paused; resume before the next insertion'
    assert robot.request(RESUME)
    robot.steer()
    assert robot.loop.phase is Phase.DONE


@pytest.mark.requirement('S-291')
def test_target_sent_during_a_stop_is_not_executed_after_it() -> None:
    """It is late, or repeated by its sender."""
    robot = Robot()
    robot.tick(20)
    assert robot.request(STOP)
    robot.tick(10)
    sent = robot.now
    robot.tick(10)
    assert robot.request(CLEAR_STOP)
    robot.follow(robot.loop.target(sent, '', TARGET, robot.now))
    robot.tick(100)
    assert robot.loop.phase is Phase.IDLE
    assert_allclose(robot.at, 0.0, atol=1e-12)
    assert robot.aim() == ''


@pytest.mark.requirement('S-292')
@pytest.mark.parametrize('periods', [0, 1, 2])
def test_guide_moved_during_the_retraction_of_a_resting_needle(periods: int) -> None:
    """The retraction needs no motion at first; the guide returns when something moves it."""
    robot = Robot()
    robot.tick(20)
    assert robot.request(RETRACT)
    robot.tick(periods)
    robot.ways[1] = robot.now + np.array([0.0, 2e8]), np.array([0.0, 1e-3])
    # Longer than the patience of a motion.
    robot.tick(1500)
    assert robot.loop.phase is Phase.IDLE
    assert robot.loop.authority.reason == ''
