# SPDX-License-Identifier: Apache-2.0
"""Continuous-time laws of the paper, and convergence of the sampled laws to them."""

from dataclasses import replace
from typing import Any

from needle_controller import (
    Axis,
    ContinuousInverseDynamics,
    ContinuousPid,
    InverseDynamics,
    InverseDynamicsGains,
    Pid,
    PidGains,
    Setpoint,
)
from needle_controller.laws.continuous import acceleration
from needle_controller.laws.law import SampledLoop
from needle_dynamics import (
    FloatArray,
    Integrator,
    NeedleModel,
    NeedleParameters,
    ParameterError,
    ShapeError,
)
import numpy as np
from numpy.testing import assert_allclose
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from support.closed_loop import closed_loop

#: Friction with a slow transient for explicit solvers, and too weak to stick under PID.
MODEL = NeedleModel(
    NeedleParameters.preset('phantom', viscous_friction=0.5, coulomb_friction=0.01)
)
DEPTH, SPEED = 0.15, 0.02


def matrix(diagonal: list[float], skew: float = 0.0) -> FloatArray:
    """Return a positive definite matrix: one that is not symmetric if ``skew`` is not zero."""
    gains = np.diag(diagonal)
    gains[0, -1], gains[-1, 0] = skew, -skew
    return gains


def moving(depth: float = DEPTH, deflection: float = 5e-4) -> FloatArray:
    """Return the state of a bent needle in motion."""
    state = MODEL.state_at(depth, deflection)
    state[4:] = [-SPEED, 0.4, 1e-3, -5e-4]
    return state


def goal(time: float) -> FloatArray:
    """Return a steady insertion, 1 mm ahead of the initial depth, with zero deflection."""
    wanted = np.zeros((3, 4))
    wanted[0, 0] = MODEL.parameters.length - (DEPTH + 1e-3 + SPEED * time)
    wanted[1, 0] = -SPEED
    return wanted


@pytest.mark.parametrize('skew', [0.0, 20.0])
def test_inverse_dynamics_gives_linear_error_dynamics(skew: float) -> None:
    """With its own model as the plant, e_ddot + k_v e_dot + k_p e = 0 on all coordinates."""
    kp, kv = matrix([900.0, 400.0, 1600.0, 2500.0], skew), matrix([60.0, 40.0, 30.0, 20.0], skew)
    law = ContinuousInverseDynamics(model=MODEL, actuation='modal', kp=kp, kv=kv)
    start = moving()
    run = solve_ivp(
        closed_loop(law, MODEL, goal), (0.0, 0.1), start, method='DOP853', rtol=1e-10, atol=1e-14
    )
    errors = (start.reshape(2, 4) - goal(0.0)[:2]).ravel()
    linear = expm(0.1 * np.block([[np.zeros((4, 4)), np.eye(4)], [-kp, -kv]])) @ errors
    end = (run.y[:, -1].reshape(2, 4) - goal(0.1)[:2]).ravel()
    # 1e-7: a thousand times the solver's own rtol, over the size of each error.
    assert_allclose(end, linear, rtol=1e-7, atol=1e-7 * np.abs(linear).max())


def test_physical_actuation_acts_on_the_base_only() -> None:
    """Both laws act on no other coordinate; the base follows its error equation."""
    law = ContinuousInverseDynamics(model=MODEL, kp=[900.0, 100.0], kv=[60.0, 20.0])
    forces = law.forces(moving(), goal(0.0))
    assert_allclose(forces[2:], 0.0, atol=0.0)
    result = acceleration(MODEL, moving(), forces)
    expected = 900.0 * (goal(0.0)[0, 0] - moving()[0])
    # Friction and bias are compensated to rounding, of 1 N on 2 g.
    assert_allclose(result[:2], [expected, -20.0 * 0.4], rtol=1e-10)
    pid = ContinuousPid(model=MODEL, kp=[50.0, 1.0], kd=[3.0, 2.0], ki=[7.0, 0.0])
    error = goal(0.0)[0, 0] - moving()[0]
    found = pid.forces(moving(), goal(0.0), [0.1, 0.2])
    # f_y pushes into the tissue, and d increases in the opposite direction.
    assert_allclose(found, [-(50.0 * error + 0.7), -2.0 * 0.4, 0.0, 0.0], rtol=1e-12)


