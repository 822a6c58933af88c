"""
Everything that is compiled: integrals of the modes, friction and modal flow, step, force sensor.

One file for all: Numba keeps machine code on disk and renews it when the file of the function
changes, but not when that of a function which it calls does.
"""

from __future__ import annotations

from math import ceil, cos, exp, expm1, inf, log1p, nan, sin, sqrt, tanh
from typing import Final, NamedTuple

from needle_dynamics.arrays import FloatArray
from needle_dynamics.compiled.cache import compiled
import numpy as np

#: Friction laws by number: set-valued Coulomb, set-valued Stribeck, smooth tanh.
COULOMB: Final = 0
STRIBECK: Final = 1
TANH: Final = 2

#: Below this argument k_i s the series of a mode is used, above it the closed form.
SERIES_END: Final = 2.0

#: Resolution of `ModeShapes.terms` in the relative inserted length.
TERMS_PER_LENGTH: Final = 32

#: Relative inserted length from which on graded steps grow in proportion to it.
GRADED_FROM: Final = 0.1

# Slots of the running sums of `advance`.
SUM_TIP: Final = 0
#: Impulse of the tissue's reaction along z, and its moment about the entry point.
SUM_REACTION: Final = 1
SUM_REACTION_MOMENT: Final = 2
SUM_FRICTION_WORK: Final = 3
SUM_DAMPING_WORK: Final = 4
SUM_INPUT_WORK: Final = 5
#: Impulse of the base on the needle that a moved base takes, without that of its inertia.
SUM_RESISTANCE: Final = 6
#: Energy lost on the hub, and time of the last contact from the start [s] (-1 for none).
SUM_IMPACT: Final = 7
SUM_CONTACT: Final = 8
#: Integral of the curvature at the tip.
SUM_BEND: Final = 9
SUMS: Final = 10


class Constants(NamedTuple):
    """What the compiled step needs of `NeedleParameters`."""

    length: float
    linear_density: float
    bending_stiffness: float
    tissue_damping: float
    moving_mass: float
    rotary_inertia: float
    minimum_depth: float
    maximum_depth: float
    hub_stop: bool
    as_printed: bool
    friction_law: int
    coulomb: float
    viscous: float
    withdrawal: float
    breakaway: float
    stribeck_speed: float
    smoothing_speed: float
    swelling: float
    swelling_time: float
    carriage_mass: float


class Tables(NamedTuple):
    """The arrays that go with `Constants`; apart, since passing arrays on is not free."""

    #: `ModeShapes.series`, `ModeShapes.terms` and `ModeShapes.constants`.
    series: FloatArray
    terms: FloatArray
    modes: FloatArray
    #: Depths at which the layers begin, the first 0, and their stiffness; each shape (m,).
    layer_start: FloatArray
    layer_stiffness: FloatArray
    #: What the layers above add to k G, k int phi and k int y phi; shape (m, pairs + 2 n).
    layer_offset: FloatArray


@compiled
def evaluate(
    xi: float, table: FloatArray, terms: FloatArray, work: FloatArray, out: FloatArray
) -> None:
    """
    Evaluate the series of two modes at the relative inserted length.

    Parameters
    ----------
    xi : float
        s / l.
    table : ndarray, shape (terms, 34)
        `ModeShapes.series`.
    terms : ndarray
        `ModeShapes.terms`: how many of them the depth needs.
    work : ndarray, shape (34,) or longer
        Scratch.
    out : ndarray, shape (14,)
        Overwritten with G (11, 12, 22), H (11, 12, 22), phi, phi'', the integral of phi and that
        of y phi, two each.

    """
    square = xi * xi
    z = square * square
    last = int(terms[int(xi * TERMS_PER_LENGTH)]) - 1
    for j in range(34):
        work[j] = table[last, j]
    for m in range(last - 1, -1, -1):
        for j in range(34):
            work[j] = work[j] * z + table[m, j]
    for pair in range(3):
        g, h = 3 * pair, 9 + 3 * pair
        out[pair] = z * xi * (work[g] + xi * work[g + 1] + square * work[g + 2])
        out[3 + pair] = xi * (work[h] + xi * work[h + 1] + square * work[h + 2])
    for i in range(2):
        j = 18 + 2 * i
        out[6 + i] = square * (work[j] + xi * work[j + 1])
        out[8 + i] = work[j + 4] + xi * work[j + 5]
        out[10 + i] = square * xi * (work[j + 8] + xi * work[j + 9])
        out[12 + i] = z * (work[j + 12] + xi * work[j + 13])


@compiled
def mode_derivatives(
    x: float, ratio: float, rest: float, end: float
) -> tuple[float, float, float, float]:
    """
    Return phi and its first three derivatives, over c_i k_i^order, at the argument x = k_i y.

    The growing exponentials of (11) nearly cancel: ``rest`` = (mu_i - 1) exp(k_i l) is what is
    left of them at the end = k_i l, so that no mode is too high.
    """
    sine, cosine = sin(x), cos(x)
    grow = 0.5 * rest * exp(x - end)
    fall = 0.5 * (ratio + 1.0) * exp(-x)
    return (
        sine - ratio * cosine + grow + fall,
        cosine + ratio * sine + grow - fall,
        -sine + ratio * cosine + grow + fall,
        -cosine - ratio * sine + grow - fall,
    )


