# SPDX-License-Identifier: Apache-2.0
"""Zero-order hold, timeout and limits of force commands."""

from __future__ import annotations

from math import inf, nan

from hypothesis import given
from hypothesis import strategies as st
from needle_dynamics.simulated.commands import AppliedForces, Commands
from needle_ros.timing import NANOSECONDS
import pytest

PERIOD = 1_000_000
BEYOND = 'must be within force_limit, 10 N, and torque_limit, 1 N m'
#: A stamp with more digits than a float can hold to the nanosecond.
NOW = 1_700_000_000 * NANOSECONDS + 1


def made(**limits: float) -> Commands:
    return Commands(timeout=0.1, force_limit=10.0, torque_limit=1.0, **limits)


def test_command_acts_from_one_sample_to_the_next() -> None:
    """Zero-order hold: the newest command between two samples acts after the second."""
    commands = made()
    commands.hold(NOW)
    assert commands.acting == AppliedForces()
    assert commands.offer(NOW, 'needle_base', 1.0, 0.1, NOW + 10) == (True, '')
    assert commands.offer(NOW, '', 2.0, 0.2, NOW + 20) == (True, '')
    assert commands.acting == AppliedForces()
    commands.hold(NOW + PERIOD)
    assert commands.acting == AppliedForces(NOW, 2.0, 0.2)
    # No newer command: the command is held.
    commands.hold(NOW + 2 * PERIOD)
    assert commands.acting == AppliedForces(NOW, 2.0, 0.2)


def test_command_expires_at_the_timeout() -> None:
    """It acts while the sample is within the timeout of its stamp, to the nanosecond."""
    commands = made()
    commands.offer(NOW, '', 2.0, 0.0, NOW)
    commands.hold(NOW + 100 * PERIOD)
    assert commands.acting.force == 2.0
    commands.hold(NOW + 100 * PERIOD + 1)
    assert commands.acting == AppliedForces(NOW)


def test_zero_stamp_means_now() -> None:
    """Nodes without a clock can publish commands."""
    commands = made()
    commands.offer(0, '', 2.0, 0.0, NOW)
    assert commands.newest == AppliedForces(NOW, 2.0)


@pytest.mark.requirement('S-086')
@pytest.mark.parametrize('age', [100 * PERIOD + 1, -100 * PERIOD - 1])
def test_commands_with_old_or_future_stamps_are_rejected(age: int) -> None:
    """The command is counted and its age is reported; the held command continues."""
    commands = made()
    commands.offer(NOW, '', 1.0, 0.0, NOW)
    counts, complaint = commands.offer(NOW - age, '', 2.0, 0.0, NOW)
    assert not counts
    when = 'old' if age > 0 else 'ahead'
    assert complaint == f'command ignored, its stamp is 0.100 s {when}: command_timeout is 0.1 s'
    assert commands.newest == AppliedForces(NOW, 1.0)
    assert (commands.stale, commands.refused, commands.overtaken) == (1, 0, 0)


@pytest.mark.requirement('S-067', 'S-091')
def test_out_of_order_commands_are_discarded() -> None:
    """The order of stamps applies, unless the newest stamp is in the future."""
    commands = made()
    commands.offer(NOW, '', 1.0, 0.0, NOW)
    assert commands.offer(NOW - PERIOD, '', 2.0, 0.0, NOW) == (False, '')
    assert commands.newest == AppliedForces(NOW, 1.0)
    assert commands.overtaken == 1
    # The clock was set back by an hour.
    back = NOW - 3600 * NANOSECONDS
    assert commands.offer(back, '', 2.0, 0.0, back) == (True, '')
    assert commands.newest == AppliedForces(back, 2.0)


