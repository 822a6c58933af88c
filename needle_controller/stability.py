# SPDX-License-Identifier: Apache-2.0
"""
Poles of the sampled control loops, and rejection of unstable gains.

Accepted gains have all poles within 1 - margin on the nominal axis at the configured delay. On
every axis within `Uncertainty`, and with one more period of unmodeled delay, all poles are within
1. The setting ``margin`` requires convergence: every error decreases by at least this fraction in
a period. The poles of slow loops are close to one (the paper's k_p = 1, k_v = 0.1 at 1 kHz: 1 -
5e-5). The default margin is therefore small, but far above the rounding of an eigenvalue.

Poles do not show a limit cycle of dry friction. It occurs if a law overcompensates dry friction in
the direction of the measured velocity, or if its integral is too fast. Such laws are also
simulated on each axis.
"""

from bisect import bisect_left
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from math import ceil, inf, log
from typing import Final

from needle_controller.compiled import laws
from needle_controller.compiled.laws import INVERSE_DYNAMICS
from needle_controller.compiled.loop import ring
from needle_controller.laws.law import Axis, Law, SampledLoop
from needle_controller.laws.sampled import BANDWIDTH, InverseDynamics
from needle_controller.reference.setpoint import Setpoint
from needle_dynamics import FloatArray
from needle_ros.errors import ParameterError
from needle_ros.settings import CheckedSettings, constant
import numpy as np

_PARTS: Final = (1.0 / 64.0, 1.0 / 16.0, 1.0 / 4.0, 1.0)  #: Checked fractions of the carriage.
_STARTS: Final = (1e-3, 5e-5)  #: Initial positions of simulated limit cycles [m] or [rad].
_SHORTEST: Final = 0.5  #: Shortest duration of such a simulation [s].
_LONGEST: Final = 20.0  #: Longest duration [s].
_DECREASE: Final = 0.1  #: Decrease of errors in each third of it.
_LEAST: Final = 1e-6  #: Least range of motion that is a limit cycle [m] or [rad].

MARGIN: Final = 1e-6  #: Default distance of the spectral radius from one.
RESERVE: Final = 1  #: Periods of unmodeled delay in reserve.
_MOST_DELAY: Final = 100  #: Largest unmodeled delay that is examined, in periods.

HIGHEST_RATE: Final = 10_000.0  #: Highest sample rate of a controller [Hz].
#: Steps between the factors on gains or rate in the search for stable ones, up to a first and up
#: to the largest factor.
_STEPS: Final = ((10.0, 1.1), (1e6, 2.0))


@dataclass(frozen=True, slots=True, kw_only=True)
class Uncertainty(CheckedSettings):
    """Largest deviation of the true axis from the modeled one, for the check of stability."""

    viscous: float = constant(0.3, '1', 'relative uncertainty of viscous friction', high=0.9)
    coulomb: float = constant(0.3, '1', 'relative uncertainty of Coulomb friction', high=0.9)
    inertia: float = constant(0.3, '1', 'relative uncertainty of the moving mass', high=0.9)
    carriage: float = constant(
        2.0, 'kg', 'mass that may move with the needle in addition to model.carriage_mass'
    )

    def axes(self, axis: Axis, *, carriage: bool = False) -> list[Axis]:
        """Return the axes at the uncertainty bounds, with ``carriage`` also with its mass."""
        extra = [part * self.carriage for part in _PARTS if carriage and self.carriage > 0.0]
        inertias = [*_bounds(axis.inertia, self.inertia)]
        inertias += [max(inertias) + mass for mass in extra]
        return [
            replace(axis, coulomb=coulomb, viscous=viscous, inertia=inertia)
            for coulomb, viscous, inertia in product(
                _bounds(axis.coulomb, self.coulomb), _bounds(axis.viscous, self.viscous), inertias
            )
        ]


def _bounds(value: float, share: float) -> list[float]:
    """Return a value and its bounds, without repetition; the value first."""
    return list(dict.fromkeys((value, value * (1.0 - share), value * (1.0 + share))))


