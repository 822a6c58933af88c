# SPDX-License-Identifier: Apache-2.0
"""Stop, pause and retraction of a steered insertion by a user; without a graph."""

from __future__ import annotations

from dataclasses import replace

from needle_ros.status import SteeringPhase as Phase
from needle_ros.system_state import Authority, CLEAR_STOP, PAUSE, RESUME, RETRACT, STOP
import numpy as np
from numpy.testing import assert_allclose
import pytest
from support.steered_robot import CONTINUOUS, Robot, SETTINGS

#: Largest displacement after a request [m]: braking from 10 mm/s within 0.2 s, and a period.
BRAKED = 1.1e-3

STRATEGIES = pytest.mark.parametrize('continuous', [False, True])


def inserted(continuous: bool, depth: float) -> Robot:
    """Return a robot during an insertion, at a depth [m]."""
    robot = Robot(CONTINUOUS if continuous else SETTINGS)
    robot.tick(20)
    assert robot.aim() == ''
    while robot.at[0] < depth:
        robot.tick()
        assert robot.loop.steers
    return robot


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
    robot.rejects = lambda name, _move: 'the needle is retracted' if name == 'controller' else ''
    robot.ways[0] = robot.now + np.array([0.0, 2e9]), np.array([begin[0], 0.0])
    assert robot.request(RETRACT)
    path = positions(robot, 600)
    assert path[:, 0].max() <= begin[0] + 1e-9
    assert robot.loop.authority.reason == ''
    assert np.abs(path[-1, 1:]).max() <= SETTINGS.guide_tolerance


@pytest.mark.requirement('S-009')
@STRATEGIES
@pytest.mark.parametrize('lost', [1, 2])
def test_lost_withdrawal_is_repeated(continuous: bool, lost: int) -> None:
    robot = inserted(continuous, 0.03)
    execute, seen = robot.execute, 0

    def deaf(name: str, log: object, move: object) -> None:
        nonlocal seen
        if name == 'controller' and robot.loop.phase is Phase.RETRACTING:
            seen += 1
            if seen <= lost:
                return
        execute(name, log, move)  # type: ignore[arg-type]

    setattr(robot, 'execute', deaf)  # noqa: B010
    assert robot.request(RETRACT)
    robot.tick(1500)
    assert seen > lost
    assert robot.at[0] == pytest.approx(SETTINGS.retract_depth, abs=SETTINGS.depth_tolerance)


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


@pytest.mark.requirement('S-011')
def test_stop_of_a_retraction_ends_it() -> None:
    robot = inserted(False, 0.04)
    assert robot.request(RETRACT)
    robot.tick(50)
    assert robot.request(STOP)
    robot.tick(100)
    held = robot.at.copy()
    robot.tick(300)
    assert_allclose(robot.at, held, atol=1e-9)
    assert robot.loop.phase is Phase.STOPPED
    assert not robot.request(RETRACT)
    assert robot.request(CLEAR_STOP)
    assert robot.request(RETRACT)
    robot.tick(1500)
    assert robot.at[0] == pytest.approx(SETTINGS.retract_depth, abs=SETTINGS.depth_tolerance)


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
