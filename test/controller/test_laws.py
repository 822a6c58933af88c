"""What the sampled laws do to the axes they believe in."""

from math import isfinite, pi

from hypothesis import given, settings
from hypothesis import strategies as st
import mpmath
from needle_controller import (
    Axis,
    DeflectionLaw,
    DeflectionLoop,
    InverseDynamics,
    InverseDynamicsGains,
    MinimumJerk,
    ModalLoop,
    no_memory,
    Pid,
    PidGains,
    ReferenceLimits,
    SampledLoop,
    Setpoint,
)
from needle_controller.compiled.laws import coupling, INTEGRAL, OFFSET, RATE
from needle_dynamics import NeedleModel, NeedleParameters, ParameterError, ShapeError
import numpy as np
from numpy.testing import assert_allclose
import pytest
from scipy.linalg import expm

MODEL = NeedleModel(NeedleParameters.preset('phantom'))
PHANTOM = Axis.insertion(MODEL.parameters)
PAPER_SI = Axis.insertion(NeedleParameters.preset('paper_si'))
PERIOD = 1e-3
#: An axis with stiffness, of 80 Hz and 10 % of critical damping.
SPRUNG = Axis(inertia=2e-3, viscous=0.2, stiffness=2e-3 * 500.0**2)

numbers = st.floats(-1.0, 1.0)
inertias = st.floats(1e-4, 10.0)
viscosities = st.floats(0.0, 500.0)
#: Angle of a free oscillation per period; beyond pi its samples do not tell which.
angles = st.one_of(st.just(0.0), st.floats(1e-3, 0.9 * pi))


def axis_of(inertia: float, viscous: float, angle: float) -> Axis:
    """Return an axis by the angle its undamped oscillation takes in a period."""
    return Axis(inertia=inertia, viscous=viscous, stiffness=inertia * (angle / PERIOD) ** 2)


@settings(deadline=None, derandomize=True)
@given(numbers, numbers, numbers, inertias, viscosities, angles)
def test_inverse_dynamics_gives_the_speed_it_aims_at(
    position, speed, load, inertia, viscous, angle
):
    """Held over the period, the force brings about u + h a exactly, on every axis."""
    axis = axis_of(inertia, viscous, angle)
    law = InverseDynamics(axis=axis, gains=InverseDynamicsGains(), period=PERIOD)
    aim = Setpoint(0.1, 0.02, 0.3)
    acceleration = 0.3 + 60.0 * (0.02 - speed) + 900.0 * (0.1 - position)
    force = law.force(position, speed, aim, no_memory(), load)
    _, reached = axis.propagate(position, speed, force - load, PERIOD)
    # Rounding of forces of the size mass * acceleration, elastic force and load, over the mass.
    elastic = PERIOD * axis.stiffness / inertia
    scale = abs(speed) + PERIOD * (abs(acceleration) + abs(load) / inertia) + 1.0 + elastic
    assert abs(reached - (speed + PERIOD * acceleration)) < 1e-11 * scale


@pytest.mark.parametrize('axis', [PAPER_SI, SPRUNG], ids=['friction', 'spring'])
def test_inverse_dynamics_tends_to_the_continuous_law(axis):
    """As h -> 0 the force is M a + mu_v u + k x + mu_s sgn(u) + N, with an error of order one."""
    aim, gains = Setpoint(0.1, 0.02, 0.3), InverseDynamicsGains(kp=9.0, kv=6.0)
    position, speed, load = 0.09, 0.01, 0.2
    acceleration = 0.3 + 6.0 * 0.01 + 9.0 * 0.01
    continuous = axis.inertia * acceleration + axis.viscous * speed + axis.stiffness * position
    continuous += axis.coulomb + load
    errors = [
        InverseDynamics(axis=axis, gains=gains, period=h).force(
            position, speed, aim, no_memory(), load
        )
        - continuous
        for h in (1e-4, 1e-5)
    ]
    # Ten times the period, ten times the error; second order adds at most 5 %, h omega.
    assert_allclose(errors[0] / errors[1], 10.0, rtol=0.05)


