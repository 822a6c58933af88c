# SPDX-License-Identifier: Apache-2.0
"""The controller as an object, in a loop around the simulated needle."""

from math import inf, nan
from typing import Any

from needle_controller import (
    Controller,
    ControllerOutput,
    ControllerSettings,
    InverseDynamicsGains,
    Measurement,
    PidGains,
    Setpoint,
)
from needle_controller.compiled.laws import INTEGRAL
from needle_dynamics import FloatArray, Integrator, NeedleModel, NeedleParameters, ParameterError
import numpy as np
import pytest

PERIOD = 1e-3


def controller(
    law: str = 'inverse_dynamics', preset: str = 'phantom', **changes: Any
) -> Controller:
    """Return a controller with default gains."""
    return Controller(NeedleParameters.preset(preset), law, settings=ControllerSettings(**changes))


def insert(
    steering: Controller, truth: NeedleParameters, duration: float, late: int = 1
) -> tuple[FloatArray, ...]:
    """Run the loop around the true needle; return depths and references [m]."""
    state = NeedleModel(truth).state_at(0.02, 5e-4)
    needle = Integrator(truth, state, 2e-5)
    waiting = [0.0] * late
    depths, aims = [], []
    for i in range(round(duration / PERIOD)):
        measured = Measurement(time=i * PERIOD, depth=needle.depth, velocity=needle.velocity)
        command = steering.command(measured)
        depths.append(needle.depth)
        aims.append(command.setpoint.position)
        waiting.append(command.force)
        needle.advance(PERIOD, waiting.pop(0))
    return np.array(depths), np.array(aims)


def test_inverse_dynamics_tracks_the_insertion() -> None:
    """With its nominal model, the depth follows within 20 um from start to end."""
    steering = controller()
    steering.set_target(0.05)
    depths, aims = insert(steering, NeedleParameters.preset('phantom'), 3.5)
    # Start and stop: within the breakaway speed the Coulomb term is reduced, 1e-4 m/s for
    # some tens of milliseconds; the initial bend, unknown to the law, adds its force of 0.2 N.
    assert np.abs(depths - aims).max() < 5e-5
    assert abs(depths[-1] - 0.05) < 2e-5


@pytest.mark.parametrize('law', ['inverse_dynamics', 'pid'])
@pytest.mark.parametrize('scale', [0.7, 1.3])
def test_both_laws_reach_the_target_with_model_mismatch(law: str, scale: float) -> None:
    """Friction 30 % off: the target is still reached, with less than 1 mm of overshoot."""
    truth = NeedleParameters.preset(
        'phantom', coulomb_friction=0.56 * scale, viscous_friction=300.0 * scale
    )
    steering = controller(law)
    steering.set_target(0.05)
    depths, _ = insert(steering, truth, 5.0)
    # Inverse dynamics compensates a Coulomb error of 0.17 N at 0.17 / (mu_v h kp) = 0.6 mm.
    assert abs(depths[-1] - 0.05) < 7e-4
    assert depths.max() < 0.051


def test_one_period_of_unmodeled_delay_is_stable() -> None:
    """One period more than configured still ends at the target: the checked margin."""
    steering = controller()
    steering.set_target(0.03)
    depths, _ = insert(steering, NeedleParameters.preset('phantom'), 2.0, late=2)
    assert abs(depths[-1] - 0.03) < 2e-5


def test_zero_force_without_target_and_for_nan_measurements() -> None:
    """Zero force until there is a target, and zero force for a measurement of NaN."""
    steering = controller()
    good = Measurement(time=0.0, depth=0.02, velocity=0.0)
    assert steering.command(good).force == 0.0
    steering.set_target(0.05)
    steering.command(good)
    assert steering.command(Measurement(time=0.1, depth=0.02, velocity=0.0)).force > 0.0
    lost = steering.command(Measurement(time=0.101, depth=nan, velocity=0.0))
    assert (lost.force, lost.torque) == (0.0, 0.0)
    # The motion restarts from the measured depth, not from the old reference.
    again = steering.command(Measurement(time=5.0, depth=0.021, velocity=0.0))
    assert again.setpoint.position == 0.021


def test_reference_is_continuous_when_the_target_changes() -> None:
    """Position and velocity of the reference are continuous when the target changes."""
    steering = controller()
    steering.set_target(0.05)
    points = []
    for i in range(1000):
        if i == 500:
            steering.set_target(0.02)
        measured = Measurement(time=i * PERIOD, depth=0.02, velocity=0.0)
        points.append(steering.command(measured).setpoint)
    speeds = np.array([point.velocity for point in points])
    # One period at the acceleration limit of 0.1 m/s^2, plus rounding.
    assert np.abs(np.diff(speeds)).max() < 1e-4 * (1.0 + 1e-6)
    assert speeds.min() < -0.009


