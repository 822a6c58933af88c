# SPDX-License-Identifier: Apache-2.0
"""References keep their limits, are continuous with the state before, and reach their target."""

from collections.abc import Callable
from itertools import accumulate, pairwise
from typing import Any

from hypothesis import assume, given, settings
from hypothesis import strategies as st
from needle_controller import MinimumJerk, ReferenceLimits, Setpoint
from needle_controller.reference.generator import ReferenceGenerator
from needle_controller.reference.path import Joined, Path, Trapezoid
from needle_controller.reference.quintic import Quintic
from needle_dynamics import FloatArray, ParameterError
import numpy as np
from numpy.testing import assert_allclose
import pytest
from scipy.interpolate import CubicHermiteSpline

LIMITS = ReferenceLimits(speed=0.01, acceleration=0.1)
BOTH = pytest.mark.parametrize('kind', [Trapezoid, MinimumJerk])

depths = st.floats(0.0, 0.2)
speeds = st.floats(-0.02, 0.02)


@BOTH
@settings(deadline=None)
@given(depths, speeds, depths)
def test_motion_starts_at_start_and_ends_at_target_at_rest(
    kind: type[MinimumJerk] | type[Trapezoid], start: float, speed: float, target: float
) -> None:
    """The ends are exact; before and after, the reference rests."""
    motion = kind(Setpoint(start, speed), target, LIMITS)
    assume(motion.duration > 0.0)
    first, last = motion.at(0.0), motion.at(motion.duration)
    assert (first.position, first.velocity) == (start, speed)
    assert last == Setpoint(target)
    before = motion.at(motion.duration * (1.0 - 1e-9))
    # 1e-9 of the duration at these speeds, and rounding of the sums over the parts.
    assert_allclose([before.position, before.velocity], [target, 0.0], atol=1e-7)


@BOTH
@settings(deadline=None)
@given(depths, speeds, depths)
def test_position_velocity_and_acceleration_are_consistent(
    kind: type[MinimumJerk] | type[Trapezoid], start: float, speed: float, target: float
) -> None:
    """The velocity is the derivative of the position and within limits and start velocity."""
    motion = kind(Setpoint(start, speed), target, LIMITS)
    assume(motion.duration > 1e-2)
    times = np.linspace(0.0, motion.duration, 801)
    points = [motion.at(t) for t in times]
    position = np.array([p.position for p in points])
    rate = np.array([p.velocity for p in points])
    ramp = np.array([p.acceleration for p in points])
    # The trapezoidal rule: exact within a part, and off by one step's change at a corner.
    step = times[1]
    assert_allclose(np.diff(position), 0.5 * step * (rate[1:] + rate[:-1]), atol=0.5 * step * step)
    assert np.abs(rate).max() <= max(LIMITS.speed, abs(speed)) * (1.0 + 1e-9)
    if kind is Trapezoid or speed == 0.0:
        assert np.abs(ramp).max() <= LIMITS.acceleration * (1.0 + 1e-6)


ends = st.builds(Setpoint, depths, speeds, st.one_of(st.just(0.0), st.floats(-0.2, 0.2)))


@settings(deadline=None)
@given(ends, ends, st.floats(-3.0, 2.0))
def test_extremes_of_a_quintic_are_found(start: Setpoint, end: Setpoint, exponent: float) -> None:
    """All samples of position, velocity and acceleration are within the extremes."""
    motion = Quintic(start, end, 10.0**exponent)
    points = [motion.at(x * motion.duration) for x in np.linspace(0.0, 1.0, 1001)]
    found = np.array([(p.position, p.velocity, p.acceleration) for p in points]).T
    low, high = motion.extremes.T
    # The size of the terms affected by rounding and by a thousandth of the duration.
    t = motion.duration
    terms = sum(
        abs(e.position) + t * abs(e.velocity) + t * t * abs(e.acceleration) for e in (start, end)
    )
    size = 100.0 * terms / np.array([1.0, t, t * t]) + 1e-300
    assert (low <= found.min(axis=1) + 1e-13 * size).all()
    assert (high >= found.max(axis=1) - 1e-13 * size).all()
    # Sampled within half a thousandth of an extreme: a second derivative of 60 terms.
    assert (np.abs(low - found.min(axis=1)) <= 1e-4 * size).all()
    assert (np.abs(high - found.max(axis=1)) <= 1e-4 * size).all()


