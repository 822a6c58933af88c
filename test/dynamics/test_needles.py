# SPDX-License-Identifier: Apache-2.0
"""Needles by name and needles of files."""

from __future__ import annotations

from pathlib import Path

from needle_dynamics import (
    find_needle,
    NeedleParameters,
    NEEDLES,
    ParameterError,
    SteeringParameters,
)
from needle_dynamics.parameters import PRESETS
import pytest


@pytest.mark.parametrize('name', NEEDLES)
def test_classes_have_the_constants_of_every_needle(name: str) -> None:
    needle, steering, _ = NEEDLES[name]
    assert NeedleParameters.preset(name) == needle
    assert SteeringParameters.preset(name) == steering


def test_only_the_needles_of_the_paper_do_not_bend() -> None:
    assert {name for name, one in NEEDLES.items() if not one.bends} == set(PRESETS)


def test_file_changes_constants_of_a_needle(tmp_path: Path) -> None:
    """Also with units, and one number for a tuple."""
    file = tmp_path / 'mine.yaml'
    file.write_text('needle: bending_25mm\nlength: 150mm\nbevel_load: 0.4N\nfree_length: 0.03\n')
    found, base = find_needle(str(file)), NEEDLES['bending_25mm']
    assert found.needle == NeedleParameters.preset('bending_25mm', length=0.15)
    assert found.steering == SteeringParameters.preset(
        'bending_25mm', bevel_load=(0.4,), free_length=0.03
    )
    assert found.needle.tissue_stiffness == base.needle.tissue_stiffness
    assert found.source == str(file)
    assert NeedleParameters.preset(str(file)) == found.needle


def test_parameter_file_of_nodes_is_a_needle(tmp_path: Path) -> None:
    """Parameters of the nodes that are no constants of the needle are left out."""
    file = tmp_path / 'identified.yaml'
    file.write_text(
        '/**/plant:\n  ros__parameters:\n    needle: phantom\n    steered: true\n'
        '    model.length: 0.15\n    steering.free_length: 0.03\n'
        '/**/steering:\n  ros__parameters:\n    prior.path_noise: 0.01\n'
    )
    found = find_needle(str(file))
    assert found.needle == NeedleParameters.preset('phantom', length=0.15)
    assert found.steering == SteeringParameters.preset('phantom', free_length=0.03)
    assert found.bends


@pytest.mark.parametrize(
    ('text', 'complaint'),
    [
        (
            'needle: bone\nlength: 1\n',
            'must have constants by name, and as needle one of paper_si',
        ),
        ('[1, 2]', 'must have constants by name'),
        ('needle: [1]\nlength: 1\n', 'must have constants by name'),
        ('1: 2\n', "mine.yaml: unknown parameter '1'"),
        ('lenght: 1\n', "mine.yaml: unknown parameter 'lenght'; did you mean 'length'"),
        ('length: long\n', "with a unit of m, cm, mm, um, got 'long'"),
        ('length: 3N\n', 'mine.yaml: length must be a number, or text with a unit of m'),
        ('a: [', 'mine.yaml cannot be read: is not YAML'),
    ],
)
def test_errors_of_a_file_name_the_file(tmp_path: Path, text: str, complaint: str) -> None:
    file = tmp_path / 'mine.yaml'
    file.write_text(text)
    with pytest.raises(ParameterError) as caught:
        find_needle(str(file))
    assert complaint in str(caught.value)


def test_missing_file_and_unknown_name_are_named() -> None:
    with pytest.raises(ParameterError, match=r'none\.yaml cannot be read: .*No such file'):
        find_needle('none.yaml')
    with pytest.raises(ParameterError, match=r"got 'bending35'; did you mean bending_35mm\?"):
        find_needle('bending35')
