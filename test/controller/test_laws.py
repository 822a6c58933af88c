# SPDX-License-Identifier: Apache-2.0
"""Sampled control laws on their nominal axes."""

from math import inf, isfinite
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st
import mpmath
from needle_controller import (
    Axis,
    InverseDynamics,
    InverseDynamicsGains,
    MinimumJerk,
    Pid,
    PidGains,
    ReferenceLimits,
    Setpoint,
)
from needle_controller.compiled.laws import INTEGRAL, OFFSET, RATE
from needle_controller.laws.law import no_memory, SampledLoop
from needle_dynamics import NeedleParameters, ParameterError
import numpy as np
from numpy.testing import assert_allclose
import pytest

PHANTOM = Axis.insertion(NeedleParameters.preset('phantom'))
PAPER_SI = Axis.insertion(NeedleParameters.preset('paper_si'))
PERIOD = 1e-3

numbers = st.floats(-1.0, 1.0)
inertias = st.floats(1e-4, 10.0)
viscosities = st.floats(0.0, 500.0)


@given(numbers, numbers, numbers, inertias, viscosities)
def test_inverse_dynamics_gives_the_commanded_velocity(
    position: float, speed: float, load: float, inertia: float, viscous: float
) -> None:
    """Held over the period, the force gives the velocity u + h a exactly, on every axis."""
    axis = Axis(inertia=inertia, viscous=viscous)
    law = InverseDynamics(axis=axis, gains=InverseDynamicsGains(), period=PERIOD)
    aim = Setpoint(0.1, 0.02, 0.3)
    acceleration = 0.3 + 60.0 * (0.02 - speed) + 900.0 * (0.1 - position)
    force = law.force(position, speed, aim, no_memory(), load)
    _, reached = axis.propagate(position, speed, force - load, PERIOD)
    # Rounding of forces of the size mass * acceleration and load, over the mass.
    scale = abs(speed) + PERIOD * (abs(acceleration) + abs(load) / inertia) + 1.0
    assert abs(reached - (speed + PERIOD * acceleration)) < 1e-11 * scale


def test_inverse_dynamics_converges_to_the_continuous_law() -> None:
    """As h -> 0 the force is M a + mu_v u + mu_s sgn(u) + N, with an error of order one."""
    axis = PAPER_SI
    aim, gains = Setpoint(0.1, 0.02, 0.3), InverseDynamicsGains(kp=9.0, kv=6.0)
    position, speed, load = 0.09, 0.01, 0.2
    acceleration = 0.3 + 6.0 * 0.01 + 9.0 * 0.01
    continuous = axis.inertia * acceleration + axis.viscous * speed + axis.coulomb + load
    errors = [
        InverseDynamics(axis=axis, gains=gains, period=h).force(
            position, speed, aim, no_memory(), load
        )
        - continuous
        for h in (1e-4, 1e-5)
    ]
    # Ten times the period, ten times the error; second order adds at most 5 %, h omega.
    assert_allclose(errors[0] / errors[1], 10.0, rtol=0.05)


@given(numbers, numbers, numbers, inertias, viscosities, st.floats(0.0, 0.1), numbers)
def test_pid_is_evaluated_at_the_end_of_the_period(
    position: float,
    speed: float,
    integral: float,
    inertia: float,
    viscous: float,
    filter_time: float,
    filtered: float,
) -> None:
    """The force equals kp e + ki int e + kd e_dot at the state at the end of the period."""
    axis = Axis(inertia=inertia, viscous=viscous)
    gains = PidGains(kp=50.0, ki=20.0, kd=3.0, filter_time=filter_time)
    aim, memory = Setpoint(0.1, 0.02, 0.3), no_memory()
    memory[INTEGRAL], memory[RATE] = integral, filtered
    law = Pid(axis=axis, gains=gains, period=PERIOD)
    force = law.force(position, speed, aim, memory)
    reached, rate = axis.propagate(position, speed, force, PERIOD)
    error = 0.1 + PERIOD * 0.02 - reached
    error_rate = 0.02 + PERIOD * 0.3 - rate
    # The filter T r_dot + r = e_dot, implicit.
    low = (filter_time * filtered + PERIOD * error_rate) / (filter_time + PERIOD)
    expected = 50.0 * error + 20.0 * (integral + PERIOD * error) + 3.0 * low
    # Rounding of terms of the size of the gains.
    scale = 100.0
    assert abs(force - expected) < 1e-11 * scale
    loop = SampledLoop(law, 0, inf)
    loop.memory[:] = memory
    assert loop.command(position, speed, aim) == force
    assert abs(loop.memory[RATE] - low) < 1e-11 * scale


