# SPDX-License-Identifier: Apache-2.0
"""The stability check accepts stable gains and rejects unstable gains."""

from contextlib import nullcontext
from dataclasses import replace
from math import log
import re
from typing import Any

from hypothesis import assume, given, HealthCheck, settings
from hypothesis import strategies as st
from needle_controller import (
    Axis,
    check_stability,
    InverseDynamics,
    InverseDynamicsGains,
    Pid,
    PidGains,
    Setpoint,
    stability,
    Uncertainty,
)
from needle_controller.compiled import laws, loop
from needle_controller.gains import LAW_OF
from needle_controller.laws.law import SampledLoop
from needle_controller.stability import delay_margin, HIGHEST_RATE, LinearLoop, stability_limit
from needle_dynamics import Integrator, NeedleModel, NeedleParameters, ParameterError
import numpy as np
from numpy.testing import assert_allclose
import pytest

MODEL = NeedleModel(NeedleParameters.preset('phantom'))
PHANTOM = Axis.insertion(MODEL.parameters)
PAPER_SI = Axis.insertion(NeedleParameters.preset('paper_si'))
PERIOD = 1e-3

PROPERTY = settings(suppress_health_check=[HealthCheck.filter_too_much])


@pytest.mark.parametrize('delay', [0, 1, 3])
@pytest.mark.parametrize('unmodeled', [0, 1, 2])
@pytest.mark.parametrize('filter_time', [0.0, 5e-3])
def test_transition_matrix_equals_the_loop(delay: int, unmodeled: int, filter_time: float) -> None:
    """Powers of the matrix propagate an initial error as the running loop."""
    axis = PHANTOM.without_coulomb()
    gains = PidGains(tolerance=0.0, filter_time=filter_time)
    law = Pid(axis=axis, gains=gains, period=PERIOD)
    (matrix,) = LinearLoop(law, delay).transition_matrices(unmodeled, [axis])
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


def decays(law: InverseDynamics | Pid, unmodeled: int) -> bool:
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
def test_stability_check_agrees_with_simulation(
    axis: Axis, law: type[InverseDynamics] | type[Pid], scale: float
) -> None:
    """Acceptance and the growth of the error in the running loop agree."""
    gains: InverseDynamicsGains | PidGains
    if law is Pid:
        gains = PidGains(kp=20.0 * scale, ki=0.0, kd=1.0 * scale, tolerance=0.0)
    else:
        gains = InverseDynamicsGains(kp=900.0 * scale, kv=60.0 * scale)
    chosen = law_of(gains, axis)
    stable = all(decays(chosen, unmodeled) for unmodeled in (0, 1))
    with nullcontext() if stable else pytest.raises(ParameterError, match='spectral radius'):
        check_stability(chosen, 1, 'gains')


def power_of_ten(low: float, high: float) -> st.SearchStrategy[float]:
    """Return numbers spread evenly over decades."""
    return st.floats(low, high).map(lambda exponent: 10.0**exponent)


gains_of_a_law = st.one_of(
    st.builds(
        InverseDynamicsGains,
        kp=power_of_ten(1.5, 6.0),
        kv=power_of_ten(0.5, 3.3),
        bandwidth=st.sampled_from([0.0, 30.0, 300.0]),
        tolerance=st.just(0.0),
    ),
    st.builds(
        PidGains,
        kp=power_of_ten(1.0, 5.0),
        ki=st.one_of(st.just(0.0), power_of_ten(0.0, 6.0)),
        kd=power_of_ten(-2.0, 4.0),
        filter_time=st.sampled_from([0.0, 2e-3]),
        tolerance=st.just(0.0),
    ),
)


def law_of(gains: InverseDynamicsGains | PidGains, axis: Axis) -> InverseDynamics | Pid:
    """Return the law that the gains are for."""
    if isinstance(gains, InverseDynamicsGains):
        return InverseDynamics(axis=axis, gains=gains, period=PERIOD)
    return Pid(axis=axis, gains=gains, period=PERIOD)


