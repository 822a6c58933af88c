# SPDX-License-Identifier: Apache-2.0
"""Parsing of `joint_commands` messages and their effect on a plant."""

from __future__ import annotations

from itertools import pairwise
from math import inf, isnan, nan
from typing import Any

from hypothesis import given
from hypothesis import strategies as st
from needle_dynamics.simulated.commands import JointCommands, JointSetpoints
from needle_dynamics.simulated.run import Event, MOTION, PlantRun, RESET
from needle_ros.errors import ParameterError
from needle_ros.system_state import Mode
from needle_ros.timing import NANOSECONDS
from needle_ros.wire import Reading
import pytest

PERIOD = NANOSECONDS // 1000
START = 1_700_000_000 * NANOSECONDS
BOTH = ('insertion', 'guide_x')
Values = tuple[float, ...]


def message(
    stamp: int,
    names: tuple[str, ...],
    position: Values = (),
    velocity: Values = (),
    effort: Values = (),
) -> Reading:
    """Return a message as sent by the hardware interface."""
    return Reading(stamp, '', names, (position, velocity, effort))


def reader(mode: str, steered: bool = False) -> JointCommands:
    return JointCommands(mode, steered=steered, shortest=1e-3, longest=0.1)


def asked(commands: JointCommands, *arguments: Any, at: float = 0.05) -> tuple[Any, ...]:
    """Return force, torque and motions of an accepted message."""
    found = commands.read(message(*arguments), {'insertion': at}, START)
    commands.accept(found)
    return found.force, found.torque, found.motions


# Reading.


def test_unset_values_have_no_effect() -> None:
    """Before a controller is active all values are NaN; a number must remain a number."""
    commands = reader('simulation')
    names = ('insertion', 'rotation')
    assert asked(commands, START, names, (), (), (nan, nan)) == (0.0, 0.0, [])
    assert asked(commands, START, names, (), (), (2.0, nan)) == (2.0, 0.0, [])
    force, torque, _ = asked(commands, START, names, (), (), (nan, nan))
    assert isnan(force)
    assert torque == 0.0
    commands.forget()
    assert asked(commands, START, names, (), (), (nan, nan)) == (0.0, 0.0, [])


def test_position_is_reached_within_the_message_interval() -> None:
    """The message interval is limited to a period of the plant and the timeout."""
    commands = reader('robot')
    steps = [(0, 0.1), (10 * PERIOD, 0.01), (10 * PERIOD, 1e-3), (900 * PERIOD, 0.1)]
    for k, (after, within) in enumerate(steps):
        goal = {'insertion': 0.05 + 1e-4 * k}
        _, _, motions = asked(commands, START + after, ('insertion',), tuple(goal.values()))
        (motion,) = motions
        assert motion.goals == goal
        assert motion.within == pytest.approx(within)
    # A repeated position has no effect.
    assert asked(commands, START + 901 * PERIOD, ('insertion',), (0.05 + 3e-4,))[2] == []


def test_velocity_without_position_lasts_for_the_timeout() -> None:
    """The motion starts at the present position; a zero velocity is sent once."""
    commands = reader('robot')
    assert asked(commands, START, ('insertion',), (), (0.0,))[2] == []
    for _ in range(2):
        _, _, motions = asked(commands, START, ('insertion',), (), (0.01,))
        (motion,) = motions
        assert motion.goals == pytest.approx({'insertion': 0.051})
        assert motion.within == 0.1
    _, _, motions = asked(commands, START, ('insertion',), (), (0.0,))
    assert motions == [JointSetpoints({'insertion': 0.05}, 0.1)]
    assert asked(commands, START, ('insertion',), (), (0.0,))[2] == []
    # With a position the velocity has no effect.
    _, _, motions = asked(commands, START, ('insertion',), (0.06,), (0.01,))
    assert [motion.goals for motion in motions] == [{'insertion': 0.06}]


@pytest.mark.parametrize(
    ('mode', 'steered', 'arguments', 'complaint'),
    [
        ('simulation', False, (BOTH, (), (), (1.0,)), 'one for each of its 2 joints, got 1'),
        ('simulation', False, (('a', 'a'), (), (), (1.0, 1.0)), 'names a joint twice: a, a'),
        ('simulation', False, (('insertion',), (0.1,)), 'position 0.1 of insertion.* no joint'),
        ('robot', False, (('insertion',), (nan,), (), (2.0,)), 'effort 2 of insertion.* no joint'),
        ('robot', False, (BOTH, (0.1, 0.0)), 'position 0 of guide_x.* it for insertion'),
        ('indenter', False, (('x',), (), (), (1.0,)), 'effort 1 of x.* for no joint'),
        ('simulation', True, (('rotation',), (), (), (0.1,)), 'effort 0.1 of ro.* for insertion'),
    ],
)
def test_unsupported_commands_are_rejected(
    mode: str, steered: bool, arguments: tuple[Any, ...], complaint: str
) -> None:
    with pytest.raises(ParameterError, match=complaint):
        reader(mode, steered).read(message(START, *arguments), {}, START)


