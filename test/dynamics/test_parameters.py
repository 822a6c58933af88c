# SPDX-License-Identifier: Apache-2.0
"""Model constants: published values, ranges and error messages."""

from __future__ import annotations

from dataclasses import asdict, fields, FrozenInstanceError, replace
from typing import Any

from hypothesis import given
from hypothesis import strategies as st
from needle_dynamics import NeedleError, NeedleParameters, ParameterError
from needle_dynamics.parameters import PRESETS
from needle_ros.settings import from_values, number_fields
import numpy as np
from numpy.testing import assert_allclose
import pytest

NUMBERS = [*number_fields(NeedleParameters)]
MAY_BE_ZERO = [
    name
    for name, item in number_fields(NeedleParameters).items()
    if item.metadata['low'] == 0.0 and not item.metadata['open_low']
]
#: Lower bounds of the ranges.
LOWEST = {name: NeedleParameters.__dataclass_fields__[name].metadata['low'] for name in NUMBERS}

#: Table 3 and section 3.2.8 of the paper, in SI units.
TABLE_3 = {
    'youngs_modulus': 200e9,
    'area_moment': 1.28e-13,
    'rotary_inertia': 1.0626e-9,
    'density': 8000.0,
    'area': 1.27e-6,
    'length': 0.2,
    'tissue_stiffness': 520.0,
    'coulomb_friction': 0.56,
    'carriage_mass': 0.0,
}


@pytest.mark.parametrize(
    ('name', 'viscous', 'damping'),
    [('paper_si', 0.3, 0.0), ('paper_mm', 300.0, 0.0), ('phantom', 300.0, 1.6)],
)
def test_presets_match_the_published_values(name: str, viscous: float, damping: float) -> None:
    """Presets are Table 3, with mu_v = 0.3 N s/m or 0.3 N s/mm, and the assumed damping."""
    values = asdict(NeedleParameters.preset(name))
    assert {key: values[key] for key in TABLE_3} == TABLE_3
    assert values['viscous_friction'] == viscous
    assert values['tissue_damping'] == damping
    assert values['hub_stop'] is True
    assert NeedleParameters.preset(name) == PRESETS[name]


def test_there_are_three_presets_and_the_default_is_paper_si() -> None:
    assert list(PRESETS) == ['paper_si', 'paper_mm', 'phantom']
    assert NeedleParameters() == NeedleParameters.preset('paper_si')


def test_damping_of_the_phantom_is_30_percent_of_critical() -> None:
    """c_a = 1.6 is 0.3 times 2 rho A omega_1 at full insertion."""
    p = NeedleParameters.preset('phantom')
    # First clamped-free root; the tissue is a foundation of 520 N/m^2.
    stiffness = p.bending_stiffness * (1.8751040687 / p.length) ** 4 + p.tissue_stiffness
    critical = 2.0 * np.sqrt(stiffness * p.linear_density)
    # 1.6 has two digits.
    assert_allclose(p.tissue_damping / critical, 0.3, atol=0.005)


def test_derived_quantities() -> None:
    """Rho A, E I and the moving mass are products and a sum of the constants."""
    p = NeedleParameters.preset('paper_si', carriage_mass=0.5)
    assert_allclose(p.linear_density, 0.01016, rtol=1e-15)
    assert_allclose(p.bending_stiffness, 0.0256, rtol=1e-15)
    assert_allclose(p.moving_mass, 0.5 + 0.01016 * 0.2, rtol=1e-15)


def test_every_number_declares_unit_description_and_range() -> None:
    """The metadata of the ROS parameter description exist, and defaults are within range."""
    for item in fields(NeedleParameters):
        assert item.metadata['description']
    for name in NUMBERS:
        meta = NeedleParameters.__dataclass_fields__[name].metadata
        assert meta['unit']
        assert meta['low'] <= getattr(NeedleParameters(), name) <= meta['high']
    others = {
        'layer_depths',
        'layer_stiffnesses',
        'friction_law',
        'modes',
        'formulation',
        'hub_stop',
    }
    assert {*NUMBERS, *others} == {item.name for item in fields(NeedleParameters)}


def with_constant(name: str, value: Any) -> NeedleParameters:
    """Return parameters with one changed constant."""
    return NeedleParameters(**{name: value})


def refusal(name: str, value: Any) -> str:
    """Return the error message for a constant, set directly, from a mapping or in a preset."""
    complaints = set()
    for make in (
        lambda: with_constant(name, value),
        lambda: from_values(NeedleParameters, {name: value}),
        lambda: NeedleParameters.preset('phantom', **{name: value}),
    ):
        with pytest.raises(ParameterError) as caught:
            make()
        complaints.add(str(caught.value))
    assert len(complaints) == 1
    return complaints.pop()


@pytest.mark.parametrize('value', [np.nan, np.inf, -np.inf, -1.0, -1e-300])
def test_constants_out_of_range_are_rejected(value: float) -> None:
    """NaN, infinite and negative constants are rejected; the message has name and range."""
    for name in NUMBERS:
        lowest = LOWEST[name]
        # Some ranges reach below zero.
        tried = 1.5 * lowest if lowest < value < 0.0 else value
        complaint = refusal(name, tried)
        assert complaint.startswith(f'{name} must be finite, >')
        assert complaint.endswith(f', got {tried!r}')


