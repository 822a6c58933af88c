# SPDX-License-Identifier: Apache-2.0
"""Check of a robot before its first motion, on simulated robots that know only their driver."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from benchmarks.commissioning import (
    cases,
    changed_robot,
    ErrorCase,
    ERRORS,
    FirstMotionSession,
    HARMFUL,
    KINDS,
    measure,
    RobotSetup,
    run,
    setup,
)
from benchmarks.robots import RATE, SimulatedRobot, Slide, Spindle, Stage, STEPS
from needle_controller import ReferenceLimits
from needle_controller.commissioning import CommissioningSettings
from needle_ros.errors import ParameterError
from needle_ros.settings import from_values
from needle_ros.status import CommissioningPhase
from needle_ros.system_state import CLEAR_STOP, PAUSE, RESUME, RETRACT
from needle_ros.timing import NANOSECONDS
import numpy as np
import pytest

#: Duration of a session with two first motions [s].
_LONG = 16.0


def correct(kind: type[SimulatedRobot], seed: int = 3) -> RobotSetup:
    """Return a robot with its correct configuration."""
    return setup(kind, np.random.default_rng(seed))


def refused(one: RobotSetup) -> FirstMotionSession:
    """Run a session that the check refuses, within 2 mm."""
    found = run(one, check=True)
    assert found.phase is CommissioningPhase.REFUSED
    assert found.motion <= HARMFUL
    return found


@pytest.mark.parametrize('case', cases(0, 9), ids=str)
def test_correct_configurations_pass_and_arrive(case: ErrorCase) -> None:
    """With any unit, sign, zero, sensor axis, and with friction and delay within their ranges."""
    found = measure(case)
    assert (found.checked.reason, found.checked.phase) == ('', CommissioningPhase.PASSED)
    assert found.checked.arrived
    assert not found.harmful


#: Each error on one of the robots, and the harmful ones of the worst kinds on all.
SOME = [
    case
    for k, case in enumerate(cases(len(ERRORS) * len(KINDS), 0))
    if k // len(KINDS) % len(KINDS) == k % len(KINDS) or case.error == 'sign with matching zero'
]


@pytest.mark.parametrize('case', SOME, ids=lambda case: f'{case.error}, {case.robot.__name__}')
def test_harmful_errors_are_refused_within_two_millimeters(case: ErrorCase) -> None:
    """The benchmark repeats this with 500 errors."""
    found = measure(case)
    assert found.harmful or case.error != 'sign with matching zero'
    assert found.refused or not found.harmful
    assert not found.refused or found.checked.motion <= HARMFUL


@pytest.mark.requirement('S-189')
@pytest.mark.parametrize(
    ('error', 'parameter'),
    [
        ('scale', 'hardware.scale must be '),
        ('scale with matching zero', 'hardware.scale must be '),
        ('sign', 'hardware.sign must be '),
        ('sign with matching zero', 'hardware.sign must be '),
        ('zero', 'hardware.zero must be '),
        ('lead and speed', 'hardware.lead must be <= 0.01 '),
    ],
)
@pytest.mark.parametrize('kind', KINDS)
def test_contradictions_of_the_measured_depths_are_rejected(
    error: str, parameter: str, kind: type[SimulatedRobot]
) -> None:
    """Before the controller starts, with the parameter and its value."""
    found = run(ERRORS[error](correct(kind), np.random.default_rng(1)), check=True)
    assert found.phase is None
    assert found.reason.startswith(parameter)


@pytest.mark.requirement('S-190')
@pytest.mark.parametrize('kind', KINDS)
def test_other_depth_than_measured_is_refused_at_rest(kind: type[SimulatedRobot]) -> None:
    """A lost zero of the encoder, or another joint."""
    one = correct(kind)
    robot = one.robot()
    found = refused(changed_robot(one, zero=robot.zero + 5e-3 / robot.gain))
    assert 'hardware.joint or hardware.zero' in found.reason
    assert found.motion == 0.0


@pytest.mark.requirement('S-191')
@pytest.mark.parametrize('kind', KINDS)
def test_missing_response_is_refused(kind: type[SimulatedRobot]) -> None:
    found = refused(replace(correct(kind), connected=False))
    assert "the joint 'axis' moved " in found.reason
    assert 'command_topic' in found.reason


@pytest.mark.parametrize('kind', KINDS)
def test_other_joint_at_the_same_depth_is_refused(kind: type[SimulatedRobot]) -> None:
    """It does not respond, while the needle is pulled by less than 2 mm."""
    one = correct(kind)
    robot = one.robot()
    near = changed_robot(one, other=robot.position(robot.depth + 0.5e-3))
    found = refused(replace(near, hardware={**one.hardware, 'joint': 'door'}))
    assert "the joint 'door' moved " in found.reason


@pytest.mark.requirement('S-191')
@pytest.mark.parametrize('kind', KINDS)
def test_reversed_driver_is_refused(kind: type[SimulatedRobot]) -> None:
    """A driver whose commands have the opposite direction of its joint states."""
    one = correct(kind)

    class Reversed(kind):  # type: ignore[misc, valid-type]
        def take(self, value: float | None) -> None:
            super().take(None if value is None else 2.0 * here - value)

    robot = one.robot()
    here = robot.position(robot.depth) if kind is not Slide else 0.0
    values = {name: getattr(robot, name) for name in SimulatedRobot.__dataclass_fields__}
    found = refused(replace(one, robot=lambda: Reversed(**values)))
    assert "the joint 'axis' moved +" in found.reason


@pytest.mark.requirement('S-190')
@pytest.mark.parametrize('kind', KINDS)
@pytest.mark.parametrize('rate', [50.0, 1000.0])
def test_wrong_rate_is_refused_at_rest(kind: type[SimulatedRobot], rate: float) -> None:
    found = refused(replace(correct(kind), rate=rate))
    assert f'received at {RATE:g} Hz, rate is {rate:g} Hz: set rate to 200' in found.reason
    assert found.motion == 0.0


@pytest.mark.requirement('S-191')
@pytest.mark.parametrize(
    ('kind', 'late', 'said'),
    [
        (Stage, {'lag': 0.2}, 'hardware.commissioning.lag'),
        (Spindle, {'dead': 20}, 'hardware.commissioning.lag'),
        (Slide, {'dead': 5}, 'the force acts 5 periods late, delay is 1: set delay to 5'),
    ],
)
def test_delay_is_refused(kind: type[SimulatedRobot], late: dict[str, Any], said: str) -> None:
    assert said in refused(changed_robot(correct(kind), **late)).reason


@pytest.mark.requirement('S-191')
@pytest.mark.parametrize('kind', KINDS)
def test_force_sensor_axes_are_refused_with_the_correct_axis(kind: type[SimulatedRobot]) -> None:
    """The proposed axis passes."""
    one = correct(kind)
    others = [axis for axis in ('x', 'y', 'z', '-x', '-y', '-z') if axis != one.robot().force_axis]
    for axis in others:
        found = refused(replace(one, hardware={**one.hardware, 'force_axis': axis}))
        _, _, rest = found.reason.partition('set hardware.force_axis to ')
        assert rest.split(',')[0] == one.robot().force_axis
    turned = {**one.hardware, 'reaction': not one.hardware['reaction']}
    found = refused(replace(one, hardware=turned))
    assert f'or hardware.reaction to {str(one.hardware["reaction"]).lower()}' in found.reason


@pytest.mark.requirement('S-191', 'S-332')
@pytest.mark.parametrize('kind', KINDS)
@pytest.mark.parametrize('seed', range(4))
def test_wrong_reaction_is_refused_with_any_bias_and_delay_of_the_sensor(
    kind: type[SimulatedRobot], seed: int
) -> None:
    """Until the end of the first motion; the correct one passes, and rejected readings, too."""
    rng = np.random.default_rng(seed)
    bias, delays = rng.uniform(-4.0, 4.0, 3), (0.0, rng.uniform(0.01, 0.5), rng.uniform(0.5, 1.4))
    one = correct(kind, seed)
    turned = {**one.hardware, 'reaction': not one.hardware['reaction']}
    fixed = one.robot()
    values = {name: getattr(fixed, name) for name in SimulatedRobot.__dataclass_fields__}

    class Biased(kind):  # type: ignore[misc, valid-type]
        delay, begun = 0.0, 0

        def wrench(self, stamp: int) -> Any:
            reading = super().wrench(stamp)
            self.begun = self.begun or stamp
            valid = stamp - self.begun >= NANOSECONDS * self.delay
            force = (*(reading.values[0][:3] + bias), 0.0, 0.0, 0.0)
            return reading._replace(frame=reading.frame if valid else 'other', values=(force,))

    for delay in delays:
        Biased.delay = float(delay)
        case = replace(one, robot=lambda: Biased(**values))
        assert run(case, check=True).phase is CommissioningPhase.PASSED
        assert 'or hardware.reaction to' in refused(replace(case, hardware=turned)).reason
    Biased.delay = np.inf
    assert run(replace(case, hardware=turned), check=True).phase is CommissioningPhase.PASSED


@pytest.mark.requirement('S-191', 'S-336')
@pytest.mark.parametrize('kind', KINDS)
@pytest.mark.parametrize('noise', [0.0, 0.05, 0.15, 0.3])
@pytest.mark.parametrize('repeats', [1, 4])
def test_wrong_reaction_is_refused_with_a_noisy_force_sensor(
    kind: type[SimulatedRobot], noise: float, repeats: int
) -> None:
    """Also with one that is slower than the encoders; more noise than force is stated."""
    one = correct(kind)
    fixed = one.robot()
    values = {name: getattr(fixed, name) for name in SimulatedRobot.__dataclass_fields__}
    values['noise'] = (2e-6, 1e-4, noise)

    class Slow(kind):  # type: ignore[misc, valid-type]
        count, last = 0, None

        def wrench(self, stamp: int) -> Any:
            if self.count % repeats == 0:
                self.last = super().wrench(stamp)
            self.count += 1
            return self.last._replace(stamp=stamp)

    noisy = replace(one, robot=lambda: Slow(**values))
    turned = replace(noisy, hardware={**one.hardware, 'reaction': not one.hardware['reaction']})
    found = run(noisy, check=True)
    assert found.phase is CommissioningPhase.PASSED
    passed = run(turned, check=True)
    if passed.phase is CommissioningPhase.PASSED:
        # Efforts end after some samples.
        assert kind is Slide or repeats * noise > 0.5
        assert 'hardware.force_axis and reaction are not checked' in passed.result
    else:
        assert 'or hardware.reaction to' in passed.reason
        assert passed.motion <= HARMFUL


@pytest.mark.requirement('S-190')
@pytest.mark.parametrize('kind', KINDS)
def test_unstated_facts_are_refused_without_motion(kind: type[SimulatedRobot]) -> None:
    """Unless the check is skipped."""
    one = replace(correct(kind), facts={})
    found = refused(one)
    assert 'positions, depths and start_depth are not stated' in found.reason
    assert 'hardware.commissioning.enabled false skips' in found.reason
    assert found.motion == 0.0
    skipped = run(one, check=False)
    assert (skipped.phase, skipped.arrived) == (CommissioningPhase.SKIPPED, True)


@pytest.mark.parametrize('kind', KINDS)
@pytest.mark.parametrize('depth', [0.0, 1e-3])
def test_needle_may_start_at_the_entry(kind: type[SimulatedRobot], depth: float) -> None:
    """The first motion may leave the range of depths by its length."""
    one = changed_robot(correct(kind), depth=depth)
    found = run(replace(one, facts={**one.facts, 'start_depth': depth}), check=True)
    assert (found.reason, found.phase) == ('', CommissioningPhase.PASSED)


@pytest.mark.parametrize('kind', KINDS)
def test_robot_without_a_force_sensor_passes(kind: type[SimulatedRobot]) -> None:
    """Its readings do not change."""
    one = correct(kind)

    class Insensible(kind):  # type: ignore[misc, valid-type]
        def resistance(self) -> float:
            return 0.0

    robot = one.robot()
    values = {name: getattr(robot, name) for name in SimulatedRobot.__dataclass_fields__}
    found = run(replace(one, robot=lambda: Insensible(**values)), check=True)
    assert found.phase is CommissioningPhase.PASSED


@pytest.mark.parametrize('kind', [Spindle, Slide])
def test_velocity_of_another_unit_is_refused(kind: type[SimulatedRobot]) -> None:
    """Degrees in place of radians, or mm in place of m."""
    one = correct(kind)

    class Degrees(kind):  # type: ignore[misc, valid-type]
        def states(self, stamp: int) -> Any:
            reading = super().states(stamp)
            positions, velocities, efforts = reading.values
            scaled = tuple(57.3 * velocity for velocity in velocities)
            return reading._replace(values=(positions, scaled, efforts))

    robot = one.robot()
    values = {name: getattr(robot, name) for name in SimulatedRobot.__dataclass_fields__}
    found = run(replace(one, robot=lambda: Degrees(**values)), check=True)
    assert found.phase is not CommissioningPhase.PASSED
    assert found.motion <= HARMFUL


@pytest.mark.requirement('S-337')
@pytest.mark.parametrize('share', [0.58, 0.77, 1.0, 1.25])
@pytest.mark.parametrize('speed', [2e-3, 1e-2])
def test_velocity_that_would_interrupt_a_motion_is_refused(share: float, speed: float) -> None:
    """Such as one between two commands; refused if more than 2 mm are missing within 2 s."""
    one = correct(Spindle)
    robot = one.robot()
    values = {name: getattr(robot, name) for name in SimulatedRobot.__dataclass_fields__}

    class Inaccurate(Spindle):
        def states(self, stamp: int) -> Any:
            reading = super().states(stamp)
            positions, velocities, efforts = reading.values
            scaled = tuple(share * velocity for velocity in velocities)
            return reading._replace(values=(positions, scaled, efforts))

    limits = ReferenceLimits(speed=speed)
    session = replace(one, robot=lambda: Inaccurate(**values))
    found = run(session, check=True, duration=12.0, limits=limits)
    if abs(share - 1.0) * 2.0 * speed > 2e-3:
        assert found.phase is CommissioningPhase.REFUSED
        assert found.reason.endswith('it is then estimated, or lower reference.speed')
    else:
        assert (found.reason, found.arrived) == ('', True)


def test_coarse_encoder_is_named() -> None:
    """Steps of 1 mm are more than the first motion."""
    one = correct(Stage)
    robot = one.robot()
    values = {name: getattr(robot, name) for name in SimulatedRobot.__dataclass_fields__}

    class Coarse(Stage):
        def position(self, depth: float) -> float:
            return super().position(1e-3 * round(depth / 1e-3))

    facts = {**one.facts, 'start_depth': 1e-3 * round(robot.depth / 1e-3)}
    values['noise'] = (0.0, 0.0, 0.02)
    found = refused(replace(one, facts=facts, robot=lambda: Coarse(**values)))
    assert 'a fifth of hardware.commissioning.distance' in found.reason
    assert 'e-' not in found.reason


def test_noise_above_the_motion_is_refused() -> None:
    """8 standard deviations of 0.1 mm are more than 0.5 mm."""
    one = changed_robot(correct(Stage), noise=(1e-4, 0.0, 0.02))
    assert 'hardware.commissioning.distance 0.0005 m' in refused(one).reason


@pytest.mark.parametrize('kind', KINDS)
def test_first_motion_is_small_and_slow(kind: type[SimulatedRobot]) -> None:
    """Its length and speed are the parameters."""
    one = correct(kind)
    facts = {**one.facts, 'distance': 1e-3, 'speed': 5e-4}
    paths: list[float] = []

    def watched(make: Callable[[], SimulatedRobot]) -> SimulatedRobot:
        robot = make()
        move = robot.move

        def moved(h: float) -> None:
            move(h)
            paths.append(robot.depth)

        robot.move = moved  # type: ignore[method-assign]
        return robot

    run(replace(one, facts=facts, robot=lambda: watched(one.robot)), check=True, duration=8.0)
    path = np.array(paths)
    first = path[: int(np.argmin(path)) + 1]
    # 20 % of the length with efforts; the delay of 15 ms of growing force adds a little.
    least, most = (0.2e-3, 0.5e-3) if kind is Slide else (0.9e-3, 1.2e-3)
    assert least < one.robot().depth - first[-1] < most
    if kind is not Slide:
        # In each simulation step; a sampled ramp is faster just after each command.
        assert np.abs(np.diff(first)).max() < 1.5 * 5e-4 / (RATE * STEPS)


@pytest.mark.parametrize('kind', KINDS)
def test_pause_interrupts_the_first_motion(kind: type[SimulatedRobot]) -> None:
    """It is repeated after the pause, in which the needle rests."""
    begins = 3.0 if kind is Slide else 1.3
    words = {begins: PAUSE, begins + 0.5: RESUME}
    found = run(correct(kind), check=True, duration=_LONG, words=words)
    assert (found.reason, found.phase) == ('', CommissioningPhase.PASSED)
    assert found.arrived
    held = run(correct(kind), check=True, duration=_LONG, words={begins: PAUSE})
    assert held.phase is CommissioningPhase.WAITING
    assert held.motion <= HARMFUL


@pytest.mark.parametrize('kind', KINDS)
def test_first_motion_is_repeated_after_a_refusal(kind: type[SimulatedRobot]) -> None:
    """By a retraction after the stop is cleared, again within 2 mm."""
    one = replace(correct(kind), connected=False)
    found = run(one, check=True, duration=_LONG, words={7.0: CLEAR_STOP, 7.1: RETRACT})
    assert found.phase is CommissioningPhase.REFUSED
    assert found.motion <= HARMFUL


@pytest.mark.parametrize(
    ('values', 'said'),
    [
        ({'positions': [1.0]}, 'positions and depths must be two each, 0.01 m apart or more, got'),
        ({'positions': [1.0, 1.0], 'depths': [0.0, 0.1]}, 'positions and depths must be two each'),
        ({'positions': [1.0, 2.0], 'depths': [0.0, 5e-3]}, 'positions and depths must be two'),
        ({'distance': 2e-3}, 'distance must be finite, >= 0.0001 and <= 0.0015 m, got 0.002'),
        ({'speed': 0.1}, 'speed must be finite, >= 0.0001 and <= 0.005 m/s, got 0.1'),
        ({'enabled': 0}, 'enabled must be true or false, got 0'),
    ],
)
def test_invalid_facts_are_rejected_in_one_line(values: dict[str, Any], said: str) -> None:
    with pytest.raises(ParameterError) as raised:
        from_values(CommissioningSettings, values, 'hardware.commissioning.')
    assert str(raised.value).startswith(f'hardware.commissioning.{said}')


@pytest.mark.requirement('S-314')
@pytest.mark.parametrize('kind', [Stage, Spindle])
@pytest.mark.parametrize('frozen', [False, True])
@pytest.mark.parametrize('speed', [1e-3, 1e-2])
@pytest.mark.parametrize('dead', [0, 100])
def test_position_robot_without_motion_stops_the_system(
    kind: type[SimulatedRobot], speed: float, dead: int, *, frozen: bool
) -> None:
    """
    Blocked, or with frozen encoders, prompt or late by 0.5 s.

    It is ahead of them by the lead of 2 mm at most, and stopped within a second and its delay.
    """
    one = correct(kind)
    robot = one.robot()
    end, moment = robot.depth + 4e-3, [0.0, 0.0]

    class Faulty(kind):  # type: ignore[misc, valid-type]
        time = 0.0

        def move(self, h: float) -> None:
            self.time += h
            moment[self.depth >= end] = self.time
            if frozen or self.depth < end:
                super().move(h)
            else:
                self.velocity = 0.0

        def position(self, depth: float) -> float:
            return float(super().position(min(depth, end) if frozen else depth))

    values = {name: getattr(robot, name) for name in SimulatedRobot.__dataclass_fields__}
    values['dead'] += dead
    session = replace(one, robot=lambda: Faulty(**values))
    limits = ReferenceLimits(speed=speed)
    found = run(session, check=False, duration=15.0, limits=limits)
    assert found.reason.startswith('the robot does not follow its position command')
    # The position is constant within noise.
    assert found.motion < 4e-3 + 2e-3 + 1e-4
    # The session ends 0.5 s after the stop; the first of the needle's motion to the lead.
    assert moment[1] - moment[0] < 1.0 + 0.2e-3 / speed + dead / RATE + 0.5 + 0.1


@pytest.mark.requirement('S-334')
@pytest.mark.parametrize('kind', [Stage, Spindle])
@pytest.mark.parametrize(
    ('lag', 'dead'), [(0.2, 0.1), (0.3, 0.0), (0.02, 0.2), (0.5, 0.2), (0.02, 0.5), (0.02, 0.75)]
)
def test_late_position_robot_arrives(kind: type[SimulatedRobot], lag: float, dead: float) -> None:
    """With any delay that `hardware.commissioning.lag` allows: 0.8 s at most."""
    late = changed_robot(correct(kind), lag=lag, dead=round(dead * RATE))
    slow = replace(late, facts={**late.facts, 'lag': 0.8})
    found = run(slow, check=True, duration=25.0)
    assert (found.reason, found.phase) == ('', CommissioningPhase.PASSED)
    assert found.arrived