def test_zero_values_after_the_end_of_a_controller_have_no_effect() -> None:
    """Zeros are accepted for interfaces that the plant does not use."""
    commands = reader('robot')
    assert asked(commands, START, ('insertion',), (nan,), (0.0,), (0.0,)) == (0.0, 0.0, [])


# Acting.


def run(**values: Any) -> PlantRun:
    return PlantRun({'needle': 'phantom', 'depth': 0.05, **values})


def drive(plant: PlantRun, samples: int, every: int, say: Any) -> list[float]:
    """Take samples with a message every ``every`` samples; return the depth at each sample."""
    depths = []
    for k in range(samples):
        stamp = START + k * PERIOD
        plant.take(stamp)
        depths.append(plant.plant.depth)
        if k % every == 0:
            now = stamp + PERIOD // 3
            plant.command_joints(say(now, k / 1000.0), now)
    return depths


@pytest.mark.requirement('S-303')
def test_setpoints_after_a_stop_are_followed_from_the_joint_on() -> None:
    """A driver that does not know the stop moves on; its next trajectory begins at the joint."""
    plant = run(mode='robot')

    def setpoint(depth: float) -> Any:
        return lambda now, _time: message(now, ('insertion',), (depth,))

    drive(plant, 500, 1, lambda now, time: message(now, ('insertion',), (0.05 + 0.01 * time,)))
    plant.halt()
    plant.commands.stopped = True
    drive(plant, 300, 1, setpoint(0.056))
    plant.commands.stopped = False
    rest = plant.plant.depth
    # The counts of the encoder are 1 um.
    assert drive(plant, 500, 1, setpoint(0.06))[-1] == pytest.approx(rest, abs=1e-6)
    drive(plant, 100, 1, setpoint(rest))
    # The position error decays with 20 1/s; a count more.
    assert drive(plant, 1500, 1, setpoint(0.06))[-1] == pytest.approx(0.06, abs=2e-6)


def test_setpoint_of_a_pause_is_followed_after_it() -> None:
    """Also one that does not change any more."""
    plant = run(mode='robot')

    def setpoint(now: int, _time: float) -> Reading:
        return message(now, ('insertion',), (0.055,))

    plant.mode = Mode.PAUSED
    # The counts of the encoder are 1 um.
    assert drive(plant, 300, 1, setpoint)[-1] == pytest.approx(0.05, abs=1e-6)
    plant.mode = Mode.RUNNING
    # The position error decays with 20 1/s; a count more.
    assert drive(plant, 1500, 1, setpoint)[-1] == pytest.approx(0.055, abs=2e-6)


@pytest.mark.parametrize('every', [1, 5, 10, 50])
def test_base_follows_positions_at_any_message_rate(every: int) -> None:
    """At a message rate below the sample rate it lags by one message, and arrives."""
    speed, plant = 0.01, run(mode='robot')

    def say(now: int, time: float) -> Reading:
        return message(now, ('insertion',), (0.05 + speed * min(time, 1.0),))

    depths = drive(plant, 2000, every, say)
    # In the middle, without start and stop; friction has no effect on the base.
    behind = [0.05 + speed * k / 1000.0 - depths[k] for k in range(500, 900)]
    assert min(behind) + 1e-6 >= 0.0
    assert max(behind) <= speed * (2 * every + 1) / 1000.0
    assert abs(depths[-1] - 0.06) < 1e-6
    steps = [b - a for a, b in pairwise(depths[500:900])]
    assert max(steps) < 1.2e-3 * speed


def test_velocity_is_held_and_ends_after_the_last_message() -> None:
    plant = run(mode='robot')
    depths = drive(plant, 500, 10, lambda now, _: message(now, ('insertion',), (), (0.02,)))
    assert depths[499] - depths[399] == pytest.approx(0.002, rel=1e-3)
    depths = drive(plant, 1000, 1000, lambda now, _: message(now - 10**12, ('insertion',)))
    # For the timeout of 0.1 s plus the braking distance.
    assert 0.001 < depths[-1] - depths[0] < 0.0025
    assert depths[-1] == pytest.approx(depths[-100], abs=1e-7)


