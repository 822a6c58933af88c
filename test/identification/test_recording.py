"""The value that identification works on is what it claims to be."""

from needle_dynamics import ShapeError
from needle_identification import Recording
import numpy as np
import pytest


def recording(**changes):
    fields = {name: np.array([0.0, 1.0, 2.0]) for name in ('time', 'depth', 'speed', 'force')}
    return Recording(name='it', **{**fields, **changes})


@pytest.mark.parametrize(
    ('changes', 'complaint'),
    [
        ({'force': np.zeros(2)}, r'force must have the shape \(n,\) of time, got \(2,\)'),
        ({'depth': np.zeros((3, 1))}, r'depth must have the shape'),
        ({'speed': np.array([0.0, np.nan, 0.0])}, 'speed must be finite'),
        ({'time': np.array([0.0, 1.0, 1.0])}, 'time must increase strictly'),
    ],
)
def test_refuses_what_is_not_a_recording(changes, complaint):
    with pytest.raises(ShapeError, match=complaint):
        recording(**changes)


def test_holds_a_copy_that_cannot_change():
    force = np.zeros(3)
    made = recording(force=force)
    force[0] = 1.0
    assert made.force[0] == 0.0
    with pytest.raises(ValueError, match='read-only'):
        made.force[0] = 1.0


@pytest.mark.parametrize('text', ['', 'a: [', 'just words', '{"/plant": 3}', '[1, 2]'])
def test_knows_no_truth_without_a_parameter_file(text):
    assert recording(configuration=text).truth is None


def test_reads_the_truth_from_the_configuration_of_the_plant():
    text = '/lab/plant:\n  ros__parameters:\n    model.coulomb_friction: 0.56\n'
    assert recording(configuration=text).truth == {'model.coulomb_friction': 0.56}
