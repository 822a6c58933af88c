# SPDX-License-Identifier: Apache-2.0
"""Constants as arrays: the same needles, results and errors as one object for each needle."""

from __future__ import annotations

from dataclasses import asdict, replace
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st
from needle_dynamics import (
    FloatArray,
    InsertionDepthError,
    NeedleArray,
    NeedleModel,
    NeedleParameters,
    ParameterError,
    ShapeError,
    simulate_batch,
)
from needle_dynamics.parameters import LEAST_RATIOS
from needle_dynamics.simulated.batch import _check, lane_constants, lane_layers
from needle_dynamics.simulated.needle_array import columns_of
from needle_ros.settings import number_fields
import numpy as np
import pytest

RUNS = 5
BASE = NeedleParameters.preset('phantom', minimum_depth=2e-3)
START = NeedleModel(BASE).state_at(0.05, 1e-3)
BASES = (
    BASE,
    replace(BASE, friction_law='stribeck', breakaway_friction=1.5, hub_stop=False),
    replace(BASE, layer_depths=(0.02, 0.04), layer_stiffnesses=(900.0, 0.0)),
    replace(BASE, swelling=0.4, swelling_time=0.01, friction_law='tanh'),
    replace(BASE, formulation='as_printed', layer_depths=(0.03,), layer_stiffnesses=(700.0,)),
    replace(BASE, modes=1),
)
#: Range of each field for valid needles that contain the start.
RANGES: dict[str, tuple[float, float]] = {
    name: (
        (0.1, 0.25) if name == 'length'
        else (1e-3, 1e-2) if name == 'minimum_depth'
        else (1.0, 2.0) if name == 'breakaway_friction'
        else (0.5 * getattr(BASE, name), 2.0 * getattr(BASE, name) + 0.1)
    )
    for name in number_fields(BASE)
}  # fmt: skip


@st.composite
def needle_arrays(draw: st.DrawFn) -> NeedleArray:
    """Draw a base, and which constants differ; layers only their depths or stiffnesses."""
    base = draw(st.sampled_from(BASES))
    names = draw(st.sets(st.sampled_from(sorted(RANGES)), min_size=1, max_size=6))
    rng = np.random.default_rng(draw(st.integers(0, 1000)))
    values: dict[str, Any] = {name: rng.uniform(*RANGES[name], RUNS) for name in sorted(names)}
    layers = len(base.layer_depths)
    if layers and draw(st.booleans()):
        values['layer_stiffnesses'] = rng.uniform(0.0, 2e3, (RUNS, layers))
    if layers and draw(st.booleans()):
        values['layer_depths'] = rng.uniform(1e-3, 0.05, (RUNS, layers)).cumsum(axis=1)
    return NeedleArray(base, **values)


@settings(max_examples=60)
@given(needle_arrays())
def test_arrays_are_the_numbers_of_one_object_for_each_needle(needles: NeedleArray) -> None:
    """Each number that the compiled code takes, to the bit."""
    each = list(needles)
    assert len(each) == RUNS
    for name, values in needles.constants.items():
        assert [getattr(p, name) for p in each] == [
            tuple(own) if isinstance(own, list) else own for own in values.tolist()
        ]
    assert np.array_equal(lane_constants(needles), lane_constants(each))
    assert np.array_equal(lane_layers(needles), lane_layers(each))


@settings(max_examples=12)
@given(needle_arrays())
def test_batch_of_arrays_equals_a_batch_of_objects(needles: NeedleArray) -> None:
    """States, depths and deflections, to the bit."""
    each = list(needles)
    starts = [NeedleModel(p).state_at(0.05, 1e-3) for p in each]
    options: dict[str, Any] = {'duration': 4e-3, 'interval': 2e-3, 'step': 1e-4}
    found, other = (simulate_batch(given, starts, 3.0, **options) for given in (needles, each))
    for name in ('states', 'depth', 'tip_deflection', 'completed'):
        assert np.array_equal(getattr(found, name), getattr(other, name), equal_nan=True)


def test_no_object_is_made_for_a_needle(monkeypatch: pytest.MonkeyPatch) -> None:
    base = replace(BASES[2], swelling=0.1)
    needles = NeedleArray(
        base,
        tissue_stiffness=np.linspace(300.0, 900.0, 100),
        layer_stiffnesses=np.linspace(200.0, 900.0, 200).reshape(100, 2),
    )
    made = list[int]()
    check = NeedleParameters.__post_init__

    def counted(self: NeedleParameters) -> None:
        made.append(1)
        check(self)

    monkeypatch.setattr(NeedleParameters, '__post_init__', counted)
    options: dict[str, Any] = {'duration': 1e-3, 'interval': 1e-3, 'step': 1e-4}
    batch = simulate_batch(needles, START, 3.0, workers=1, **options)
    assert np.isfinite(batch.tip_deflection).all()
    # A few for what all share, and not one for each of a hundred.
    assert len(made) < 10
    assert np.ptp(batch.tip_deflection[:, -1]) > 0.0


