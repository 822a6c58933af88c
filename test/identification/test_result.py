# SPDX-License-Identifier: Apache-2.0
"""The result is a complete parameter file, with numbers rounded to their errors."""

from math import inf, nan
from pathlib import Path

from hypothesis import given, settings
from hypothesis import strategies as st
from needle_dynamics import NeedleParameters, ParameterError
from needle_identification import (
    FrictionSummary,
    IdentificationError,
    Statistic,
    StiffnessSummary,
    write_result,
)
from needle_identification.estimation.estimate import between, measured, rounded, UNKNOWN
from needle_identification.result import limited, model_parameters, result_yaml
from needle_ros.settings import from_values
import pytest
import yaml


def found(name: str, mean: float, error: float = 0.01, unit: str = 'N') -> Statistic:
    """Return a synthetic result."""
    if mean != mean:
        return Statistic(name=name, symbol=name, unit=unit)
    interval = (mean - 2.0 * error, mean + 2.0 * error)
    return Statistic(
        name=name, symbol=name, unit=unit, mean=mean, deviation=None, error=error,
        interval=interval, count=1,
    )  # fmt: skip


def friction(*statistics: Statistic) -> FrictionSummary:
    """Return a synthetic result without recordings."""
    return FrictionSummary(statistics=statistics, estimates=())


STIFFNESS = StiffnessSummary(
    levels=(), tissue_stiffness=found('tissue_stiffness', 520.25, 3.0, 'N/m^2'), estimates=()
)
FRICTION = friction(found('coulomb_friction', 0.5604), found('viscous_friction', 300.014, 0.04))


def test_the_file_has_the_parameters_of_plant_and_controller() -> None:
    """Both sections have the means under the names of the nodes' parameters."""
    document = yaml.safe_load(result_yaml(FRICTION, STIFFNESS))
    expected = {
        'model.coulomb_friction': 0.5604,
        'model.viscous_friction': 300.014,
        'model.tissue_stiffness': 520.25,
    }
    assert document == {
        f'/**/{node}': {'ros__parameters': expected} for node in ('plant', 'controller')
    }


@pytest.mark.parametrize(
    ('given_', 'names'),
    [
        ((FRICTION, None), {'model.coulomb_friction', 'model.viscous_friction'}),
        ((None, STIFFNESS), {'model.tissue_stiffness'}),
    ],
)
def test_the_file_has_only_identified_parameters(
    given_: tuple[None, StiffnessSummary] | tuple[FrictionSummary, None], names: set[str]
) -> None:
    """A friction result does not set the stiffness, and vice versa."""
    assert set(yaml.safe_load(result_yaml(*given_))['/**/plant']['ros__parameters']) == names


def test_undetermined_parameters_are_not_set() -> None:
    """They appear in a comment only."""
    text = result_yaml(friction(found('coulomb_friction', 0.5), found('viscous_friction', nan)))
    assert list(yaml.safe_load(text)['/**/plant']['ros__parameters']) == ['model.coulomb_friction']
    assert f'# viscous_friction (viscous_friction) is {UNKNOWN}\n' in text
    with pytest.raises(IdentificationError, match='determine no parameter'):
        result_yaml(friction(found('viscous_friction', nan)))


def test_a_mean_outside_the_range_is_set_to_the_limit() -> None:
    """The model rejects negative friction, and breakaway friction below Coulomb friction."""
    outside = found('coulomb_friction', -0.001), found('breakaway_friction', 0.99, unit='1')
    values = model_parameters([*outside, found('offset', 0.1)])
    sentences = limited([*outside, found('offset', 0.1), found('viscous_friction', 0.3)])
    assert len(sentences) == len(outside)
    assert 'coulomb_friction = -0.001 ± 0.010 N is outside the range' in sentences[0]
    assert sentences[1].endswith('model.breakaway_friction is 1')
    assert all(f'# {words}\n' in result_yaml(friction(*outside)) for words in sentences)
    assert values == {
        'model.coulomb_friction': 0.0,
        'model.breakaway_friction': 1.0,
        # Only the Stribeck law has breakaway friction.
        'model.friction_law': 'stribeck',
    }
    constants = {name.removeprefix('model.'): value for name, value in values.items()}
    assert from_values(NeedleParameters, constants).friction_law == 'stribeck'


@settings(deadline=None)
@given(st.floats(1e-12, 1e12))
def test_values_are_read_back_from_the_file(value: float) -> None:
    """Values have seven digits and are numbers; YAML would parse 5e-05 as text."""
    text = result_yaml(friction(found('viscous_friction', value)))
    read = yaml.safe_load(text)['/**/plant']['ros__parameters']['model.viscous_friction']
    assert isinstance(read, float)
    # Half a unit of the seventh digit.
    assert abs(read - value) <= 5e-7 * value


def test_the_file_is_replaced_atomically(tmp_path: Path) -> None:
    """The file is complete, without a temporary file."""
    path = tmp_path / 'result.yaml'
    path.write_text('old')
    write_result(path, FRICTION)
    assert path.read_text() == result_yaml(FRICTION)
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    ('name', 'complaint'),
    [
        ('no/result.yaml', r'no/result.yaml cannot be written: No such file'),
        ('.', 'it is not the name of a file'),
        ('', 'it is not the name of a file'),
    ],
)
def test_an_unwritable_file_is_reported(tmp_path: Path, name: str, complaint: str) -> None:
    """A one-line error, without a temporary file."""
    with pytest.raises(ParameterError, match=complaint):
        write_result(tmp_path / name, FRICTION)
    assert not list(tmp_path.iterdir())


@settings(deadline=None)
@given(st.floats(-1e6, 1e6), st.floats(1e-6, 1e6))
def test_a_number_is_rounded_to_two_digits_of_its_error(value: float, error: float) -> None:
    """The rounding error is at most a twentieth of the standard error."""
    told, reach = measured(value, error).split(' ± ')
    # Half of the second digit of the error, which is at least 1.0, and rounding of the sum.
    assert abs(float(told) - value) <= max(0.0501 * error, 0.501 if error >= 10.0 else 0.0)
    assert abs(float(reach) - error) <= max(0.0501 * error, 0.501 if error >= 10.0 else 0.0)
    assert rounded(value, error) == told
    low, high = map(float, between((value - error, value + error)).split(' to '))
    assert low <= value + 0.03 * error + 0.501 * (error >= 10.0)
    assert high >= value - 0.03 * error - 0.501 * (error >= 10.0)


@pytest.mark.parametrize(
    ('value', 'error', 'text'),
    [
        (0.56043, 0.00051, '0.56043 ± 0.00051 N'),
        (300.014, 12.6, '300 ± 13 N'),
        (0.25, 0.0, '0.25 ± 0 N'),
        (0.25, inf, '0.25 N'),
        (nan, inf, UNKNOWN),
    ],
)
def test_a_number_is_written_with_its_unit(value: float, error: float, text: str) -> None:
    """A zero error is written, an infinite error is not, and nan is written in words."""
    assert measured(value, error, 'N') == text


def test_a_pure_number_has_no_unit() -> None:
    """The unit 1 is not written."""
    assert measured(0.1, 0.01, '1') == '0.100 ± 0.010'
    assert between((-inf, inf)) == UNKNOWN
