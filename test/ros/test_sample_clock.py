# SPDX-License-Identifier: Apache-2.0
"""Schedule of simulation samples."""

from itertools import pairwise

from hypothesis import given, settings
from hypothesis import strategies as st
from needle_ros.errors import JobError
from needle_ros.sample_clock import SampleClock
from needle_ros.timing import NANOSECONDS
import pytest

#: Initial time of the clock, which is never zero [ns].
BEGIN = 1_700_000_000 * NANOSECONDS


def make(
    rate: float = 1000.0,
    factor: float = 1.0,
    backlog: float = 0.5,
    own: bool = False,
    lockstep: bool = False,
) -> SampleClock:
    """Return a started clock."""
    clock = SampleClock(rate, factor, backlog, own=own, lockstep=lockstep)
    clock.begin(BEGIN)
    return clock


def take(clock: SampleClock, now: int) -> list[int]:
    """Take all due samples; return their stamps."""
    return [clock.take() for _ in range(clock.due(now))]


ticks = st.lists(st.integers(0, 300_000_000), min_size=1, max_size=60)


@given(ticks, st.sampled_from([30.0, 100.0, 1000.0]), st.sampled_from([0.5, 1.0, 7.0]))
@settings(max_examples=60)
def test_samples_are_at_multiples_of_the_period_and_never_early(
    steps: list[int], rate: float, factor: float
) -> None:
    """For any delay of the checks, no sample is missing, repeated, or early."""
    clock = make(rate, factor, own=True)
    now, stamps = BEGIN, []
    for step in steps:
        now += step
        stamps += take(clock, now)
    assert stamps == [BEGIN + round((k + 1) / rate * NANOSECONDS) for k in range(len(stamps))]
    # Rounding of 1 ns.
    assert not stamps or stamps[-1] <= BEGIN + (now - BEGIN) * factor + 1


@given(ticks)
@settings(max_examples=60)
def test_samples_beyond_the_backlog_are_dropped(steps: list[int]) -> None:
    """The newest stamp is within a period of now; each sample is taken or counted as lost."""
    clock = make(100.0, backlog=0.1)
    now, taken = BEGIN, 0
    for step in steps:
        now += step
        due = clock.due(now)
        assert due <= 10
        for _ in range(due):
            taken += 1
            assert clock.take() <= now + 1
    # Rounding of 1 ns at each loss of samples.
    assert now - clock.stamp < NANOSECONDS / 100.0 + len(steps) + 1
    assert taken + clock.lost == pytest.approx((now - BEGIN) / 1e7, abs=1.0)


def test_independent_time_waits_after_a_stall() -> None:
    """Half of a stall of 1 s is made up in bursts; the rest delays simulated time."""
    clock = make(own=True)
    stamps = []
    for k in range(1000):
        stamps += take(clock, BEGIN + NANOSECONDS + k * 1_000_000)
    assert clock.waited == pytest.approx(0.5 * NANOSECONDS, abs=2e6)
    assert clock.lost == 0
    assert {b - a for a, b in pairwise(stamps)} == {1_000_000}


def test_maximum_speed_is_independent_of_the_clock() -> None:
    """Samples are due at once, limited to the burst size of subscribers."""
    clock = make(factor=0.0)
    stamps = [stamp for _ in range(10) for stamp in take(clock, BEGIN)]
    assert len(stamps) == 200
    assert stamps[-1] == BEGIN + 200_000_000


@pytest.mark.parametrize('factor', [0.0, 1.0])
def test_lockstep_waits_for_the_command_of_each_sample(factor: float) -> None:
    """Time starts at zero and advances by one sample per matching command."""
    clock = make(factor=factor, lockstep=True)
    now = BEGIN
    for k in range(1, 50):
        now += 5_000_000
        assert take(clock, now) == [k * 1_000_000]
        assert take(clock, now + 50_000_000) == []
        clock.answered(k * 1_000_000 - 1)
        assert take(clock, now + 50_000_000) == []
        assert clock.awaited == clock.simulated(now) == k * 1_000_000
        clock.answered(k * 1_000_000)
    assert clock.lost == 0


def test_lockstep_waits_for_all_processing_nodes() -> None:
    """A command and two nodes, in any order; a repeated response counts once."""
    clock = make(lockstep=True)
    clock.participants = 2
    (stamp,) = take(clock, BEGIN + 1_000_000)
    later = BEGIN + 2_000_000
    for by in ('steering', 'steering', 'demo'):
        clock.answered(stamp, by)
        assert take(clock, later) == []
    assert clock.missing == 'no command has answered'
    clock.answered(stamp)
    assert clock.awaited is None
    (stamp,) = take(clock, later)
    clock.answered(stamp)
    clock.answered(stamp - 1_000_000, 'steering')
    assert clock.awaited == stamp
    assert clock.missing == '0 of 2 nodes have processed'
    # Both nodes have left.
    clock.participants = 0
    assert take(clock, later + 1_000_000) == [stamp + 1_000_000]


