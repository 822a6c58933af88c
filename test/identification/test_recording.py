# SPDX-License-Identifier: Apache-2.0
"""Recordings are validated and immutable."""

from typing import Any

from needle_dynamics import FloatArray, ShapeError
from needle_identification import IndentationRecording, Recording
import numpy as np
import pytest


def recording(**changes: Any) -> Recording:
    names = ('time', 'depth', 'velocity', 'force')
    fields: dict[str, Any] = {name: np.array([0.0, 1.0, 2.0]) for name in names}
    return Recording(name='it', **{**fields, **changes})


@pytest.mark.parametrize(
    ('changes', 'complaint'),
    [
        ({'force': np.zeros(2)}, r'force must have the shape \(n,\) .*, got \(2,\) and \(3,\)'),
        ({'depth': np.zeros((3, 1))}, r'depth must have the shape'),
        ({'velocity': np.array([0.0, np.nan, 0.0])}, 'velocity must be finite'),
        ({'time': np.array([0.0, 1.0, 1.0])}, 'time must increase strictly'),
    ],
)
def test_invalid_arrays_are_rejected(changes: dict[str, FloatArray], complaint: str) -> None:
    with pytest.raises(ShapeError, match=complaint):
        recording(**changes)


def test_a_recording_is_a_read_only_copy() -> None:
    force = np.zeros(3)
    made = recording(force=force)
    force[0] = 1.0
    assert made.force[0] == 0.0
    with pytest.raises(ValueError, match='read-only'):
        made.force[0] = 1.0


@pytest.mark.parametrize('text', ['', 'a: [', 'just words', '{"/plant": 3}', '[1, 2]'])
def test_without_a_parameter_file_there_are_no_true_values(text: str) -> None:
    assert recording(configuration=text).truth is None


def test_true_values_are_read_from_the_plant_configuration() -> None:
    text = '/lab/plant:\n  ros__parameters:\n    model.coulomb_friction: 0.56\n'
    assert recording(configuration=text).truth == {'model.coulomb_friction': 0.56}


def test_only_the_velocity_may_be_missing() -> None:
    assert recording(velocity=None).velocity is None
    with pytest.raises(ShapeError, match='force must have the shape'):
        recording(force=None)


def test_without_depth_the_velocity_is_integrated() -> None:
    made = Recording(time=[0.0, 1.0, 3.0], velocity=[0.0, 1.0, 1.0], force=[0.0, 0.0, 0.0])  # type: ignore[arg-type]
    assert made.depth.tolist() == [0.0, 0.5, 2.5]
    with pytest.raises(ShapeError, match='velocity or depth must be given'):
        Recording(time=np.arange(3.0), force=np.zeros(3))


def test_the_repr_fits_on_a_short_line() -> None:
    assert repr(recording()) == '<Recording it: 3 samples in 2 s>'


def test_an_indentation_has_two_components_and_an_off_plane_position() -> None:
    fields: dict[str, Any] = {
        'time': np.arange(3.0),
        'position': np.zeros((3, 2)),
        'off_plane': np.zeros(3),
        'force': np.zeros((3, 2)),
        'configuration': '/plant:\n  ros__parameters:\n    mode: indenter\n',
    }
    made = IndentationRecording(name='it', **fields)
    assert made.truth == {'mode': 'indenter'}
    assert not made.force.flags.writeable
    for name, wrong in (('force', np.zeros(3)), ('off_plane', np.zeros((3, 1)))):
        with pytest.raises(ShapeError, match=f'{name} must have the shape'):
            IndentationRecording(name='it', **{**fields, name: wrong})
    assert IndentationRecording(**{**fields, 'off_plane': None}).off_plane.tolist() == [0.0] * 3
