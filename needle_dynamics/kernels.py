"""
Everything that is compiled: series of the modes, friction flow, modal flow, time step.

One file for all: Numba keeps machine code on disk and renews it when the file of the function
changes, but not when that of a function which it calls does.
"""

from __future__ import annotations

from collections.abc import Callable
from math import cos, exp, expm1, inf, log1p, sin, sqrt
from typing import cast, Final, NamedTuple, TypeAlias, TypeVar

import numba
import numpy as np
from numpy.typing import NDArray

FloatArray: TypeAlias = NDArray[np.float64]

#: Number of modes n in (10), as in the paper.
MODES: Final = 2

# Columns of the series: where each quantity starts. Pairs count 11, 12, 22.
GRAM: Final = 0
CURVATURE_GRAM: Final = 9
VALUE: Final = 18
CURVATURE: Final = 22
AREA: Final = 26
MOMENT: Final = 30
COLUMNS: Final = 34

# Slots of the running sums of `advance`.
SUM_TIP: Final = 0
SUM_AREA: Final = 1
SUM_MOMENT: Final = 2
SUM_AREA_RATE: Final = 3
SUM_MOMENT_RATE: Final = 4
SUM_FRICTION_WORK: Final = 5
SUM_DAMPING_WORK: Final = 6
SUM_INPUT_WORK: Final = 7
#: Impulse of the base on the needle that a moved base takes, without that of its inertia.
SUM_RESISTANCE: Final = 8
SUMS: Final = 9

_Function = TypeVar('_Function', bound=Callable[..., object])


def compiled(function: _Function) -> _Function:
    """Compile a function to machine code at its first call and keep it on disk."""
    # error_model: divide as C does; every divisor below is positive by construction.
    return cast(_Function, numba.njit(cache=True, error_model='numpy')(function))


class Constants(NamedTuple):
    """What the compiled step needs of `NeedleParameters`."""

    length: float
    linear_density: float
    bending_stiffness: float
    tissue_stiffness: float
    tissue_damping: float
    moving_mass: float
    rotary_inertia: float
    coulomb: float
    viscous: float
    minimum_depth: float
    hub_stop: bool


#: Length of the output of `evaluate`: G (11, 12, 22), H (11, 12, 22), then phi, phi'',
#: the integral of phi and that of y phi, two each.
INTEGRALS: Final = 14


