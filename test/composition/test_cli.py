"""The command line: what it prints, writes, and how it ends."""

from hashlib import sha256
import json
from pathlib import Path

from needle_dynamics.plant_node import PlantNode
from needle_insertion.cli import main, SHIPPED_BAGS
import pytest
from rclpy.context import Context
import yaml

BAGS = [str(path) for path in sorted(SHIPPED_BAGS.glob('friction_*'))]


def test_shipped_bags_give_the_friction_they_were_made_with(capsys):
    """Over the shipped recordings mu_s and mu_v are within two standard errors of the truth."""
    assert main(['identify', 'friction', *BAGS, '--json']) == 0
    result = json.loads(capsys.readouterr().out)
    assert len(result['bags']) == len(BAGS) >= 4
    for name, truth in (('coulomb_friction', 0.56), ('viscous_friction', 300.0)):
        found = result[name]
        assert abs(found['mean'] - truth) <= 2.0 * found['error']
        # A tight number: a percent of the truth.
        assert found['error'] < 0.01 * truth


def test_the_table_names_each_bag(capsys):
    """One line per bag, the scatter over bags, and the mean."""
    assert main(['identify', 'friction', *BAGS]) == 0
    text = capsys.readouterr().out
    assert all(bag in text for bag in BAGS)
    assert 'STD over bags' in text
    assert 'mean ± its SE' in text


def test_the_result_runs_the_plant(tmp_path):
    """The plant takes the file with --params-file and holds the identified values."""
    file = tmp_path / 'friction.yaml'
    assert main(['identify', 'friction', *BAGS, '-o', str(file)]) == 0
    given = yaml.safe_load(file.read_text())['/**/plant']['ros__parameters']
    context = Context()
    context.init(args=[])
    plant = PlantNode(context=context, cli_args=['--ros-args', '--params-file', str(file)])
    try:
        assert plant.trigger_configure()
        assert plant.failure is None
        assert plant.model_parameters().viscous_friction == given['model.viscous_friction']
        assert plant.model_parameters().coulomb_friction == given['model.coulomb_friction']
    finally:
        plant.destroy_node()
        context.try_shutdown()


@pytest.mark.parametrize(
    ('content', 'complaint'),
    [(None, 'does not exist'), (b'not a bag at all', 'mcap'), (b'', 'mcap')],
    ids=['missing', 'corrupt', 'empty'],
)
def test_bad_bags_end_in_one_line(tmp_path, capsys, content, complaint):
    """A bag that cannot be read is named in one line, exit status 2, and nothing is written."""
    bag, file = tmp_path / 'bag.mcap', tmp_path / 'friction.yaml'
    if content is not None:
        bag.write_bytes(content)
    assert main(['identify', 'friction', str(bag), '-o', str(file)]) == 2
    captured = capsys.readouterr()
    assert captured.out == ''
    assert captured.err.count('\n') == 1
    assert str(bag) in captured.err
    assert complaint in captured.err
    assert not file.exists()


def test_a_topic_that_is_not_there_is_answered_with_those_that_are(capsys):
    """The message lists the topics of the bag."""
    assert main(['identify', 'friction', BAGS[0], '--wrench-topic', '/force']) == 2
    error = capsys.readouterr().err
    assert '/force' in error
    assert '/base_wrench' in error


@pytest.mark.parametrize(
    'words', [[], ['identify'], ['identify', 'mass', 'x'], ['bench', 'luck'], ['demo', '--fast']]
)
def test_bad_usage_ends_with_2(words, capsys):
    """Unknown commands and options are refused with the usage."""
    with pytest.raises(SystemExit) as refused:
        main(words)
    assert refused.value.code == 2
    assert 'usage: needle' in capsys.readouterr().err


@pytest.mark.parametrize('value', ['-1', 'nan', '1e9'])
def test_settings_are_checked(value, capsys):
    """A cutoff that is no frequency below half the sample rate is refused by name."""
    assert main(['identify', 'friction', BAGS[0], '--cutoff', value]) == 2
    assert 'cutoff must be' in capsys.readouterr().err


def test_the_checksums_of_the_shipped_bags_hold():
    """Each file of the shipped recordings is the one that SHA256SUMS names."""
    listed = dict(
        reversed(line.split()) for line in (SHIPPED_BAGS / 'SHA256SUMS').read_text().splitlines()
    )
    files = [path for path in SHIPPED_BAGS.glob('friction_*/*') if path.is_file()]
    assert {str(path.relative_to(SHIPPED_BAGS)) for path in files} == set(listed)
    for path in files:
        name = str(Path(path).relative_to(SHIPPED_BAGS))
        assert sha256(path.read_bytes()).hexdigest() == listed[name]
