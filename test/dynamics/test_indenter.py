# SPDX-License-Identifier: Apache-2.0
"""Indenter: end-effector that presses the tissue, section 3.2.2.3."""

from __future__ import annotations

from typing import Any

from hypothesis import given
from hypothesis import strategies as st
from needle_dynamics import FloatArray, ParameterError
from needle_dynamics.simulated.force_sensor import ForceSensor, ForceSensorParameters
from needle_dynamics.simulated.indenter import Indenter, IndenterParameters
from needle_ros.errors import JobError
import numpy as np
from numpy.testing import assert_allclose
import pytest
from scipy.stats import chi2

RATE = 250.0
PERFECT = ForceSensorParameters(
    force_noise=0.0, torque_noise=0.0, force_resolution=0.0, torque_resolution=0.0, filter=0
)
EXACT = {'position_noise': 0.0, 'encoder_resolution': 0.0}
JOINTS = ['x', 'z']

forces = st.floats(-3.0, 3.0)


def indenter(
    seed: int = 0, sensor: ForceSensorParameters = PERFECT, limit: float = 1e3, **changes: Any
) -> Indenter:
    """Return an indenter that is ideal except for the changes."""
    parameters = IndenterParameters(**(EXACT | changes))
    return Indenter(parameters, ForceSensor(sensor, RATE, seed), RATE, seed, limit)


def press(of: Indenter, *points: tuple[float, float, float]) -> None:
    """Command points: time, force along x and z."""
    of.follow(JOINTS, [p[0] for p in points], [[]] * len(points), [p[1:] for p in points])


