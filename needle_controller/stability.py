"""
Poles of the sampled loops, and the refusal of gains that cannot be stable.

What is accepted has all poles within 1 - margin with the delay of the graph, and within 1 with a
period more that the law does not know of. That period is the reserve for what is not modeled; the
setting ``margin`` asks for convergence: every error shrinks by at least this part in a period.
Slow loops have poles close to one by right (the source's k_p = 1, k_v = 0.1 at 1 kHz: 1 - 5e-5),
so that its default is small, yet far above the rounding of an eigenvalue.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from math import inf, log10
from typing import Final

from needle_controller.compiled import laws as kernels
from needle_controller.laws.axis import Law, SampledLoop, Setpoint
from needle_dynamics import (
    FloatArray,
)
from needle_ros.errors import (
    ParameterError,
)
import numpy as np

#: By how much a spectral radius has to be less than one, by default.
MARGIN: Final = 1e-6

#: Periods of delay held in reserve, that the law does not know of.
RESERVE: Final = 1

#: Largest factors by which gains and rate are changed in search of what would do.
_MOST_GAIN: Final = 1e6
_MOST_RATE: Final = 1e3


@dataclass(frozen=True, slots=True, kw_only=True)
class Limit:
    """
    What limits the stability of a loop.

    Attributes
    ----------
    radius : float
        Largest modulus of its poles.
    bound : float
        What the radius must not exceed: 1 - margin, or with the reserve what is just below 1.
    unmodeled : int
        Periods of delay beyond those that the law knows of: 0 or RESERVE.

    """

    radius: float
    bound: float
    unmodeled: int

    @property
    def stable(self) -> bool:
        """Whether the loop is stable by the margin."""
        return self.radius <= self.bound


def transition_matrix(law: Law, delay: int, unmodeled: int = 0) -> FloatArray:
    """
    One period of the closed loop as a matrix, exact for its linear part.

    The state is position, speed, what the law remembers (the integral and the filtered rate, as
    far as its gains use them) and the commands on their way, those last that the law knows of.
    The loop itself is probed, so that what is analyzed is what runs.

    Parameters
    ----------
    law : Law
        Control law.
    delay : int
        Periods from measurement to effect that the law takes into account.
    unmodeled : int
        Further periods that it does not know of.

    Returns
    -------
    ndarray, shape (N, N)
        Transition matrix over one period.

    """
    linear, late = law.linear(), delay + unmodeled
    loop, rest = SampledLoop(linear, delay, inf), Setpoint(0.0)
    # A memory that no gain uses is not part of the loop, and the offset of a switch just fades.
    c, used = law.constants, []
    if c[kernels.KI] > 0.0:
        used.append(kernels.INTEGRAL)
    if c[kernels.FILTER_TIME] * c[kernels.KD] > 0.0:
        used.append(kernels.RATE)
    first = 2 + len(used)

    def period(state: FloatArray) -> list[float]:
        position, speed = state[:2].tolist()
        commands: list[float] = state[first:].tolist()
        loop.memory[used] = state[2:first]
        loop.on_the_way.extend(commands[unmodeled:])
        commands.append(loop.command(position, speed, rest))
        end = linear.axis.propagate(position, speed, commands[0], linear.period)
        return [*end, *loop.memory[used].tolist(), *commands[1:]]

    return np.array([period(unit) for unit in np.eye(first + late)]).T


def spectral_radius(law: Law, delay: int, unmodeled: int = 0) -> float:
    """
    Largest modulus of the poles of the sampled loop; below 1 it is stable.

    Parameters
    ----------
    law : Law
        Control law.
    delay, unmodeled : int
        As in `transition_matrix`.

    Returns
    -------
    float
        Spectral radius.

    """
    return float(np.abs(np.linalg.eigvals(transition_matrix(law, delay, unmodeled))).max())


def stability_limit(law: Law, delay: int, *, margin: float = MARGIN) -> Limit:
    """
    Find what limits the stability of a loop with the delay of the graph and the reserve.

    Parameters
    ----------
    law : Law
        Control law.
    delay : int
        Periods from measurement to effect.
    margin : float
        By how much the spectral radius has to be less than one, in [0, 1).

    Returns
    -------
    Limit
        The radius that is farthest from its bound.

    Raises
    ------
    ParameterError
        If ``margin`` is outside its range.

    """
    if not 0.0 <= margin < 1.0:
        raise ParameterError(f'margin must be in [0, 1), got {margin!r}')
    bounds = {0: 1.0 - margin, RESERVE: float(np.nextafter(1.0, 0.0))}
    limits = [
        Limit(radius=spectral_radius(law, delay, unmodeled), bound=bound, unmodeled=unmodeled)
        for unmodeled, bound in bounds.items()
    ]
    return max(limits, key=lambda limit: limit.radius - limit.bound)


def check_stability(law: Law, delay: int, name: str, *, margin: float = MARGIN) -> Limit:
    """
    Reject gains that are unstable, or would be with the reserve of delay in the graph.

    Parameters
    ----------
    law : Law
        Control law.
    delay : int
        Periods from measurement to effect.
    name : str
        Name of the gains for the message.
    margin : float
        By how much the spectral radius has to be less than one, in [0, 1).

    Returns
    -------
    Limit
        What limits the stability.

    Raises
    ------
    ParameterError
        Naming the gains, the rate, the delay and the spectral radius found, and the nearest
        change that would do: a common factor on the gains, or else a rate.

    """
    limit = stability_limit(law, delay, margin=margin)
    if limit.stable:
        return limit
    late = delay + limit.unmodeled
    bound = f'<= 1 - {margin:g}' if limit.unmodeled == 0 else '< 1'
    raise ParameterError(
        f'{name} cannot be stable at {1.0 / law.period:.7g} Hz with a delay of {late} '
        f'period{"" if late == 1 else "s"}: spectral radius {limit.radius:.7g} must be '
        f'{bound}; {_advice(law, delay, margin)}'
    )


def _advice(law: Law, delay: int, margin: float) -> str:
    """Say what would do: a factor on all gains, or else a rate."""

    def accepts(changed: Law) -> bool:
        return stability_limit(changed, delay, margin=margin).stable

    for factor in _nearby():
        if accepts(law.scaled(factor)):
            return f'all of them times {factor:g} would be'
    for factor in _upwards(_MOST_RATE):
        rate = _digits(factor / law.period, 3)
        if accepts(replace(law, period=1.0 / rate)):
            return f'a rate of {rate:.7g} Hz would do'
    missing = [slot for slot in ('KP', 'KD') if law.constants[getattr(kernels, slot)] == 0.0]
    if missing:
        names = {'KP': 'kp', 'KD': 'kd' if law.constants[kernels.LAW] == kernels.PID else 'kv'}
        return f'{" and ".join(names[slot] for slot in missing)} must not be zero'
    return 'neither a common factor on them nor a higher rate would do'


def _digits(value: float, digits: int) -> float:
    """Round a positive number to significant digits."""
    return round(value, digits - 1 - int(np.floor(log10(value))))


def _upwards(most: float) -> Iterator[float]:
    """Yield factors above one, within a tenth of each other."""
    factor = 1.1
    while factor <= most:
        yield factor
        factor *= 1.1


def _nearby() -> Iterator[float]:
    """Yield factors of two digits around one, the nearest first."""
    for factor in _upwards(_MOST_GAIN):
        yield _digits(1.0 / factor, 2)
        yield _digits(factor, 2)
