# SPDX-License-Identifier: Apache-2.0
"""Batches of steered needles."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as some
from hypothesis.extra.numpy import arrays, broadcastable_shapes
from needle_dynamics import (
    insert_batch,
    NeedleParameters,
    NEEDLES,
    ParameterError,
    ShapeError,
    SteeredNeedle,
    SteeringParameters,
)
import numpy as np
from numpy.testing import assert_array_equal
import pytest

NEEDLE, STEERING, _ = NEEDLES['bending_35mm']
DEPTHS = np.linspace(0.0, 0.1, 12)


def drawn(runs: int) -> dict[str, Any]:
    """Return different needles, tissues, paths and seeds."""
    rng = np.random.default_rng(1)
    several = [
        replace(NEEDLE, tissue_stiffness=k, layer_depths=(0.04,) * n, layer_stiffnesses=(5e4,) * n)
        for k, n in zip(rng.uniform(1e3, 1e5, runs), rng.integers(0, 2, runs), strict=True)
    ]
    return {
        'needles': several,
        'steering': [
            replace(STEERING, bevel_load=(load,), path_noise=3e-4, skin_stiffness=skin)
            for load, skin in zip(rng.uniform(0, 1, runs), rng.uniform(0, 1e3, runs), strict=True)
        ],
        'depths': DEPTHS,
        'guides': rng.uniform(-3e-3, 3e-3, (runs, len(DEPTHS), 2)),
        'tilts': rng.uniform(-0.01, 0.01, (runs, len(DEPTHS), 2)),
        'rolls': rng.uniform(-3.0, 3.0, (runs, len(DEPTHS))),
        'seeds': range(runs),
    }


def test_each_run_equals_a_single_needle() -> None:
    values = drawn(20)
    tips = insert_batch(**values)
    for i, found in enumerate(tips):
        guides, tilts, rolls = (values[name][i] for name in ('guides', 'tilts', 'rolls'))
        one = SteeredNeedle(
            values['needles'][i],
            values['steering'][i],
            guide=guides[0],
            tilt=tilts[0],
            roll=rolls[0],
            seed=i,
        )
        for k, depth in enumerate(DEPTHS):
            one.move(depth=depth, guide=guides[k], tilt=tilts[k], roll=rolls[k])
            assert_array_equal(one.tip, found[k])


@pytest.mark.parametrize('workers', [2, 3, 7])
def test_results_are_independent_of_workers(workers: int) -> None:
    values = drawn(20)
    assert_array_equal(insert_batch(**values, workers=workers), insert_batch(**values, workers=1))


def test_progress_is_called_for_each_run() -> None:
    values, calls = drawn(20), list[None]()
    found = insert_batch(**values, progress=lambda: calls.append(None))
    assert len(calls) == 20
    assert_array_equal(found, insert_batch(**values))


@settings(max_examples=30)
@given(some.data())
def test_common_values_are_broadcast_to_all_runs(data: some.DataObject) -> None:
    runs, poses = 3, 4
    depths = np.linspace(0.0, 0.1, poses)
    given_: dict[str, Any] = {}
    full: dict[str, Any] = {}
    for name, shape in (
        ('guides', (runs, poses, 2)),
        ('tilts', (runs, poses, 2)),
        ('rolls', (runs, poses)),
    ):
        fewer = data.draw(some.sampled_from([(), shape[1:], shape]))
        values = data.draw(arrays(np.float64, fewer, elements=some.floats(-1e-2, 1e-2)))
        given_[name], full[name] = values, np.broadcast_to(values, shape)
    few = insert_batch(NEEDLE, STEERING, depths, **given_)
    all_ = insert_batch([NEEDLE] * runs, [STEERING] * runs, np.tile(depths, (runs, 1)), **full)
    assert_array_equal(np.broadcast_to(few, all_.shape), all_)


@given(broadcastable_shapes((3, 4), min_dims=1, max_dims=4))
def test_wrong_shapes_are_rejected(shape: tuple[int, ...]) -> None:
    depths, rolls = np.linspace(0.0, 0.1, 4), np.zeros(shape)
    if shape[-1] == 4 and len(shape) < 3:
        tips = insert_batch(NEEDLE, STEERING, depths, rolls=rolls)
        assert tips.shape == (*(shape[:-1] or (1,)), 4, 3)
    else:
        with pytest.raises(ShapeError, match=r'rolls must have shape|at most one axis of runs'):
            insert_batch(NEEDLE, STEERING, depths, rolls=rolls)


@pytest.mark.parametrize('kind', [list, tuple, np.array, np.int64, range])
def test_seeds_are_arrays_or_sequences(kind: Any) -> None:
    noisy = SteeringParameters(path_noise=1e-3)
    seeds = range(2, 4) if kind is range else kind([2, 3])
    found = insert_batch(NEEDLE, noisy, [0.0, 0.1], seeds=seeds)
    assert np.array_equal(found, insert_batch(NEEDLE, noisy, [0.0, 0.1], seeds=(2, 3)))
    one = SteeredNeedle(NEEDLE, noisy, seed=np.int64(3))  # type: ignore[arg-type]
    same = SteeredNeedle(NEEDLE, noisy, seed=3)
    for needle, guide in ((one, np.array([1e-3, 0.0])), (same, (1e-3, 0.0))):
        needle.move(guide=guide, tilt=0.0 * np.array(guide))
        needle.move(depth=0.1)
    assert np.array_equal(one.tip, same.tip)


@pytest.mark.parametrize(
    ('change', 'error', 'words'),
    [
        ({'depths': [[[0.0]]]}, ShapeError, r'depths must have shape \(k,\) or \(runs, k\)'),
        ({'depths': []}, ShapeError, r'depths must have shape \(k,\) or \(runs, k\)'),
        ({'depths': [0.0, 0.17]}, ParameterError, r'depths must be in \[0, 0\.16\] m'),
        ({'depths': [0.0, -0.01]}, ParameterError, r'depths must be in \[0, 0\.16\] m'),
        ({'depths': [0.0, np.nan]}, ParameterError, 'depths must be finite'),
        ({'rolls': [0.0, 1.0, 2.0]}, ShapeError, r'rolls must have shape \(2,\) or \(runs, 2\)'),
        ({'guides': [0.0, np.inf]}, ParameterError, 'guides must be finite'),
        ({'seeds': [0.5]}, ParameterError, r'seed must be an integer >= 0, got 0\.5'),
        ({'seeds': ()}, ShapeError, 'got 1 needles, 1 steering, 1 poses, 0 seeds'),
        (
            {'seeds': (1, 2), 'needles': [NEEDLE] * 3},
            ShapeError,
            'got 3 needles, 1 steering, 1 poses, 2 seeds',
        ),
        ({'workers': 0}, ParameterError, 'workers must be an integer >= 1, got 0'),
        (
            {'steering': [STEERING, SteeringParameters(path_noise_length=1e-3)]},
            ParameterError,
            'path_noise_length must be the same',
        ),
    ],
)
def test_invalid_values_are_rejected(change: dict[str, Any], error: type, words: str) -> None:
    values: dict[str, Any] = {'needles': NEEDLE, 'steering': STEERING, 'depths': [0.0, 0.1]}
    with pytest.raises(error, match=words):
        insert_batch(**values | change)


def test_needle_shorter_than_the_depth_is_rejected() -> None:
    short = NeedleParameters.preset('phantom', length=0.1)
    with pytest.raises(ParameterError, match=r'depths must be in \[0, 0\.06\] m'):
        insert_batch([NEEDLE, short], STEERING, DEPTHS)