@pytest.mark.requirement('S-032', 'S-086')
@pytest.mark.parametrize(
    ('frame', 'force', 'torque', 'complaint'),
    [
        ('needle_entry', 1.0, 0.0, "must be in needle_base, got 'needle_entry'"),
        ('', nan, 0.0, f'{BEYOND}, got nan N and 0.0 N m'),
        ('', 0.0, inf, f'{BEYOND}, got 0.0 N and inf N m'),
        ('', -10.1, 0.0, f'{BEYOND}, got -10.1 N and 0.0 N m'),
    ],
)
def test_invalid_command_sets_zero_force(
    frame: str, force: float, torque: float, complaint: str
) -> None:
    """It replaces an older command."""
    commands = made()
    commands.offer(NOW, '', 1.0, 0.0, NOW)
    said = f'a command {complaint}; no force is applied'
    assert commands.offer(NOW + 1, frame, force, torque, NOW) == (True, said)
    commands.hold(NOW + PERIOD)
    assert commands.acting == AppliedForces(NOW + 1)
    assert commands.refused == 1


@pytest.mark.requirement('S-079')
def test_no_force_acts_with_several_command_publishers() -> None:
    """From the detection until the next command of the remaining publisher."""
    commands = made()
    commands.offer(NOW, '', 1.0, 0.0, NOW)
    assert not commands.count_commanders(1)
    assert commands.count_commanders(3)
    assert commands.duplicates == 2
    commands.hold(NOW + PERIOD)
    assert commands.acting == AppliedForces(NOW)
    commands.offer(NOW + PERIOD, '', 1.0, 0.0, NOW + PERIOD)
    assert commands.newest == AppliedForces(NOW + PERIOD)
    assert commands.count_commanders(1)
    commands.offer(NOW + 2 * PERIOD, '', 1.0, 0.0, NOW + 2 * PERIOD)
    assert commands.newest.force == 1.0


@pytest.mark.requirement('S-033')
@given(st.lists(st.floats(-10.0, 10.0), min_size=1, max_size=30))
def test_force_growth_is_rate_limited_and_release_is_immediate(forces: list[float]) -> None:
    """From one sample to the next; the force may cross zero and grow from there."""
    commands, growth = made(interval=1e-3, force_rate_limit=2000.0), 2.0
    before = 0.0
    for k, force in enumerate(forces):
        stamp = NOW + k * PERIOD
        commands.offer(stamp, '', force, 0.5, stamp)
        commands.hold(stamp)
        held = commands.acting
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
    assert commands.acting.force == 0.0


@pytest.mark.requirement('S-034')
def test_no_force_acts_above_the_energy_limit() -> None:
    """5 N at 0.4 m/s are 2 W: above 1 J within a second, until the energy is half of it."""
    commands = made(interval=1e-3, power_limit=1.0)
    acted, spent = [], 0.0
    for k in range(4000):
        stamp = NOW + k * PERIOD
        commands.offer(stamp, '', 5.0, 0.0, stamp)
        distance = 0.4e-3 if commands.acting.force else 0.0
        spent += commands.acting.force * distance
        commands.hold(stamp, distance)
        acted.append(commands.acting.force == 5.0)
        assert commands.exhausted != acted[-1]
    first = acted.index(False)
    # 2 W (1 - exp(-t)) is 1 J at ln 2; then it halves in ln 2.
    assert first == pytest.approx(693, abs=2)
    assert acted.index(True, first) - first == pytest.approx(693, abs=2)
    # The decay within a second is at most the permitted energy.
    assert spent <= 1.0 + 4.0 * 1.0
    # Motion of the needle against the force supplies no energy.
    commands = made(interval=1e-3, power_limit=1e-9)
    commands.offer(NOW, '', 5.0, 0.0, NOW)
    commands.hold(NOW, 0.0)
    commands.hold(NOW, -1.0)
    assert not commands.exhausted


