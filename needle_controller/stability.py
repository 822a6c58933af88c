"""
Poles of the sampled loops, and the rejection of gains that are unstable.

Accepted gains have all poles within 1 - margin at the configured delay, and within 1 with one more
period of delay that the law does not know. That period is the reserve for everything that is not
modeled. The setting ``margin`` requires convergence: every error decreases by at least this part
in a period. The poles of slow loops are close to one (the paper's k_p = 1, k_v = 0.1 at 1 kHz:
1 - 5e-5). The default margin is therefore small, but far above the rounding of an eigenvalue.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from math import floor, inf, log10
from typing import Final

from needle_controller.compiled.laws import INTEGRAL, PID, RATE
from needle_controller.laws.law import Law, SampledLoop
from needle_controller.reference.setpoint import Setpoint
from needle_dynamics import FloatArray
from needle_ros.errors import ParameterError
import numpy as np

#: Default distance of the spectral radius from one.
MARGIN: Final = 1e-6

#: Periods of delay in reserve, unknown to the law.
RESERVE: Final = 1

#: Largest factors on gains and rate in the search for stable ones.
_MOST_GAIN: Final = 1e6
_MOST_RATE: Final = 1e3


@dataclass(frozen=True, slots=True, kw_only=True)
class Limit:
    """
    What limits the stability of a loop.

    Attributes
    ----------
    radius : float
        Spectral radius: the largest modulus of the poles.
    bound : float
        Largest valid radius: 1 - margin, or with the reserve just below 1.
    unmodeled : int
        Periods of delay that the law does not know: 0 or RESERVE.

    """

    radius: float
    bound: float
    unmodeled: int

    @property
    def stable(self) -> bool:
        """Whether the loop is stable with its margin."""
        return self.radius <= self.bound


def transition_matrix(law: Law, delay: int, unmodeled: int = 0) -> FloatArray:
    """
    One period of the closed loop as a matrix, exact for its linear part.

    The state is position, speed, the memory of the law (integral and filtered rate, if its gains
    use them) and the pending commands; the last ones are those that the law knows. The matrix is
    found from the loop itself, so that what is analyzed is what runs.

    Parameters
    ----------
    law : Law
        Control law.
    delay : int
        Periods from measurement to effect that the law takes into account.
    unmodeled : int
        Further periods that the law does not know.

    Returns
    -------
    ndarray, shape (N, N)
        Transition matrix over one period.

    """
    linear, late = law.linear(), delay + unmodeled
    loop, rest = SampledLoop(linear, delay, inf), Setpoint(0.0)
    # Only memory that the gains use belongs to the loop; the offset after a switch just fades.
    c = law.constants
    used = [k for k, uses in ((INTEGRAL, c.ki), (RATE, c.filter_time * c.kd)) if uses > 0.0]
    first = 2 + len(used)

    def period(state: FloatArray) -> list[float]:
        position, speed = state[:2].tolist()
        commands: list[float] = state[first:].tolist()
        loop.memory[used] = state[2:first]
        loop.pending.extend(commands[unmodeled:])
        commands.append(loop.command(position, speed, rest))
        end = linear.axis.propagate(position, speed, commands[0], linear.period)
        return [*end, *loop.memory[used].tolist(), *commands[1:]]

    return np.array([period(unit) for unit in np.eye(first + late)]).T


def spectral_radius(law: Law, delay: int, unmodeled: int = 0) -> float:
    """
    Return the largest modulus of the poles; see `transition_matrix`. Below 1 is stable.

    Parameters
    ----------
    law, delay, unmodeled
        As for `transition_matrix`.

    Returns
    -------
    float
        The modulus.

    """
    return float(np.abs(np.linalg.eigvals(transition_matrix(law, delay, unmodeled))).max())


def stability_limit(law: Law, delay: int, *, margin: float = MARGIN) -> Limit:
    """
    Find what limits the stability of a loop, with its delay and with the reserve.

    Parameters
    ----------
    law : Law
        Control law.
    delay : int
        Periods from measurement to effect.
    margin : float
        Required distance of the spectral radius from one, in [0, 1).

    Returns
    -------
    Limit
        The radius that is farthest from its bound.

    Raises
    ------
    ParameterError
        If ``margin`` is out of range.

    Examples
    --------
    >>> from needle_controller import Axis, Pid, PidGains, stability_limit
    >>> from needle_dynamics import NeedleParameters
    >>> axis = Axis.insertion(NeedleParameters.preset('phantom'))
    >>> stability_limit(Pid(axis=axis, gains=PidGains(), period=1e-3), delay=1).stable
    True

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
    Reject gains that are unstable, or would be with the delay in reserve.

    Parameters
    ----------
    law, delay, margin
        As for `stability_limit`.
    name : str
        Name of the gains for the message.

    Returns
    -------
    Limit
        What limits the stability.

    Raises
    ------
    ParameterError
        If the gains are unstable. The message names gains, rate, delay and spectral radius, and
        the nearest stable change: a common factor on the gains, or else a rate.

    Examples
    --------
    >>> from needle_controller import Axis, InverseDynamics, InverseDynamicsGains, check_stability
    >>> axis = Axis(inertia=2.0, viscous=300.0)
    >>> law = InverseDynamics(axis=axis, gains=InverseDynamicsGains(kv=3000.0), period=1e-3)
    >>> check_stability(law, delay=1, name='my gains')
    Traceback (most recent call last):
        ...
    needle_ros.errors.ParameterError: my gains are unstable at 1000 Hz ...

    """
    limit = stability_limit(law, delay, margin=margin)
    if limit.stable:
        return limit
    late = delay + limit.unmodeled
    bound = f'<= 1 - {margin:g}' if limit.unmodeled == 0 else '< 1'
    raise ParameterError(
        f'{name} are unstable at {1.0 / law.period:.7g} Hz with a delay of {late} '
        f'period{"" if late == 1 else "s"}: spectral radius {limit.radius:.7g} must be '
        f'{bound}; {_advice(law, delay, margin)}'
    )


def _advice(law: Law, delay: int, margin: float) -> str:
    """Say what would be stable: a factor on all gains, or else a rate."""

    def accepts(changed: Law) -> bool:
        return stability_limit(changed, delay, margin=margin).stable

    for factor in _nearby():
        if accepts(law.scaled(factor)):
            return f'all of them times {factor:g} would be stable'
    for factor in _upwards(_MOST_RATE):
        rate = _digits(factor / law.period, 3)
        if accepts(replace(law, period=1.0 / rate)):
            return f'a rate of {rate:.7g} Hz would be stable'
    damping = 'kd' if law.constants.kind == PID else 'kv'
    gains = {'kp': law.constants.kp, damping: law.constants.kd}
    missing = [name for name, gain in gains.items() if gain == 0.0]
    if missing:
        return f'{" and ".join(missing)} must not be zero'
    return 'neither a common factor on them nor a higher rate would be stable'


def _digits(value: float, digits: int) -> float:
    """Round a positive number to significant digits."""
    return round(value, digits - 1 - floor(log10(value)))


def _upwards(most: float) -> Iterator[float]:
    """Yield factors above one, each 1.1 times the one before."""
    factor = 1.1
    while factor <= most:
        yield factor
        factor *= 1.1


def _nearby() -> Iterator[float]:
    """Yield factors of two digits around one, the nearest first."""
    for factor in _upwards(_MOST_GAIN):
        yield _digits(1.0 / factor, 2)
        yield _digits(factor, 2)
