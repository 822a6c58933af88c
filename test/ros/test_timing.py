"""Stamps and rates."""

from fractions import Fraction

from builtin_interfaces.msg import Time
from hypothesis import given
from hypothesis import strategies as st
from needle_ros.timing import apart, NANOSECONDS, nanoseconds, RateCounter, seconds

MILLISECOND = NANOSECONDS // 1000


@given(st.integers(0, 2**31 - 1), st.integers(0, NANOSECONDS - 1))
def test_times_are_those_of_the_message(sec: int, nanosec: int) -> None:
    """Nanoseconds to the last digit; seconds but for two roundings."""
    time = Time(sec=sec, nanosec=nanosec)
    assert divmod(nanoseconds(time), NANOSECONDS) == (sec, nanosec)
    exact = sec + Fraction(nanosec, NANOSECONDS)
    # Half a unit in the last place, 2^-53, for the fraction, and for the sum.
    assert abs(Fraction(seconds(time)) - exact) <= exact / 2**52


def test_an_absurd_age_is_that_of_another_clock() -> None:
    """A node with simulated time and one without are decades apart: no such number is said."""
    assert apart(1_500_000_000) == '1.500 s old'
    assert apart(-1_500_000_000) == '1.500 s ahead'
    for age in (1_795_193_306 * NANOSECONDS, -1_795_193_306 * NANOSECONDS):
        assert apart(age).startswith('of another clock: use_sim_time must be alike in all nodes')


def test_rates_and_shares_are_those_of_the_last_second() -> None:
    """In any second that is full; of a time that went back nothing is left."""
    window = RateCounter()
    for i in range(2001):
        window.add(i * MILLISECOND, i % 4 == 0)
    # 1000 in the second, and a quarter of them: whole numbers.
    assert window.rate(2000 * MILLISECOND) == 1000.0
    assert window.share(2000 * MILLISECOND) == 0.25
    # Only the one of 2 s in the five seconds since: a quotient of integers, rounded once.
    assert window.rate(7 * NANOSECONDS) == 0.2
    window.add(NANOSECONDS)
    assert window.rate(NANOSECONDS) == 0.2
    assert window.rate(2 * NANOSECONDS) == 1.0