@settings(deadline=None, derandomize=True)
@given(numbers, numbers, numbers, inertias, viscosities, angles, st.floats(0.0, 0.1), numbers)
def test_pid_is_evaluated_at_the_end_of_the_period(
    position, speed, integral, inertia, viscous, angle, filter_time, filtered
):
    """The force equals kp e + ki int e + kd e_dot at the state that it itself brings about."""
    axis = axis_of(inertia, viscous, angle)
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
    # Rounding of terms of the size of the gains, and of speeds that a spring brings in.
    scale = 100.0 * (1.0 + angle / PERIOD)
    assert abs(force - expected) < 1e-11 * scale
    law.remember(position, speed, aim, memory, force, force)
    assert abs(memory[RATE] - low) < 1e-11 * scale


@settings(deadline=None, derandomize=True, max_examples=200)
@given(st.floats(-3.0, 6.0), st.floats(-2.0, 10.5), st.sampled_from([1e-6, 1e-3]))
def test_response_is_exact(damping, square, t):
    """Every entry agrees with the matrix exponential in 40 digits, damped a little or a lot."""
    gamma, omega2 = 10.0**damping, 10.0**square
    response = Axis(inertia=1.0, viscous=gamma, stiffness=omega2).response(t)
    with mpmath.workdps(40):
        matrix = mpmath.expm(t * mpmath.matrix([[0, 1, 0], [-omega2, -gamma, 1], [0, 0, 0]]))
    exact = [float(matrix[i, j]) for i, j in ((0, 0), (0, 1), (1, 0), (1, 1), (0, 2), (1, 2))]
    omega = np.sqrt(omega2)
    scales = np.array([1.0, 1.0 / omega, omega, 1.0, 1.0 / omega2, 1.0 / omega])
    # Rounding of the phase omega t, in the norm of energy.
    assert_allclose(response / scales, exact / scales, rtol=0.0, atol=1e-14 * (1.0 + omega * t))
    if omega * t < 1.0:
        # Slow against the period the force still acts to all digits.
        assert_allclose([response.pf, response.vf], [exact[4], exact[5]], rtol=1e-13)


def test_response_joins_its_limits():
    """Hardly any friction is like none, and hardly any stiffness too, to first order."""
    free = Axis(inertia=2e-3).response(PERIOD)
    # x = mu_v h / M = 5e-6, and k h^2 / M = 5e-6, are the relative sizes of what changes.
    assert_allclose(Axis(inertia=2e-3, viscous=1e-5).response(PERIOD), free, rtol=1e-5)
    soft = Axis(inertia=2e-3, stiffness=1e-2).response(PERIOD)
    assert_allclose(soft, free, rtol=1e-5, atol=6e-3)


@pytest.mark.parametrize(
    ('changes', 'words'),
    [
        ({'inertia': 0.0}, 'inertia must be finite and > 0'),
        ({'inertia': 1.0, 'viscous': -1.0}, 'viscous must be finite and >= 0'),
        ({'inertia': 1.0, 'stiffness': 1.0, 'coulomb': 1.0}, 'stiffness must have coulomb = 0'),
    ],
)
def test_axes_that_are_none_are_refused(changes, words):
    """No mass, negative damping, and dry friction on a spring."""
    with pytest.raises(ParameterError, match=words):
        Axis(**changes)


@settings(deadline=None, derandomize=True, max_examples=30)
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


@pytest.mark.parametrize('period', [1e-5, 1e-4, 1e-3])
def test_breakaway_overcomes_coulomb_friction_at_rest(period):
    """At rest with an error the inverse dynamics breaks away, at the sign of the error."""
    law = InverseDynamics(axis=PHANTOM, gains=InverseDynamicsGains(), period=period)
    for sign in (-1.0, 1.0):
        position, speed = 0.05, 0.0
        for _ in range(round(0.5 / period)):
            force = law.force(position, speed, Setpoint(0.05 + sign * 1e-3), no_memory())
            position, speed = PHANTOM.propagate(position, speed, force, period)
        # Compensation is full down to breakaway_speed / (1 ms kp) = 0.11 mm from the target.
        assert abs(position - 0.05 - sign * 1e-3) < 1.2e-4


