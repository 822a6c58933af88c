"""The result is a parameter file, whole or not there."""

from identification.samples import simulated
from needle_identification import (
    IdentificationError,
    identify_friction,
    result_yaml,
    Statistic,
    summarize,
    write_result,
)
from needle_identification.friction import FrictionSummary
import pytest
import yaml


@pytest.fixture(scope='module')
def summary():
    return summarize([identify_friction(simulated())])


def test_holds_the_friction_for_plant_and_controller(summary):
    document = yaml.safe_load(result_yaml(summary))
    assert sorted(document) == ['/**/controller', '/**/plant']
    for section in document.values():
        assert section == {
            'ros__parameters': {
                'model.coulomb_friction': round(summary.coulomb.mean, 6),
                'model.viscous_friction': round(summary.viscous.mean, 6),
            }
        }
    assert '# from simulated 0' in result_yaml(summary)


def test_a_mean_below_zero_is_zero_within_its_error():
    zero = Statistic(mean=-0.001, deviation=0.002, error=0.001, interval=(-0.003, 0.001))
    document = yaml.safe_load(
        result_yaml(FrictionSummary(coulomb=zero, viscous=zero, estimates=()))
    )
    assert document['/**/plant']['ros__parameters']['model.viscous_friction'] == 0.0


def test_replaces_the_file_at_once(tmp_path, summary):
    path = tmp_path / 'result.yaml'
    path.write_text('old')
    write_result(path, summary)
    assert path.read_text() == result_yaml(summary)
    assert list(tmp_path.iterdir()) == [path]


def test_names_the_file_that_cannot_be_written(tmp_path, summary):
    with pytest.raises(IdentificationError, match=r'cannot write .*/no/result.yaml: No such file'):
        write_result(tmp_path / 'no' / 'result.yaml', summary)
