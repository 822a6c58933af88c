"""Stamps and rates."""

from builtin_interfaces.msg import Time
from hypothesis import given
from hypothesis import strategies as st
from needle_dynamics.timing import NANOSECONDS, nanoseconds, seconds, Window
import pytest

MILLISECOND = NANOSECONDS // 1000


@given(st.integers(0, 2**31 - 1), st.integers(0, NANOSECONDS - 1))
def test_times_are_those_of_the_message(sec, nanosec):
    """Nanoseconds to the last digit; seconds to the last bit of what a double can hold."""
    time = Time(sec=sec, nanosec=nanosec)
    assert divmod(nanoseconds(time), NANOSECONDS) == (sec, nanosec)
    # Two roundings: of the fraction, and of the sum.
    assert seconds(time) == pytest.approx(nanoseconds(time) / NANOSECONDS, rel=2.0**-51, abs=0.0)


def test_rates_and_shares_are_those_of_the_last_second():
    """In any second that is full; of a time that went back nothing is left."""
    window = Window()
    for i in range(2001):
        window.add(i * MILLISECOND, i % 4 == 0)
    # 1000 in the second, and a quarter of them: whole numbers.
    assert window.rate(2000 * MILLISECOND) == 1000.0
    assert window.share(2000 * MILLISECOND) == 0.25
    # Only the one of 2 s in the five seconds since.
    assert window.rate(7 * NANOSECONDS) == pytest.approx(0.2, rel=1e-12)
    window.add(NANOSECONDS)
    assert window.rate(NANOSECONDS) == pytest.approx(0.2, rel=1e-12)
    assert window.rate(2 * NANOSECONDS) == 1.0
