# SPDX-License-Identifier: Apache-2.0
"""Construction of settings from values: checks, defaults, and error messages."""

from __future__ import annotations

from array import array
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

from needle_ros.errors import ParameterError
from needle_ros.settings import (
    check_constants,
    check_whole,
    checked,
    choice,
    constant,
    flag,
    from_values,
    is_number,
    text,
    unknown_name,
)
import numpy as np
import pytest


@dataclass(frozen=True, kw_only=True)
class Robot:
    """Example of settings."""

    gain: float = constant(2.0, '1/s', 'gain', open_low=True, high=50.0)
    offset: float = constant(0.0, '1', 'offset', low=-1.0)
    levels: tuple[float, ...] = constant((1.0, 2.0), 'N', 'levels')
    joints: tuple[str, ...] = field(default=('x', 'z'), metadata={'description': 'joints'})
    law: str = 'pid'

    def __post_init__(self) -> None:
        check_constants(self)


@dataclass(frozen=True, kw_only=True)
class Stand:
    """Example of settings that are not numbers."""

    side: str = choice('left', ('left', 'right'), 'side of the robot')
    mirrored: bool = flag(False, 'whether it is mirrored')
    label: str = text('', 'label')

    def __post_init__(self) -> None:
        check_constants(self)


@dataclass(frozen=True, kw_only=True)
class Pair:
    """Example of settings with a condition on two of them."""

    low: float = constant(0.0, '1', 'low')
    high: float = constant(1.0, '1', 'high')

    def __post_init__(self) -> None:
        check_constants(self)
        if self.low > self.high:
            raise ParameterError('both are wrong: low > high')


@pytest.mark.parametrize(
    ('given', 'value'),
    [
        (np.int64(3), 3.0),
        (np.uint8(3), 3.0),
        (np.float32(0.1), float(np.float32(0.1))),
        (np.float64(0.1), 0.1),
        (Fraction(1, 4), 0.25),
    ],
)
def test_numbers_of_numpy_are_numbers(given: Any, value: float) -> None:
    """With the same result as numbers of Python, in every check."""
    assert is_number(given)
    assert checked('x', given) == value
    for robot in (Robot(gain=given), from_values(Robot, {'gain': given, 'levels': [given]})):
        assert isinstance(robot.gain, (int, float))
        assert robot.gain == value
    with pytest.raises(ParameterError, match=r'gain must be finite, > 0 and <= 50 1/s'):
        Robot(gain=type(given)(200))
    if value == 3.0:
        check_whole('x', given, 0, 3)
        with pytest.raises(ParameterError, match='x must be an integer from 0 to 2'):
            check_whole('x', given, 0, 2)


@pytest.mark.parametrize('given', [True, np.True_, '3', None, 3j, np.array(3.0), [3.0]])
def test_other_types_are_no_numbers(given: Any) -> None:
    assert not is_number(given)
    with pytest.raises(ParameterError, match='x must be a number'):
        checked('x', given)
    for value in (given, np.float32(3.0), 3.0):
        with pytest.raises(ParameterError, match='x must be an integer'):
            check_whole('x', value, 0, 3)


@pytest.mark.parametrize('given', [np.float32('nan'), np.float32('inf'), 10**400, np.nan])
def test_numbers_that_are_not_finite_are_rejected(given: Any) -> None:
    assert not is_number(given)
    with pytest.raises(ParameterError, match='x must be finite'):
        checked('x', given)


def test_values_are_converted_to_field_types() -> None:
    """Integers to floats, lists and arrays to tuples; missing values get the default."""
    made = from_values(Robot, {'gain': 3, 'levels': [1, 2.5], 'law': 'pd'})
    assert made == Robot(gain=3.0, levels=(1.0, 2.5), law='pd')
    assert [type(number) for number in (made.gain, *made.levels)] == [float] * 3
    assert from_values(Robot, {'levels': array('d', [4.0])}).levels == (4.0,)
    assert from_values(Robot, {}) == Robot()


@pytest.mark.parametrize(
    ('given', 'message'),
    [
        ({'side': 'top'}, "stand.side must be one of left, right, got 'top'"),
        ({'side': ['left']}, "stand.side must be one of left, right, got ['left']"),
        ({'mirrored': 1}, 'stand.mirrored must be true or false, got 1'),
        ({'label': 3}, 'stand.label must be text, got 3'),
    ],
)
def test_an_invalid_word_is_named_with_the_valid_words(
    given: dict[str, Any], message: str
) -> None:
    with pytest.raises(ParameterError) as caught:
        from_values(Stand, given, 'stand.')
    assert str(caught.value) == message


def test_a_choice_describes_its_words() -> None:
    meta = Stand.__dataclass_fields__['side'].metadata
    assert meta['description'] == 'one of left, right: side of the robot'


def test_none_is_an_empty_tuple() -> None:
    """An empty list of a parameter file arrives from rcl as None."""
    assert from_values(Robot, {'levels': None, 'joints': None}) == Robot(levels=(), joints=())


@pytest.mark.parametrize(
    ('values', 'complaint'),
    [
        ({'gain': None}, 'arm.gain must be a number, got None'),
        ({'gain': True}, 'arm.gain must be a number, got True'),
        ({'gain': 0}, 'arm.gain must be finite, > 0 and <= 50 1/s, got 0.0'),
        ({'gain': 51.0}, 'arm.gain must be finite, > 0 and <= 50 1/s, got 51.0'),
        ({'gain': 10**400}, 'arm.gain must be finite, got an integer of too many digits'),
        ({'offset': -2}, 'arm.offset must be finite, >= -1, got -2.0'),
        ({'levels': [1.0, float('nan')]}, 'arm.levels must be finite, >= 0 N, got nan'),
        ({'levels': ['a']}, "arm.levels must be a number, or text with a unit of N, mN, got 'a'"),
        ({'gains': 1.0}, "unknown parameter 'arm.gains'; did you mean 'arm.gain'?"),
        (
            {'xyzzy': 1.0},
            (
                "unknown parameter 'arm.xyzzy'; valid: arm.gain, arm.joints, arm.law, "
                'arm.levels, arm.offset'
            ),
        ),
    ],
)
def test_error_names_the_invalid_value(values: dict[str, Any], complaint: str) -> None:
    """The message has the qualified name, the value, and the valid range."""
    with pytest.raises(ParameterError) as caught:
        from_values(Robot, values, 'arm.')
    assert str(caught.value) == complaint


def test_unknown_name_has_a_hint() -> None:
    """The nearest name, or all names."""
    assert unknown_name('rat', ['rate', 'mode']) == "unknown parameter 'rat'; did you mean 'rate'?"
    assert unknown_name('q', ['rate', 'mode']) == "unknown parameter 'q'; valid: mode, rate"


def test_message_about_several_fields_names_their_group() -> None:
    """The prefix alone would be read as the beginning of a name."""
    with pytest.raises(ParameterError) as caught:
        from_values(Pair, {'low': 2.0}, 'pair.')
    assert str(caught.value) == 'pair: both are wrong: low > high'


def test_units_in_text_and_single_numbers_are_accepted() -> None:
    assert from_values(Robot, {'levels': '3N'}).levels == (3.0,)
    assert from_values(Robot, {'levels': ['30mN', 2]}).levels == (0.03, 2.0)
    # PyYAML reads a number without a point as text.
    assert from_values(Robot, {'levels': ['1e-3']}).levels == (1e-3,)
    with pytest.raises(
        ParameterError, match=r"^levels must be .* text with a unit of N, mN, got '3mm'$"
    ):
        from_values(Robot, {'levels': '3mm'})