@compiled
def evaluate_many(
    xi: float,
    length: float,
    modes: FloatArray,
    table: FloatArray,
    work: FloatArray,
    out: FloatArray,
) -> None:
    """
    Evaluate what `evaluate` does for any number of modes n.

    Pairs of modes with small arguments come from the series, which does not cancel there, the
    others from the boundary values of the antiderivatives: the fourth derivative of a mode is
    k^4 times the mode.

    Parameters
    ----------
    xi : float
        s / l.
    length : float
        Needle length l [m].
    modes : ndarray, shape (4, n)
        `ModeShapes.constants`.
    table : ndarray, shape (terms, columns)
        `ModeShapes.series`.
    work : ndarray, shape (columns + 4 n,)
        Scratch.
    out : ndarray, shape (n (n + 1) + 4 n,)
        Overwritten with G and H (upper triangles by rows), phi, phi'', the integral of phi and
        that of y phi.

    """
    n = modes.shape[1]
    pairs = n * (n + 1) // 2
    columns = table.shape[1]
    square = xi * xi
    z = square * square
    last = table.shape[0] - 1
    for j in range(columns):
        work[j] = table[last, j]
    for m in range(last - 1, -1, -1):
        for j in range(columns):
            work[j] = work[j] * z + table[m, j]
    s = xi * length
    for i in range(n):
        end, ratio, rest, scale = modes[0, i], modes[1, i], modes[2, i], modes[3, i]
        k = end / length
        p0, p1, p2, p3 = mode_derivatives(end * xi, ratio, rest, end)
        d = columns + 4 * i
        work[d] = scale * p0
        work[d + 1] = scale * k * p1
        work[d + 2] = scale * k * k * p2
        work[d + 3] = scale * k * k * k * p3
        at = 2 * pairs + i
        j = 6 * pairs + 2 * i
        if end * xi < SERIES_END:
            out[at] = square * (work[j] + xi * work[j + 1])
            out[at + n] = work[j + 2 * n] + xi * work[j + 2 * n + 1]
            out[at + 2 * n] = square * xi * (work[j + 4 * n] + xi * work[j + 4 * n + 1])
            out[at + 3 * n] = z * (work[j + 6 * n] + xi * work[j + 6 * n + 1])
        else:
            k4 = k * k * k * k
            # At the clamped end the second derivative is 2 c mu k^2 and the third -2 c k^3.
            out[at] = work[d]
            out[at + n] = work[d + 2]
            out[at + 2 * n] = (work[d + 3] + 2.0 * scale * k * k * k) / k4
            out[at + 3 * n] = (s * work[d + 3] - work[d + 2] + 2.0 * ratio * scale * k * k) / k4
    pair = 0
    for i in range(n):
        a0, a1 = work[columns + 4 * i], work[columns + 4 * i + 1]
        a2, a3 = work[columns + 4 * i + 2], work[columns + 4 * i + 3]
        ki4 = (modes[0, i] / length) ** 4
        for j in range(i, n):
            if modes[0, j] * xi < SERIES_END:
                g, h = 3 * pair, 3 * (pairs + pair)
                out[pair] = z * xi * (work[g] + xi * work[g + 1] + square * work[g + 2])
                out[pairs + pair] = xi * (work[h] + xi * work[h + 1] + square * work[h + 2])
            else:
                b0, b1 = work[columns + 4 * j], work[columns + 4 * j + 1]
                b2, b3 = work[columns + 4 * j + 2], work[columns + 4 * j + 3]
                if i == j:
                    whole = s * (ki4 * a0 * a0 + a2 * a2 - 2.0 * a1 * a3)
                    out[pair] = (whole - a1 * a2 + 3.0 * a0 * a3) / (4.0 * ki4)
                else:
                    kj4 = (modes[0, j] / length) ** 4
                    out[pair] = (a3 * b0 - a2 * b1 + a1 * b2 - a0 * b3) / (ki4 - kj4)
                out[pairs + pair] = a2 * b1 - a3 * b0 + ki4 * out[pair]
            pair += 1


@compiled
def _integrals(
    length: float,
    s: float,
    series: FloatArray,
    terms: FloatArray,
    modes: FloatArray,
    work: FloatArray,
    out: FloatArray,
) -> None:
    """Evaluate the modes and their integrals at an inserted length."""
    if modes.shape[1] == 2:
        evaluate(s / length, series, terms, work, out)
    else:
        evaluate_many(s / length, length, modes, series, work, out)


@compiled
def decay_means(x: float) -> tuple[float, float]:
    """
    Return the means over [0, 1] of exp(-x r) and of r -> mean of exp(-x r') over [0, r] times r.

    They are (1 - exp(-x)) / x and (x - 1 + exp(-x)) / x^2, without cancellation at small x.
    """
    if x < 1e-4:
        # Taylor: the next terms are below 1e-13.
        return 1.0 - x * (0.5 - x / 6.0), 0.5 - x * (1.0 / 6.0 - x / 24.0)
    mean = -expm1(-x) / x
    return mean, (1.0 - mean) / x


@compiled
def _glide(u: float, a: float, b: float, t: float) -> tuple[float, float]:
    """
    Solve u_dot = a - b u for a time t.

    Returns the final speed and the displacement.
    """
    x = b * t
    mean, ramp = decay_means(x)
    return u * (1.0 - x * mean) + a * t * mean, t * (u * mean + a * t * ramp)


