# SPDX-License-Identifier: Apache-2.0
"""Axial motion of a steered needle: friction, cutting, membranes."""

from __future__ import annotations

from dataclasses import replace
from math import inf, nan, sin
from typing import Any

from hypothesis import given
from hypothesis import strategies as some
from needle_dynamics import (
    Insertion,
    InsertionDepthError,
    Integrator,
    NeedleModel,
    NeedleParameters,
    ParameterError,
    SteeredNeedle,
    SteeringParameters,
)
import numpy as np
import pytest

NEEDLE = replace(
    NeedleParameters.preset('phantom'),
    tissue_stiffness=2e4,
    layer_depths=(0.03,),
    layer_stiffnesses=(5e4,),
    carriage_mass=0.1,
)
STEERING = SteeringParameters(
    bevel_load=(0.3,),
    cutting_force=(1.0, 2.0),
    coulomb_per_length=(10.0, 20.0),
    viscous_per_length=(100.0, 50.0),
    membrane_depths=(0.02,),
    membrane_strengths=(2.0,),
    membrane_stiffness=500.0,
)


def force_at(depth: float, velocity: float) -> float:
    """Return friction and cutting of the needle above, without its membrane."""
    above, below = min(depth, 0.03), max(0.0, depth - 0.03)
    dry = 0.56 + 10.0 * above + 20.0 * below + (1.0 if depth < 0.03 else 2.0)
    return dry + (300.0 + 100.0 * above + 50.0 * below) * velocity


def test_axial_model_of_the_paper_is_a_special_case() -> None:
    """Without the added effects the axis moves as in the 8-state model of a straight needle."""
    needle = NeedleParameters.preset('phantom')
    one = Insertion(needle, depth=0.05)
    other = Integrator(needle, NeedleModel(needle).state_at(0.05))
    for force in (3.0, 0.5, 2.0, -2.0, 0.0):
        one.push(0.2, force)
        other.advance(0.2, force)
        # Both are exact for Coulomb's friction, in steps of their own.
        assert one.depth == pytest.approx(other.depth, abs=1e-13)
        assert one.velocity == pytest.approx(other.velocity, abs=1e-13)


def test_force_at_constant_velocity() -> None:
    """Friction grows with the inserted length in each layer; the membrane is a spring at first."""
    one, velocity = Insertion(NEEDLE, STEERING), 5e-3
    one.carry(0.1, velocity)
    for _ in range(1500):
        before = one.depth
        force = one.carry(5e-3, velocity)
        middle = 0.5 * (before + one.depth)
        if 0.02 < middle < 0.024:
            # It does not cut while it pushes the membrane.
            expected = force_at(middle, velocity) - 1.0 + 500.0 * (middle - 0.02)
            assert one.punctured == (False,) or one.depth > 0.024
        else:
            expected = force_at(middle, velocity)
        events = any(before <= at <= one.depth for at in (0.02, 0.024, 0.03))
        assert events or force == pytest.approx(expected, rel=1e-9)
    assert one.punctured == (True,)
    assert one.depth > 0.035


def test_events_are_exact_in_time() -> None:
    """A membrane ruptures at its strength, for any time steps."""
    times = []
    for step in (1e-3, 1e-5):
        one = Insertion(NEEDLE, STEERING, depth=0.018, step=step)
        while not one.punctured[0]:
            one.carry(1e-3, 4e-3)
        times.append(one.depth)
    assert times[0] == pytest.approx(times[1], abs=1e-12)
    ways = []
    for step in (4e-3, 2e-3, 1e-3, 1e-5):
        one = Insertion(NEEDLE, STEERING, depth=0.018, step=step)
        one.push(0.8, 4.5)
        assert one.punctured == (True,)
        ways.append(one.depth)
    errors = np.abs(np.array(ways[:-1]) - ways[-1])
    # Of second order, with stops, layers and a puncture during the motion.
    assert (np.log2(errors[:-1] / errors[1:]) > 1.6).all()
    assert errors[-1] < 1e-7


@given(some.floats(-5.0, 5.0), some.floats(1e-3, 0.1))
def test_needle_rests_within_friction_and_cutting_forces(force: float, depth: float) -> None:
    """Cutting resists insertion only, friction resists both; a membrane pushes outward."""
    steering = replace(STEERING, membrane_depths=(), membrane_strengths=())
    one = Insertion(NEEDLE, steering, depth=depth)
    cutting = 1.0 if depth < 0.03 else 2.0
    dry = force_at(depth, 0.0) - cutting
    one.push(1e-3, force)
    assert (one.depth != depth) == (not -dry <= force <= dry + cutting)
    assert np.sign(one.depth - depth) in (0.0, np.sign(force))


def test_reinsertion_has_no_cutting_force() -> None:
    """Along its own path there is friction only, up to the deepest cut."""
    one = Insertion(NEEDLE, STEERING, depth=0.05)
    tip = one.needle.tip
    one.carry(0.1, -0.02)
    while one.depth > 0.04:
        one.carry(0.01, -0.02)
    one.carry(0.1, 4e-3)
    while one.depth < 0.0489:
        before = one.depth
        force = one.carry(0.01, 4e-3)
        middle = 0.5 * (before + one.depth)
        expected = force_at(middle, 4e-3) - 2.0
        assert one.depth >= 0.05 or force == pytest.approx(expected, rel=1e-9)
    # Uncut tissue acts from 1 mm before it.
    assert (one.needle.load == 0.0).all()
    while one.depth < 0.05:
        force = one.carry(0.01, 4e-3)
    force = one.carry(0.01, 4e-3)
    assert force == pytest.approx(force_at(one.depth - 2e-5, 4e-3), rel=1e-6)
    assert one.needle.tip[2] == pytest.approx(tip[2], abs=1e-4)


