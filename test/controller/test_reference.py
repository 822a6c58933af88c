"""References keep their limits, join what was before, and arrive."""

from hypothesis import assume, given, settings
from hypothesis import strategies as st
from needle_controller import MinimumJerk, ReferenceLimits, Setpoint, Trapezoid
import numpy as np
from numpy.testing import assert_allclose
import pytest

LIMITS = ReferenceLimits(speed=0.01, acceleration=0.1)
BOTH = pytest.mark.parametrize('kind', [Trapezoid, MinimumJerk])

depths = st.floats(0.0, 0.2)
speeds = st.floats(-0.02, 0.02)


@BOTH
@settings(deadline=None)
@given(depths, speeds, depths)
def test_starts_where_it_was_and_ends_at_the_target_at_rest(kind, start, speed, target):
    """The ends are exact, before and after it rests there."""
    motion = kind(Setpoint(start, speed), target, LIMITS)
    assume(motion.duration > 0.0)
    first, last = motion.at(0.0), motion.at(motion.duration)
    assert (first.position, first.speed) == (start, speed)
    assert last == Setpoint(target)
    before = motion.at(motion.duration * (1.0 - 1e-9))
    # 1e-9 of the duration at these speeds, and rounding of the sums over the parts.
    assert_allclose([before.position, before.speed], [target, 0.0], atol=1e-7)


@BOTH
@settings(deadline=None)
@given(depths, speeds, depths)
def test_position_speed_and_acceleration_belong_together(kind, start, speed, target):
    """The speed is the derivative of the position and stays within what limits and start allow."""
    motion = kind(Setpoint(start, speed), target, LIMITS)
    assume(motion.duration > 1e-2)
    times = np.linspace(0.0, motion.duration, 4001)
    points = [motion.at(t) for t in times]
    position = np.array([p.position for p in points])
    rate = np.array([p.speed for p in points])
    ramp = np.array([p.acceleration for p in points])
    # The trapezoidal rule: exact within a part, and off by one step's change at a corner.
    step = times[1]
    assert_allclose(np.diff(position), 0.5 * step * (rate[1:] + rate[:-1]), atol=0.5 * step * step)
    assert np.abs(rate).max() <= max(LIMITS.speed, abs(speed)) * (1.0 + 1e-9)
    if kind is Trapezoid or speed == 0.0:
        assert np.abs(ramp).max() <= LIMITS.acceleration * (1.0 + 1e-6)


@settings(deadline=None)
@given(depths, depths)
def test_trapezoid_is_the_fastest_motion(start, target):
    """Its duration is the least that speed and acceleration allow from rest to rest."""
    distance = abs(target - start)
    motion = Trapezoid(Setpoint(start), target, LIMITS)
    v, a = LIMITS.speed, LIMITS.acceleration
    least = distance / v + v / a if distance > v * v / a else 2.0 * np.sqrt(distance / a)
    assert motion.duration == pytest.approx(least, rel=1e-9, abs=1e-12)


def test_minimum_jerk_meets_its_limit():
    """From rest to rest the peak speed is the limit, reached half-way."""
    motion = MinimumJerk(Setpoint(0.02), 0.12, LIMITS)
    # Peak of the quintic at half time: 15/8 of the mean speed.
    assert motion.at(0.5 * motion.duration).speed == pytest.approx(LIMITS.speed, rel=1e-12)
    assert motion.duration == pytest.approx(18.75, rel=1e-12)