@compiled
def slide(
    u: float,
    drive: float,
    mass: float,
    coulomb: float,
    viscous: float,
    t: float,
    withdrawal: float = 1.0,
    breakaway: float = 1.0,
) -> tuple[float, float]:
    """
    Exact flow of the insertion axis under a constant force and friction (15).

    Parameters
    ----------
    u : float
        Insertion speed [m/s].
    drive : float
        Constant force [N], positive into the tissue.
    mass, coulomb, viscous : float
        Moving mass [kg], Coulomb friction [N], viscous friction [N s/m].
    t : float
        Duration [s].
    withdrawal : float
        Friction on withdrawal over that on insertion.
    breakaway : float
        Friction that rest can bear over Coulomb friction.

    Returns
    -------
    speed : float
        Speed after ``t`` [m/s]; exactly zero while stuck.
    displacement : float
        Distance moved [m].

    """
    distance = 0.0
    if u != 0.0:
        sign = 1.0 if u > 0.0 else -1.0
        factor = 1.0 if u > 0.0 else withdrawal
        b = factor * viscous / mass
        braking = (factor * coulomb - drive * sign) / mass
        stop = inf
        if braking > 0.0:
            stop = abs(u) / braking
            if b * stop > 1e-16:
                # Below, it is the same to rounding, and b may be too small to divide by.
                stop = log1p(b * stop) / b
        if stop > t:
            return _glide(u, -sign * braking, b, t)
        _, distance = _glide(u, -sign * braking, b, stop)
        t -= stop
    bearable = breakaway * coulomb
    if -withdrawal * bearable <= drive <= bearable:
        return 0.0, distance
    factor = 1.0 if drive > 0.0 else withdrawal
    excess = drive - coulomb if drive > 0.0 else drive + factor * coulomb
    speed, further = _glide(0.0, excess / mass, factor * viscous / mass, t)
    return speed, distance + further


@compiled
def _dry(c: Constants, u: float) -> float:
    """Return the modulus of the dry part of friction at a speed."""
    factor = 1.0 if u >= 0.0 else c.withdrawal
    if c.friction_law == STRIBECK:
        r = u / c.stribeck_speed
        return factor * c.coulomb * (1.0 + (c.breakaway - 1.0) * exp(-r * r))
    if c.friction_law == TANH:
        return factor * c.coulomb * tanh(abs(u) / c.smoothing_speed)
    return factor * c.coulomb


@compiled
def _creep(c: Constants, u: float, drive: float, h: float) -> float:
    """Solve M (w - u) = h (drive - friction(w)) for w under the smooth law."""
    # The residual grows with w: Newton, kept inside a bracket that always holds the root.
    inertia = c.moving_mass / h
    reach = (abs(drive) + c.coulomb * max(1.0, c.withdrawal)) / inertia + abs(u)
    low, high = -reach, reach
    w = u
    for _ in range(100):
        factor = 1.0 if w >= 0.0 else c.withdrawal
        turned = tanh(w / c.smoothing_speed)
        value = inertia * (w - u) - drive + factor * (c.coulomb * turned + c.viscous * w)
        steep = c.coulomb * (1.0 - turned * turned) / c.smoothing_speed + c.viscous
        if value > 0.0:
            high = w
        else:
            low = w
        following = w - value / (inertia + factor * steep)
        if not low <= following <= high:
            following = 0.5 * (low + high)
        if abs(following - w) <= 1e-15 * reach:
            return following
        w = following
    return w


@compiled
def _flow(c: Constants, u: float, drive: float, h: float) -> tuple[float, float]:
    """Return speed and displacement of the insertion axis after a time h, for every law."""
    if c.friction_law == COULOMB:
        return slide(u, drive, c.moving_mass, c.coulomb, c.viscous, h, c.withdrawal)
    if c.friction_law == STRIBECK:
        # Dry friction is that at the speed in the middle of the step; rest bears the break-away.
        mass, bearable = c.moving_mass, c.breakaway * c.coulomb
        level = _dry(c, abs(u))
        half, _ = slide(u, drive, mass, level, c.viscous, 0.5 * h, c.withdrawal, bearable / level)
        level = _dry(c, abs(half))
        return slide(u, drive, mass, level, c.viscous, h, c.withdrawal, bearable / level)
    # Two implicit stages of second order, L-stable (R. Alexander, SIAM J. Numer. Anal. 14, 1977).
    part = 1.0 - sqrt(0.5)
    first = _creep(c, u, drive, part * h)
    end = _creep(c, u + (1.0 - part) / part * (first - u), drive, part * h)
    step = h * ((1.0 - part) * first + part * end)
    lost = drive * step - 0.5 * c.moving_mass * (end * end - u * u)
    if lost < 0.0 or (drive - _smooth(c, end)) * (drive - _smooth(c, u)) < 0.0:
        # Past the steady speed, or energy out of friction: implicit Euler, of first order, never.
        end = _creep(c, u, drive, h)
        step = h * end
    return end, step


@compiled
def _smooth(c: Constants, u: float) -> float:
    """Return friction under the smooth law."""
    viscous = c.viscous * u * (1.0 if u >= 0.0 else c.withdrawal)
    return viscous + (_dry(c, u) if u >= 0.0 else -_dry(c, u))


@compiled
def _layer(start: FloatArray, s: float, layer: int) -> int:
    """Return the layer that holds a depth, looked for from the one given."""
    while layer + 1 < start.shape[0] and s >= start[layer + 1]:
        layer += 1
    while layer > 0 and s < start[layer]:
        layer -= 1
    return layer


@compiled
def _time_to_layer(start: FloatArray, stiffness: FloatArray, s: float, u: float) -> float:
    """Return the time until the next border between unlike layers at the speed now."""
    soonest = inf
    for i in range(1, start.shape[0]):
        ahead = (start[i] - s) / u if u != 0.0 else inf
        if 0.0 < ahead < soonest and stiffness[i] != stiffness[i - 1]:
            soonest = ahead
    return soonest