# Anti-windup, feed-forward, memory.


def test_the_integral_neither_winds_up_nor_hunts():
    """In a limit the integral stands still, and within the tolerance at rest it is frozen."""
    loop = SampledLoop(Pid(axis=PHANTOM, gains=PidGains(), period=PERIOD), 0, 1.0)
    for _ in range(100):
        assert loop.command(0.0, 0.0, Setpoint(0.1)) == 1.0
    assert loop.memory[INTEGRAL] == 0.0
    loop.limit = 1e3
    loop.command(0.0, 0.0, Setpoint(1e-5))
    assert loop.memory[INTEGRAL] == 0.0
    loop.command(0.0, 0.0, Setpoint(1e-3))
    assert loop.memory[INTEGRAL] == pytest.approx(PERIOD * 1e-3, rel=1e-12)


def test_back_calculation_unwinds_in_its_tracking_time():
    """Without an error what exceeds the limit fades as exp(-t / tracking_time)."""
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
def test_a_limit_does_not_make_the_integral_overshoot(anti_windup):
    """After a long time in the limit the axis arrives without more overshoot than unlimited."""
    gains = PidGains(anti_windup=anti_windup, tracking_time=0.02)
    loop = SampledLoop(Pid(axis=PHANTOM, gains=gains, period=PERIOD), 1, 4.0)
    position, speed, waiting, path = 0.0, 0.0, [0.0], []
    for _ in range(20_000):
        waiting.append(loop.command(position, speed, Setpoint(0.05)))
        position, speed = PHANTOM.propagate(position, speed, waiting.pop(0), PERIOD)
        path.append(position)
    # The integral that slides at the limit, 4 N, is 0.7 mm of kp beyond what rest asks for.
    assert max(path) < 0.0512
    assert abs(path[-1] - 0.05) < 1e-4


@pytest.mark.parametrize('axis', [PHANTOM, PAPER_SI, SPRUNG], ids=['phantom', 'si', 'spring'])
def test_feed_forward_follows_the_reference_by_itself(axis):
    """With the axis it believes in, almost nothing is left to the feedback; without it a lot."""
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


@settings(deadline=None, derandomize=True)
@given(
    numbers,
    numbers,
    st.floats(-10.0, 10.0),
    st.sampled_from([PHANTOM, PAPER_SI, SPRUNG]),
    st.sampled_from(
        [
            InverseDynamicsGains(),
            PidGains(),
            PidGains(ki=0.0, filter_time=0.01),
            PidGains(feed_forward=True, anti_windup='back_calculation'),
        ]
    ),
)
def test_a_switch_has_no_bump(position, speed, last, axis, gains):
    """Whatever law follows, its first force is the last one of the law before."""
    law = InverseDynamics if isinstance(gains, InverseDynamicsGains) else Pid
    loop = SampledLoop(Pid(axis=axis, gains=PidGains(), period=PERIOD), 1, 20.0)
    loop.last = last
    loop.switch(law(axis=axis, gains=gains, period=PERIOD))
    # Rounding of forces of the size of the gains and of the spring, times the divisor of PID.
    scale = 1e-9 * (1.0 + axis.stiffness)
    assert loop.command(position, speed, Setpoint(0.1, 0.01, 0.2)) == pytest.approx(
        last, abs=scale
    )
    # The next command is the law's own again: finite, whatever the bridge took.
    assert isfinite(loop.command(position, speed, Setpoint(0.1, 0.01, 0.2)))


def test_what_bridges_a_switch_fades():
    """The force that inverse dynamics took over is gone after ten times its 0.1 s."""
    loop = SampledLoop(Pid(axis=PHANTOM, gains=PidGains(), period=PERIOD), 0, 20.0)
    loop.last = 3.0
    law = InverseDynamics(axis=PHANTOM, gains=InverseDynamicsGains(), period=PERIOD)
    loop.switch(law)
    for _ in range(1000):
        force = loop.command(0.05, 0.0, Setpoint(0.05))
    # exp(-10) of the 3 N.
    assert abs(force) == pytest.approx(3.0 * np.exp(-9.99), rel=1e-6)
    assert loop.memory[OFFSET] < 2e-4


