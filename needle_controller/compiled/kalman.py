# SPDX-License-Identifier: Apache-2.0
"""
Steps of a Kalman filter in which every measurement is a reading of one entry of the state.

The state is, in this order: c and b of the modes (`bending`), and slowly varying loads, which
together drive the rest; the memory of the low-pass and its reading, for each channel of the
wrench; the running mean of the tip deflection over the current exposure.
"""

from needle_dynamics.arrays import FloatArray
from needle_dynamics.compiled.cache import compiled


@compiled
def measure(
    x: FloatArray,
    covariance: FloatArray,
    index: int,
    value: float,
    variance: float,
    size: int,
    work: FloatArray,
) -> float:
    """
    Update state (N,) and covariance (N, N) with a reading of one entry, in Joseph's form.

    Corrects the first ``size`` entries; ``work``, shape (2, N), is scratch memory. Returns the
    squared innovation over its variance, 0 if both variances are 0.
    """
    own: float = covariance[index, index]
    spread: float = own + variance
    if spread <= 0.0:
        return 0.0
    column, gain = work[0], work[1]
    innovation: float = value - x[index]
    for i in range(size):
        column[i] = covariance[i, index]
        gain[i] = column[i] / spread
        x[i] += gain[i] * innovation
    for i in range(size):
        left = column[i] - gain[i] * own
        for j in range(i + 1):
            reduced = covariance[i, j] - gain[i] * column[j]
            reduced += (variance * gain[i] - left) * gain[j]
            covariance[i, j] = covariance[j, i] = reduced
    return innovation * innovation / spread


@compiled
def add_to_mean(
    x: FloatArray, covariance: FloatArray, row: FloatArray, shared: FloatArray
) -> None:
    """Add the linear form ``row`` of the first entries of the state to its last entry."""
    last = x.shape[0] - 1
    for j in range(last + 1):
        shared[j] = 0.0
        for i in range(row.shape[0]):
            shared[j] += row[i] * covariance[i, j]
    own = 2.0 * shared[last]
    for i in range(row.shape[0]):
        x[last] += row[i] * x[i]
        own += row[i] * shared[i]
    for j in range(last):
        covariance[last, j] += shared[j]
        covariance[j, last] = covariance[last, j]
    covariance[last, last] += own


@compiled
def clear_mean(x: FloatArray, covariance: FloatArray) -> None:
    """Set the last entry of the state (N,) to zero with zero variance."""
    last = x.shape[0] - 1
    x[last] = 0.0
    for j in range(last + 1):
        covariance[last, j] = covariance[j, last] = 0.0


@compiled
def _product(
    left: FloatArray, right: FloatArray, modal: int, low: int, high: int, out: FloatArray
) -> None:
    """Compute the row left[k] right[k], summed over the modes and over low to high."""
    # Sums of whole rows can be vectorized.
    out[:] = 0.0
    for m in range(modal):
        part = left[m]
        for k in range(out.shape[0]):
            out[k] += part * right[m, k]
    for m in range(low, high):
        part = left[m]
        for k in range(out.shape[0]):
            out[k] += part * right[m, k]


@compiled
def _memory(i: int, modal: int, filters: int) -> tuple[int, int]:
    """Return the range of entries that drive an entry in addition to the modes: its low-pass."""
    if i < modal:
        return 0, 0
    low = modal + (i - modal) // filters * filters
    return low, low + filters - 1


@compiled
def propagate(
    x: FloatArray,
    covariance: FloatArray,
    transition: FloatArray,
    modal: int,
    filters: int,
    size: int,
    work: FloatArray,
) -> None:
    """
    Propagate state (N,) and covariance (N, N) through a transition (N, N), in place.

    Only nonzero blocks are multiplied: modes and loads drive all entries, each low-pass drives
    itself, and its reading has no memory. ``modal`` and ``filters`` are the numbers of entries of
    modes and loads, and of each low-pass with its reading; ``size`` is N, or N - 1 while the last
    entry, which stays, is zero without variance; ``work``, shape (N + 2, N), is scratch memory.
    """
    end = modal + 2 * filters
    fresh, row, turned = work[0], work[1, :size], work[2:]
    for i in range(end):
        low, high = _memory(i, modal, filters)
        value = 0.0
        for m in range(modal):
            value += transition[i, m] * x[m]
        for m in range(low, high):
            value += transition[i, m] * x[m]
        fresh[i] = value
        _product(transition[i], covariance, modal, low, high, row)
        # Transposed, so that the second product sums rows, too.
        for k in range(size):
            turned[k, i] = row[k]
    for i in range(end):
        x[i] = fresh[i]
        low, high = _memory(i, modal, filters)
        _product(transition[i], turned[:, i:end], modal, low, high, covariance[i, i:end])
        for k in range(i, end):
            covariance[k, i] = covariance[i, k]
        for k in range(end, size):
            covariance[i, k] = covariance[k, i] = turned[k, i]
