# SPDX-License-Identifier: Apache-2.0
"""Adaptive friction: accurate, bounded, and without effect on stability."""

from dataclasses import replace
from math import inf, pi, sin
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st
from needle_controller import (
    Adaptive,
    AdaptiveGains,
    Axis,
    Controller,
    ControllerSettings,
    InverseDynamics,
    InverseDynamicsGains,
    Measurement,
    MinimumJerk,
    ReferenceLimits,
    run_batch,
    run_controller,
    Setpoint,
    Uncertainty,
)
from needle_controller.compiled.laws import (
    adapt,
    bounds,
    correction,
    FOLLOWS,
    INTEGRAL,
    LEARNED,
    MEASURED,
    POSITION,
    VELOCITY,
)
from needle_controller.laws.law import SampledLoop
from needle_controller.stability import LinearLoop
from needle_dynamics import NeedleModel, NeedleParameters
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
import pytest

NEEDLE = NeedleParameters.preset('phantom')
PHANTOM = Axis.insertion(NEEDLE)
PERIOD = 1e-3


def law(axis: Axis = PHANTOM, **changes: Any) -> Adaptive:
    """Return the law with default gains, but for some."""
    return Adaptive(axis=axis, gains=AdaptiveGains(**changes), period=PERIOD)


def drive(loop: SampledLoop, plant: Axis, duration: float) -> None:
    """Move back and forth at up to 20 mm/s, 1 s a swing."""
    amplitude, rate = 0.02 / (2.0 * pi), 2.0 * pi
    position, speed = 0.05, 0.0
    for i in range(round(duration / PERIOD)):
        phase = rate * i * PERIOD
        aim = Setpoint(
            0.05 + amplitude * (1.0 - np.cos(phase)),
            amplitude * rate * sin(phase),
            amplitude * rate**2 * np.cos(phase),
        )
        force = loop.command(position, speed, aim)
        position, speed = plant.propagate(position, speed, force, PERIOD)


def test_friction_mismatch_is_learned() -> None:
    """Dry and viscous friction of both directions, within three standard deviations."""
    truth = replace(PHANTOM, coulomb=0.7, viscous=240.0, withdrawal=0.8)
    loop = SampledLoop(law(), 0, 20.0)
    drive(loop, truth, 8.0)
    expected = {
        'dry friction, insertion [N]': 0.7 - 0.56,
        'viscous friction, insertion [N s/m]': 240.0 - 300.0,
        'dry friction, withdrawal [N]': 0.8 * 0.7 - 0.56,
        'viscous friction, withdrawal [N s/m]': 0.8 * 240.0 - 300.0,
    }
    for name, value in expected.items():
        found, error = loop.learned[name]
        assert abs(found - value) < 3.0 * error, name
        # The interval is small: 4 % of dry, 5 % of viscous friction.
        assert error < (0.02 if 'dry' in name else 15.0), name


@settings(max_examples=50)
@given(
    st.lists(
        st.tuples(*[st.floats(-1e3, 1e3)] * 3, st.floats(-1.0, 1.0)), min_size=5, max_size=60
    ),
    st.floats(0.1, 3.0),
)
def test_learned_force_stays_within_its_bounds(
    measured: list[tuple[float, float, float, float]], bound: float
) -> None:
    """For any measurements, the learned force is finite and within the bounds."""
    loop = SampledLoop(law(bound=bound), 1, inf)
    most = bounds(bound, PHANTOM.coulomb, PHANTOM.viscous)
    position = 0.05
    for speed, jump, target, share in measured:
        # Some of the motions agree with their speed, so that they are used.
        position += PERIOD * speed + (1e-3 * jump if share < 0.0 else 0.0)
        loop.command(position, speed, Setpoint(target))
        for block in loop.memory[LEARNED:].reshape(2, -1):
            for depth in (0.0, 0.05, 0.2):
                force = correction(block, most, depth, 0.01)
                assert abs(force) <= (most[0] + 0.01 * most[1]) * (1.0 + 1e-12)


def test_frozen_learning_keeps_its_estimate() -> None:
    """`learn: false` keeps and applies the learned friction."""
    truth = replace(PHANTOM, coulomb=0.7, viscous=240.0)
    loop = SampledLoop(law(), 0, 20.0)
    drive(loop, truth, 2.0)
    loop.switch(law(learn=False))
    learned = loop.memory[LEARNED:].copy()
    drive(loop, replace(PHANTOM, coulomb=0.3), 2.0)
    assert_array_equal(loop.memory[LEARNED:], learned)
    assert loop.learned['dry friction, insertion [N]'][0] > 0.1


def test_estimate_survives_a_stop_but_not_other_constants() -> None:
    """A pause, a stop and other gains keep the estimate; other constants discard it."""
    loop = SampledLoop(law(), 0, 20.0)
    drive(loop, replace(PHANTOM, coulomb=0.7), 2.0)
    learned = loop.learned
    loop.stop()
    loop.unwind()
    loop.switch(law(kp=400.0))
    assert loop.learned == learned != {}
    loop.switch(law(replace(PHANTOM, coulomb=0.7)))
    assert loop.learned == {}
    drive(loop, PHANTOM, 1.0)
    loop.reset()
    assert loop.learned == {}


def test_missing_samples_are_excluded_from_learning() -> None:
    """Two periods between measurements appear as twice the speed, and are ignored."""
    loop = SampledLoop(law(), 0, 20.0)
    loop.command(0.05, 0.01, Setpoint(0.05, 0.01))
    loop.command(0.05 + 2.5 * PERIOD * 0.01, 0.01, Setpoint(0.05, 0.01))
    assert loop.learned == {}
    loop.command(0.05 + 3.5 * PERIOD * 0.01, 0.01, Setpoint(0.05, 0.01))
    assert loop.learned != {}
    loop.stop()
    assert loop.memory[MEASURED] == 0.0