@pytest.mark.requirement('S-023')
@settings(deadline=None)
@given(depths, depths)
def test_trapezoid_is_the_fastest_motion(start: float, target: float) -> None:
    """Its duration is the minimum for the limits of speed and acceleration from rest to rest."""
    distance = abs(target - start)
    motion = Trapezoid(Setpoint(start), target, LIMITS)
    v, a = LIMITS.speed, LIMITS.acceleration
    least = distance / v + v / a if distance > v * v / a else 2.0 * np.sqrt(distance / a)
    assert motion.duration == pytest.approx(least, rel=1e-9, abs=1e-12)


@pytest.mark.requirement('S-023')
@pytest.mark.parametrize(('velocity', 'target'), [(0.0, 0.05), (0.03, 0.05), (0.01, -0.05)])
def test_samples_of_a_trapezoid_are_its_setpoints(velocity: float, target: float) -> None:
    """To the bit, also before the start and after the end."""
    motion = Trapezoid(Setpoint(0.02, velocity), target, ReferenceLimits())
    times = np.linspace(-0.1, motion.duration + 0.1, 997)
    assert np.array_equal(motion.sampled(times), [motion.at(time) for time in times.tolist()])


def test_minimum_jerk_reaches_its_speed_limit() -> None:
    """From rest to rest the peak speed is the limit, reached half-way."""
    motion = MinimumJerk(Setpoint(0.02), 0.12, LIMITS)
    # Peak of the quintic at half time: 15/8 of the mean speed; tolerance of rounding.
    assert motion.at(0.5 * motion.duration).velocity == pytest.approx(LIMITS.speed, rel=1e-12)
    assert motion.duration == pytest.approx(18.75, rel=1e-12)


def samples(motion: Callable[..., Any], end: float, count: int = 801) -> tuple[FloatArray, ...]:
    """Return times, positions, speeds and accelerations of a motion."""
    times = np.linspace(0.0, end, count)
    points = [motion(t) for t in times]
    return times, *np.array([(p.position, p.velocity, p.acceleration) for p in points]).T


def check_smooth(
    motion: Callable[..., Any], end: float, extra_speed: float = 0.0, extra_ramp: float = 0.0
) -> None:
    """Check continuity and limits of position and velocity, with the excess of the start."""
    times, position, speed, _ = samples(motion, end)
    step = times[1]
    top = max(LIMITS.speed, abs(extra_speed))
    ramp = max(LIMITS.acceleration, abs(extra_ramp))
    # A mean over a step does not exceed the largest value within it.
    assert np.abs(np.diff(position)).max() <= top * step * (1.0 + 1e-6) + 1e-12
    assert np.abs(np.diff(speed)).max() <= ramp * step * (1.0 + 1e-6) + 1e-12
    assert np.abs(speed).max() <= top * (1.0 + 1e-6)


REACH = (0.001, 0.2)

#: Points of a path: time to the next point, and fraction of the highest speed.
legs = st.lists(st.tuples(st.floats(0.3, 3.0), st.floats(-1.0, 1.0)), min_size=1, max_size=6)


def lines(legs: list[tuple[float, float]], start: float = 0.1) -> tuple[list[float], list[float]]:
    """Return times and positions of lines within limits and reach."""
    times, positions = [0.0], [start]
    for time, part in legs:
        times.append(times[-1] + time)
        at = positions[-1] + part * LIMITS.speed * time
        positions.append(min(max(at, 0.01), 0.19))
    return times, positions