@settings(max_examples=200)
@given(st.floats(-3.0, 6.0), st.sampled_from([1e-6, 1e-3]))
def test_response_is_exact(damping: float, t: float) -> None:
    """Every entry agrees with the matrix exponential in 40 digits, for weak and strong damping."""
    gamma = 10.0**damping
    response = Axis(inertia=1.0, viscous=gamma).response(t)
    with mpmath.workdps(40):
        matrix = mpmath.expm(t * mpmath.matrix([[0, 1, 0], [0, -gamma, 1], [0, 0, 0]]))
    exact = [float(matrix[i, j]) for i, j in ((0, 1), (1, 1), (0, 2), (1, 2))]
    # pf has the cancellation of (1 - mean) / x, 1e-16 over x = 1e-4, with some reserve.
    pv, vv, pf, vf = response
    assert_allclose([pv, pf, vf], [exact[0], *exact[2:]], rtol=1e-11)
    assert_allclose(vv, exact[1], rtol=1e-14, atol=1e-15)


def test_response_is_continuous_at_zero_friction() -> None:
    """Weak friction equals zero friction, to first order."""
    free = Axis(inertia=2e-3).response(PERIOD)
    # x = mu_v h / M = 5e-6 is the relative size of the change.
    assert_allclose(Axis(inertia=2e-3, viscous=1e-5).response(PERIOD), free, rtol=1e-5)


@pytest.mark.parametrize(
    ('changes', 'words'),
    [
        ({'inertia': 0.0}, 'inertia must be finite, > 0'),
        ({'inertia': 1.0, 'viscous': -1.0}, 'viscous must be finite, >= 0 N s/m'),
    ],
)
def test_invalid_axes_are_rejected(changes: dict[str, Any], words: str) -> None:
    """No mass, and negative damping."""
    with pytest.raises(ParameterError, match=words):
        Axis(**changes)