def limit_cycle(law: Law, delay: int, unmodeled: int, plant: Axis, radius: float) -> float:
    """
    Simulate a law on another axis; return the amplitude of a limit cycle [m] or [rad], or 0.

    A limit cycle is possible if the law has an integral, or compensates friction in the direction
    of the measured velocity, as inverse dynamics without feedback does. Other laws are not
    simulated. ``radius`` is the spectral radius of the loop, below 1.
    """
    c = law.constants
    measured = c.kind == INVERSE_DYNAMICS and c.kp == 0.0
    if law.axis.coulomb == 0.0 or not (c.ki > 0.0 or measured):
        return 0.0
    periods = log(_DECREASE) / log(max(radius, 1e-3))
    count = ceil(min(max(periods, _SHORTEST / c.period), _LONGEST / c.period))
    amplitudes = [0.0]
    for start in _STARTS:
        pending = np.zeros(delay + unmodeled)
        before, after, turns = ring(
            law.packed, plant.constants, plant.inertia, delay, pending, start, count
        )
        if turns > 1 and after > max(0.5 * before, _LEAST):
            amplitudes.append(0.5 * after)
    return max(amplitudes)


@dataclass(frozen=True, slots=True, kw_only=True)
class Limit:
    """Stability limit of a loop: the critical axis, its poles and its limit cycle."""

    radius: float  #: spectral radius: the largest modulus of the poles
    bound: float  #: largest valid radius: 1 - margin, or with the reserve just below 1
    unmodeled: int  #: periods of delay that the law does not model: 0 or RESERVE
    plant: Axis  #: the true axis
    cycle: float = 0.0  #: amplitude of a limit cycle of dry friction [m] or [rad]; 0 without

    @property
    def stable(self) -> bool:
        """Whether the loop is stable with its margin, without a limit cycle."""
        return self.radius <= self.bound and self.cycle == 0.0


class LinearLoop:
    """
    Linear part of the loop of a law that models ``delay`` periods from measurement to effect.

    The state is position, velocity, the memory of the law (integral, filtered rate and modeled
    motion, if its gains use them) and the pending commands; the latest are known to the law. The
    rows of the law are computed by running the implemented loop on unit states, so that analysis
    and implementation agree.
    """

    def __init__(self, law: Law, delay: int) -> None:
        self._law, self._delay = law, delay
        loop, rest = SampledLoop(law.linear(), delay, inf), Setpoint(0.0)
        # Only memory used by the gains is part of the loop; the offset after a switch decays.
        c = law.constants
        follows = c.kp if c.kind == laws.INVERSE_DYNAMICS else 0.0
        uses = {laws.INTEGRAL: c.ki, laws.RATE: c.filter_time * c.kd}
        uses |= {laws.POSITION: follows, laws.VELOCITY: follows}
        used = [entry for entry, gain in uses.items() if gain > 0.0]
        #: Number of states before the commands.
        self._first = first = 2 + len(used)

        def answer(state: FloatArray) -> list[float]:
            loop.memory[used], loop.memory[laws.FOLLOWS] = state[2:first], float(follows > 0.0)
            loop.pending[:] = state[first:]
            position, velocity = state[:2].tolist()
            force = loop.command(position, velocity, rest)
            return [*loop.memory[used].tolist(), force]

        #: Memory and command after a period, from the state without unmodeled delay.
        self._rows = np.array([answer(unit) for unit in np.eye(first + delay)]).T

    def transition_matrices(self, unmodeled: int, plants: Sequence[Axis]) -> FloatArray:
        """
        Return the transition matrices over one period, exact for the linear part, (m, k, k).

        ``unmodeled`` periods of delay are unknown to the law. The m ``plants`` are the true axes,
        without their dry friction.
        """
        late, first = self._delay + unmodeled, self._first
        known = [*range(first), *range(first + unmodeled, first + late)]
        # With the new command as last entry, which acts at once without a delay.
        matrix = np.zeros((len(plants), first + late, first + late + 1))
        # The two rows of position and velocity: of these, and of the force that acts.
        matrix[:, 0, 0] = 1.0
        moved = np.transpose([plant.response(self._law.period) for plant in plants])
        matrix[:, 0, 1], matrix[:, 1, 1], matrix[:, 0, first], matrix[:, 1, first] = moved
        matrix[:, 2:first, known] = self._rows[:-1]
        matrix[:, first:, first + 1 :] = np.eye(late)
        matrix[:, :, known] += matrix[:, :, -1:] * self._rows[-1]
        return matrix[:, :, :-1]

    def spectral_radius(self, unmodeled: int = 0, plant: Axis | None = None) -> float:
        """Return the largest modulus of the poles; below 1 is stable."""
        return float(self.spectral_radii(unmodeled, [plant or self._law.axis])[0])

    def spectral_radii(self, unmodeled: int, plants: Sequence[Axis]) -> FloatArray:
        """Return `spectral_radius` of each axis, shape (len(plants),)."""
        poles = np.linalg.eigvals(self.transition_matrices(unmodeled, plants))
        return np.asarray(np.abs(poles).max(axis=1))


