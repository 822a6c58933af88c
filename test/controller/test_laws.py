"""What the sampled laws do to the axis they believe in."""

from contextlib import nullcontext

from hypothesis import given, settings
from hypothesis import strategies as st
from needle_controller import (
    Axis,
    check_stability,
    InverseDynamics,
    InverseDynamicsGains,
    Pid,
    PidGains,
    SampledLoop,
    Setpoint,
    spectral_radius,
    transition_matrix,
)
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


@settings(deadline=None)
@given(numbers, numbers, numbers, inertias, viscosities)
def test_inverse_dynamics_gives_the_speed_it_aims_at(position, speed, load, inertia, viscous):
    """Held over the period, the force brings about u + h a exactly, whatever the friction."""
    axis = Axis(inertia=inertia, viscous=viscous)
    law = InverseDynamics(axis=axis, gains=InverseDynamicsGains(), period=PERIOD)
    aim = Setpoint(0.1, 0.02, 0.3)
    acceleration = 0.3 + 60.0 * (0.02 - speed) + 900.0 * (0.1 - position)
    force = law.force(position, speed, aim, 0.0, load)
    _, reached = axis.propagate(position, speed, force - load, PERIOD)
    # Rounding of forces of the size mass * acceleration and load, divided by the mass.
    scale = abs(speed) + PERIOD * (abs(acceleration) + abs(load) / inertia) + 1.0
    assert abs(reached - (speed + PERIOD * acceleration)) < 1e-11 * scale


def test_inverse_dynamics_tends_to_the_continuous_law():
    """As h -> 0 the force is M a + mu_v u + mu_s sgn(u) + N, with an error of first order."""
    aim, gains = Setpoint(0.1, 0.02, 0.3), InverseDynamicsGains(kp=9.0, kv=6.0)
    position, speed, load = 0.09, 0.01, 0.2
    acceleration = 0.3 + 6.0 * 0.01 + 9.0 * 0.01
    continuous = (
        PAPER_SI.inertia * acceleration + PAPER_SI.viscous * speed + PAPER_SI.coulomb + load
    )
    errors = [
        InverseDynamics(axis=PAPER_SI, gains=gains, period=h).force(
            position, speed, aim, 0.0, load
        )
        - continuous
        for h in (1e-4, 1e-5)
    ]
    # Ten times the period, ten times the error; second order adds h mu_v / M = 1 %.
    assert_allclose(errors[0] / errors[1], 10.0, rtol=0.02)


@settings(deadline=None)
@given(numbers, numbers, numbers, inertias, viscosities)
def test_pid_is_evaluated_at_the_end_of_the_period(position, speed, memory, inertia, viscous):
    """The force equals kp e + ki int e + kd e_dot at the state that it itself brings about."""
    axis = Axis(inertia=inertia, viscous=viscous)
    gains = PidGains(kp=50.0, ki=20.0, kd=3.0)
    aim = Setpoint(0.1, 0.02, 0.3)
    force = Pid(axis=axis, gains=gains, period=PERIOD).force(position, speed, aim, memory, 0.0)
    reached, rate = axis.propagate(position, speed, force, PERIOD)
    error = 0.1 + PERIOD * 0.02 - reached
    error_rate = 0.02 + PERIOD * 0.3 - rate
    expected = 50.0 * error + 20.0 * (memory + PERIOD * error) + 3.0 * error_rate
    # Rounding of terms of the size of the gains.
    assert abs(force - expected) < 1e-11 * 100.0


