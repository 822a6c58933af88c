# SPDX-License-Identifier: Apache-2.0
"""Needles by name and needles of files."""

from __future__ import annotations

from math import pi
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
    assert find_needle(file) == found


def test_diameters_stand_for_area_and_area_moment(tmp_path: Path) -> None:
    """The literature prints 22 gauge as 0.7 mm outside and 0.48 mm inside."""
    file = tmp_path / 'mine.yaml'
    file.write_text('needle: misra_2010\nouter_diameter: 0.7mm\ninner_diameter: 0.48e-3\n')
    found, known = find_needle(str(file)).needle, NEEDLES['hollow_0.70mm'].needle
    assert (found.area, found.area_moment) == pytest.approx((known.area, known.area_moment))
    solid = NEEDLES['phantom'].changed({'outer_diameter': 1e-3}).needle
    assert solid.area == pytest.approx(0.25 * pi * 1e-6)
    assert solid.area_moment == pytest.approx(solid.area**2 / (4.0 * pi))


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
        (
            'outer_diameter: 1mm\ninner_diameter: 2mm\n',
            'must be 0 <= inner < outer <= 0.02 m, got 0.001',
        ),
        ('outer_diameter: 3N\n', "mine.yaml: '3N' is not a length"),
        ('inner_diameter: 1mm\n', 'must be 0 <= inner < outer <= 0.02 m, got 0.0 and'),
        (
            'outer_diameter: 0.7\n',
            'must be 0 <= inner < outer <= 0.02 m, got 0.7 (in mm?) and 0.0',
        ),
        ('outer_diameter: 1mm\narea: 1mm^2\n', 'area is given by the diameters, too'),
        ('outer_diamter: 1mm\n', "did you mean 'outer_diameter'"),
        ('a: [', 'mine.yaml is not YAML'),
        (
            '/**/plant:\n  ros__parameters:\n    tip.noise: 0.001\n    tip.rate: 40\n',
            'must have constants model.* or steering.*, got tip.noise, tip.rate',
        ),
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


@pytest.mark.parametrize(
    'change', [{'outer_diameter': 2e-3}, {'youngs_modulus': 9e10}, {'area_moment': 1e-14}]
)
def test_torsional_stiffness_follows_the_bending_stiffness(change: dict[str, float]) -> None:
    """Their ratio is a property of the material; a given value is used unchanged."""
    base = NEEDLES['bending_35mm']
    needle, steering, _ = base.changed(change)
    ratio = base.needle.bending_stiffness / base.steering.torsional_stiffness
    assert needle.bending_stiffness != base.needle.bending_stiffness
    assert needle.bending_stiffness / steering.torsional_stiffness == pytest.approx(ratio)
    given = base.changed({**change, 'torsional_stiffness': 0.01}).steering
    assert given.torsional_stiffness == 0.01
    assert not NEEDLES['phantom'].changed(change).bends