@compiled
def _rotate_two(
    rho: float,
    ei: float,
    damping: float,
    as_printed: bool,
    at: FloatArray,
    offset: FloatArray,
    layer: int,
    ka: float,
    growth: float,
    q1: float,
    q2: float,
    z1: float,
    z2: float,
    h: float,
    decay: float,
    sums: FloatArray,
) -> tuple[float, float, float, float, float]:
    """
    Exact modal flow of two modes at frozen depth for a time h, between half steps of damping.

    Returns the new q and z (momenta, or rates in the formulation as printed) and the impulse of
    the modes on the insertion axis, against insertion [N s]. The tissue has the stiffness ``ka``
    at the tip; ``offset`` of its layer, times ``growth``, is what the layers above add.
    """
    k11 = ei * at[3] + ka * at[0] + growth * offset[layer, 0]
    k12 = ei * at[4] + ka * at[1] + growth * offset[layer, 1]
    k22 = ei * at[5] + ka * at[2] + growth * offset[layer, 2]
    # Cholesky factor of the modal mass rho A G = L L^T.
    l11 = sqrt(rho * at[0])
    l21 = rho * at[1] / l11
    l22 = sqrt(rho * at[2] - l21 * l21)
    i11 = 1.0 / l11
    i22 = 1.0 / l22
    ratio = l21 * i11
    # Stiffness in the coordinates y = L^T q, where the mass is the identity.
    b11 = k11 * i11 * i11
    b12 = (k12 - ratio * k11) * i11 * i22
    b22 = (k22 - 2.0 * ratio * k12 + ratio * ratio * k11) * i22 * i22
    # One Jacobi rotation diagonalizes it.
    tau = (b22 - b11) / (2.0 * b12)
    tangent = (1.0 if tau >= 0.0 else -1.0) / (abs(tau) + sqrt(1.0 + tau * tau))
    cj = 1.0 / sqrt(1.0 + tangent * tangent)
    sj = tangent * cj
    square1 = b11 - tangent * b12
    square2 = b22 + tangent * b12
    omega1 = sqrt(square1)
    omega2 = sqrt(square2)

    y1 = l11 * q1 + l21 * q2
    y2 = l22 * q2
    if as_printed:
        v1 = l11 * z1 + l21 * z2
        v2 = l22 * z2
    else:
        v1 = z1 * i11
        v2 = (z2 - l21 * v1) * i22
    a1 = cj * y1 - sj * y2
    a2 = sj * y1 + cj * y2
    b1 = cj * v1 - sj * v2
    b2 = sj * v1 + cj * v2

    lost = b1 * b1 + b2 * b2
    b1 *= decay
    b2 *= decay

    cos1 = cos(omega1 * h)
    sin1 = sin(omega1 * h)
    cos2 = cos(omega2 * h)
    sin2 = sin(omega2 * h)
    e1 = a1 * cos1 + b1 * sin1 / omega1
    f1 = b1 * cos1 - a1 * omega1 * sin1
    e2 = a2 * cos2 + b2 * sin2 / omega2
    f2 = b2 * cos2 - a2 * omega2 * sin2

    # Integrals over the rotation of a_i a_j and b_i b_j (b = a_dot), from the end values.
    twice1 = (b1 * b1 + square1 * a1 * a1) * h
    twice2 = (b2 * b2 + square2 * a2 * a2) * h
    change1 = e1 * f1 - a1 * b1
    change2 = e2 * f2 - a2 * b2
    aa1 = 0.5 * (twice1 - change1) / square1
    bb1 = 0.5 * (twice1 + change1)
    aa2 = 0.5 * (twice2 - change2) / square2
    bb2 = 0.5 * (twice2 + change2)
    change12 = e1 * f2 - a1 * b2
    change21 = e2 * f1 - a2 * b1
    gap = 1.0 / (square1 - square2)
    aa12 = (change12 - change21) * gap
    bb12 = (square1 * change12 - square2 * change21) * gap

    # Tip value and tip curvature of the two normal modes.
    w1 = at[6] * i11
    w2 = (at[7] - l21 * w1) * i22
    n1 = cj * w1 - sj * w2
    n2 = sj * w1 + cj * w2
    w1 = at[8] * i11
    w2 = (at[9] - l21 * w1) * i22
    m1 = cj * w1 - sj * w2
    m2 = sj * w1 + cj * w2
    elastic = (
        (ei * m1 * m1 + ka * n1 * n1) * aa1
        + (ei * m2 * m2 + ka * n2 * n2) * aa2
        + 2.0 * (ei * m1 * m2 + ka * n1 * n2) * aa12
    )
    inertial = rho * (n1 * n1 * bb1 + n2 * n2 * bb2 + 2.0 * n1 * n2 * bb12)

    # Integral of q over the rotation, for the means that sensors take.
    s1 = (b1 - f1) / square1
    s2 = (b2 - f2) / square2
    sums[SUM_TIP] += n1 * s1 + n2 * s2
    sums[SUM_BEND] += m1 * s1 + m2 * s2
    y1 = cj * s1 + sj * s2
    y2 = cj * s2 - sj * s1
    mean2 = y2 * i22
    mean1 = (y1 - l21 * mean2) * i11

    lost += f1 * f1 + f2 * f2
    f1 *= decay
    f2 *= decay
    sums[SUM_DAMPING_WORK] += 0.5 * lost * (1.0 - decay * decay)

    y1 = cj * e1 + sj * e2
    y2 = cj * e2 - sj * e1
    v1 = cj * f1 + sj * f2
    v2 = cj * f2 - sj * f1
    r2 = y2 * i22
    r1 = (y1 - l21 * r2) * i11
    moved1 = damping * (r1 - q1)
    moved2 = damping * (r2 - q2)
    # The tissue holds the needle by the integral of k w, and damps it by that of c_a w_dot.
    sums[SUM_REACTION] += (
        (ka * at[10] + growth * offset[layer, 3]) * mean1
        + (ka * at[11] + growth * offset[layer, 4]) * mean2
        + at[10] * moved1
        + at[11] * moved2
    )
    sums[SUM_REACTION_MOMENT] += (
        (ka * at[12] + growth * offset[layer, 5]) * mean1
        + (ka * at[13] + growth * offset[layer, 6]) * mean2
        + at[12] * moved1
        + at[13] * moved2
    )
    if as_printed:
        z2 = v2 * i22
        return r1, r2, (v1 - l21 * z2) * i11, z2, 0.0
    return r1, r2, l11 * v1, l21 * v1 + l22 * v2, 0.5 * (elastic - inertial)


