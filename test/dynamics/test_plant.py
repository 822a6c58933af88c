# SPDX-License-Identifier: Apache-2.0
"""Plant: base motions and pushes, changes of constants, tare, and tip sensor."""

from __future__ import annotations

from dataclasses import replace
from math import inf, nan
from typing import Any

from hypothesis import given
from hypothesis import strategies as st
from needle_controller.steering.motion import duration_of, smooth
from needle_controller.steering.settings import ExecutiveSettings
from needle_dynamics import (
    FloatArray,
    InsertionDepthError,
    Integrator,
    NeedleModel,
    NeedleParameters,
    ParameterError,
    ShapeError,
)
from needle_dynamics.parameters import PRESETS
from needle_dynamics.simulated.assembly import PlantConstants
from needle_dynamics.simulated.base import BaseMotion, BaseParameters
from needle_dynamics.simulated.force_sensor import ForceSensor, ForceSensorParameters
from needle_dynamics.simulated.plant import Plant, PlantSample
from needle_dynamics.simulated.tip_sensor import TipParameters, TipReading, TipSensor
from needle_ros.contract import INSERTION
from needle_ros.errors import JobError
from needle_ros.trajectories import JointPath
import numpy as np
from numpy.testing import assert_allclose
import pytest
from scipy.signal import butter, sosfilt, sosfilt_zi

RATE = 500.0
DEPTH = 0.1
PERFECT = ForceSensorParameters(
    force_noise=0.0, torque_noise=0.0, force_resolution=0.0, torque_resolution=0.0, filter=0
)


def robot(
    parameters: NeedleParameters = PRESETS['phantom'], depth: float = DEPTH, **limits: Any
) -> Plant:
    """Return a plant in mode robot with an ideal sensor."""
    state = NeedleModel(parameters).state_at(depth, 0.0)
    base = BaseMotion(
        BaseParameters(**limits), depth, (parameters.minimum_depth, parameters.length), 1e3
    )
    return Plant(Integrator(parameters, state, 2e-5), ForceSensor(PERFECT, RATE, 0), RATE, base)


def follow(plant: Plant, *points: tuple[float, float | None, float | None]) -> None:
    """Send a trajectory of points: time, insertion depth or None, force or None."""
    times, depths, forces = zip(*points, strict=True)

    def row(value: float | None) -> list[float]:
        return [] if value is None else [value]

    plant.follow(['insertion'], times, [row(d) for d in depths], [row(f) for f in forces])


def run(plant: Plant, duration: float) -> list[PlantSample]:
    return [plant.advance() for _ in range(round(duration * RATE))]


def column(samples: list[PlantSample], name: str) -> FloatArray:
    return np.array([getattr(sample, name) for sample in samples])


@pytest.mark.parametrize('way', [1.0, -1.0])
@pytest.mark.parametrize('changes', [{}, {'coulomb_friction': 0.31}, {'carriage_mass': 0.5}])
def test_force_ramp_moves_the_needle_when_it_exceeds_friction(
    way: float, changes: dict[str, float]
) -> None:
    """Up to mu_s the depth is constant bit for bit; above, the velocity is (f - mu_s) / mu_v."""
    parameters = NeedleParameters.preset('phantom', **changes)
    mu_s = parameters.coulomb_friction
    plant = robot(parameters)
    follow(plant, (1.0, None, 2.0 * way))
    samples = run(plant, 1.0)
    # The needle moves under the mean force of each quarter of an interval.
    ends = np.arange(1, len(samples) + 1)
    felt, force = 2.0 * way * ends / RATE, 2.0 * way * (ends - 0.125) / RATE
    speed, depth = column(samples, 'velocity'), column(samples, 'depth')
    at_rest = np.abs(force) <= mu_s
    assert at_rest.sum() == np.floor(mu_s / 2.0 * RATE + 0.125)
    assert np.all(speed[at_rest] == 0.0)
    assert np.all(depth[at_rest] == DEPTH)
    assert np.all(speed[~at_rest] * way > 0.0)
    wrench = column(samples, 'wrench')[:, 1]
    assert_allclose(wrench[at_rest], felt[at_rest], rtol=1e-12)
    if not parameters.carriage_mass:
        # M / mu_v = 7 us: transients decay to e^-70 within a quarter of an interval of 2 ms.
        assert_allclose(speed[~at_rest], (force[~at_rest] - way * mu_s) / 300.0, rtol=1e-9)
        assert_allclose(wrench[~at_rest], felt[~at_rest], rtol=1e-12)


