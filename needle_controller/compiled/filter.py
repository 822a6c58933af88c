"""
What the observer compiles: normal modes, their transition over a sample, the filter's step.

The state of the filter is, in this order,

- c = omega a and b = a_dot of each normal mode of the inserted part, in the norm of energy: both
  in sqrt(J), so that without damping the transition is a rotation,
- the memory of the low-pass of each channel of the wrench (lateral force, moment about the base),
  and as its last entry the reading,
- the running mean of the tip deflection over the exposure that is going on.

Every measurement is thus a single entry of the state.
"""

from __future__ import annotations

from math import cos, exp, pi, sin, sqrt

from needle_dynamics.arrays import FloatArray
from needle_dynamics.compiled.cache import compiled

# Slots of `fixed`.
DENSITY, BENDING, DAMPING, PRINTED, LENGTH = 0, 1, 2, 3, 4
#: Power of the noise force, and variances of the readings of force, moment and tip.
NOISE, FORCE_VARIANCE, MOMENT_VARIANCE, TIP_VARIANCE = 5, 6, 7, 8
#: Ticks of the force sensor in a sample, and variance of the tip deflection at the start.
TICKS, TIP_PRIOR = 9, 10
#: Variances of the white noise of force and moment before the low-pass.
FORCE_INPUT, MOMENT_INPUT = 11, 12
FIXED = 13

# Slots of `sensor`: transition over a sample, noise of both channels over a sample; as rows what
# an input of one leaves so many ticks later; and as first row what it leaves in the long run.
WHOLE, FORCE_NOISE, MOMENT_NOISE, RESPONSE, STEADY = 0, 1, 2, 3, 4
SENSOR = 5

# Slots of a row of `book` after the state; then g, omega (n each) and two changes of basis.
TIME, SPAN, LATERAL, MOMENT, NIS, DEGREES = 0, 1, 2, 3, 4, 5
HEADER = 6

# Columns of `tips`.
START, END, VALUE = 0, 1, 2

# Slots of the outputs after q and q_dot.
TIP, TIP_SPREAD, LOAD = 0, 1, 2
OUTPUTS = 3


