"""From when and how long a command acts."""

from __future__ import annotations

from math import inf, nan

from hypothesis import given
from hypothesis import strategies as st
from needle_dynamics.simulated.commands import Command, Commands
from needle_ros.timing import NANOSECONDS
import pytest

PERIOD = 1_000_000
BEYOND = 'must be within force_limit, 10 N, and torque_limit, 1 N m'
#: A stamp that a float could not hold to the nanosecond.
NOW = 1_700_000_000 * NANOSECONDS + 1


def made(**limits: float) -> Commands:
    return Commands(timeout=0.1, force_limit=10.0, torque_limit=1.0, **limits)


def test_a_command_acts_from_the_next_sample_to_the_one_after() -> None:
    """A zero-order hold: whatever comes between two samples, the newest acts after the second."""
    commands = made()
    commands.hold(NOW)
    assert commands.held == Command()
    assert commands.offer(NOW, 'needle_base', 1.0, 0.1, NOW + 10) == (True, '')
    assert commands.offer(NOW, '', 2.0, 0.2, NOW + 20) == (True, '')
    assert commands.held == Command()
    commands.hold(NOW + PERIOD)
    assert commands.held == Command(NOW, 2.0, 0.2)
    # Nothing newer has come: it goes on.
    commands.hold(NOW + 2 * PERIOD)
    assert commands.held == Command(NOW, 2.0, 0.2)


def test_a_command_ends_at_the_timeout() -> None:
    """It acts as long as a sample is within the timeout of its stamp, to the nanosecond."""
    commands = made()
    commands.offer(NOW, '', 2.0, 0.0, NOW)
    commands.hold(NOW + 100 * PERIOD)
    assert commands.held.force == 2.0
    commands.hold(NOW + 100 * PERIOD + 1)
    assert commands.held == Command(NOW)


def test_an_empty_stamp_is_now() -> None:
    """A node that has no clock may command too."""
    commands = made()
    commands.offer(0, '', 2.0, 0.0, NOW)
    assert commands.newest == Command(NOW, 2.0)


@pytest.mark.parametrize('age', [100 * PERIOD + 1, -100 * PERIOD - 1])
def test_a_command_that_is_too_old_or_early_does_not_count(age: int) -> None:
    """It is counted, and the age is said; what acts goes on."""
    commands = made()
    commands.offer(NOW, '', 1.0, 0.0, NOW)
    counts, complaint = commands.offer(NOW - age, '', 2.0, 0.0, NOW)
    assert not counts
    when = 'old' if age > 0 else 'ahead'
    assert complaint == f'command ignored, its stamp is 0.100 s {when}: command_timeout is 0.1 s'
    assert commands.newest == Command(NOW, 1.0)
    assert (commands.stale, commands.refused, commands.overtaken) == (1, 0, 0)


def test_a_command_that_was_overtaken_does_not_count() -> None:
    """The order of stamps decides, not that of arrival; unless the newest is of the future."""
    commands = made()
    commands.offer(NOW, '', 1.0, 0.0, NOW)
    assert commands.offer(NOW - PERIOD, '', 2.0, 0.0, NOW) == (False, '')
    assert commands.newest == Command(NOW, 1.0)
    assert commands.overtaken == 1
    # The clock was set back by an hour.
    back = NOW - 3600 * NANOSECONDS
    assert commands.offer(back, '', 2.0, 0.0, back) == (True, '')
    assert commands.newest == Command(back, 2.0)


@pytest.mark.parametrize(
    ('frame', 'force', 'torque', 'complaint'),
    [
        ('needle_entry', 1.0, 0.0, "must be in needle_base, got 'needle_entry'"),
        ('', nan, 0.0, f'{BEYOND}, got nan N and 0.0 N m'),
        ('', 0.0, inf, f'{BEYOND}, got 0.0 N and inf N m'),
        ('', -10.1, 0.0, f'{BEYOND}, got -10.1 N and 0.0 N m'),
    ],
)
def test_an_invalid_command_is_no_force(
    frame: str, force: float, torque: float, complaint: str
) -> None:
    """It counts, so that an older one does not act any longer."""
    commands = made()
    commands.offer(NOW, '', 1.0, 0.0, NOW)
    said = f'a command {complaint}; no force is applied'
    assert commands.offer(NOW + 1, frame, force, torque, NOW) == (True, said)
    commands.hold(NOW + PERIOD)
    assert commands.held == Command(NOW + 1)
    assert commands.refused == 1


def test_while_several_nodes_command_no_force_acts() -> None:
    """From the time on that it is seen, until the next command of the last one."""
    commands = made()
    commands.offer(NOW, '', 1.0, 0.0, NOW)
    assert not commands.count_commanders(1)
    assert commands.count_commanders(3)
    assert commands.rivals == 2
    commands.hold(NOW + PERIOD)
    assert commands.held == Command(NOW)
    commands.offer(NOW + PERIOD, '', 1.0, 0.0, NOW + PERIOD)
    assert commands.newest == Command(NOW + PERIOD)
    assert commands.count_commanders(1)
    commands.offer(NOW + 2 * PERIOD, '', 1.0, 0.0, NOW + 2 * PERIOD)
    assert commands.newest.force == 1.0