def test_inverse_dynamics_breaks_away() -> None:
    """At rest friction is compensated in the direction of the desired acceleration."""
    rest = MODEL.state_at(DEPTH)
    kp, kv = [900.0, 100.0], [60.0, 20.0]
    for breakaway_speed in (0.0, 1e-6):
        law = ContinuousInverseDynamics(model=MODEL, kp=kp, kv=kv, breakaway_speed=breakaway_speed)
        for sign in (-1.0, 1.0):
            aim = np.zeros((3, 4))
            aim[0, 0] = rest[0] - sign * 1e-3
            found = acceleration(MODEL, rest, law.forces(rest, aim))
            assert_allclose(found[0], -sign * 0.9, rtol=1e-9)


@pytest.mark.parametrize(
    'friction', ['coulomb', 'stribeck', 'tanh'], ids=['coulomb', 'stribeck', 'tanh']
)
@pytest.mark.parametrize('speed', [-0.02, 0.02])
def test_full_compensation_equals_model_friction(friction: str, speed: float) -> None:
    """Beyond the breakaway speed the smooth compensation equals friction, in both directions."""
    model = NeedleModel(replace(MODEL.parameters, friction_law=friction, withdrawal_friction=1.5))
    state = moving()
    state[4] = -speed
    laws = [
        ContinuousInverseDynamics(
            model=model, kp=[9.0, 1.0], kv=[6.0, 2.0], breakaway_speed=breakaway_speed
        )
        for breakaway_speed in (0.0, 1e-3)
    ]
    exact, smooth = (law.forces(state, goal(0.0)) for law in laws)
    assert_allclose(smooth, exact, rtol=1e-12)


def test_law_with_another_nominal_needle() -> None:
    """The forces depend on the nominal model of the law only, for any plant."""
    other = NeedleModel(
        replace(MODEL.parameters, viscous_friction=0.7, tissue_stiffness=700.0, area=1e-6)
    )
    law = ContinuousInverseDynamics(
        model=other, actuation='modal', kp=np.full(4, 100.0), kv=np.full(4, 20.0)
    )
    state = moving()
    wanted = 100.0 * (goal(0.0)[0] - state[:4]) + 20.0 * (goal(0.0)[1] - state[4:])
    assert_allclose(law.forces(state, goal(0.0)), other.inverse_dynamics(state, wanted))
    rate = closed_loop(law, MODEL, goal)(0.0, state)
    assert_allclose(
        MODEL.inverse_dynamics(state, rate[4:]), law.forces(state, goal(0.0)), rtol=1e-9
    )


# Convergence.


def sampled_end(
    kind: str, gains: tuple[InverseDynamicsGains | PidGains, ...], period: float, duration: float
) -> FloatArray:
    """Run the sampled loop around the true needle; return its state at the end."""
    p = MODEL.parameters
    law: Any = InverseDynamics if kind == 'inverse_dynamics' else Pid
    insertion = law(axis=Axis.insertion(p), gains=gains[0], period=period)
    rotation = law(axis=Axis.rotation(p), gains=gains[1], period=period)
    state, count = moving(), round(duration / period)

    def aim(time: float) -> Setpoint:
        return Setpoint(DEPTH + 1e-3 + SPEED * time, SPEED)

    needle = Integrator(p, state, 2e-5)
    loops = SampledLoop(insertion, 0, np.inf), SampledLoop(rotation, 0, np.inf)
    for i in range(count):
        x = needle.state
        load = -float(MODEL.bias_forces(x)[0])
        force = loops[0].command(needle.depth, needle.velocity, aim(i * period), load)
        torque = loops[1].command(float(x[1]), float(x[5]), Setpoint(0.0))
        needle.advance(period, force, torque)
    return needle.state


ID_GAINS = (InverseDynamicsGains(kp=900.0, kv=60.0),) * 2
PID_GAINS = (
    PidGains(kp=50.0, ki=40.0, kd=1.0),
    # 20 rad/s on 5e-10 kg m^2.
    PidGains(kp=2e-7, ki=1e-6, kd=2e-8),
)


