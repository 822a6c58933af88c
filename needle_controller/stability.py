"""
Poles of the sampled loops, and the refusal of gains that cannot be stable.

What is accepted has all poles within 1 - margin with the delay of the graph, and within 1 with a
period more that the law does not know of. That period is the reserve for what is not modeled; the
setting ``margin`` asks for convergence: every error shrinks by at least this part in a period.
Slow loops have poles close to one by right (the source's k_p = 1, k_v = 0.1 at 1 kHz: 1 - 5e-5),
so that its default is small, yet far above the rounding of an eigenvalue.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from math import ceil, inf, log10, pi
from typing import Final

from needle_controller.compiled import laws as kernels
from needle_controller.laws.axis import Law, SampledLoop, Setpoint
from needle_controller.laws.modal import DeflectionLaw, NormalModes
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

#: Depths at which a range is looked at before the worst of them is refined.
_DEPTHS: Final = 25
_FINER: Final = 7

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
    axis : str
        The mode of deflection that leads in it, with depth and frequency; '' for other axes.
    depth : float or None
        Inserted length [m] of that mode.
    aliased : bool
        The mode is not below half the rate: samples do not tell it from a slower one.

    """

    radius: float
    bound: float
    unmodeled: int
    axis: str = ''
    depth: float | None = None
    aliased: bool = False

    @property
    def stable(self) -> bool:
        """Whether the loop is stable by the margin."""
        return self.radius <= self.bound and not self.aliased


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


def deflection_matrix(
    law: DeflectionLaw, modes: NormalModes, delay: int, unmodeled: int = 0
) -> FloatArray:
    """
    Do what `transition_matrix` does for all deflections at a depth, in normal coordinates.

    Parameters
    ----------
    law : DeflectionLaw
        Control law.
    modes : NormalModes
        Axes at the depth, ``law.at(depth)``.
    delay, unmodeled : int
        As in `transition_matrix`.

    Returns
    -------
    ndarray, shape (N n, N n)
        Transition matrix over one period; each part of the state has n entries.

    """
    return kernels.deflection_matrix(law.constants, modes.table, delay, unmodeled)


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


def stability_limit(
    law: Law | DeflectionLaw,
    delay: int,
    depths: tuple[float, float] | None = None,
    *,
    margin: float = MARGIN,
) -> Limit:
    """
    Find what limits the stability of a loop with the delay of the graph and the reserve.

    Parameters
    ----------
    law : Law or DeflectionLaw
        Control law.
    delay : int
        Periods from measurement to effect.
    depths : tuple of float, optional
        Lowest and highest inserted length [m] for a law on deflections; from minimum_depth to
        the whole needle if not given. The base's axes do not depend on the depth.
    margin : float
        By how much the spectral radius has to be less than one, in [0, 1).

    Returns
    -------
    Limit
        The radius that is farthest from its bound, or the mode that is too fast for the rate.

    Raises
    ------
    ParameterError
        If ``margin`` or ``depths`` is outside its range.

    """
    if not 0.0 <= margin < 1.0:
        raise ParameterError(f'margin must be in [0, 1), got {margin!r}')
    bounds = {0: 1.0 - margin, RESERVE: float(np.nextafter(1.0, 0.0))}
    if isinstance(law, DeflectionLaw):
        p = law.model.parameters
        low, high = depths if depths is not None else (p.minimum_depth, p.length)
        if not 0.0 < low <= high <= law.model.modes.reach * p.length:
            raise ParameterError(
                f'depths must be increasing in (0, {law.model.modes.reach * p.length:g}] m, got '
                f'{low!r} and {high!r}'
            )
        return _worst_depth(law, delay, low, high, bounds)
    aliased = law.axis.stiffness / law.axis.inertia >= (pi / law.period) ** 2
    return _worst(
        [
            Limit(
                radius=spectral_radius(law, delay, unmodeled),
                bound=bound,
                unmodeled=unmodeled,
                aliased=aliased,
            )
            for unmodeled, bound in bounds.items()
        ]
    )


def _worst(limits: Sequence[Limit]) -> Limit:
    """Return the limit that is farthest from being met, the first of equal ones."""
    return max(limits, key=lambda limit: (limit.aliased, limit.radius - limit.bound))


def _worst_depth(
    law: DeflectionLaw, delay: int, low: float, high: float, bounds: dict[int, float]
) -> Limit:
    grid = np.geomspace(low, high, _DEPTHS) if high > low else np.array([low])
    # The ends as they were given.
    grid[0], grid[-1] = low, high
    excesses, fastest = _excesses(law, delay, grid, bounds)
    if fastest.max() >= (pi / law.period) ** 2:
        # The fastest mode of all; there is no more to find out.
        return _at_depth(law, delay, float(grid[fastest.argmax()]), bounds)
    k = int(excesses.argmax())
    worst, depth = excesses[k], grid[k]
    left, right = grid[max(k - 1, 0)], grid[min(k + 1, len(grid) - 1)]
    while right - left > 1e-2 * high / _DEPTHS:
        finer = np.linspace(left, right, _FINER)
        excesses, _ = _excesses(law, delay, finer[1:-1], bounds)
        k = int(excesses.argmax()) + 1
        if excesses[k - 1] > worst:
            worst, depth = excesses[k - 1], finer[k]
        left, right = finer[k - 1], finer[k + 1]
    return _at_depth(law, delay, float(depth), bounds)