def test_a_stopped_loop_keeps_what_it_knows():
    """A stop takes the commands off the way; the integral waits, and a reset forgets it."""
    loop = SampledLoop(Pid(axis=PHANTOM, gains=PidGains(), period=PERIOD), 2, 20.0)
    for _ in range(10):
        loop.command(0.05, 0.0, Setpoint(0.051))
    integral = loop.memory[INTEGRAL]
    loop.stop()
    assert list(loop.on_the_way) == [0.0, 0.0]
    assert loop.memory[INTEGRAL] == integral > 0.0
    loop.reset()
    assert not loop.memory.any()


def test_a_switch_keeps_the_period():
    """A law of another period belongs into another loop."""
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
def test_gains_that_are_none_are_refused(changes, words):
    """Unknown names and numbers out of range, with what would be valid."""
    with pytest.raises(ParameterError, match=words):
        PidGains(**changes)


# The deflection.

#: Tissue in two layers, and modes that the general evaluation is for.
LAYERED = NeedleModel(
    NeedleParameters.preset('phantom', layer_depths=[0.05], layer_stiffnesses=[2000.0])
)
FOUR = NeedleModel(NeedleParameters.preset('phantom', modes=4, minimum_depth=0.05))


@pytest.mark.parametrize(
    ('model', 'depth'),
    [
        *((MODEL, depth) for depth in (0.005, 0.02, 0.1, 0.2)),
        *((LAYERED, depth) for depth in (0.005, 0.05, 0.2)),
        *((FOUR, depth) for depth in (0.08, 0.2)),
    ],
)
def test_normal_modes_are_the_model(model, depth):
    """V^T M V = 1, V^T K V = omega^2, and forces turn as the power asks for."""
    law = DeflectionLaw(model=model, gains=InverseDynamicsGains(), period=PERIOD)
    modes = law.at(depth)
    mass = model.parameters.linear_density * model.modes.integrals(depth).gram
    v = modes.shapes
    # Rounding times cond(G), 1e5 at 2 cm, over the entries of V.
    assert_allclose(v.T @ mass @ v, np.eye(law.count), atol=1e-9)
    stiffness = v.T @ model.stiffness_matrix(depth) @ v
    assert_allclose(stiffness, np.diag(modes.squares), atol=1e-9 * modes.squares[-1])
    q, force = (
        np.array([0.3, -0.2, 0.1, 0.4])[: law.count],
        np.array([2.0, 5.0, 1.0, 3.0])[: law.count],
    )
    assert_allclose(modes.from_normal(modes.to_normal(q)), q, rtol=1e-10)
    assert_allclose(modes.from_normal_force(modes.to_normal_force(force)), force, rtol=1e-10)
    power = modes.to_normal_force(force) @ modes.to_normal(q)
    assert_allclose(power, force @ q, rtol=1e-8)


def test_the_modes_at_2_cm_are_those_of_the_needle():
    """2.2 kHz and 22 kHz at 2 cm, 42 Hz and 144 Hz at full insertion."""
    law = DeflectionLaw(model=MODEL, gains=InverseDynamicsGains(), period=PERIOD)
    assert_allclose(law.at(0.02).frequencies, [2230.0, 21940.0], rtol=1e-3)
    assert_allclose(law.at(0.2).frequencies, [42.3, 143.7], rtol=1e-3)


@pytest.mark.parametrize('formulation', ['complete', 'as_printed'])
def test_loads_are_the_bias_forces_of_the_model(formulation):
    """What couples motion and deflection is what the model has beyond the linear modal part."""
    model = NeedleModel(NeedleParameters.preset('phantom', formulation=formulation))
    law = DeflectionLaw(model=model, gains=InverseDynamicsGains(), period=PERIOD)
    state = np.array([0.08, 0.1, 2e-4, -5e-5, -0.02, 0.3, 0.02, 0.01])
    x, speed = np.stack([state[2:4], state[6:]]), 0.02
    against, held = coupling(law.constants, law.at(0.12).table, x, speed)
    bias = model.bias_forces(state)
    linear = model.stiffness_matrix(0.12) @ x[0]
    linear += model.parameters.tissue_damping * model.modes.integrals(0.12).gram @ x[1]
    assert_allclose(against, -bias[0], rtol=1e-12)
    # Small differences of the linear part.
    assert_allclose(held, bias[2:] - linear, rtol=1e-12, atol=1e-13 * np.abs(linear).max())


