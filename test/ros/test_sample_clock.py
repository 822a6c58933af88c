"""When samples are due."""

from itertools import pairwise

from hypothesis import given, settings
from hypothesis import strategies as st
from needle_ros.errors import JobError
from needle_ros.sample_clock import SampleClock
from needle_ros.timing import NANOSECONDS
import pytest

#: A clock is never at zero.
BEGIN = 1_700_000_000 * NANOSECONDS


def make(
    rate: float = 1000.0,
    factor: float = 1.0,
    backlog: float = 0.5,
    own: bool = False,
    lockstep: bool = False,
) -> SampleClock:
    """Return a clock that has begun."""
    clock = SampleClock(rate, factor, backlog, own=own, lockstep=lockstep)
    clock.begin(BEGIN)
    return clock


def take(clock: SampleClock, now: int) -> list[int]:
    """Take what is due; return the stamps."""
    return [clock.take() for _ in range(clock.due(now))]


ticks = st.lists(st.integers(0, 300_000_000), min_size=1, max_size=60)


@given(ticks, st.sampled_from([30.0, 100.0, 1000.0]), st.sampled_from([0.5, 1.0, 7.0]))
@settings(max_examples=60)
def test_samples_are_at_multiples_of_the_period_and_never_early(
    steps: list[int], rate: float, factor: float
) -> None:
    """However late the looks are, no sample is missing, twice, or of the future."""
    clock = make(rate, factor, own=True)
    now, stamps = BEGIN, []
    for step in steps:
        now += step
        stamps += take(clock, now)
    assert stamps == [BEGIN + round((k + 1) / rate * NANOSECONDS) for k in range(len(stamps))]
    # A nanosecond of rounding.
    assert not stamps or stamps[-1] <= BEGIN + (now - BEGIN) * factor + 1


@given(ticks)
@settings(max_examples=60)
def test_the_clocks_time_skips_what_is_beyond_the_backlog(steps: list[int]) -> None:
    """The newest stamp is within a period of the clock's now; every sample is taken or lost."""
    clock = make(100.0, backlog=0.1)
    now, taken = BEGIN, 0
    for step in steps:
        now += step
        due = clock.due(now)
        assert due <= 10
        for _ in range(due):
            taken += 1
            assert clock.take() <= now + 1
    # A nanosecond of rounding for each time that samples were lost.
    assert now - clock.stamp < NANOSECONDS / 100.0 + len(steps) + 1
    assert taken + clock.lost == pytest.approx((now - BEGIN) / 1e7, abs=1.0)


def test_a_time_of_its_own_waits_for_a_machine_that_stalls() -> None:
    """After a stall of a second half of it is made up in bursts; the rest has been waited."""
    clock = make(own=True)
    stamps = []
    for k in range(1000):
        stamps += take(clock, BEGIN + NANOSECONDS + k * 1_000_000)
    assert clock.waited == pytest.approx(0.5 * NANOSECONDS, abs=2e6)
    assert clock.lost == 0
    assert {b - a for a, b in pairwise(stamps)} == {1_000_000}


def test_as_fast_as_possible_is_not_bound_to_the_clock() -> None:
    """Without a clock samples are due at once, and as many as readers can bear."""
    clock = make(factor=0.0)
    stamps = [stamp for _ in range(10) for stamp in take(clock, BEGIN)]
    assert len(stamps) == 200
    assert stamps[-1] == BEGIN + 200_000_000


@pytest.mark.parametrize('factor', [0.0, 1.0])
def test_in_lockstep_each_sample_waits_for_its_answer(factor: float) -> None:
    """Time begins at zero and goes on by a sample for every answer, if it is the right one."""
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


def test_in_lockstep_a_sample_waits_for_all_who_process_it() -> None:
    """A command and each of two nodes, in any order; an answer that comes twice counts once."""
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
    # Both have gone.
    clock.participants = 0
    assert take(clock, later + 1_000_000) == [stamp + 1_000_000]


def test_in_lockstep_a_recorder_is_at_most_10_samples_behind() -> None:
    """Time stands still until the recorder has more, or has ended."""
    clock, now = make(factor=0.0, lockstep=True), BEGIN
    clock.recorded['recorder'] = 1
    stamps = []

    def run() -> None:
        for stamp in (stamp for _ in range(100) for stamp in take(clock, now)):
            stamps.append(stamp)
            clock.answered(stamp)

    run()
    assert len(stamps) == 11
    assert clock.missing == 'a recorder is 10 samples behind'
    clock.recorded['recorder'] = stamps[9]
    run()
    assert len(stamps) == 21
    clock.recorded.clear()
    run()
    assert len(stamps) == 121


def test_in_lockstep_a_stall_is_made_up() -> None:
    """Late samples follow each answer at once, as far back as the backlog."""
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


def test_in_lockstep_it_is_no_faster_than_its_pace() -> None:
    """An answer that comes at once does not make time run faster."""
    clock = make(lockstep=True)
    for k in range(1, 3001):
        # The clock is looked at ten times a period.
        for stamp in take(clock, BEGIN + k * 100_000):
            clock.answered(stamp)
    assert clock.stamp == 300_000_000


@pytest.mark.parametrize('own', [False, True])
def test_a_pause_ends_with_the_run(own: bool) -> None:
    """Who begins again is not held by a pause of before."""
    clock = make(own=own)
    clock.pause()
    clock.begin(BEGIN)
    assert take(clock, BEGIN + 5_000_000)
    clock.begin(BEGIN, paused=True)
    assert not take(clock, BEGIN + 5_000_000)


@pytest.mark.parametrize('own', [False, True])
def test_in_a_pause_time_stands_still(own: bool) -> None:
    """Afterwards a time of its own goes on where it stood, the clock's at the clock's now."""
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
def test_a_step_is_one_sample(own: bool) -> None:
    """Each step is a period on in a time of its own, and the clock's now where that is time."""
    clock = make(own=own)
    with pytest.raises(JobError, match='time is not paused; pause first'):
        clock.step(BEGIN)
    clock.pause()
    stamps = [clock.step(BEGIN + k * NANOSECONDS) for k in (1, 2, 3)]
    wanted = [1_000_000, 2_000_000, 3_000_000] if own else [k * NANOSECONDS for k in (1, 2, 3)]
    assert [stamp - BEGIN for stamp in stamps] == wanted
    assert clock.due(BEGIN + 4 * NANOSECONDS) == 0


def test_a_step_in_lockstep_waits_for_the_answer_too() -> None:
    """A second step is refused until the first sample has been answered."""
    clock = make(lockstep=True)
    clock.pause()
    stamp = clock.step(BEGIN)
    with pytest.raises(JobError, match=r'no command has answered the sample of 0.001000 s'):
        clock.step(BEGIN)
    clock.answered(stamp)
    assert clock.step(BEGIN) == 2_000_000


@pytest.mark.parametrize('own', [False, True])
def test_a_clock_that_is_set_back_does_not_stop_it(own: bool) -> None:
    """The clock's time follows; a time of its own goes on where it was."""
    clock = make(own=own)
    newest = take(clock, BEGIN + 100_000_000)[-1] if not own else BEGIN
    back = BEGIN - 3600 * NANOSECONDS
    assert take(clock, back) == []
    first = take(clock, back + 1_000_000)[0]
    assert first == (newest if own else back) + 1_000_000