@given(st.lists(st.floats(-10.0, 10.0), min_size=1, max_size=30))
def test_a_force_grows_no_faster_than_it_may_and_ends_at_once(forces: list[float]) -> None:
    """From one sample to the next; through zero it may go, and grow from there."""
    commands, growth = made(interval=1e-3, force_rate_limit=2000.0), 2.0
    before = 0.0
    for k, force in enumerate(forces):
        stamp = NOW + k * PERIOD
        commands.offer(stamp, '', force, 0.5, stamp)
        commands.hold(stamp)
        held = commands.held
        assert (held.stamp, held.torque) == (stamp, 0.5)
        assert abs(held.force) <= max(abs(force), 0.0)
        if abs(force) <= abs(before) and force * before >= 0.0:
            assert held.force == force
        elif force * before >= 0.0:
            # The numbers have 16 digits.
            assert abs(held.force) == pytest.approx(min(abs(force), abs(before) + growth), 1e-12)
        else:
            assert abs(held.force) == pytest.approx(min(abs(force), growth), 1e-12)
        before = held.force
    commands.hold(NOW + 1000 * PERIOD)
    assert commands.held.force == 0.0


def test_no_force_acts_while_more_energy_was_put_in_than_may_be() -> None:
    """5 N at 0.4 m/s are 2 W: after 1 J within less than a second, until it is half of that."""
    commands = made(interval=1e-3, power_limit=1.0)
    acted, spent = [], 0.0
    for k in range(4000):
        stamp = NOW + k * PERIOD
        commands.offer(stamp, '', 5.0, 0.0, stamp)
        distance = 0.4e-3 if commands.held.force else 0.0
        spent += commands.held.force * distance
        commands.hold(stamp, distance)
        acted.append(commands.held.force == 5.0)
        assert commands.exhausted != acted[-1]
    first = acted.index(False)
    # 2 W (1 - exp(-t)) is 1 J at ln 2; then it halves in ln 2.
    assert first == pytest.approx(693, abs=2)
    assert acted.index(True, first) - first == pytest.approx(693, abs=2)
    # What is forgotten in a second is at most what may be put in.
    assert spent <= 1.0 + 4.0 * 1.0
    # Being moved puts nothing in, nor does what the needle gives back.
    commands = made(interval=1e-3, power_limit=1e-9)
    commands.offer(NOW, '', 5.0, 0.0, NOW)
    commands.hold(NOW, 0.0)
    commands.hold(NOW, -1.0)
    assert not commands.exhausted


def test_after_somebody_came_and_went_no_command_acts_for_the_timeout() -> None:
    """What they said may come late, and is over by then."""
    commands = made()
    commands.offer(NOW, '', 1.0, 0.0, NOW)
    commands.hush(NOW)
    assert commands.newest == Command(NOW)
    for k, acts in ((1, False), (99, False), (100, True)):
        at = NOW + k * PERIOD
        commands.offer(at, '', 2.0, 0.0, at)
        assert (commands.newest.force == 2.0) == acts


def test_what_was_commanded_is_forgotten() -> None:
    """At a reset older commands still do not count; at an activation nothing is known."""
    commands = made()
    commands.offer(NOW, '', 1.0, 0.0, NOW)
    commands.hold(NOW)
    commands.forget()
    assert commands.held == commands.newest == Command(NOW)
    assert commands.offer(NOW - 1, '', 1.0, 0.0, NOW) == (False, '')
    commands.begin()
    assert commands.held == commands.newest == Command()


def test_a_force_that_answers_no_sample_is_of_another_node() -> None:
    """Until the number of nodes changes, or one has come and gone: so another may take over."""
    commands = made()
    commands.count_commanders(1)
    # Nobody has answered yet: a user by hand may stamp as he likes.
    assert commands.offer(NOW + 5, '', 1.0, 0.0, NOW + 10) == (True, '')
    commands.hold(NOW + PERIOD)
    assert commands.offer(NOW + PERIOD, '', 2.0, 0.0, NOW + PERIOD + 10) == (True, '')
    for stamp in (0, NOW + PERIOD + 20):
        counts, complaint = commands.offer(stamp, '', 9.0, 0.0, NOW + PERIOD + 30)
        assert not counts
        assert 'its stamp is that of no sample' in complaint
    assert commands.newest.force == 2.0
    assert commands.refused == 2
    # Letting go is nobody's harm: a stop is not of a sample.
    assert commands.offer(0, '', 0.0, 0.0, NOW + PERIOD + 40) == (True, '')
    for change in (lambda: commands.count_commanders(0), lambda: commands.hush(NOW + PERIOD)):
        commands.hold(NOW + 2 * PERIOD)
        commands.offer(NOW + 2 * PERIOD, '', 1.0, 0.0, NOW + 2 * PERIOD + 10)
        assert not commands.offer(0, '', 9.0, 0.0, NOW + 2 * PERIOD + 20)[0]
        change()
        assert commands.offer(0, '', 3.0, 0.0, NOW + 2 * PERIOD + 30)[0]


def test_samples_may_be_answered_for_the_timeout() -> None:
    """An older answer is stale; one of a clock that was set back is no answer."""
    commands = made()
    for k in range(300):
        commands.hold(NOW + k * PERIOD)
    now = NOW + 299 * PERIOD
    assert commands.offer(NOW + 250 * PERIOD, '', 1.0, 0.0, now)[0]
    assert 'its stamp is' in commands.offer(NOW + 150 * PERIOD, '', 1.0, 0.0, now)[1]
    commands.hold(NOW)
    assert not commands.offer(NOW + 40 * PERIOD, '', 1.0, 0.0, NOW)[0]