@compiled
def _cholesky(density: float, at: FloatArray, n: int, factor: FloatArray) -> None:
    """Write the lower Cholesky factor of the modal mass rho A G."""
    for j in range(n):
        for i in range(j, n):
            value = density * at[j * n - j * (j - 1) // 2 + i - j]
            for k in range(j):
                value -= factor[i, k] * factor[j, k]
            factor[i, j] = sqrt(value) if i == j else value / factor[j, j]


@compiled
def _diagonalize(matrix: FloatArray, basis: FloatArray, n: int) -> None:
    """Diagonalize a positive definite matrix in place by Jacobi rotations; vectors in basis."""
    for i in range(n):
        for j in range(n):
            basis[i, j] = 1.0 if i == j else 0.0
    for _ in range(30):
        largest = 0.0
        for i in range(n):
            for j in range(i + 1, n):
                off = matrix[i, j]
                scale = sqrt(matrix[i, i] * matrix[j, j])
                largest = max(largest, abs(off) / scale)
                if abs(off) <= 1e-17 * scale:
                    continue
                tau = (matrix[j, j] - matrix[i, i]) / (2.0 * off)
                t = (1.0 if tau >= 0.0 else -1.0) / (abs(tau) + sqrt(1.0 + tau * tau))
                cj = 1.0 / sqrt(1.0 + t * t)
                sj = t * cj
                for k in range(n):
                    x, y = matrix[k, i], matrix[k, j]
                    matrix[k, i], matrix[k, j] = cj * x - sj * y, sj * x + cj * y
                for k in range(n):
                    x, y = matrix[i, k], matrix[j, k]
                    matrix[i, k], matrix[j, k] = cj * x - sj * y, sj * x + cj * y
                for k in range(n):
                    x, y = basis[k, i], basis[k, j]
                    basis[k, i], basis[k, j] = cj * x - sj * y, sj * x + cj * y
        if largest <= 1e-16:
            break


@compiled
def _layer(tissue: FloatArray, depth: float) -> int:
    """Return the row of ``tissue`` that holds a depth."""
    layer = 0
    while layer + 1 < tissue.shape[0] and depth >= tissue[layer + 1, 0]:
        layer += 1
    return layer


@compiled
def _normal_modes(  # noqa: C901
    fixed: FloatArray,
    tissue: FloatArray,
    at: FloatArray,
    depth: float,
    growth: float,
    basis: FloatArray,
    work: FloatArray,
) -> None:
    """
    Write the normal modes of the inserted part: q = N a with N^T rho A G N = 1.

    ``basis``, shape (2 n + 1, n), takes N, rho A G and the frequencies omega.
    """
    n = basis.shape[1]
    pairs = n * (n + 1) // 2
    layer = _layer(tissue, depth)
    ka = growth * tissue[layer, 1]
    factor, stiff, vectors = work[0], work[1], work[2]
    _cholesky(fixed[DENSITY], at, n, factor)
    pair = 0
    for i in range(n):
        for j in range(i, n):
            basis[n + i, j] = basis[n + j, i] = fixed[DENSITY] * at[pair]
            stiff[i, j] = stiff[j, i] = (
                fixed[BENDING] * at[pairs + pair]
                + ka * at[pair]
                + growth * tissue[layer, 2 + pair]
            )
            pair += 1
    # L^-1 K L^-T, by columns and then by rows.
    for k in range(n):
        for i in range(n):
            value = stiff[i, k]
            for j in range(i):
                value -= factor[i, j] * stiff[j, k]
            stiff[i, k] = value / factor[i, i]
    for k in range(n):
        for i in range(n):
            value = stiff[k, i]
            for j in range(i):
                value -= factor[i, j] * stiff[k, j]
            stiff[k, i] = value / factor[i, i]
    for i in range(n):
        for j in range(i):
            stiff[i, j] = stiff[j, i] = 0.5 * (stiff[i, j] + stiff[j, i])
    _diagonalize(stiff, vectors, n)
    for i in range(n):
        # Ascending, so that a mode keeps its place while the depth changes.
        least = i
        for k in range(i + 1, n):
            if stiff[k, k] < stiff[least, least]:
                least = k
        if least != i:
            stiff[i, i], stiff[least, least] = stiff[least, least], stiff[i, i]
            for k in range(n):
                vectors[k, i], vectors[k, least] = vectors[k, least], vectors[k, i]
    for k in range(n):
        basis[2 * n, k] = sqrt(stiff[k, k])
        for i in range(n - 1, -1, -1):
            value = vectors[i, k]
            for j in range(i + 1, n):
                value -= factor[j, i] * basis[j, k]
            basis[i, k] = value / factor[i, i]


@compiled
def _change(
    fixed: FloatArray, old: FloatArray, new: FloatArray, by_c: FloatArray, by_b: FloatArray
) -> None:
    """
    Write how c and b change from one basis to another at once; turn the new modes the old way.

    q and the momenta rho A G q_dot (as printed, the rates) go on as they are.
    """
    n = new.shape[1]
    for i in range(n):
        for attempt in range(2):
            for k in range(n):
                same_q, same_p = 0.0, 0.0
                for j in range(n):
                    new_m, old_m = 0.0, 0.0
                    for m in range(n):
                        new_m += new[m, i] * new[n + m, j]
                        old_m += new[m, i] * old[n + m, j]
                    same_q += new_m * old[j, k]
                    same_p += old_m * old[j, k]
                by_c[i, k] = same_q * new[2 * n, i] / old[2 * n, k]
                by_b[i, k] = same_q if fixed[PRINTED] != 0.0 else same_p
            if attempt == 1 or by_c[i, i] >= 0.0:
                break
            for m in range(n):
                new[m, i] = -new[m, i]


@compiled
def _means(rate: float, since: float, until: float) -> tuple[float, float]:
    """Return the means of cos(rate t) and sin(rate t) over a time."""
    middle, half = 0.5 * rate * (since + until), 0.5 * rate * (until - since)
    # The next term is below 1e-18.
    mean = sin(half) / half if abs(half) > 1e-4 else 1.0 - half * half / 6.0
    return mean * cos(middle), mean * sin(middle)


@compiled
def _settle(
    by_c: float, by_b: float, one: float, other: float, since: float, until: float
) -> tuple[float, float, float, float]:
    """
    Spread a small change diag(by_c, by_b) of basis over a time in which the modes turn.

    Depth changes evenly, not at once: what mode ``other`` gives to ``one``, of these
    frequencies, is the mean over the rotation in between. Slow modes do not turn and take the
    change as it is; of fast ones only the part remains that keeps the action energy / omega.
    Returned as (c by c, c by b, b by c, b by b).
    """
    turn, mirror = 0.5 * (by_c + by_b), 0.5 * (by_c - by_b)
    cos_d, sin_d = _means(other - one, since, until)
    cos_s, sin_s = _means(other + one, since, until)
    return (
        turn * cos_d + mirror * cos_s,
        turn * sin_d + mirror * sin_s,
        mirror * sin_s - turn * sin_d,
        turn * cos_d - mirror * cos_s,
    )


@compiled
def _swing(omega: float, rate: float, t: float) -> tuple[float, float, float, float]:
    """
    Return the transition of c_dot = omega b, b_dot = -omega c - rate b over a time t.

    Returned as (c by c, c by b, b by c, b by b).
    """
    half = 0.5 * rate
    square = omega * omega - half * half
    reach = square * t * t
    if abs(reach) < 1e-6:
        # Near critical damping, or a short time: the next terms are below 1e-14.
        even = (1.0 - 0.5 * reach) * exp(-half * t)
        odd = t * (1.0 - reach / 6.0) * exp(-half * t)
    elif square > 0.0:
        turn = sqrt(square)
        fall = exp(-half * t)
        even, odd = fall * cos(turn * t), fall * sin(turn * t) / turn
    else:
        turn = sqrt(-square)
        # omega^2 / (half + turn) is half - turn without cancellation.
        slow, fast = exp(-omega * omega / (half + turn) * t), exp(-(half + turn) * t)
        even, odd = 0.5 * (slow + fast), 0.5 * (slow - fast) / turn
    return even + half * odd, omega * odd, -omega * odd, even - half * odd


@compiled
def _reaction(
    fixed: FloatArray,
    tissue: FloatArray,
    at: FloatArray,
    basis: FloatArray,
    depth: float,
    speed: float,
    growth: float,
    rows: FloatArray,
) -> None:
    """
    Write the impulse of the base's lateral force and moment per change of c and b.

    Balance of momentum over the inserted part, as in `NeedleModel.base_reaction`: the integral
    of the state over a time is what its change over that time says. ``rows`` is (2, 2 n).
    """
    n = basis.shape[1]
    pairs = n * (n + 1) // 2
    layer = _layer(tissue, depth)
    ka, rho, damping = growth * tissue[layer, 1], fixed[DENSITY], fixed[DAMPING]
    rate = damping / rho
    for channel in range(2):
        first = 2 * pairs + 2 * n + channel * n
        above = 2 + pairs + channel * n
        # What enters brings the momentum of the tip, and the inserted part is slowed by it.
        entering = rho * speed * (1.0 if channel == 0 else depth)
        if fixed[PRINTED] == 0.0:
            for k in range(n):
                area, tip = 0.0, 0.0
                for i in range(n):
                    area += at[first + i] * basis[i, k]
                    tip += at[2 * pairs + i] * basis[i, k]
                entering -= rho * rho * speed * area * tip
        for k in range(n):
            inertia, held, carried = 0.0, 0.0, 0.0
            for i in range(n):
                shape = basis[i, k]
                inertia += rho * at[first + i] * shape
                held += (ka * at[first + i] + growth * tissue[layer, above + i]) * shape
                carried += (damping * at[first + i] + entering * at[2 * pairs + i]) * shape
            omega = basis[2 * n, k]
            compliance = held / (omega * omega)
            rows[channel, k] = (carried - compliance * rate) / omega
            rows[channel, n + k] = inertia - compliance
    outside = fixed[LENGTH] - depth
    for k in range(2 * n):
        rows[1, k] += outside * rows[0, k]


@compiled
def begin(
    fixed: FloatArray,
    sensor: FloatArray,
    tissue: FloatArray,
    at: FloatArray,
    basis: FloatArray,
    pairs: FloatArray,
    book: FloatArray,
    work: FloatArray,
    slot: int,
    time: float,
    span: float,
    depth: float,
    growth: float,
) -> None:
    """
    Write the state before any measurement into a slot.

    Every c and b has the same variance: the one that gives the tip its variance. What the memory
    of the low-pass holds is a constant and a white wrench as large as such a needle exerts.
    """
    n, filters = basis.shape[1], sensor.shape[2]
    modal, tip = 2 * n, n * (n + 1)
    _normal_modes(fixed, tissue, at, depth, growth, basis, work)
    _reaction(fixed, tissue, at, basis, depth, 0.0, growth, work[3])
    share = 0.0
    for k in range(n):
        value = 0.0
        for i in range(n):
            value += at[tip + i] * basis[i, k]
        share += (value / basis[2 * n, k]) ** 2
    variance = fixed[TIP_PRIOR] / share
    book[slot] = 0.0
    size = pairs.shape[2]
    book[slot, size + TIME] = time
    covariance = pairs[slot, 0]
    covariance[:] = 0.0
    for i in range(modal):
        covariance[i, i] = variance
    tick = span / fixed[TICKS]
    for channel in range(2):
        reaction = 0.0
        for k in range(n):
            omega = basis[2 * n, k]
            cc, cb, bc, bb = _swing(omega, fixed[DAMPING] / fixed[DENSITY], tick)
            c, b = work[3, channel, k], work[3, channel, n + k]
            reaction += (c * (cc - 1.0) + b * bc) ** 2 + (c * cb + b * (bb - 1.0)) ** 2
        reaction *= variance / (tick * tick)
        first = modal + channel * filters
        noise = fixed[FORCE_INPUT + channel]
        for i in range(filters):
            covariance[first + i, first + i] += noise + reaction
            for j in range(filters):
                held = sensor[STEADY, 0, i] * sensor[STEADY, 0, j]
                covariance[first + i, first + j] += reaction * held


@compiled
def _prepare(  # noqa: C901
    fixed: FloatArray,
    sensor: FloatArray,
    tissue: FloatArray,
    at: FloatArray,
    basis: FloatArray,
    transition: FloatArray,
    page: FloatArray,
    work: FloatArray,
    span: float,
    depth: float,
    speed: float,
    growth: float,
    moved: bool,
) -> None:
    """
    Write the transition over one sample, frozen at its mean depth, and renew the basis.

    ``page`` takes the tip's share in c, the frequencies, and the changes of basis of c and b.
    """
    n, filters = basis.shape[1], sensor.shape[2]
    modal, tip, square = 2 * n, n * (n + 1), n * n
    rate = fixed[DAMPING] / fixed[DENSITY]
    to_c, to_b = work[4], work[5]
    if moved:
        old = work[6, :, :n]
        for i in range(modal + 1):
            for k in range(n):
                old[i, k] = basis[i, k]
        _normal_modes(fixed, tissue, at, depth, growth, basis, work)
        _change(fixed, old, basis, to_c, to_b)
        for i in range(n):
            for k in range(n):
                same = 1.0 if i == k else 0.0
                cc, _, _, bb = _settle(
                    to_c[i, k] - same, to_b[i, k] - same, basis[modal, i], basis[modal, k],
                    -0.5 * span, 0.5 * span,
                )  # fmt: skip
                to_c[i, k], to_b[i, k] = same + cc, same + bb
    else:
        for i in range(n):
            for k in range(n):
                to_c[i, k] = to_b[i, k] = 1.0 if i == k else 0.0
    for k in range(n):
        value = 0.0
        for i in range(n):
            value += at[tip + i] * basis[i, k]
        page[k] = value / basis[modal, k]
        page[n + k] = basis[modal, k]
        for i in range(n):
            page[modal + i * n + k] = to_c[i, k]
            page[modal + square + i * n + k] = to_b[i, k]

    transition[:] = 0.0
    for i in range(n):
        cc, cb, bc, bb = _swing(basis[modal, i], rate, span)
        for k in range(n):
            transition[i, k] = cc * to_c[i, k]
            transition[i, n + k] = cb * to_b[i, k]
            transition[n + i, k] = bc * to_c[i, k]
            transition[n + i, n + k] = bb * to_b[i, k]
    rows, drive = work[3], work[0]
    _reaction(fixed, tissue, at, basis, depth, speed, growth, rows)
    ticks = int(fixed[TICKS])
    tick = span / ticks
    for i in range(2 * filters):
        for k in range(modal):
            drive[i, k] = 0.0
    for k in range(n):
        cc, cb, bc, bb = _swing(basis[modal, k], rate, tick)
        for channel in range(2):
            # The mean over a tick is what the change of the state over it makes of it.
            c, b = rows[channel, k] / tick, rows[channel, n + k] / tick
            by_c, by_b = c * (cc - 1.0) + b * bc, c * cb + b * (bb - 1.0)
            for count in range(ticks):
                for i in range(filters):
                    left = sensor[RESPONSE, ticks - 1 - count, i]
                    drive[channel * filters + i, k] += left * by_c
                    drive[channel * filters + i, n + k] += left * by_b
                by_c, by_b = by_c * cc + by_b * bc, by_c * cb + by_b * bb
    for channel in range(2):
        own, first = channel * filters, modal + channel * filters
        for i in range(filters):
            for k in range(n):
                by_c, by_b = 0.0, 0.0
                for j in range(n):
                    by_c += drive[own + i, j] * to_c[j, k]
                    by_b += drive[own + i, n + j] * to_b[j, k]
                transition[first + i, k] = by_c
                transition[first + i, n + k] = by_b
            for j in range(filters):
                transition[first + i, first + j] = sensor[WHOLE, i, j]


@compiled
def _measure(
    x: FloatArray,
    covariance: FloatArray,
    index: int,
    value: float,
    variance: float,
    size: int,
    work: FloatArray,
) -> float:
    """Take in a reading of one entry of the state, in Joseph's form; return its NIS."""
    spread: float = covariance[index, index] + variance
    if spread <= 0.0:
        return 0.0
    column, gain = work[0], work[1]
    own = covariance[index, index]
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
def _expose(
    fixed: FloatArray,
    x: FloatArray,
    covariance: FloatArray,
    page: FloatArray,
    n: int,
    start: float,
    end: float,
    exposure: float,
    work: FloatArray,
) -> None:
    """Add a part of the sample, times from its start, to the running mean of the tip."""
    modal, square = 2 * n, n * n
    last = x.shape[0] - 1
    rate = fixed[DAMPING] / fixed[DENSITY]
    row, shared, fresh = work[0], work[1], work[2]
    for k in range(n):
        omega = page[n + k]
        c1, c2, c3, c4 = _swing(omega, rate, start)
        e1, e2, e3, e4 = _swing(omega, rate, end)
        share = -page[k] / (omega * exposure)
        fresh[k] = share * (e3 - c3 + rate / omega * (e1 - c1))
        fresh[n + k] = share * (e4 - c4 + rate / omega * (e2 - c2))
    for k in range(n):
        row[k], row[n + k] = 0.0, 0.0
        for i in range(n):
            row[k] += fresh[i] * page[modal + i * n + k]
            row[n + k] += fresh[n + i] * page[modal + square + i * n + k]
    for j in range(last + 1):
        shared[j] = 0.0
        for i in range(modal):
            shared[j] += row[i] * covariance[i, j]
    own = 2.0 * shared[last]
    for i in range(modal):
        x[last] += row[i] * x[i]
        own += row[i] * shared[i]
    for j in range(last):
        covariance[last, j] += shared[j]
        covariance[j, last] = covariance[last, j]
    covariance[last, last] += own


@compiled
def _forget(x: FloatArray, covariance: FloatArray) -> None:
    """Start the running mean of the tip anew."""
    last = x.shape[0] - 1
    x[last] = 0.0
    for j in range(last + 1):
        covariance[last, j] = covariance[j, last] = 0.0


@compiled
def _propagate(  # noqa: C901
    x: FloatArray,
    covariance: FloatArray,
    transition: FloatArray,
    modal: int,
    filters: int,
    size: int,
    work: FloatArray,
) -> None:
    """Take state and covariance through the transition, in place; the last entry stays."""
    # Rows of both are added up, which the processor does several entries at a time.
    turned, fresh = work[0], work[1, 0]
    end = modal + 2 * filters
    for i in range(end):
        # Modes drive the low-pass of both channels; its reading is not remembered.
        low = modal + (i - modal) // filters * filters if i >= modal else 0
        high = low + filters - 1 if i >= modal else 0
        value = 0.0
        row = work[2, 0]
        for k in range(size):
            row[k] = 0.0
        for m in range(modal):
            part = transition[i, m]
            value += part * x[m]
            for k in range(size):
                row[k] += part * covariance[m, k]
        for m in range(low, high):
            part = transition[i, m]
            value += part * x[m]
            for k in range(size):
                row[k] += part * covariance[m, k]
        fresh[i] = value
        for k in range(size):
            turned[k, i] = row[k]
    for i in range(end):
        x[i] = fresh[i]
        low = modal + (i - modal) // filters * filters if i >= modal else 0
        high = low + filters - 1 if i >= modal else 0
        row = covariance[i]
        for k in range(i, end):
            row[k] = 0.0
        for m in range(modal):
            part = transition[i, m]
            for k in range(i, end):
                row[k] += part * turned[m, k]
        for m in range(low, high):
            part = transition[i, m]
            for k in range(i, end):
                row[k] += part * turned[m, k]
        for k in range(i, end):
            covariance[k, i] = row[k]
        for k in range(end, size):
            covariance[i, k] = covariance[k, i] = turned[k, i]


@compiled
def _advance(  # noqa: C901
    fixed: FloatArray,
    sensor: FloatArray,
    pairs: FloatArray,
    book: FloatArray,
    tips: FloatArray,
    count: int,
    work: FloatArray,
    old: int,
    new: int,
) -> None:
    """Fill the slot ``new`` from the slot ``old``, with what was measured in between."""
    size, filters = pairs.shape[2], sensor.shape[2]
    modal = size - 1 - 2 * filters
    n = modal // 2
    last = size - 1
    x, covariance = book[new, :size], pairs[new, 0]
    for i in range(size):
        x[i] = book[old, i]
        for j in range(size):
            covariance[i, j] = pairs[old, 0, i, j]
    header = book[new, size:]
    t0, t1, span = book[old, size + TIME], header[TIME], header[SPAN]
    # White noise of the sample, half of it at either end: the trapezoidal rule.
    kick = 0.5 * span * fixed[NOISE] / fixed[DENSITY]
    for k in range(n, modal):
        covariance[k, k] += kick
    nis, degrees = 0.0, 0.0
    for w in range(count):
        start, end = tips[w, START], tips[w, END]
        if end <= t0:
            continue
        if start >= t1:
            break
        if start >= t0:
            _forget(x, covariance)
        pace = span / (t1 - t0)
        since, until = max(start - t0, 0.0) * pace, min(end - t0, t1 - t0) * pace
        _expose(
            fixed, x, covariance, header[HEADER:], n, since, until, (end - start) * pace, work[0]
        )
        if end <= t1:
            nis += _measure(
                x, covariance, last, tips[w, VALUE], fixed[TIP_VARIANCE], size, work[0]
            )
            degrees += 1.0
            _forget(x, covariance)
    used = size if covariance[last, last] > 0.0 else last
    _propagate(x, covariance, pairs[new, 1], modal, filters, used, work)
    for channel in range(2):
        first = modal + channel * filters
        for i in range(filters):
            for j in range(filters):
                covariance[first + i, first + j] += sensor[FORCE_NOISE + channel, i, j]
    for channel in range(2):
        reading = header[LATERAL + channel]
        # A reading that is missing is not a number.
        if reading == reading:
            index = modal + (channel + 1) * filters - 1
            variance = fixed[FORCE_VARIANCE + channel]
            nis += _measure(x, covariance, index, reading, variance, used, work[0])
            degrees += 1.0
    for k in range(n, modal):
        covariance[k, k] += kick
    header[NIS], header[DEGREES] = nis, degrees


@compiled
def observe(
    fixed: FloatArray,
    sensor: FloatArray,
    tissue: FloatArray,
    at: FloatArray,
    basis: FloatArray,
    pairs: FloatArray,
    book: FloatArray,
    tips: FloatArray,
    work: FloatArray,
    count: int,
    old: int,
    new: int,
    time: float,
    span: float,
    depth: float,
    speed: float,
    growth: float,
    moved: bool,
    lateral: float,
    moment: float,
) -> None:
    """
    Take in one sample: from the slot ``old`` to ``new``, at mean depth and speed between them.

    Parameters
    ----------
    fixed : ndarray, shape (FIXED,)
        Constants.
    sensor : ndarray, shape (SENSOR, f, f)
        Low-pass of the wrench.
    tissue : ndarray, shape (layers, 2 + pairs + 2 n)
        Start and stiffness of each layer, and what those above add.
    at : ndarray, shape (n (n + 1) + 4 n,)
        `ModeShapes.packed` at ``depth``.
    basis : ndarray, shape (2 n + 1, n)
        Normal modes of the last sample; renewed if the depth has ``moved``.
    pairs : ndarray, shape (slots, 2, N, N)
        Covariance, and transition from the slot before.
    book : ndarray, shape (slots, N + HEADER + 2 n + 2 n^2)
        State and what goes with it.
    tips : ndarray, shape (m, 3)
        Exposures of the tip in order: start, end, mean. ``count`` of them are valid.
    work : ndarray, shape (7, N, N)
        Scratch.
    count, old, new : int
        As above.
    time, span : float
        Time of the new slot and length of the sample [s].
    depth, speed, growth : float
        Means over the sample; growth of the tissue's stiffness.
    moved : bool
        Whether the depth or the growth differs from that of the basis.
    lateral, moment : float
        Readings, not a number where missing.

    """
    header = book[new, pairs.shape[2] :]
    header[TIME], header[SPAN] = time, span
    header[LATERAL], header[MOMENT] = lateral, moment
    _prepare(
        fixed, sensor, tissue, at, basis, pairs[new, 1], header[HEADER:], work, span, depth,
        speed, growth, moved,
    )  # fmt: skip
    _advance(fixed, sensor, pairs, book, tips, count, work, old, new)


@compiled
def replay(
    fixed: FloatArray,
    sensor: FloatArray,
    pairs: FloatArray,
    book: FloatArray,
    tips: FloatArray,
    work: FloatArray,
    count: int,
    oldest: int,
    newest: int,
    since: float,
) -> None:
    """Fill the slots after the last one that is not later than ``since`` once more."""
    slots, size = pairs.shape[0], pairs.shape[2]
    slot = newest
    while slot != oldest and book[slot, size + TIME] > since:
        slot = slot - 1 if slot > 0 else slots - 1
    while slot != newest:
        following = slot + 1 if slot + 1 < slots else 0
        _advance(fixed, sensor, pairs, book, tips, count, work, slot, following)
        slot = following


@compiled
def outputs(  # noqa: C901
    fixed: FloatArray,
    tissue: FloatArray,
    at: FloatArray,
    basis: FloatArray,
    x: FloatArray,
    covariance: FloatArray,
    work: FloatArray,
    depth: float,
    growth: float,
    span: float,
    present: FloatArray,
    jacobian: FloatArray,
    out: FloatArray,
) -> None:
    """
    Return to the source's coordinates at the present depth, half a sample after the mean one.

    ``present`` takes the normal modes there and ``jacobian``, shape (2 n, 2 n), the derivatives
    of q and q_dot by c and b; ``out`` takes q, q_dot, the tip deflection, its standard deviation
    and the load against insertion, the row of d of the bias forces (13) with its sign turned, of
    the modes below half the sample rate.
    """
    n = basis.shape[1]
    modal, tip = 2 * n, n * (n + 1)
    _normal_modes(fixed, tissue, at, depth, growth, present, work)
    to_c, to_b, turned = work[4], work[5], work[3]
    _change(fixed, basis, present, to_c, to_b)
    for i in range(n):
        for k in range(n):
            same = 1.0 if i == k else 0.0
            cc, cb, bc, bb = _settle(
                to_c[i, k] - same, to_b[i, k] - same, present[modal, i], present[modal, k],
                -0.5 * span, 0.0,
            )  # fmt: skip
            turned[i, k], turned[i, n + k] = same + cc, cb
            turned[n + i, k], turned[n + i, n + k] = bc, same + bb
    for i in range(n):
        for k in range(modal):
            jacobian[i, k], jacobian[n + i, k] = 0.0, 0.0
            for j in range(n):
                jacobian[i, k] += present[i, j] / present[modal, j] * turned[j, k]
                jacobian[n + i, k] += present[i, j] * turned[n + j, k]
    for i in range(modal):
        out[i] = 0.0
        for k in range(modal):
            out[i] += jacobian[i, k] * x[k]
    bend, slow, rate, deflection, variance = 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(n):
        deflection += at[tip + i] * out[i]
    for j in range(n):
        omega = present[modal, j]
        if omega * span >= pi:
            # Samples do not tell it from a slower one: its square would be that of noise.
            continue
        c, b = 0.0, 0.0
        for k in range(modal):
            c += turned[j, k] * x[k]
            b += turned[n + j, k] * x[k]
        for i in range(n):
            slow += at[tip + i] * present[i, j] * c / omega
            bend += at[tip + n + i] * present[i, j] * c / omega
            rate += at[tip + i] * present[i, j] * b
    row = work[1, 0]
    for k in range(modal):
        row[k] = 0.0
        for i in range(n):
            row[k] += at[tip + i] * jacobian[i, k]
    for k in range(modal):
        for m in range(modal):
            variance += row[k] * covariance[k, m] * row[m]
    out[modal + TIP] = deflection
    out[modal + TIP_SPREAD] = sqrt(max(variance, 0.0))
    out[modal + LOAD] = 0.0
    if fixed[PRINTED] == 0.0:
        ka = growth * tissue[_layer(tissue, depth), 1]
        out[modal + LOAD] = 0.5 * (
            fixed[BENDING] * bend * bend + ka * slow * slow - fixed[DENSITY] * rate * rate
        )