@compiled
def evaluate(xi: float, table: FloatArray, work: FloatArray, out: FloatArray) -> None:
    """
    Evaluate all series at the relative inserted length.

    Parameters
    ----------
    xi : float
        s / l.
    table : ndarray, shape (terms, columns)
        `ModeShapes.series`.
    work : ndarray, shape (columns,)
        Scratch.
    out : ndarray, shape (14,)
        Overwritten with the values, in the order of `INTEGRALS`.

    """
    square = xi * xi
    z = square * square
    last = table.shape[0] - 1
    for j in range(COLUMNS):
        work[j] = table[last, j]
    for m in range(last - 1, -1, -1):
        for j in range(COLUMNS):
            work[j] = work[j] * z + table[m, j]
    for pair in range(3):
        g, h = GRAM + 3 * pair, CURVATURE_GRAM + 3 * pair
        out[pair] = z * xi * (work[g] + xi * work[g + 1] + square * work[g + 2])
        out[3 + pair] = xi * (work[h] + xi * work[h + 1] + square * work[h + 2])
    for i in range(MODES):
        j = 2 * i
        out[6 + i] = square * (work[VALUE + j] + xi * work[VALUE + j + 1])
        out[8 + i] = work[CURVATURE + j] + xi * work[CURVATURE + j + 1]
        out[10 + i] = square * xi * (work[AREA + j] + xi * work[AREA + j + 1])
        out[12 + i] = z * (work[MOMENT + j] + xi * work[MOMENT + j + 1])


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
    u: float, drive: float, mass: float, coulomb: float, viscous: float, t: float
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

    Returns
    -------
    speed : float
        Speed after ``t`` [m/s]; exactly zero while stuck.
    displacement : float
        Distance moved [m].

    """
    b = viscous / mass
    distance = 0.0
    if u != 0.0:
        sign = 1.0 if u > 0.0 else -1.0
        braking = (coulomb - drive * sign) / mass
        stop = inf
        if braking > 0.0:
            stop = abs(u) / braking
            if b > 0.0:
                stop = log1p(b * stop) / b
        if stop > t:
            return _glide(u, -sign * braking, b, t)
        _, distance = _glide(u, -sign * braking, b, stop)
        t -= stop
    if abs(drive) <= coulomb:
        return 0.0, distance
    excess = drive - coulomb if drive > 0.0 else drive + coulomb
    speed, further = _glide(0.0, excess / mass, b, t)
    return speed, distance + further


@compiled
def _rotate(
    c: Constants,
    at: FloatArray,
    q1: float,
    q2: float,
    p1: float,
    p2: float,
    h: float,
    decay: float,
    sums: FloatArray,
) -> tuple[float, float, float, float, float]:
    """
    Exact modal flow at frozen depth for a time h, between two half steps of tissue damping.

    Returns q1, q2, p1, p2 and the impulse on the insertion axis [N s] against insertion.
    """
    rho, ei, ka = c.linear_density, c.bending_stiffness, c.tissue_stiffness
    # Cholesky factor of the modal mass rho A G = L L^T.
    l11 = sqrt(rho * at[0])
    l21 = rho * at[1] / l11
    l22 = sqrt(rho * at[2] - l21 * l21)
    i11 = 1.0 / l11
    i22 = 1.0 / l22
    ratio = l21 * i11
    # Stiffness in the coordinates y = L^T q, where the mass is the identity.
    k11 = ei * at[3] + ka * at[0]
    k12 = ei * at[4] + ka * at[1]
    k22 = ei * at[5] + ka * at[2]
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
    v1 = p1 * i11
    v2 = (p2 - l21 * v1) * i22
    a1 = cj * y1 - sj * y2
    a2 = sj * y1 + cj * y2
    b1 = cj * v1 - sj * v2
    b2 = sj * v1 + cj * v2

    lost = b1 * b1 + b2 * b2
    b1 *= decay
    b2 *= decay
    lost *= 1.0 - decay * decay

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
    impulse = 0.5 * (elastic - inertial)

    # Integral of q over the rotation, for the means that sensors take.
    s1 = (b1 - f1) / square1
    s2 = (b2 - f2) / square2
    sums[SUM_TIP] += n1 * s1 + n2 * s2
    y1 = cj * s1 + sj * s2
    y2 = cj * s2 - sj * s1
    mean2 = y2 * i22
    mean1 = (y1 - l21 * mean2) * i11
    sums[SUM_AREA] += at[10] * mean1 + at[11] * mean2
    sums[SUM_MOMENT] += at[12] * mean1 + at[13] * mean2

    after = f1 * f1 + f2 * f2
    f1 *= decay
    f2 *= decay
    sums[SUM_DAMPING_WORK] += 0.5 * (lost + after * (1.0 - decay * decay))

    y1 = cj * e1 + sj * e2
    y2 = cj * e2 - sj * e1
    v1 = cj * f1 + sj * f2
    v2 = cj * f2 - sj * f1
    r2 = y2 * i22
    r1 = (y1 - l21 * r2) * i11
    sums[SUM_AREA_RATE] += at[10] * (r1 - q1) + at[11] * (r2 - q2)
    sums[SUM_MOMENT_RATE] += at[12] * (r1 - q1) + at[13] * (r2 - q2)
    return r1, r2, l11 * v1, l21 * v1 + l22 * v2, impulse


@compiled
def advance(
    c: Constants,
    table: FloatArray,
    work: FloatArray,
    at: FloatArray,
    state: FloatArray,
    force: float,
    torque: float,
    base_speed: float,
    moved: bool,
    h: float,
    steps: int,
    sums: FloatArray,
) -> int:
    """
    Take ``steps`` steps in place under constant inputs; return how many were taken.

    With ``moved`` the speed goes evenly to ``base_speed``, whatever force that takes.
    Fewer steps than asked for means that the inserted length fell below its minimum.
    """
    s = c.length - state[0]
    u = -state[4]
    q1 = state[2]
    q2 = state[3]
    rho = c.linear_density
    evaluate(s / c.length, table, work, at)
    p1 = rho * (at[0] * state[6] + at[1] * state[7])
    p2 = rho * (at[1] * state[6] + at[2] * state[7])
    decay = exp(-0.5 * h * c.tissue_damping / rho)
    change = (base_speed - u) / steps
    taken = 0
    while taken < steps:
        middle = s + 0.5 * h * u
        if c.hub_stop and middle > c.length:
            middle = c.length
        if middle < c.minimum_depth:
            break
        evaluate(middle / c.length, table, work, at)
        r1, r2, t1, t2, impulse = _rotate(c, at, q1, q2, p1, p2, h, decay, sums)
        drive = force - impulse / h
        if moved:
            # Counted from the end, so that a base that shall rest does so exactly.
            new_u = base_speed - (steps - taken - 1) * change
            step = 0.5 * h * (u + new_u)
        else:
            new_u, step = slide(u, drive, c.moving_mass, c.coulomb, c.viscous, h)
        if s + step < c.minimum_depth:
            break
        stopped = c.hub_stop and s + step >= c.length
        if stopped:
            step = c.length - s
        if moved or stopped:
            lost = c.coulomb * abs(step) + c.viscous * 0.5 * (u + new_u) * step
        else:
            lost = drive * step - 0.5 * c.moving_mass * (new_u * new_u - u * u)
        if moved:
            gained = 0.0 if stopped else 0.5 * c.moving_mass * (new_u * new_u - u * u)
            sums[SUM_INPUT_WORK] += lost + impulse / h * step + gained
            pace = abs(u) + abs(new_u)
            if pace > 0.0:
                # Coulomb friction counts for the time spent in each direction.
                push = impulse / h + c.coulomb * (u + new_u) / pace
            else:
                push = impulse / h - min(max(impulse / h, -c.coulomb), c.coulomb)
            sums[SUM_RESISTANCE] += push * h + c.viscous * step
        else:
            sums[SUM_INPUT_WORK] += force * step
        sums[SUM_FRICTION_WORK] += lost
        q1, q2, p1, p2 = r1, r2, t1, t2
        s += step
        u = new_u
        if stopped:
            s = c.length
            u = 0.0
        taken += 1
    evaluate(s / c.length, table, work, at)
    # Back from momenta to rates, by the same Cholesky factor.
    l11 = sqrt(rho * at[0])
    l21 = rho * at[1] / l11
    l22 = sqrt(rho * at[2] - l21 * l21)
    v1 = p1 / l11
    v2 = (p2 - l21 * v1) / l22
    rate2 = v2 / l22
    rate1 = (v1 - l21 * rate2) / l11
    duration = taken * h
    turn = 2.0 * torque / c.rotary_inertia
    sums[SUM_INPUT_WORK] += torque * (state[5] + 0.5 * turn * duration) * duration
    state[0] = c.length - s
    state[1] += (state[5] + 0.5 * turn * duration) * duration
    state[2] = q1
    state[3] = q2
    state[4] = -u
    state[5] += turn * duration
    state[6] = rate1
    state[7] = rate2
    return taken