@settings(PROPERTY, max_examples=60)
@given(
    gains_of_a_law,
    st.sampled_from(['phantom', 'paper_si', 'paper_mm']),
    st.sampled_from([0.0, 0.1, 0.56]),
    st.floats(0.003, 0.198),
    st.integers(0, 2),
    st.integers(0, 1),
)
def test_accepted_gains_are_stable_at_every_depth(
    gains: InverseDynamicsGains | PidGains,
    preset: str,
    coulomb: float,
    depth: float,
    delay: int,
    unmodeled: int,
) -> None:
    """On the true, bent needle the error stays bounded and ends within the friction band."""
    truth = NeedleParameters.preset(preset, coulomb_friction=coulomb)
    law = law_of(gains, Axis.insertion(truth))
    assume(stability_limit(law, delay).stable)
    radius = LinearLoop(law, delay).spectral_radius(unmodeled)
    # Four decades of the slowest pole, not longer than three seconds.
    periods = 50 + round(log(1e-4) / log(radius))
    assume(periods <= 3000)
    model = NeedleModel(truth)
    state = model.state_at(depth, 2e-4 * depth)
    # The bent needle pulls by the change of its energy, which is proportional to s^-3.
    pull = 5.0 * model.energy(state) / depth
    needle = Integrator(truth, state, 1e-4)
    error = 1e-4 if depth < 0.1 else -1e-4
    loop, waiting = SampledLoop(law, delay, np.inf), [0.0] * (delay + unmodeled)
    errors = []
    for _ in range(periods):
        measured = needle.depth, needle.velocity
        errors.append(depth + error - measured[0])
        waiting.append(loop.command(*measured, Setpoint(depth + error)))
        needle.advance(PERIOD, waiting.pop(0))
    # Friction holds the needle against smaller forces of the law: at rest, the compensation of
    # inverse dynamics grows by kp e 1 ms / breakaway_speed. An undamped needle keeps pulling.
    c = law.constants
    if isinstance(gains, InverseDynamicsGains) and not gains.bandwidth:
        band = (1e-4 / (1e-3 * gains.kp) if coulomb else 0.0) + pull / (PHANTOM.inertia * gains.kp)
    else:
        # The law predicts a motion that friction prevents, and divides its force by the predicted
        # reduction. Stick-slip under the integral overshoots by the same distance.
        r, h = law.axis.response(PERIOD), PERIOD
        share = h / (h + c.filter_time)
        divisor = 1.0 + (c.kp + h * c.ki) * r.pf + c.kd * share * r.vf
        band = divisor * (2.0 * coulomb + pull) / c.kp
    # A fast loop with a period of unmodeled delay oscillates before it settles.
    assert max(map(abs, errors)) < 20.0 * (abs(error) + band)
    assert max(map(abs, errors[-20:])) < 0.02 * abs(error) + band


@settings(PROPERTY, max_examples=60)
@given(gains_of_a_law, st.sampled_from([PHANTOM, PAPER_SI]), st.integers(0, 3), st.integers(0, 1))
def test_pole_outside_the_unit_circle_diverges(
    gains: InverseDynamicsGains | PidGains, axis: Axis, delay: int, unmodeled: int
) -> None:
    """In the running loop without friction the error grows by the spectral radius."""
    law = law_of(gains, axis)
    radius = LinearLoop(law, delay).spectral_radius(unmodeled)
    assume(radius > 1.0 + 1e-3)
    assert not stability_limit(law, delay).stable
    loop, linear = SampledLoop(law.linear(), delay, np.inf), axis.without_coulomb()
    waiting, (position, speed) = [0.0] * (delay + unmodeled), (1e-6, 0.0)
    for _ in range(100_000):
        waiting.append(loop.command(position, speed, Setpoint(0.0)))
        position, speed = linear.propagate(position, speed, waiting.pop(0), PERIOD)
        if abs(position) > 1.0:
            break
    assert abs(position) > 1.0


def test_gains_of_the_paper_are_stable_in_implicit_form() -> None:
    """On 2 g at 1 kHz kp = 1e3, kv = 1e4 are stable here; the textbook form diverges."""
    law = Pid(axis=PAPER_SI, gains=PidGains(kp=1e3, ki=0.0, kd=1e4), period=PERIOD)
    assert LinearLoop(law, 0).spectral_radius() < 1.0
    r = PAPER_SI.response(PERIOD)
    textbook = np.array([[1.0 - 1e3 * r.pf, r.pv - 1e4 * r.pf], [-1e3 * r.vf, r.vv - 1e4 * r.vf]])
    assert np.abs(np.linalg.eigvals(textbook)).max() > 1000.0


@pytest.mark.parametrize('rate', [100.0, 1e3, 1e4])
def test_slow_gains_of_the_paper_are_within_the_margin(rate: float) -> None:
    """k_p = 1, k_v = 0.1 take a minute to settle; the default margin permits them."""
    law = InverseDynamics(
        axis=PAPER_SI, gains=InverseDynamicsGains(kp=1.0, kv=0.1), period=1.0 / rate
    )
    check_stability(law, 1, 'gains')
    # The pole is at -0.05 1/s; the period adds h k_p / (2 k_v) to that.
    assert_allclose(1.0 - LinearLoop(law, 1).spectral_radius(), 0.05 / rate, rtol=0.05)