@pytest.mark.parametrize('preset', ['phantom', 'paper_si'])
@pytest.mark.parametrize('force', [100.0, -100.0])
def test_push_respects_the_speed_limit(preset: str, force: float) -> None:
    """For any force; at the limit the sensor measures the force required by the motion."""
    parameters = PRESETS[preset]
    plant = robot(parameters, speed_limit=0.03)
    follow(plant, (0.5, None, force))
    samples = run(plant, 1.0)
    speed = column(samples, 'velocity')
    # The velocity is prescribed: rounding only.
    assert np.abs(speed).max() <= 0.03 * (1.0 + 1e-12)
    assert_allclose(speed[-250:], np.copysign(0.03, force), rtol=1e-12)
    felt = np.copysign(parameters.coulomb_friction + 0.03 * parameters.viscous_friction, force)
    # No contribution of bending: the needle was straight.
    assert_allclose(column(samples, 'wrench')[-200:, 1], felt, rtol=1e-9)


def test_speed_limit_keeps_the_needle_in_the_tissue() -> None:
    """A force that would pull the needle out within an interval is limited before."""
    plant = robot(PRESETS['paper_si'], depth=0.003, speed_limit=0.001)
    follow(plant, (0.0, None, -1000.0))
    # The velocity is reached linearly in the first quarter of the interval.
    assert plant.advance().depth == pytest.approx(0.003 - 0.875 * 0.001 / RATE, rel=1e-9)
    with pytest.raises(InsertionDepthError, match='minimum_depth'):
        run(plant, 3.0)


def test_motion_after_a_push_starts_at_the_actual_position() -> None:
    """It ends at the commanded position."""
    plant = robot()
    follow(plant, (0.5, None, 2.0), (1.5, 0.11, None), (2.0, 0.11, None))
    pushed = run(plant, 0.5)[-1].depth
    assert pushed > DEPTH + 1e-4
    back = run(plant, 1.0)
    slope = (0.11 - pushed) / 1.0
    line = pushed + slope * np.arange(1, len(back) + 1) / RATE
    # The velocity at the end of the push, (2 - 0.56) / 300 m/s, is braked at 0.5 m/s^2.
    lead = (1.44 / 300.0) ** 2
    assert np.abs(column(back, 'depth') - line).max() < lead
    assert np.abs(np.diff(column(back, 'velocity'))).max() <= 0.5 / RATE * (1.0 + 1e-12)
    assert run(plant, 0.5)[-1].depth == pytest.approx(0.11, abs=1e-7)


def test_push_force_is_piecewise_linear_and_held_at_the_end() -> None:
    """The first segment starts at zero force."""
    plant = robot()
    follow(plant, (0.2, None, 0.4), (0.4, None, -0.2))
    ends = np.arange(1, 301) / RATE
    expected = np.interp(ends, [0.0, 0.2, 0.4], [0.0, 0.4, -0.2])
    assert_allclose(column(run(plant, 0.6), 'force'), expected, atol=1e-12)
    # A new push starts with the present force.
    follow(plant, (0.1, None, 0.3))
    ramp = np.interp(ends[:50], [0.0, 0.1], [-0.2, 0.3])
    assert_allclose(column(run(plant, 0.1), 'force'), ramp, atol=1e-12)
    # After a motion a push starts at zero force.
    follow(plant, (0.1, DEPTH, None), (0.2, None, 0.5))
    run(plant, 0.1)
    assert_allclose(column(run(plant, 0.1), 'force'), 5.0 * ends[:50], atol=1e-12)


def test_position_overrides_effort_in_a_point() -> None:
    one, other = robot(), robot()
    follow(one, (0.5, 0.102, None), (0.7, 0.102, None))
    follow(other, (0.5, 0.102, 50.0), (0.7, 0.102, nan))
    assert np.array_equal(column(run(one, 0.7), 'depth'), column(run(other, 0.7), 'depth'))


