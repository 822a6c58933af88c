"""Poles of a sampled loop, and the refusal of gains that cannot be stable."""

from __future__ import annotations

from math import inf

from needle_controller.axis import Law, SampledLoop, Setpoint
from needle_dynamics import FloatArray, ParameterError
import numpy as np


def transition_matrix(law: Law, delay: int, unmodeled: int = 0) -> FloatArray:
    """
    One period of the closed loop as a matrix, exact for its linear part.

    The state is position, speed, what the law remembers, the commands the law knows to be on
    their way and those it does not know of. The loop itself is probed, so that what is
    analyzed is what runs.

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
    ndarray, shape (n, n)
        Transition matrix over one period, n = 3 + delay + unmodeled.

    """
    linear = law.linear()
    loop = SampledLoop(linear, delay, inf)
    rest = Setpoint(0.0)
    late = delay + unmodeled

    def period(state: FloatArray) -> list[float]:
        position, speed, memory, *commands = state.tolist()
        loop.memory = memory
        # The newest commands are those that the law knows of.
        for i in range(delay):
            loop.on_the_way[i] = commands[late - delay + i]
        newest = loop.command(position, speed, rest)
        commands.append(newest)
        end = linear.axis.propagate(position, speed, commands[0], linear.period)
        return [*end, loop.memory, *commands[1:]]

    return np.array([period(unit) for unit in np.eye(3 + late)]).T


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
        Spectral radius, without the pole of a memory that the law does not use.

    """
    matrix = transition_matrix(law, delay, unmodeled)
    used = np.ones(len(matrix), dtype=bool)
    # A memory that nothing reads is not part of the loop.
    used[2] = bool(np.delete(matrix[:, 2], 2).any())
    return float(np.abs(np.linalg.eigvals(matrix[np.ix_(used, used)])).max())


def check_stability(law: Law, delay: int, name: str) -> None:
    """
    Refuse gains that are unstable, or would be with one period more of delay in the graph.

    Parameters
    ----------
    law : Law
        Control law.
    delay : int
        Periods from measurement to effect.
    name : str
        Name of the gains for the message.

    Raises
    ------
    ParameterError
        Naming the gains, the rate, the delay and the spectral radius found.

    """
    for unmodeled in (0, 1):
        radius = spectral_radius(law, delay, unmodeled)
        if radius >= 1.0:
            factor = _stable_factor(law, delay)
            advice = (
                f'all of them times {factor:.2g} would be'
                if factor is not None
                else 'no common factor makes them stable: a gain is zero or missing'
            )
            raise ParameterError(
                f'{name} cannot be stable at {1.0 / law.period:g} Hz with a delay of '
                f'{delay + unmodeled} periods: spectral radius {radius:.6g} must be < 1; {advice}'
            )


def _stable_factor(law: Law, delay: int) -> float | None:
    """Return a factor on all gains, within a tenth of the largest, that makes the loop stable."""
    for factor in 0.9 ** np.arange(1, 200):
        scaled = law.scaled(float(factor))
        if max(spectral_radius(scaled, delay, unmodeled) for unmodeled in (0, 1)) < 1.0:
            return float(factor)
    return None