GAINS = {
    'inverse_dynamics': InverseDynamicsGains(kp=900.0, kv=60.0),
    'pid': PidGains(kp=5.0, ki=20.0, kd=0.02, filter_time=2e-3),
    'feed_forward': PidGains(kp=5.0, ki=20.0, kd=0.02, feed_forward=True),
}


@pytest.mark.parametrize('kind', GAINS)
@pytest.mark.parametrize('depth', [0.12, 0.2])
def test_laws_on_deflections_do_what_they_say(kind, depth):
    """Forces held over a period bring about u + h a, or equal PID at the state they lead to."""
    gains = GAINS[kind]
    law = DeflectionLaw(model=MODEL, gains=gains, period=PERIOD)
    modes, rng = law.at(depth), np.random.default_rng(5)
    x, target = 1e-3 * rng.standard_normal((2, 2)), 1e-3 * rng.standard_normal((3, 2))
    memory = no_memory(2)
    memory[INTEGRAL], memory[RATE] = rng.standard_normal((2, 2)) * 1e-3
    old = memory.copy()
    loop = DeflectionLoop(law, 0)
    loop.memory = memory
    force, _ = loop.answer(modes, x, target, 0.0)
    # An independent solution: the exponential of the modal rows in q.
    gram = MODEL.modes.integrals(depth).gram
    mass = MODEL.parameters.linear_density * gram
    drift = np.block(
        [
            [np.zeros((2, 2)), np.eye(2), np.zeros((2, 1))],
            [
                -np.linalg.solve(mass, MODEL.stiffness_matrix(depth)),
                -np.eye(2) * MODEL.parameters.tissue_damping / MODEL.parameters.linear_density,
                np.linalg.solve(mass, force)[:, np.newaxis],
            ],
            [np.zeros((1, 5))],
        ]
    )
    end, rate = (expm(PERIOD * drift) @ [*x.ravel(), 1.0])[:4].reshape(2, 2)
    if isinstance(gains, InverseDynamicsGains):
        wanted = target[2] + gains.kv * (target[1] - x[1]) + gains.kp * (target[0] - x[0])
        assert_allclose(rate, x[1] + PERIOD * wanted, rtol=1e-9, atol=1e-14)
        return
    error = target[0] + PERIOD * target[1] - end
    error_rate = target[1] + PERIOD * target[2] - rate
    share = PERIOD / (gains.filter_time + PERIOD)
    low = (1.0 - share) * old[RATE] + share * error_rate
    expected = gains.kp * error + gains.ki * (old[INTEGRAL] + PERIOD * error) + gains.kd * low
    if gains.feed_forward:
        # The force that takes the modes along the reference.
        plain = DeflectionLaw(
            model=MODEL, gains=InverseDynamicsGains(kp=0.0, kv=0.0), period=PERIOD
        )
        expected = expected + DeflectionLoop(plain, 0).answer(modes, target[:2], target, 0.0)[0]
    assert_allclose(force, expected, rtol=1e-9)
    assert_allclose(memory[RATE], low, rtol=1e-9)
    assert_allclose(memory[INTEGRAL], old[INTEGRAL] + PERIOD * (target[0] - x[0]), rtol=1e-12)


def test_one_mode_is_one_axis():
    """With one mode the law on deflections is the law on that mode's axis."""
    model = NeedleModel(NeedleParameters.preset('phantom', modes=1))
    gains = InverseDynamicsGains()
    law = DeflectionLaw(model=model, gains=gains, period=PERIOD)
    modes = law.at(0.15)
    alone = InverseDynamics(axis=modes.axes[0], gains=gains, period=PERIOD)
    x = np.array([[2e-4], [3e-3]])
    force = DeflectionLoop(law, 0).command(modes, x, np.zeros((3, 1)))
    (position,), (rate,) = modes.to_normal(x[0]), modes.to_normal(x[1])
    single = alone.force(position, rate, Setpoint(0.0), no_memory())
    assert_allclose(modes.to_normal_force(force), [single], rtol=1e-12)


