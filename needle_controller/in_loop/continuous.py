# SPDX-License-Identifier: Apache-2.0
"""
Continuous closed loop, with dry friction as a set-valued law.

The motion is solved in pieces with a fixed direction of sliding. A piece ends where the needle
stops, breaks away, or reaches the hub. Friction is not smoothed.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import inf, sqrt
from typing import Final

from needle_controller.in_loop.run import LoopRun
from needle_controller.laws.continuous import acceleration, ContinuousLaw
from needle_dynamics import FloatArray, InsertionDepthError, NeedleModel
from needle_ros.errors import NeedleError, ParameterError, ShapeError
import numpy as np
from numpy.typing import ArrayLike

_AT_REST: Final = 1e-300  #: Smallest velocity of either sign, for a start from rest [m/s].
_ROUNDING: Final = 1e-9  #: Relative excess of a force at break-away: a decaying motion ends once.
_MOST_PIECES: Final = 1000  #: Largest number of pieces of a motion; more are chatter.


def run_continuous(
    law: ContinuousLaw,
    plant: NeedleModel,
    state: ArrayLike,
    goal: ArrayLike | Callable[[float], ArrayLike],
    times: ArrayLike,
    *,
    tolerance: float = 1e-6,
    method: str = 'Radau',
) -> LoopRun:
    """
    Solve the continuous closed loop, with sticking, break-away and hub.

    Parameters
    ----------
    law : ContinuousLaw
        Control law.
    plant : NeedleModel
        The true needle.
    state : array_like, shape (2 (2 + n),)
        Initial state; integrals of the error start at zero.
    goal : array_like, shape (3, 2 + n), or callable
        Desired q, q_dot and q_ddot, or a function of time [s] that returns them.
    times : array_like, shape (k,)
        Times of the samples [s], increasing. The run starts at the first time.
    tolerance : float
        Relative tolerance of the solver.
    method : str
        Solver of SciPy: ``Radau`` for stiff loops with high gain; ``DOP853`` where the law removes
        the stiffness, such as `modal` inverse dynamics.

    Returns
    -------
    LoopRun
        The run.

    Raises
    ------
    NeedleError
        If the needle leaves its range, the solver fails, or law and friction chatter.

    Notes
    -----
    Modes that the law does not drive are solved at their own frequency of kilohertz: `physical`
    actuation is for short times only. An exponentially decaying motion is reported as chatter when
    its speed falls below the resolution of the tolerance.

    """
    wanted = np.array(times, dtype=float)
    if wanted.ndim != 1 or len(wanted) < 2 or not (np.diff(wanted) > 0.0).all():
        raise ShapeError(f'times must be at least two, increasing, got {wanted.tolist()}')
    if law.model.coordinates != plant.coordinates:
        raise ParameterError(
            f'law and plant must have the same number of modes, got {law.model.modes.count} and '
            f'{plant.modes.count}'
        )
    y = np.concatenate([plant.checked_state(state), np.zeros(law.integrals)])
    desired = goal if callable(goal) else lambda _time: goal
    pieces = _Pieces(law, plant, desired, tolerance, method)
    time, states = float(wanted[0]), np.empty((len(wanted), len(y)))
    states[0] = y
    events: list[tuple[float, str]] = []
    done = 1
    for _ in range(_MOST_PIECES):
        here = wanted[done:]
        time, y, samples, what = pieces.solve(time, y, here)
        states[done : done + len(samples)] = samples
        done += len(samples)
        if done == len(wanted):
            break
        events.append((time, what))
    else:
        raise NeedleError(f'law and friction chatter: {_MOST_PIECES} changes up to {time:g} s')
    m = plant.coordinates
    forces = [pieces.forces(t, x) for t, x in zip(wanted, states, strict=True)]
    return LoopRun(plant, wanted, states[:, : 2 * m], np.array(forces), tuple(events))


@dataclass
class _Pieces:
    law: ContinuousLaw
    plant: NeedleModel
    goal: Callable[[float], ArrayLike]
    tolerance: float
    method: str

    def __post_init__(self) -> None:
        p, m = self.plant.parameters, self.plant.coordinates
        self.low = -(self.plant.modes.reach - 1.0) * p.length
        self.high = p.length - p.minimum_depth
        # Sizes: the needle's length, a radian, a deflection of 1 cm; the same per second.
        sizes = np.full(m, 0.01 * sqrt(p.length))
        sizes[:2] = p.length, 1.0
        self.scale = np.concatenate([sizes, sizes, sizes[: self.law.integrals]])
        self.m = m

    def _clamped(self, y: FloatArray, direction: int) -> FloatArray:
        """Return the state with depth in range and velocity in the direction of sliding."""
        x = y[: 2 * self.m].copy()
        x[0] = min(max(x[0], self.low), self.high)
        if direction == 0:
            x[self.m] = 0.0
        elif -direction * x[self.m] <= 0.0:
            x[self.m] = -direction * _AT_REST
        return x

    def forces(self, time: float, y: FloatArray, direction: int | None = None) -> FloatArray:
        x = y[: 2 * self.m] if direction is None else self._clamped(y, direction)
        return self.law.forces(x, self.goal(time), y[2 * self.m :], time)

    def rate(self, time: float, y: FloatArray, direction: int) -> FloatArray:
        m, x = self.m, self._clamped(y, direction)
        now = self.goal(time)
        forces = self.law.forces(x, now, y[2 * m :], time)
        result = acceleration(self.plant, x, forces, time)
        errors = self.law.errors(x, now)[0][: self.law.integrals]
        rates = y[m : 2 * m].copy()
        if direction == 0:
            rates[0] = result[0] = 0.0
        return np.concatenate([rates, result, errors])

    def jacobian(self, time: float, y: FloatArray, direction: int) -> FloatArray:
        """
        Return the derivative of `rate` by central differences of the size of the state.

        SciPy's one-sided differences at rounding level are too inaccurate where gains of 1e4 act
        on the modal mass of a short needle: Newton's method then fails at most steps.
        """
        steps = 1e-4 * self.scale
        if y[self.m] != 0.0:
            # Without crossing zero velocity, where friction jumps.
            steps[self.m] = 0.5 * abs(y[self.m])
        columns = []
        for i, step in enumerate(steps):
            high, low = y.copy(), y.copy()
            high[i] += step
            low[i] -= step
            change = self.rate(time, high, direction) - self.rate(time, low, direction)
            columns.append(change / (high[i] - low[i]))
        return np.array(columns).T

    def _excess(self, time: float, y: FloatArray, side: int) -> float:
        """Return the excess of the drive over dry friction on a side of rest [N]."""
        x = self._clamped(y, 0)
        drive = self.forces(time, y, 0)[0] + self.plant.bias_forces(x, time)[0]
        bearable = self.plant.friction.force(0.0, side * inf)
        return float(side * (drive - bearable) - _ROUNDING * (abs(drive) + abs(bearable)))

    def _at_hub(self, y: FloatArray) -> bool:
        return self.plant.parameters.hub_stop and bool(y[0] <= 0.0)

    def _direction(self, time: float, y: FloatArray) -> int:
        """Return the direction of motion: 1 into the tissue, -1 out of it, 0 at rest."""
        velocity, at_hub = -y[self.m], self._at_hub(y)
        if velocity != 0.0 and not (at_hub and velocity > 0.0):
            return 1 if velocity > 0.0 else -1
        if self._excess(time, y, 1) > 0.0 and not at_hub:
            return 1
        return -1 if self._excess(time, y, -1) > 0.0 else 0

    def solve(
        self, time: float, y: FloatArray, wanted: FloatArray
    ) -> tuple[float, FloatArray, FloatArray, str]:
        """Solve to the next change or the last time; return time, state, samples and change."""
        from scipy.integrate import solve_ivp

        direction, m = self._direction(time, y), self.m
        names: list[str] = []
        events: list[Callable[[float, FloatArray], float]] = []

        def watch(name: str, event: Callable[[float, FloatArray], float]) -> None:
            event.terminal, event.direction = True, 1.0  # type: ignore[attr-defined]
            names.append(name)
            events.append(event)

        if direction == 0:
            if not self._at_hub(y):
                watch('breaks away inward', lambda t, z: self._excess(t, z, 1))
            watch('breaks away outward', lambda t, z: self._excess(t, z, -1))
        else:
            watch('stops', lambda _, z: float(direction * z[m]))
            watch('leaves its range', lambda _, z: float(z[0] - self.high))
            end_stop = 'touches the hub' if self.plant.parameters.hub_stop else 'leaves its range'
            watch(end_stop, lambda _, z: self.low - float(z[0]))
        implicit = {'jac': lambda t, z: self.jacobian(t, z, direction)}
        run = solve_ivp(
            lambda t, z: self.rate(t, z, direction),
            (time, float(wanted[-1])),
            y,
            method=self.method,
            t_eval=wanted,
            events=events,
            rtol=self.tolerance,
            atol=1e-3 * self.tolerance * self.scale,
            **(implicit if self.method in ('Radau', 'BDF') else {}),
        )
        if run.status < 0:
            raise NeedleError(f'the closed loop cannot be solved beyond {run.t[-1]:g} s')
        samples = np.array(run.y).reshape(len(y), -1).T
        # Exactly at rest, and within the hub, without rounding of the solver.
        samples[:, 0] = np.maximum(samples[:, 0], self.low)
        if direction == 0:
            samples[:, 0], samples[:, m] = y[0], 0.0
        if run.status == 0:
            return float(wanted[-1]), samples[-1].copy(), samples, ''
        which = next(i for i, at in enumerate(run.t_events) if len(at))
        time, end = float(run.t_events[which][0]), run.y_events[which][0].copy()
        what = names[which]
        if what == 'leaves its range':
            depth = self.plant.parameters.length - end[0]
            raise InsertionDepthError(
                f'insertion depth {depth:.6g} m left its range at {time:g} s'
            )
        if what == 'touches the hub':
            end[0] = 0.0
        if direction != 0:
            end[m] = 0.0
        else:
            end[0] = y[0]
            # Break-away: the smallest velocity gives the direction.
            end[m] = -_AT_REST if what.endswith('inward') else _AT_REST
        return time, end, samples, what