@settings(max_examples=30)
@given(st.integers(0, 5), st.lists(numbers, min_size=8, max_size=8))
def test_prediction_compensates_the_delay(delay: int, kicks: list[float]) -> None:
    """With its nominal axis, the depths equal the depths without delay, shifted by the delay."""

    def run(late: int) -> list[float]:
        law = InverseDynamics(axis=PAPER_SI, gains=InverseDynamicsGains(), period=PERIOD)
        loop = SampledLoop(law, late, 100.0)
        waiting = [0.0] * late
        position, speed, path = 0.05, 0.0, []
        for i in range(200 + late):
            # The reference at the time at which the command takes effect.
            kick = kicks[min(i, 199) // 25]
            waiting.append(loop.command(position, speed, Setpoint(0.05 + 1e-3 * kick)))
            position, speed = PAPER_SI.propagate(position, speed, waiting.pop(0), PERIOD)
            path.append(position)
        return path[late:]

    # The same arithmetic in the same order, except for the rounding of a prediction at rest.
    assert_allclose(run(delay), run(0), rtol=0.0, atol=1e-12)


@pytest.mark.parametrize('period', [1e-5, 1e-4, 1e-3])
def test_breakaway_overcomes_coulomb_friction_at_rest(period: float) -> None:
    """At rest with an error the inverse dynamics breaks away, in the direction of the error."""
    law = InverseDynamics(axis=PHANTOM, gains=InverseDynamicsGains(), period=period)
    for sign in (-1.0, 1.0):
        position, speed = 0.05, 0.0
        for _ in range(round(0.5 / period)):
            force = law.force(position, speed, Setpoint(0.05 + sign * 1e-3), no_memory())
            position, speed = PHANTOM.propagate(position, speed, force, period)
        # Compensation is full down to breakaway_speed / (1 ms kp) = 0.11 mm from the target.
        assert abs(position - 0.05 - sign * 1e-3) < 1.2e-4


# Anti-windup, feed-forward, memory.


def test_integral_neither_winds_up_nor_hunts() -> None:
    """At a limit the integral is constant, and within the tolerance at rest it is frozen."""
    loop = SampledLoop(Pid(axis=PHANTOM, gains=PidGains(), period=PERIOD), 0, 1.0)
    for _ in range(100):
        assert loop.command(0.0, 0.0, Setpoint(0.1)) == 1.0
    assert loop.memory[INTEGRAL] == 0.0
    loop.limit = 1e3
    loop.command(0.0, 0.0, Setpoint(1e-5))
    assert loop.memory[INTEGRAL] == 0.0
    loop.command(0.0, 0.0, Setpoint(1e-3))
    assert loop.memory[INTEGRAL] == pytest.approx(PERIOD * 1e-3, rel=1e-12)


def test_back_calculation_unwinds_in_its_tracking_time() -> None:
    """Without an error the excess over the limit decays as exp(-t / tracking_time)."""
    gains = PidGains(anti_windup='back_calculation', tracking_time=0.05, tolerance=0.0)
    law = Pid(axis=PHANTOM, gains=gains, period=1e-5)
    loop = SampledLoop(law, 0, 1.0)
    loop.memory[INTEGRAL] = 3.0 / gains.ki
    start = law.force(0.0, 0.0, Setpoint(0.0), loop.memory)
    for _ in range(5000):
        assert loop.command(0.0, 0.0, Setpoint(0.0)) == 1.0
    end = law.force(0.0, 0.0, Setpoint(0.0), loop.memory)
    # One time constant; the implicit form is good to h / tracking_time.
    assert_allclose((end - 1.0) / (start - 1.0), np.exp(-1.0), rtol=3e-4)


@pytest.mark.parametrize('anti_windup', ['conditional', 'back_calculation'])
def test_force_limit_causes_no_integral_overshoot(anti_windup: str) -> None:
    """After a long time at the limit the axis has no more overshoot than without a limit."""
    gains = PidGains(anti_windup=anti_windup, tracking_time=0.02)
    loop = SampledLoop(Pid(axis=PHANTOM, gains=gains, period=PERIOD), 1, 4.0)
    position, speed, waiting, path = 0.0, 0.0, [0.0], []
    for _ in range(20_000):
        waiting.append(loop.command(position, speed, Setpoint(0.05)))
        position, speed = PHANTOM.propagate(position, speed, waiting.pop(0), PERIOD)
        path.append(position)
    # The integral during motion at the limit, 4 N, is 0.7 mm of kp above the force at rest.
    assert max(path) < 0.0512
    assert abs(path[-1] - 0.05) < 1e-4


@pytest.mark.parametrize('axis', [PHANTOM, PAPER_SI], ids=['phantom', 'si'])
def test_feed_forward_follows_the_reference(axis: Axis) -> None:
    """With the nominal axis, the feedback is almost zero; without feed-forward it is large."""
    reference = MinimumJerk(Setpoint(0.0), 0.01, ReferenceLimits(speed=0.02, acceleration=0.2))
    worst = {}
    for feed_forward in (False, True):
        gains = PidGains(kp=500.0, ki=0.0, kd=1.0, feed_forward=feed_forward)
        loop = SampledLoop(Pid(axis=axis, gains=gains, period=PERIOD), 0, 100.0)
        position = speed = 0.0
        errors = []
        for i in range(1000):
            aim = reference.at(i * PERIOD)
            errors.append(abs(aim.position - position))
            force = loop.command(position, speed, aim)
            position, speed = axis.propagate(position, speed, force, PERIOD)
        worst[feed_forward] = max(errors)
    assert worst[True] < 0.05 * worst[False]


@given(
    numbers,
    numbers,
    st.floats(-10.0, 10.0),
    st.sampled_from([PHANTOM, PAPER_SI]),
    st.sampled_from(
        [
            InverseDynamicsGains(),
            PidGains(),
            PidGains(ki=0.0, filter_time=0.01),
            PidGains(feed_forward=True, anti_windup='back_calculation'),
        ]
    ),
)
def test_switch_between_laws_is_bumpless(
    position: float, speed: float, last: float, axis: Axis, gains: InverseDynamicsGains | PidGains
) -> None:
    """For each pair of laws, the first force equals the last force before the switch."""
    law: Any = InverseDynamics if isinstance(gains, InverseDynamicsGains) else Pid
    loop = SampledLoop(Pid(axis=axis, gains=PidGains(), period=PERIOD), 1, 20.0)
    loop.last = last
    loop.switch(law(axis=axis, gains=gains, period=PERIOD))
    # Rounding of forces of the size of the gains, times the divisor of PID.
    assert loop.command(position, speed, Setpoint(0.1, 0.01, 0.2)) == pytest.approx(last, abs=1e-9)
    # The next command is computed by the law: finite, for any offset.
    assert isfinite(loop.command(position, speed, Setpoint(0.1, 0.01, 0.2)))


def test_offset_after_a_switch_decays() -> None:
    """The offset of a law without integral is zero after ten times its 0.1 s."""
    loop = SampledLoop(Pid(axis=PHANTOM, gains=PidGains(), period=PERIOD), 0, 20.0)
    loop.last = 3.0
    gains = InverseDynamicsGains(bandwidth=0.0)
    loop.switch(InverseDynamics(axis=PHANTOM, gains=gains, period=PERIOD))
    for _ in range(1000):
        force = loop.command(0.05, 0.0, Setpoint(0.05))
    # exp(-10) of the 3 N.
    assert abs(force) == pytest.approx(3.0 * np.exp(-9.99), rel=1e-6)
    assert loop.memory[OFFSET] < 2e-4


def test_stop_keeps_the_integral() -> None:
    """A stop discards the pending commands; the integral is frozen, and a reset discards it."""
    loop = SampledLoop(Pid(axis=PHANTOM, gains=PidGains(), period=PERIOD), 2, 20.0)
    for _ in range(10):
        loop.command(0.05, 0.0, Setpoint(0.051))
    integral = loop.memory[INTEGRAL]
    loop.stop()
    assert list(loop.pending) == [0.0, 0.0]
    assert loop.memory[INTEGRAL] == integral > 0.0
    loop.reset()
    assert not loop.memory.any()


def test_switch_to_another_period_is_rejected() -> None:
    """A law of another period requires another loop."""
    law = Pid(axis=PHANTOM, gains=PidGains(), period=PERIOD)
    with pytest.raises(ParameterError, match=r'period must stay 0\.001 s'):
        SampledLoop(law, 0, 1.0).switch(Pid(axis=PHANTOM, gains=PidGains(), period=2e-3))


@pytest.mark.parametrize(
    ('changes', 'words'),
    [
        ({'anti_windup': 'clamping'}, 'one of conditional, back_calculation'),
        ({'feed_forward': 1.0}, 'feed_forward must be true or false'),
        ({'filter_time': -1.0}, 'filter_time must be finite, >= 0 s'),
        ({'tracking_time': 0.0}, 'tracking_time must be finite, > 0 s'),
    ],
)
def test_invalid_gains_are_rejected(changes: dict[str, Any], words: str) -> None:
    """Unknown names and numbers out of range, with the valid values."""
    with pytest.raises(ParameterError, match=words):
        PidGains(**changes)