def modal_loop(gains, delay: int, model: NeedleModel = MODEL) -> ModalLoop:
    """Return a loop with the same law on all coordinates."""
    kind = InverseDynamics if isinstance(gains, InverseDynamicsGains) else Pid
    return ModalLoop(
        kind(axis=Axis.insertion(model.parameters), gains=gains, period=PERIOD),
        kind(axis=Axis.rotation(model.parameters), gains=gains, period=PERIOD),
        DeflectionLaw(model=model, gains=gains, period=PERIOD),
        delay,
        force_limit=10.0,
        torque_limit=1.0,
    )


class PlainModalLoop:
    """What `ModalLoop` does, in q1..qn and by matrix exponentials, without normal modes."""

    def __init__(self, like: ModalLoop, delay: int) -> None:
        self.laws = like.insertion.law, like.rotation.law
        self.gains = like.deflection.law.gains
        self.delay, self.sent = delay, [np.zeros(4)] * delay
        self.memories = no_memory(), no_memory()
        self.integral, self.rate = np.zeros(2), np.zeros(2)

    def command(self, state: np.ndarray, insertion: Setpoint, target: np.ndarray) -> np.ndarray:
        p, g = MODEL.parameters, self.gains
        depth, speed, angle, turn = p.length - state[0], -state[4], state[1], state[5]
        at = depth + 0.5 * (self.delay + 1) * PERIOD * speed
        integrals, stiffness = MODEL.modes.integrals(at), MODEL.stiffness_matrix(at)
        inverse = np.linalg.inv(p.linear_density * integrals.gram)
        drift = np.zeros((6, 6))
        drift[:2, 2:4], drift[2:4, :2], drift[2:4, 4:] = np.eye(2), -inverse @ stiffness, inverse
        drift[2:4, 2:4] = -np.eye(2) * p.tissue_damping / p.linear_density
        flow = expm(PERIOD * drift)[:4]
        x = np.concatenate([state[2:4], state[6:]])

        def coupled() -> tuple[float, np.ndarray]:
            tip, rate = integrals.value @ x[:2], integrals.value @ x[2:]
            bend = integrals.curvature @ x[:2]
            elastic = p.bending_stiffness * bend**2 + p.tissue_stiffness * tip**2
            held = p.linear_density * speed * rate * integrals.value
            return 0.5 * (elastic - p.linear_density * rate**2), held

        for force in self.sent:
            against, held = coupled()
            x = flow @ np.concatenate([x, force[2:] - held])
            depth, speed = self.laws[0].axis.propagate(depth, speed, force[0] - against, PERIOD)
            angle, turn = self.laws[1].axis.propagate(angle, turn, force[1], PERIOD)
        against, held = coupled()
        free, push = flow[:, :4] @ x, flow[:, 4:]
        if isinstance(g, InverseDynamicsGains):
            wanted = target[2] + g.kv * (target[1] - x[2:]) + g.kp * (target[0] - x[:2])
            forces = held + np.linalg.solve(push[2:], x[2:] + PERIOD * wanted - free[2:])
        else:
            share = PERIOD / (g.filter_time + PERIOD)
            ahead = np.concatenate(
                [target[0] + PERIOD * target[1], target[1] + PERIOD * target[2]]
            )
            # Forces = gains [e, e_dot] + rest, with [e, e_dot] = ahead - free - push forces.
            gains = np.hstack([(g.kp + PERIOD * g.ki) * np.eye(2), g.kd * share * np.eye(2)])
            rest = g.ki * self.integral + g.kd * (1.0 - share) * self.rate
            if g.feed_forward:
                along = np.concatenate([target[0], target[1]])
                rest = rest + np.linalg.solve(push[2:], ahead[2:] - flow[2:, :4] @ along)
            forces = np.linalg.solve(np.eye(2) + gains @ push, gains @ (ahead - free) + rest)
            error_rate = (ahead - free - push @ forces)[2:]
            self.rate = (1.0 - share) * self.rate + share * error_rate
            self.integral = self.integral + PERIOD * (target[0] - x[:2])
        base = []
        for law, memory, at_now, load in (
            (self.laws[0], self.memories[0], (depth, speed, insertion), against),
            (self.laws[1], self.memories[1], (angle, turn, Setpoint(0.0)), 0.0),
        ):
            base.append(law.force(*at_now, memory, load))
            law.remember(*at_now, memory, base[-1], base[-1])
        self.sent = [*self.sent, np.array([*base, *forces])]
        answer = self.sent[-1]
        self.sent = self.sent[len(self.sent) - self.delay :]
        return answer