@settings(deadline=None, max_examples=60)
@given(legs, st.floats(0.05, 0.15), speeds, st.booleans())
def test_path_is_joined_continuously_from_any_state_and_followed_to_its_end(
    legs: list[tuple[float, float]], start: float, speed: float, cubic: bool
) -> None:
    """Lines, or cubics at rest in their points: joined within the limits, ended exactly."""
    times, positions = lines(legs)
    if cubic:
        # Rest to rest a cubic has 3/2 of the mean speed and 6 D / T^2.
        positions = [0.1 + 0.05 * (at - 0.1) for at in positions]
    path = Path(times, positions, [0.0] * len(times) if cubic else None, LIMITS, REACH)
    motion = Joined(Setpoint(start, speed), path, 0.0, LIMITS)
    first = motion.at(0.0)
    assert_allclose((first.position, first.velocity), (start, speed), rtol=1e-12)
    check_smooth(motion.at, motion.duration + 0.1, speed)
    assert motion.at(motion.duration) == Setpoint(positions[-1])


def test_lines_are_followed_exactly_between_their_corners() -> None:
    """In the middle of each line the path is the line; a corner is cut by dv^2 / 8a at most."""
    times, positions = [0.0, 2.0, 4.0], [0.1, 0.118, 0.11]
    path = Path(times, positions, None, LIMITS, REACH)
    for t in (1.0, 3.0):
        assert path.at(t).position == pytest.approx(np.interp(t, times, positions), rel=1e-12)
    off = max(abs(path.at(t).position - np.interp(t, times, positions))
              for t in np.linspace(0.0, 4.2, 2001))  # fmt: skip
    assert off <= 0.013**2 / (8.0 * LIMITS.acceleration) * (1.0 + 1e-9)


@pytest.mark.requirement('S-024')
@pytest.mark.parametrize(
    ('times', 'positions', 'rates', 'reason'),
    [
        ([], [], None, 'at least one time'),
        ([1.0], [0.1, 0.2], None, 'one position for each'),
        ([1.0, 2.0], [0.1, 0.1], [0.0], 'a velocity for each of its 2 points or none'),
        ([1.0, 1.0], [0.1, 0.1], None, 'times must be >= 0 and increasing'),
        ([-1.0], [0.1], None, 'times must be >= 0 and increasing'),
        ([1.0, np.nan], [0.1, 0.1], None, 'must be finite'),
        ([1.0], [np.inf], None, 'must be finite'),
        ([1.0], [0.3], None, r'positions must be in \[0.001, 0.2\] m'),
        (
            [0.0, 1.0],
            [0.1, 0.12],
            None,
            'velocity after 0 s must be within 0.01 m/s, got 0.02 m/s',
        ),
        ([0.0, 1.0], [0.1, 0.101], [0.0, 0.01], 'velocity at the end must be 0'),
        ([0.0, 0.1], [0.1, 0.1004], [0.0, 0.0], 'acceleration after 0 s must be within 0.1'),
        ([0.0, 0.01, 1.0], [0.1, 0.1001, 0.1], None, 'velocity changes from 0.01 to'),
        ([0.0, 4.0], [0.1995, 0.1995], [0.009, 0.0], r'must stay in \[0.001, 0.2\] m'),
    ],
)
def test_infeasible_paths_are_rejected(
    times: list[float], positions: list[float], rates: list[float] | None, reason: str
) -> None:
    """In one line, with the invalid and the valid values."""
    with pytest.raises(ParameterError, match=reason):
        Path(times, positions, rates, LIMITS, REACH)


