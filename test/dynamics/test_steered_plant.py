# SPDX-License-Identifier: Apache-2.0
"""Steered plant: robot, guide and sensors of a needle that cuts its path."""

from __future__ import annotations

import json
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st
from needle_dynamics import Insertion, InsertionDepthError, ParameterError, SteeredNeedle
from needle_dynamics.simulated.assembly import PlantConstants
from needle_dynamics.simulated.commands import AppliedForces
from needle_dynamics.simulated.plant import Measurement
from needle_dynamics.simulated.run import Event, PARAMETERS, PlantRun, RESET, TARE, TRAJECTORY
from needle_dynamics.simulated.steered import SteeredPlant
from needle_dynamics.simulated.tip_sensor import TipParameters, TipSensor
from needle_ros.contract import STEERING_JOINTS
from needle_ros.errors import JobError
import numpy as np
from numpy.testing import assert_allclose
import pytest

#: A period of 2 ms [ns].
PERIOD = 2_000_000
VALUES: dict[str, Any] = {
    'steered': True,
    'needle': 'bending_35mm',
    'mode': 'robot',
    'rate': 500.0,
    'depth': 0.01,
    'steering.bevel_load': [0.3],
    'steering.skin_stiffness': 300.0,
    'steering.cutting_force': [1.2],
    'tip.noise': 0.0,
}
JOINTS = tuple(joint.name for joint in STEERING_JOINTS)


def course(seconds: float, **ends: float) -> Event:
    """Return a trajectory of one point."""
    return Event(
        TRAJECTORY,
        {'joints': [*ends], 'times': [seconds], 'positions': [[*ends.values()]], 'efforts': [[]]},
    )


def run(
    values: dict[str, Any], samples: int, *events: Event, force: float = 0.0
) -> tuple[PlantRun, list[dict[str, list[float]]]]:
    """Perform events, take samples; return the values by topic."""
    plant = PlantRun(values)
    for event in events:
        plant.perform(event)
    taken = [
        {name: numbers for name, _, numbers in plant.take(k * PERIOD, AppliedForces(0, force))}
        for k in range(1, samples + 1)
    ]
    return plant, taken


def test_tip_matches_a_needle_moved_along_the_joint_states() -> None:
    """A `SteeredNeedle` moved along the published joints ends at the same tip."""
    move = course(2.0, insertion=0.05, guide_x=2e-3, guide_z=-1e-3, guide_tilt_x=0.02, roll=1.0)
    plant, taken = run({**VALUES, 'base.encoder_resolution': 0.0}, 1200, move)
    assert isinstance(plant.plant, SteeredPlant)
    told = plant.constants
    alone = SteeredNeedle(told.model, told.steering)
    alone.move(depth=0.01)
    for sample in taken:
        depth, x, z, tilt_x, tilt_z, roll = sample['joint_states'][:6]
        alone.move(depth=depth, guide=(x, z), tilt=(tilt_x, tilt_z), roll=roll)
    truth = taken[-1]['ground_truth']
    assert_allclose(truth[0], told.model.length - 0.05, rtol=0.0, atol=1e-6)
    # Rounding of a thousand steps.
    assert_allclose(truth[1:4], [alone.tip[0], alone.tip[2], alone.tip_roll], atol=1e-12)
    assert_allclose(taken[-1]['tip_deflection'], alone.tip, atol=1e-12)
    assert abs(truth[1]) > 1e-4
    assert abs(truth[2]) > 1e-4
    # The status contains the published joint; the base stops within 1e-6 rad of its setpoint.
    assert plant.plant.report.joint['roll'] == pytest.approx(roll, abs=1e-12)
    assert roll == pytest.approx(1.0, abs=1e-6)