def run(of: Indenter, duration: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return positions, true forces and readings."""
    samples = [of.advance() for _ in range(round(duration * RATE))]
    return tuple(  # type: ignore[return-value]
        np.array([getattr(s, name) for s in samples]) for name in ('position', 'force', 'wrench')
    )


def stiffness(force: FloatArray) -> FloatArray:
    """Return K(|F|) of the defaults, Table 2."""
    table = {
        1.1: [[1.26, 0.04], [-0.10, 1.01]],
        1.2: [[0.82, 0.04], [-0.10, 0.81]],
        1.3: [[1.10, 0.01], [-0.11, 0.69]],
        1.4: [[1.03, 0.001], [-0.11, 0.60]],
        1.5: [[0.96, -0.005], [-0.11, 0.52]],
    }
    levels = np.array(list(table))
    rows = np.array(list(table.values())).reshape(-1, 4).T
    size = np.hypot(*force)
    return 1e3 * np.array([np.interp(size, levels, row) for row in rows]).reshape(2, 2)


@given(forces, forces)
def test_displacement_matches_the_stiffness_table(x: float, z: float) -> None:
    """F = K(|F|) d with K linear between the levels of Table 2 and constant outside."""
    force = np.array([x, z])
    moved = indenter().displacement(force)
    # Rounding of a two by two solution, condition number below 3.
    assert_allclose(stiffness(force) @ moved[[0, 2]], force, rtol=0.0, atol=1e-12)


@given(forces, forces, st.floats(-1e-3, 1e-3))
def test_out_of_plane_motion_is_proportional_to_the_force(
    x: float, z: float, slope: float
) -> None:
    """Y is the slope times |F|, for any direction."""
    # Squares of numbers below 1e-150 vanish.
    moved = indenter(off_plane=slope).displacement(np.array([x, z]))
    assert_allclose(moved[1], slope * np.sqrt(x * x + z * z), rtol=1e-12, atol=1e-150)


def test_force_trajectory_is_piecewise_linear_and_measured() -> None:
    """From the present force to each point, then held; only the components x and z."""
    of = indenter()
    press(of, (0.5, 1.0, -0.5), (1.0, 0.0, 0.5))
    position, force, wrench = run(of, 1.5)
    time = np.arange(1, len(force) + 1) / RATE
    expected = np.array(
        [np.interp(time, [0.0, 0.5, 1.0], line) for line in ([0.0, 1.0, 0.0], [0.0, -0.5, 0.5])]
    ).T
    assert_allclose(force, expected, atol=1e-12)
    assert np.array_equal(wrench[:, [0, 2]], force)
    assert not wrench[:, [1, 3, 4, 5]].any()
    assert_allclose(position, [of.displacement(f) for f in force], rtol=0.0, atol=0.0)
    press(of, (0.2, 0.4, 0.5))
    assert_allclose(run(of, 0.2)[1][:, 0], 2.0 * time[:50], atol=1e-12)


def test_force_rate_is_limited() -> None:
    """A step command gives a ramp of the force magnitude at the highest rate."""
    of = indenter(force_rate=2.0)
    press(of, (0.0, 0.9, 1.2))
    _, force, _ = run(of, 1.0)
    before = np.vstack([np.zeros(2), force[:-1]])
    rate = np.hypot(*(force - before).T) * RATE
    assert_allclose(rate[: int(0.75 * RATE)], 2.0, rtol=1e-9)
    assert rate.max() <= 2.0 * (1.0 + 1e-9)
    assert np.array_equal(force[-1], [0.9, 1.2])


def test_position_noise_has_the_given_deviation() -> None:
    """White noise with equal deviation on all three axes, determined by the seed."""
    count = 5000
    seen = run(indenter(seed=4, position_noise=2e-5), count / RATE)[0] / 2e-5
    # Chi-square bounds with probability 1e-6; the seed is fixed.
    low, high = chi2.ppf([5e-7, 1.0 - 5e-7], count) / count
    assert np.all((low < np.mean(seen**2, axis=0)) & (np.mean(seen**2, axis=0) < high))
    # Five standard errors.
    bound = 5.0 / np.sqrt(count)
    assert np.abs(seen.mean(axis=0)).max() < bound
    assert np.abs(np.mean(seen[1:] * seen[:-1], axis=0)).max() < bound
    again = run(indenter(seed=4, position_noise=2e-5), count / RATE)[0] / 2e-5
    assert np.array_equal(seen, again)
    noise = ForceSensorParameters(force_noise=1.0, force_resolution=0.0, filter=0)
    position, _, wrench = run(indenter(4, noise, position_noise=1.0), 20.0)
    assert np.abs(np.mean(position * wrench[:, :3], axis=0)).max() < bound * 1.2


def test_positions_are_whole_counts() -> None:
    """Noise is rounded too, with an error of at most half a count."""
    of = indenter(seed=1, position_noise=3e-5, encoder_resolution=1e-5)
    counts = run(of, 4.0)[0] / 1e-5
    # Rounding of the quotient of a few counts.
    assert np.abs(counts - np.round(counts)).max() < 1e-9
    assert len(np.unique(np.round(counts))) > 10


def test_single_stiffness_level_is_linear() -> None:
    one: Any = dict.fromkeys(('stiffness_xx', 'stiffness_zz'), (1000.0,))
    none: Any = dict.fromkeys(('stiffness_xz', 'stiffness_zx'), (0.0,))
    of = indenter(force_levels=(1.0,), **one, **none)
    assert_allclose(of.displacement(np.array([3.0, -0.1]))[[0, 2]], [3e-3, -1e-4], rtol=1e-12)


def test_tare_requires_a_constant_force() -> None:
    """Rejected while the force changes, and until a tenth of a second after."""
    of = indenter(sensor=ForceSensorParameters(force_bias=2.0))
    press(of, (0.2, 0.0, 1.0))
    run(of, 0.1)
    with pytest.raises(JobError, match=r'^the end-effector moves; it must rest$'):
        of.tare()
    run(of, 0.1)
    of.advance()
    with pytest.raises(JobError, match=r'^1 of 25 readings at rest so far$'):
        of.tare()
    run(of, 0.2)
    of.tare()
    # Five sigma of two means of 25 readings; the acting force of 1 N is zeroed too.
    assert np.abs(run(of, 0.1)[2][:, :3].mean(axis=0)).max() < 5 * 0.01 * np.sqrt(2 / 25)


@pytest.mark.parametrize(
    ('message', 'complaint'),
    [
        ((['x'], [1.0], [[]], [[1.0]]), r"needs the joint 'z', got \['x'\]"),
        ((JOINTS, [], [], []), 'trajectory has no points'),
        ((JOINTS, [1.0, 0.5], [[], []], [[0, 0], [0, 0]]), 'times must be >= 0 and increasing'),
        ((JOINTS, [1.0], [[0.0, 0.0]], [[0, 0]]), 'the indenter takes efforts, not positions'),
        ((JOINTS, [1.0], [[]], [[1.0]]), 'each point needs efforts of x and z within 5 N, got'),
        ((JOINTS, [1.0], [[]], [[1.0, 5.1]]), 'within 5 N'),
        ((JOINTS, [1.0], [[]], [[np.nan, 1.0]]), 'within 5 N'),
    ],
)
def test_invalid_trajectories_have_no_effect(message: Any, complaint: str) -> None:
    """The trajectory is rejected with a reason, and the previous trajectory continues."""
    of = indenter(limit=5.0)
    press(of, (0.5, 1.0, 0.0))
    with pytest.raises(ParameterError, match=complaint):
        of.follow(*message)
    assert np.array_equal(run(of, 0.6)[1][-1], [1.0, 0.0])


@pytest.mark.parametrize(
    ('changes', 'complaint'),
    [
        ({'stiffness_xx': (1.0,)}, 'stiffness_xx must be a list with one value for each of the'),
        ({'stiffness_zz': 500.0}, 'stiffness_zz must be a list'),
        ({'force_levels': (1.5, 1.4, 1.3, 1.2, 1.1)}, 'force_levels must increase'),
        ({'stiffness_xz': (3e3,) * 5}, 'must resist a press in every direction, got'),
        ({'stiffness_zz': (0.0,) * 5}, 'must resist a press in every direction, got'),
        ({'stiffness_zz': (np.nan,) * 5}, 'stiffness_zz must be finite'),
        ({'force_rate': 0.0}, 'force_rate must be finite, > 0 N/s'),
        ({'position_noise': -1.0}, 'position_noise must be finite, >= 0 m'),
    ],
)
def test_invalid_tissue_parameters_are_rejected(changes: dict[str, Any], complaint: str) -> None:
    """The message contains the name of the field."""
    with pytest.raises(ParameterError, match=complaint):
        IndenterParameters(**changes)