@pytest.mark.requirement('S-092')
def test_force_is_held_and_ends_after_the_last_message() -> None:
    """At a tenth of the rate the velocity is (f - mu_s) / mu_v, and finally zero."""
    plant = run()
    names = ('insertion', 'rotation')
    drive(plant, 500, 10, lambda now, _: message(now, names, (), (), (3.56, nan)))
    assert plant.commands.acting.force == 3.56
    before = plant.plant.depth
    drive(plant, 100, 10, lambda now, _: message(now, names, (), (), (3.56, nan)))
    assert plant.plant.depth - before == pytest.approx(0.001, rel=0.02)
    for k in range(102):
        plant.take(START + (100 + k) * PERIOD)
    assert plant.commands.acting.force == 0.0


@pytest.mark.requirement('S-092')
@pytest.mark.parametrize('value', [nan, inf, -16.0])
def test_invalid_forces_are_rejected(value: float) -> None:
    """The force is counted and reported, and the previous force ends."""
    plant = run()
    plant.take(START)
    say = lambda force, k: plant.command_joints(  # noqa: E731
        message(START + k, ('insertion',), (), (), (force,)), START + k
    )
    assert say(3.0, 1) == (True, '')
    assert plant.commands.newest.force == 3.0
    counts, complaint = say(value, 2)
    assert counts
    assert 'must be within force_limit, 15 N' in complaint
    assert (plant.commands.newest.force, plant.commands.refused) == (0.0, 1)
    # It is rejected in every message.
    assert say(value, 3)[1]
    assert say(3.0, 4) == (True, '')
    assert plant.commands.newest.force == 3.0


def test_position_out_of_range_rejects_the_whole_message() -> None:
    """The force is rejected too, and the guide does not move."""
    plant = run(steered=True, needle='bending_35mm')
    plant.take(START)
    names, efforts = ('insertion', 'guide_x'), (2.0, nan)
    say = lambda x, k: plant.command_joints(  # noqa: E731
        message(START + k, names, (nan, x), (), efforts), START + k
    )
    assert say(0.001, 1) == (True, '')
    assert plant.commands.newest.force == 2.0
    counts, complaint = say(0.03, 2)
    assert counts
    assert 'joint_commands: guide_x must stay in [-0.02, 0.02] m' in complaint
    assert (plant.commands.newest.force, plant.commands.refused) == (0.0, 1)
    assert say(0.002, 3) == (True, '')
    events = [event for event in plant.events() if event.kind == MOTION]
    assert [event.content['positions'] for event in events] == [[[0.001]], [[0.002]]]


def test_nothing_moves_with_two_command_publishers() -> None:
    """Neither force nor position acts; the position acts after the other publisher has gone."""
    plant = run(mode='robot')
    plant.take(START)
    plant.commands.count_commanders(2)
    assert plant.command_joints(message(START, ('insertion',), (0.06,)), START) == (True, '')
    assert all(event.kind != MOTION for event in plant.events())
    plant.commands.count_commanders(1)
    plant.command_joints(message(START + 1, ('insertion',), (0.06,)), START + 1)
    assert [event.kind for event in plant.events()] == [MOTION]


def test_repeated_commands_act_again_after_a_reset() -> None:
    plant = run(mode='robot')
    say = lambda: plant.command_joints(  # noqa: E731
        message(START, ('insertion',), (0.06,)), START
    )
    plant.take(START)
    say()
    say()
    plant.perform(Event(RESET))
    say()
    assert [e.kind for e in plant.events()][1:] == ['time', MOTION, RESET, MOTION]


@given(
    st.lists(
        st.tuples(
            st.sampled_from(['insertion', 'guide_x', 'roll', 'rotation', 'other']),
            *[st.floats()] * 3,
        ),
        max_size=4,
    ),
    st.tuples(*[st.booleans()] * 3),
    st.sampled_from([('simulation', False), ('simulation', True), ('robot', True)]),
)
def test_arbitrary_messages_give_finite_forces_and_positions_in_range(
    joints: list[tuple[str, float, float, float]],
    filled: tuple[bool, bool, bool],
    kind: tuple[str, bool],
) -> None:
    """Forces stay within their limit and joint targets within their range."""
    plant = _PLANTS[kind]
    names, *columns = zip(*joints, strict=True) if joints else ((), (), (), ())
    values = tuple(
        tuple(column) if full else () for column, full in zip(columns, filled, strict=True)
    )
    plant.begin()
    counts, _ = plant.command_joints(Reading(START, '', tuple(names), values), START)
    assert counts
    assert abs(plant.commands.newest.force) <= 15.0
    for event in plant.events():
        if event.kind == MOTION:
            for joint, at in zip(
                event.content['joints'], event.content['positions'][0], strict=True
            ):
                assert abs(at) <= {'roll': 100.0, 'guide_x': 0.02}.get(joint, 0.2)


_PLANTS = {
    (mode, steered): run(mode=mode, steered=steered, needle='bending_35mm')
    for mode, steered in (('simulation', False), ('simulation', True), ('robot', True))
}