@pytest.mark.parametrize('kind', ['inverse_dynamics', 'pid'])
def test_sampled_law_converges_to_the_continuous_law(kind: str) -> None:
    """Half the period, half the difference of the closed loops, in all coordinates together."""
    gains: tuple[InverseDynamicsGains | PidGains, ...] = ID_GAINS
    law: ContinuousInverseDynamics | ContinuousPid
    if kind == 'inverse_dynamics':
        law = ContinuousInverseDynamics(
            model=MODEL, kp=np.full(2, 900.0), kv=np.full(2, 60.0), breakaway_speed=1e-4
        )
    else:
        gains = PID_GAINS
        kp, kd, ki = np.transpose([(g.kp, g.kd, g.ki) for g in PID_GAINS])
        law = ContinuousPid(model=MODEL, kp=kp, kd=kd, ki=ki)
    duration = 0.016
    start = np.concatenate([moving(), np.zeros(law.integrals)])
    exact = solve_ivp(
        closed_loop(law, MODEL, goal), (0.0, duration), start,
        method='DOP853', rtol=1e-9, atol=1e-14,
    ).y[:8, -1]  # fmt: skip
    # Each coordinate and rate in the size of its motion.
    scales = np.abs(moving()) + np.abs(exact) + 1e-4
    scales[0] = 1e-3
    periods = np.array([2e-4, 1e-4, 5e-5])
    errors = [
        np.linalg.norm((sampled_end(kind, gains, h, duration) - exact) / scales) for h in periods
    ]
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    # First order; the second-order part is h omega_2 = 0.35 at the longest period.
    assert_allclose(orders, 1.0, atol=0.2)
    assert errors[-1] < 0.05


# Bad input.


@pytest.mark.parametrize(
    ('changes', 'error', 'words'),
    [
        ({'kp': [1.0, 2.0, 3.0]}, ShapeError, r'kp must have shape \(2,\) or \(2, 2\)'),
        ({'kp': np.eye(4)}, ShapeError, 'got shape'),
        ({'kv': [1.0, np.nan]}, ParameterError, 'kv must be finite'),
        ({'kv': 'stiff'}, ShapeError, 'kv must be real numbers'),
        ({'kp': [1.0, -2.0]}, ParameterError, 'kp must be positive definite, .* eigenvalue -2'),
        ({'kv': [1.0, 0.0]}, ParameterError, 'kv must be positive definite'),
        ({'kp': [[1.0, 5.0], [5.0, 1.0]]}, ParameterError, 'kp must be positive definite'),
        ({'actuation': 'magnetic'}, ParameterError, 'one of physical, modal'),
        ({'breakaway_speed': -1.0}, ParameterError, 'breakaway_speed must be finite, >= 0'),
    ],
)
def test_invalid_gains_are_rejected(
    changes: dict[str, Any], error: type[ParameterError] | type[ShapeError], words: str
) -> None:
    """Sizes, numbers, definiteness and names, each in one line."""
    valid = {'kp': [900.0, 100.0], 'kv': [60.0, 20.0]}
    with pytest.raises(error, match=words):
        ContinuousInverseDynamics(model=MODEL, **{**valid, **changes})


def test_invalid_arguments_are_rejected() -> None:
    """An integral gain may be zero but not negative; goals and integrals have fixed sizes."""
    with pytest.raises(ParameterError, match='ki must be positive semidefinite'):
        ContinuousPid(model=MODEL, kp=[1.0, 1.0], kd=[1.0, 1.0], ki=[1.0, -1.0])
    pid = ContinuousPid(model=MODEL, kp=[1.0, 1.0], kd=[1.0, 1.0], ki=[1.0, 0.0])
    with pytest.raises(ShapeError, match=r'integral must have shape \(2,\)'):
        pid.forces(moving(), goal(0.0))
    with pytest.raises(ShapeError, match=r'goal must have shape \(3, 4\)'):
        pid.forces(moving(), np.zeros(4), [0.0, 0.0])
    with pytest.raises(ShapeError, match=r'forces must have shape \(4,\)'):
        acceleration(MODEL, moving(), [1.0, 2.0])