@compiled
def _cholesky(c: Constants, at: FloatArray, factor: FloatArray) -> None:
    """Write the lower Cholesky factor of the modal mass rho A G into ``factor``."""
    n = factor.shape[0]
    for j in range(n):
        for i in range(j, n):
            value = c.linear_density * at[j * n - j * (j - 1) // 2 + i - j]
            for k in range(j):
                value -= factor[i, k] * factor[j, k]
            factor[i, j] = sqrt(value) if i == j else value / factor[j, j]


@compiled
def _forward(factor: FloatArray, x: FloatArray) -> None:
    """Replace x by the solution of L y = x."""
    for i in range(x.shape[0]):
        value = x[i]
        for k in range(i):
            value -= factor[i, k] * x[k]
        x[i] = value / factor[i, i]


@compiled
def _backward(factor: FloatArray, x: FloatArray) -> None:
    """Replace x by the solution of L^T y = x."""
    for i in range(x.shape[0] - 1, -1, -1):
        value = x[i]
        for k in range(i + 1, x.shape[0]):
            value -= factor[k, i] * x[k]
        x[i] = value / factor[i, i]


@compiled
def _diagonalize(matrix: FloatArray, basis: FloatArray) -> None:
    """Diagonalize a positive definite matrix in place by Jacobi rotations; vectors in basis."""
    n = matrix.shape[0]
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
def _rotate_many(  # noqa: C901
    c: Constants,
    at: FloatArray,
    offset: FloatArray,
    layer: int,
    ka: float,
    growth: float,
    q: FloatArray,
    z: FloatArray,
    h: float,
    decay: float,
    sums: FloatArray,
) -> float:
    """Do what `_rotate_two` does for any number of modes, on ``q`` and ``z`` in place."""
    n = q.shape[0]
    pairs = n * (n + 1) // 2
    factor = np.zeros((n, n))
    _cholesky(c, at, factor)
    stiff = np.empty((n, n))
    for i in range(n):
        for j in range(i, n):
            pair = i * n - i * (i - 1) // 2 + j - i
            tissue = ka * at[pair] + growth * offset[layer, pair]
            stiff[i, j] = c.bending_stiffness * at[pairs + pair] + tissue
            stiff[j, i] = stiff[i, j]
    for i in range(n):
        _forward(factor, stiff[:, i])
    for i in range(n):
        _forward(factor, stiff[i, :])
    basis = np.empty((n, n))
    _diagonalize(stiff, basis)
    x, v, tip, bend = np.zeros(n), np.zeros(n), np.empty(n), np.empty(n)
    for i in range(n):
        for k in range(i, n):
            x[i] += factor[k, i] * q[k]
            v[i] += factor[k, i] * z[k]
        tip[i] = at[2 * pairs + i]
        bend[i] = at[2 * pairs + n + i]
    if not c.as_printed:
        v[:] = z
        _forward(factor, v)
    _forward(factor, tip)
    _forward(factor, bend)
    a, b, value, curvature = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n)
    for j in range(n):
        for i in range(n):
            a[j] += basis[i, j] * x[i]
            b[j] += basis[i, j] * v[i]
            value[j] += basis[i, j] * tip[i]
            curvature[j] += basis[i, j] * bend[i]
    e, f, mean = np.empty(n), np.empty(n), np.empty(n)
    lost = 0.0
    for j in range(n):
        lost += b[j] * b[j]
        b[j] *= decay
        omega = sqrt(stiff[j, j])
        co, si = cos(omega * h), sin(omega * h)
        e[j] = a[j] * co + b[j] * si / omega
        f[j] = b[j] * co - a[j] * omega * si
        lost += f[j] * f[j]
        mean[j] = (b[j] - f[j]) / stiff[j, j]
        sums[SUM_TIP] += value[j] * mean[j]
        sums[SUM_BEND] += curvature[j] * mean[j]
    sums[SUM_DAMPING_WORK] += 0.5 * lost * (1.0 - decay * decay)
    impulse = 0.0
    for i in range(n):
        for j in range(i, n):
            if i == j:
                twice = (b[i] * b[i] + stiff[i, i] * a[i] * a[i]) * h
                change = e[i] * f[i] - a[i] * b[i]
                aa, bb = 0.5 * (twice - change) / stiff[i, i], 0.5 * (twice + change)
            else:
                one, two = e[i] * f[j] - a[i] * b[j], e[j] * f[i] - a[j] * b[i]
                # Twice: the pair stands for both orders.
                gap = 2.0 / (stiff[i, i] - stiff[j, j])
                aa = (one - two) * gap
                bb = (stiff[i, i] * one - stiff[j, j] * two) * gap
            shared = value[i] * value[j]
            bent = c.bending_stiffness * curvature[i] * curvature[j]
            impulse += 0.5 * ((bent + ka * shared) * aa - c.linear_density * shared * bb)
    mean_q = np.zeros(n)
    for i in range(n):
        x[i] = v[i] = 0.0
        for j in range(n):
            x[i] += basis[i, j] * e[j]
            v[i] += basis[i, j] * f[j] * decay
            mean_q[i] += basis[i, j] * mean[j]
    _backward(factor, x)
    _backward(factor, mean_q)
    for i in range(n):
        moved = c.tissue_damping * (x[i] - q[i])
        area, moment = at[2 * pairs + 2 * n + i], at[2 * pairs + 3 * n + i]
        force = ka * area + growth * offset[layer, pairs + i]
        torque = ka * moment + growth * offset[layer, pairs + n + i]
        sums[SUM_REACTION] += force * mean_q[i] + area * moved
        sums[SUM_REACTION_MOMENT] += torque * mean_q[i] + moment * moved
        q[i] = x[i]
    if c.as_printed:
        _backward(factor, v)
        z[:] = v
        return 0.0
    for i in range(n):
        z[i] = 0.0
        for k in range(i + 1):
            z[i] += factor[i, k] * v[k]
    return impulse


