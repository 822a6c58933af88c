"""The command line: what it prints, writes, and how it ends."""

from hashlib import sha256
import json
from pathlib import Path

from needle_dynamics.plant_node import PlantNode
from needle_insertion.cli import main, SHIPPED_BAGS
import pytest
from rclpy.context import Context
from rclpy.lifecycle import TransitionCallbackReturn
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
        assert plant.trigger_configure() == TransitionCallbackReturn.SUCCESS
        assert plant.model_parameters().viscous_friction == given['model.viscous_friction']
        assert plant.model_parameters().coulomb_friction == given['model.coulomb_friction']
    finally:
        plant.destroy_node()
        context.try_shutdown()


@pytest.mark.parametrize(
    ('content', 'complaint'),
    [
        (None, 'does not exist'),
        (b'not a bag at all', 'MCAP'),
        (b'', 'MCAP'),
    ],
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


@pytest.mark.parametrize(
    ('words', 'complaint'),
    [
        (['--repeats', '0'], '--repeats must be >= 1'),
        (['--seed', '-3'], '--seed must be >= 0'),
        (['--rate', 'nan'], '--rate must be in'),
        (['--rate', '-5'], '--rate must be in'),
    ],
)
def test_an_experiment_is_refused_before_anything_is_written(tmp_path, capsys, words, complaint):
    """Bad numbers are named, with exit status 2, and leave no folder behind."""
    assert main(['experiment', 'friction', str(tmp_path / 'out'), *words]) == 2
    assert complaint in capsys.readouterr().err
    assert not (tmp_path / 'out').exists()


def test_an_experiment_does_not_write_over_another(tmp_path, capsys):
    """A run that is already there is named before the first is recorded."""
    (tmp_path / 'friction_2').mkdir()
    assert main(['experiment', 'friction', str(tmp_path), '--repeats', '2']) == 2
    assert 'friction_2 exists' in capsys.readouterr().err
    assert not (tmp_path / 'friction_1').exists()


@pytest.mark.parametrize('output', ['.', '/', ''])
def test_a_result_needs_the_name_of_a_file(output, capsys):
    """A folder as output is refused in one line."""
    assert main(['identify', 'friction', BAGS[0], '-o', output]) == 2
    assert 'it is not the name of a file' in capsys.readouterr().err


def test_a_bag_counts_once(capsys):
    """The same recording twice would feign a smaller error: it is refused."""
    assert main(['identify', 'friction', BAGS[0], BAGS[0] + '/']) == 2
    assert 'is given twice' in capsys.readouterr().err


def test_a_signed_axis_is_taken_as_it_is_written(capsys):
    """``--force-axis -y`` turns the force around, which makes friction negative: refused."""
    assert main(['identify', 'friction', BAGS[0], '--force-axis', '-y']) == 2
    assert 'friction must not be negative' in capsys.readouterr().err


def test_a_place_that_cannot_be_written_ends_in_one_line(capsys):
    """An error of the operating system is told in one line."""
    assert main(['demo', '-o', '/dev/null/demo']) == 2
    assert capsys.readouterr().err.count('\n') == 1
