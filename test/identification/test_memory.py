# SPDX-License-Identifier: Apache-2.0
"""Autocorrelated noise: its effect on errors is estimated from the noise."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st
from needle_dynamics import FloatArray
from needle_identification import regress
from needle_identification.estimation import memory
from needle_identification.estimation.memory import divided, Memory, memory_of
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
import pytest
from scipy.signal import lfilter
from scipy.special import ndtr

LENGTH = 10


def colored(rng: np.random.Generator, n: int, length: float) -> FloatArray:
    """Return exponentially correlated noise of variance one."""
    kept = np.exp(-1.0 / length)
    steps = np.sqrt(1.0 - kept**2) * rng.standard_normal(n)
    steps[0] = rng.standard_normal()
    return np.asarray(lfilter([1.0], [1.0, -kept], steps))


@given(used=st.lists(st.booleans(), min_size=1, max_size=200), length=st.integers(1, 40))
def test_parts_contain_each_used_sample_exactly_once(used: list[bool], length: int) -> None:
    chosen = np.array(used)
    if not chosen.any():
        return
    parts = divided(chosen, length)
    counts = np.zeros(len(chosen), dtype=int)
    for start, end in parts.limits:
        assert start < end
        counts[start:end] += 1
    assert_array_equal(counts, chosen.astype(int))
    assert_allclose(parts.sums(np.ones(len(chosen))), parts.sizes)
    # The longest part is half as long again, rounded up.
    assert parts.sizes.max() <= np.ceil(1.5 * length)


def test_a_subset_of_parts_is_sufficient_in_a_long_recording() -> None:
    """Correlation time and inflation equal the values of a recording of a tenth of the length."""
    found = []
    for n in (10_000, 100_000):
        rng = np.random.default_rng(1)
        noise = colored(rng, n, 30.0) + 0.3 * rng.standard_normal(n)
        x = np.sign(np.sin(2.0 * np.pi * np.arange(n) / 500.0))[:, np.newaxis]
        found.append(regress(x, noise, correlation=LENGTH, colored=True).memory)
        assert found[-1] is not None
    # A factor of two is one step of the grid; the short recording excludes fewer models.
    assert 10.0 < found[1].length < 90.0
    assert_allclose(found[1].inflation, found[0].inflation, rtol=0.3)


def dense(
    r: FloatArray, x: FloatArray, a: FloatArray, centers: FloatArray, white: FloatArray
) -> FloatArray:
    """Compute the inflation with dense matrices, single models, and intervals by search."""
    m, k = x.shape
    models = [(0.0, 0.0), *((-1.0, g) for g in memory._DIFFERENCES)]
    apart = np.abs(np.subtract.outer(centers, centers))
    beside = np.eye(m, k=1) + np.eye(m, k=-1)
    differences = np.eye(m) - 0.5 * np.where(apart < 1.5 * LENGTH, beside, 0.0)
    times = np.geomspace(0.5 * LENGTH, memory._LONGEST * (centers[-1] - centers[0]), memory._TIMES)
    models += [(t, g) for t in times for g in memory._RATIOS]
    logs, deviations = [], []
    for t, g in models:
        v = np.diag(white)
        if t > 0.0:
            v = v + g * np.exp(-apart / t)
        elif t < 0.0:
            v = v + g * differences
        inverse = np.linalg.inv(v)
        normal = x.T @ inverse @ x
        p = inverse - inverse @ x @ np.linalg.solve(normal, x.T @ inverse)
        scale = float(r @ p @ r) / (m - k)
        logs.append(
            -0.5
            * (
                np.linalg.slogdet(v)[1]
                + np.linalg.slogdet(normal)[1]
                + (m - k) * np.log(scale * (m - k))
            )
        )
        deviations.append(np.sqrt(scale * np.einsum('ik,ij,jk->k', a, v, a)))
    weights = np.exp(np.array(logs) - max(logs))
    weights[0] *= memory._WHITE
    few = 1 + len(memory._DIFFERENCES)
    weights[1:few] *= memory._DIFFERENCED / (few - 1)
    weights[few:] *= (1.0 - memory._WHITE - memory._DIFFERENCED) / (len(weights) - few)
    weights /= weights.sum()
    table = np.array(deviations)
    found = []
    for column in table.T:
        low, high = 0.0, 10.0 * column.max()
        for _ in range(200):
            middle = 0.5 * (low + high)
            outside = weights @ (2.0 * ndtr(-middle / column)) > 0.05
            low, high = (middle, high) if outside else (low, middle)
        found.append(high / 1.959963984540054 / column[0])
    return np.array(found)


@pytest.mark.parametrize('length', [0.0, 30.0, 1e4])
def test_the_chain_equals_the_dense_solution(length: float) -> None:
    rng = np.random.default_rng(3)
    n = 600
    used = np.ones(n, dtype=np.bool_)
    used[100:130] = used[400:415] = False
    x = np.column_stack([np.ones(n), np.sin(0.05 * np.arange(n))]) * used[:, np.newaxis]
    noise = 0.3 * rng.standard_normal(n) + (colored(rng, n, length) if length else 0.0)
    y = np.where(used, noise, 0.0)
    solution = np.linalg.lstsq(x, y, rcond=None)[0]
    influence = x @ np.linalg.inv(x.T @ x)
    residual = np.where(used, y - x @ solution, 0.0)
    parts = divided(used, LENGTH)
    found = memory_of(residual, x, influence, parts)
    expected = dense(
        parts.means(residual), parts.means(x), parts.sums(influence), parts.centers,
        parts.length / parts.sizes,
    )  # fmt: skip
    # Rounding of the sums, and omitted models with a probability below 1e-6.
    assert_allclose(found.inflation, expected, rtol=1e-4)
    assert (found.length > 0.0) == (length > 0.0)


def test_differenced_noise_reduces_errors() -> None:
    """
    Differences of white noise, as in the velocity from noisy positions.

    The mean over a part is the difference of its ends, which is small for a long part.
    """
    rng, n = np.random.default_rng(6), 20_000
    parts = divided(np.ones(n, dtype=np.bool_), LENGTH)
    # Strokes in both directions, insensitive to a slow drift.
    x = np.sign(np.sin(2.0 * np.pi * np.arange(n) / 500.0 + 0.1))[:, np.newaxis]
    steps = 5.0 * np.diff(rng.standard_normal(n + 1))
    found = memory_of(steps, x, x / n, parts)
    # Pure differences: half remains with the largest ratio of the grid.
    assert found.inflation[0] < 0.6
    assert found.length == 0.0
    white = rng.standard_normal(n)
    assert_allclose(memory_of(white, x, x / n, parts).inflation, 1.0, atol=0.1)


def test_whitened_noise_is_white() -> None:
    """Neighbors of colored noise are correlated; their innovations are not."""
    rng = np.random.default_rng(5)
    noise = colored(rng, 20_000, 60.0) + 0.5 * rng.standard_normal(20_000)
    used = np.ones(20_000, dtype=np.bool_)
    parts = divided(used, LENGTH)
    ones = np.ones((20_000, 1))
    found = memory_of(noise - noise.mean(), ones, ones / 20_000, parts)
    means = parts.means(noise)
    new = found.whitened(means, parts)
    alike = [np.corrcoef(values[:-1], values[1:])[0, 1] for values in (means, new)]
    assert alike[0] > 0.7
    # Of 2000 parts: a standard deviation of 0.022. Means of correlated noise are more correlated
    # than values (the chain models values): 0.09 here for any grid of times.
    assert abs(alike[1]) < 0.15
    white = Memory(inflation=np.ones(1), far=np.ones(1), length=0.0, ratio=0.0)
    assert_allclose(white.whitened(means, parts), means)


@pytest.mark.parametrize('length', [0.0, 20.0, 100.0, 1e5])
def test_intervals_have_their_coverage_for_any_correlation_time(length: float) -> None:
    """White noise, two correlation times, and a random walk; the window only is overconfident."""
    n, trials = 3200, 200
    slow = np.sign(np.sin(2.0 * np.pi * np.arange(n) / 400.0))
    # Equal motion in both directions, as required for friction: excludes an offset.
    x = np.column_stack([slow, slow * (1.0 + np.arange(n) % 200 / 200.0)])
    truth = np.array([0.5, 2.0])
    covered = {False: np.zeros(2), True: np.zeros(2)}
    for seed in range(trials):
        rng = np.random.default_rng(seed)
        noise = 0.1 * rng.standard_normal(n) + (colored(rng, n, length) if length else 0.0)
        y = x @ truth + noise
        for allowed in covered:
            low, high = regress(x, y, correlation=LENGTH, colored=allowed).interval().T
            covered[allowed] += (low <= truth) & (truth <= high)
    # 95 % of 200, with three standard deviations (1.5 % each), too wide for a random walk.
    assert (covered[True] / trials >= 0.9).all()
    if length == 100.0:
        assert (covered[False] / trials < 0.85).all()


def test_exact_data_and_few_data_give_white_noise() -> None:
    ones = np.ones((40, 1))
    for residual in (np.zeros(40), np.r_[1.0, np.zeros(39)]):
        few = divided(np.arange(40) < (40 if not residual.any() else 5), LENGTH)
        assert_array_equal(memory_of(residual, ones, ones / 40, few).inflation, 1.0)


def test_a_column_of_zeros_has_no_growth() -> None:
    """Such as the lag of a force that does not depend on the velocity."""
    residual = colored(np.random.default_rng(0), 2000, 20.0)
    x = np.column_stack([np.ones(2000), np.zeros(2000)])
    found = memory_of(residual, x, x / 2000, divided(np.ones(2000, dtype=np.bool_), LENGTH))
    assert found.inflation[0] > 1.0
    assert found.inflation[1] == found.far[1] == 1.0
