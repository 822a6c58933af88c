# SPDX-License-Identifier: Apache-2.0
"""Probability of a planned insertion: laws of its parts, and of its statistics."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st
from needle_dynamics import FloatArray
from needle_planning import Anatomy, find_plan, Plan, Structure
from needle_planning.chance import _tolerance, chance_of, POPULATION, read_population
from needle_planning.plan_scenario import write_inputs
from needle_ros.errors import ParameterError
from needle_study.study import build_study
from needle_study.summary import probability
import numpy as np
import pytest
from scipy.optimize import isotonic_regression

#: The law stops a needle whose measurements are identical, without noise.
NO_ERRORS = {'path_noise': 0.0, 'tip_noise': 1e-9}
AXES = 'xyz'


def walls(gap: tuple[int, int], margin: float = 1e-3) -> Anatomy:
    """Return two walls, each with an end at a voxel of 1 mm, and a small entry region above."""
    labels = np.zeros((60, 60, 80), np.int16)
    labels[28:32, 28:32, 78] = 1
    labels[10 : gap[0], :, 40] = 2
    labels[gap[1] : 60, :, 60] = 2
    structures = {
        1: Structure(name='skin', role='entry'),
        2: Structure(name='bone', role='obstacle', margin=margin),
    }
    return Anatomy(
        labels=labels, to_patient=np.diag([1e-3, 1e-3, 1e-3, 1.0]), structures=structures
    )


WIDE, NARROW = walls((25, 35)), walls((29, 35), 5e-4)


@pytest.fixture(scope='module')
def straight() -> Plan:
    return find_plan(WIDE, (0.030, 0.030, 0.005), bow=False)


@pytest.fixture(scope='module')
def bowed() -> Plan:
    plan = find_plan(NARROW, (0.028, 0.030, 0.005))
    assert plan.bow > 1e-3
    return plan


def inserted(
    folder: Path,
    plan: Plan,
    anatomy: Anatomy,
    population: Mapping[str, Any],
    samples: int = 1,
    **more: Any,
) -> dict[str, FloatArray]:
    """Insert needles in this process."""
    write_inputs(folder, plan, [anatomy])
    document = {
        'scenario': 'needle_planning.plan_scenario:PlanScenario',
        'samples': samples,
        'seed': 2,
        'settings': {'folder': str(folder), 'radius': 1e-3, **more},
        'population': population,
    }
    return build_study(document).rows(0, samples)


@pytest.mark.parametrize(('name', 'anatomy'), [('straight', WIDE), ('bowed', NARROW)])
def test_insertion_without_uncertainty_is_the_plan(
    tmp_path: Path, request: pytest.FixtureRequest, name: str, anatomy: Anatomy
) -> None:
    plan: Plan = request.getfixturevalue(name)
    (clearance,), (miss,) = (
        inserted(tmp_path, plan, anatomy, NO_ERRORS)[one] for one in ('clearance', 'miss')
    )
    # Both are lower bounds, at most 50 um below the true clearance.
    assert clearance == pytest.approx(plan.clearance, abs=1e-4)
    # The simulated guide is good to a nanometer, the expected end of the plan to the same.
    assert miss == pytest.approx(np.linalg.norm(plan.path[-1] - plan.target), abs=1e-6)


def test_probability_without_uncertainty_is_one(straight: Plan) -> None:
    found = chance_of(straight, WIDE, insertions=16, population=NO_ERRORS, workers=1)
    assert (found.hit.value, found.clear.value, found.success.value) == (1.0, 1.0, 1.0)
    assert found.causes == ()


@pytest.mark.parametrize('axis', AXES)
def test_displaced_patient_and_moved_target_are_missed_by_as_much(
    tmp_path: Path, straight: Plan, axis: str
) -> None:
    """No sensor measures them: the tip is where the image had the target."""
    for name in ('registration', 'target'):
        (miss,) = inserted(tmp_path, straight, WIDE, NO_ERRORS | {f'{name}_{axis}': 2e-3})['miss']
        # The simulated guide is good to a nanometer.
        assert miss == pytest.approx(2e-3, abs=1e-6)


@pytest.mark.parametrize(('axis', 'arm'), [('x', 1.0), ('y', 0.0), ('z', 1.0)])
def test_rotated_patient_is_missed_by_the_chord(
    tmp_path: Path, straight: Plan, axis: str, arm: float
) -> None:
    """The rotation is about the entry point; about the needle it does not move the target."""
    (miss,) = inserted(tmp_path, straight, WIDE, NO_ERRORS | {f'rotation_{axis}': 0.02})['miss']
    # The simulated guide is good to a nanometer.
    assert miss == pytest.approx(2.0 * arm * straight.length * np.sin(0.01), abs=1e-6)


def test_patient_displaced_toward_the_wall_is_nearer_to_it(tmp_path: Path, straight: Plan) -> None:
    """The clearance is that of the plan in the anatomy displaced by the same vector."""
    shift = np.array([0.5e-3, -0.3e-3, 0.4e-3])
    errors = dict(zip(('registration_x', 'registration_y', 'registration_z'), shift, strict=True))
    (clearance,) = inserted(tmp_path, straight, WIDE, NO_ERRORS | errors)['clearance']
    matrix = WIDE.to_patient.copy()
    matrix[:3, 3] += shift @ straight.axes
    moved = inserted(tmp_path, straight, replace(WIDE, to_patient=matrix), NO_ERRORS)['clearance']
    # Two lower bounds.
    assert clearance == pytest.approx(moved[0], abs=5e-5)


@pytest.mark.parametrize('error', [{'entry_x': 1e-3}, {'frame_z': 0.02}, {'tilt_x': 0.02}])
def test_law_corrects_errors_that_the_sensor_measures(
    tmp_path: Path, straight: Plan, error: dict[str, float]
) -> None:
    """The tip ends nearer to the target than without a law."""
    misses = [
        inserted(tmp_path, straight, WIDE, NO_ERRORS | error, law=law)['miss'][0]
        for law in ('multi_hypothesis', 'open_loop')
    ]
    assert misses[0] < 0.5 * misses[1]


def test_result_does_not_depend_on_the_number_of_workers(straight: Plan) -> None:
    one, two = (
        chance_of(straight, WIDE, insertions=48, seed=3, workers=workers) for workers in (1, 2)
    )
    assert one.document() == two.document()
    for name, values in one.values.items():
        np.testing.assert_array_equal(values, two.values[name])


def test_kept_needles_are_those_of_the_first_insertions(straight: Plan) -> None:
    """From the skin to the tip that was counted."""
    found = chance_of(straight, WIDE, insertions=6, seed=3, workers=1, shafts=4)
    tips = np.stack([found.values[f'tip_{axis}'][:4] for axis in 'ras'], axis=1)
    np.testing.assert_array_equal(found.shafts[:, -1], tips)
    lengths = np.linalg.norm(np.diff(found.shafts, axis=1), axis=2).sum(axis=1)
    # Slopes are small: the path is longer than the depth by less than 1 %.
    np.testing.assert_allclose(lengths, straight.length, rtol=0.01)
    assert chance_of(straight, WIDE, insertions=2, workers=1).shafts.shape == (0, 0, 3)
    with pytest.raises(ParameterError, match='shafts must be'):
        chance_of(straight, WIDE, insertions=2, workers=1, shafts=3)


def test_probability_holds_with_other_random_numbers(tmp_path: Path, straight: Plan) -> None:
    """The interval of 200 insertions contains the fraction of 500 others."""
    stated = chance_of(straight, WIDE, insertions=200, seed=1)
    others = inserted(tmp_path, straight, WIDE, POPULATION, 500)
    for name in ('hit', 'clear', 'success'):
        low, high = getattr(stated, name)[1:3]
        assert low <= others[name].mean() <= high
    assert stated.success.value < 1.0


@pytest.mark.parametrize(
    ('population', 'cause'),
    [
        ({'registration_x': {'normal': [0.0, 1e-3]}, 'entry_z': {'normal': [0.0, 1e-5]}},
         'registration'),
        ({'slow_noise': 1.5e-3, 'entry_z': {'normal': [0.0, 1e-5]}}, 'noise of path and sensor'),
    ],
)  # fmt: skip
def test_only_cause_of_failure_explains_all(
    straight: Plan, population: dict[str, Any], cause: str
) -> None:
    found = chance_of(straight, WIDE, insertions=104, population=NO_ERRORS | population)
    (name, index), (_, other) = found.causes
    assert name == cause
    # The other variable does not cause a failure: equal samples have equal results.
    assert index.value == pytest.approx(1.0, abs=0.1)
    assert other.low == 0.0


@settings(deadline=None)
@given(st.integers(1, 20_000), st.floats(0.0, 1.0))
def test_interval_of_independent_samples_is_that_of_wilson(count: int, part: float) -> None:
    """Also where the number of samples times their fraction is rounded."""
    ones = round(part * count)
    found = probability([np.append(np.ones(ones), np.zeros(count - ones))])
    z, p = 1.96, ones / count
    for end in (found.low, found.high):
        # The score test of an end has its critical value.
        assert count * (p - end) ** 2 == pytest.approx(z * z * end * (1.0 - end), abs=1e-9)


def test_larger_uncertainty_has_no_larger_probability(tmp_path: Path, straight: Plan) -> None:
    """Of a displaced patient, which is not corrected."""
    found = []
    for size in (0.25e-3, 0.5e-3, 1e-3):
        errors = {f'registration_{axis}': {'normal': [0.0, size]} for axis in AXES}
        found.append(inserted(tmp_path, straight, WIDE, NO_ERRORS | errors, 128)['success'].mean())
    # The samples of the three have the same quantiles: each error grows by the same factor.
    assert found[0] >= found[1] >= found[2]
    assert found[0] > found[2]


def test_wider_obstacles_have_no_larger_clearance(tmp_path: Path, straight: Plan) -> None:
    """In each insertion: the difference of the margins."""
    near, far = (
        inserted(tmp_path, straight, walls((25, 35), margin), POPULATION, 24)['clearance']
        for margin in (1e-3, 1.5e-3)
    )
    # Each is a lower bound, at most 50 um below the true clearance.
    np.testing.assert_allclose(near - far, 5e-4, atol=5e-5)


def test_tolerance_at_the_largest_examined_error_is_a_lower_bound(straight: Plan) -> None:
    found = chance_of(straight, WIDE, insertions=8, population=NO_ERRORS, radius=0.05, workers=1)
    assert found.entry_tolerance[:3] == (6e-3, 6e-3, 6e-3)
    assert found.tolerance_text() == 'at least 6 mm'
    for three, text in (
        ((6e-3, 4.8e-3, 6e-3), 'at least 6 mm (4.8 to at least 6 mm)'),
        ((5e-3, 4.8e-3, 5.12e-3), '5.0 mm (4.8 to 5.1 mm)'),
    ):
        estimate = found.entry_tolerance._replace(value=three[0], low=three[1], high=three[2])
        assert replace(found, entry_tolerance=estimate).tolerance_text() == text


def test_causes_need_100_insertions(straight: Plan) -> None:
    found = chance_of(straight, WIDE, insertions=8, population=NO_ERRORS, workers=1)
    assert found.causes_text() == 'at least 100 insertions are needed'
    assert replace(found, insertions=100).causes_text() == 'none found'


@settings(deadline=None)
@given(st.lists(st.booleans(), min_size=2, max_size=80))
def test_tolerance_is_where_the_isotonic_regression_ends(hits: Sequence[bool]) -> None:
    success = np.array(hits, dtype=np.float64)
    radii = np.linspace(1e-5, 6e-3, len(hits))
    # Rounding: a mean may be 0.95 exactly.
    kept = int(np.sum(isotonic_regression(success, increasing=False).x >= 0.95 - 1e-9))
    expected = 0.0 if kept == 0 else radii[kept - 1]
    assert _tolerance(radii[::-1], success[::-1]) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize(
    ('text', 'reason'),
    [
        ('population: {}', 'must have a variable'),
        ('population: [1]', 'must be names with values'),
        ('populatoin: {entry_x: 0}', 'populatoin'),
        ('- 1', 'must be names with values'),
        ('population: {entry_x: {table: [none.csv, x]}}', 'none.csv cannot be read'),
        ('{population: {entry_x: 0}, correlations: 3}', 'correlations must be a list'),
        ('population: {entry_y: 1mm}', 'entry_y'),
        ('population: {entry_x: {normal: [0]}}', 'normal takes [mean, standard deviation]'),
        ('{population: {entry_x: 0}, correlations: [[entry_x, skin, 2]]}', 'correlations takes'),
        ('a: [', 'is not YAML'),
    ],
)
def test_invalid_population_is_one_line(tmp_path: Path, text: str, reason: str) -> None:
    file = tmp_path / 'population.yaml'
    file.write_text(text, 'utf-8')
    with pytest.raises(ParameterError) as caught:
        read_population(file)
    assert reason in str(caught.value)
    assert str(file) in str(caught.value)
    assert '\n' not in str(caught.value)


@pytest.mark.parametrize(
    ('arguments', 'reason'),
    [
        ({'insertions': 0}, 'insertions must be an integer from 1'),
        ({'workers': 0}, 'workers must be an integer from 1'),
        ({'radius': 0.0}, 'radius must be finite, > 0 m'),
        ({'radius': float('nan')}, 'radius must be finite, > 0 m'),
        ({'population': {'entry_y': 1e-3}}, 'entry_y'),
        ({'population': {'layer_8': 1.1}}, 'layer_8 is not in the plan, which has'),
        ({'population': {'entry_x': {'normal': [0.0]}}}, 'entry_x: normal takes'),
        ({'population': {'skin': {'normal': [0.0, 1.0]}}}, 'truncate it'),
        ({'law': 'magic'}, 'magic'),
        ({'correlations': [3]}, 'correlations takes'),
        ({'correlations': [['entry_x', 'depth', 0.5]]}, 'correlations takes'),
    ],
)
def test_invalid_arguments_are_one_line(
    straight: Plan, arguments: dict[str, Any], reason: str
) -> None:
    with pytest.raises(ParameterError) as caught:
        chance_of(straight, WIDE, **arguments)
    assert reason in str(caught.value)
    assert '\n' not in str(caught.value)


def test_population_file_has_tables_and_correlations(tmp_path: Path) -> None:
    (tmp_path / 'errors.csv').write_text('x\n0.001\n-0.002\n', 'utf-8')
    file = tmp_path / 'population.yaml'
    file.write_text(
        'population:\n  entry_x: {table: [errors.csv, x]}\n  entry_z: {normal: [0, 1mm]}\n'
        'correlations: [[errors.csv, entry_z, 0.5]]\n',
        'utf-8',
    )
    population, correlations = read_population(file)
    assert population['entry_x'] == {'rows': [0.001, -0.002], 'of': 'errors.csv'}
    assert correlations == [['errors.csv', 'entry_z', 0.5]]