@settings(max_examples=100)
@given(
    st.sampled_from(sorted(RANGES)),
    st.sampled_from([-1.0, 0.0, 1e-9, 0.3, 1e3, np.inf, -np.inf, np.nan]),
    st.integers(0, RUNS - 1),
    st.sampled_from(BASES),
)
def test_value_is_rejected_as_by_the_object(
    name: str, value: float, run: int, base: NeedleParameters
) -> None:
    """The same values are valid, and the message names the first invalid run."""
    values = np.full(RUNS, getattr(base, name))
    values[run:] = value
    changed: dict[str, Any] = {name: value}
    expected = message = None
    try:
        expected = replace(base, **changed)
    except ParameterError as error:
        message = f'run {run}: {error}'
    if message is None:
        assert NeedleArray(base, **{name: values})[run] == expected
        return
    with pytest.raises(ParameterError) as caught:
        NeedleArray(base, **{name: values})
    assert str(caught.value) == message


@pytest.mark.parametrize(
    ('constants', 'message'),
    [
        ({'layer_stiffnesses': [[1.0, 2.0, 3.0]]}, 'run 0: layer_stiffnesses must have one value'),
        ({'layer_depths': [[0.1, 0.2], [0.1, 0.1]]}, 'run 1: layer_depths must be > 0 and incre'),
        ({'layer_depths': [[0.0, 0.2]]}, 'run 0: layer_depths must be > 0 and increase'),
        ({'layer_stiffnesses': [[1.0, -2.0]]}, 'run 0: layer_stiffnesses must be finite'),
        ({'layer_stiffnesses': [[1.0, np.nan]]}, 'run 0: layer_stiffnesses must be finite'),
        ({'length': [0.2, 0.1], 'minimum_depth': [0.1, 0.1]}, 'run 1: minimum_depth must be < '),
        ({'density': [True]}, 'density must be an array of numbers, got an array of bool'),
        ({'density': ['8000']}, 'density must be an array of numbers, got an array of <U4'),
        ({'modes': [1, 2]}, "unknown parameter 'modes'"),
        ({'densty': [1.0]}, "unknown parameter 'densty'; did you mean 'density'?"),
    ],
)
def test_invalid_constants_are_rejected(constants: dict[str, Any], message: str) -> None:
    with pytest.raises(ParameterError) as caught:
        NeedleArray(BASES[2], **constants)
    assert message in str(caught.value)
    assert '\n' not in str(caught.value)


def test_depth_at_which_modes_are_indistinguishable_is_rejected() -> None:
    ratio = LEAST_RATIOS[1]
    limits = np.array([1.001, 0.999]) * ratio * BASE.length
    with pytest.raises(ParameterError, match='run 1: 2 modes cannot be distinguished'):
        NeedleArray(BASE, minimum_depth=limits)


@pytest.mark.parametrize(
    'constants',
    [{}, {'density': 8e3}, {'density': [[8e3]]}, {'density': []}, {'layer_depths': [0.1]},
     {'density': [8e3, 8e3], 'area': [1e-6]}, {'density': [[8e3], [8e3, 8e3]]}],
)  # fmt: skip
def test_arrays_must_fit(constants: dict[str, Any]) -> None:
    with pytest.raises(ShapeError):
        NeedleArray(BASE, **constants)


def test_start_outside_of_a_needle_is_reported_as_for_objects() -> None:
    needles = NeedleArray(BASE, length=np.array([0.2, 0.1, 0.2]))
    starts: FloatArray = np.tile(START, (3, 1))
    with pytest.raises(InsertionDepthError) as caught:
        simulate_batch(needles, starts, 3.0, duration=1e-3, interval=1e-3)
    with pytest.raises(InsertionDepthError) as other:
        _check(list(needles), starts)
    assert str(caught.value) == str(other.value)


def test_array_is_a_copy_that_is_not_writable() -> None:
    given = np.array([0.4, 0.5])
    needles = NeedleArray(BASE, coulomb_friction=given)
    given[0] = -1.0
    assert needles[0].coulomb_friction == needles[-2].coulomb_friction == 0.4
    with pytest.raises(ValueError, match='read-only'):
        needles.constants['coulomb_friction'][0] = 1.0
    assert [p.coulomb_friction for p in needles[::-1]] == [0.5, 0.4]
    with pytest.raises(IndexError):
        _ = needles[2]


def test_columns_are_the_properties_of_the_objects() -> None:
    needles = NeedleArray(BASE, area=[1e-6, 2e-6], length=[0.15, 0.2])
    names = ['linear_density', 'bending_stiffness', 'moving_mass', 'reach', 'hub_stop', 'modes']
    found, other = (columns_of(given, names) for given in (needles, list(needles)))
    assert {name: values.tolist() for name, values in found.items()} == {
        name: values.tolist() for name, values in other.items()
    }
    assert asdict(needles[0]) == asdict(replace(BASE, area=1e-6, length=0.15))