def test_unpunctured_membrane_pushes_the_needle_back() -> None:
    frictionless = replace(NEEDLE, coulomb_friction=0.0, viscous_friction=30.0)
    steering = replace(STEERING, coulomb_per_length=(0.0,), cutting_force=(0.0,))
    one = Insertion(frictionless, steering, depth=0.02)
    one.push(20.0, 1.5)
    # At rest the spring balances the force.
    assert one.depth == pytest.approx(0.02 + 1.5 / 500.0, abs=1e-9)
    one.push(20.0, 0.0)
    assert one.depth == pytest.approx(0.02, abs=1e-9)
    assert one.punctured == (False,)
    one.push(20.0, 2.1)
    assert one.punctured == (True,)


def test_hub_stops_on_the_guide() -> None:
    one = Insertion(NEEDLE, STEERING, depth=0.1)
    one.push(30.0, 50.0)
    assert one.depth == pytest.approx(0.18, abs=1e-15)
    assert one.velocity == 0.0
    one.push(1.0, -50.0)
    assert one.depth < 0.18
    one.carry(0.1, 0.05)
    with pytest.raises(InsertionDepthError, match='the needle reached 180 mm, where its hub'):
        one.carry(10.0, 0.05)


def test_motion_out_of_the_skin_is_an_error_without_effect() -> None:
    one = Insertion(NEEDLE, STEERING, depth=0.01)
    with pytest.raises(InsertionDepthError, match='the needle reached the skin'):
        one.push(10.0, -20.0)
    assert one.depth == 0.0
    assert 0.0 < one.time < 10.0


def test_breathing_drags_the_needle() -> None:
    """Friction couples a free needle to tissue that moves along it."""
    needle = replace(NEEDLE, carriage_mass=0.0, viscous_friction=0.0)
    one = Insertion(needle, replace(STEERING, viscous_per_length=(0.0,)), depth=0.05)
    for k in range(1, 1001):
        one.push(1e-3, 0.0, tissue=(0.0, 3e-3 * sin(3e-3 * k), 0.0))
    # Stuck in it, once friction has brought 2 g to the first 9 mm/s, over 0.05 um.
    assert one.depth == pytest.approx(0.05 + 3e-3 * sin(3.0), abs=1e-7)
    held = Insertion(needle, STEERING, depth=0.05)
    for k in range(1, 1001):
        held.carry(1e-3, 0.0, tissue=(0.0, -3e-3 * sin(1.5e-3 * k), 0.0))
    # The tissue moved against a fixed needle, which cut further.
    assert held.depth == pytest.approx(0.05, abs=1e-12)
    assert held.needle.deepest - held.needle.path.depths[0] == pytest.approx(
        0.05 + 3e-3 * sin(1.5), abs=1e-9
    )


def test_wrench_balances_the_needle() -> None:
    """The tissue opposes a guide shift to z with a force to -z: the base pushes to z."""
    one = Insertion(NEEDLE, STEERING, depth=0.05)
    start = one.wrench
    one.push(1e-3, 0.0, guide=(0.0, 1e-3))
    assert one.wrench[1] > start[1]
    assert one.wrench[0] == start[0] == 0.0
    turned = Insertion(NEEDLE, replace(STEERING, torsional_friction=0.05), depth=0.05)
    turned.push(1e-3, 0.0, roll=10.0)
    # All of the inserted length slides.
    assert turned.wrench[3] == pytest.approx(0.05 * 0.05, rel=1e-12)


@pytest.mark.parametrize(
    ('values', 'words'),
    [
        ({'duration': 0.0}, 'duration must be positive and finite, got 0.0 s'),
        ({'duration': nan}, 'duration must be positive and finite, got nan s'),
        ({'force': inf}, 'force must be finite, got inf'),
        ({'guide': (nan, 0.0)}, 'guide must be finite'),
        ({'tissue': (0.0, 0.06, 0.0)}, 'tissue must stay between guide and tip'),
    ],
)
def test_invalid_inputs_are_rejected(values: dict[str, Any], words: str) -> None:
    one = Insertion(NEEDLE, STEERING, depth=0.05)
    with pytest.raises(ParameterError, match=words):
        one.push(**{'duration': 0.01, 'force': 9.0} | values)
    # No motion along or across the axis.
    assert (one.depth, one.needle.depth, one.velocity, one.time) == (0.05, 0.05, 0.0, 0.0)


def test_invalid_constants_are_rejected() -> None:
    with pytest.raises(ParameterError, match='hub_stop must be true'):
        Insertion(replace(NEEDLE, hub_stop=False), STEERING)
    for needle, words in (
        (replace(NEEDLE, friction_law='tanh'), "friction_law must be coulomb .* got 'tanh'"),
        (replace(NEEDLE, swelling=0.1), 'swelling must be 0'),
    ):
        for kind in (SteeredNeedle, Insertion):
            with pytest.raises(ParameterError, match=words):
                kind(needle, STEERING)
    with pytest.raises(ParameterError, match='cutting_force must have one value, or one for each'):
        Insertion(NEEDLE, replace(STEERING, cutting_force=(1.0, 2.0, 3.0)))
    with pytest.raises(ParameterError, match='membrane_strengths must have one value for each'):
        replace(STEERING, membrane_depths=(0.01, 0.02))
    for step in (0.0, nan, True):
        with pytest.raises(ParameterError, match=r'step must be (finite, > 0 s|a number)'):
            Insertion(NEEDLE, STEERING, step=step)
