# SPDX-License-Identifier: Apache-2.0
"""Functions without branches, for loops over lanes."""

from math import factorial, pi
from typing import Final

from needle_dynamics.compiled.cache import inlined

ROUND: Final = 1.5 * 2.0**52  #: adding and subtracting this number rounds to an integer

#: pi / 2 as a sum of three parts; integer multiples of the first two are exact.
_HALF_PI: Final = (1.5707963267341256, 6.077100506303966e-11, 2.0222662487959506e-21)
_TURN: Final = 2.0 / pi

#: Coefficients of Taylor series, 1 / 2! to 1 / 19!.
(
    _F2, _F3, _F4, _F5, _F6, _F7, _F8, _F9, _F10, _F11, _F12, _F13, _F14, _F15, _F16, _F17, _F18,
    _F19,
) = (1.0 / factorial(k) for k in range(2, 20))  # fmt: skip

_DECAYED: Final = 40.0  #: exponent above which exp(-x) is negligible against 1


@inlined
def lane_sine_cosine(x: float) -> tuple[float, float]:
    """Return sine and cosine of an angle [rad] without branches."""
    turns = (x * _TURN + ROUND) - ROUND
    r = ((x - turns * _HALF_PI[0]) - turns * _HALF_PI[1]) - turns * _HALF_PI[2]
    y = r * r
    sine = r - r * y * (
        _F3 - y * (_F5 - y * (_F7 - y * (_F9 - y * (_F11 - y * (_F13 - y * _F15)))))
    )
    cosine = 1.0 - y * (
        _F2 - y * (_F4 - y * (_F6 - y * (_F8 - y * (_F10 - y * (_F12 - y * (_F14 - y * _F16))))))
    )
    quarter = turns - 4.0 * ((0.25 * turns + ROUND) - ROUND)
    odd = abs(quarter) == 1.0
    one = cosine if odd else sine
    two = sine if odd else cosine
    # ``quarter`` is -2 to 2.
    first = -one if quarter == -1.0 or abs(quarter) == 2.0 else one
    second = -two if quarter == 1.0 or abs(quarter) == 2.0 else two
    return first, second


@inlined
def lane_decay_means(x: float) -> tuple[float, float]:
    """Return `friction.decay_means` without branches: series of x / 32, doubled five times."""
    z = -min(x, _DECAYED) / 32.0
    ramp = _F14 + z * (_F15 + z * (_F16 + z * (_F17 + z * (_F18 + z * _F19))))
    ramp = _F8 + z * (_F9 + z * (_F10 + z * (_F11 + z * (_F12 + z * (_F13 + z * ramp)))))
    ramp = _F2 + z * (_F3 + z * (_F4 + z * (_F5 + z * (_F6 + z * (_F7 + z * ramp)))))
    mean = 1.0 + z * ramp
    for _ in range(5):
        ramp = 0.25 * (mean * mean + 2.0 * ramp)
        mean *= 1.0 + 0.5 * z * mean
        z *= 2.0
    far = 1.0 / max(x, _DECAYED)
    return (far, (1.0 - far) * far) if x > _DECAYED else (mean, ramp)