@pytest.mark.parametrize('resolution', [0.0, 1e-6, 2.5e-5])
def test_encoder_rounds_to_the_nearest_count(resolution: float) -> None:
    """The error of the joint position is at most half a count; zero disables rounding."""
    plant = robot(encoder_resolution=resolution)
    follow(plant, (1.0, 0.103, None))
    samples = run(plant, 1.2)
    depth, shown = column(samples, 'depth'), column(samples, 'joint_position')
    if resolution == 0.0:
        assert np.array_equal(depth, shown)
    else:
        # Rounding of the quotient of up to 1e5 counts.
        assert np.abs(shown / resolution - np.round(shown / resolution)).max() < 1e-9
        assert np.abs(depth - shown).max() <= 0.5 * resolution * (1.0 + 1e-9)


@pytest.mark.parametrize(
    ('points', 'complaint'),
    [
        ([(1.0, 0.3, None)], r'trajectory must stay in \[0.001, 0.2\] m, got 0.3 m'),
        ([(1.0, nan, None)], 'trajectory must stay in'),
        ([(1.0, None, inf)], 'a push must be within 1000 N, got inf N'),
        ([(1.0, None, nan)], 'a push must be within 1000 N'),
        ([(1.0, None, 1.0), (2.0, None, None)], 'each point needs a position or an effort'),
        ([(-1.0, 0.1, None)], r'trajectory times must be >= 0 and increasing, got -1 s'),
        ([(1.0, 0.1, None), (1.0, 0.1, None)], 'and increasing, got 1 s after 1 s'),
    ],
)
def test_invalid_trajectories_have_no_effect(points: list[Any], complaint: str) -> None:
    """The trajectory is rejected with a reason, and the previous trajectory continues."""
    plant = robot()
    follow(plant, (0.0, 0.101, None))
    with pytest.raises(ParameterError, match=complaint):
        follow(plant, *points)
    assert run(plant, 1.0)[-1].depth == pytest.approx(0.101, abs=1e-7)


def test_trajectories_are_rejected_in_mode_simulation() -> None:
    parameters = PRESETS['phantom']
    needle = Integrator(parameters, NeedleModel(parameters).state_at(DEPTH, 0.0))
    plant = Plant(needle, ForceSensor(PERFECT, RATE, 0), RATE)
    with pytest.raises(ParameterError, match='in the modes robot and indenter only'):
        follow(plant, (1.0, 0.1, None))


def test_tare_requires_rest() -> None:
    """Rejected during motion and until a tenth of a second after."""
    plant = robot()
    follow(plant, (0.2, None, 0.5), (1.2, 0.11, None))
    run(plant, 0.7)
    with pytest.raises(JobError, match=r'^the needle moves at 10 mm/s; it must rest$'):
        plant.tare()
    samples = run(plant, 1.5)
    assert samples[-1].velocity == 0.0
    rested = sum(1 for sample in samples if abs(sample.velocity) <= 1e-6)
    assert rested >= 50
    plant.tare()
    # At rest with the least force: only the tare value remains.
    assert abs(plant.advance().wrench[1]) < 1e-9
    with pytest.raises(JobError, match='1 of 50 readings at rest so far'):
        plant.tare()


def test_push_below_the_speed_limit_equals_an_advance() -> None:
    """The result equals the free needle under the force, bit for bit."""
    parameters = PRESETS['phantom']
    state = NeedleModel(parameters).state_at(0.05, 1e-3)
    one, other = Integrator(parameters, state), Integrator(parameters, state)
    for force in (0.2, 1.5, 3.0):
        assert one.advance_pushed(0.01, force, 0.05) == other.advance(0.01, force)
        assert np.array_equal(one.state, other.state)
        assert one.time == other.time


@pytest.mark.parametrize('law', ['coulomb', 'stribeck', 'tanh'])
def test_change_of_constants_keeps_the_state(law: str) -> None:
    """The state is equal bit for bit; the motion continues with the new constants."""
    parameters = NeedleParameters.preset('phantom', friction_law=law)
    changed = replace(parameters, coulomb_friction=0.8, viscous_friction=200.0)
    one = Integrator(parameters, NeedleModel(parameters).state_at(0.05, 1e-3))
    one.advance(0.05, 3.0)
    before = one.state
    one.change(changed)
    assert np.array_equal(one.state, before)
    other = Integrator(changed, before)
    assert one.advance(0.05, 3.0) == other.advance(0.05, 3.0)
    assert np.array_equal(one.state, other.state)
    if law != 'tanh':
        assert one.velocity == pytest.approx((3.0 - 0.8) / 200.0, rel=1e-3)