def _excesses(
    law: DeflectionLaw, delay: int, depths: FloatArray, bounds: dict[int, float]
) -> tuple[FloatArray, FloatArray]:
    """Return by how much the radius is beyond its bound, and the square of the fastest mode."""
    at = [law.at(float(depth)) for depth in depths]
    excesses = []
    for unmodeled, bound in bounds.items():
        matrices = np.array([deflection_matrix(law, modes, delay, unmodeled) for modes in at])
        excesses.append(np.abs(np.linalg.eigvals(matrices)).max(axis=1) - bound)
    return np.max(excesses, axis=0), np.array([modes.squares[-1] for modes in at])


def _at_depth(law: DeflectionLaw, delay: int, depth: float, bounds: dict[int, float]) -> Limit:
    modes, n = law.at(depth), law.count
    found = []
    for unmodeled, bound in bounds.items():
        values, vectors = np.linalg.eig(deflection_matrix(law, modes, delay, unmodeled))
        k = int(np.abs(values).argmax())
        found.append((float(np.abs(values[k])), bound, unmodeled, vectors[: 2 * n, k]))
    radius, bound, unmodeled, vector = max(found, key=lambda one: one[0] - one[1])
    aliased = bool(modes.frequencies[-1] >= 0.5 / law.period)
    # The mode with the most energy in the motion that grows the fastest.
    energy = np.abs(vector[n:]) ** 2 + modes.squares * np.abs(vector[:n]) ** 2
    mode = n - 1 if aliased else int(energy.argmax())
    frequency = _digits(float(modes.frequencies[mode]), 2)
    unit = f'{frequency / 1000.0:g} kHz' if frequency >= 1000.0 else f'{frequency:g} Hz'
    return Limit(
        radius=radius,
        bound=bound,
        unmodeled=unmodeled,
        axis=f'deflection mode {mode + 1} at {100.0 * depth:.3g} cm: {unit}',
        depth=depth,
        aliased=aliased,
    )


def check_stability(
    law: Law | DeflectionLaw,
    delay: int,
    name: str,
    *,
    margin: float = MARGIN,
    depths: tuple[float, float] | None = None,
) -> Limit:
    """
    Refuse gains that are unstable, or would be with the reserve of delay in the graph.

    Parameters
    ----------
    law : Law or DeflectionLaw
        Control law.
    delay : int
        Periods from measurement to effect.
    name : str
        Name of the gains for the message.
    margin : float
        By how much the spectral radius has to be less than one, in [0, 1).
    depths : tuple of float, optional
        As in `stability_limit` [m].

    Returns
    -------
    Limit
        What limits the stability.

    Raises
    ------
    ParameterError
        Naming the gains, the rate, the delay, the axis and the spectral radius found, and the
        nearest change that would do: a common factor on the gains, or else a rate or depths.

    """
    limit = stability_limit(law, delay, depths, margin=margin)
    if limit.stable:
        return limit
    late = delay + limit.unmodeled
    what = f'{limit.axis}, ' if limit.axis else ''
    if limit.aliased:
        what += 'not below half the rate, '
    bound = f'<= 1 - {margin:g}' if limit.unmodeled == 0 else '< 1'
    raise ParameterError(
        f'{name} cannot be stable at {1.0 / law.period:.7g} Hz with a delay of {late} '
        f'period{"" if late == 1 else "s"}: {what}spectral radius {limit.radius:.7g} must be '
        f'{bound}; {_advice(law, delay, margin, depths, limit)}'
    )


def _advice(
    law: Law | DeflectionLaw,
    delay: int,
    margin: float,
    depths: tuple[float, float] | None,
    limit: Limit,
) -> str:
    """Say what would do: a factor on all gains, or else a rate or a depth."""

    def accepts(changed: Law | DeflectionLaw) -> bool:
        # First where it fails now: most changes do not help there.
        here = [(limit.depth, limit.depth)] if limit.depth is not None else []
        return all(
            stability_limit(changed, delay, where, margin=margin).stable
            for where in (*here, depths)
        )

    if not limit.aliased:
        for factor in _nearby():
            if accepts(law.scaled(factor)):
                return f'all of them times {factor:g} would be'
    advice = []
    for factor in _upwards(_MOST_RATE):
        rate = _digits(factor / law.period, 3)
        if accepts(replace(law, period=1.0 / rate)):
            advice.append(f'a rate of {rate:.7g} Hz')
            break
    if isinstance(law, DeflectionLaw):
        high = depths[1] if depths is not None else law.model.parameters.length
        depth = _least_depth(law, delay, margin, limit.depth or 0.0, high)
        if depth is not None:
            advice.append(f'inserted lengths from {100.0 * depth:.3g} cm on')
    if advice:
        return f'{" or ".join(advice)} would do'
    missing = [slot for slot in ('KP', 'KD') if law.constants[getattr(kernels, slot)] == 0.0]
    if missing and not limit.aliased:
        names = {'KP': 'kp', 'KD': 'kd' if law.constants[kernels.LAW] == kernels.PID else 'kv'}
        return f'{" and ".join(names[slot] for slot in missing)} must not be zero'
    if limit.aliased:
        return f'with these gains no rate up to {_MOST_RATE / law.period:.7g} Hz would do'
    return 'neither a common factor on them nor a higher rate would do'


def _least_depth(
    law: DeflectionLaw, delay: int, margin: float, low: float, high: float
) -> float | None:
    """Return the least depth, in millimeters, from which on a law is stable."""
    bad, good = ceil(1e3 * low), int(1e3 * high)
    if bad >= good or not stability_limit(law, delay, (1e-3 * good, high), margin=margin).stable:
        return None
    while good - bad > 1:
        middle = (good + bad) // 2
        if stability_limit(law, delay, (1e-3 * middle, high), margin=margin).stable:
            good = middle
        else:
            bad = middle
    return 1e-3 * good


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