def test_joints_respect_their_limits_and_arrive() -> None:
    """Velocity and acceleration stay within the limits; other joints rest."""
    ends = {'guide_z': 6e-3, 'guide_tilt_z': -0.1, 'roll': 6.0}
    plant, taken = run(VALUES, 1000, course(0.01, **ends))
    states = np.array([sample['joint_states'] for sample in taken])
    positions, speeds = states[:, 1:6], states[:, 7:12]
    limits = {'guide_z': 0.02, 'guide_tilt_z': 0.2, 'roll': 10.0}
    for k, name in enumerate(JOINTS):
        speed = np.abs(speeds[:, k]).max()
        if name not in ends:
            assert speed == 0.0
            continue
        rate = np.abs(np.diff(speeds[:, k], prepend=0.0)).max() * 500.0
        # Rounding.
        assert 0.9 * limits[name] < speed <= limits[name]
        assert rate <= limits[name] / 0.1 * (1.0 + 1e-9)
        assert_allclose(positions[-1, k], ends[name], rtol=1e-5)
        assert np.abs(positions[:, k]).max() <= abs(ends[name]) * (1.0 + 1e-3)
    assert isinstance(plant.plant, SteeredPlant)


def test_joints_missing_in_a_trajectory_continue() -> None:
    """A roll trajectory stops neither the guide nor the insertion."""
    plant, taken = run(VALUES, 100, course(1.0, insertion=0.03, guide_x=2e-3))
    plant.perform(course(0.5, roll=0.4))
    for k in range(101, 801):
        numbers = {name: values for name, _, values in plant.take(k * PERIOD)}
    assert_allclose(numbers['joint_states'][:6], [0.03, 2e-3, 0.0, 0.0, 0.0, 0.4], atol=1e-6)
    assert taken[-1]['joint_states'][5] == 0.0


@pytest.mark.parametrize(
    ('change', 'complaint'),
    [
        (
            {'joints': ['gide_x']},
            r"takes joints of insertion, guide_x, .*, roll, got \['gide_x'\]",
        ),
        ({'joints': []}, 'takes joints of'),
        ({'joints': ['roll', 'roll'], 'positions': [[1.0, 2.0]]}, 'takes joints of'),
        ({'positions': [[0.03]]}, r'guide_x must stay in \[-0\.02, 0\.02\] m, got 0.03 m'),
        ({'positions': [[float('nan')]]}, 'guide_x must stay in'),
        ({'joints': ['roll'], 'positions': [[101.0]]}, r'roll must stay in \[-100, 100\] rad'),
        ({'positions': [[]]}, 'each point needs a position of guide_x'),
        ({'times': [-1.0]}, 'times must be >= 0 and increasing'),
        ({'times': []}, 'trajectory has no points'),
        (
            {'joints': ['guide_x', 'insertion'], 'positions': [[1e-3, 0.161]]},
            r'trajectory must stay in \[0\.001, 0\.159\] m, got 0.161 m',
        ),
    ],
)
def test_invalid_trajectories_move_no_joint(change: dict[str, Any], complaint: str) -> None:
    """The message contains the given and the valid values."""
    plant, _ = run(VALUES, 1)
    content = {**course(1.0, guide_x=1e-3).content, **change}
    with pytest.raises(ParameterError, match=complaint):
        plant.perform(Event(TRAJECTORY, content))
    before = plant.take(2 * PERIOD)
    assert [v[:6] for n, _, v in before if n == 'joint_states'] == [[0.01, *[0.0] * 5]]


def test_insertion_trajectory_is_ignored_under_force_commands() -> None:
    """The controller uses the trajectory; the force moves the needle."""
    values = {**VALUES, 'mode': 'simulation', 'sensor.force_noise': 0.0, 'sensor.filter': 0}
    _, taken = run(values, 500, course(0.1, insertion=0.1, guide_z=1e-3), force=4.0)
    depth, speed = (taken[-1]['joint_states'][k] for k in (0, 6))
    told = PlantConstants.of(values).model
    # At constant velocity the force equals friction plus cutting force.
    held = told.coulomb_friction + 1.2
    assert_allclose(speed, (4.0 - held) / told.viscous_friction, rtol=1e-9)
    assert depth < 0.02
    # The robot rests within 10 nm of the end, taken twice.
    assert taken[-1]['joint_states'][2] == pytest.approx(1e-3, abs=2e-8)
    assert taken[-1]['ground_truth'][8] == -4.0
    assert_allclose(taken[-1]['base_wrench'][1], 4.0, atol=0.003)