def test_change_of_constants_continues_the_motion() -> None:
    """With corrected friction in mid-motion, it keeps its target and reference and arrives."""
    truth = NeedleParameters.preset('phantom', coulomb_friction=1.0, viscous_friction=500.0)
    steering, told = controller(), controller()
    told.change(truth)
    for each in (steering, told):
        each.set_target(0.05)
    nominal, _ = insert(steering, truth, 2.0)
    steering.change(truth)
    assert steering.target == 0.05
    where = Measurement(time=2.0, depth=nominal[-1], velocity=0.0)
    before = steering.command(Measurement(time=1.999, depth=nominal[-1], velocity=0.0)).setpoint
    # One period at 0.01 m/s.
    assert steering.command(where).setpoint.position == pytest.approx(before.position, abs=1.1e-5)
    depths, aims = insert(told, truth, 3.5)
    # As with the correct model from the start.
    assert np.abs(depths - aims).max() < 5e-5
    assert np.abs(nominal - aims[:2000]).max() > 1e-4


def test_constants_with_unstable_gains_are_rejected() -> None:
    """Too little friction for the gains is rejected with a valid change; the law stays."""
    steering, other = controller('pid'), controller('pid')
    thin = NeedleParameters.preset('phantom', viscous_friction=0.3)
    with pytest.raises(ParameterError, match=r'pid.insertion gains are unstable at 1000 Hz'):
        steering.change(thin)
    measured = Measurement(time=0.5, depth=0.021, velocity=1e-3)
    for each in (steering, other):
        each.set_target(0.05)
        each.command(Measurement(time=0.0, depth=0.02, velocity=0.0))
    assert steering.command(measured) == other.command(measured)


@pytest.mark.requirement('S-020', 'S-022')
def test_forces_stay_within_their_limit() -> None:
    """No command exceeds the force limit, for any error."""
    steering = controller(force_limit=2.0)
    steering.set_target(0.2)
    forces = [
        steering.command(Measurement(time=i * PERIOD, depth=0.02, velocity=0.0)).force
        for i in range(999)
    ]
    assert max(forces) == 2.0


@pytest.mark.requirement('S-024')
@pytest.mark.parametrize('depth', [nan, -0.01, 0.0, 0.21, np.inf])
def test_targets_out_of_range_are_rejected(depth: float) -> None:
    """Before the skin, beyond the hub and not a number: rejected with the valid range."""
    with pytest.raises(ParameterError, match=r'target depth must be in \[0.001, 0.2\] m'):
        controller().set_target(depth)


def test_unknown_law_is_rejected_with_valid_names() -> None:
    """An unknown law is rejected with the valid names."""
    with pytest.raises(ParameterError, match='inverse_dynamics, pid'):
        controller('sliding_mode')


@pytest.mark.parametrize(
    ('gains', 'reason'),
    [
        ({'lqr': {'insertion': PidGains()}}, 'unknown gains lqr.insertion; valid: adaptive'),
        ({'pid': {'deflection': PidGains()}}, 'with insertion and rotation'),
        ({'pid': {'rotation': InverseDynamicsGains()}}, 'pid.rotation must be PidGains'),
    ],
)
def test_gains_of_other_names_or_laws_are_rejected(gains: Any, reason: str) -> None:
    """Only the gains of a law on its axes are accepted."""
    with pytest.raises(ParameterError, match=reason):
        Controller(NeedleParameters.preset('phantom'), gains=gains)


def test_missing_gains_have_their_defaults() -> None:
    """A robot without rotation has gains of insertion only; a change keeps the others."""
    plain = Controller(NeedleParameters.preset('phantom'), 'pid')
    given = Controller(
        NeedleParameters.preset('phantom'), 'pid', gains={'pid': {'insertion': PidGains()}}
    )
    measured = Measurement(time=0.0, depth=0.02, velocity=0.0, angle=0.1)
    for each in (plain, given):
        each.set_target(0.05)
        each.change(gains={'inverse_dynamics': {'insertion': InverseDynamicsGains(kp=400.0)}})
    assert plain.command(measured) == given.command(measured)
    assert plain.command(measured).torque < 0.0


def test_printed_formulation_is_rejected() -> None:
    """It is for the model and the integrator; a controller uses the complete equations."""
    printed = NeedleParameters.preset('phantom', formulation='as_printed')
    with pytest.raises(ParameterError, match=r"formulation must be 'complete'.* got 'as_printed'"):
        Controller(printed)
    with pytest.raises(ParameterError, match="formulation must be 'complete'"):
        controller().change(printed)