@pytest.mark.parametrize(
    ('name', 'value', 'complaint'),
    [
        ('length', 0.0, 'length must be finite, > 0 m, got 0.0'),
        ('coulomb_friction', -1.0, 'coulomb_friction must be finite, >= 0 N, got -1.0'),
        ('swelling', -1.0, 'swelling must be finite, > -1, got -1.0'),
        ('breakaway_friction', 0.5, 'breakaway_friction must be finite, >= 1, got 0.5'),
        ('area', True, 'area must be a number, got True'),
    ],
)
def test_error_message_contains_the_valid_range(name: str, value: Any, complaint: str) -> None:
    """Name, range with its unit, and value."""
    assert refusal(name, value) == complaint


def test_zero_is_valid_only_where_the_model_is_regular() -> None:
    """Friction, tissue and carriage may be zero; geometry and inertia may not."""
    for name in NUMBERS:
        if name in MAY_BE_ZERO or LOWEST[name] < 0.0:
            assert getattr(with_constant(name, 0.0), name) == 0.0
        else:
            with pytest.raises(ParameterError, match=rf'^{name} must be finite, >.*got 0\.0$'):
                with_constant(name, 0.0)


def test_list_of_constants_that_may_be_zero() -> None:
    """Only these constants have zero as the closed lower bound."""
    assert MAY_BE_ZERO == [
        'carriage_mass',
        'tissue_stiffness',
        'tissue_damping',
        'coulomb_friction',
        'viscous_friction',
        'withdrawal_friction',
    ]


@pytest.mark.parametrize('value', [True, False, '0.1', None, [0.1], 1j])
def test_non_numbers_are_rejected(value: Any) -> None:
    """Booleans, strings and None are rejected even if float() converts them."""
    for name in NUMBERS:
        assert refusal(name, value) == f'{name} must be a number, got {value!r}'


@pytest.mark.parametrize('value', [1, 0, 'yes', None, 1.0])
def test_hub_stop_must_be_boolean(value: Any) -> None:
    with pytest.raises(ParameterError, match='hub_stop must be true or false, got'):
        NeedleParameters(hub_stop=value)
    assert NeedleParameters(hub_stop=False).hub_stop is False


@pytest.mark.parametrize('value', [0.2, 0.3])
def test_minimum_depth_must_be_less_than_the_length(value: float) -> None:
    with pytest.raises(ParameterError, match=r'minimum_depth must be < length = 0\.2 m, got'):
        NeedleParameters(minimum_depth=value)


def test_integers_are_converted_to_floats() -> None:
    """A configuration file may contain 8000 instead of 8000.0."""
    made = from_values(NeedleParameters, {'density': 8000, 'viscous_friction': 0})
    assert made == replace(NeedleParameters(), viscous_friction=0.0)
    assert type(made.density) is type(made.viscous_friction) is float
    assert type(NeedleParameters.preset('phantom', density=7850).density) is float


@given(
    values=st.fixed_dictionaries(
        {},
        optional={
            name: st.floats(0.0 if name in MAY_BE_ZERO else max(1e-30, LOWEST[name]), 1e30)
            for name in NUMBERS
            if name not in ('length', 'minimum_depth')
        }
        | {'length': st.floats(1e-2, 1.0), 'hub_stop': st.booleans()},
    )
)
def test_mapping_round_trip(values: dict[str, Any]) -> None:
    """`from_mapping` uses defaults for missing keys, and `asdict` is its inverse."""
    made = from_values(NeedleParameters, values)
    assert asdict(made) == asdict(NeedleParameters()) | values
    assert from_values(NeedleParameters, asdict(made)) == made


def test_unknown_key_error_suggests_the_nearest_valid_key() -> None:
    with pytest.raises(ParameterError) as caught:
        from_values(NeedleParameters, {'viscous_fricton': 0.3})
    assert str(caught.value) == (
        "unknown parameter 'viscous_fricton'; did you mean 'viscous_friction'?"
    )
    with pytest.raises(ParameterError, match="did you mean 'density'"):
        NeedleParameters.preset('phantom', desity=1.0)


def test_unknown_key_error_lists_all_valid_keys() -> None:
    """If there is no similar key."""
    with pytest.raises(ParameterError, match='xyzzy') as caught:
        from_values(NeedleParameters, {'xyzzy': 1.0})
    for item in fields(NeedleParameters):
        assert item.name in str(caught.value)


def test_unknown_preset_error_lists_the_presets() -> None:
    with pytest.raises(ParameterError, match=r"paper_si, paper_mm, phantom.*'papper'"):
        NeedleParameters.preset('papper')


def test_constants_are_frozen() -> None:
    """Checked constants cannot be changed, including presets."""
    p = NeedleParameters()
    with pytest.raises(FrozenInstanceError):
        p.length = 0.3  # type: ignore[misc]
    with pytest.raises(ParameterError):
        replace(p, length=-1.0)
    assert hash(p) == hash(NeedleParameters())


def test_preset_with_changes_does_not_modify_the_preset() -> None:
    changed = NeedleParameters.preset('paper_mm', length=0.15)
    assert changed == replace(PRESETS['paper_mm'], length=0.15)
    assert PRESETS['paper_mm'].length == 0.2


def test_errors_are_needle_errors_and_value_errors() -> None:
    """Callers can catch the base class of the project or ValueError."""
    assert issubclass(ParameterError, NeedleError)
    assert issubclass(ParameterError, ValueError)