@pytest.mark.parametrize('lockstep', [True, False])
@given(before=st.integers(0, 200))
@settings(max_examples=20)
def test_lag_of_a_recorder_is_limited(lockstep: bool, before: int) -> None:
    """Time waits until a recorder catches up or ends; it need not have samples from before it."""
    clock, most = make(factor=0.0, own=True, lockstep=lockstep), 10 if lockstep else 80
    stamps: list[int] = []

    def run(number: int) -> int:
        """Take up to this many samples; return how many."""
        first = len(stamps)
        for _ in range(number):
            # At maximum speed several are due at once.
            if clock.due(BEGIN):
                stamps.append(clock.take())
                clock.answered(stamps[-1])
        return len(stamps) - first

    assert run(before) == before
    clock.record('recorder', 1)
    assert run(300) == most + 1
    assert clock.awaited == stamps[-1]
    assert clock.missing == f'a recorder is {most} samples behind'
    clock.record('recorder', stamps[-2])
    assert run(300) == most
    clock.record('recorder', 0)
    assert run(300) == 300


def test_lockstep_makes_up_a_stall() -> None:
    """Late samples follow each command at once, up to the backlog."""
    clock = make(lockstep=True, backlog=0.01)
    now = BEGIN + 5_000_000
    stamps = []
    for _ in range(10):
        for stamp in take(clock, now):
            stamps.append(stamp)
            clock.answered(stamp)
    assert stamps == [k * 1_000_000 for k in range(1, 6)]
    assert clock.waited == 0
    assert clock.due(now + NANOSECONDS) == 1
    assert clock.waited == NANOSECONDS - 10_000_000


def test_lockstep_does_not_exceed_the_real_time_factor() -> None:
    """Immediate responses do not accelerate time."""
    clock = make(lockstep=True)
    for k in range(1, 3001):
        # Ten checks per period.
        for stamp in take(clock, BEGIN + k * 100_000):
            clock.answered(stamp)
    assert clock.stamp == 300_000_000


@pytest.mark.parametrize('own', [False, True])
def test_restart_clears_a_pause(own: bool) -> None:
    clock = make(own=own)
    clock.pause()
    clock.begin(BEGIN)
    assert take(clock, BEGIN + 5_000_000)
    clock.begin(BEGIN, paused=True)
    assert not take(clock, BEGIN + 5_000_000)


@pytest.mark.parametrize('own', [False, True])
def test_time_stops_during_a_pause(own: bool) -> None:
    """After the pause, an independent time continues at its value, other time at the clock."""
    clock = make(own=own)
    before = take(clock, BEGIN + 10_000_000)[-1]
    clock.pause()
    later = BEGIN + 5 * NANOSECONDS
    assert take(clock, later) == []
    assert clock.simulated(later) == before
    clock.resume(later)
    first = take(clock, later + 1_000_000)[0]
    assert first == (before + 1_000_000 if own else later)
    assert clock.lost == clock.waited == 0


@pytest.mark.parametrize('own', [False, True])
def test_step_takes_one_sample(own: bool) -> None:
    """A step advances independent time by a period, and other time to the clock."""
    clock = make(own=own)
    with pytest.raises(JobError, match='time is not paused; pause first'):
        clock.step(BEGIN)
    clock.pause()
    stamps = [clock.step(BEGIN + k * NANOSECONDS) for k in (1, 2, 3)]
    wanted = [1_000_000, 2_000_000, 3_000_000] if own else [k * NANOSECONDS for k in (1, 2, 3)]
    assert [stamp - BEGIN for stamp in stamps] == wanted
    assert clock.due(BEGIN + 4 * NANOSECONDS) == 0


def test_lockstep_step_waits_for_the_command() -> None:
    """A second step is rejected until the first sample has been answered."""
    clock = make(lockstep=True)
    clock.pause()
    stamp = clock.step(BEGIN)
    with pytest.raises(JobError, match=r'no command has answered the sample of 0.001000 s'):
        clock.step(BEGIN)
    clock.answered(stamp)
    assert clock.step(BEGIN) == 2_000_000


@pytest.mark.parametrize('own', [False, True])
def test_sampling_continues_after_the_clock_is_set_back(own: bool) -> None:
    """Independent time continues at its value, other time follows the clock."""
    clock = make(own=own)
    newest = take(clock, BEGIN + 100_000_000)[-1] if not own else BEGIN
    back = BEGIN - 3600 * NANOSECONDS
    assert take(clock, back) == []
    first = take(clock, back + 1_000_000)[0]
    assert first == (newest if own else back) + 1_000_000
