# SPDX-License-Identifier: Apache-2.0
"""Stamps and event rates."""

from fractions import Fraction

from builtin_interfaces.msg import Time
from hypothesis import given
from hypothesis import strategies as st
from needle_ros.timing import apart, NANOSECONDS, nanoseconds, RateCounter, seconds

MILLISECOND = NANOSECONDS // 1000


@given(st.integers(0, 2**31 - 1), st.integers(0, NANOSECONDS - 1))
def test_time_conversion_is_exact(sec: int, nanosec: int) -> None:
    """Nanoseconds exactly, seconds up to two roundings."""
    time = Time(sec=sec, nanosec=nanosec)
    assert divmod(nanoseconds(time), NANOSECONDS) == (sec, nanosec)
    exact = sec + Fraction(nanosec, NANOSECONDS)
    # Half a unit in the last place, 2^-53, for each of two roundings: fraction and sum.
    assert abs(Fraction(seconds(time)) - exact) <= exact / 2**52


def test_age_of_days_is_reported_as_another_clock() -> None:
    """Simulated time and system time differ by decades: the age is not printed."""
    assert apart(1_500_000_000) == '1.500 s old'
    assert apart(-1_500_000_000) == '1.500 s ahead'
    for age in (1_795_193_306 * NANOSECONDS, -1_795_193_306 * NANOSECONDS):
        assert apart(age).startswith('of another clock: use_sim_time must be alike in all nodes')


def test_rate_and_fraction_of_the_last_full_second() -> None:
    """A clock that is set back resets the counter."""
    window = RateCounter()
    for i in range(2001):
        window.add(i * MILLISECOND, i % 4 == 0)
    # 1000 events in the second, a quarter marked: exact integers.
    assert window.rate(2000 * MILLISECOND) == 1000.0
    assert window.share(2000 * MILLISECOND) == 0.25
    # Only the event at 2 s in the five seconds since: a ratio of integers, rounded once.
    assert window.rate(7 * NANOSECONDS) == 0.2
    window.add(NANOSECONDS)
    assert window.rate(NANOSECONDS) == 0.2
    assert window.rate(2 * NANOSECONDS) == 1.0