def test_margin_is_enforced() -> None:
    """A margin larger than the margin of the loop is rejected, a smaller one accepted."""
    law = Pid(axis=PHANTOM, gains=PidGains(ki=0.0), period=PERIOD)
    # The slow pole is at -kp / (mu_v + kd) = -15 1/s.
    assert_allclose(LinearLoop(law, 1).spectral_radius(), 1.0 - 0.015, atol=5e-4)
    check_stability(law, 1, 'gains', margin=0.014)
    with pytest.raises(ParameterError, match=r'radius 0\.98.* must be <= 1 - 0\.02') as refusal:
        check_stability(law, 1, 'gains', margin=0.02)
    factor = float(re.search(r'times ([\d.]+) would', str(refusal.value))[1])
    assert factor > 1.0
    check_stability(law.scaled(factor), 1, 'gains', margin=0.02)
    with pytest.raises(ParameterError, match=r'margin must be in \[0, 1\)'):
        check_stability(law, 1, 'gains', margin=1.0)


def test_unstable_gains_are_rejected_with_advice() -> None:
    """The error contains the gains, the rate, the spectral radius and a stable change."""
    law = InverseDynamics(axis=PHANTOM, gains=InverseDynamicsGains(kv=3000.0), period=PERIOD)
    words = (
        r'my gains are unstable at 1000 Hz with a delay of 1 period: spectral radius .* '
        r'must be <= 1 - 1e-06; all gains times ([\d.]+) would be stable'
    )
    with pytest.raises(ParameterError, match=words) as refusal:
        check_stability(law, 1, 'my gains')
    factor = float(re.search(words, str(refusal.value))[1])
    check_stability(law.scaled(factor), 1, 'my gains')
    # Gains larger by 10 % are unstable.
    assert not stability_limit(law.scaled(1.15 * factor), 1).stable


def test_search_for_stable_gains_ends_at_the_highest_rate(monkeypatch: pytest.MonkeyPatch) -> None:
    """Only valid rates are simulated; up to 1 MHz, this search took three minutes."""
    rates, ring = [], loop.ring

    def recorded(law: tuple[float, ...], *others: Any) -> tuple[float, float, int]:
        rates.append(1.0 / laws.LawConstants(*law).period)
        return ring(law, *others)

    monkeypatch.setattr(stability, 'ring', recorded)
    law = law_of(PidGains(kp=100.0, ki=1e5, kd=1e4), PHANTOM)
    plants = Uncertainty().axes(PHANTOM, carriage=True)
    with pytest.raises(ParameterError, match=r'no common factor .* and no rate up to 10000 Hz'):
        check_stability(law, 1, 'gains', plants=plants)
    assert 1e3 < max(rates) <= HIGHEST_RATE


@pytest.mark.parametrize(
    ('gains', 'missing'),
    [(InverseDynamicsGains(kp=0.0), 'kp'), (PidGains(kp=0.0, ki=0.0, kd=0.0), 'kp and kd')],
)
def test_missing_gains_are_named(gains: InverseDynamicsGains | PidGains, missing: str) -> None:
    """No common factor replaces a gain of zero."""
    with pytest.raises(ParameterError, match=f'{missing} must not be zero'):
        check_stability(law_of(gains, PAPER_SI), 1, 'gains')


def test_uncertainty_axes_cover_all_bounds() -> None:
    """The axes have every combination of bounds, and at most the whole carriage mass."""
    axes = Uncertainty(viscous=0.2, coulomb=0.1, inertia=0.5, carriage=1.0).axes(
        PHANTOM, carriage=True
    )
    for name, share in (('viscous', 0.2), ('coulomb', 0.1)):
        value = getattr(PHANTOM, name)
        expected = {value * (1.0 - share), value, value * (1.0 + share)}
        assert {getattr(axis, name) for axis in axes} == expected
    inertias = [axis.inertia for axis in axes]
    assert min(inertias) == 0.5 * PHANTOM.inertia
    assert max(inertias) == 1.5 * PHANTOM.inertia + 1.0
    exact = Uncertainty(viscous=0.0, coulomb=0.0, inertia=0.0, carriage=0.0)
    assert exact.axes(PHANTOM, carriage=True) == [PHANTOM]


@pytest.mark.parametrize('delay', [0, 1, 2])
@pytest.mark.parametrize('rate', [50.0, 100.0, 1000.0, 4000.0])
def test_default_gains_are_stable_on_all_uncertain_axes(rate: float, delay: int) -> None:
    """Friction and mass 50 % off, with an unmodeled carriage of 2 kg."""
    half = Uncertainty(viscous=0.5, coulomb=0.5, inertia=0.5)
    law = InverseDynamics(axis=PHANTOM, gains=InverseDynamicsGains(), period=1.0 / rate)
    check_stability(law, delay, 'gains', plants=half.axes(PHANTOM, carriage=True))


