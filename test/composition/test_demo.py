"""The demo's verdicts: each can fail."""

from needle_identification import FrictionSummary, Recording, Statistic
from needle_insertion.demo import (
    COUNTED,
    DemoError,
    friction_checks,
    Insertion,
    insertion_checks,
    run,
    TARGET_DEPTH,
)
import numpy as np
import pytest


def insertion(end=TARGET_DEPTH, peak=TARGET_DEPTH, lag=0.0, complete=1.0) -> Insertion:
    """Return a made-up insertion."""
    time = np.linspace(0.0, 10.0, 1001)
    aim = np.linspace(0.02, TARGET_DEPTH, 1001)
    depth = aim - lag
    depth[-2:] = peak, end
    return Insertion(
        law='pid',
        depth=np.array([time, depth]),
        aim=np.array([time, aim]),
        tip=np.array([time, time]),
        force=np.array([time, time]),
        completeness=dict.fromkeys(COUNTED, 1.0) | {'base_wrench': complete},
    )


@pytest.mark.parametrize(
    ('changes', 'verdicts'),
    [
        ({}, [True, True, True, True]),
        ({'end': 0.1194}, [False, True, True, True]),
        ({'peak': 0.1212}, [True, False, False, True]),
        ({'lag': 2e-3}, [True, True, False, True]),
        ({'complete': 0.99}, [True, True, True, False]),
        ({'complete': 1.01}, [True, True, True, False]),
    ],
)
def test_an_insertion_is_judged_by_end_overshoot_tracking_and_messages(changes, verdicts):
    """Each check fails for its own reason and for no other."""
    assert [check.passed for check in insertion_checks(insertion(**changes))] == verdicts


def statistic(mean: float, error: float) -> Statistic:
    """Return a made-up result."""
    interval = mean - 2.0 * error, mean + 2.0 * error
    return Statistic(mean=mean, deviation=None, error=error, interval=interval)


def recording(configuration: str) -> Recording:
    """Return a made-up recording."""
    values = np.zeros(2)
    return Recording(
        name='bag',
        time=np.array([0.0, 1.0]),
        depth=values,
        speed=values,
        force=values,
        configuration=configuration,
    )


@pytest.mark.parametrize('found', [0.5599, 0.5571])
def test_friction_is_judged_by_its_standard_errors(found):
    """Two standard errors from the truth of the recorded plant decide."""
    truth = (
        '/plant: {ros__parameters: {model.coulomb_friction: 0.56, model.viscous_friction: 300.0}}'
    )
    summary = FrictionSummary(
        coulomb=statistic(found, 0.001),
        viscous=statistic(300.1, 0.1),
        estimates=(),
    )
    coulomb, viscous = friction_checks('one bag', recording(truth), summary, 2.0)
    assert coulomb.passed == (found == 0.5599)
    assert viscous.passed


def test_a_recording_without_truth_cannot_be_judged():
    """A bag that does not say what its plant was is no base for a verdict."""
    one = statistic(1.0, 0.1)
    summary = FrictionSummary(coulomb=one, viscous=one, estimates=())
    with pytest.raises(DemoError, match='bag does not hold the configuration'):
        friction_checks('one bag', recording(''), summary, 2.0)


def test_the_demo_removes_nothing_that_is_not_its_own(tmp_path):
    """A folder that no demo made is left alone."""
    bags, output = tmp_path / 'bags', tmp_path / 'thesis'
    (bags / 'friction_1').mkdir(parents=True)
    output.mkdir()
    (output / 'chapter').touch()
    with pytest.raises(DemoError, match='is not from a demo'):
        run(output, bags)
    assert (output / 'chapter').exists()
    with pytest.raises(DemoError, match='holds no friction recordings'):
        run(output, output)