def test_fractional_delay_is_rejected() -> None:
    """A delay is a whole number of periods."""
    with pytest.raises(ParameterError, match='whole number'):
        ControllerSettings(delay=1.5)


@pytest.mark.parametrize('switch', ['law', 'gains'])
def test_switch_in_motion_is_bumpless(switch: str) -> None:
    """Another law, or other gains, start with the last force; it does not jump later either."""
    truth = NeedleParameters.preset('phantom')
    steering = controller()
    steering.set_target(0.1)
    insert(steering, truth, 1.0)
    # The last command, and the depth at its time.
    needle = Integrator(truth, NeedleModel(truth).state_at(0.02, 5e-4), 2e-5)
    steering = controller()
    steering.set_target(0.1)
    forces, waiting = [], [0.0]
    for i in range(3000):
        if i == 2000 and switch == 'law':
            steering.change(law='pid')
        elif i == 2000:
            stiff = InverseDynamicsGains(kp=2500.0, kv=100.0)
            steering.change(gains={'inverse_dynamics': {'insertion': stiff}})
        measured = Measurement(time=i * PERIOD, depth=needle.depth, velocity=needle.velocity)
        forces.append(steering.command(measured).force)
        waiting.append(forces[-1])
        needle.advance(PERIOD, waiting.pop(0))
    steps = np.abs(np.diff(forces))
    # The first force equals the last force to rounding; later it changes as the laws do: the
    # offset decays by 1 % a period.
    assert steps[1999] < 1e-9
    assert steps[1999:].max() < 0.02 * abs(forces[1999])
    assert steering.law == ('pid' if switch == 'law' else 'inverse_dynamics')


def test_switch_to_unstable_gains_is_rejected() -> None:
    """The error names them, and the old law continues."""
    steering = controller()
    unstable = InverseDynamicsGains(kv=3000.0)
    with pytest.raises(ParameterError, match=r'inverse_dynamics.insertion gains are unstable'):
        steering.change(gains={'inverse_dynamics': {'insertion': unstable}})
    with pytest.raises(ParameterError, match='valid: adaptive, inverse_dynamics, pid'):
        steering.change(law='bang_bang')
    assert steering.law == 'inverse_dynamics'


@pytest.mark.parametrize('kv', [61.0, 3000.0])
@pytest.mark.parametrize('same', [True, False])
def test_checked_change_equals_an_unchecked_one(kv: float, same: bool) -> None:
    """A check before changes nothing: limits or error are equal, also after another check."""
    each = controller(), controller()
    errors = []
    for steering, checked in zip(each, (True, False), strict=True):
        wanted = {'inverse_dynamics': {'insertion': InverseDynamicsGains(kv=kv)}}
        if checked:
            steering.check_change(gains=wanted if same else None)
        try:
            steering.change(gains=wanted)
        except ParameterError as error:
            errors.append(str(error))
    assert len(errors) == (2 if kv > 1e3 else 0)
    assert len(set(errors)) < 2
    before, after = each
    assert (before.limits, before.age_limits) == (after.limits, after.age_limits)


def test_checked_change_is_not_checked_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """The change takes no time, so that no measurement waits for it."""
    steering = controller()
    wanted = {'inverse_dynamics': {'insertion': InverseDynamicsGains(kv=61.0)}}
    steering.check_change(gains=wanted)
    monkeypatch.setattr(Controller, '_checked', lambda *_: pytest.fail('checked again'))
    steering.change(gains=wanted)
    assert steering._insertion.law.gains == wanted['inverse_dynamics']['insertion']


def test_stability_limits_are_reported() -> None:
    """A radius for each axis; a margin above the margin of the gains is rejected."""
    steering = controller()
    assert set(steering.limits) == {'insertion', 'rotation'}
    assert all(limit.stable for limit in steering.limits.values())
    with pytest.raises(ParameterError, match=r'must be <= 1 - 0.1'):
        controller(stability_margin=0.1)


@pytest.mark.requirement('S-055')
@pytest.mark.parametrize(
    ('depth', 'speed', 'fault'),
    [(0.025, 0.0, 'moved by 0.005 m'), (0.02, 9e3, 'moved by 0 m'), (nan, 0.0, 'must be finite')],
)
def test_inconsistent_measurement_gives_zero_force(depth: float, speed: float, fault: str) -> None:
    """A displacement inconsistent with the velocity gives zero force and the reason."""
    steering = controller()
    steering.set_target(0.05)
    for i in range(100):
        command = steering.command(Measurement(time=i * PERIOD, depth=0.02, velocity=0.0))
    assert command.force > 0.0
    wrong = steering.command(Measurement(time=0.1, depth=depth, velocity=speed))
    assert (wrong.force, wrong.torque) == (0.0, 0.0)
    assert fault in wrong.fault
    # Two consistent measurements at the old depth: it continues to its target.
    for i in range(101, 200):
        command = steering.command(Measurement(time=i * PERIOD, depth=0.02, velocity=0.0))
    assert command.fault is None
    assert command.force > 0.0
    assert steering.target == 0.05