def test_overcompensated_friction_is_rejected() -> None:
    """The law of the paper compensates too much friction: a limit cycle, or an unstable pole."""
    gains = InverseDynamicsGains(bandwidth=0.0)
    law = InverseDynamics(axis=PHANTOM, gains=gains, period=PERIOD)
    less_dry = replace(PHANTOM, coulomb=0.7 * PHANTOM.coulomb)
    with pytest.raises(ParameterError, match=r'coulomb friction 0\.392 .*a limit cycle of'):
        check_stability(law, 0, 'gains', plants=[less_dry])
    less = replace(PHANTOM, viscous=0.7 * PHANTOM.viscous)
    with pytest.raises(ParameterError, match=r'viscous friction 210 .* bandwidth = 30'):
        check_stability(law, 0, 'gains', plants=[less])
    # The nominal axis is stable, as in the paper.
    check_stability(law, 0, 'gains')


#: Longer run of a law that decays slowly [s].
_SLOW = 400.0


def comes_to_rest(
    law: InverseDynamics | Pid, plant: Axis, delay: int, unmodeled: int, duration: float = 20.0
) -> bool:
    """Run a law for 20 s on an axis; return whether it holds still within the last second."""
    n, h = round(duration / law.period), law.period
    loop = SampledLoop(law, delay, np.inf)
    position, speed, path = 1e-3, 0.0, np.empty(n)
    waiting = [0.0] * (delay + unmodeled)
    for i in range(n):
        waiting.append(loop.command(position, speed, Setpoint(0.0)))
        position, speed = plant.propagate(position, speed, waiting.pop(0), h)
        path[i] = position
        if not abs(position) < 1.0:
            return False
    last, before = (np.ptp(part) for part in (path[-n // 20 :], path[-n // 5 : -n // 10]))
    if last <= max(1e-5, 0.9 * before):
        return True
    if duration < _SLOW:
        # Weak integral action with dry friction slips less often than once in 20 s.
        return comes_to_rest(law, plant, delay, unmodeled, _SLOW)
    last, before = (np.ptp(part) for part in (path[-n // 4 :], path[n // 4 : n // 2]))
    return bool(last <= 0.95 * before)


def test_weak_integral_action_with_dry_friction_decays() -> None:
    """Its slips are half a minute apart, and each is smaller than the one before."""
    axis = replace(PHANTOM, inertia=0.002032)
    gains = PidGains(kp=10.0, ki=10**2.125, kd=1.0, tolerance=0.0)
    law = replace(law_of(gains, axis), period=0.01)
    assert stability_limit(law, 0, plants=[axis]).stable
    assert all(comes_to_rest(law, axis, 0, unmodeled) for unmodeled in (0, 1))


@settings(PROPERTY, max_examples=25)
@given(
    gains_of_a_law,
    st.sampled_from([PHANTOM, PAPER_SI]),
    st.sampled_from([100.0, 500.0, 1000.0]),
    st.integers(0, 2),
    st.floats(0.0, 0.5),
    st.sampled_from([0.0, 0.5, 2.0]),
    st.data(),
)
def test_accepted_laws_settle_on_all_uncertain_axes(
    gains: InverseDynamicsGains | PidGains,
    axis: Axis,
    rate: float,
    delay: int,
    width: float,
    carriage: float,
    data: st.DataObject,
) -> None:
    """No false acceptance: the motion ends on each axis, with dry friction."""
    law = replace(law_of(gains, axis), period=1.0 / rate)
    box = Uncertainty(viscous=width, coulomb=width, inertia=width, carriage=carriage)
    plants = box.axes(axis, carriage=True)
    assume(stability_limit(law, delay, plants=plants).stable)
    corner, unmodeled = data.draw(st.sampled_from(plants)), data.draw(st.integers(0, 1))
    assert comes_to_rest(law, corner, delay, unmodeled)


@pytest.mark.requirement('S-321')
@pytest.mark.parametrize('gains', [InverseDynamicsGains(), PidGains()])
@pytest.mark.parametrize('rate', [200.0, 1000.0])
def test_delay_margin_is_the_largest_stable_delay(
    gains: InverseDynamicsGains | PidGains, rate: float
) -> None:
    """On every axis within the uncertainty, at each shorter delay, and on some not beyond it."""
    law = LAW_OF[type(gains)](axis=PHANTOM, gains=gains, period=1.0 / rate)
    axes = [PHANTOM, *Uncertainty().axes(PHANTOM, carriage=True)]
    margin, loop = delay_margin(law, 1, axes), LinearLoop(law, 1)

    def largest(late: int) -> float:
        return max(loop.spectral_radius(late, axis) for axis in axes)

    assert 1 <= margin < 100
    assert all(largest(late) < 1.0 for late in range(0, margin + 1, 4))
    assert largest(margin) < 1.0 <= largest(margin + 1)