@pytest.mark.requirement('S-094')
def test_no_command_acts_for_the_timeout_after_a_short_lived_publisher() -> None:
    """Its commands may arrive late, and expire within the timeout."""
    commands = made()
    commands.offer(NOW, '', 1.0, 0.0, NOW)
    commands.ignore(NOW)
    assert commands.newest == AppliedForces(NOW)
    for k, acts in ((1, False), (99, False), (100, True)):
        at = NOW + k * PERIOD
        commands.offer(at, '', 2.0, 0.0, at)
        assert (commands.newest.force == 2.0) == acts


@pytest.mark.requirement('S-017')
def test_no_command_acts_during_a_stop() -> None:
    """A force ends at once, and a later command acts only after the stop."""
    commands = made()
    commands.offer(NOW, '', 2.0, 0.2, NOW)
    commands.stop()
    commands.hold(NOW)
    assert commands.acting == AppliedForces(NOW)
    commands.offer(NOW + 1, '', 2.0, 0.2, NOW + 1)
    commands.hold(NOW + 1)
    assert commands.acting == AppliedForces(NOW + 1)
    commands.stopped = False
    commands.hold(NOW + 2)
    assert commands.acting == AppliedForces(NOW + 1)
    commands.offer(NOW + 3, '', 2.0, 0.2, NOW + 3)
    commands.hold(NOW + 3)
    assert commands.acting == AppliedForces(NOW + 3, 2.0, 0.2)


def test_reset_and_activation_discard_commands() -> None:
    """After a reset older commands are still discarded; an activation starts without history."""
    commands = made()
    commands.offer(NOW, '', 1.0, 0.0, NOW)
    commands.hold(NOW)
    commands.forget()
    assert commands.acting == commands.newest == AppliedForces(NOW)
    assert commands.offer(NOW - 1, '', 1.0, 0.0, NOW) == (False, '')
    commands.begin()
    assert commands.acting == commands.newest == AppliedForces()


@pytest.mark.requirement('S-095')
def test_force_without_the_stamp_of_a_sample_is_rejected() -> None:
    """Until the number of publishers changes, so that another node may take over."""
    commands = made()
    commands.count_commanders(1)
    # No response to a sample yet: manual commands may have any stamp.
    assert commands.offer(NOW + 5, '', 1.0, 0.0, NOW + 10) == (True, '')
    commands.hold(NOW + PERIOD)
    assert commands.offer(NOW + PERIOD, '', 2.0, 0.0, NOW + PERIOD + 10) == (True, '')
    for stamp in (0, NOW + PERIOD + 20):
        counts, complaint = commands.offer(stamp, '', 9.0, 0.0, NOW + PERIOD + 30)
        assert not counts
        assert 'its stamp matches no sample' in complaint
    assert commands.newest.force == 2.0
    assert commands.refused == 2
    # A release of the force is always accepted: a stop command needs no sample.
    assert commands.offer(0, '', 0.0, 0.0, NOW + PERIOD + 40) == (True, '')
    for change in (lambda: commands.count_commanders(0), lambda: commands.ignore(NOW + PERIOD)):
        commands.hold(NOW + 2 * PERIOD)
        commands.offer(NOW + 2 * PERIOD, '', 1.0, 0.0, NOW + 2 * PERIOD + 10)
        assert not commands.offer(0, '', 9.0, 0.0, NOW + 2 * PERIOD + 20)[0]
        change()
        assert commands.offer(0, '', 3.0, 0.0, NOW + 2 * PERIOD + 30)[0]


def test_samples_can_be_answered_within_the_timeout() -> None:
    """An older response is stale; a response from before a clock reset is rejected."""
    commands = made()
    for k in range(300):
        commands.hold(NOW + k * PERIOD)
    now = NOW + 299 * PERIOD
    assert commands.offer(NOW + 250 * PERIOD, '', 1.0, 0.0, now)[0]
    assert 'its stamp is' in commands.offer(NOW + 150 * PERIOD, '', 1.0, 0.0, now)[1]
    commands.hold(NOW)
    assert not commands.offer(NOW + 40 * PERIOD, '', 1.0, 0.0, NOW)[0]
