# SPDX-License-Identifier: Apache-2.0
"""Benchmark of batches: the step in C is the same step."""

from __future__ import annotations

from benchmarks.batches import Batches
from benchmarks.lanes_in_c import build
import numpy as np
from numpy.testing import assert_allclose
import pytest


def test_step_in_c_gives_the_same_states() -> None:
    """More needles than lanes."""
    in_c = build()
    if in_c is None:
        pytest.skip('needs a C compiler')
    batches = Batches(runs=50)
    ours = batches.compiled(None)
    # Rounding of the library functions, over two thousand steps.
    scale = np.abs(ours).max(axis=0) + 1e-300
    assert_allclose(batches.compiled(in_c) / scale, ours / scale, rtol=0.0, atol=1e-10)
    assert_allclose(ours / scale, batches.one_by_one() / scale, rtol=0.0, atol=1e-9)