@compiled
def _balance(
    c: Constants,
    at: FloatArray,
    offset: FloatArray,
    layer: int,
    ka: float,
    growth: float,
    modal: FloatArray,
) -> FloatArray:
    """Return the deflections q that hold generalized forces on them at rest, K q = Q."""
    n = modal.shape[0]
    pairs = n * (n + 1) // 2
    factor = np.zeros((n, n))
    for j in range(n):
        for i in range(j, n):
            pair = j * n - j * (j - 1) // 2 + i - j
            tissue = ka * at[pair] + growth * offset[layer, pair]
            value = c.bending_stiffness * at[pairs + pair] + tissue
            for k in range(j):
                value -= factor[i, k] * factor[j, k]
            factor[i, j] = sqrt(value) if i == j else value / factor[j, j]
    held = modal.copy()
    _forward(factor, held)
    _backward(factor, held)
    return held


@compiled
def _shift(
    c: Constants,
    at: FloatArray,
    offset: FloatArray,
    layer: int,
    ka: float,
    growth: float,
    held: FloatArray,
    h: float,
    before: tuple[float, float],
    sums: FloatArray,
) -> float:
    """
    Add to the sums of a rotation what it misses of one about the deflections ``held``.

    ``before`` are the sums of tip and curvature before it. Returns what the impulse on the
    insertion axis misses, which is quadratic in the deflections (none as printed).
    """
    n = held.shape[0]
    pairs = n * (n + 1) // 2
    tip, bend, force, torque = 0.0, 0.0, 0.0, 0.0
    for i in range(n):
        j = 2 * pairs + i
        tip += at[j] * held[i]
        bend += at[j + n] * held[i]
        force += (ka * at[j + 2 * n] + growth * offset[layer, pairs + i]) * held[i]
        torque += (ka * at[j + 3 * n] + growth * offset[layer, pairs + n + i]) * held[i]
    crossed = sums[SUM_TIP] - before[0], sums[SUM_BEND] - before[1]
    sums[SUM_TIP] += h * tip
    sums[SUM_BEND] += h * bend
    sums[SUM_REACTION] += h * force
    sums[SUM_REACTION_MOMENT] += h * torque
    if c.as_printed:
        return 0.0
    elastic: float = c.bending_stiffness * bend * (crossed[1] + 0.5 * h * bend)
    return float(elastic + ka * tip * (crossed[0] + 0.5 * h * tip))


@compiled
def _carried(
    c: Constants,
    at: FloatArray,
    z: FloatArray,
    rates: FloatArray,
    factor: FloatArray,
) -> tuple[float, float]:
    """Return the needle's momentum along z and its moment about the entry point, from `z`."""
    n = z.shape[0]
    rates[:] = z
    if not c.as_printed:
        _cholesky(c, at, factor)
        _forward(factor, rates)
        _backward(factor, rates)
    momentum, angular = 0.0, 0.0
    first = n * (n + 1) + 2 * n
    for i in range(n):
        momentum += at[first + i] * rates[i]
        angular += at[first + n + i] * rates[i]
    return c.linear_density * momentum, c.linear_density * angular