def test_load_that_is_not_finite_is_a_fault() -> None:
    """Zero force for one sample; the law does not remember it."""
    steering = controller()
    steering.set_target(0.05)
    forces = []
    for i in range(100):
        measured = Measurement(time=i * PERIOD, depth=0.02, velocity=0.0)
        command = steering.command(measured, load=nan if i == 50 else 0.0)
        assert (command.fault is not None) == (i == 50)
        forces.append(command.force)
    assert forces[50] == 0.0
    assert 0.0 < forces[-1] < 15.0


@pytest.mark.requirement('S-072')
def test_needle_moved_during_a_fault_clears_the_target() -> None:
    """One message, and no motion before a new target."""
    steering = controller()
    steering.set_target(0.05)
    commands = [
        steering.command(Measurement(time=i * PERIOD, depth=0.02 + 0.01 * (i > 50), velocity=0.0))
        for i in range(100)
    ]
    assert [c.notice for c in commands if c.notice] == [
        'the needle has moved by 0.010000 m since the fault; the target is cleared'
    ]
    assert steering.target is None
    assert not any(c.force for c in commands[51:])


def test_integral_is_frozen_without_a_command() -> None:
    """After a fault PID continues with its integral."""
    truth = NeedleParameters.preset('phantom')
    steering = controller('pid')
    steering.set_target(0.05)
    insert(steering, truth, 1.0)
    # Measured as `insert` left it, at rest: only the integral acts then.
    loop = steering._insertion
    learned = float(loop.memory[INTEGRAL])
    assert learned != 0.0
    steering.release()
    for i in range(500):
        steering.command(Measurement(time=2.0 + i * PERIOD, depth=nan, velocity=0.0))
    assert loop.memory[INTEGRAL] == learned
    steering.forget()
    assert loop.memory[INTEGRAL] == 0.0


@pytest.mark.requirement('S-084')
@pytest.mark.parametrize('step', [7.0, -7.0], ids=['forward', 'back'])
def test_gap_or_step_back_in_time_restarts_the_motion(step: float) -> None:
    """No fault and no jump of the reference: to the same target from the measured depth."""
    steering = controller()
    steering.set_target(0.05)
    for i in range(500):
        before = steering.command(
            Measurement(time=10.0 + i * PERIOD, depth=0.02 + 1e-5 * i, velocity=0.01)
        )
    # Cruising at the speed limit: the setpoint is the limit itself, to rounding.
    assert before.setpoint.velocity == pytest.approx(0.01, rel=1e-12)
    where = 0.02 + 1e-5 * 500
    for i in range(200):
        after = steering.command(
            Measurement(time=10.5 + step + i * PERIOD, depth=where, velocity=0.0)
        )
        assert after.fault is None
        if i == 0:
            assert after.setpoint.position == where
            assert after.setpoint.velocity == 0.0
            assert f'continued after {7.001 if step > 0 else -6.999:.3f} s' in after.notice
        else:
            assert after.notice is None
    assert steering.target == 0.05
    assert after.force > 0.0


@pytest.mark.requirement('S-087')
@pytest.mark.parametrize('load', [nan, inf])
def test_command_detects_non_finite_values(load: float) -> None:
    """An invalid load gives no force; an invalid command must not be sent."""
    steering = controller()
    steering.set_target(0.05)
    measured = Measurement(time=0.0, depth=0.02, velocity=0.0)
    assert steering.command(measured).is_finite()
    refused = steering.command(measured, load)
    assert refused.force == 0.0
    assert 'must be finite' in refused.fault
    assert not ControllerOutput(force=0.0, torque=load, setpoint=Setpoint(0.02)).is_finite()


@pytest.mark.requirement('S-024')
def test_depth_range_limits_the_targets() -> None:
    """Targets outside it are rejected, and also an empty range."""
    steering = controller(lowest_depth=0.02, highest_depth=0.1)
    for depth in (0.01, 0.11):
        with pytest.raises(ParameterError, match=r'must be in \[0.02, 0.1\] m'):
            steering.set_target(depth)
    with pytest.raises(ParameterError, match='lowest_depth and highest_depth must leave a part'):
        controller(lowest_depth=0.3)
