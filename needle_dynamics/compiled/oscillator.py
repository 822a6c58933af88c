# SPDX-License-Identifier: Apache-2.0
"""Damped oscillator, and first-order lag under a constant force; both exact."""

from math import cos, exp, expm1, sin, sqrt

from needle_dynamics.compiled.cache import compiled, kernel


@compiled
def swing(damping: float, square: float, t: float) -> tuple[float, float, float, float]:
    """Solve x_ddot + damping x_dot + square x = 0 for a time t [s], exactly."""
    # Returns pp, pv [s], vp [1/s], vv: after t, x is pp x + pv v, and v is vp x + vv v.
    half = 0.5 * damping
    apart = square - half * half
    if apart >= 0.0:
        w = sqrt(apart)
        fall = exp(-half * t)
        pv = fall * (sin(w * t) / w if w > 0.0 else t)
        pp = fall * cos(w * t) + half * pv
        return pp, pv, -square * pv, pp - damping * pv
    # Two real poles, the slow pole in a form without cancellation.
    r = sqrt(-apart)
    fast = -(half + r)
    slow = square / fast
    pv = exp(slow * t) * -expm1(-2.0 * r * t) / (2.0 * r)
    return exp(slow * t) - slow * pv, pv, -square * pv, exp(slow * t) + fast * pv


@kernel
def decay_means(x: float) -> tuple[float, float]:
    """Return two means of exp(-x r) for x >= 0, without cancellation at small x."""
    # The mean over r in [0, 1], (1 - exp(-x)) / x, and the integral over r in [0, 1] of the mean
    # over [0, r] times r, (x - 1 + exp(-x)) / x^2.
    if x < 1e-4:
        # Taylor: the next terms are below 1e-13.
        return 1.0 - x * (0.5 - x / 6.0), 0.5 - x * (1.0 / 6.0 - x / 24.0)
    mean = -expm1(-x) / x
    return mean, (1.0 - mean) / x


@compiled
def glide(u: float, a: float, b: float, t: float) -> tuple[float, float]:
    """Solve u_dot = a - b u for a time t [s], exactly; return velocity and displacement."""
    x = b * t
    mean, ramp = decay_means(x)
    return u * (1.0 - x * mean) + a * t * mean, t * (u * mean + a * t * ramp)