@settings(deadline=None, max_examples=200)
@given(
    st.lists(
        st.tuples(st.floats(0.05, 2.0), st.floats(-1.0, 1.0), st.floats(-1.0, 1.0)),
        min_size=1,
        max_size=5,
    ),
    st.sampled_from([1e-3, 5e-3, 2e-2]),
    st.sampled_from([0.1, REACH[1] - 1e-5]),
)
def test_cubics_are_accepted_if_and_only_if_they_are_within_limits(
    points: list[tuple[float, float, float]], size: float, start: float
) -> None:
    """As the cubic spline of SciPy, at 401 times between two points."""
    times = [0.0, *accumulate(step for step, _, _ in points)]
    positions = [start, *(min(start + size * x, REACH[1]) for _, x, _ in points)]
    rates = [0.0, *(size * v for *_, v in points[:-1]), 0.0]
    spline = CubicHermiteSpline(times, positions, rates)
    sampled = np.concatenate([np.linspace(*pair, 401)[:-1] for pair in pairwise(times)])
    fastest = np.abs(spline(sampled, 1)).max()
    # Acceleration is linear between the points, and jumps there.
    ends = [*times[:-1], *np.nextafter(times[1:], 0.0)]
    excess = max(fastest / LIMITS.speed, np.abs(spline(ends, 2)).max() / LIMITS.acceleration) - 1.0
    beyond = max(spline(sampled).max() - REACH[1], REACH[0] - spline(sampled).min())
    # Peaks between the sampled times: second order in their step.
    assume(abs(excess) > 1e-4 and not -4e-7 < beyond <= 0.0)
    try:
        path = Path(times, positions, rates, LIMITS, REACH)
    except ParameterError:
        assert excess > 0.0 or beyond > 0.0
    else:
        assert excess <= 0.0
        assert beyond <= 0.0
        found = [path.at(t).position for t in sampled.tolist()]
        # Rounding.
        assert_allclose(found, spline(sampled), rtol=1e-9)


class Walk:
    """A guide sampled at 1 kHz around changes."""

    def __init__(self, kind: str) -> None:
        self.guide = ReferenceGenerator(kind, LIMITS, REACH)
        self.time = 0.0
        self.points: list[Setpoint] = []

    def on(self, duration: float) -> Setpoint:
        for _ in range(round(duration * 1000.0)):
            self.points.append(self.guide.at(self.time, 0.05))
            self.time += 1e-3
        return self.points[-1]


KINDS = pytest.mark.parametrize('kind', ['trapezoid', 'minimum_jerk'])
events = st.lists(
    st.tuples(st.sampled_from(['target', 'path', 'pause', 'resume']), st.floats(0.01, 1.5)),
    min_size=1,
    max_size=6,
)


@KINDS
@settings(deadline=None, max_examples=25)
@given(st.data(), events)
def test_reference_is_continuous_across_all_changes(
    kind: str, data: Any, events: list[tuple[str, float]]
) -> None:
    """Targets, paths, pauses and resumptions in any order: no jump of position or velocity."""
    walk = Walk(kind)
    walk.guide.aim(0.12)
    for event, wait in events:
        walk.on(wait)
        if event == 'target':
            walk.guide.aim(data.draw(depths.filter(lambda at: at > 0.001)))
        elif event == 'path':
            walk.guide.follow(*lines([(1.0, 0.9), (0.7, -0.4)], 0.06))
        else:
            getattr(walk.guide, event)()
        before, after = walk.guide.ahead(walk.time), walk.guide.at(walk.time, 0.05)
        assert_allclose(after.position, before.position, rtol=1e-12)
        assert_allclose(after.velocity, before.velocity, rtol=1e-9, atol=1e-12)
        if kind == 'minimum_jerk':
            assert_allclose(after.acceleration, before.acceleration, rtol=1e-9, atol=1e-9)
    walk.on(0.5)
    position, speed = np.array([(p.position, p.velocity) for p in walk.points]).T
    assert np.abs(np.diff(position)).max() <= 1e-3 * LIMITS.speed * (1.0 + 1e-6)
    assert np.abs(np.diff(speed)).max() <= 1e-3 * LIMITS.acceleration * (1.0 + 1e-6)