def test_learning_does_not_change_the_poles() -> None:
    """The poles equal the poles of inverse dynamics."""
    other = InverseDynamics(axis=PHANTOM, gains=InverseDynamicsGains(), period=PERIOD)
    own, known = (LinearLoop(one, 1).transition_matrices(1, [PHANTOM]) for one in (law(), other))
    assert_allclose(own, known, rtol=1e-12)


def test_no_learning_without_friction() -> None:
    """On the axis of rotation all bounds are zero."""
    loop = SampledLoop(law(Axis(inertia=1e-9)), 0, 1.0)
    drive(loop, Axis(inertia=1e-9), 0.2)
    assert all(value == (0.0, 0.0) for value in loop.learned.values())


@pytest.mark.parametrize('delay', [0, 1])
def test_adaptive_law_tracks_better_than_inverse_dynamics(delay: int) -> None:
    """With friction 50 % off, each rms error is smaller; the final error is as small."""
    plants = [
        replace(NEEDLE, coulomb_friction=0.56 * dry, viscous_friction=300.0 * viscous)
        for dry in (0.5, 1.5)
        for viscous in (0.5, 1.5)
    ]
    start = NeedleModel(NEEDLE).state_at(0.02, 5e-4)
    reference = MinimumJerk(Setpoint(0.02), 0.05, ReferenceLimits())
    gains = InverseDynamicsGains()
    each = (InverseDynamics(axis=PHANTOM, gains=gains, period=PERIOD), law())
    fixed, learned = (
        run_batch(one, plants, start, reference, delay=delay, limit=15.0, duration=8.0, step=1e-3)
        for one in each
    )
    assert (learned.rms < 0.9 * fixed.rms).all()
    assert np.abs(learned.final).max() < 1e-5


@pytest.mark.parametrize('direction', [1.0, -1.0])
def test_learned_friction_is_taken_out_of_the_integral(direction: float) -> None:
    """The force of the law is equal before and after a period in which it learns."""
    own = law(replace(PHANTOM, withdrawal=0.7))
    loop = SampledLoop(own, 1, 20.0)
    memory, speed = loop.memory, direction * 0.01
    memory[[INTEGRAL, POSITION, VELOCITY, FOLLOWS]] = direction * 1e-3, 0.06, speed, 1.0
    memory[MEASURED : MEASURED + 3] = 1.0, 0.06 - speed * PERIOD, speed
    # The acceleration of the modeled motion is zero at its own setpoint.
    at = (0.06, speed, Setpoint(0.06, speed))
    before, block = own.force(*at, memory), memory[LEARNED:].copy()
    adapt(own.packed, memory, 0.06, speed, direction * 5.0)
    assert np.abs(memory[LEARNED:] - block).max() > 0.01
    # Rounding of forces of a few newtons.
    assert own.force(*at, memory) == pytest.approx(before, abs=1e-12)


@given(st.floats(-1e-4, 1e-4), st.floats(-20.0, 20.0), st.sampled_from([-0.01, 0.01]))
def test_learning_takes_no_more_than_the_integral_has(
    integral: float, force: float, speed: float
) -> None:
    """Friction that is gone does not return to the integral, which keeps its sign."""
    own = law(PHANTOM)
    memory = SampledLoop(own, 1, 20.0).memory
    memory[[INTEGRAL, POSITION, VELOCITY, FOLLOWS]] = integral, 0.06, speed, 1.0
    memory[MEASURED : MEASURED + 3] = 1.0, 0.06 - speed * PERIOD, speed
    adapt(own.packed, memory, 0.06, speed, force)
    assert min(integral, 0.0) <= memory[INTEGRAL] <= max(integral, 0.0)


def test_learning_is_bumpless() -> None:
    """A light needle with more friction than modeled does not lunge when it breaks away."""
    nominal = NeedleParameters(
        length=0.2, carriage_mass=0.042, coulomb_friction=16.9, viscous_friction=1.02, modes=1
    )
    steering = Controller(
        nominal,
        settings=ControllerSettings(force_limit=43.8),
        uncertainty=Uncertainty(carriage=0.0),
    )
    steering.set_target(0.1266)
    plant = replace(nominal, coulomb_friction=1.22 * 16.9)
    start = NeedleModel(plant).state_at(0.1)
    run = run_controller(steering, plant, start, duration=6.0, step=1e-3)
    # Added to the integral, which has compensated it, the learned friction led to 11.5 mm. The
    # needle rests up to 0.5 dmu_s / m h^2 = 0.042 mm from its target, and its motion at the end is
    # as long again.
    assert run.depth.max() < 0.1266 + 1e-4
    assert abs(run.depth[-1] - 0.1266) < 1e-4


def test_controller_reports_learned_friction() -> None:
    """By name, with unit and standard deviation; nothing with another law."""
    controller = Controller(NEEDLE, 'adaptive')
    controller.set_target(0.05)
    assert controller.learned == {}
    truth = replace(PHANTOM, viscous=400.0)
    position, speed, force = 0.02, 0.0, 0.0
    for i in range(3000):
        measured = Measurement(time=i * PERIOD, depth=position, velocity=speed)
        coming = controller.command(measured).force
        position, speed = truth.propagate(position, speed, force, PERIOD)
        force = coming
    names = list(controller.learned)
    assert names[0] == 'dry friction, insertion [N]'
    assert len(names) == 3
    controller.change(law='inverse_dynamics')
    assert controller.learned == {}