def test_incompatible_constants_are_rejected() -> None:
    """Another number of modes or a shorter needle is an error, and the old constants are kept."""
    parameters = PRESETS['phantom']
    state = NeedleModel(parameters).state_at(0.05, 1e-3)
    one, other = Integrator(parameters, state), Integrator(parameters, state)
    with pytest.raises(ShapeError):
        one.change(replace(parameters, modes=1))
    with pytest.raises(InsertionDepthError):
        one.change(replace(parameters, length=0.1))
    assert one.model.parameters == parameters
    assert one.advance(0.05, 3.0) == other.advance(0.05, 3.0)


@given(
    end=st.floats(0.02, 0.18),
    part=st.floats(0.0, 0.99),
    acceleration=st.floats(0.05, 0.5),
    rate=st.sampled_from([100.0, 200.0, 1000.0]),
)
def test_base_that_joins_late_does_not_overshoot(
    end: float, part: float, acceleration: float, rate: float
) -> None:
    """A minimum-jerk motion within its limits that is joined after a part of its duration."""
    settings = ExecutiveSettings(speed=0.05, guide_speed=0.05, acceleration=0.8 * acceleration)
    duration = duration_of(np.array([end - DEPTH, 0.0, 0.0]), settings)
    motion = smooth((INSERTION,), np.array([DEPTH]), np.array([end]), max(duration, 1e-3))
    path = JointPath([INSERTION], motion.times.tolist(), motion.positions.tolist())
    rest = path.after(part * duration)
    base = BaseMotion(BaseParameters(acceleration_limit=acceleration), DEPTH, (0.0, 0.2))
    base.follow(0.0, DEPTH, rest.times, [depth for (depth,) in rest.positions])
    depth, velocity, beyond = DEPTH, 0.0, 0.0
    for k in range(round((duration + 4.0) * rate)):
        after = base.velocity(k / rate, depth, velocity, 1.0 / rate)
        depth, velocity = depth + 0.5 * (velocity + after) / rate, after
        beyond = max(beyond, (depth - end) * np.sign(end - DEPTH))
    # A base in time has an error of an interval at its speed; a base is late above 0.1 mm.
    assert beyond <= 0.5 * 0.05 / rate + 1e-4
    # The last of the error decays with `position_gain`, in much less than the 4 s after the end.
    assert depth == pytest.approx(end, abs=1e-6)


def test_same_seed_gives_the_same_samples() -> None:
    """The samples depend only on the seed and the inputs."""

    def seen(seed: int) -> FloatArray:
        parameters = PRESETS['phantom']
        needle = Integrator(parameters, NeedleModel(parameters).state_at(DEPTH, 1e-4))
        base = BaseMotion(BaseParameters(), DEPTH, (0.001, 0.2))
        plant = Plant(needle, ForceSensor(ForceSensorParameters(), RATE, seed), RATE, base)
        follow(plant, (0.2, None, 1.0), (0.4, 0.1, None))
        return column(run(plant, 0.5), 'wrench')

    assert np.array_equal(seen(1), seen(1))
    assert not np.array_equal(seen(1), seen(2))


def test_force_and_velocity_of_a_moved_base_refer_to_one_instant() -> None:
    """(15) holds for each sample during acceleration and braking."""
    plant = robot(acceleration_limit=0.1)
    parameters = plant.integrator.model.parameters
    follow(plant, (0.1, 0.1, None), (0.5, 0.112, None), (0.9, 0.1, None))
    samples = run(plant, 1.0)
    speed = column(samples, 'velocity')
    moving = np.flatnonzero(speed[1:] * speed[:-1] > 0.0) + 1
    inertia = parameters.moving_mass * np.diff(speed, prepend=0.0) * RATE
    friction = np.array([parameters.friction.force(v, 0.0) for v in speed])
    assert len(moving) > 300
    # The needle is straight: rounding of forces of 10 N.
    assert_allclose(
        column(samples, 'force')[moving], (friction + inertia)[moving], rtol=0.0, atol=1e-11
    )