@pytest.mark.requirement('S-008')
@KINDS
def test_pause_brakes_holds_and_resumes(kind: str) -> None:
    """In motion it stops within v^2 / 2a (2.9 times that with minimum jerk), then continues."""
    walk = Walk(kind)
    walk.guide.aim(0.1)
    before = walk.on(2.0)
    walk.guide.pause()
    held = walk.on(1.0)
    assert held.velocity == held.acceleration == 0.0
    assert 0.0 < held.position - before.position <= 2.9 * 0.01**2 / (2.0 * 0.1) + 1e-5
    assert walk.on(1.0) == held
    # A target while paused waits.
    walk.guide.aim(0.06)
    assert walk.on(0.5) == held
    walk.guide.resume()
    assert walk.on(10.0) == Setpoint(0.06)


@KINDS
def test_paused_path_is_resumed_at_its_interruption(kind: str) -> None:
    """It continues from its rest position to the end of the path, delayed by the pause."""
    times, positions = [0.0, 4.0, 8.0], [0.05, 0.08, 0.06]
    walk = Walk(kind)
    walk.guide.follow(times, positions)
    walk.on(2.0)
    walk.guide.pause()
    held = walk.on(3.0)
    walk.guide.resume()
    start = len(walk.points)
    walk.on(10.0)
    after = np.array([p.position for p in walk.points[start:]])
    assert after.min() == pytest.approx(0.06, abs=1e-9)
    # It still reaches the extreme point, less its cut corner.
    assert after.max() == pytest.approx(0.08, abs=0.0125**2 / 0.8 + 1e-9)
    assert after[0] == held.position
    assert walk.points[-1] == Setpoint(0.06)


#: A range of ten stopping distances at the highest speed.
NARROW = (0.05, 0.055)
inside = st.one_of(st.sampled_from(NARROW), st.floats(*NARROW))


@st.composite
def narrow_paths(draw: Callable[..., Any]) -> tuple[list[float], list[float]]:
    """Return times and positions of lines from end to end of the narrow reach."""
    times, positions = [draw(st.sampled_from([0.0, 0.05, 1.0]))], [draw(inside)]
    for _ in range(draw(st.integers(0, 4))):
        positions.append(draw(inside))
        distance = abs(positions[-1] - positions[-2])
        # Time for the line, and for the corners at both ends.
        pause = draw(st.floats(0.21, 1.0))
        times.append(times[-1] + distance / LIMITS.speed + pause)
    return times, positions


narrow_events = st.lists(
    st.tuples(
        st.one_of(st.sampled_from(['pause', 'resume']), inside, narrow_paths()),
        st.floats(0.0, 1.0),
    ),
    min_size=2,
    max_size=6,
)


@pytest.mark.requirement('S-023')
@KINDS
@settings(deadline=None, max_examples=40)
@given(start=inside, events=narrow_events)
def test_reference_stays_in_the_depth_range(kind: str, start: float, events: list[Any]) -> None:
    """Targets, paths and pauses at its ends, at any speed: it turns before them, smoothly."""
    guide, time, points = ReferenceGenerator(kind, LIMITS, NARROW), 0.0, []
    guide.aim(NARROW[1])
    for event, wait in [('resume', 0.3), *events, ('resume', 2.0)]:
        if isinstance(event, float):
            guide.aim(event)
        elif isinstance(event, tuple):
            guide.follow(*event)
        else:
            getattr(guide, event)()
        for _ in range(round(wait * 500.0) + 1):
            points.append(guide.at(time, start))
            time += 2e-3
    positions, rates = np.array([(point.position, point.velocity) for point in points]).T
    assert np.abs(np.diff(positions)).max() <= 2e-3 * LIMITS.speed * (1.0 + 1e-6)
    if kind == 'trapezoid':
        # A reference within limits and range can always brake before the end of the range.
        assert np.abs(np.diff(rates)).max() <= 2e-3 * LIMITS.acceleration * (1.0 + 1e-6)
    # Extremes of polynomials are found to 1e-9 of the reach.
    assert positions.min() >= NARROW[0] - 1e-11
    assert positions.max() <= NARROW[1] + 1e-11