def test_sensor_measures_friction_cutting_and_guide_load() -> None:
    """Insertion: friction and cutting; withdrawal: friction; bent needle: guide load."""
    values = {**VALUES, 'sensor.force_noise': 0.0, 'sensor.torque_noise': 0.0}
    values |= {'sensor.force_resolution': 0.0, 'sensor.torque_resolution': 0.0, 'sensor.filter': 0}
    plant, taken = run(values, 1000, course(2.0, insertion=0.05))
    told = plant.constants.model
    speed = taken[800]['joint_states'][6]
    assert_allclose(speed, 0.02, rtol=1e-6)
    expected = told.coulomb_friction + 1.2 + told.viscous_friction * speed
    assert_allclose(taken[800]['base_wrench'][1], expected, rtol=1e-6)
    # The wrench of the sensor equals the joint efforts, in the order of the message.
    x, y, z, about_x, about_y, about_z = taken[900]['base_wrench']
    efforts = taken[900]['joint_states'][12:]
    assert_allclose([y, x, z, -about_z, about_x, about_y], efforts, rtol=1e-12)
    assert abs(z) > 0.01
    plant.perform(course(2.0, insertion=0.03))
    for k in range(1001, 1801):
        numbers = {name: values for name, _, values in plant.take(k * PERIOD)}
    back = numbers['joint_states'][6]
    expected = told.withdrawal_friction * (told.viscous_friction * back - told.coulomb_friction)
    assert_allclose(numbers['base_wrench'][1], expected, rtol=1e-5)