def test_sensor_resolves_vibration_within_a_sample() -> None:
    """Under a commanded wrench each internal sample is the true mean over it (SciPy cascade)."""
    parameters = PRESETS['paper_mm']
    # Modes of 0.36 and 3.4 kHz.
    state = NeedleModel(parameters).state_at(0.05, 5e-4)
    inputs = 3.0, 1e-6
    sensor = ForceSensor(replace(PERFECT, filter=2), 1000.0, 0)
    plant = Plant(Integrator(parameters, state, 2e-5), sensor, 1000.0)
    samples = [plant.advance(*inputs) for _ in range(40)]
    needle = Integrator(parameters, state, 2e-5)
    parts = [needle.advance(1.25e-4, *inputs) for _ in range(320)]
    true = np.array([[part.axial_force, part.lateral_force, part.moment] for part in parts])
    cascade = np.concatenate([butter(2, cut, fs=8000.0, output='sos') for cut in (500.0, 125.0)])
    start = sosfilt_zi(cascade)[:, :, np.newaxis] * true[0]
    felt, _ = sosfilt(cascade, true, axis=0, zi=start)
    wrench = column(samples, 'wrench')
    # Conversion of rates to momenta and back in each part.
    assert_allclose(wrench[:, 1:4], felt[7::8], rtol=0.0, atol=1e-8 * np.abs(true).max())
    assert np.all(wrench[:, [0, 4, 5]] == 0.0)
    # The vibration within a sample matters: means over samples are not sufficient.
    means = true.reshape(40, 8, 3).mean(axis=1)
    assert np.abs(true[:, 1] - np.repeat(means[:, 1], 8)).max() > 0.1 * np.abs(true[:, 1]).max()


def watched(rate: float = 0.0, noise: float = 0.0, delay: float = 0.0) -> list[TipReading | None]:
    """Return the readings of a tip sensor for 40 samples at 100 Hz that increase from 1."""
    sensor = TipSensor(TipParameters(rate=rate, noise=noise, delay=delay), 100.0, 1)
    return [sensor.measure(0.1 * k, float(k)) for k in range(1, 41)]


def test_tip_sensor_has_its_own_rate_and_delay() -> None:
    """Each reading is the mean over its exposure and is published after the delay."""
    assert [r.deflection for r in watched() if r] == list(range(1, 41))
    readings = watched(rate=10.0, delay=0.03)
    assert [k for k, r in enumerate(readings, 1) if r] == [13, 23, 33]
    seen = [r for r in readings if r]
    assert [r.deflection for r in seen] == [5.5, 15.5, 25.5]
    assert [r.age for r in seen] == [3, 3, 3]
    assert_allclose([r.depth for r in seen], [1.0, 2.0, 3.0], rtol=1e-12)


def test_tip_noise_has_the_given_deviation_and_seed() -> None:
    """The same seed gives the same noise."""
    noisy, again = watched(noise=0.5), watched(noise=0.5)
    assert noisy == again
    errors = [r.deflection - k for k, r in enumerate(noisy, 1) if r]
    # 40 samples: the standard deviation has an error of 11 %, taken three times.
    assert 0.33 < np.std(errors) < 0.67


def test_tip_rate_need_not_divide_the_plant_rate() -> None:
    """Each exposure ends at the nearest sample of the plant; no sample is omitted or repeated."""
    seen = [k for k, reading in enumerate(watched(rate=30.0), 1) if reading]
    # 100 Hz: every 10/3 samples.
    assert seen[:6] == [3, 7, 10, 13, 17, 20]
    with pytest.raises(
        ParameterError, match=r'tip\.rate must be at most the rate of the plant 100 Hz'
    ):
        watched(rate=150.0)


def test_plant_can_start_from_modal_coordinates() -> None:
    """An additional deflection, or values that are not numbers, are rejected."""
    plant = PlantConstants.of({'modal': [1e-5, 2e-6]}).make()
    assert isinstance(plant, Plant)
    assert plant.integrator.state[2:4].tolist() == [1e-5, 2e-6]
    with pytest.raises(ParameterError, match='modal and tip_deflection both define'):
        PlantConstants.of({'modal': [1e-5, 2e-6], 'tip_deflection': 1e-3}).make()
    with pytest.raises(ParameterError, match='modal must be a number'):
        PlantConstants.of({'modal': ['one', 'two']})