def delay_margin(law: Law, delay: int, plants: Sequence[Axis] = ()) -> int:
    """
    Return how many more periods than ``delay`` the loop may be late; at most 100 are examined.

    With this delay all poles are inside of the unit circle, on the nominal axis and on ``plants``.
    """
    loop = LinearLoop(law, delay)
    # The axis that needs most time to stop is usually the least stable one: first, it leaves one
    # evaluation for the others.
    axes = sorted(_linear_axes(law, plants), key=lambda axis: axis.viscous / axis.inertia)
    margin, rest = _MOST_DELAY, axes[:1]
    while rest and margin > 0:

        def unstable(late: int, plant: Axis = rest[0]) -> bool:
            return loop.spectral_radius(late, plant) >= 1.0

        # Matrices grow with the delay: from short to long ones.
        late = 1
        while late < margin and not unstable(late):
            late = min(2 * late, margin)
        if unstable(late):
            longer = range(late // 2, late)
            margin = max(longer.start + bisect_left(longer, True, key=unstable) - 1, 0)
        radii = loop.spectral_radii(margin, axes).tolist()
        rest = [axis for axis, radius in zip(axes, radii, strict=True) if radius >= 1.0]
    return margin


def _linear_axes(law: Law, plants: Sequence[Axis]) -> list[Axis]:
    """Return axes with all different poles; dry friction changes none."""
    return list({(one.inertia, one.viscous): one for one in (law.axis, *plants)}.values())


def _limits(law: Law, delay: int, margin: float, plants: Sequence[Axis]) -> Iterator[Limit]:
    """Yield the stability limits on the nominal axis, and then on the other axes."""
    inside = float(np.nextafter(1.0, 0.0))
    axes, linear, loop = (law.axis, *plants), _linear_axes(law, plants), LinearLoop(law, delay)
    radii = [loop.spectral_radii(late, linear).tolist() for late in (0, RESERVE)]
    both = {(one.inertia, one.viscous): own for one, *own in zip(linear, *radii, strict=True)}
    # Limit cycles are searched at the bounds of friction.
    dry, viscous = (
        {min(values), max(values)}
        for values in ([axis.coulomb for axis in axes], [axis.viscous for axis in axes])
    )
    for plant in axes:
        own = both[plant.inertia, plant.viscous]
        for unmodeled, radius in zip((0, RESERVE), own, strict=True):
            bound, cycle = inside, 0.0
            if plant is law.axis and unmodeled == 0:
                bound = 1.0 - margin
            if radius < 1.0 and plant.coulomb in dry and plant.viscous in viscous:
                cycle = limit_cycle(law, delay, unmodeled, plant, radius)
            yield Limit(radius=radius, bound=bound, unmodeled=unmodeled, plant=plant, cycle=cycle)


def stability_limit(
    law: Law, delay: int, *, margin: float = MARGIN, plants: Sequence[Axis] = ()
) -> Limit:
    """
    Return the largest limit cycle, or else the radius with the largest excess over its bound.

    The loop runs on its nominal axis and on other ``plants``, such as those from
    `Uncertainty.axes`, with its delay and with the delay in reserve. ``margin`` is the required
    distance of the spectral radius from one, in [0, 1).
    """
    if not 0.0 <= margin < 1.0:
        raise ParameterError(f'margin must be in [0, 1), got {margin!r}')
    found = _limits(law, delay, margin, plants)
    return max(found, key=lambda limit: (limit.cycle, limit.radius - limit.bound))


def check_stability(
    law: Law, delay: int, name: str, *, margin: float = MARGIN, plants: Sequence[Axis] = ()
) -> Limit:
    """
    Reject gains that are unstable on any of the axes, also with the delay in reserve.

    Parameters
    ----------
    law : Law
        Control law.
    delay : int
        Periods from measurement to effect.
    name : str
        Name of the gains for the message.
    margin : float
        Required distance of the spectral radius from one, in [0, 1).
    plants : sequence of Axis
        Other axes on which the loop must be stable, such as those from `Uncertainty.axes`.

    Returns
    -------
    Limit
        The stability limit.

    Raises
    ------
    ParameterError
        If the gains are unstable. The message contains gains, rate, delay, the axis with its
        spectral radius or limit cycle, and the nearest stable change: the feedback of inverse
        dynamics, a common factor on the gains, or else a rate.

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
    limit = stability_limit(law, delay, margin=margin, plants=plants)
    if limit.stable:
        return limit
    late = delay + limit.unmodeled
    if limit.cycle:
        found = f'a limit cycle of {limit.cycle:.3g}'
    else:
        bound = '< 1' if limit.bound > 1.0 - margin else f'<= 1 - {margin:g}'
        found = f'spectral radius {limit.radius:.7g} must be {bound}'
    raise ParameterError(
        f'{name} are unstable at {1.0 / law.period:.7g} Hz with a delay of {late} '
        f'period{"" if late == 1 else "s"}{_difference(limit.plant, law.axis)}: {found}; '
        f'{_advice(law, delay, margin, plants, limit)}'
    )


def _difference(plant: Axis, modeled: Axis) -> str:
    """Describe how an axis differs from the nominal one, '' if it does not."""
    units = {'coulomb': 'coulomb friction', 'viscous': 'viscous friction', 'inertia': 'inertia'}
    changed = [
        f'{words} {getattr(plant, name):.4g} instead of {getattr(modeled, name):.4g}'
        for name, words in units.items()
        if getattr(plant, name) != getattr(modeled, name)
    ]
    return f' if the axis has {", ".join(changed)} (SI units)' if changed else ''


def _advice(law: Law, delay: int, margin: float, plants: Sequence[Axis], worst: Limit) -> str:
    """Describe the nearest stable change: feedback, a factor on all gains, or a rate."""

    def accepts(changed: Law) -> bool:
        # The worst axis first: it is the most likely to reject the change.
        most = stability_limit(changed, delay, margin=margin, plants=(worst.plant,))
        return most.stable and all(
            limit.stable for limit in _limits(changed, delay, margin, plants)
        )

    known = ''
    if worst.plant is not law.axis and stability_limit(law, delay, margin=margin).stable:
        known = '; or set uncertainty.* to the real model uncertainty: the nominal loop is stable'
    if isinstance(law, InverseDynamics) and law.gains.bandwidth == 0.0:
        with_feedback = replace(law, gains=replace(law.gains, bandwidth=BANDWIDTH))
        if accepts(with_feedback):
            return f'with feedback, bandwidth = {BANDWIDTH:g}, they would be stable{known}'
    for factor in _nearby():
        if accepts(law.scaled(factor)):
            return f'all gains times {factor:g} would be stable{known}'
    for factor in _upwards():
        rate = float(f'{factor / law.period:.3g}')
        if rate > HIGHEST_RATE:
            break
        if accepts(replace(law, period=1.0 / rate)):
            return f'a rate of {rate:.7g} Hz would be stable{known}'
    c = law.constants
    gains = {'kp': c.kp, 'kd': c.kd}
    if isinstance(law, InverseDynamics):
        gains = {'kp': c.model_kp, 'kv': c.model_kv}
    missing = [name for name, gain in gains.items() if gain == 0.0]
    if missing:
        return f'{" and ".join(missing)} must not be zero'
    rates = f'rate up to {HIGHEST_RATE:g} Hz'
    return f'no common factor on the gains and no {rates} would be stable{known}'


def _upwards() -> Iterator[float]:
    factor = 1.0
    for most, step in _STEPS:
        while (factor := step * factor) <= most:
            yield factor
        factor /= step


def _nearby() -> Iterator[float]:
    """Yield factors of two digits around one, the nearest first."""
    for factor in _upwards():
        yield float(f'{1.0 / factor:.2g}')
        yield float(f'{factor:.2g}')