@pytest.mark.parametrize('samples', [1, 2, 3, 4, 7])
def test_readings_of_a_push_conserve_the_impulse(
    samples: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """For any sensor rate, the mean of the samples equals the mean of the pushes."""
    push = Event(
        TRAJECTORY,
        {'joints': ['insertion'], 'times': [0.02], 'positions': [[]], 'efforts': [[4.0]]},
    )
    forces: list[float] = []
    one = Insertion.push

    def pushed(self: Insertion, duration: float, force: float, **options: Any) -> float:
        forces.append(one(self, duration, force, **options))
        return forces[-1]

    monkeypatch.setattr(Insertion, 'push', pushed)
    plant, _ = run({**VALUES, 'sensor.rate': 500.0 * samples}, 5, push)
    loads = plant.plant._wrenches[:, 1]  # type: ignore[attr-defined]
    assert len(loads) == samples
    assert len(forces) == 20
    assert (np.diff(forces) > 0.0).all()
    # Equal impulse except for rounding; each reading covers the pushes in its interval.
    assert loads.mean() == pytest.approx(np.mean(forces[-4:]), rel=1e-12)
    assert (np.diff(loads) >= 0.0).all()
    if samples == 2:
        assert loads.tolist() == pytest.approx([np.mean(forces[-4:-2]), np.mean(forces[-2:])])


def test_push_force_ramps_up_within_the_speed_limit() -> None:
    """The force equals the command until the velocity reaches its limit."""
    push = Event(
        TRAJECTORY,
        {'joints': ['insertion'], 'times': [1.0, 2.0], 'positions': [[], []],
         'efforts': [[4.0], [4.0]]},
    )  # fmt: skip
    quiet = {'sensor.force_noise': 0.0, 'sensor.filter': 0}
    _, taken = run({**VALUES, **quiet}, 800, push)
    forces = [sample['base_wrench'][1] for sample in taken]
    # A count, and the part of a period covered by a ramp.
    assert_allclose(forces[:500], np.arange(500) * 4.0 / 500, atol=0.02)
    _, fast = run({**VALUES, **quiet, 'base.speed_limit': 1e-3}, 800, push)
    speeds = [sample['joint_states'][6] for sample in fast]
    # Rounding.
    assert max(speeds) == pytest.approx(1e-3, rel=1e-12)
    assert fast[-1]['base_wrench'][1] < 3.0


def test_tare_requires_needle_and_guide_at_rest() -> None:
    """A moving guide loads the sensor."""
    plant, _ = run(VALUES, 100)
    plant.perform(Event(TARE))
    plant.perform(course(1.0, roll=0.5))
    plant.take(101 * PERIOD)
    with pytest.raises(JobError, match='roll moves; it must rest'):
        plant.perform(Event(TARE))
    plant.perform(course(1.0, insertion=0.02))
    for k in range(102, 152):
        plant.take(k * PERIOD)
    with pytest.raises(JobError, match='the needle moves at 1'):
        plant.perform(Event(TARE))


def test_recorded_run_can_be_replayed_bit_for_bit() -> None:
    """After conversion to JSON, with noise of path and sensors."""
    noisy = {**VALUES, 'seed': 7, 'tip.noise': 1.8e-4, 'tip.rate': 40.0, 'tip.delay': 0.02}
    noisy |= {'tip.dropout': 0.1, 'steering.path_noise': 1e-3}
    done = {
        1: [course(1.0, insertion=0.04, guide_x=2e-3)],
        200: [Event(PARAMETERS, {'model.coulomb_friction': 0.9}), course(0.5, roll=2.0)],
        400: [Event(RESET), course(1.0, guide_tilt_z=0.05, insertion=0.03)],
    }
    runs: list[list[list[Measurement]]] = []
    for _ in range(2):
        plant, samples = PlantRun(noisy), []
        for k in range(1, 601):
            for kind, content in done.get(k, []):
                plant.perform(Event(kind, json.loads(json.dumps(content))))
            samples.append(plant.take(k * PERIOD))
        runs.append(samples)
    assert runs[0] == runs[1]
    lost = sum('tip_deflection' not in [name for name, _, _ in sample] for sample in runs[0])
    # 40 of 500 per second, and 10 % of them lost.
    assert 600 - 48 < lost < 600 - 30


@pytest.mark.parametrize(
    ('change', 'complaint'),
    [
        ({'steered': 1}, 'steered must be true or false, got 1'),
        ({'mode': 'indenter'}, 'steered must be false in mode indenter'),
        ({'tip_deflection': 1e-3}, 'tip_deflection must be 0'),
        ({'modal': [1e-6, 0.0]}, 'modal empty'),
        ({'steering.free_length': 0.2}, 'free_length must be < length = 0.2 m'),
        ({'steering.bevel_load': [0.1, 0.2]}, 'one for each of the 1 layers'),
        ({'model.friction_law': 'tanh'}, 'friction_law must be coulomb'),
        ({'guide.rise_time': 0.0}, r'guide\.rise_time must be finite, > 0 s, got 0\.0'),
        ({'tip.offset': [0.0]}, r'tip\.offset must be three numbers, x y z, got \[0\.0\]'),
        ({'depth': 0.17}, r'depth must be in \[0, 0\.16\] m'),
    ],
)
def test_inconsistent_constants_are_rejected(change: dict[str, Any], complaint: str) -> None:
    with pytest.raises(ParameterError, match=complaint):
        PlantConstants.of({**VALUES, **change}).make()


def test_preset_includes_its_steering_constants() -> None:
    """Given constants override the preset."""
    constants = PlantConstants.of({'steered': True, 'needle': 'bending_50mm'})
    assert constants.steering.free_length == 0.04
    changed = {'steered': True, 'needle': 'bending_50mm', 'steering.free_length': 0.03}
    assert PlantConstants.of(changed).steering.free_length == 0.03
    assert PlantConstants.of({'steered': True}).steering.free_length == 0.02


def test_complete_withdrawal_is_an_error() -> None:
    """The limit is the skin, as in `Insertion`."""
    with pytest.raises(InsertionDepthError, match='the needle reached the skin'):
        run({**VALUES, 'mode': 'simulation'}, 500, force=-15.0)


def test_outline_runs_from_the_base_to_the_tip() -> None:
    """It has the length and the slopes of the needle, and the cut path."""
    plant, taken = run(VALUES, 1500, course(2.0, insertion=0.08, guide_z=4e-3))
    seen = plant.plant.outline()
    assert seen is not None
    assert_allclose(seen.points[-1], taken[-1]['tip_deflection'], atol=1e-12)
    whole = np.vstack([seen.base, seen.points])
    length = np.linalg.norm(np.diff(whole, axis=0), axis=1).sum()
    # Small slopes: the arc length exceeds the length along y by half their square.
    assert_allclose(length, 0.2, rtol=1e-3)
    assert_allclose(seen.points[0], [0.0, -0.04, 4e-3], atol=1e-6)
    # The robot overshot slightly; the path ends at the deepest point.
    deepest = max((sample['tip_deflection'] for sample in taken), key=lambda tip: tip[1])
    assert_allclose(seen.path[-1], deepest, atol=1e-9)
    middle = 0.5 * (seen.slopes[1:] + seen.slopes[:-1])
    # In the tissue, where points are a millimeter apart.
    steps = np.diff(seen.points, axis=0)[1:]
    assert_allclose(steps[:, [0, 2]] / steps[:, [1]], middle[1:], atol=2e-3)


def seen_by(readings: int = 2000, **constants: Any) -> np.ndarray:
    """Return spatial sensor readings of a tip at (2, 50, 1) mm; NaN if missing."""
    sensor = TipSensor(TipParameters(**{'noise': 0.0, **constants}), 100.0, 3, spatial=True)
    found = [sensor.measure(0.05, 1e-3, 2e-3) for _ in range(readings)]
    return np.array([(r.across, r.depth, r.deflection) if r else (np.nan,) * 3 for r in found])


def test_tracker_has_noise_on_every_axis() -> None:
    errors = seen_by(noise=1.8e-4) - (2e-3, 0.05, 1e-3)
    # 2000 samples: errors of 4 um (mean) and 1.6 % (deviation), each taken four times.
    assert_allclose(errors.mean(axis=0), 0.0, atol=1.6e-5)
    assert_allclose(errors.std(axis=0), 1.8e-4, rtol=0.064)
    # Independent: a correlation has an error of 0.022.
    assert np.abs(np.corrcoef(errors.T) - np.eye(3)).max() < 0.09


def test_dropout_has_the_given_probability() -> None:
    lost = np.isnan(seen_by(dropout=0.05)[:, 0]).mean()
    # Standard deviation of 0.005.
    assert 0.03 < lost < 0.07
    assert np.isnan(seen_by(dropout=1.0)).all()


@settings(max_examples=50, deadline=None)
@given(turn=st.floats(-3.1, 3.1), offset=st.tuples(*[st.floats(-0.01, 0.01)] * 3))
def test_sensor_frame_has_a_rotation_and_an_offset(
    turn: float, offset: tuple[float, float, float]
) -> None:
    """The inverse rotation gives the tip; the offset is added after the rotation."""
    ((x, y, z),) = seen_by(1, turn=turn, offset=offset) - offset
    c, s = np.cos(turn), np.sin(turn)
    # Rounding.
    assert_allclose([c * x + s * z, y, c * z - s * x], [2e-3, 0.05, 1e-3], atol=1e-15)


def test_imager_measures_only_within_its_slice() -> None:
    """It reports x = 0 within the slice, and nothing outside."""
    assert_allclose(seen_by(3, slice=2.5e-3), [[0.0, 0.05, 1e-3]] * 3)
    assert np.isnan(seen_by(3, slice=1.5e-3)).all()