@pytest.mark.parametrize('delay', [0, 1, 3])
@pytest.mark.parametrize('kind', GAINS)
def test_the_modal_loop_is_the_law_written_plainly(kind, delay):
    """Period by period all forces agree, for a needle that moves, bends and is late."""
    loop = modal_loop(GAINS[kind], delay)
    loop.insertion.limit = loop.rotation.limit = np.inf
    plain, rng = PlainModalLoop(loop, delay), np.random.default_rng(8)
    for _ in range(20):
        state = MODEL.state_at(rng.uniform(0.17, 0.19), 1e-3 * rng.standard_normal())
        state[4:] = rng.standard_normal(4) * (0.01, 0.1, 1e-3, 1e-3)
        aim = Setpoint(*rng.standard_normal(3) * (0.01, 0.01, 0.1))
        target = 1e-4 * rng.standard_normal((3, 2))
        found = loop.command(state, aim, Setpoint(0.0), target)
        # Rounding of the exponential and of two eigenproblems; forces cancel by a factor of ten.
        assert_allclose(found, plain.command(state, aim, target), rtol=1e-12)


@pytest.mark.parametrize('gains', [InverseDynamicsGains(), GAINS['pid']], ids=['id', 'pid'])
def test_a_modal_switch_has_no_bump(gains):
    """All forces go on from where they were."""
    loop = modal_loop(PidGains(kp=1.0, ki=3.0, kd=1e-3), 1)
    state = MODEL.state_at(0.15, 1e-3)
    aims = Setpoint(0.15), Setpoint(0.0), np.zeros((3, 2))
    before = loop.command(state, *aims)
    after = modal_loop(gains, 1)
    loop.switch(after.insertion.law, after.rotation.law, after.deflection.law)
    assert_allclose(loop.command(state, *aims), before, rtol=1e-9, atol=1e-12)
    loop.stop()
    assert not any(force.any() for force in loop.deflection.on_the_way)
    loop.reset()
    assert not loop.deflection.memory.any()


def test_the_modal_loop_checks_what_it_gets():
    """Wrong shapes and laws of different periods."""
    loop = modal_loop(InverseDynamicsGains(), 0)
    state = MODEL.state_at(0.15)
    with pytest.raises(ShapeError, match=r'deflection must be finite with shape \(3, 2\)'):
        loop.command(state, Setpoint(0.15), Setpoint(0.0), np.zeros(2))
    slow = DeflectionLaw(model=MODEL, gains=InverseDynamicsGains(), period=2e-3)
    with pytest.raises(ParameterError, match='one period'):
        ModalLoop(
            loop.insertion.law, loop.rotation.law, slow, 0, force_limit=1.0, torque_limit=1.0
        )
    with pytest.raises(ParameterError, match='period and number of modes must stay'):
        loop.deflection.switch(slow)
    with pytest.raises(ParameterError, match='inserted length must be > 0'):
        slow.at(0.0)
    swelling = NeedleModel(NeedleParameters.preset('phantom', swelling=0.3))
    with pytest.raises(
        ParameterError, match=r'swelling must be 0 with modal actuation.* got 0\.3'
    ):
        DeflectionLaw(model=swelling, gains=InverseDynamicsGains(), period=PERIOD)
