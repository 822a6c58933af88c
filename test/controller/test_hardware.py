# SPDX-License-Identifier: Apache-2.0
"""Conversion between the messages of a robot driver and the contract."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from math import isnan, nan
from typing import Any

from hypothesis import given
from hypothesis import strategies as st
from needle_controller import Controller, ForceCommand, HardwareSettings, Robot
from needle_controller.hardware import dynamic_reading
from needle_dynamics import NeedleParameters
from needle_ros.errors import ParameterError
from needle_ros.settings import from_values
from needle_ros.wire import Reading
import numpy as np
import pytest

SECOND = 1_000_000_000
NUMBERS = st.floats(-1e3, 1e3)
ROBOTS = st.builds(
    lambda sign, scale, zero: Robot(HardwareSettings(sign=sign, scale=scale, zero=zero)),
    st.sampled_from([-1.0, 1.0]),
    st.floats(1e-4, 10.0),
    st.floats(-100.0, 100.0),
)
SIGNED = ['x', 'y', 'z', '-x', '-y', '-z']
MOVES: dict[str, Any] = {
    'command': 'position',
    'command_type': 'joint_trajectory',
    'command_topic': 'go',
}
PUSHES: dict[str, Any] = {'command_type': 'float64_multi_array', 'command_topic': 'push'}


def state(
    names: Sequence[str],
    positions: Sequence[float],
    velocities: Sequence[float] = (),
    efforts: Sequence[float] = (),
    stamp: int = SECOND,
) -> Reading:
    """Return a joint state."""
    return Reading(stamp, '', tuple(names), (tuple(positions), tuple(velocities), tuple(efforts)))


def forces(**settings: Any) -> Robot:
    """Return a robot with effort commands."""
    return Robot(HardwareSettings(**{**PUSHES, **settings}))


def moves(**settings: Any) -> Robot:
    """Return a configured robot with position commands."""
    robot = Robot(HardwareSettings(**{**MOVES, **settings}))
    robot.configure(Controller(NeedleParameters.preset('phantom')))
    return robot


def push(stamp: int, force: float = 10.0) -> ForceCommand:
    """Return a force command during a motion."""
    return ForceCommand(stamp, force, 0.0, (0.03, 0.01), (0.0, 0.0))


@given(robot=ROBOTS, position=NUMBERS)
def test_position_commands_invert_measurements(robot: Robot, position: float) -> None:
    """A measured position is commanded unchanged, for any sign, scale and zero."""
    settings = robot.settings
    length = robot.length(position)
    assert np.sign(length) == np.sign(settings.sign * (position - settings.zero))
    # Positions up to 1e3 are rounded to 1e-13, a length of them divided by 1e-4 to 1e-9.
    assert length / (settings.sign * settings.scale) + settings.zero == pytest.approx(
        position, abs=1e-9
    )
    # Within the lead of a resting command.
    sent = Robot(HardwareSettings(**MOVES, sign=settings.sign, scale=settings.scale,
                                  zero=settings.zero))  # fmt: skip
    sent.configure(Controller(NeedleParameters.preset('phantom')))
    sent.measurement(state(['insertion'], [position], [0.0]))
    # Rounded as above.
    assert sent.command(push(SECOND, 0.0), length) == pytest.approx([position], abs=1e-9)


@given(robot=ROBOTS, force=NUMBERS, velocity=NUMBERS)
def test_power_is_preserved(robot: Robot, force: float, velocity: float) -> None:
    """Effort times velocity of the robot equals force times velocity of the needle."""
    settings = robot.settings
    measured = robot.measurement(state(['insertion'], [0.0], [velocity]))
    told = forces(sign=settings.sign, scale=settings.scale, zero=settings.zero)
    # Products and quotients of three factors: a few roundings of 1e-16.
    (effort,) = told.command(ForceCommand(0, force), None) or [nan]
    assert effort * velocity == pytest.approx(force * measured.velocity, rel=1e-12, abs=1e-12)
    assert told.force(effort) == pytest.approx(force, rel=1e-12, abs=1e-12)
    read = robot.measurement(state(['insertion'], [0.0], [velocity], [effort]))
    assert read.force == pytest.approx(force, rel=1e-12, abs=1e-12)


@given(st.permutations(['slide', 'a', 'b', 'rotation']))
def test_joint_is_found_by_name(names: list[str]) -> None:
    """In any order and with other joints; only a torque rotates the needle."""
    place = {'slide': 0.03, 'a': 1.0, 'b': nan, 'rotation': 0.5}
    reading = state(names, [place[n] for n in names], [place[n] / 3.0 for n in names])
    for robot, angle in (
        (forces(joint='slide'), 0.0),
        (Robot(HardwareSettings(joint='slide')), 0.5),
    ):
        found = robot.measurement(reading)
        assert (found.depth, found.velocity, found.angle) == (0.03, 0.01, angle)
        assert isnan(found.force)


@pytest.mark.requirement('S-112')
def test_missing_joints_and_velocities_are_named() -> None:
    """With the available joints."""
    with pytest.raises(
        ParameterError, match="no position of the joint 'slide'; positions found: 'a', 'b' "
    ):
        forces(joint='slide').measurement(state(['a', 'b'], [0.0, 1.0], [0.0, 0.0]))
    with pytest.raises(ParameterError, match='positions found: none'):
        forces(joint='slide').measurement(state(['slide'], []))
    for velocities in ([], [nan]):
        with pytest.raises(ParameterError, match="no velocity of 'slide': efforts need it"):
            forces(joint='slide').measurement(state(['slide'], [0.0], velocities))
    with pytest.raises(ParameterError, match="joint 'b'; positions found: 'slide', 'a' "):
        moves(joint='slide', command_joints=('slide', 'b')).measurement(
            state(['slide', 'a', 'b'], [0.0, 1.0, nan])
        )


@pytest.mark.parametrize('velocities', [[], [nan]])
def test_velocity_is_estimated_for_position_commands(velocities: list[float]) -> None:
    """It settles with the time constant of its filter, and restarts after a gap."""
    robot = moves(scale=1e-3)
    period = 1_000_000
    found = [
        robot.measurement(state(['insertion'], [20.0 + 0.01 * k], velocities, stamp=k * period))
        for k in range(100)
    ]
    assert robot.estimates
    assert found[0].velocity == 0.0
    assert found[5].velocity == pytest.approx(0.01 * (1.0 - (5.0 / 6.0) ** 5))
    # After 99 periods (5/6)^99 = 1.4e-8 of the initial error remains.
    assert found[-1].velocity == pytest.approx(0.01, rel=3e-8)
    later = robot.measurement(state(['insertion'], [30.0], velocities, stamp=SECOND))
    assert later.velocity == 0.0
    assert not moves().estimates
    assert moves().measurement(state(['insertion'], [0.02], [0.01])).velocity == 0.01


@pytest.mark.parametrize(('along', 'aside'), [*product(SIGNED, ['', *SIGNED])])
def test_sensor_axes_are_a_proper_rotation(along: str, aside: str) -> None:
    """For each valid pair; the named axes are y and z of the base."""
    if aside and along[-1] == aside[-1]:
        with pytest.raises(ParameterError, match='lateral_axis must be across force_axis'):
            HardwareSettings(force_axis=along, lateral_axis=aside)
        return
    settings = HardwareSettings(force_axis=along, lateral_axis=aside)
    turn = np.zeros((3, 3))
    for row, (axis, sign) in enumerate(settings.axes()):
        turn[row, axis] = sign
    assert np.linalg.det(turn) == pytest.approx(1.0)
    for name, row in ((along, 1), *([(aside, 2)] if aside else [])):
        assert turn[row, 'xyz'.index(name[-1])] == (-1.0 if name[0] == '-' else 1.0)
    values = np.arange(1.0, 7.0)
    for reaction, sign in ((False, 1.0), (True, -1.0)):
        robot = Robot(HardwareSettings(force_axis=along, lateral_axis=aside, reaction=reaction))
        read = robot.wrench(Reading(5, 'tool', (), (tuple(values.tolist()),)))
        np.testing.assert_array_equal(read.values[0][:3], sign * turn @ values[:3])
        np.testing.assert_array_equal(read.values[0][3:], sign * turn @ values[3:])
        assert (read.stamp, read.frame) == (5, 'tool')


def test_default_settings_are_the_contract() -> None:
    """No rotation, offset or scale."""
    robot = Robot(HardwareSettings())
    values = (1.0, -2.0, 3.0, -4.0, 5.0, -6.0)
    assert robot.wrench(Reading(0, 'needle_base', (), (values,))).values == (values,)
    found = robot.measurement(
        state(['insertion', 'rotation'], [0.02, 0.1], [0.3, 0.2], [4.0, 5.0])
    )
    assert (found.depth, found.velocity, found.force) == (0.02, 0.3, 4.0)
    assert (found.angle, found.angular_velocity) == (0.1, 0.2)


def test_dynamic_joint_state_is_converted() -> None:
    """Interfaces in any order and any number; missing values are NaN."""
    reading = dynamic_reading(
        7,
        'world',
        ['gripper', 'slide', 'tool'],
        [
            (['position'], [0.1]),
            (['effort', 'position', 'temperature', 'velocity'], [3.0, 0.02, 300.0, 0.01]),
            ([], []),
        ],
    )
    assert (reading.stamp, reading.frame) == (7, 'world')
    assert reading.names == ('gripper', 'slide', 'tool')
    np.testing.assert_array_equal(
        reading.values, [[0.1, 0.02, nan], [nan, 0.01, nan], [nan, 3.0, nan]]
    )
    found = forces(joint='slide').measurement(reading)
    assert (found.depth, found.velocity, found.force) == (0.02, 0.01, 3.0)


def test_other_joints_get_zero_effort() -> None:
    """In the order of command_joints."""
    robot = forces(joint='slide', command_joints=('a', 'slide', 'b'), sign=-1.0)
    assert robot.command(ForceCommand(0, 3.0), None) == [0.0, -3.0, 0.0]


def test_other_joints_hold_their_position() -> None:
    """The position of the first measurement, until the next activation."""
    robot = moves(joint='slide', command_joints=('a', 'slide'))
    assert robot.command(push(SECOND), None) is None
    robot.measurement(state(['slide', 'a'], [0.02, 1.0], [0.0, 0.0]))
    robot.measurement(state(['slide', 'a'], [0.02, 1.5], [0.0, 0.0]))
    first, second = robot.command(push(SECOND), 0.02) or [nan, nan]
    assert first == 1.0
    assert 0.02 < second < 0.0201
    robot.begin()
    assert robot.command(push(SECOND), None) is None
    robot.measurement(state(['slide', 'a'], [0.03, 2.0], [0.0, 0.0]))
    assert robot.command(push(SECOND, 0.0), 0.03) == [2.0, 0.03]


@pytest.mark.requirement('S-326')
def test_other_joints_hold_where_they_are_after_a_loss() -> None:
    """Also in a stop: a robot that has restarted may have moved all joints."""
    for stopped in (False, True):
        robot = moves(joint='slide', command_joints=('a', 'slide'))
        robot.measurement(state(['slide', 'a'], [0.02, 1.0], [0.0, 0.0]))
        assert robot.command(push(SECOND, 0.0), 0.02) == [1.0, 0.02]
        assert robot.command(ForceCommand(SECOND + 1), None, stopped=stopped) is None
        robot.measurement(state(['slide', 'a'], [0.03, 2.0], [0.0, 0.0]))
        assert robot.command(ForceCommand(SECOND + 2), 0.03, stopped=stopped) == [2.0, 0.03]


@pytest.mark.requirement('S-114')
def test_position_command_rests_without_a_reference() -> None:
    """It holds the last command in a fault, and yields to the robot in a stop.

    Without a known depth there is none: the robot may be anywhere.
    """
    robot = moves(scale=1e-3)
    for k in range(1, 100):
        stamp = SECOND + k * 1_000_000
        robot.measurement(state(['insertion'], [20.0], [0.0], stamp=stamp))
        (last,) = robot.command(push(stamp), 0.02) or [nan]
    assert last == pytest.approx(22.0)
    # A repeated measurement does not stop the motion.
    assert robot.command(ForceCommand(stamp, 10.0), 0.02) == [last]
    assert robot.command(ForceCommand(stamp + 1), 0.02) == [last]
    # In a stop it moves to the robot with 50 mm/s.
    for k in range(1, 100):
        (now,) = robot.command(ForceCommand(stamp + k * 1_000_000), 0.02, stopped=True) or [nan]
        assert 0.0 <= last - now <= 0.05 + 1e-9
        last = now
    assert last == pytest.approx(20.0)
    # Implausible measurements do not change the command.
    stamp += SECOND
    robot.measurement(state(['insertion'], [1e9], [0.0], stamp=stamp + 2))
    assert robot.command(ForceCommand(stamp + 2), None, stopped=True) is None
    assert robot.command(ForceCommand(stamp + 3), 0.02, stopped=True) == pytest.approx([20.0])
    assert robot.command(ForceCommand(stamp + 4), 0.02, stopped=True) == pytest.approx([20.0])


def test_friction_change_applies_at_once() -> None:
    """The virtual base gets the changed friction of the law."""
    phantom, robot = NeedleParameters.preset('phantom'), moves()
    ways = []
    for k, share in enumerate((1.0, 1.0, 2.0)):
        viscous = share * phantom.viscous_friction
        robot.set_model(replace(phantom, coulomb_friction=0.0, viscous_friction=viscous))
        for n in range(50):
            stamp = SECOND + (50 * k + n) * 1_000_000
            robot.measurement(state(['insertion'], [0.02], [0.0], stamp=stamp))
            ways.append((robot.command(push(stamp, 3.0), 0.02) or [])[0])
    assert ways[99] - ways[98] == pytest.approx(3.0 / phantom.viscous_friction * 1e-3, rel=1e-6)
    assert ways[149] - ways[148] == pytest.approx(0.5 * (ways[99] - ways[98]), rel=1e-6)


def test_known_load_does_not_move_the_virtual_base() -> None:
    """The law adds the load to its force; the virtual base excludes it."""
    robot = moves()
    robot.measurement(state(['insertion'], [0.02], [0.0]))
    assert robot.command(push(SECOND, 5.0), 0.02, 5.0) == [0.02]


@pytest.mark.parametrize(
    ('values', 'said'),
    [
        ({'scale': 0.0}, 'hardware.scale must be finite, > 0 m, got 0.0'),
        ({'sign': 0.5}, 'hardware.sign must be 1 or -1, got 0.5'),
        ({'joint': ''}, "hardware.joint must be the name of a joint, got ''"),
        ({'force_axis': 'up'}, "hardware.force_axis must be x, y, z, -x, -y or -z, got 'up'"),
        ({'lateral_axis': '--x'}, 'hardware.lateral_axis must be x, y, z, -x, -y or -z, got'),
        ({'command': 'velocity'}, 'hardware.command must be one of effort, position, got'),
        ({'command_type': 'twist'}, 'hardware.command_type must be one of wrench, float64'),
        ({'command': 'position'}, 'hardware.command_type must be one of float64_multi'),
        (PUSHES | {'command_topic': ''}, "hardware.command_topic must be the driver's topic"),
        ({'state_type': 'x'}, 'hardware.state_type must be one of joint_state, dynamic'),
        ({'stamps': 'now'}, "hardware.stamps must be one of header, receive, got 'now'"),
        ({'command_joints': ['a']}, "hardware.command_joints must have the joint 'insertion'"),
        ({'command_joints': ['insertion'] * 2}, 'hardware.command_joints must have the joint'),
        ({'reaction': 1}, 'hardware.reaction must be true or false, got 1'),
        ({'lead': 0.0}, 'hardware.lead must be finite, > 0 m'),
        ({'state_topc': 'x'}, "unknown parameter 'hardware.state_topc'; did you mean"),
    ],
)  # fmt: skip
def test_invalid_settings_are_rejected_in_one_line(values: dict[str, Any], said: str) -> None:
    """With the invalid and the valid values."""
    with pytest.raises(ParameterError) as raised:
        from_values(HardwareSettings, values, 'hardware.')
    assert str(raised.value).startswith(said)
