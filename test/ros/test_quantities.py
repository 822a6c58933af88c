# SPDX-License-Identifier: Apache-2.0
"""Quantities with units, and targets."""

from __future__ import annotations

from math import inf, pi

from needle_ros.errors import ParameterError
from needle_ros.quantities import EXAMPLES, quantities, quantity, target
import pytest


@pytest.mark.parametrize(
    ('text', 'unit', 'value'),
    [
        ('50mm', 'm', 0.05),
        ('0.05', 'm', 0.05),
        (' 5 cm ', 'm', 0.05),
        ('-2e-3m', 'm', -0.002),
        ('3N', 'N', 3.0),
        ('20 s', 's', 20.0),
        ('2min', 's', 120.0),
        ('5mm/s', 'm/s', 0.005),
        ('10', '1/s', 10.0),
        ('10 1/s', '1/s', 10.0),
        ('inf', 'N', inf),
        ('-11', '1', -11.0),
    ],
)
def test_quantity_is_read_with_or_without_unit(text: str, unit: str, value: float) -> None:
    # Up to the rounding of the factor.
    assert quantity(text, unit) == pytest.approx(value, rel=1e-15)


def test_examples_are_quantities() -> None:
    # 5 degrees: up to the rounding of the factor.
    assert {unit: quantity(text, unit) for unit, text in EXAMPLES.items()} == {
        '1': 0.001,
        'm': 0.05,
        's': 20.0,
        'N': 3.0,
        'm/s': 0.005,
        'rad': pytest.approx(pi / 36.0, rel=1e-15),
        'm^2': 1e-6,
        'm^4': 0.1e-12,
        'kg': 0.1,
        'kg/m^3': 8000.0,
        'Pa': 200e9,
        'N/m^2': 30e3,
    }


@pytest.mark.parametrize(
    ('text', 'unit', 'message'),
    [
        ('4N', 'm', "'4N' is not a length, such as 0.05 or 50mm"),
        ('mm', 'm', "'mm' is not a length, such as 0.05 or 50mm"),
        ('3 kg', 'N', "'3 kg' is not a force, such as 3 or 3N"),
        ('4mm 5mm', 'm', "'4mm 5mm' is not a length, such as 0.05 or 50mm"),
        ('x', '1/s', "'x' is not a quantity, such as 1.5 or 1.51/s"),
    ],
)
def test_error_names_the_text_and_an_example(text: str, unit: str, message: str) -> None:
    with pytest.raises(ParameterError) as caught:
        quantity(text, unit)
    assert str(caught.value) == message


@pytest.mark.parametrize(
    'text',
    [
        '4mm,100mm,-2mm',
        '4mm 100mm -2mm',
        '4 mm, 100 mm, -2 mm',
        '4 mm 10 cm -2 mm',
        '0.004,0.1,-2e-3',
    ],
)
def test_target_has_commas_or_blanks(text: str) -> None:
    assert target(text) == pytest.approx((0.004, 0.1, -0.002), rel=1e-15)


def test_a_single_length_is_a_depth_on_the_axis() -> None:
    assert target('50mm') == (0.0, 0.05, 0.0)
    assert quantities('30mm', 'm') == [0.03]


@pytest.mark.parametrize('text', ['1mm,2mm', '1,2,3,4', '0,inf,0', 'nan'])
def test_invalid_target_is_named(text: str) -> None:
    with pytest.raises(ParameterError, match=rf"^'{text}' is not a target: x,y,z"):
        target(text)
