# SPDX-License-Identifier: Apache-2.0
"""The steering executive with a simulated robot, with and without faults; without ROS."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
import re
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st
from needle_controller import ExecutiveSettings, ReferenceLimits, SteeringPrior
from needle_controller.reference.path import Path
from needle_controller.reference.quintic import Quintic
from needle_controller.reference.setpoint import Setpoint
from needle_controller.steering.guarded_law import TipMeasurements
from needle_controller.steering.law import TipEstimate
from needle_controller.steering.motion import duration_of, JointMotion, smooth
from needle_dynamics import ParameterError
from needle_ros.event_log import Severity
from needle_ros.quantities import NORMAL
from needle_ros.status import SteeringPhase as Phase
from needle_ros.system_state import CLEAR_STOP, STOP
from needle_ros.wire import Reading
import numpy as np
from numpy.testing import assert_allclose
import pytest
from scipy.interpolate import CubicHermiteSpline
from support.steered_robot import (
    CONTINUOUS,
    inserted,
    NAMES,
    PERIOD,
    Robot,
    SECOND,
    SETTINGS,
    TARGET,
)


@settings(max_examples=50, deadline=None)
@given(
    begin=st.tuples(st.floats(0.0, 0.1), *[st.floats(-6e-3, 6e-3)] * 2),
    end=st.tuples(st.floats(0.0, 0.1), *[st.floats(-6e-3, 6e-3)] * 2),
    duration=st.floats(0.01, 20.0),
)
def test_motion_is_smooth_proportional_and_monotonic(
    begin: tuple[float, ...], end: tuple[float, ...], duration: float
) -> None:
    """It ends at rest exactly at its goal, within its speed limits, and never reverses."""
    one, other = np.array(begin), np.array(end)
    move = smooth(NAMES, one, other, duration)
    assert (move.positions[-1] == other).all()
    assert (move.velocities[-1] == 0.0).all()
    assert move.times[-1] == pytest.approx(duration)
    way = other - one
    gone = (move.positions - one) @ way / max(way @ way, 1e-300)
    assert (np.diff(gone) >= -1e-12).all()
    assert_allclose(move.positions, one + np.outer(gone, way), atol=1e-15)
    # The highest speed of a polynomial of least jerk is 15/8 of the mean.
    assert (np.abs(move.velocities) <= 1.8751 * np.abs(way) / duration + 1e-15).all()


@given(duration=st.floats(100.0, 1e10))
def test_long_motion_has_few_points(duration: float) -> None:
    """As for a speed of 1e-9 m/s; cubics between the points are exact to 1e-9 of the way."""
    # Their error is h^4 / 384 times the fourth derivative, at most 360, with h = 1/1000.
    move = smooth(NAMES, np.zeros(3), np.array([0.1, 0.0, 0.0]), duration)
    assert len(move.times) <= 1000
    spline = CubicHermiteSpline(move.times, move.positions[:, 0], move.velocities[:, 0])
    way = Quintic(Setpoint(0.0), Setpoint(0.1), duration)
    times = np.linspace(move.times[0], duration, 4001)
    expected = [way.at(time).position for time in times.tolist()]
    assert_allclose(spline(times), expected, atol=1e-10)


@pytest.mark.requirement('S-117')
def test_insertion_hits_the_target_with_a_consistent_estimate() -> None:
    """The error is within the reported interval; the guide rests during the insertion."""
    robot = Robot()
    robot.steer()
    assert robot.loop.phase is Phase.DONE
    # 16 readings of 0.18 mm per measurement; three deviations of the last measurement.
    assert robot.miss < 3.0 * 1.8e-4 / np.sqrt(16.0) + 1e-4
    there = robot.loop.expected
    off = robot.needle.tip[[0, 2]] - there.mean
    # 99.9 % of draws of two normal numbers.
    assert off @ np.linalg.solve(there.covariance, off) < 13.8
    ways = np.abs(np.diff(robot.tracked, axis=0))
    assert not ((ways[:, 0] > 1e-9) & (ways[:, 1:].max(axis=1) > 1e-9)).any()
    speeds = ways.max(axis=0) / (1e-9 * PERIOD)
    # A reading of positions is rounded to 10 ms.
    assert (speeds <= [0.0101, 0.0202, 0.0202]).all()
    assert np.abs(robot.tracked).max(axis=0)[1:].max() <= SETTINGS.guide_limit
    severity, line, _ = robot.loop.diagnose(robot.now)
    assert severity is Severity.INFO
    assert re.fullmatch(
        r'done: the tip is at x = .* ± .* mm, y = (59\.[89]|60\.0)\d ± .* mm, z = .* \(95 %\), '
        r'0\.\d\d mm from the target', line,
    )  # fmt: skip


@pytest.mark.requirement('S-338')
def test_miss_in_depth_is_a_warning() -> None:
    """The sensor measures the tip 2 mm short; the needle is at its insertion depth."""
    robot = Robot()
    robot.sees = lambda tip: tip - np.array([0.0, 2e-3, 0.0])
    robot.steer()
    severity, line, _ = robot.loop.diagnose(robot.now)
    assert robot.loop.phase is Phase.DONE
    assert severity is Severity.WARNING
    assert [
        line
        for severity, line in robot.loop.events.take()
        if severity is Severity.WARNING and line.startswith('the first measurement of the tip is')
    ]
    # A bent needle is 0.1 mm less deep than its insertion depth.
    assert re.search(
        r'y = (57\.[89]|58\.0)\d ± .* 2\.\d\d mm from the target, at most 2.\d\d mm$', line
    )


@pytest.mark.requirement('S-271')
@pytest.mark.parametrize(
    ('off', 'half', 'severity'),
    [
        (0.2, 0.1, Severity.INFO),
        (0.9, 2.0, Severity.WARNING),
        (0.0, 2.0, Severity.WARNING),
        (0.9, 0.2, Severity.WARNING),
        (1.2, 0.1, Severity.WARNING),
    ],
)
def test_uncertain_hit_is_a_warning(off: float, half: float, severity: Severity) -> None:
    """Distance from the target and half width of the interval [mm] are at most 1 mm together."""
    robot = Robot()
    robot.steer()
    law = robot.loop._insertion.law
    deviation = 1e-3 * half / NORMAL
    law.expected = TipEstimate(
        np.array(TARGET)[[0, 2]] + (1e-3 * off, 0.0), deviation**2 * np.eye(2)
    )
    line, found = law.outcome()
    assert found is severity
    assert f'± {half:.2f} mm, y' in line
    assert ('at most' in line) == (severity is Severity.WARNING)


@pytest.mark.requirement('S-300')
@pytest.mark.parametrize(('offset', 'severity'), [(0.0, Severity.INFO), (2e-3, Severity.WARNING)])
def test_tip_beside_the_guide_is_a_warning(offset: float, severity: Severity) -> None:
    """A shift of the sensor frame is reported; the tilt of the guide alone is less than 1 mm."""
    robot = Robot()
    robot.sees = lambda tip: np.add(tip, (offset, 0.0, 0.0))
    robot.steer()
    assert robot.loop.phase is Phase.DONE
    line, found = robot.loop._insertion.law.outcome()
    warned = severity is Severity.WARNING
    assert found is severity
    assert ('mm beside the guide' in line) == warned
    reported = [
        k for k, (_, line) in enumerate(robot.loop.events.take()) if line.startswith('the tip')
    ]
    assert bool(reported) == warned


@pytest.mark.requirement('S-329')
def test_tip_far_from_the_guide_stops_before_the_insertion() -> None:
    """Such as a tip in mm."""
    robot = Robot()
    robot.sees = lambda tip: np.add(tip, (1.76, 0.0, 0.0))
    robot.steer()
    assert robot.loop.phase is Phase.STOPPED
    assert 'the tip is 1760 mm beside the guide before the insertion' in robot.loop.fault
    assert not robot.at.any()


@pytest.mark.requirement('S-338')
@pytest.mark.parametrize('settings', [SETTINGS, CONTINUOUS])
@pytest.mark.parametrize('shift', [-0.022, -6e-3, -3.3e-3, 3.3e-3, 6e-3, 0.022])
def test_tip_that_is_not_at_the_insertion_depth_stops_before_the_insertion(
    shift: float, settings: ExecutiveSettings
) -> None:
    """By more than `slip_tolerance`, as for a shifted origin or an encoder without its zero."""
    robot = Robot(settings, law='open_loop')
    robot.sees = lambda tip: np.add(tip, (0.0, shift, 0.0))
    robot.steer()
    assert robot.loop.phase is Phase.STOPPED
    assert not robot.at.any()
    found = re.match(
        r'the first measurement of the tip is y = (.*) mm at an insertion depth of 0\.00 mm, ',
        robot.loop.fault,
    )
    assert found is not None
    # Five standard deviations of a mean of 19 readings of 0.18 mm, and the digits of the line.
    assert abs(float(found[1]) - 1e3 * shift) < 5.0 * 0.18 / np.sqrt(19.0) + 0.005


@pytest.mark.requirement('S-338')
@pytest.mark.parametrize('settings', [SETTINGS, CONTINUOUS])
@pytest.mark.parametrize('shift', [-2.7e-3, 2.7e-3])
def test_smaller_difference_of_tip_and_insertion_depth_is_no_stop(
    shift: float, settings: ExecutiveSettings
) -> None:
    robot = Robot(settings, law='open_loop')
    robot.sees = lambda tip: np.add(tip, (0.0, shift, 0.0))
    robot.steer()
    assert robot.loop.phase is Phase.DONE


@pytest.mark.requirement('S-124')
def test_late_and_lost_readings_are_tolerated() -> None:
    """Ultrasound: 66 ms late, one in four ticks, 5 % lost."""
    robot = Robot(replace(SETTINGS, measurement_time=0.5))
    robot.late = 66_000_000
    lost = np.random.default_rng(5)
    robot.sees = lambda tip: tip if robot.now // PERIOD % 4 == 0 and lost.random() > 0.05 else None
    robot.steer()
    assert robot.loop.phase is Phase.DONE
    assert robot.miss < 4e-4


def stuck(robot: Robot, joint: int, depth: float = 0.03) -> None:
    at = 5e-4 if joint else depth

    def moves(wanted: Any) -> Any:
        wanted[joint] = np.clip(wanted[joint], -at, at)
        return wanted

    robot.moves = moves


def frozen(robot: Robot) -> None:
    held: list[Any] = []

    def sees(tip: Any) -> Any:
        if robot.at[0] > 0.03:
            held.append(tip)
            return held[0]
        return tip

    robot.sees = sees


def lost(robot: Robot) -> None:
    robot.sees = lambda tip: tip if robot.at[0] < 0.02 else None


def slips(robot: Robot) -> None:
    """Leave the tip behind: the needle slips in the guide."""

    def sees(tip: Any) -> Any:
        tip[1] -= max(0.0, 0.5 * (robot.at[0] - 0.02))
        return tip

    robot.sees = sees


def silent(robot: Robot) -> None:
    robot.says = lambda at: at if at[0] < 0.03 else None


def creeps(robot: Robot) -> None:
    """Move the needle externally, during a measurement of the tip."""

    def moves(wanted: Any) -> Any:
        if robot.loop.phase is Phase.MEASURING and wanted[0] > 0.03:
            wanted[0] += 1e-3
        return wanted

    robot.moves = moves


def test_needle_at_the_limit_of_its_tolerance_is_measured() -> None:
    """It arrives just within the tolerance, and settles just outside of it."""
    robot = Robot()

    def short(wanted: Any) -> Any:
        off = 1.1 if robot.loop.phase is Phase.MEASURING else 0.9
        wanted[0] = max(0.0, wanted[0] - off * SETTINGS.depth_tolerance)
        return wanted

    robot.moves = short
    robot.steer()
    assert robot.loop.fault == ''
    assert robot.loop.phase is Phase.DONE


def pushed_back(robot: Robot, measurements: int) -> None:
    """Push the needle back by 1 mm in its first measurements, until they are discarded."""
    seen = 0

    def moves(wanted: Any) -> Any:
        nonlocal seen
        if robot.loop.phase is Phase.MEASURING and wanted[0] > 0.03 and seen < measurements:
            seen += 1
            wanted[0] -= 1e-3
        return wanted

    robot.moves = moves


@pytest.mark.requirement('S-311')
@pytest.mark.parametrize('settings', [SETTINGS, CONTINUOUS])
def test_needle_that_tissue_pushes_back_is_measured_again(settings: ExecutiveSettings) -> None:
    """As after a gap in the commands; a needle that leaves its goal each time is stopped."""
    robot = Robot(settings)
    pushed_back(robot, 3)
    robot.steer()
    assert robot.loop.phase is Phase.DONE
    assert robot.miss < 4e-4
    held = Robot(settings)
    pushed_back(held, 1000)
    held.steer()
    assert held.loop.phase is Phase.STOPPED
    assert 's late' in held.loop.fault


@pytest.mark.requirement('S-122', 'S-123', 'S-126', 'S-127', 'S-130', 'S-131', 'S-132', 'S-162')
@pytest.mark.parametrize(
    ('fault', 'said', 'deepest'),
    [
        (lambda robot: stuck(robot, 1), r'guide_x is at -?0\.500 mm, not at', 0.03),
        (
            lambda robot: stuck(robot, 0),
            'insertion is at 30.000 mm, not at 35.000 mm: joint_trajectory sent 4 times, contr',
            0.031,
        ),
        (frozen, 'the tip sensor is frozen: 20 identical readings', 0.036),
        (lost, '7 tip measurements are missing', 0.056),
        (slips, 'mm less deep than the needle was inserted: the needle slips', 0.031),
        (silent, r'no joint_states received within 0\.5\d s', 0.036),
        (creeps, r'during the measurement of the tip insertion is at 3.\.000 mm', 0.037),
    ],
)
def test_faults_stop_the_insertion_with_a_message(
    fault: Callable[[Robot], None], said: str, deepest: float
) -> None:
    """The needle rests soon after, and no step follows."""
    robot = Robot()
    fault(robot)
    robot.steer()
    assert robot.loop.phase is Phase.STOPPED
    severity, state, _ = robot.loop.diagnose(robot.now)
    assert severity is Severity.ERROR
    assert state.startswith('stopped: ')
    with pytest.raises(AssertionError, match=said):
        raise AssertionError(robot.loop.fault)
    robot.tick(300)
    # At most 10 mm deeper than the detection: the step under way.
    assert robot.at[0] <= deepest + 1e-9
    before = robot.at
    robot.tick(100)
    assert_allclose(robot.at, before, atol=1e-9)


@pytest.mark.parametrize(
    ('step', 'rate', 'late'),
    [(5e-3, 20.0, 0), (5e-3, 8.0, 0), (2.5e-3, 50.0, 20_000_000), (2.5e-3, 20.0, 66_000_000)],
)
def test_continuous_insertion_hits_the_target(step: float, rate: float, late: int) -> None:
    """In 12 s instead of 18, with readings during motion, also late; the guide never jumps."""
    robot = Robot(replace(CONTINUOUS, step_length=step, rate=rate))
    robot.late = late
    robot.steer()
    assert robot.loop.phase is Phase.DONE
    assert robot.miss < 4e-4
    assert robot.seconds < 14.0
    tracked = np.array(robot.tracked)
    going = (tracked[:, 0] > 1e-3) & (tracked[:, 0] < 0.059)
    # No rest during the insertion.
    assert (np.diff(tracked[going, 0]) > 0.0).all()
    ways = np.abs(np.diff(tracked[:, 1:], axis=0)).max(axis=0) / (1e-9 * PERIOD)
    # Twice the mean speed of the largest step, at the peak of the insertion speed.
    assert (ways <= 2.0 * CONTINUOUS.guide_step / step * CONTINUOUS.speed).all()


def test_guide_waits_for_a_stalled_needle() -> None:
    """For two seconds within a step; then the guide has the same position at the same depth."""
    robot, held = Robot(CONTINUOUS), 0

    def moves(wanted: Any) -> Any:
        nonlocal held
        if wanted[0] > 0.0325 and held < 200:
            held += 1
            robot.ways[0] = robot.ways[0][0] + PERIOD, robot.ways[0][1]
            wanted[0] = 0.0325
        return wanted

    robot.moves = moves
    robot.steer()
    assert robot.loop.phase is Phase.DONE
    assert robot.miss < 4e-4
    tracked = np.array(robot.tracked)
    stalled = tracked[np.abs(tracked[:, 0] - 0.0325) < 1e-9][20:, 1:]
    assert len(stalled) > 150
    assert_allclose(stalled, np.tile(stalled[-1], (len(stalled), 1)), atol=1e-6)


@pytest.mark.requirement('S-119', 'S-139', 'S-140')
@pytest.mark.parametrize(
    ('fault', 'said', 'deepest'),
    [
        (lambda robot: stuck(robot, 1), r'the guide is at x = -?0\.500 mm', 0.02),
        (lambda robot: stuck(robot, 0), 'insertion is at 30.000 mm, not at 60.000 mm', 0.031),
        (
            lambda robot: stuck(robot, 0, 0.0),
            'insertion is at 0.000 mm, not at 60.000 mm: joint_traj',
            0.0,
        ),
        (frozen, 'the tip sensor is frozen', 0.048),
        (lost, '7 tip measurements are missing', 0.061),
        (slips, 'deep than the needle was inserted: the needle slips', 0.04),
        (silent, r'no joint_states received within 0\.5\d s', 0.061),
    ],
)
def test_faults_stop_a_continuous_insertion_with_a_message(
    fault: Callable[[Robot], None], said: str, deepest: float
) -> None:
    """
    The needle rests soon after.

    Except without `joint_states`: then the depth is unknown, and the needle moves to the target
    depth, unless its driver stops without `joint_states`, as our controller does.
    """
    robot = Robot(CONTINUOUS)
    fault(robot)
    robot.steer()
    assert robot.loop.phase is Phase.STOPPED
    with pytest.raises(AssertionError, match=said):
        raise AssertionError(robot.loop.fault)
    robot.tick(1000)
    assert robot.at[0] <= deepest
    before = robot.at
    robot.tick(100)
    assert_allclose(robot.at, before, atol=1e-9)


@settings(max_examples=50, deadline=None)
@given(speed=st.floats(1e-3, 0.05), acceleration=st.floats(0.01, 1.0), way=st.floats(5e-4, 0.1))
def test_axis_law_with_the_same_limits_accepts_every_motion(
    speed: float, acceleration: float, way: float
) -> None:
    """It interpolates the points by cubics, and checks their speed and acceleration."""
    own = ExecutiveSettings(speed=speed, acceleration=acceleration)
    begin, end = np.array([0.01, 0.0, 0.0]), np.array([0.01 + way, 0.0, 0.0])
    move = smooth(own.joints, begin, end, duration_of(end - begin, own))
    limits = ReferenceLimits(speed=1.001 * speed, acceleration=acceleration)
    times = np.concatenate([[0.0], move.times])
    positions = np.concatenate([[0.01], move.positions[:, 0]])
    speeds = np.concatenate([[0.0], move.velocities[:, 0]])
    path = Path(times.tolist(), positions.tolist(), speeds.tolist(), limits, (0.0, 0.2))
    assert path.last == end[0]


@pytest.mark.parametrize('continuous', [False, True])
def test_single_implausible_reading_has_no_effect(continuous: bool) -> None:
    """An encoder reading of 150 mm, and a guide position of 50 mm, for one message."""
    robot = inserted(continuous, 0.0301)
    for absurd in ((0.15, *robot.at[1:]), (robot.at[0], 0.05, 0.0)):
        reading = robot.joints(robot.now + 1, absurd)
        assert robot.loop.joints(reading, robot.now + 1) is None
    while robot.loop.steers:
        robot.tick()
    assert robot.loop.phase is Phase.DONE
    assert robot.miss < 4e-4


@pytest.mark.requirement('S-141', 'S-142')
@pytest.mark.parametrize('continuous', [False, True])
def test_stop_is_sent_again_to_a_needle_that_still_moves(continuous: bool) -> None:
    """It moves at 20 mm/s against its commands; the robot follows the second stop."""
    robot = Robot(replace(SETTINGS, continuous=continuous))
    runs, asked = False, 0

    def moves(wanted: Any) -> Any:
        if runs:
            wanted[0] = robot.at[0] + 2e-4
        return wanted

    follow = robot.follow

    def hear(move: JointMotion | None) -> None:
        nonlocal runs, asked
        if move is not None and robot.loop.phase is Phase.STOPPED:
            asked += 1
            runs = runs and asked < 2
        follow(move)

    robot.moves = moves
    setattr(robot, 'follow', hear)  # noqa: B010
    robot.tick(20)
    robot.aim()
    robot.tick(500)
    runs, begun = True, robot.at[0]
    while robot.loop.steers:
        robot.tick()
    # Within the step or the insertion under way, and 1.5 mm more.
    assert robot.at[0] <= (TARGET[1] if continuous else begun + SETTINGS.step_length) + 2e-3
    assert 'insertion is at' in robot.loop.fault
    robot.tick(400)
    assert 2 <= asked <= 3
    before = robot.at
    robot.tick(100)
    assert_allclose(robot.at, before, atol=1e-9)


@pytest.mark.requirement('S-142')
@pytest.mark.parametrize('continuous', [False, True])
def test_braking_needle_is_not_stopped_again(continuous: bool) -> None:
    """It brakes within 0.2 s, and rests then."""
    robot = inserted(continuous, 0.0301)
    while robot.tracked[-1][0] - robot.tracked[-2][0] < 5e-5:
        robot.tick()
    robot.loop.events.take()
    before = robot.at[0]
    robot.request('stop')
    robot.tick(200)
    # Faster than 5 mm/s: at least 0.5 mm in 0.2 s without braking, half of it with.
    assert robot.at[0] - before > 1e-4
    assert not [line for _, line in robot.loop.events.take() if 'still moves' in line]


@pytest.mark.requirement('S-142')
@pytest.mark.parametrize('continuous', [False, True])
def test_stop_does_not_move_a_guide_whose_position_is_wrong(continuous: bool) -> None:
    """The robot reports mm instead of m."""
    robot = inserted(continuous, 0.0301)
    robot.says = lambda at: (at[0], *(1e3 * at[1:]))
    while robot.loop.steers:
        robot.tick()
    assert 'guide_' in robot.loop.fault
    stopped = robot.at[1:]
    robot.tick(100)
    assert_allclose(robot.at[1:], stopped, atol=1e-9)


@pytest.mark.requirement('S-187')
@pytest.mark.parametrize('continuous', [False, True])
def test_needle_moved_deeper_after_the_insertion_stops_the_system(continuous: bool) -> None:
    """At five times its tolerance beyond the target; a withdrawn needle is no fault."""
    robot = Robot(replace(SETTINGS, continuous=continuous))
    robot.steer()
    offset = -5e-3
    robot.moves = lambda wanted: np.add(wanted, (offset, 0.0, 0.0))
    robot.tick(10)
    assert robot.loop.fault == ''
    offset = 0.0
    for _ in range(100):
        offset += 1e-4
        robot.tick()
        if robot.loop.fault:
            break
    assert offset == pytest.approx(5.0 * SETTINGS.depth_tolerance, abs=2e-4)
    assert robot.loop.phase is Phase.STOPPED
    assert robot.loop.authority.reason == robot.loop.fault
    assert 'after the insertion insertion is at 61.' in robot.loop.fault


def test_slow_needle_is_no_fault() -> None:
    robot = Robot(replace(CONTINUOUS, speed=5e-3))
    robot.steer()
    assert robot.loop.phase is Phase.DONE


@pytest.mark.requirement('S-121')
def test_target_after_a_retraction_is_accepted() -> None:
    """From any guide position: the guide moves to zero first."""
    robot = Robot()
    robot.steer()
    assert np.abs(robot.at[1:]).max() > 1e-4
    robot.ways[0] = robot.now + np.array([0.0, 1e9]), np.array([robot.at[0], 0.0])
    robot.tick(120)
    assert robot.aim() == ''
    robot.tick(20)
    assert robot.loop.steers


def test_second_insertion_warns_of_the_old_path() -> None:
    """The first does not."""
    robot = Robot()
    said: list[str] = []
    for _ in range(2):
        robot.steer()
        said.append(' '.join(line for _, line in robot.loop.events.take()))
        robot.ways[0] = robot.now + np.array([0.0, 1e9]), np.array([robot.at[0], 0.0])
        robot.tick(120)
    assert 'may follow the old path' not in said[0]
    assert 'a needle was 60.0 mm deep before: in the same tissue' in said[1]


def test_settings_incompatible_with_continuous_are_rejected() -> None:
    with pytest.raises(ParameterError, match='turns must be 0 if continuous'):
        ExecutiveSettings(continuous=True, turns=2)
    with pytest.raises(ParameterError, match='continuous must be true or false'):
        ExecutiveSettings(continuous=2.0)  # type: ignore[arg-type]
    with pytest.raises(ParameterError, match='rate must be at least 8 Hz if continuous'):
        ExecutiveSettings(continuous=True, rate=5.0)


@pytest.mark.requirement('S-133')
def test_duplicate_publishers_of_measurements_are_rejected() -> None:
    for counts in ((2, 1), (1, 2)):
        robot = Robot()
        robot.tick(5)
        robot.loop.count_publishers(*counts)
        assert '2 nodes publish' in robot.aim()
        robot.loop.count_publishers(1, 1)
        assert robot.aim() == ''
        robot.tick(10)
        robot.loop.count_publishers(*counts)
        robot.tick(2)
        assert '2 nodes publish' in robot.loop.fault


@pytest.mark.requirement('S-134')
def test_clock_set_back_stops_the_insertion() -> None:
    robot = Robot()
    robot.tick(5)
    robot.aim()
    robot.tick(100)
    robot.now -= 10 * SECOND
    robot.tick(2)
    assert robot.loop.fault == 'the clock went back by 9.990 s'


@pytest.mark.parametrize(
    ('point', 'frame', 'complaint'),
    [
        ((np.nan, 0.06, 0.0), '', 'target must be finite'),
        (TARGET, 'needle_base', "target must be in frame '' or 'needle_entry', got 'needle_base'"),
        ((0.05, 0.06, 0.0), '', 'x = 50.00 mm, z = 0.00 mm is out of reach'),
        (
            (0.0, 0.2, 0.0),
            '',
            'at a depth of at most 160 mm with this needle, got 200 mm; targets are',
        ),
        ((4.0, 80.0, -2.0), '', 'got 80000 mm; targets are in m'),
        ((0.0, 0.0, 0.0), '', 'the needle is at 0.00 mm already'),
    ],
)
def test_invalid_targets_are_rejected(
    point: tuple[float, float, float], frame: str, complaint: str
) -> None:
    """Nothing moves, and another target is accepted."""
    robot = Robot()
    assert robot.aim() == 'target rejected: no joint_states received within 0.5 s'
    robot.tick(5)
    with pytest.raises(AssertionError, match=complaint):
        raise AssertionError(robot.aim(point, frame))
    assert robot.loop.phase is Phase.IDLE
    robot.tick(5)
    assert not robot.at.any()
    assert robot.aim() == ''


@pytest.mark.parametrize('before', [0, 5], ids=['never valid', 'valid before'])
@pytest.mark.parametrize('name', ['joint_states', 'tip_deflection'])
def test_rejection_of_a_target_has_the_reason_of_refused_measurements(
    name: str, before: int
) -> None:
    """They arrive, but are not valid; the reason is gone with the next valid one."""
    robot = Robot()
    robot.tick(before)
    nan = [np.nan] * 3
    if name == 'joint_states':
        robot.says = lambda _: nan
    else:
        robot.sees = lambda _: nan
    robot.tick(60)
    assert robot.aim() == (
        f'target rejected: no valid {name} received within 0.5 s; {name} must be finite, '
        'got [nan, nan, nan]'
    )
    robot.says = robot.sees = lambda values: values
    robot.tick(5)
    assert robot.aim() == ''


def test_too_many_steps_are_rejected() -> None:
    """Their plan would exceed the memory."""
    robot = Robot(replace(SETTINGS, step_length=1e-4, depth_tolerance=1e-5))
    robot.tick(5)
    assert 'it would take 600 steps of 0.1 mm, at most 200 are possible' in robot.aim()


@pytest.mark.requirement('S-121')
def test_needle_must_be_straight_at_the_start() -> None:
    """Outside tissue the guide moves to its zero first; in tissue it must be there."""
    robot = Robot()
    robot.ways[1] = np.zeros(1), np.array([3e-3])
    robot.tick(20)
    assert robot.aim() == ''
    robot.tick(55)
    assert_allclose(robot.at, 0.0, atol=1e-12)
    assert robot.loop.law.step == 0

    robot = Robot()
    robot.ways[:2] = [(np.zeros(1), np.array([at])) for at in (0.02, 3e-3)]
    robot.tick(20)
    assert 'the guide is 3.00 mm off its zero with the needle at 20.00 mm' in robot.aim()


def test_target_may_move_laterally_but_not_in_depth() -> None:
    robot = Robot()
    robot.tick(5)
    robot.aim((0.0, 0.06, 0.0))
    robot.tick(600)
    assert robot.loop.steers
    assert 'the insertion is to a depth of 60.00 mm, got 70.00 mm' in robot.aim((0.0, 0.07, 0.0))
    assert 'out of reach' in robot.aim((0.06, 0.06, 0.0))
    assert_allclose(robot.loop.law.target, 0.0)
    assert robot.aim() == ''
    while robot.loop.steers:
        robot.tick()
    assert robot.miss < 4e-4


@pytest.mark.requirement('S-006', 'S-120')
def test_stop_brings_needle_and_guide_to_rest() -> None:
    """Within 3 mm; afterwards the needle must be retracted before another insertion."""
    robot = Robot()
    robot.tick(5)
    robot.aim()
    while robot.loop.phase is not Phase.INSERTING or robot.at[0] < 0.032:
        robot.tick()
    depth = robot.at[0]
    assert robot.request(STOP)
    robot.tick(200)
    assert depth <= robot.at[0] <= depth + 3e-3
    assert robot.aim() == 'target rejected: stopped: requested by a user; ~/clear_stop releases'
    assert robot.request(CLEAR_STOP)
    robot.tick(200)
    assert robot.aim().endswith(
        'has been steered; set retract_depth to 0.00 mm (it is 10.00 mm), and retract it to '
        '0.00 mm first'
    )


@pytest.mark.requirement('S-125')
def test_noisy_readings_give_a_warning() -> None:
    """Five times the configured noise."""
    robot = Robot(prior=SteeringPrior(noise=8e-6))
    robot.tick(5)
    robot.aim()
    robot.tick(60)
    severity, _, status = robot.loop.diagnose(robot.now)
    assert severity is Severity.WARNING
    assert 'noise of the tip measurement is 0.0' in status.warning


@pytest.mark.requirement('S-125')
def test_averaged_measurement_rejects_outliers() -> None:
    """Many readings with two outliers; and no readings."""
    look = TipMeasurements()
    assert look.average(1e-5) is None
    rng = np.random.default_rng(1)
    tips = np.array([1e-3, 0.05, -2e-3]) + 1e-4 * rng.standard_normal((20, 3))
    for tip in tips:
        look.take(tuple(tip))
    look.take((0.02, 0.05, 0.0))
    look.take((1e300, 0.05, 0.0))
    average = look.average(1e-5)
    assert average.readings == 20
    assert_allclose(average.tip, tips.mean(axis=0), atol=1e-12)
    # The deviation of 20 readings is known to 1 / sqrt(38): three times that.
    assert average.error == pytest.approx(1e-4 / np.sqrt(20.0), rel=3.0 / np.sqrt(38.0))


numbers = st.floats(allow_nan=True, allow_infinity=True) | st.floats(-0.1, 0.1)


@pytest.mark.requirement('S-136', 'S-142')
@settings(max_examples=60, deadline=None)
@given(
    said=st.lists(
        st.tuples(
            st.sampled_from(['joints', 'tip', 'names', 'late']),
            st.tuples(numbers, numbers, numbers),
        ),
        max_size=12,
    ),
    continuous=st.booleans(),
)
def test_motions_stay_within_limits_for_any_input(
    said: list[tuple[str, tuple[float, float, float]]], continuous: bool
) -> None:
    """Each motion ends within guide limit and target depth, never NaN."""
    robot = Robot(
        replace(
            SETTINGS,
            measurement_time=0.05,
            step_length=0.02,
            settle_time=0.0,
            continuous=continuous,
        )
    )
    moves: list[JointMotion] = []
    follow = robot.follow

    def keep(move: JointMotion | None) -> None:
        if move is not None:
            moves.append(move)
        follow(move)

    setattr(robot, 'follow', keep)  # noqa: B010
    robot.tick(5)
    robot.aim()
    for what, values in said:
        robot.tick(20)
        if what == 'tip':
            reading = Reading(robot.now + 1, 'needle_entry', (), (values,))
            keep(robot.loop.tip(reading, robot.now))
        elif what == 'names':
            reading = Reading(robot.now + 1, '', NAMES[:2], (values[:2], (), ()))
            keep(robot.loop.joints(reading, robot.now))
        else:
            stamp = robot.now + (1 if what == 'joints' else -10 * SECOND)
            keep(robot.loop.joints(robot.joints(stamp, values), robot.now))
    robot.tick(50)
    for move in moves:
        assert np.isfinite(move.positions).all()
        assert np.isfinite(move.velocities).all()
        for name, column in zip(move.joints, move.positions.T, strict=True):
            low, high = (0.0, TARGET[1]) if name == 'insertion' else (-6e-3, 6e-3)
            assert low - 1e-12 <= column.min() <= column.max() <= high + 1e-12


def test_motion_of_rounding_size_is_not_sent() -> None:
    """A controller rejects a motion with equal times of its points."""
    robot = Robot()
    robot.tick(5)
    robot.aim()
    loop = robot.loop
    for way, sent in ((1e-15, False), (5e-7, False), (2e-6, True)):
        motions = loop._motions
        move = motions.send(motions.goal + np.array([0.0, way, 0.0]), robot.now)
        assert (move is not None) == sent
        assert move is None or (np.diff(move.times) > 1e-5).all()


@given(
    speed=st.floats(-0.05, 0.05),
    age=st.integers(0, 500_000_000),
    later=st.integers(-500_000_000, 500_000_000),
)
def test_depth_of_a_reading_is_by_the_stamps_of_the_measurements(
    speed: float, age: int, later: int
) -> None:
    """At a constant speed it is exact, whatever the age of the measured position."""
    motions, end = Robot(CONTINUOUS).loop._motions, 2_000_000_000
    for stamp in (1_000_000_000, end - age):
        motions.measure(np.array([0.05 + speed * 1e-9 * stamp, 0.0, 0.0]), stamp)
    # A micrometer in 500 m/s: rounding only.
    assert motions.depth_at(end + later) == pytest.approx(
        0.05 + speed * 1e-9 * (end + later), abs=1e-12
    )