@compiled
def advance(  # noqa: C901
    c: Constants,
    tables: Tables,
    state: FloatArray,
    time: float,
    force: float,
    torque: float,
    base_speed: float,
    moved: bool,
    longest: float,
    graded: bool,
    duration: float,
    sums: FloatArray,
    modal: FloatArray | None = None,
    felt: FloatArray | None = None,
) -> float:
    """
    Advance ``state`` in place under constant inputs; return the time that was left undone.

    ``modal`` are generalized forces on q1..qn; without them the machine code knows nothing of
    such forces. At frozen depth they shift the deflections about which the modes rotate.

    Steps are no longer than ``longest`` [s]; with ``graded`` they grow with the inserted length
    once it exceeds a tenth of the needle's, since the modes slow down. With ``moved`` the speed
    goes evenly to ``base_speed``, whatever force that takes. Time is left undone when the
    inserted length would leave its range; it is not a number when the motion is none.

    ``felt``, shape (parts, 3), takes what the base feels in equal parts of the duration, where
    steps then end: the mean force of the base on the needle along y and along z, and the mean
    moment about x at the base. That is by balance of momentum, exact whatever the modes do.
    """
    series, terms, modes, layer_start, layer_stiffness, layer_offset = tables
    n = modes.shape[1]
    pairs = n * (n + 1) // 2
    work = np.empty(series.shape[1] + 4 * n)
    at = np.empty(2 * pairs + 4 * n)
    q, z = state[2 : 2 + n].copy(), state[4 + n :].copy()
    q_before, z_before = q.copy(), z.copy()
    rho, ei = c.linear_density, c.bending_stiffness
    damping, printed = c.tissue_damping, c.as_printed
    s = c.length - state[0]
    u = -state[2 + n]
    factor, rates = np.zeros((n, n)), np.empty(n)
    if not c.as_printed:
        # From rates to momenta p = rho A G q_dot, in which dG/dt needs no term.
        _integrals(c.length, s, series, terms, modes, work, at)
        for i in range(n):
            z[i] = 0.0
            for j in range(n):
                low, high = min(i, j), max(i, j)
                gram = at[low * n - low * (low - 1) // 2 + high - low]
                z[i] += c.linear_density * gram * state[4 + n + j]
    q1, q2, z1, z2 = q[0], q[-1], z[0], z[-1]
    gain = (base_speed - u) / duration
    growth, decay, layer = 1.0, 1.0, 0
    pull = 0.0
    sums[SUM_CONTACT] = -1.0
    if modal is not None:
        for i in range(n):
            sums[SUM_INPUT_WORK] -= modal[i] * q[i]
    count, whole, renew = 0, longest, True
    # Time left in the part, and of the parts after it.
    left, later = duration, 0.0
    if felt is not None:
        row, parts = 0, felt.shape[0]
        part = duration / parts
        left, later = part, (parts - 1) * part
        if c.as_printed:
            _integrals(c.length, s, series, terms, modes, work, at)
        momentum, angular = _carried(c, at, z, rates, factor)
        s_before, u_before = s, u
        resistance, reaction = sums[SUM_RESISTANCE], sums[SUM_REACTION]
        turning = sums[SUM_REACTION_MOMENT]
    while left > 0.0:
        if renew:
            if graded:
                whole = longest * max(1.0, s / (GRADED_FROM * c.length))
            # A time of a whole number of steps is not rounded up.
            count = ceil(left / whole * (1.0 - 1e-9))
            even = left / count
            renew = graded
        h = even
        count -= 1
        rest = left - h if count > 0 else 0.0
        if layer_start.shape[0] > 1:
            border = _time_to_layer(layer_start, layer_stiffness, s, u)
            if 1e-3 * h < border < h:
                # A step ends where a layer does: its stiffness is that of one layer.
                h, rest, renew = border, left - border, True
        middle = s + 0.5 * h * u
        if graded:
            # Mean depth of the step if it speeds up as the last one did: a steadier phase.
            middle += h * h * pull / 6.0
        if c.hub_stop and middle > c.length:
            middle = c.length
        if not c.minimum_depth <= middle <= c.maximum_depth:
            break
        if n == 2:
            evaluate(middle / c.length, series, terms, work, at)
        else:
            evaluate_many(middle / c.length, c.length, modes, series, work, at)
        if layer_start.shape[0] > 1:
            layer = _layer(layer_start, middle, layer)
        if c.swelling != 0.0:
            now = time + duration - (left + later) + 0.5 * h
            growth = 1.0 - c.swelling * expm1(-now / c.swelling_time)
        if c.tissue_damping != 0.0:
            decay = exp(-0.5 * h * c.tissue_damping / c.linear_density)
        ka = growth * layer_stiffness[layer]
        if n != 2:
            q_before[:], z_before[:] = q, z
        x1, x2 = q1, q2
        if modal is not None:
            held = _balance(c, at, layer_offset, layer, ka, growth, modal)
            before = sums[SUM_TIP], sums[SUM_BEND]
            x1, x2 = q1 - held[0], q2 - held[-1]
            q -= held
        if n == 2:
            r1, r2, y1, y2, impulse = _rotate_two(
                rho, ei, damping, printed,
                at, layer_offset, layer, ka, growth, x1, x2, z1, z2, h, decay, sums,
            )  # fmt: skip
        else:
            impulse = _rotate_many(c, at, layer_offset, layer, ka, growth, q, z, h, decay, sums)
        if modal is not None:
            impulse += _shift(c, at, layer_offset, layer, ka, growth, held, h, before, sums)
            r1, r2 = r1 + held[0], r2 + held[-1]
            q += held
        drive = force - impulse / h
        if moved:
            # Counted from the end, so that a base that shall rest does so exactly.
            new_u = base_speed - (rest + later) * gain
            step = 0.5 * h * (u + new_u)
        elif c.friction_law == COULOMB:
            new_u, step = slide(u, drive, c.moving_mass, c.coulomb, c.viscous, h, c.withdrawal)
        else:
            new_u, step = _flow(c, u, drive, h)
        stopped = c.hub_stop and s + step >= c.length
        if s + step < c.minimum_depth or (s + step > c.maximum_depth and not stopped):
            # The last valid state is the one before this step.
            if n != 2:
                q[:], z[:] = q_before, z_before
            break
        if n == 2:
            q1, q2, z1, z2 = r1, r2, y1, y2
        if stopped:
            step = c.length - s
            if step > 0.0:
                # Time and speed of the contact within the step, by bisection.
                early, late = 0.0, h
                for _ in range(60):
                    trial = 0.5 * (early + late)
                    if moved:
                        gone = trial * (u + 0.5 * trial * gain)
                    else:
                        _, gone = _flow(c, u, drive, trial)
                    if gone < step:
                        early = trial
                    else:
                        late = trial
                if moved:
                    new_u = u + late * gain
                else:
                    new_u, _ = _flow(c, u, drive, late)
                sums[SUM_CONTACT] = time + duration - (left + later) + late
                sums[SUM_IMPACT] += 0.5 * c.moving_mass * new_u * new_u
            elif u > 0.0:
                # It started on the hub: all its speed is lost at once.
                new_u = u
                sums[SUM_CONTACT] = time + duration - (left + later)
                sums[SUM_IMPACT] += 0.5 * c.moving_mass * u * u
            else:
                new_u = 0.0
        gained = 0.5 * c.moving_mass * (new_u * new_u - u * u)
        if moved:
            mean = 0.5 * (u + new_u)
            pace = abs(u) + abs(new_u)
            viscous = c.viscous * (1.0 if mean >= 0.0 else c.withdrawal)
            if pace > 0.0:
                # Dry friction counts for the time spent in each direction.
                dry = _dry(c, mean) * (u + new_u) / pace
            else:
                bearable = c.coulomb * (c.breakaway if c.friction_law == STRIBECK else 1.0)
                if c.friction_law == TANH:
                    bearable = 0.0
                dry = min(max(-impulse / h, -c.withdrawal * bearable), bearable)
            lost = (dry + viscous * mean) * step
            sums[SUM_INPUT_WORK] += lost + impulse / h * step + gained
            sums[SUM_RESISTANCE] += (impulse / h + dry) * h + viscous * step
        else:
            lost = drive * step - gained
            sums[SUM_INPUT_WORK] += force * step
        sums[SUM_FRICTION_WORK] += lost
        s += step
        pull = (new_u - u) / h
        u = new_u
        if stopped:
            s = c.length
            u = 0.0
        left = rest
        if felt is not None and left <= 0.0:
            if n == 2:
                z[0], z[1] = z1, z2
            _integrals(c.length, s, series, terms, modes, work, at)
            momentum_now, angular_now = _carried(c, at, z, rates, factor)
            if moved:
                axial = c.linear_density * c.length * (u - u_before)
                felt[row, 0] = (axial + sums[SUM_RESISTANCE] - resistance) / part
            else:
                felt[row, 0] = force - c.carriage_mass * (u - u_before) / part
            lateral = (momentum_now - momentum + sums[SUM_REACTION] - reaction) / part
            about = (angular_now - angular + sums[SUM_REACTION_MOMENT] - turning) / part
            lever = c.length - 0.5 * (s_before + s)
            felt[row, 1], felt[row, 2] = lateral, about + lever * lateral + torque
            momentum, angular, s_before, u_before = momentum_now, angular_now, s, u
            resistance, reaction = sums[SUM_RESISTANCE], sums[SUM_REACTION]
            turning = sums[SUM_REACTION_MOMENT]
            row += 1
            if row < parts:
                left, later, renew = part, (parts - 1 - row) * part, True
    if n == 2:
        q[0], q[1], z[0], z[1] = q1, q2, z1, z2
    if modal is not None:
        for i in range(n):
            sums[SUM_INPUT_WORK] += modal[i] * q[i]
    if not c.as_printed:
        _integrals(c.length, s, series, terms, modes, work, at)
        _cholesky(c, at, factor)
        _forward(factor, z)
        _backward(factor, z)
    left += later
    done = duration - left
    turn = 2.0 * torque / c.rotary_inertia
    turned = (state[3 + n] + 0.5 * turn * done) * done
    sums[SUM_INPUT_WORK] += torque * turned
    state[0] = c.length - s
    state[1] += turned
    state[2 : 2 + n] = q
    state[2 + n] = -u
    state[3 + n] += turn * done
    state[4 + n :] = z
    size = 0.0
    for value in state:
        size += abs(value)
    for value in sums:
        size += abs(value)
    # Not a number tells that the motion has left the numbers.
    return left if size < inf else nan


@compiled
def run(
    c: Constants,
    tables: Tables,
    state: FloatArray,
    forces: FloatArray,
    torques: FloatArray,
    interval: float,
    longest: float,
    graded: bool,
    states: FloatArray,
) -> int:
    """
    Advance ``state`` through intervals of constant inputs; return how many were completed.

    ``states``, shape (k + 1, ...), is filled with the states at the ends of the intervals; with
    a single row it is left alone, and only ``state`` is the result.
    """
    sums = np.zeros(SUMS)
    keep = states.shape[0] > 1
    if keep:
        states[0] = state
    for k in range(forces.shape[0]):
        left = advance(
            c, tables, state, k * interval, forces[k], torques[k], 0.0, False, longest, graded,
            interval, sums,
        )  # fmt: skip
        if left != 0.0:
            return k
        if keep:
            states[k + 1] = state
    return len(forces)


@compiled
def straight(before: FloatArray, now: FloatArray, felt: FloatArray) -> None:
    """Fill ``felt``, shape (k, 6), with a straight line that ends with ``now``."""
    samples = felt.shape[0]
    for j in range(samples):
        # The last sample is the wrench now, to the bit.
        back = (samples - 1.0 - j) / samples
        for i in range(6):
            felt[j, i] = now[i] + back * (before[i] - now[i])


@compiled
def sense(
    felt: FloatArray,
    drawn: FloatArray,
    constants: FloatArray,
    sections: FloatArray,
    memory: FloatArray,
    offset: FloatArray,
    zero: FloatArray,
    reading: FloatArray,
) -> None:
    """
    Take the samples of a force sensor since its last reading; read the last of them.

    Parameters
    ----------
    felt : ndarray, shape (k, 6)
        True wrench of each of the k samples.
    drawn : ndarray, shape (k + 1, 6)
        Standard normal numbers: noise of each sample, then the step of the offset.
    constants : ndarray, shape (4, 6)
        Standard deviations of noise and step, range, and resolution (0 for none) of each axis.
    sections : ndarray, shape (filters, 6)
        Second-order sections of the cascade, as SciPy has them.
    memory : ndarray, shape (filters, 2, 6)
        Their memory in transposed direct form II; renewed.
    offset : ndarray, shape (6,)
        Offset of the sensor; renewed.
    zero : ndarray, shape (6,)
        What the reading is zeroed on.
    reading : ndarray, shape (6,)
        Overwritten with the reading.

    """
    samples = felt.shape[0]
    for i in range(6):
        noise, limit, count = constants[0, i], constants[2, i], constants[3, i]
        offset[i] += constants[1, i] * drawn[samples, i]
        value = 0.0
        for j in range(samples):
            value = felt[j, i] + offset[i] + noise * drawn[j, i]
            value = min(max(value, -limit), limit)
            for k in range(sections.shape[0]):
                x = value
                value = sections[k, 0] * x + memory[k, 0, i]
                memory[k, 0, i] = sections[k, 1] * x - sections[k, 4] * value + memory[k, 1, i]
                memory[k, 1, i] = sections[k, 2] * x - sections[k, 5] * value
        value -= zero[i]
        # Counts know no negative zero.
        reading[i] = np.rint(value / count) * count + 0.0 if count > 0.0 else value
