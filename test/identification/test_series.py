# SPDX-License-Identifier: Apache-2.0
"""A series keeps samples or their means, in bounded memory."""

from typing import Any

from hypothesis import given, settings, strategies
from needle_dynamics import FloatArray
from needle_identification.recordings import samples
from needle_identification.recordings.samples import FINEST, Series
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
from numpy.typing import NDArray
import pytest


def gathered(stamps: NDArray[np.int64], values: FloatArray, batch: int = 7) -> Series:
    made = Series(values.shape[1])
    for k in range(0, len(stamps), batch):
        made.add(stamps[k : k + batch], values[k : k + batch])
    made.compact()
    return made


@settings(max_examples=100, deadline=None)
@given(strategies.lists(strategies.integers(-(10**9), 10**9), min_size=1, max_size=50))
def test_sparse_samples_are_kept_unchanged(numbers: list[int]) -> None:
    stamps = np.array(numbers) * FINEST
    values = np.random.default_rng(0).normal(size=(len(stamps), 2))
    made = gathered(stamps, values)
    unique, first = np.unique(stamps, return_index=True)
    assert made.width == 0
    assert_array_equal(made.stamps, unique)
    assert_array_equal(made.values, values[first])
    assert made.repeated == len(stamps) - len(unique)
    assert made.late == np.count_nonzero(np.diff(stamps) < 0)


def test_dense_samples_are_averaged() -> None:
    step = 125_000
    stamps = np.arange(100_000) * step
    made = gathered(stamps, np.asarray(stamps[:, None] * 1e-9, float), batch=1000)
    assert made.width == FINEST
    assert len(made.stamps) == 100_000 * step // FINEST
    # The mean of a line is on the line, up to rounding of the stamp to 1 ns.
    assert_allclose(made.values[:, 0], made.stamps * 1e-9, rtol=0.0, atol=1e-9)


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(samples, 'MOST_SAMPLES', 64)
    monkeypatch.setattr(samples, '_GATHERED', 100)


def test_a_long_series_is_averaged_and_keeps_its_mean(small: Any) -> None:
    rng = np.random.default_rng(0)
    stamps = np.arange(5000) * 4_000_000
    values = rng.normal(size=(5000, 1))
    made = Series(1)
    for k in range(0, 5000, 50):
        made.add(stamps[k : k + 50], values[k : k + 50])
        assert len(made.stamps) <= 64
    made.compact()
    assert 20.0 / 64 < made.width * 1e-9 < 2.1 * 20.0 / 64
    # Bins start at multiples of their width: only the first and the last are incomplete.
    full = made.values[1:-1, 0]
    assert abs(full.mean() - values.mean()) < 0.02


def test_memory_is_bounded_for_any_stamps(small: Any) -> None:
    rng = np.random.default_rng(0)
    made = Series(1)
    for _ in range(50):
        stamps = rng.integers(-(2**61), 2**61, size=100)
        made.add(stamps, rng.normal(size=(100, 1)))
        assert len(made.stamps) <= 64
    made.compact()
    assert (np.diff(made.stamps) > 0).all()
