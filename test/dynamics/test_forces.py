# SPDX-License-Identifier: Apache-2.0
"""Inverse dynamics, friction power and base reaction, for every formulation."""

from __future__ import annotations

from typing import Any

from needle_dynamics import Integrator, NeedleError, NeedleModel, NeedleParameters, ShapeError
from needle_ros.errors import ParameterError
import numpy as np
from numpy.testing import assert_allclose
import pytest

KINDS: tuple[dict[str, Any], ...] = (
    {},
    {'formulation': 'as_printed'},
    {'modes': 3, 'minimum_depth': 0.02, 'tissue_damping': 16.0},
    {'layer_depths': (0.03, 0.06), 'layer_stiffnesses': (3e4, 2e3), 'carriage_mass': 0.01},
    {'friction_law': 'stribeck', 'breakaway_friction': 1.5, 'withdrawal_friction': 0.7},
)
kinds = pytest.mark.parametrize('changes', KINDS)


def moving(model: NeedleModel, seed: int, speed: float) -> np.ndarray:
    """Return the state of a bent needle in motion."""
    rng = np.random.default_rng(seed)
    state = model.state_at(rng.uniform(0.04, 0.18), 5e-4)
    m = model.coordinates
    state[m] = -speed
    state[m + 1 :] = rng.normal(size=m - 1) * 1e-2
    return state


@kinds
@pytest.mark.parametrize('speed', [-0.3, 0.2])
def test_inverse_dynamics_inverts_forward_dynamics(changes: dict[str, Any], speed: float) -> None:
    """The forces required for an acceleration under given forces equal these forces."""
    model = NeedleModel(NeedleParameters.preset('paper_si', **changes))
    for seed in range(5):
        state = moving(model, seed, speed)
        forces = model.inverse_dynamics(state, model.acceleration(state, 1.7, 2e-3))
        expected = np.zeros(model.coordinates)
        expected[:2] = 1.7, 2e-3
        # Rounding of the elastic forces, up to 100 N/m^1/2, amplified by cond(G) = 1e5.
        assert_allclose(forces, expected, atol=1e-9)


@pytest.mark.parametrize('sign', [-1.0, 1.0])
def test_breakaway_requires_friction_plus_inertia(sign: float) -> None:
    """From rest the force is mass times acceleration plus Coulomb friction, in its direction."""
    model = NeedleModel(NeedleParameters.preset('paper_si'))
    wanted = np.array([-sign * 3.0, 0.0, 0.0, 0.0])
    force = model.inverse_dynamics(model.state_at(0.1), wanted)[0]
    assert_allclose(force, sign * (model.parameters.moving_mass * 3.0 + 0.56), rtol=1e-12)


@kinds
def test_friction_dissipates_power_in_both_directions(changes: dict[str, Any]) -> None:
    """Friction opposes the motion, in and out of the tissue."""
    model = NeedleModel(NeedleParameters.preset('paper_si', **changes))
    for speed in (-0.2, -1e-6, 1e-6, 0.2):
        assert model.friction.force(speed, 0.0) * speed > 0.0


def base_reaction(model: NeedleModel, state: np.ndarray, force: float, torque: float) -> Any:
    """Return axial and lateral force and moment of the base, by the balance of momentum."""
    p, tissue, m = model.parameters, model.tissue, model.coordinates
    depth, modal, rate = p.length - state[0], state[2:m], state[m + 2 :]
    acceleration = model.acceleration(state, force, torque)
    at, layer = model.modes.integrals(depth), tissue.layer(depth)
    integrals = np.array([at.area, at.moment])
    above = np.array([model.layers.area[layer], model.layers.moment[layer]])
    elastic = tissue.growth(0.0) * (tissue.stiffnesses[layer] * integrals + above)
    # The entering part carries the momentum of the tip, with the depth as lever arm.
    entering = -state[m] * (at.value @ rate) * np.array([1.0, depth])
    inertia = p.linear_density * (integrals @ acceleration[2:] + entering)
    lateral, about_entry = inertia + elastic @ modal + p.tissue_damping * integrals @ rate
    axial = force + p.carriage_mass * acceleration[0]
    return axial, lateral, about_entry + state[0] * lateral + torque


# As printed, the modes lack the effect of the depth rate in the momentum balance.
@pytest.mark.parametrize('changes', [kind for kind in KINDS if 'formulation' not in kind])
@pytest.mark.parametrize('speed', [-0.3, 0.2])
def test_base_reaction_matches_the_mean_of_the_integrator(
    changes: dict[str, Any], speed: float
) -> None:
    """Over a short interval the mean base load equals the load at the middle."""
    model = NeedleModel(NeedleParameters.preset('paper_si', **changes))
    interval = 2e-7
    for seed in range(3):
        start = moving(model, seed, speed)
        half = Integrator(model.parameters, start, 1e-8)
        half.advance(0.5 * interval, 2.0, 1e-3)
        seen = Integrator(model.parameters, start, 1e-8).advance(interval, 2.0, 1e-3)
        axial, lateral, moment = base_reaction(model, half.state, 2.0, 1e-3)
        # Curvature over the interval: (omega h)^2 / 24 = 1e-5 at the 10 kHz of these depths, and
        # rounding of the momenta over the interval, 1e-16 cond(G) / 2e-7 s.
        assert_allclose(seen.axial_force, axial, rtol=1e-4, atol=1e-6)
        assert_allclose(seen.lateral_force, lateral, rtol=1e-4, atol=1e-5)
        assert_allclose(seen.moment, moment, rtol=1e-4, atol=1e-6)


def test_invalid_accelerations_are_rejected() -> None:
    model = NeedleModel(NeedleParameters())
    with pytest.raises(ShapeError, match=r'acceleration must have shape \(4,\), got \(3,\)'):
        model.inverse_dynamics(model.state_at(0.1), np.zeros(3))
    with pytest.raises(ParameterError, match='acceleration must be finite, got nan'):
        model.inverse_dynamics(model.state_at(0.1), [0.0, np.nan, 0.0, 0.0])


def test_holding_force_is_the_excess_over_friction() -> None:
    """Without acceleration of the base, friction holds the bent needle up to its bound."""
    for tip, bends in ((1e-3, False), (6e-2, True)):
        model = NeedleModel(NeedleParameters.preset('paper_si'))
        state = model.state_at(0.05, tip)
        still = model.acceleration(state)
        still[0] = 0.0
        held = model.inverse_dynamics(state, still)[0]
        pull = model.bias_forces(state)[0]
        assert (abs(pull) > 0.56) == bends
        assert_allclose(held, -pull - np.clip(-pull, -0.56, 0.56), atol=1e-12)


@pytest.mark.parametrize(('step', 'force'), [(1e-25, 3.0), (1e-5, 1e308)])
def test_extreme_steps_and_forces_raise_an_error(step: float, force: float) -> None:
    """Steps below rounding and forces that overflow raise a typed error."""
    p = NeedleParameters.preset('paper_si')
    with pytest.raises(NeedleError):
        Integrator(p, NeedleModel(p).state_at(0.02, 5e-4), step).advance(1e-3, force)