def test_response_joins_the_frictionless_limit():
    """The linear response with hardly any friction is that with none, to first order."""
    free, slow = (
        Axis(inertia=2e-3).response(PERIOD),
        Axis(inertia=2e-3, viscous=1e-5).response(PERIOD),
    )
    # x = mu_v h / M = 5e-6 is the relative size of what friction changes.
    assert_allclose(slow, free, rtol=1e-5)


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 5), st.lists(numbers, min_size=8, max_size=8))
def test_the_loop_predicts_its_delay_away(delay, kicks):
    """With the axis it believes in, delay only delays: the depths are those without it, later."""

    def run(late: int) -> list[float]:
        law = InverseDynamics(axis=PAPER_SI, gains=InverseDynamicsGains(), period=PERIOD)
        loop = SampledLoop(law, late, 100.0)
        waiting = [0.0] * late
        position, speed, path = 0.05, 0.0, []
        for i in range(200 + late):
            # The reference is that of the time at which the command takes effect.
            kick = kicks[min(i, 199) // 25]
            waiting.append(loop.command(position, speed, Setpoint(0.05 + 1e-3 * kick)))
            position, speed = PAPER_SI.propagate(position, speed, waiting.pop(0), PERIOD)
            path.append(position)
        return path[late:]

    # The same arithmetic in the same order, but for the rounding of a prediction at rest.
    assert_allclose(run(delay), run(0), rtol=0.0, atol=1e-12)


@pytest.mark.parametrize('delay', [0, 1, 3])
@pytest.mark.parametrize('unmodeled', [0, 1, 2])
def test_transition_matrix_is_the_loop(delay, unmodeled):
    """Powers of the matrix are what the running loop does to an initial error."""
    axis = PHANTOM.without_coulomb()
    law = Pid(axis=axis, gains=PidGains(tolerance=0.0), period=PERIOD)
    matrix = transition_matrix(law, delay, unmodeled)
    state = np.zeros(len(matrix))
    state[0] = 1e-3
    loop = SampledLoop(law, delay, np.inf)
    position, speed = 1e-3, 0.0
    waiting = [0.0] * (delay + unmodeled)
    for _ in range(50):
        state = matrix @ state
        waiting.append(loop.command(position, speed, Setpoint(0.0)))
        position, speed = axis.propagate(position, speed, waiting.pop(0), PERIOD)
    # Rounding over fifty steps.
    assert_allclose([position, speed], state[:2], rtol=1e-9, atol=1e-15)


def decays(law, unmodeled: int) -> bool:
    """Return whether an error of the loop without Coulomb friction is smaller at the end."""
    loop = SampledLoop(law.linear(), 1, np.inf)
    axis = law.axis.without_coulomb()
    position, speed = 1.0, 0.0
    waiting = [0.0] * (1 + unmodeled)
    sizes = []
    for _ in range(4000):
        waiting.append(loop.command(position, speed, Setpoint(0.0)))
        position, speed = axis.propagate(position, speed, waiting.pop(0), PERIOD)
        sizes.append(abs(position))
        if sizes[-1] > 1e6:
            return False
    return max(sizes[-500:]) < max(sizes[:500])


@pytest.mark.parametrize('axis', [PHANTOM, PAPER_SI], ids=['phantom', 'paper_si'])
@pytest.mark.parametrize('scale', [0.1, 1.0, 10.0, 100.0, 1000.0])
@pytest.mark.parametrize('law', [InverseDynamics, Pid])
def test_what_is_accepted_is_stable_and_what_is_refused_is_not(axis, law, scale):
    """Acceptance and the growth of the error in the running loop agree."""
    if law is Pid:
        gains = PidGains(kp=20.0 * scale, ki=0.0, kd=1.0 * scale, tolerance=0.0)
    else:
        gains = InverseDynamicsGains(kp=900.0 * scale, kv=60.0 * scale)
    chosen = law(axis=axis, gains=gains, period=PERIOD)
    stable = all(decays(chosen, unmodeled) for unmodeled in (0, 1))
    with nullcontext() if stable else pytest.raises(ParameterError, match='spectral radius'):
        check_stability(chosen, 1, 'gains')


def test_the_gains_of_the_source_hold_in_the_implicit_form():
    """On 2 g at 1 kHz kp = 1e3, kv = 1e4 are stable here; the textbook form explodes."""
    law = Pid(axis=PAPER_SI, gains=PidGains(kp=1e3, ki=0.0, kd=1e4), period=PERIOD)
    assert spectral_radius(law, 0) < 1.0
    decay, gain, drift, shift = PAPER_SI.response(PERIOD)
    textbook = np.array(
        [[1.0 - 1e3 * shift, drift - 1e4 * shift], [-1e3 * gain, decay - 1e4 * gain]]
    )
    assert np.abs(np.linalg.eigvals(textbook)).max() > 1000.0


def test_gains_that_cannot_be_stable_are_named():
    """The refusal names the gains, the rate and what was found."""
    law = InverseDynamics(axis=PHANTOM, gains=InverseDynamicsGains(kv=3000.0), period=PERIOD)
    with pytest.raises(ParameterError, match=r'my gains cannot be stable at 1000 Hz.*radius'):
        check_stability(law, 1, 'my gains')


def test_breakaway_overcomes_coulomb_friction_at_rest():
    """At rest with an error the inverse dynamics breaks away, at the sign of the error."""
    law = InverseDynamics(axis=PHANTOM, gains=InverseDynamicsGains(), period=PERIOD)
    for sign in (-1.0, 1.0):
        position, speed = 0.05, 0.0
        for _ in range(1000):
            force = law.force(position, speed, Setpoint(0.05 + sign * 1e-3), 0.0, 0.0)
            position, speed = PHANTOM.propagate(position, speed, force, PERIOD)
        # Compensation is full down to breakaway_speed / (h kp) = 0.11 mm from the target.
        assert abs(position - 0.05 - sign * 1e-3) < 1.2e-4


def test_the_integral_neither_winds_up_nor_hunts():
    """In a limit the integral stands still, and within the tolerance at rest it is frozen."""
    loop = SampledLoop(Pid(axis=PHANTOM, gains=PidGains(), period=PERIOD), 0, 1.0)
    for _ in range(100):
        assert loop.command(0.0, 0.0, Setpoint(0.1)) == 1.0
    assert loop.memory == 0.0
    loop.limit = 1e3
    loop.command(0.0, 0.0, Setpoint(1e-5))
    assert loop.memory == 0.0
    loop.command(0.0, 0.0, Setpoint(1e-3))
    assert loop.memory == pytest.approx(PERIOD * 1e-3, rel=1e-12)
