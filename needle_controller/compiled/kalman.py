"""
Steps of a Kalman filter in which every measurement is a reading of one entry of the state.

The state is, in this order: c and b of the modes (`bending`), and loads that change slowly, which
together drive all the rest; of each channel of the wrench the
memory of its low-pass and, last, its reading; the running mean of the tip deflection over the
exposure that is going on.
"""

from __future__ import annotations

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
    Take in a reading of one entry of the state, in Joseph's form.

    Parameters
    ----------
    x : ndarray, shape (N,)
        State; overwritten.
    covariance : ndarray, shape (N, N)
        Its covariance; overwritten.
    index : int
        Entry that was read.
    value, variance : float
        Reading, and variance of its error.
    size : int
        Number of entries to correct; those after them are left alone.
    work : ndarray, shape (2, N)
        Scratch.

    Returns
    -------
    float
        The squared innovation over its variance; 0 if both variances are 0.

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
    """
    Add a linear form of the first entries of the state to its last entry.

    Parameters
    ----------
    x : ndarray, shape (N,)
        State; overwritten.
    covariance : ndarray, shape (N, N)
        Its covariance; overwritten.
    row : ndarray, shape (m,)
        The linear form, of the first m entries.
    shared : ndarray, shape (N,)
        Scratch.

    """
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
    """
    Set the last entry of the state to zero, exactly known.

    Parameters
    ----------
    x : ndarray, shape (N,)
        State; overwritten.
    covariance : ndarray, shape (N, N)
        Its covariance; overwritten.

    """
    last = x.shape[0] - 1
    x[last] = 0.0
    for j in range(last + 1):
        covariance[last, j] = covariance[j, last] = 0.0


@compiled
def _product(
    left: FloatArray, right: FloatArray, modal: int, low: int, high: int, out: FloatArray
) -> None:
    """Write the row left[k] right[k], summed over the modes and over low to high."""
    # Whole rows are added up: the processor does several entries at a time.
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
    """Return which entries, beside the modes, drive an entry: the memory of its low-pass."""
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
    Take state and covariance through a transition, in place.

    Only what can differ from zero is multiplied: modes and loads drive everything, each low-pass
    drives itself, and its reading is not remembered.

    Parameters
    ----------
    x : ndarray, shape (N,)
        State; overwritten.
    covariance : ndarray, shape (N, N)
        Its covariance; overwritten.
    transition : ndarray, shape (N, N)
        Transition; the last entry of the state stays as it is.
    modal, filters : int
        Number of entries of modes and loads, and of each low-pass with its reading.
    size : int
        N, or N - 1 while the last entry is zero and exactly known.
    work : ndarray, shape (N + 2, N)
        Scratch.

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
        # Transposed, so that the second product adds up rows, too.
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
